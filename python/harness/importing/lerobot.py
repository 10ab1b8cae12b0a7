"""Reads LeRobot datasets, whose rows are the samples."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from harness._paths import plain_path

from .alignment import wanted
from .labels import Labeling
from .mapping import Columns, Mapping, MappingError, with_numbers
from .recording import Recording
from .streams import irregular


def open_lerobot(mapping: Mapping) -> Recording:
    """Opens a LeRobot dataset.

    Raises:
        MappingError: it can't be read, or does not fit the mapping.
        ImportError: the package lerobot is not installed.
    """
    try:
        from lerobot.datasets import LeRobotDataset
    except ImportError as error:
        raise ImportError(
            f"importing from LeRobot needs the package lerobot: pip install 'lerobot[dataset]' ({error})"
        ) from error
    if not (mapping.source / "meta/info.json").exists():
        raise MappingError(f"source: {mapping.source} is no LeRobot dataset: it has no meta/info.json")
    # LeRobot reads the frames later, so the path must stay until the last episode.
    kept = contextlib.ExitStack()
    root = kept.enter_context(plain_path(mapping.source))
    with _blaming(mapping.source):
        dataset = LeRobotDataset("local/source", root=root, video_backend="pyav", return_uint8=True)
    columns = wanted(mapping.selections, list(dataset.meta.features))

    pictures = {name for name, feature in dataset.meta.features.items() if feature["dtype"] in ("image", "video")}
    places = [f"{mapping.source}, episode {index}" for index in range(len(dataset.meta.episodes))]

    def read(episode: Any, place: str) -> Columns:
        rows = range(episode["dataset_from_index"], episode["dataset_to_index"])
        with _blaming(mapping.source):
            items = [dataset[row] for row in rows]
            times = np.array([float(item["timestamp"]) for item in items])
        if problem := irregular(times, 1 / dataset.fps):
            row, how = problem
            raise MappingError(f"{place}: frame {row}: {how} at {dataset.fps:g} fps; each frame is a sample")
        stacked = {name: np.stack([_plain(item[name], name in pictures) for item in items]) for name in columns}
        return with_numbers(stacked, mapping.selections)

    def episodes() -> Iterator[Callable[[], Columns]]:
        with kept:
            for episode, place in zip(dataset.meta.episodes, places, strict=True):
                yield partial(read, episode, place)

    labeling = Labeling(mapping)
    labels = [labeling.of(str(index), {}) for index in range(len(places))]
    return Recording(float(dataset.fps), len(places), episodes(), places, labels=labels)


@contextlib.contextmanager
def _blaming(source: Path) -> Iterator[None]:
    """Turns any exception of LeRobot into a MappingError, because LeRobot raises many kinds for a damaged dataset."""
    try:
        yield
    except Exception as error:
        raise MappingError(f"source: LeRobot can't read {source}: {' '.join(str(error).split())}") from error


def _plain(value: Any, is_picture: bool) -> np.ndarray:
    """Returns a tensor as an array. The channels of a picture become its last axis, and its values are 0 to 255."""
    array: np.ndarray = value.numpy()
    if not is_picture:
        return array
    # The pixels of image files are divided by 255, and those of videos are not.
    array = np.rint(array * 255).astype(np.uint8) if array.dtype.kind == "f" else array
    return array.transpose(1, 2, 0)
