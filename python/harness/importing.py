"""Imports recordings as datasets: LeRobot datasets, and plain Parquet files.

`import_dataset` does the same as the command

    harness import MAPPING.yaml

It returns the dataset's name, which specs use as a scenario: `scenarios: [lab_finger-0123456789abcdef]`. The mapping
defines which columns of the recording make up which modality:

    name: lab_finger                # the dataset becomes results/datasets/lab_finger-HASH
    source: recordings              # a LeRobot dataset's folder, a Parquet file, or a folder of Parquet files
    format: lerobot                 # or parquet
    modalities:
      setpoint: action                            # where the robot was commanded to be at the sample; required
      proprioception: observation.state[0:20]     # elements of a column of lists
      arm: [rotation, lift, extension]            # several columns
      contact_force: force_??                     # all columns that match a pattern of * and ?, in the file's order
      contact_force_mean: {from: mean_??, scale: 9.81}      # values are multiplied by one factor, or one per element
      vision: observation.images.external         # pictures of any size
      touch: {from: "pad_?", unit: N}             # any other name is a new vector, with its unit
      wrist: {from: observation.images.wrist, size: [96, 96]}     # or a new image, with its rows and columns
    # These keys are required with `format: parquet`, and not allowed otherwise.
    episode: episode                # the column whose value differs between episodes
    order: sample                   # the column by which an episode's rows are sorted
    sample_rate_hz: 10              # samples per second

`source` is relative to the mapping's folder. `modalities` must have `setpoint` and at least one other. Vectors may have
any width. The names of the finger's modalities have a fixed meaning. Their values must be in rad, m and N, after they
have been multiplied by `scale`. `vision` is an image, which is resized to 64 x 64 pixels unless it has a `size`. A
recording needs at least 3 episodes, each with at least 2 samples.

A row of a LeRobot dataset contains an observation and the action that is sent after it. Its `action` is therefore the
setpoint of the next sample. `setpoint: {from: COLUMN, shift: 1}` says so: each sample gets the value of the row before,
and the first row of each episode is left out. Columns of a LeRobot dataset that begin with `action` have `shift: 1`
unless the mapping says `shift: 0`, and all other columns have `shift: 0`.

The module needs the packages pillow, pyyaml and tqdm: `pip install 'soft-harness[import]'`. For LeRobot datasets, it
also needs the package lerobot.
"""

from __future__ import annotations

import argparse
import contextlib
import fnmatch
import hashlib
import io
import json
import os
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from harness._unfinished import unfinished_folder
from harness.recorded import (
    FINGER,
    FORMAT,
    Episode,
    Layout,
    difference_of,
    image_shapes,
    vector_columns,
    write_episode,
)

try:
    import yaml
    from PIL import Image
    from tqdm import tqdm
except ImportError as error:
    raise ImportError(
        f"importing needs the packages pillow, pyyaml and tqdm: pip install pillow pyyaml tqdm ({error})"
    ) from error

__all__ = ["MappingError", "import_dataset"]

SCENARIOS = ("empty", "cluttered")
FORMATS = ("lerobot", "parquet")
RESERVED = ("dataset", "scenario", "episode", "sample", "time", "factors", "action", "kl", "total", "frame_difference")
"""Names that no modality may have, because they have another meaning or are computed."""
NAME = re.compile(r"[a-z][a-z0-9_]{0,63}")
"""What a dataset or a modality may be called."""
MAX_SIDE = 1024
"""The largest number of rows or columns of an image, pixels."""

KNOWN: dict[str, dict[str, Any]] = {each["name"]: each for each in FINGER["modalities"]}
"""The finger's modalities by name, as its layout defines them."""
PARQUET_KEYS = ("episode", "order", "sample_rate_hz")
"""Keys that a mapping of Parquet files needs in addition."""

Columns = dict[str, Any]
"""The values of a recording's columns in one episode, by name: arrays or lists, [samples, …]."""

_ACTION = re.compile(r"action\b")
_TERM = re.compile(r"(?P<column>[^\[\]]+)(\[(?P<first>\d+)(:(?P<last>\d+))?\])?")


class MappingError(ValueError):
    """Raised if a mapping is wrong or does not fit the recording. The message says where and why."""


class _Loader(yaml.SafeLoader):
    """Reads YAML as `yaml.safe_load` does, but refuses a mapping with two equal keys."""

    def compose_mapping_node(self, anchor: Any) -> Any:
        node = super().compose_mapping_node(anchor)
        seen = set()
        for key in (key for key, _ in node.value if isinstance(key, yaml.ScalarNode)):
            if key.value in seen:
                line = key.start_mark.line + 1
                raise MappingError(f"line {line}: the key '{key.value}' is there twice; remove one of them")
            seen.add(key.value)
        return node


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
    shift: int = 0
    """1 for setpoints that each belong to the sample of the next row, otherwise 0."""

    def columns(self, available: list[str]) -> list[str]:
        """Returns the names of the columns that it needs, out of those available.

        Raises:
            MappingError: a term matches no column.
        """
        return [column for term in self.terms for column, _ in self._matches(term, available)]

    def column_of_pictures(self, available: list[str]) -> str:
        """Returns the name of the column of an image.

        Raises:
            MappingError: it is not exactly one whole column.
        """
        (term,) = self.terms
        found = self._matches(term, available)
        if len(found) != 1 or found[0][1] != slice(0, None):
            names = ", ".join(name for name, _ in found)
            what = f"which matches {names}" if len(found) > 1 else "which is a part of one"
            raise self.error(f"must be one whole column, not {term}, {what}")
        return found[0][0]

    def pick(self, episode: Columns) -> np.ndarray:
        """Returns the modality's values, float32 [samples, elements].

        Raises:
            MappingError: there are no values or fewer than the terms name, they are not finite numbers, or `scale` has
                another number of elements.
        """
        parts = []
        for term in self.terms:
            for column, elements in self._matches(term, list(episode)):
                try:
                    values = np.asarray(episode[column], np.float64)
                except (TypeError, ValueError):
                    raise self.error(f"'{column}' holds no numbers, or lists of different lengths") from None
                values = values.reshape(len(values), -1)
                if (elements.stop or 0) > values.shape[1]:
                    raise self.error(
                        f"{term} goes beyond the end of '{column}'; all of it is {column}[0:{values.shape[1]}]"
                    )
                parts.append(values[:, elements])
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
            raise self.error(f"value {element} of row {row} is {values[row, element]}; it must be a finite number")
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
            text = yaml.load(path.read_text(encoding="utf-8"), _Loader)
            return cls._of(text, path.parent)
        except (yaml.YAMLError, UnicodeDecodeError) as error:
            raise MappingError(f"{path} is no YAML: {' '.join(str(error).split())}") from None
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
        if not NAME.fullmatch(str(name)) or name in SCENARIOS:
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
        return cls(name, source, _selections(text["modalities"], kind), rows, text)


def _selections(modalities: Any, kind: str) -> dict[str, Selection]:
    if not isinstance(modalities, dict):
        raise MappingError("modalities: must say what makes up each modality, by its name")
    if modalities.get("setpoint") is None:
        raise MappingError("missing 'modalities.setpoint'")
    if len(modalities) == 1:
        raise MappingError(
            "modalities: there is nothing to learn from the setpoint alone; name what was sensed"
        )
    for name in modalities:
        if not NAME.fullmatch(str(name)) or name in RESERVED:
            raise MappingError(
                f"modalities: {name!r} can't name a modality; use small letters, digits and _, a letter first, "
                f"and none of {', '.join(RESERVED)}"
            )
    # The finger's modalities come first, in their order, so that a dataset of the finger has the same columns.
    given = [name for name in KNOWN if name in modalities]
    selections = {name: _selection(name, modalities[name], kind) for name in dict.fromkeys([*given, *modalities])}
    _check_differences(selections)
    return selections


def _check_differences(selections: dict[str, Selection]) -> None:
    taken = set(selections)
    for name in (name for name, selection in selections.items() if selection.size is not None):
        difference = difference_of(name)
        if difference in taken or not NAME.fullmatch(difference):
            problem = "another modality has this name" if difference in taken else "this is longer than 64 characters"
            raise MappingError(
                f"modalities.{name}: the change of this image is called '{difference}', and {problem}; give the image "
                "another name"
            )
        taken.add(difference)


def _selection(modality: str, value: Any, kind: str) -> Selection:
    where = f"modalities.{modality}"
    scale, unit, size, shift = None, "", KNOWN.get(modality, {}).get("size"), None
    if isinstance(value, dict):
        of_setpoint = ("shift",) if modality == "setpoint" else ()
        _check_keys(value, ("from",), f"{where}.", ("from", "scale", "unit", "size", *of_setpoint))
        shift = value.get("shift")
        size, unit, scale, value = value.get("size", size), value.get("unit", ""), value.get("scale"), value["from"]
        if modality in KNOWN and (KNOWN[modality]["kind"] == "image") != (size is not None):
            raise MappingError(f"{where}: is a {KNOWN[modality]['kind']}; an image has a size, a vector has none")
        if modality in KNOWN and unit:
            raise MappingError(
                f"{where}.unit: is that of the finger's; leave it out, or give the modality another name"
            )
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
    if shift is None:
        shift = int(modality == "setpoint" and kind == "lerobot" and all(_ACTION.match(term) for term in terms))
    if shift not in (0, 1) or isinstance(shift, bool):
        raise MappingError(f"{where}.shift: must be 0 or 1, not {shift!r}")
    return Selection(modality, tuple(terms), scale, str(unit), tuple(size) if size else None, shift)


def _layout(mapping: Mapping, widths: dict[str, int]) -> Layout:
    """Returns the layout of a dataset, given the widths of its vectors."""
    modalities: list[dict[str, Any]] = []
    for name, selection in mapping.selections.items():
        known = KNOWN.get(name)
        if selection.size is not None:
            image = {"kind": "image", "size": list(selection.size), "scale": "shared"}
            modalities.append({"name": name, "meaning": "Image", **image})
            meaning = f"Change of {name} since the sample before"
            modalities.append({"name": difference_of(name), "meaning": meaning, **image, "difference_of": name})
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


def import_dataset(
    mapping: str | os.PathLike[str], results: str | os.PathLike[str] = "results", *, progress: bool = True
) -> str:
    """Imports a recording as a dataset. The whole recording is read into memory.

    Args:
        mapping: the YAML file that says what to import; see `harness.importing`.
        results: the folder of datasets and runs. The dataset is written to `datasets` in it, unless it is there
            already.
        progress: shows a progress bar on stderr.

    Returns:
        The dataset's name, which ends in a hash of its content. Specs use it in `scenarios`.

    Raises:
        MappingError: the mapping or the recording is wrong. The message says where. A MappingError is a ValueError.
        FileNotFoundError: the mapping or its source does not exist.
        ImportError: the recording is a LeRobot dataset, and the package lerobot is not installed.
        OSError: the results folder can't be written.

    Example:
        >>> import polars
        >>> from pathlib import Path
        >>> from harness.importing import import_dataset
        >>> columns = {"trial": [0, 0, 1, 1, 2, 2], "row": [0, 1] * 3}
        >>> columns |= {"command": [0.0, 0.1] * 3, "angle": [0.0, 0.2] * 3}
        >>> polars.DataFrame(columns).write_parquet("lab.parquet")
        >>> keys = "name: lab, source: lab.parquet, format: parquet, episode: trial, order: row, sample_rate_hz: 10"
        >>> modalities = "{setpoint: command, bend: {from: angle, unit: rad}}"
        >>> _ = Path("lab.yaml").write_text(f"{{{keys}, modalities: {modalities}}}")
        >>> import_dataset("lab.yaml", progress=False)
        'lab-...'
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
    rows, shift = len(next(iter(columns.values()))), mapping.selections["setpoint"].shift
    samples = rows - shift
    if samples < 2:
        left_out = " after its first row, which is left out" if shift else ""
        noun = "sample" if samples == 1 else "samples"
        raise MappingError(f"it has {samples} {noun}{left_out}; it must have 2 or more")
    selections = mapping.selections
    vectors = {name: each.pick(columns) for name, each in selections.items() if each.size is None}
    vectors = {name: values[:samples] if name == "setpoint" else values[shift:] for name, values in vectors.items()}
    images = {}
    for name, selection in selections.items():
        if selection.size is not None:
            pictures = columns[selection.column_of_pictures(list(columns))][shift:]
            shape = (*selection.size, 3)
            images[name] = np.stack([_frame(picture, selection, shape) for picture in pictures])
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
                    f"modalities.{name}: has {values.shape[1]} values in episode {episode.index} and {widths[name]} "
                    "in the first"
                )
    layout = _layout(mapping, widths)
    elements = {column.name for each in vector_columns(layout).values() for column in each}
    for image in sorted(elements & image_shapes(layout).keys()):
        raise MappingError(f"modalities.{image}: a vector has a column of this name; give the image another name")
    content = {
        "layout": layout,
        "name": mapping.name,
        "sample_rate_hz": rate,
        "modalities": [name for name in mapping.selections if name != "setpoint"],
        "episodes": [{"samples": len(episode), "sha256": _digest(episode)} for episode in episodes],
    }
    identity = {"format": FORMAT, "imported": content}
    # The Rust program computes the same hash from the same text, in which letters beyond ASCII are not escaped.
    text = json.dumps(identity, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    name = f"{mapping.name}-{hashlib.sha256(text.encode()).hexdigest()[:16]}"
    folder = results / "datasets" / name
    if folder.exists():
        return name
    folder.parent.mkdir(parents=True, exist_ok=True)
    with unfinished_folder(results, "import") as unfinished:
        unfinished.chmod(0o755)
        for episode in episodes:
            write_episode(unfinished / f"episode_{episode.index:05}.parquet", name, name, episode, layout)
        description = json.dumps(identity | {"mapping": mapping.text}, indent=2, default=str)
        (unfinished / "dataset.json").write_text(description + "\n")
        try:
            unfinished.rename(folder)
        except OSError:
            # Another process may have imported the same dataset meanwhile.
            if not folder.exists():
                raise
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
    parser = argparse.ArgumentParser(
        prog="harness import", description="Import a LeRobot dataset or Parquet files as a dataset."
    )
    parser.add_argument(
        "mapping", type=Path, help="YAML file that says what to import, and which columns are which modality"
    )
    folder = "folder of datasets and runs [default: results]"
    parser.add_argument("--results", type=Path, default=Path("results"), metavar="DIR", help=folder)
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
