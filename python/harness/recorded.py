"""Reads and writes dataset folders: a sealed Parquet file per episode, and `dataset.json`."""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

FORMAT = 2
"""The format of the files that this version reads and writes. It equals `FORMAT` of the Rust crate `dataset`."""

Layout = dict[str, Any]
"""The layout of a dataset's samples, from its `dataset.json`: `modalities`, and `regions` of the images."""

FINGER: Layout = json.loads((Path(__file__).parent / "models" / "finger.json").read_text(encoding="utf-8"))
"""The layout of the worlds `empty` and `cluttered`."""

PAPER = ("empty", "cluttered")
"""The worlds of the paper."""


@dataclass(frozen=True)
class Column:
    """A column of the episodes' files."""

    name: str
    """The column's name in the file."""
    kind: str
    """`text`, `integer`, `real` or `bytes`."""
    unit: str
    """The unit of its values; empty if they have none."""
    meaning: str
    """A description for the file's metadata."""


KEY_COLUMNS = (
    Column("dataset", "text", "", "the dataset's folder"),
    Column("scenario", "text", "", "empty, cluttered, the name of a world file, or the name of an imported dataset"),
    Column("episode", "integer", "1", "episode of the dataset"),
    Column("sample", "integer", "1", "counted from 0 within the episode"),
    Column("time", "real", "s", "time since the episode's start"),
)
"""The first columns of every episode's file."""


def _stored(layout: Layout, kind: str) -> list[dict[str, Any]]:
    """The modalities of a kind that the files contain. They contain no differences, which are computed."""
    return [each for each in layout["modalities"] if each["kind"] == kind and not each.get("difference_of")]


def vector_columns(layout: Layout) -> dict[str, tuple[Column, ...]]:
    """The columns of each vector, in the order of its elements, by its name, such as `proprioception`."""
    return {
        vector["name"]: tuple(
            Column(
                f"{vector['name']}_{element['name']}",
                "real",
                element.get("unit", ""),
                f"{vector.get('meaning', '')} {element['name']}",
            )
            for element in vector["elements"]
        )
        for vector in _stored(layout, "vector")
    }


def image_shapes(layout: Layout) -> dict[str, tuple[int, int, int]]:
    """Rows, columns and channels of each image, by its name."""
    return {image["name"]: (*image["size"], 3) for image in _stored(layout, "image")}


def difference_of(image: str) -> str:
    """Returns the name of an image's change since the sample before."""
    return "frame_difference" if image == "vision" else f"{image}_difference"


def columns(layout: Layout) -> list[Column]:
    """The columns of an episode's file, in order. A test compares them with those that the Rust program writes."""
    images = [
        Column(
            name,
            "bytes",
            "",
            f"image, {rows} x {width} x 3 bytes: rows from the top, pixels from the left, RGB",
        )
        for name, (rows, width, _) in image_shapes(layout).items()
    ]
    vectors = [column for elements in vector_columns(layout).values() for column in elements]
    labels = [Column(each["name"], each["kind"], "", "label of the episode") for each in layout.get("labels", [])]
    return [*KEY_COLUMNS, *labels, *vectors, *images]


_SEAL = b"sha256-seal:"
_DIGITS = 64


class DamagedError(ValueError):
    """A file has changed since it was written."""


@dataclass(frozen=True)
class Episode:
    """The samples of one episode."""

    index: int
    """The episode's number in its dataset, from 0."""
    time: np.ndarray
    """Time since the episode's start, s, [samples]."""
    vectors: dict[str, np.ndarray]
    """float32 [samples, elements] by name, in the units of the files' columns."""
    images: dict[str, np.ndarray]
    """uint8 [samples, rows, columns, 3] by name."""
    labels: dict[str, Any] = dataclasses.field(default_factory=dict)
    """What was the same during the episode, by name."""
    elements: dict[str, list[str]] = dataclasses.field(default_factory=dict)
    """The names of the elements of each vector; empty if they are those of a layout."""

    def __len__(self) -> int:
        return len(self.time)


class RecordedDataset:
    """A dataset's folder, `results/datasets/SCENARIO-HASH`.

    Raises:
        FileNotFoundError: the folder contains no dataset.
        ValueError: the dataset has the format of another version, or was imported.
    """

    def __init__(self, folder: str | Path):
        self.folder = Path(folder)
        try:
            self.description = read_json(self.folder / "dataset.json")
        except (FileNotFoundError, NotADirectoryError):
            raise FileNotFoundError(
                f"{self.folder} contains no dataset: a dataset is a folder with a dataset.json, as in results/datasets"
            ) from None
        if self.description.get("format") != FORMAT:
            found = self.description.get("format")
            raise ValueError(f"{self.folder} is in format {found}; this version reads format {FORMAT}")
        if "simulation" not in self.description:
            raise ValueError(f"{self.folder} was imported; only simulated datasets are exported")

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.folder.resolve().name

    @property
    def layout(self) -> Layout:
        """The layout of its samples."""
        layout: Layout = self.description["layout"]
        return layout

    @property
    def scenario(self) -> str:
        """The world that was simulated: `empty`, `cluttered`, or the name of a world file."""
        return str(self.description["scenario"])

    @property
    def is_finger(self) -> bool:
        """Whether it records what the built-in worlds `empty` and `cluttered` do, and maybe more."""
        return self.scenario in PAPER and vector_columns(FINGER).items() <= vector_columns(self.layout).items()

    @property
    def sample_rate_hz(self) -> float:
        """Samples per second."""
        return float(self.description["simulation"]["sample_rate_hz"])

    @property
    def episodes(self) -> range:
        """Indices of all episodes of the dataset, including those that are not collected yet."""
        return range(self.description["simulation"]["episodes"])

    @property
    def samples_per_episode(self) -> int:
        """Number of samples of each episode."""
        spec = self.description["simulation"]
        return int(spec["actuations_per_episode"] * round(spec["actuation_seconds"] * spec["sample_rate_hz"]))

    def choose(self, episodes: Iterable[int] | None) -> list[int]:
        """Returns the given episodes, sorted, or all episodes if None. Checks that they are on disk.

        Raises:
            ValueError: one is not an episode of the dataset.
            FileNotFoundError: one is not collected yet.
        """
        chosen = sorted(set(self.episodes if episodes is None else episodes))
        foreign = [index for index in chosen if index not in self.episodes]
        if foreign or not chosen:
            what = f"{foreign[0]} is none of them" if foreign else "none is named"
            raise ValueError(f"episodes: {self.name} has 0 to {len(self.episodes) - 1}; {what}")
        missing = [index for index in chosen if not self._path(index).exists()]
        if missing:
            raise FileNotFoundError(
                f"{len(missing)} of {len(chosen)} episodes of {self.name} are not there, the first is {missing[0]}; "
                "collect them with `harness collect`, or name those that are there"
            )
        return chosen

    def read(self, index: int) -> Episode:
        """Reads one episode.

        Raises:
            FileNotFoundError: there is no such file.
            DamagedError: the file has changed since it was written, or is another episode's.
        """
        table = pl.read_parquet(io.BytesIO(read_stamped(self._path(index), self.name, index)))
        return Episode(
            index=index,
            time=table["time"].to_numpy(),
            vectors={
                vector: table.select(column.name for column in columns).to_numpy()
                for vector, columns in vector_columns(self.layout).items()
            },
            images={
                name: np.frombuffer(b"".join(table[name]), np.uint8).reshape(-1, *shape)
                for name, shape in image_shapes(self.layout).items()
            },
        )

    def _path(self, index: int) -> Path:
        return self.folder / f"episode_{index:05}.parquet"


def read_sealed(path: Path) -> bytes:
    """Reads a file and checks its seal: the SHA-256 of the file in which the seal's digits are replaced by dashes.

    Raises:
        DamagedError: the file has changed since it was written, or has no seal.
    """
    data = path.read_bytes()
    start = data.rfind(_SEAL) + len(_SEAL)
    if start < len(_SEAL):
        raise DamagedError(
            f"{path} is damaged: it has no seal; its end is missing, or the harness did not write it"
        )
    digest = _digest(data, start)
    if data[start : start + _DIGITS] != digest:
        raise DamagedError(f"{path} is damaged: it has changed since it was written: its SHA-256 differs")
    return data


def read_stamped(path: Path, dataset: str, index: int) -> bytes:
    """Reads the file of an episode of a dataset, as `read_sealed` does.

    Raises:
        DamagedError: the file has changed since it was written, or is another episode's.
    """
    data = read_sealed(path)
    stamp = pl.read_parquet_metadata(io.BytesIO(data))
    if (stamp.get("harness.dataset"), stamp.get("harness.episode")) != (dataset, str(index)):
        raise DamagedError(f"{path} is damaged: it is not episode {index} of {dataset}")
    return data


def read_json(path: Path) -> Any:
    """Reads a JSON file as the Rust program does, to which `NaN` and `Infinity` are no numbers.

    Raises:
        OSError: the file can't be read.
        DamagedError: it is no JSON.
    """

    def refuse(constant: str) -> None:
        raise ValueError(f"{constant} is no number in JSON")

    try:
        return json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)
    except ValueError as error:
        raise DamagedError(f"{path} is damaged: {error}") from None


def _digest(data: bytes, start: int) -> bytes:
    """Computes the seal of `data`, whose digits begin at `start`."""
    digest = hashlib.sha256(data[:start])
    digest.update(b"-" * _DIGITS)
    digest.update(data[start + _DIGITS :])
    return digest.hexdigest().encode()


def write_episode(path: Path, dataset: str, scenario: str, episode: Episode, layout: Layout) -> None:
    """Writes and seals an episode's file."""
    samples = len(episode)
    values = {
        "dataset": pl.repeat(dataset, samples, eager=True),
        "scenario": pl.repeat(scenario, samples, eager=True),
        "episode": pl.repeat(episode.index, samples, dtype=pl.UInt32, eager=True),
        "sample": pl.arange(samples, dtype=pl.UInt32, eager=True),
        "time": pl.Series(episode.time, dtype=pl.Float64),
    }
    kinds = {"text": pl.String, "integer": pl.Int64, "real": pl.Float64}
    for label in layout.get("labels", []):
        values[label["name"]] = pl.Series([episode.labels[label["name"]]] * samples, dtype=kinds[label["kind"]])
    for vector, elements in vector_columns(layout).items():
        for place, column in enumerate(elements):
            values[column.name] = pl.Series(episode.vectors[vector][:, place], dtype=pl.Float32)
    for name in image_shapes(layout):
        values[name] = pl.Series([image.tobytes() for image in episode.images[name]], dtype=pl.Binary)
    metadata = {
        "harness.columns": json.dumps([dataclasses.asdict(column) for column in columns(layout)]),
        "harness.dataset": dataset,
        "harness.episode": str(episode.index),
        "harness.seal": (_SEAL + b"-" * _DIGITS).decode(),
    }
    buffer = io.BytesIO()
    table = pl.DataFrame({column.name: values[column.name] for column in columns(layout)})
    table.write_parquet(buffer, metadata=metadata)
    data = bytearray(buffer.getvalue())
    start = data.rfind(_SEAL) + len(_SEAL)
    data[start : start + _DIGITS] = _digest(bytes(data), start)
    path.write_bytes(data)
