"""Imports LeRobot datasets and plain Parquet files that were recorded elsewhere as datasets of the harness.

    harness import MAPPING.yaml

prints the dataset's name, which specs use as a scenario: `scenarios: [lab_finger-0123456789abcdef]`. The mapping
defines which columns of the recording make up which modality:

    name: lab_finger                # the dataset becomes results/datasets/lab_finger-HASH
    source: recordings              # a LeRobot dataset's folder, a Parquet file, or a folder of Parquet files
    format: lerobot                 # or parquet
    modalities:
      setpoint: action                            # what was commanded; the only one that every dataset needs
      proprioception: observation.state[0:20]     # elements of a column of lists
      arm: [rotation, lift, extension]            # several columns
      contact_force: force_??                     # columns by a pattern of * and ?, in their order in the file
      contact_force_mean: {from: mean_??, scale: 9.81}      # a factor, or one per element, into rad, m and N
      vision: observation.images.external         # pictures of any size
      touch: {from: "pad_?", unit: N}             # any other name is a new vector, with its unit
      wrist: {from: observation.images.wrist, size: [96, 96]}     # or a new image, with its rows and columns
    episode: episode                # Parquet only: the column whose value differs between episodes,
    order: sample                   # Parquet only: the column by which an episode's rows are sorted,
    sample_rate_hz: 10              # Parquet only: samples per second

`source` is relative to the mapping's folder. Vectors may have any width. The names of the finger's modalities have a
fixed meaning: `vision` is an image and becomes 64 x 64 pixels unless it has a `size`, forces are in N and never
negative, and so on.
"""

from __future__ import annotations

import argparse
import contextlib
import fnmatch
import hashlib
import io
import json
import re
import shutil
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from harness.recorded import FINGER, FORMAT, Episode, Layout, write_episode

try:
    import yaml
    from PIL import Image
    from tqdm import tqdm
except ImportError as error:
    raise ImportError(
        f"importing needs the packages pillow, pyyaml and tqdm: pip install pillow pyyaml tqdm ({error})"
    ) from error

SCENARIOS = ("empty", "cluttered")
FORMATS = ("lerobot", "parquet")
RESERVED = ("dataset", "scenario", "episode", "sample", "time", "action", "kl", "total", "frame_difference")
"""Names that no modality may have, because they have another meaning or are computed."""
MAX_SIDE = 1024
"""The largest number of rows or columns of an image, pixels."""

KNOWN: dict[str, dict[str, Any]] = {each["name"]: each for each in FINGER["modalities"]}
"""The finger's modalities by name, as its layout defines them."""
PARQUET_KEYS = ("episode", "order", "sample_rate_hz")
"""Keys that a mapping of Parquet files needs in addition."""

Columns = dict[str, Any]
"""The values of a recording's columns in one episode, by name: arrays or lists, [samples, …]."""

_TERM = re.compile(r"(?P<column>[^\[\]]+)(\[(?P<first>\d+)(:(?P<last>\d+))?\])?")


class MappingError(ValueError):
    """A mapping is wrong or does not fit the recording. The message says where and why."""


@dataclass(frozen=True)
class Selection:
    """Which columns of a recording make up a modality, from a mapping."""

    modality: str
    """Name of the modality."""
    terms: tuple[str, ...]
    """Columns, elements of columns, or patterns, such as `action`, `state[0:20]` or `force_??`."""
    scale: np.ndarray | None
    """float64, one factor or one per element; None for values that are already in the harness's units."""
    unit: str = ""
    """The unit of a vector that the finger does not have."""
    size: tuple[int, int] | None = None
    """Rows and columns of an image; None for a vector."""

    def columns(self, available: list[str]) -> list[str]:
        """Returns the names of the columns that it needs, out of those available.

        Raises:
            MappingError: a term matches no column.
        """
        return [column for term in self.terms for column, _ in self._matches(term, available)]

    def pick(self, episode: Columns) -> np.ndarray:
        """Returns the modality's values, float32 [samples, elements].

        Raises:
            MappingError: there are no values, they are not finite numbers, or `scale` has another number of elements.
        """
        parts = []
        for term in self.terms:
            for column, elements in self._matches(term, list(episode)):
                try:
                    values = np.asarray(episode[column], np.float64)
                except (TypeError, ValueError):
                    raise self.error(f"'{column}' holds no numbers, or lists of different lengths") from None
                parts.append(values.reshape(len(values), -1)[:, elements])
        values = np.concatenate(parts, axis=1)
        if values.shape[1] == 0:
            raise self.error(f"{' + '.join(self.terms)} gives no values")
        if self.scale is not None and len(self.scale) not in (1, values.shape[1]):
            raise self.error(f"scale: must be 1 number or {values.shape[1]}, not {len(self.scale)}")
        if self.scale is not None:
            values = values * self.scale
        with np.errstate(over="ignore"):
            values = values.astype(np.float32)
        if not np.isfinite(values).all():
            row, element = np.argwhere(~np.isfinite(values))[0]
            raise self.error(
                f"value {element} of row {row} is {values[row, element]}; nothing can be learnt from it"
            )
        return values

    def error(self, problem: str) -> MappingError:
        """Returns an error whose message begins with the modality's place in the mapping."""
        return MappingError(f"modalities.{self.modality}: {problem}")

    def _matches(self, term: str, available: list[str]) -> list[tuple[str, slice]]:
        """Returns the columns that a term matches, each with the slice of its elements."""
        found = _TERM.fullmatch(term)
        if not found:
            raise self.error(
                f"'{term}' is not understood; write COLUMN, COLUMN[3], COLUMN[0:20] or PATTERN_*"
            )
        is_pattern = "*" in found["column"] or "?" in found["column"]
        names = fnmatch.filter(available, found["column"]) if is_pattern else [found["column"]]
        unknown = [name for name in names if name not in available]
        if unknown or not names:
            raise self.error(
                f"there is no column '{found['column']}'; the columns are {', '.join(available)}"
            )
        first = int(found["first"] or 0)
        last = int(found["last"]) if found["last"] else first + 1 if found["first"] else None
        return [(name, slice(first, last)) for name in names]


@dataclass(frozen=True)
class Rows:
    """How the rows of Parquet files form episodes."""

    episode: str
    """The column whose value differs between episodes."""
    order: str
    """The column by which an episode's rows are sorted."""
    sample_rate_hz: float
    """Samples per second."""


@dataclass(frozen=True)
class Mapping:
    """The content of a mapping's file."""

    name: str
    """The dataset's name, without the hash."""
    source: Path
    """The recording: a folder or a file."""
    selections: dict[str, Selection]
    """The columns of each modality, by its name."""
    rows: Rows | None
    """Set for Parquet files only."""
    text: dict[str, Any]
    """The parsed YAML of the file."""

    @classmethod
    def load(cls, path: Path) -> Mapping:
        """Reads a mapping.

        Raises:
            FileNotFoundError: there is no such file, or no source.
            MappingError: a key is missing, unknown or has a wrong value.
        """
        try:
            text = yaml.safe_load(path.read_text())
        except (yaml.YAMLError, UnicodeDecodeError) as error:
            raise MappingError(f"{path} is no YAML: {' '.join(str(error).split())}") from None
        try:
            return cls._of(text, path.parent)
        except MappingError as error:
            raise MappingError(f"{path}: {error}") from None

    @classmethod
    def _of(cls, text: Any, folder: Path) -> Mapping:
        if not isinstance(text, dict):
            raise MappingError("a mapping has the keys name, source, format and modalities")
        required: tuple[str, ...] = ("name", "source", "format", "modalities")
        kind = text.get("format")
        if kind not in FORMATS:
            raise MappingError(f"format: must be {' or '.join(FORMATS)}, not {kind!r}")
        required += PARQUET_KEYS if kind == "parquet" else ()
        _check_keys(text, required, "")
        name = text["name"]
        if not re.fullmatch(r"[a-z][a-z0-9_]{0,63}", str(name)) or name in SCENARIOS:
            raise MappingError(
                f"name: {name!r} can't name an imported dataset; use 1 to 64 small letters, digits and _, and none of "
                f"{', '.join(SCENARIOS)}"
            )
        rows = None
        if kind == "parquet":
            rate = text["sample_rate_hz"]
            if not (isinstance(rate, int | float) and 0.01 <= rate <= 1000):
                raise MappingError(f"sample_rate_hz: must be a number of 0.01 to 1000, not {rate!r}")
            rows = Rows(str(text["episode"]), str(text["order"]), float(rate))
        source = folder / str(text["source"])
        if not source.exists():
            raise FileNotFoundError(f"source: {source} is not there")
        return cls(name, source, _selections(text["modalities"]), rows, text)


def _selections(modalities: Any) -> dict[str, Selection]:
    if not isinstance(modalities, dict):
        raise MappingError("modalities: must say what makes up each modality, by its name")
    if modalities.get("setpoint") is None:
        raise MappingError("missing 'modalities.setpoint'")
    if len(modalities) == 1:
        raise MappingError(
            "modalities: there is nothing to learn from the setpoint alone; name what was sensed"
        )
    for name in modalities:
        if not re.fullmatch(r"[a-z][a-z0-9_]{0,63}", str(name)) or name in RESERVED:
            raise MappingError(
                f"modalities: {name!r} can't name a modality; use small letters, digits and _, a letter first, and none "
                f"of {', '.join(RESERVED)}"
            )
    # The finger's modalities come first, in their order, so that a dataset of the finger has the same columns.
    given = [name for name in KNOWN if name in modalities]
    return {name: _selection(name, modalities[name]) for name in dict.fromkeys([*given, *modalities])}


def _selection(modality: str, value: Any) -> Selection:
    where = f"modalities.{modality}"
    scale, unit, size = None, "", KNOWN.get(modality, {}).get("size")
    if isinstance(value, dict):
        _check_keys(value, ("from",), f"{where}.", ("from", "scale", "unit", "size"))
        size, unit, scale, value = value.get("size", size), value.get("unit", ""), value.get("scale"), value["from"]
        if modality in KNOWN and (KNOWN[modality]["kind"] == "image") != (size is not None):
            raise MappingError(f"{where}: is a {KNOWN[modality]['kind']}; an image has a size, a vector has none")
        if modality in KNOWN and unit:
            raise MappingError(f"{where}.unit: is that of the finger's; leave it out, or give the modality another name")
    if size is not None and not (
        isinstance(size, list)
        and len(size) == 2
        and all(isinstance(side, int) and 1 <= side <= MAX_SIDE for side in size)
    ):
        raise MappingError(f"{where}.size: must be rows and columns of 1 to {MAX_SIDE} pixels, not {size!r}")
    if scale is not None:
        numbers = scale if isinstance(scale, list) else [scale]
        if size is not None or not all(isinstance(number, int | float) for number in numbers):
            raise MappingError(f"{where}.scale: must be a number or a list of them, and is for vectors alone")
        scale = np.array(numbers, np.float64)
    terms = value if isinstance(value, list) else [value]
    if not terms or not all(isinstance(term, str) for term in terms):
        raise MappingError(f"{where}: must be a column, or a list of columns, not {value!r}")
    if size is not None and len(terms) != 1:
        raise MappingError(f"{where}: must be one column")
    return Selection(modality, tuple(terms), scale, str(unit), tuple(size) if size else None)


def _layout(mapping: Mapping, widths: dict[str, int]) -> Layout:
    """Returns the layout of a dataset, given the widths of its vectors."""
    modalities: list[dict[str, Any]] = []
    for name, selection in mapping.selections.items():
        known = KNOWN.get(name)
        if selection.size is not None:
            image = {"kind": "image", "size": list(selection.size), "scale": "shared"}
            modalities.append({"name": name, "meaning": "Image", **image})
            difference = "frame_difference" if name == "vision" else f"{name}_difference"
            meaning = f"Change of {name} since the sample before"
            modalities.append({"name": difference, "meaning": meaning, **image, "difference_of": name})
        elif known and len(known["elements"]) == widths[name]:
            modalities.append(known)
        else:
            units = {element["unit"] for element in known["elements"]} if known else {selection.unit}
            unit = units.pop() if len(units) == 1 else ""
            elements = [{"name": f"{index:02}", "unit": unit} for index in range(widths[name])]
            keep = ("scale", "minimum", "percentage")
            rest = {key: known[key] for key in keep if key in known} if known else {"scale": "per_element"}
            modalities.append({"name": name, "meaning": "Value", "kind": "vector", "elements": elements, **rest})
    return {"modalities": modalities}


def _check_keys(
    section: dict[str, Any], required: tuple[str, ...], prefix: str, allowed: tuple[str, ...] | None = None
) -> None:
    allowed = allowed or required
    for key in section:
        if key not in allowed:
            raise MappingError(f"unknown key '{prefix}{key}'; allowed are {', '.join(allowed)}")
    missing = [key for key in required if section.get(key) is None]
    if missing:
        raise MappingError(f"missing '{prefix}{missing[0]}'")


def import_dataset(mapping: str | Path, results: str | Path = "results", *, progress: bool = True) -> str:
    """Imports a recording. The whole recording is read into memory.

    Args:
        mapping: the mapping's file; the module's documentation describes it.
        results: the results folder. The dataset is written to `datasets` in it, unless it is there already.
        progress: whether to show a progress bar on stderr.

    Returns:
        The dataset's name, which ends in a hash of its content. Specs use it in `scenarios`.

    Raises:
        ValueError: the mapping or the recording is wrong; the message says where.
        FileNotFoundError: the mapping or its source does not exist.
        ImportError: the recording is a LeRobot dataset, and the package lerobot is not installed.
    """
    chosen = Mapping.load(Path(mapping))
    try:
        rate, episodes = _read(chosen, progress)
    except MappingError as error:
        raise MappingError(f"{mapping}: {error}") from None
    return _write(chosen, rate, episodes, Path(results))


def _read(mapping: Mapping, progress: bool) -> tuple[float, list[Episode]]:
    """Returns the recording's samples per second and its episodes."""
    recording = _open_parquet(mapping, mapping.rows) if mapping.rows else _open_lerobot(mapping)
    rate, episodes = recording.sample_rate_hz, []
    bar = tqdm(
        recording.episodes,
        desc=mapping.name,
        total=recording.length,
        unit=" episodes",
        file=sys.stderr,
        disable=not progress,
    )
    for index, columns in enumerate(bar):
        try:
            episodes.append(_episode(index, columns, mapping, rate))
        except MappingError as error:
            raise MappingError(f"episode {index}: {error}") from None
    if len(episodes) < 3:
        raise MappingError(
            f"{len(episodes)} episodes were found; training, validation and test need one each"
        )
    return rate, episodes


@dataclass(frozen=True)
class Recording:
    """An opened recording."""

    sample_rate_hz: float
    """Samples per second."""
    length: int
    """Number of episodes."""
    episodes: Iterator[Columns]
    """The values of the needed columns in each episode, [samples, …]."""


def _wanted(mapping: Mapping, available: list[str]) -> list[str]:
    columns = [column for selection in mapping.selections.values() for column in selection.columns(available)]
    return list(dict.fromkeys(columns))


def _open_parquet(mapping: Mapping, what: Rows) -> Recording:
    files = sorted(mapping.source.glob("**/*.parquet")) if mapping.source.is_dir() else [mapping.source]
    if not files:
        raise FileNotFoundError(f"source: {mapping.source} holds no .parquet file")
    keys = list(dict.fromkeys([what.episode, what.order]))
    try:
        table = pl.scan_parquet(files, hive_partitioning=False)
        available = table.collect_schema().names()
        for key in keys:
            if key not in available:
                raise MappingError(f"there is no column '{key}'; the columns are {', '.join(available)}")
        wanted = _wanted(mapping, available)
        rows = table.select(list(dict.fromkeys([*keys, *wanted]))).sort(keys).collect()
    except pl.exceptions.PolarsError as error:
        raise MappingError(f"source: {mapping.source} can't be read: {error}") from None
    if rows.select(keys).is_duplicated().any():
        raise MappingError(f"order: two rows of an episode have the same '{what.order}'")
    groups = rows.partition_by(what.episode, maintain_order=True)
    episodes = ({name: group[name].to_list() for name in wanted} for group in groups)
    return Recording(what.sample_rate_hz, len(groups), episodes)


def _open_lerobot(mapping: Mapping) -> Recording:
    try:
        from lerobot.datasets import LeRobotDataset
    except ImportError as error:
        raise ImportError(
            f"importing from LeRobot needs the package lerobot: pip install 'lerobot[dataset]' ({error})"
        ) from error
    if not (mapping.source / "meta/info.json").exists():
        raise MappingError(f"source: {mapping.source} is no LeRobot dataset: it has no meta/info.json")
    with _blaming(mapping.source):
        dataset = LeRobotDataset("local/source", root=mapping.source, video_backend="pyav", return_uint8=True)
    wanted = _wanted(mapping, list(dataset.meta.features))

    def episodes() -> Iterator[Columns]:
        for episode in dataset.meta.episodes:
            rows = range(episode["dataset_from_index"], episode["dataset_to_index"])
            with _blaming(mapping.source):
                items = [dataset[row] for row in rows]
            yield {name: np.stack([_plain(item[name]) for item in items]) for name in wanted}

    return Recording(float(dataset.fps), len(dataset.meta.episodes), episodes())


@contextlib.contextmanager
def _blaming(source: Path) -> Iterator[None]:
    """Turns any exception of LeRobot into a MappingError, because LeRobot raises many kinds for a damaged dataset."""
    try:
        yield
    except Exception as error:
        raise MappingError(f"source: LeRobot can't read {source}: {' '.join(str(error).split())}") from error


def _plain(value: Any) -> np.ndarray:
    """Returns a tensor as an array. The channels of a picture become its last axis."""
    array: np.ndarray = value.numpy()
    return array.transpose(1, 2, 0) if array.ndim == 3 else array


def _episode(index: int, columns: Columns, mapping: Mapping, rate: float) -> Episode:
    samples = len(next(iter(columns.values())))
    if samples < 2:
        raise MappingError("it has 1 sample; a prediction needs a next one")
    selections = mapping.selections
    vectors = {name: each.pick(columns) for name, each in selections.items() if each.size is None}
    images = {}
    for name, selection in selections.items():
        if selection.size is not None:
            (column,) = selection.columns(list(columns))
            shape = (*selection.size, 3)
            images[name] = np.stack([_frame(picture, selection, shape) for picture in columns[column]])
    return Episode(index, np.arange(samples) / rate, vectors, images)


def _frame(picture: Any, selection: Selection, shape: tuple[int, int, int]) -> np.ndarray:
    """Returns a picture as RGB pixels of this shape. It may be an array, raw bytes, or the bytes of an image file."""
    if isinstance(picture, dict):
        picture = picture.get("bytes")
    if isinstance(picture, bytes) and len(picture) == np.prod(shape):
        return np.frombuffer(picture, np.uint8).reshape(shape)
    try:
        image = Image.open(io.BytesIO(picture)) if isinstance(picture, bytes) else Image.fromarray(picture)
        height, width, _ = shape
        if image.size == (width, height):
            return np.asarray(image.convert("RGB"))
        # Each new pixel is the mean of the pixels that it covers.
        return np.asarray(image.convert("RGB").resize((width, height), Image.Resampling.BOX))
    except (OSError, TypeError, ValueError, AttributeError) as error:
        raise selection.error(f"a value is no picture: {error}") from None


def _write(mapping: Mapping, rate: float, episodes: list[Episode], results: Path) -> str:
    """Writes a dataset, unless it is there already, and returns its name."""
    widths = {name: values.shape[1] for name, values in episodes[0].vectors.items()}
    for episode in episodes:
        for name, values in episode.vectors.items():
            if values.shape[1] != widths[name]:
                raise MappingError(
                    f"modalities.{name}: has {values.shape[1]} values in episode {episode.index} and {widths[name]} in the "
                    "first"
                )
    layout = _layout(mapping, widths)
    content = {
        "layout": layout,
        "name": mapping.name,
        "sample_rate_hz": rate,
        "modalities": [name for name in mapping.selections if name != "setpoint"],
        "episodes": [{"samples": len(episode), "sha256": _digest(episode)} for episode in episodes],
    }
    identity = {"format": FORMAT, "imported": content}
    text = json.dumps(identity, sort_keys=True, separators=(",", ":"))
    name = f"{mapping.name}-{hashlib.sha256(text.encode()).hexdigest()[:16]}"
    folder = results / "datasets" / name
    if folder.exists():
        return name
    folder.parent.mkdir(parents=True, exist_ok=True)
    unfinished = Path(tempfile.mkdtemp(prefix=".unfinished-import-", dir=results))
    try:
        unfinished.chmod(0o755)
        for episode in episodes:
            write_episode(unfinished / f"episode_{episode.index:05}.parquet", name, name, episode, layout)
        description = json.dumps(identity | {"mapping": mapping.text}, indent=2, default=str)
        (unfinished / "dataset.json").write_text(description + "\n")
        unfinished.rename(folder)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    return name


def _digest(episode: Episode) -> str:
    """Returns the SHA-256 of all vectors and images of an episode."""
    digest = hashlib.sha256()
    for name, values in [*episode.vectors.items(), *episode.images.items()]:
        if len(values):
            digest.update(name.encode())
            digest.update(np.ascontiguousarray(values, values.dtype.newbyteorder("<")).tobytes())
    return digest.hexdigest()


def main(words: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="harness import", description="Imports a recording as a dataset.")
    parser.add_argument("mapping", type=Path, help="YAML: what to import, and which columns are what")
    parser.add_argument("--results", type=Path, default=Path("results"), help="the results folder")
    arguments = parser.parse_args(words)
    try:
        name = import_dataset(arguments.mapping, arguments.results)
    except KeyboardInterrupt:
        return 130
    except (ValueError, OSError, ImportError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(f"{name}: in {arguments.results / 'datasets' / name}; train on it with 'scenarios=[{name}]'")
    return 0


if __name__ == "__main__":
    sys.exit(main())
