"""Mappings: the files that say which parts of a recording make up which modality."""

from __future__ import annotations

import fnmatch
import json
import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from harness import _harness
from harness.recorded import FINGER

from .categories import Categories, CategoryError, slug

NAME = re.compile(r"[a-z][a-z0-9_]{0,63}")
"""What a dataset, a stream or a modality may be called."""
UNITS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
"""Nanoseconds in the units of time."""

KNOWN: dict[str, dict[str, Any]] = {each["name"]: each for each in FINGER["modalities"]}
"""The finger's modalities by name, as its layout defines them."""
WHERE = ("file", "data", "topic", "frame_id", "time", "times")
"""The keys of a stream that say where its values and times are."""
DIVISIONS = ("episode", "episodes", "episode_ends")
"""The keys that say how streams form episodes."""

Columns = dict[str, Any]
"""The values of a recording's columns in one episode, by name: arrays or lists, [samples, …]."""

EXACT = 2**24
"""The largest integer up to which float32 has all integers."""
LEVELS = 100
"""How many values float32 must have in the range of an element whose values are larger than EXACT."""

_ACTION = re.compile(r"action\b")
_TERM = re.compile(r"(?P<column>[^\[\]]+)(\[(?P<first>\d+)(:(?P<last>\d+))?\])?")


def listed(columns: list[str]) -> str:
    """Returns the names of columns, and a hint if a file seems to begin with numbers instead of names."""
    return ", ".join(columns) + header_hint([name.partition(".")[2] or name for name in columns])


def header_hint(names: list[str]) -> str:
    """Returns what to do if the names of all columns are numbers, otherwise nothing."""
    is_number = re.compile(r"[-+]?\d*\.?\d+([eE][-+]?\d+)?")
    are_numbers = names and all(map(is_number.fullmatch, names))
    return "; these are numbers: if the file has no line with names, say 'header: none'" if are_numbers else ""


def wrapped(angles: np.ndarray, turn: float) -> np.ndarray:
    """Returns angles above minus half a turn and at most half a turn."""
    return angles - turn * np.ceil(angles / turn - 0.5)


def continuous(values: np.ndarray, order: str) -> np.ndarray:
    """Returns quaternions, [rows, 4], of length 1. Each has the sign that is nearer to the one before, and the first a
    positive w."""
    values = values / np.linalg.norm(values, axis=1, keepdims=True)
    signs = np.where((values[1:] * values[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    first = -1.0 if values[0, order.index("w")] < 0 else 1.0
    return values * np.cumprod(np.append(first, signs))[:, None]


class MappingError(ValueError):
    """Raised if a mapping is wrong or does not fit the recording. The message says where and why."""


@dataclass(frozen=True)
class Look:
    """What is done with the pixels of an image before they are resized."""

    is_bgr: bool = False
    """Whether its channels are blue, green and red."""
    crop: tuple[int, int, int, int] | None = None
    """First row, first column, rows and columns of the part that is kept, pixels."""
    range: tuple[float, float] | None = None
    """The values of a depth that become 0 and 255."""


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
    turn: float | None = None
    """A whole turn in the unit of angles, before `scale`; None for other values."""
    quaternion: str = ""
    """The order of a quaternion's four values, `xyzw` or `wxyz`; empty for other values."""
    categories: Categories | None = None
    """The values of its column, if they are categories."""
    size: tuple[int, int] | None = None
    """Rows and columns of an image; None for a vector."""
    look: Look = Look()
    """What is done with an image's pixels before they are resized."""
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
                values = self._numbers(column, episode[column])
                if (elements.stop or 0) > values.shape[1]:
                    raise self.error(
                        f"{term} goes beyond the end of '{column}'; all of it is {column}[0:{values.shape[1]}]"
                    )
                parts.append(values[:, elements])
        values = np.concatenate(parts, axis=1)
        if values.shape[1] == 0:
            raise self.error(f"{' + '.join(self.terms)} gives no values")
        if self.categories:
            return self._of_categories(self.categories, values)
        if self.turn:
            values = wrapped(values, self.turn)
        if self.quaternion:
            self.check_quaternions(values, "row {}".format)
            values = continuous(values, self.quaternion)
        if self.scale is not None and len(self.scale) not in (1, values.shape[1]):
            raise self.error(f"scale: must be 1 number or {values.shape[1]}, not {len(self.scale)}")
        if self.scale is not None:
            values = values * self.scale
        return self._stored(values)

    def elements(self, episode: Columns, width: int) -> list[str]:
        """Returns the names of the elements of a vector of this width: those of its columns, without what all names of
        its columns would repeat, or numbers for the elements of a single column."""
        if self.categories:
            return list(self.categories.names)
        found = [match for term in self.terms for match in self._matches(term, list(episode))]
        numbers = [f"{index:02}" for index in range(width)]
        if len(found) != width:
            return numbers
        short = [slug(column.partition(".")[2] or column).removeprefix(f"{self.modality}_") for column, _ in found]
        long = [slug(column) for column, _ in found]
        return next((names for names in (short, long) if all(names) and len(set(names)) == width > 1), numbers)

    def check_quaternions(self, values: np.ndarray, at: Callable[[int], str]) -> None:
        """Raises a MappingError if values, [rows, elements], are no quaternions of a length near 1."""
        if values.shape[1] != 4:
            raise self.error(f"a quaternion has 4 values, and {' + '.join(self.terms)} has {values.shape[1]}")
        length = np.linalg.norm(values, axis=1)
        wrong = np.flatnonzero(~((length > 0.5) & (length < 2)))
        if len(wrong):
            raise self.error(
                f"{at(int(wrong[0]))}: is no quaternion: its length is {length[wrong[0]]:.3g} instead of 1"
            )

    def numbers_of_categories(
        self, values: Any, at: Callable[[int], str], missing: tuple[float, ...] = ()
    ) -> np.ndarray:
        """Returns the numbers of the categories of a column's values, float64 [rows]; NaN for a missing value, and for
        a number that stands for one.

        Raises:
            MappingError: a value is none of the categories.
        """
        assert self.categories
        try:
            return self.categories.numbers(values, at, missing)
        except CategoryError as error:
            raise self.error(str(error)) from None

    def _of_categories(self, categories: Categories, numbers: np.ndarray) -> np.ndarray:
        """Returns the elements of categories with these numbers, [samples, values]."""
        if numbers.shape[1] != 1:
            raise self.error(f"categories are from one column, and {' + '.join(self.terms)} has {numbers.shape[1]}")
        missing = np.flatnonzero(np.isnan(numbers[:, 0]))
        if len(missing):
            raise self.error(f"row {missing[0]} has no value; every sample needs a category")
        return categories.elements(numbers[:, 0])

    def _numbers(self, column: str, values: Any) -> np.ndarray:
        """Returns the values of a column, float64 [samples, elements]."""
        try:
            found = np.asarray(values)
            # NumPy would read the numbers in texts.
            if found.dtype.kind in "biuf" or found.dtype.kind == "O" and not _holds_text(found):
                return found.astype(np.float64).reshape(len(found), -1)
        except (TypeError, ValueError):
            pass
        raise self.error(f"'{column}' holds no numbers, or lists of different lengths")

    def _stored(self, values: np.ndarray) -> np.ndarray:
        """Returns values as a dataset stores them, float32 [samples, elements]."""
        with np.errstate(over="ignore"):
            stored = values.astype(np.float32)
        if not np.isfinite(stored).all():
            row, element = np.argwhere(~np.isfinite(stored))[0]
            raise self.error(
                f"value {element} of row {row} is {values[row, element]}; it must be a finite number, at most 3.4e38"
            )
        largest, span = np.abs(stored).max(axis=0), np.ptp(values, axis=0)
        steps = np.spacing(largest)
        is_extreme = (largest > EXACT) | (largest < np.finfo(np.float32).tiny)
        if (coarse := is_extreme & (steps * LEVELS > span) & (span > 0)).any():
            element = int(np.argmax(coarse))
            advice = (
                "subtract a constant before the import" if largest[element] > 1 else "use a smaller unit, by 'scale'"
            )
            raise self.error(
                f"value {element} changes by {span[element]:.6g} only, near {largest[element]:.6g}; datasets store 24 "
                f"bits (float32), in which such values are {steps[element]:g} apart; {advice}"
            )
        return stored

    def error(self, problem: str) -> MappingError:
        """Returns an error whose message begins with the modality's place in the mapping."""
        return MappingError(f"modalities.{self.modality}: {problem}")

    def _matches(self, term: str, available: list[str]) -> list[tuple[str, slice]]:
        """Returns the columns that a term matches, each with the slice of its elements."""
        if term in available:
            return [(term, slice(0, None))]
        found = _TERM.fullmatch(term)
        if not found:
            raise self.error(f"'{term}' is not understood; write COLUMN, COLUMN[3], COLUMN[0:20] or PATTERN_*")
        is_pattern = "*" in found["column"] or "?" in found["column"]
        names = fnmatch.filter(available, found["column"]) if is_pattern else [found["column"]]
        unknown = [name for name in names if name not in available]
        if unknown or not names:
            raise self.error(f"there is no column '{found['column']}'; the columns are {listed(available)}")
        first = int(found["first"] or 0)
        last = int(found["last"]) if found["last"] else first + 1 if found["first"] else None
        return [(name, slice(first, last)) for name in names]


@dataclass(frozen=True)
class Labeled:
    """A modality whose categories are the values of a label."""

    modality: str
    """Name of the modality."""
    label: str
    """The label."""
    categories: Categories | None
    """The categories; None for all values of the label."""

    def of(self, labels: list[dict[str, Any]]) -> tuple[Categories, list[int]]:
        """Returns the categories, and the number of that of each episode, given the labels of the episodes.

        Raises:
            MappingError: an episode lacks the label, or its value is none of the categories.
        """
        try:
            if self.label not in labels[0]:
                raise CategoryError(f"there is no label '{self.label}'; the labels are {', '.join(labels[0])}")
            values = [each[self.label] for each in labels]
            if None in values:
                raise CategoryError(f"episode {values.index(None)} has no value of the label '{self.label}'")
            categories = self.categories or Categories.of(sorted({*values}))
            numbers = categories.numbers(values, lambda episode: f"episode {episode}")
        except CategoryError as error:
            raise MappingError(f"modalities.{self.modality}: {error}") from None
        return categories, numbers.astype(int).tolist()


def with_numbers(columns: Columns, selections: dict[str, Selection]) -> Columns:
    """Returns columns with the numbers of categories in the place of their values.

    Raises:
        MappingError: a value is none of the categories.
    """
    for selection in selections.values():
        for column in selection.columns(list(columns)) if selection.categories else []:
            columns = columns | {column: selection.numbers_of_categories(columns[column], "row {}".format)}
    return columns


@dataclass(frozen=True)
class Rows:
    """How the rows of Parquet files form episodes."""

    episode: str
    """The column whose value differs between episodes."""
    order: str
    """The column by which an episode's rows are sorted."""
    sample_rate_hz: float
    """Samples per second."""


class Counts:
    """How much an import has left out or changed."""

    def __init__(self) -> None:
        self._by_what: dict[str, dict[str, int]] = {}
        self._episodes: dict[str, None] = {}

    def note(self, what: str, place: str, count: int) -> None:
        """Notes how much it was at a place, which may be read several times."""
        if count:
            self._by_what.setdefault(what, {})[place] = count

    def note_episode(self, reason: str) -> None:
        """Notes that an episode is left out, and why."""
        self._episodes[reason] = None

    @property
    def lines(self) -> list[str]:
        """What was done, with the sum over all places."""
        sums = [(what, sum(places.values()), len(places)) for what, places in self._by_what.items()]
        counted = [f"{what}: {count}" + f", in {places} recordings" * (places > 1) for what, count, places in sums]
        return counted + [f"episode left out: {reason}" for reason in self._episodes]


@dataclass(frozen=True)
class Text:
    """How the text of a table is read."""

    header: int | str = ""
    """The line of the header, from 1; `none` if there is none; empty for the first line that is no comment."""
    has_units: bool = False
    """Whether the line below the header has units."""
    encoding: str = "utf-8"
    """The name of a Python codec."""
    missing: tuple[str, ...] = ()
    """Texts that stand for a missing value."""


@dataclass(frozen=True)
class StreamSettings:
    """Where the values of a stream are, and when they were measured."""

    name: str
    """The stream's name in the mapping."""
    where: dict[str, Any] = field(default_factory=dict)
    """The keys of the format, such as `file`, `data`, `topic` and `time`."""
    time_unit: int = UNITS["s"]
    """Nanoseconds in the unit of its times."""
    rate_hz: float | None = None
    """Its rate, for streams without times."""
    offset_s: float | str = 0.0
    """Seconds that are added to its times, or the label of a trial that has them."""
    begin_at_zero: bool = False
    """Whether its times count from its first row."""
    align: str = "last"
    """`last`, `linear` or `mean`. Pictures always have `last`."""
    max_gap_s: float = math.inf
    """The longest time from one row to the next, s. May be infinite."""
    skip_missing: bool = False
    """Whether rows without a value or a time are left out. Otherwise, they are an error."""
    missing: tuple[float, ...] = ()
    """Numbers that stand for a missing value."""
    text: Text = Text()
    """How its file is read, if it is a text."""
    counts: Counts = field(default_factory=Counts)
    """Where it is noted what was left out."""

    def note(self, what: str, place: str, count: int) -> None:
        """Notes how many of its rows were left out or changed at a place."""
        self.counts.note(f"rows of streams.{self.name} {what}", place, count)

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
    steps_back: str
    """What happens where a time goes back: `refuse`, `sort` or `split`."""
    skip_bad: bool
    """Whether episodes that can't be imported are left out. Otherwise, they are an error."""
    begin_s: float | str
    """What is left out at the begin of each trial, s, or the label of a trial that has it."""
    end_s: float | str
    """The time from the begin of each trial after which it is left out, s, or a label. May be infinite."""
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
    folder: Path
    """The folder of the file, to which paths are relative."""
    source: Path
    """The recording: a folder, a file, or, for streams, a pattern of both."""
    format: str
    """One of FORMATS."""
    selections: dict[str, Selection]
    """The columns of each modality, by its name. A recording without commands has no `setpoint`."""
    labeled: dict[str, Labeled]
    """The modalities whose categories are the values of a label, by their names."""
    rows: Rows | None
    """Set for Parquet files only."""
    sampling: Sampling | None
    """Set for recordings of streams only."""
    text: dict[str, Any]
    """The content of the file."""
    counts: Counts
    """What the import leaves out or changes."""

    @classmethod
    def load(cls, path: Path) -> Mapping:
        """Reads a mapping.

        Raises:
            FileNotFoundError: there is no such file, or no source.
            MappingError: a key is missing, unknown or has a wrong value.
        """
        try:
            text = json.loads(_harness.read_mapping(path))
        except ValueError as error:
            raise MappingError(str(error)) from None
        source, has_streams = path.parent / text["source"], "streams" in text
        is_pattern = has_streams and any(letter in text["source"] for letter in "*?")
        if not is_pattern and not source.exists():
            raise FileNotFoundError(f"source: {source} is not there")
        rows = None
        if text["format"] == "parquet" and not has_streams:
            rows = Rows(text["episode"], text["order"], float(text["sample_rate_hz"]))
        counts = Counts()
        sampling = _sampling(text, counts) if has_streams else None
        modalities = text["modalities"]
        of_labels = {name: keys for name, keys in modalities.items() if isinstance(keys, dict) and "label" in keys}
        of_columns = {name: keys for name, keys in modalities.items() if name not in of_labels}
        selections = _selections(of_columns, text["format"])
        labeled = {name: Labeled(name, keys["label"], _categories(name, keys)) for name, keys in of_labels.items()}
        return cls(text["name"], path.parent, source, text["format"], selections, labeled, rows, sampling, text, counts)

    @property
    def shift(self) -> int:
        """How many rows the setpoint is moved: 1 if each row has that of the next sample."""
        return self.selections["setpoint"].shift if "setpoint" in self.selections else 0


def _sampling(text: dict[str, Any], counts: Counts) -> Sampling:
    return Sampling(
        sample_rate_hz=float(text["sample_rate_hz"]),
        split_at_gaps=text.get("gaps") == "split",
        steps_back=text.get("steps_back", "refuse"),
        skip_bad=text.get("bad_episodes") == "skip",
        begin_s=text.get("from_s", 0.0),
        end_s=text.get("to_s", math.inf),
        max_episode_s=float(text.get("max_episode_s", math.inf)),
        streams={name: _stream(name, keys, text, counts) for name, keys in text["streams"].items()},
        divided_by={key: text[key] for key in DIVISIONS if key in text and not str(text[key]).endswith(".csv")},
    )


def _stream(name: str, keys: dict[str, Any], text: dict[str, Any], counts: Counts) -> StreamSettings:
    max_gap = keys.get("max_gap_s", text["max_gap_s"])
    missing = ["null" if each is None else each for each in _listed(keys.get("missing_values", []))]
    return StreamSettings(
        name=name,
        where={key: keys[key] for key in WHERE if key in keys},
        time_unit=UNITS[keys.get("time_unit", "s")],
        rate_hz=keys.get("rate_hz"),
        offset_s=keys.get("offset_s", 0.0),
        begin_at_zero=keys.get("begin_at_zero", False),
        align=keys.get("align", text.get("align", "last")),
        max_gap_s=math.inf if max_gap == "unlimited" else float(max_gap),
        skip_missing=keys.get("missing") == "skip",
        missing=tuple(float(each) for each in missing if not isinstance(each, str)),
        text=Text(
            keys.get("header", ""),
            keys.get("units_row", False),
            keys.get("encoding", "utf-8"),
            tuple(each for each in missing if isinstance(each, str)),
        ),
        counts=counts,
    )


def _selections(modalities: dict[str, Any], kind: str) -> dict[str, Selection]:
    # The finger's modalities come first, in their order, so that a dataset of the finger has the same columns.
    modalities = {name: value for name, value in modalities.items() if (name, value) != ("setpoint", "none")}
    given = [name for name in KNOWN if name in modalities]
    return {name: _selection(name, modalities[name], kind) for name in dict.fromkeys([*given, *modalities])}


def _selection(modality: str, value: Any, kind: str) -> Selection:
    keys = value if isinstance(value, dict) else {"from": value}
    terms = _listed(keys["from"])
    size = keys.get("size", KNOWN.get(modality, {}).get("size"))
    if "range" in keys and keys["range"][0] == keys["range"][1]:
        raise MappingError(f"modalities.{modality}.range: its two values must differ")
    if 0 in keys.get("crop", [])[2:]:
        raise MappingError(f"modalities.{modality}.crop: at least one row and column must be kept")
    is_action = modality == "setpoint" and kind == "lerobot" and all(_ACTION.match(term) for term in terms)
    return Selection(
        modality=modality,
        terms=tuple(terms),
        scale=np.array(_listed(keys["scale"]), np.float64) if "scale" in keys else None,
        unit=str(keys.get("unit", keys.get("angle", ""))),
        turn={"deg": 360.0, "rad": 2 * math.pi}.get(keys.get("angle", "")),
        quaternion=keys.get("quaternion", ""),
        categories=_categories(modality, keys),
        look=Look(
            keys.get("order") == "bgr",
            tuple(keys["crop"]) if "crop" in keys else None,
            tuple(keys["range"]) if "range" in keys else None,
        ),
        size=tuple(size) if size else None,
        shift=keys.get("shift", int(is_action)),
    )


def _categories(modality: str, keys: dict[str, Any]) -> Categories | None:
    if "categories" not in keys:
        return None
    try:
        return Categories.of(keys["categories"])
    except CategoryError as error:
        raise MappingError(f"modalities.{modality}.categories: {error}") from None


def _holds_text(values: np.ndarray) -> bool:
    return any(isinstance(value, str | bytes) for value in np.ravel(values).tolist())


def _listed(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [value]
