"""Mappings: the files that say which parts of a recording make up which modality."""

from __future__ import annotations

import fnmatch
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from harness.recorded import FINGER, difference_of

SCENARIOS = ("empty", "cluttered")
STREAMS = {
    "csv": (("file", "time", "times", "missing"), ("episode",)),
    "hdf5": (("data", "time", "missing"), ("episode", "episodes", "episode_ends")),
    "zarr": (("data", "time", "missing"), ("episode", "episodes", "episode_ends")),
    "matlab": (("data", "time", "missing"), ("episode", "episodes", "episode_ends")),
    "ros2": (("topic", "time", "missing"), ("episode",)),
}
"""The formats whose recordings consist of streams, each with the keys that its streams and its mapping may have."""
FORMATS = ("lerobot", "parquet", *STREAMS)
RESERVED = ("dataset", "scenario", "episode", "sample", "time", "factors", "action", "kl", "total", "frame_difference")
"""Names that no modality may have, because they have another meaning or are computed."""
NAME = re.compile(r"[a-z][a-z0-9_]{0,63}")
"""What a dataset, a stream or a modality may be called."""
MAX_SIDE = 1024
"""The largest number of rows or columns of an image, pixels."""
ALIGNMENTS = ("last", "linear", "mean")
"""How a sample gets its value from the values of a stream that are near it in time."""
UNITS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
"""Nanoseconds in the units of time."""

KNOWN: dict[str, dict[str, Any]] = {each["name"]: each for each in FINGER["modalities"]}
"""The finger's modalities by name, as its layout defines them."""
PARQUET_KEYS = ("episode", "order", "sample_rate_hz")
"""Keys that a mapping of Parquet files needs in addition."""
STREAM_KEYS = ("sample_rate_hz", "max_gap_s", "streams")
"""Keys that a mapping of streams needs in addition."""

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
            raise self.error(f"'{term}' is not understood; write COLUMN, COLUMN[3], COLUMN[0:20] or PATTERN_*")
        is_pattern = "*" in found["column"] or "?" in found["column"]
        names = fnmatch.filter(available, found["column"]) if is_pattern else [found["column"]]
        unknown = [name for name in names if name not in available]
        if unknown or not names:
            raise self.error(f"there is no column '{found['column']}'; the columns are {', '.join(available)}")
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
class StreamSettings:
    """Where the values of a stream are, and when they were measured."""

    name: str
    """The stream's name in the mapping."""
    where: dict[str, str]
    """The keys of the format, such as `file`, `data`, `topic` and `time`."""
    time_unit: int
    """Nanoseconds in the unit of its times."""
    rate_hz: float | None
    """Its rate, for streams without times."""
    offset_ns: int
    """Nanoseconds that are added to its times."""
    begin_at_zero: bool
    """Whether its times count from its first row."""
    align: str
    """`last`, `linear` or `mean`. Pictures always have `last`."""
    max_gap_s: float
    """The longest time from one row to the next, s. May be infinite."""
    skip_missing: bool
    """Whether rows without a value are left out. Otherwise, they are an error."""

    def error(self, problem: str) -> MappingError:
        """Returns an error whose message begins with the stream's place in the mapping."""
        return MappingError(f"streams.{self.name}: {problem}")


@dataclass(frozen=True)
class Sampling:
    """How streams are sampled, and how they form episodes."""

    sample_rate_hz: float
    """Samples per second."""
    split_at_gaps: bool
    """Whether a gap begins a new episode. Otherwise, it is an error."""
    max_episode_s: float
    """The longest episode, s. May be infinite."""
    streams: dict[str, StreamSettings]
    """The streams by name."""
    divided_by: dict[str, str]
    """The keys `episode`, `episodes` and `episode_ends` that the mapping has."""


@dataclass(frozen=True)
class Mapping:
    """The content of a mapping's file."""

    name: str
    """The dataset's name, without the hash."""
    source: Path
    """The recording: a folder, a file, or, for streams, a pattern of both."""
    format: str
    """One of FORMATS."""
    selections: dict[str, Selection]
    """The columns of each modality, by its name."""
    rows: Rows | None
    """Set for Parquet files only."""
    sampling: Sampling | None
    """Set for recordings of streams only."""
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
            raise MappingError(f"format: must be {', '.join(FORMATS[:-1])} or {FORMATS[-1]}, not {kind!r}")
        required += PARQUET_KEYS if kind == "parquet" else STREAM_KEYS if kind in STREAMS else ()
        of_streams = ("align", "gaps", "max_episode_s", *STREAMS[kind][1]) if kind in STREAMS else ()
        _check_keys(text, required, "", (*required, *of_streams))
        name = text["name"]
        if not NAME.fullmatch(str(name)) or name in SCENARIOS:
            raise MappingError(
                f"name: {name!r} can't name an imported dataset; use 1 to 64 small letters, digits and _, and none of "
                f"{', '.join(SCENARIOS)}"
            )
        rows = None
        if kind == "parquet":
            rows = Rows(str(text["episode"]), str(text["order"]), _rate(text))
        source = folder / str(text["source"])
        is_pattern = kind in STREAMS and any(letter in str(text["source"]) for letter in "*?")
        if not is_pattern and not source.exists():
            raise FileNotFoundError(f"source: {source} is not there")
        sampling = _sampling(text, kind) if kind in STREAMS else None
        return cls(name, source, kind, _selections(text["modalities"], kind), rows, sampling, text)


def _rate(text: dict[str, Any]) -> float:
    rate = text["sample_rate_hz"]
    if not (isinstance(rate, int | float) and 0.01 <= rate <= 1000):
        raise MappingError(f"sample_rate_hz: must be a number of 0.01 to 1000, not {rate!r}")
    return float(rate)


def _sampling(text: dict[str, Any], kind: str) -> Sampling:
    keys, division = STREAMS[kind]
    divided_by = {key: str(text[key]) for key in division if text.get(key) is not None}
    if len(divided_by) > 1:
        raise MappingError(f"{' and '.join(divided_by)}: only one of them can divide the recording into episodes")
    if not isinstance(text["streams"], dict):
        raise MappingError("streams: must say where each stream is, by its name")
    defaults = {
        "align": _one_of(text.get("align", "last"), ALIGNMENTS, "align"),
        "max_gap_s": _seconds(text["max_gap_s"], "max_gap_s"),
    }
    streams = {str(name): _stream(str(name), value, kind, keys, defaults) for name, value in text["streams"].items()}
    return Sampling(
        sample_rate_hz=_rate(text),
        split_at_gaps=_one_of(text.get("gaps", "refuse"), ("refuse", "split"), "gaps") == "split",
        max_episode_s=_seconds(text.get("max_episode_s", math.inf), "max_episode_s"),
        streams=streams,
        divided_by=divided_by,
    )


def _stream(name: str, value: Any, kind: str, keys: tuple[str, ...], defaults: dict[str, Any]) -> StreamSettings:
    if not NAME.fullmatch(name):
        raise MappingError(f"streams: {name!r} can't name a stream; use small letters, digits and _, a letter first")
    where = f"streams.{name}"
    required = {"hdf5": ("data",), "zarr": ("data",), "matlab": ("data",), "ros2": ("topic",)}.get(kind, ())
    shared = ("rate_hz", "time_unit", "begin_at_zero", "offset_s", "align", "max_gap_s")
    without = ("rate_hz", "time_unit") if kind == "ros2" else ()
    if not isinstance(value, dict):
        raise MappingError(f"{where}: must have keys such as {', '.join(keys)}, not {value!r}")
    _check_keys(value, required, f"{where}.", (*keys, *(key for key in shared if key not in without)))
    texts = {key: value[key] for key in keys if value.get(key) is not None}
    for key, text in texts.items():
        if not isinstance(text, str):
            raise MappingError(f"{where}.{key}: must be a text, not {text!r}")
    rate, offset = value.get("rate_hz"), value.get("offset_s", 0)
    if rate is not None and not (_is_number(rate) and 0.001 <= rate <= 1e6):
        raise MappingError(f"{where}.rate_hz: must be a number of 0.001 to 1000000, not {rate!r}")
    if not (_is_number(offset) and abs(offset) <= 1e9):
        raise MappingError(f"{where}.offset_s: must be a number of seconds, not {offset!r}")
    if rate is not None and "time" in texts:
        raise MappingError(f"{where}: has time and rate_hz; remove one of them")
    return StreamSettings(
        name=name,
        where=texts,
        time_unit=UNITS[_one_of(value.get("time_unit", "s"), tuple(UNITS), f"{where}.time_unit")],
        rate_hz=None if rate is None else float(rate),
        offset_ns=round(offset * 1e9),
        begin_at_zero=_one_of(value.get("begin_at_zero", False), (False, True), f"{where}.begin_at_zero"),
        align=_one_of(value.get("align", defaults["align"]), ALIGNMENTS, f"{where}.align"),
        max_gap_s=_seconds(value.get("max_gap_s", defaults["max_gap_s"]), f"{where}.max_gap_s"),
        skip_missing=_one_of(texts.get("missing", "refuse"), ("refuse", "skip"), f"{where}.missing") == "skip",
    )


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _seconds(value: Any, place: str) -> float:
    if not (isinstance(value, int | float) and not isinstance(value, bool) and value > 0):
        raise MappingError(f"{place}: must be a positive number of seconds, or .inf, not {value!r}")
    return float(value)


def _one_of(value: Any, allowed: tuple[Any, ...], place: str) -> Any:
    if value not in allowed:
        names = [str(each).lower() if isinstance(each, bool) else str(each) for each in allowed]
        raise MappingError(f"{place}: must be {', '.join(names[:-1])} or {names[-1]}, not {value!r}")
    return value


def _selections(modalities: Any, kind: str) -> dict[str, Selection]:
    if not isinstance(modalities, dict):
        raise MappingError("modalities: must say what makes up each modality, by its name")
    if modalities.get("setpoint") is None:
        raise MappingError("missing 'modalities.setpoint'")
    if len(modalities) == 1:
        raise MappingError("modalities: there is nothing to learn from the setpoint alone; name what was sensed")
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
