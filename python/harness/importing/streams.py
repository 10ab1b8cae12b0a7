"""Streams: the parts of a recording whose values were measured together, each with its own times."""

from __future__ import annotations

import contextlib
import itertools
import re
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from .mapping import Mapping, MappingError, Selection, StreamSettings

LIMIT_NS = 2**62
"""The largest time, ns. It is 146 years."""
RESOLUTION_S = 1e-3
"""How far apart two times may be that their type can just tell from each other, s."""
NO_TIME = np.iinfo(np.int64).min
"""Stands in the times of rows that have none."""
CHUNK_ROWS = 65536
"""How many rows are read at once where a whole stream is searched."""


class Stream(ABC):
    """Values that were measured together. A row has a time and one value of each column."""

    place: str
    """The file, and what in it: for messages."""
    times: np.ndarray
    """int64 [rows], ns."""
    columns: list[str]
    """The names by which a mapping calls its columns: `STREAM`, or `STREAM.COLUMN`."""
    received: np.ndarray | None = None
    """int64 [rows], ns: when a recorder received the values, if it noted that."""
    coded: frozenset[str] = frozenset()
    """The columns whose values are numbers of categories."""

    def __len__(self) -> int:
        return len(self.times)

    @abstractmethod
    def read(self, column: str, first: int, last: int) -> np.ndarray:
        """Returns the values of the rows from `first` to before `last`, float64 [rows, …].

        Raises:
            MappingError: they are no numbers, or can't be read.
        """

    def values(self, column: str, first: int, last: int) -> Any:
        """Returns the values of the rows from `first` to before `last`, which may be texts: an array, or a list in which
        missing ones are None.

        Raises:
            MappingError: they can't be read.
        """
        return self.read(column, first, last)

    @abstractmethod
    def pictures(self, column: str, rows: np.ndarray) -> Iterator[Any]:
        """Yields the pictures of increasing rows: uint8 [rows, columns, 3], or the bytes of an image file.

        Raises:
            MappingError: they are no pictures, or can't be read.
        """

    def at(self, row: int) -> str:
        """Returns the place of a row: for messages."""
        return f"{self.place}: row {row}"


class View(Stream):
    """Some rows of another stream, in any order. Numbers in `missing` become NaN."""

    def __init__(
        self, whole: Stream, rows: np.ndarray, times: np.ndarray | None = None, missing: tuple[float, ...] = ()
    ):
        self.whole, self.rows, self.place, self.columns = whole, rows, whole.place, whole.columns
        self.times = whole.times[rows] if times is None else times
        self.received = None if whole.received is None else whole.received[rows]
        self.missing, self.coded = missing, whole.coded

    def read(self, column: str, first: int, last: int) -> np.ndarray:
        rows = self.rows[first:last]
        begin = int(rows.min())
        values: np.ndarray = self.whole.read(column, begin, int(rows.max()) + 1)[rows - begin]
        may_miss = self.missing and column not in self.coded
        return np.where(np.isin(values, self.missing), np.nan, values) if may_miss else values

    def values(self, column: str, first: int, last: int) -> Any:
        rows = self.rows[first:last]
        begin = int(rows.min())
        found = self.whole.values(column, begin, int(rows.max()) + 1)
        return found[rows - begin] if isinstance(found, np.ndarray) else [found[row] for row in (rows - begin).tolist()]

    def pictures(self, column: str, rows: np.ndarray) -> Iterator[Any]:
        own = self.rows[rows]
        if (np.diff(own) > 0).all():
            return self.whole.pictures(column, own)
        return itertools.chain.from_iterable(self.whole.pictures(column, own[[index]]) for index in range(len(own)))

    def at(self, row: int) -> str:
        return self.whole.at(int(self.rows[row]))


class Coded(Stream):
    """Another stream, in which the values of some columns are the numbers of their categories."""

    def __init__(self, whole: Stream, selections: dict[str, Selection], missing: tuple[float, ...]):
        """`selections` has those of the columns, and `missing` the numbers that stand for a missing value."""
        self.whole, self.place, self.columns = whole, whole.place, whole.columns
        self.times, self.received = whole.times, whole.received
        self.coded, self._selections, self._missing = frozenset(selections), selections, missing

    def read(self, column: str, first: int, last: int) -> np.ndarray:
        if column not in self._selections:
            return self.whole.read(column, first, last)
        values = self.whole.values(column, first, last)
        at = self.whole.at
        return self._selections[column].numbers_of_categories(values, lambda row: at(first + row), self._missing)

    def pictures(self, column: str, rows: np.ndarray) -> Iterator[Any]:
        return self.whole.pictures(column, rows)

    def at(self, row: int) -> str:
        return self.whole.at(row)


@dataclass(frozen=True)
class Take:
    """A part of a recording in which all streams were recorded together."""

    name: str
    """Which part it is: for messages."""
    streams: dict[str, Stream]
    """The streams by their name in the mapping."""
    labels: dict[str, Any] = field(default_factory=dict)
    """What the recording itself says of it, such as the value by which it is divided."""

    @property
    def columns(self) -> list[str]:
        """The columns of all streams."""
        return [column for stream in self.streams.values() for column in stream.columns]


def nanoseconds(values: np.ndarray, unit: int, at: Any, absent: np.ndarray | None = None) -> np.ndarray:
    """Returns times as int64, ns.

    Args:
        values: numbers, [rows].
        unit: nanoseconds in their unit.
        at: returns the place of a row.
        absent: which rows have no time, bool [rows]. They get NO_TIME.

    Raises:
        MappingError: one is not a finite number, or larger than a time can be, or they are floats that can't tell times
            a millisecond apart.
    """
    if absent is not None and absent.any():
        times = np.full(len(values), NO_TIME)
        rows = np.flatnonzero(~absent)
        times[rows] = nanoseconds(values[rows], unit, lambda row: at(int(rows[row])))
        return times
    with np.errstate(invalid="ignore"):
        wrong = ~(np.abs(values.astype(np.float64)) <= LIMIT_NS / unit)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise MappingError(
            f"{at(row)}: {values[row]} is no time; times are finite numbers in s, unless the stream has a time_unit of "
            "ms, us or ns; to leave out rows without a time, say 'missing: skip'"
        )
    if values.dtype.kind in "iub":
        return values.astype(np.int64) * unit
    if len(values):
        latest = int(np.argmax(np.abs(values)))
        step_s = float(np.spacing(np.abs(values[latest]))) * unit / 1e9
        if step_s > RESOLUTION_S:
            raise MappingError(
                f"{at(latest)}: {values[latest]} is {values.dtype}, in which times so large are {step_s:.3g} s apart; "
                "store them as float64 or integers, or relative to the start"
            )
    return np.rint(values.astype(np.float64) * unit).astype(np.int64)


def stamps(parts: list[np.ndarray], settings: StreamSettings, at: Any) -> np.ndarray:
    """Returns the times of a stream, int64, ns, from numbers in its unit, or from seconds and nanoseconds.

    Raises:
        MappingError: as `nanoseconds`.
    """
    units = [settings.time_unit] if len(parts) == 1 else [10**9, 1]
    absent = np.zeros(len(parts[0]), bool)
    if settings.skip_missing:
        for part in parts:
            absent |= ~np.isfinite(part) | np.isin(part, settings.missing)
    times = [nanoseconds(part, unit, at, absent) for part, unit in zip(parts, units, strict=True)]
    return times[0] if len(times) == 1 else np.where(absent, NO_TIME, sum(times))


def irregular(times: np.ndarray, period: float, rounding: float = 0.0) -> tuple[int, str] | None:
    """Returns the first row that is no sample at a regular rate, and how it comes; None if all are.

    A sample may come up to 1.5 periods after the one before, and all together may last 5 % longer or shorter.
    `rounding` is by how much rounded times can change a step, in the unit of `period`.
    """
    steps, slack = np.diff(times) / period, rounding / period
    wrong = np.flatnonzero(steps > 1.501 + slack)
    if len(wrong):
        row = int(wrong[0])
        return row + 1, f"comes {steps[row]:.3g} samples after the row before it"
    count, lasted = len(steps), float(steps.sum())
    if abs(lasted - count) > max(1.0, 0.05 * count) + slack + 1e-3:
        return count, f"is row {count}, and comes {lasted:.4g} samples after row 0"
    return None


def regular(rows: int, rate_hz: float) -> np.ndarray:
    """Returns the times of rows at a fixed rate, int64, ns, from 0."""
    return np.rint(np.arange(rows) * (1e9 / rate_hz)).astype(np.int64)


def checked(
    stream: Stream,
    settings: StreamSettings,
    columns: list[str],
    pictures: set[str],
    place: str,
    offset_ns: int,
    is_sorted: bool,
) -> Stream:
    """Returns some columns of a stream, without missing values, and with the times that its settings say.

    Args:
        stream: the stream.
        settings: its settings.
        columns: the columns.
        pictures: those of them that hold no numbers.
        place: where it is noted what was left out.
        offset_ns: is added to its times, ns.
        is_sorted: whether rows are sorted by their times. Otherwise, a time that goes back is an error.

    Raises:
        MappingError: it has no rows, or its times go back.
    """
    rows = np.flatnonzero(stream.times != NO_TIME)
    if settings.skip_missing:
        numbers = [column for column in columns if column not in pictures]
        rows = rows[_is_whole(View(stream, rows, missing=settings.missing), numbers)]
        settings.note("left out, without a value or a time", place, len(stream) - len(rows))
    if len(rows) == 0:
        raise MappingError(f"{stream.place}: holds no rows{' without missing values' * settings.skip_missing}")
    times = stream.times[rows]
    back = np.flatnonzero(np.diff(times) < 0)
    if is_sorted and len(back):
        settings.note("that are sorted, because their time goes back", place, len(back))
        order = np.argsort(times, kind="stable")
        rows, times = rows[order], times[order]
    elif len(back):
        row = int(back[0])
        raise MappingError(
            f"{stream.at(int(rows[row + 1]))}: the time goes back from {seconds(times[row])} to "
            f"{seconds(times[row + 1])} s; 'steps_back: sort' sorts the rows by their times, and 'steps_back: split' "
            "begins a new episode there"
        )
    start = times[0] if settings.begin_at_zero else 0
    view = View(stream, rows, times - start + offset_ns, settings.missing)
    view.columns = columns
    if settings.begin_at_zero:
        view.received = None
    return view


def _is_whole(stream: Stream, columns: list[str]) -> np.ndarray:
    whole = np.ones(len(stream), bool)
    for first in range(0, len(stream), CHUNK_ROWS):
        last = min(first + CHUNK_ROWS, len(stream))
        for column in columns:
            values = stream.read(column, first, last).reshape(last - first, -1)
            whole[first:last] &= np.isfinite(values).all(axis=1)
    return whole


def seconds(time_ns: int | np.integer[Any]) -> str:
    """Returns a time in s, as text, without digits that say nothing."""
    text = f"{int(time_ns) / 1e9:.6f}"
    return text.rstrip("0").rstrip(".")


def divided(starts: np.ndarray, stream: Stream) -> list[Stream]:
    """Returns the parts of a stream that begin at the given rows."""
    return [View(stream, rows) for rows in np.split(np.arange(len(stream)), starts[1:])]


def changes(values: np.ndarray) -> np.ndarray:
    """Returns the rows at which a value differs from the one before, and row 0."""
    flat = np.asarray(values).reshape(len(values), -1)
    return np.flatnonzero(np.append(True, (flat[1:] != flat[:-1]).any(axis=1)))


def natural(path: Path) -> list[Any]:
    """A key by which `trial_2` comes before `trial_10`."""
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.split(r"(\d+)", str(path)) if part]


def matching(folder: Path, pattern: str) -> list[Path]:
    """Returns the paths in a folder that match a pattern of `*` and `?`. Brackets stand for themselves."""
    return list(folder.glob(pattern.replace("[", "[[]")))


def sources(
    mapping: Mapping, suffixes: tuple[str, ...], marks: tuple[str, ...] = (), inner: tuple[str, ...] = ()
) -> list[Path]:
    """Returns the recordings at a mapping's source, in order: itself, those in its folder, or those that match it.

    Args:
        mapping: the mapping.
        suffixes: what the name of a recording ends in.
        marks: files that tell that a folder is one recording.
        inner: patterns of files that tell so of a folder in the source, even if the marks are missing.

    Raises:
        FileNotFoundError: there is none.
    """
    source = mapping.source

    def is_one(path: Path) -> bool:
        return path.suffix in suffixes or any((path / mark).exists() for mark in marks)

    if not source.exists():
        folder = next(each for each in source.parents if each.exists())
        found = matching(folder, str(source.relative_to(folder)))
    elif source.is_file() or is_one(source):
        found = [source]
    else:
        found = [path for path in source.iterdir() if is_one(path) or any(any(path.glob(each)) for each in inner)]
    if not found:
        raise FileNotFoundError(f"source: {source} is no {', '.join(suffixes)}, and holds none")
    return sorted(found, key=natural)


@contextlib.contextmanager
def blaming(place: str) -> Iterator[None]:
    """Turns any exception of a library into a MappingError, because they raise many kinds for a damaged file."""
    try:
        yield
    except (MappingError, ImportError, MemoryError):
        raise
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise MappingError(f"{place}: can't be read: {reason}") from error


@contextlib.contextmanager
def needing(package: str, what: str) -> Iterator[None]:
    """Turns the ImportError of an optional package into one that says how to install it."""
    try:
        yield
    except ImportError as error:
        raise ImportError(f"importing {what} needs the package {package}: pip install {package} ({error})") from error
