"""Writes the folder of a dataset, one episode at a time."""

from __future__ import annotations

import contextlib
import hashlib
import json
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from tqdm import tqdm

from harness._unfinished import LOCK, unfinished_folder
from harness.recorded import (
    FORMAT,
    Episode,
    Layout,
    difference_of,
    image_shapes,
    read_json,
    read_stamped,
    vector_columns,
    write_episode,
)

from .labels import TRIAL, unified
from .mapping import KNOWN, Mapping, MappingError
from .recording import Recording, times

DESCRIPTION = "dataset.json"
"""The file that describes a dataset."""


@dataclass(frozen=True)
class Draft:
    """An episode in a file. It becomes one of the dataset when the name is known, which needs all episodes."""

    path: Path
    index: int
    samples: int
    digest: str
    """SHA-256 of its vectors and images."""
    elements: dict[str, list[str]]
    """The names of the elements of each vector."""
    labels: dict[str, Any]
    """Its labels."""

    @classmethod
    def write(cls, folder: Path, episode: Episode) -> Draft:
        """Writes an episode to a new file in a folder."""
        path = folder / f"draft_{episode.index:05}.npy"
        with open(path, "wb") as file:
            for values in [episode.time, *episode.vectors.values(), *episode.images.values()]:
                np.save(file, values, allow_pickle=False)
        return cls(path, episode.index, len(episode), _digest(episode), episode.elements, episode.labels)

    def read(self, mapping: Mapping, labels: dict[str, Any], labeled: dict[str, np.ndarray]) -> Episode:
        """Reads the episode, and gives it labels, and vectors that are the same at all samples."""
        images = [name for name, selection in mapping.selections.items() if selection.size is not None]
        with open(self.path, "rb") as file:
            time = np.load(file)
            vectors = {name: np.load(file) for name in self.elements}
            vectors |= {name: np.tile(values, (len(time), 1)) for name, values in labeled.items()}
            return Episode(self.index, time, vectors, {name: np.load(file) for name in images}, labels)


def write_dataset(
    mapping: Mapping, recording: Recording, episodes: Iterable[Episode], results: Path, progress: bool
) -> str:
    """Writes the dataset of a recording, and returns its name. If it is there already, only its missing and damaged
    files are written. Has one episode at a time in memory.

    Raises:
        MappingError: the episodes do not fit each other. Whatever `episodes` raises is raised as well.
        OSError: the folder can't be written.
    """
    with _made(results), unfinished_folder(results, "import") as unfinished:
        unfinished.chmod(0o755)
        drafts = [Draft.write(unfinished, episode) for episode in episodes]
        labels, kinds = unified([draft.labels for draft in drafts])
        labeled = {name: each.of(labels) for name, each in mapping.labeled.items()}
        named = drafts[0].elements | {name: list(categories.names) for name, (categories, _) in labeled.items()}
        identity = _identity(mapping, recording.sample_rate_hz, drafts, named, labels, kinds)
        # The Rust program computes the same hash from the same text, in which letters beyond ASCII are not escaped.
        text = json.dumps(identity, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
        name = f"{mapping.name}-{hashlib.sha256(text.encode()).hexdigest()[:16]}"
        folder = results / "datasets" / name
        layout = identity["imported"]["layout"]
        for draft in tqdm(drafts, desc="writing", unit=" episodes", file=sys.stderr, disable=not progress):
            file = f"episode_{draft.index:05}.parquet"
            if not _is_intact(read_stamped, folder / file, name, draft.index):
                of_labels = {
                    modality: categories.elements(np.array([numbers[draft.index]]))
                    for modality, (categories, numbers) in labeled.items()
                }
                episode = draft.read(mapping, labels[draft.index], of_labels)
                write_episode(unfinished / file, name, name, episode, layout)
            draft.path.unlink(missing_ok=True)
        if not _is_intact(_read_description, folder / DESCRIPTION, identity):
            rest = {"mapping": mapping.text, "import": _report(mapping, recording)}
            description = json.dumps(identity | rest, indent=2, allow_nan=False)
            (unfinished / DESCRIPTION).write_text(description + "\n", encoding="utf-8")
        folder.parent.mkdir(exist_ok=True)
        _move(unfinished, folder)
    return name


def _report(mapping: Mapping, recording: Recording) -> dict[str, Any]:
    """Returns what the dataset's page shows of the import: where modalities are from, the times of streams, and what was
    left out or changed."""
    sources = {name: " + ".join(selection.terms) for name, selection in mapping.selections.items()}
    sources |= {name: f"the label {each.label}" for name, each in mapping.labeled.items()}
    return {"sources": sources, "streams": times(recording), "cleaned": mapping.counts.lines}


def _is_intact(read: Callable[..., object], *arguments: object) -> bool:
    """Returns whether a file can be read: it is there, and was not changed since it was written."""
    try:
        read(*arguments)
    # Polars raises errors of its own for a damaged file.
    except (OSError, ValueError, pl.exceptions.PolarsError):
        return False
    return True


def _read_description(path: Path, identity: dict[str, Any]) -> None:
    """Reads the description of a dataset.

    Raises:
        OSError: it can't be read.
        ValueError: it is damaged, or describes another dataset.
    """
    found = read_json(path)
    if not isinstance(found, dict) or {key: found.get(key) for key in identity} != identity:
        raise ValueError(f"{path} does not describe this dataset")


def _move(unfinished: Path, folder: Path) -> None:
    """Moves the new files to a dataset's folder. Nobody ever sees a part of a file."""
    if not folder.exists():
        try:
            unfinished.rename(folder)
            return
        except OSError:
            # Another process may have imported the same dataset meanwhile.
            if not folder.exists():
                raise
    # The description comes last, so that a dataset without episodes is not taken for whole.
    for path in sorted(unfinished.iterdir(), key=lambda path: path.name == DESCRIPTION):
        if path.name != LOCK:
            path.replace(folder / path.name)


@contextlib.contextmanager
def _made(folder: Path) -> Iterator[None]:
    """Makes a folder, and removes it if the work in it fails and leaves it empty."""
    missing = [path for path in [folder, *folder.parents] if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    try:
        yield
    except BaseException:
        with contextlib.suppress(OSError):
            for path in missing:
                path.rmdir()
        raise


def _identity(
    mapping: Mapping,
    rate: float,
    drafts: list[Draft],
    named: dict[str, list[str]],
    labels: list[dict[str, Any]],
    kinds: list[dict[str, str]],
) -> dict[str, Any]:
    """Returns what a dataset's hash is computed from. `named` has the names of the elements of each vector."""
    for draft in drafts:
        for name, elements in draft.elements.items():
            if len(elements) != len(named[name]):
                raise MappingError(
                    f"modalities.{name}: has {len(elements)} values in episode {draft.index} and {len(named[name])} in "
                    "the first"
                )
    layout = _layout(mapping, named) | {"labels": kinds}
    elements = {column.name for each in vector_columns(layout).values() for column in each}
    for image in sorted(elements & image_shapes(layout).keys()):
        raise MappingError(f"modalities.{image}: a vector has a column of this name; give the image another name")
    for label in kinds:
        if label["name"] in elements | image_shapes(layout).keys():
            raise MappingError(f"the label '{label['name']}' is also a column of a modality; give one another name")
    # As text, because Python and Rust write some numbers differently.
    texts = [{key: None if value is None else str(value) for key, value in each.items()} for each in labels]
    content = {
        "layout": layout,
        "name": mapping.name,
        "sample_rate_hz": rate,
        "modalities": [name for name in (*mapping.selections, *mapping.labeled) if name != "setpoint"],
        "split": _split(mapping.text.get("split"), labels),
        "episodes": [
            {"samples": draft.samples, "sha256": draft.digest, "labels": texts[draft.index]} for draft in drafts
        ],
    }
    return {"format": FORMAT, "imported": content}


def _split(asked: dict[str, Any] | None, labels: list[dict[str, Any]]) -> dict[str, Any]:
    """Returns how runs divide the dataset unless they ask for another split: as the mapping says, or whole trials at
    random, or the time of a recording of so few trials that training, validation and test can't have one each."""
    if asked is None:
        return {"by": TRIAL, "seed": 0} if len({each[TRIAL] for each in labels}) >= 3 else {"by": "time"}
    by = asked["by"]
    if by in ("episode", "time", "sample"):
        return asked
    if by not in labels[0]:
        raise MappingError(f"split.by: there is no label '{by}'; the labels are {', '.join(labels[0])}")
    values = {str(each[by]) for each in labels}
    tested = asked["test"] if isinstance(asked.get("test"), list) else []
    for value in tested:
        if str(value) not in values:
            raise MappingError(f"split.test: no episode has the {by} {value}; there are {', '.join(sorted(values))}")
    return {"seed": 0} | asked


def _layout(mapping: Mapping, named: dict[str, list[str]]) -> Layout:
    """Returns the layout of a dataset, given the names of the elements of its vectors."""
    modalities: list[dict[str, Any]] = []
    for name, selection in mapping.selections.items():
        known = KNOWN.get(name)
        if selection.size is not None:
            image = {"kind": "image", "size": list(selection.size), "scale": "shared"}
            modalities.append({"name": name, "meaning": "Image", **image})
            meaning = f"Change of {name} since the sample before"
            modalities.append({"name": difference_of(name), "meaning": meaning, **image, "difference_of": name})
        elif known and len(known["elements"]) == len(named[name]):
            modalities.append(known)
        elif selection.categories:
            modalities.append(_of_categories(name, named[name]))
        else:
            units = {element["unit"] for element in known["elements"]} if known else {selection.unit}
            unit = units.pop() if len(units) == 1 else ""
            elements = [{"name": element, "unit": unit} for element in named[name]]
            keep = ("scale", "minimum", "percentage")
            rest = {key: known[key] for key in keep if key in known} if known else {"scale": "per_element"}
            modalities.append({"name": name, "meaning": "Value", "kind": "vector", "elements": elements, **rest})
    return {"modalities": modalities + [_of_categories(name, named[name]) for name in mapping.labeled]}


def _of_categories(name: str, named: list[str]) -> dict[str, Any]:
    """Returns the definition of a modality, given the names of its categories."""
    elements = [{"name": element, "unit": ""} for element in named]
    vector = {"name": name, "meaning": "Whether it is", "kind": "vector", "elements": elements}
    return vector | {"scale": "per_element", "category": True}


def _digest(episode: Episode) -> str:
    """Returns the SHA-256 of all vectors and images of an episode."""
    digest = hashlib.sha256()
    for name, values in [*episode.vectors.items(), *episode.images.items()]:
        if len(values):
            digest.update(name.encode())
            digest.update(np.ascontiguousarray(values, values.dtype.newbyteorder("<")).tobytes())
    return digest.hexdigest()
