"""Opened recordings, whose episodes are read one after another."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from tqdm import tqdm

from .alignment import Plan, Quality, align, plan, wanted
from .labels import Labeling
from .mapping import Columns, Mapping, MappingError, Sampling
from .streams import Take, checked, seconds


@dataclass(frozen=True)
class Recording:
    """An opened recording."""

    sample_rate_hz: float
    """Samples per second."""
    length: int
    """Number of episodes."""
    episodes: Iterator[Columns]
    """The values of the needed columns in each episode, [samples, …]."""
    places: list[str]
    """Where each episode is in the recording."""
    qualities: list[Quality] = field(default_factory=list)
    """What is known about the times of each stream."""
    left_out: int = 0
    """Samples in no episode, because a stream has a gap there."""
    labels: list[dict[str, Any]] = field(default_factory=list)
    """The labels of each episode."""


def open_streams(mapping: Mapping, sampling: Sampling, progress: bool) -> Recording:
    """Opens a recording of streams. Reads the times of all streams, but no other values.

    Raises:
        MappingError: a file is damaged, does not fit the mapping, or has a gap.
        FileNotFoundError: a file is missing.
        ImportError: a package is missing that reads the files.
    """
    reader = importlib.import_module(f".{mapping.format}", __package__)

    def takes() -> Iterator[Take]:
        first = None
        for take in reader.takes(mapping):
            take = _checked(take, first, mapping, sampling)
            first = first or take
            yield take

    qualities = {name: Quality(name) for name in sampling.streams}
    bar = tqdm(takes(), desc="reading times", unit=" takes", file=sys.stderr, disable=not progress)
    names, plans, labels = [], [], []
    labeling = Labeling(mapping)
    for take in bar:
        names.append(take.name)
        plans.append(plan(take, mapping, sampling, qualities))
        labels += [labeling.of(take.name, take.labels)] * len(plans[-1].spans)
    places = [
        f"{name}, from {seconds(span.times(sampling.sample_rate_hz)[0])} s"
        for name, each in zip(names, plans, strict=True)
        for span in each.spans
    ]
    return Recording(
        sample_rate_hz=sampling.sample_rate_hz,
        length=len(places),
        episodes=_episodes(takes, plans, mapping, sampling),
        places=places,
        qualities=list(qualities.values()),
        left_out=sum(each.left_out for each in plans),
        labels=labels,
    )


def _episodes(
    takes: Callable[[], Iterator[Take]], plans: list[Plan], mapping: Mapping, sampling: Sampling
) -> Iterator[Columns]:
    for take, each in zip(takes(), plans, strict=True):
        for span in each.spans:
            yield align(take, span, mapping, sampling)


def _checked(take: Take, first: Take | None, mapping: Mapping, sampling: Sampling) -> Take:
    """Returns a take with the streams and columns that a mapping uses, with their final times.

    The columns are in the order of the first take, because files may list the same columns in different orders.
    """
    try:
        columns = wanted(mapping.selections, take.columns)
    except MappingError as error:
        raise MappingError(f"{take.name}: {error}") from None
    if first and columns != first.columns:
        _check_equal(take, first, mapping)
        columns = first.columns
    used = {_stream_of(column) for column in columns}
    return Take(
        take.name,
        {
            name: checked(stream, sampling.streams[name], [each for each in columns if _stream_of(each) == name])
            for name, stream in take.streams.items()
            if name in used
        },
        take.labels,
    )


def _stream_of(column: str) -> str:
    return column.partition(".")[0]


def _check_equal(take: Take, first: Take, mapping: Mapping) -> None:
    """Raises a MappingError if a modality has other columns in a take than in the first."""
    for selection in mapping.selections.values():
        found, expected = selection.columns(take.columns), selection.columns(first.columns)
        if sorted(found) != sorted(expected):
            name = _stream_of(min({*found} ^ {*expected}))
            raise selection.error(
                f"{take.streams[name].place} has the columns {', '.join(found)}, and {first.streams[name].place} has "
                f"{', '.join(expected)}; a modality has the same columns in all recordings"
            )


def table(recording: Recording) -> list[str]:
    """Returns the lines of a table of the streams: their rates, jitter, gaps and delay."""
    head = ("stream", "rows", "rate", "jitter", "longest gap", "delay", "transport")
    rows = [head] + [
        (
            each.name,
            str(each.rows),
            f"{each.rate_hz:.4g} Hz",
            duration(each.jitter_s),
            duration(each.gap_ns / 1e9),
            duration(each.delay_s),
            "-" if each.transport_s is None else duration(each.transport_s),
        )
        for each in recording.qualities
        if each.rows
    ]
    widths = np.array([[len(cell) for cell in row] for row in rows]).max(axis=0).tolist()
    aligned = [[cell.ljust(width) for cell, width in zip(row, widths, strict=True)] for row in rows]
    return ["  ".join(row).rstrip() for row in aligned]


def duration(time_s: float) -> str:
    """Returns a time as text, in ms if it is short."""
    return f"{time_s:.3g} s" if abs(time_s) >= 1 else f"{round(time_s * 1e3, 3):.3g} ms"
