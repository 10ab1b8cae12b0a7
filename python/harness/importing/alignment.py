"""Alignment: samples at one rate from streams that each have their own times."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .mapping import Columns, Look, Mapping, MappingError, Sampling, Selection, StreamSettings, wrapped
from .pictures import shown
from .streams import Stream, Take, needing, seconds

TOLERANCE_NS = 1000
"""A value that is at most so much later than a sample counts as measured at the sample."""


@dataclass(frozen=True)
class Span:
    """The samples of an episode in a take."""

    start_ns: int
    """The time of the take's sample 0."""
    first: int
    """The first sample."""
    last: int
    """The sample after the last."""

    def times(self, rate_hz: float, before: int = 0) -> np.ndarray:
        """Returns the samples' times and those of some samples before, int64, ns."""
        return self.start_ns + np.rint(np.arange(self.first - before, self.last) * (1e9 / rate_hz)).astype(np.int64)


@dataclass
class Quality:
    """What is known about the times of a stream, over all takes."""

    name: str
    """The stream's name."""
    rows: int = 0
    """Rows in all takes."""
    periods: list[np.ndarray] = field(default_factory=list)
    """int64 [rows - 1] of each take: the time from each row to the next, ns."""
    ages: list[np.ndarray] = field(default_factory=list)
    """int64 [samples] of each take: the time from the last value to the sample, ns."""
    transports: list[np.ndarray] = field(default_factory=list)
    """int64 [rows] of each take: the time from measuring to receiving, ns."""
    gap_ns: int = 0
    """The longest time from a row to the next."""
    gap_at: str = ""
    """Where that is."""

    def add(self, stream: Stream, samples: np.ndarray) -> None:
        """Adds a take: its stream, and the times of its samples."""
        periods = np.diff(stream.times)
        self.rows += len(stream)
        self.periods.append(periods)
        self.ages.append(np.maximum(samples - stream.times[latest(stream.times, samples)], 0))
        if stream.received is not None:
            self.transports.append(stream.received - stream.times)
        if len(periods) and periods.max() > self.gap_ns:
            row = int(periods.argmax())
            self.gap_ns, self.gap_at = int(periods[row]), stream.at(row)

    @property
    def rate_hz(self) -> float:
        """The rate at which rows follow each other mostly, Hz."""
        typical = self._typical()
        return 1e9 / typical if typical else 0.0

    @property
    def jitter_s(self) -> float:
        """What 95 % of the times from one row to the next differ at most from their median, s."""
        periods = np.concatenate(self.periods)
        return float(np.quantile(np.abs(periods - self._typical()), 0.95)) / 1e9 if len(periods) else 0.0

    @property
    def delay_s(self) -> float:
        """How old the last value is at a sample, on average, s."""
        return float(np.concatenate(self.ages).mean()) / 1e9

    @property
    def transport_s(self) -> float | None:
        """The median time from measuring to receiving, s, if the recording has both."""
        return float(np.median(np.concatenate(self.transports))) / 1e9 if self.transports else None

    def _typical(self) -> float:
        periods = np.concatenate(self.periods)
        return float(np.median(periods)) if len(periods) else 0.0


@dataclass(frozen=True)
class Plan:
    """The episodes of a take."""

    spans: list[Span]
    """The samples of each episode."""
    left_out: int
    """Samples that are in no episode, because a stream has a gap there."""
    outside: int
    """Samples before and after the part of the take that the mapping asks for."""


def latest(times: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """Returns the row of the last value at each sample, int64 [samples]; -1 if there is none."""
    rows: np.ndarray = np.searchsorted(times, samples + TOLERANCE_NS, side="right") - 1
    return rows


def plan(
    take: Take, mapping: Mapping, sampling: Sampling, qualities: dict[str, Quality], part: tuple[float, float]
) -> Plan:
    """Divides a take into episodes, and adds its streams to the qualities.

    A sample is where every stream has had a value, and no stream has ended. A stream without a longest gap keeps its
    last value until the others end. `part` says from when to when samples are used, s from the first.

    Raises:
        MappingError: the streams do not overlap, or one has a gap that is too long.
    """
    start = max(int(stream.times[0]) for stream in take.streams.values())
    ends = {
        name: int(stream.times[-1])
        for name, stream in take.streams.items()
        if np.isfinite(sampling.streams[name].max_gap_s)
    }
    end = min(ends.values()) if ends else max(int(stream.times[-1]) for stream in take.streams.values())
    if end + TOLERANCE_NS < start:
        ranges = "; ".join(
            f"{name} lasts from {seconds(stream.times[0])} to {seconds(stream.times[-1])} s"
            for name, stream in take.streams.items()
        )
        raise MappingError(
            f"{take.name}: the streams are at no time all there: {ranges}; if their clocks differ, use offset_s or "
            "begin_at_zero"
        )
    rate = sampling.sample_rate_hz
    count = int((end + TOLERANCE_NS - start) * rate / 1e9) + 1
    begin = int(np.ceil(part[0] * rate - 1e-6))
    whole = Span(start, begin, int(min(count, part[1] * rate + 1e-6 + 1)))
    if whole.last <= whole.first:
        raise MappingError(
            f"{take.name}: from_s {part[0]:g} to to_s {part[1]:g} leaves no sample; the streams are all there for "
            f"{(end - start) / 1e9:.6g} s"
        )
    samples = whole.times(rate)
    usable = np.ones(len(samples), bool)
    for name, stream in take.streams.items():
        qualities[name].add(stream, samples)
        usable &= ~_in_gaps(stream, sampling.streams[name], samples, sampling.split_at_gaps)
    bounds = np.flatnonzero(np.diff(np.concatenate([[False], usable, [False]])))
    most = max(2, int(min(sampling.max_episode_s * rate + 1e-6, len(samples))))
    least = 2 + mapping.shift
    spans, left_out = [], int((~usable).sum())
    for first, last in zip(bounds[::2].tolist(), bounds[1::2].tolist(), strict=True):
        for begin in range(whole.first + first, whole.first + last, most):
            span = Span(start, begin, min(begin + most, whole.first + last))
            # A rest that is too short is left out. A take that is too short as a whole is an error later.
            if span.last - span.first >= least or span.last - span.first == len(samples):
                spans.append(span)
            else:
                left_out += span.last - span.first
    return Plan(spans, left_out, count - len(samples))


def _in_gaps(stream: Stream, settings: StreamSettings, samples: np.ndarray, allowed: bool) -> np.ndarray:
    """Returns which samples are in a gap of a stream, bool [samples]."""
    inside = np.zeros(len(samples), bool)
    if not np.isfinite(settings.max_gap_s):
        return inside
    for row in np.flatnonzero(np.diff(stream.times) > settings.max_gap_s * 1e9 + TOLERANCE_NS).tolist():
        before, after = stream.times[row], stream.times[row + 1]
        missing = (samples > before + TOLERANCE_NS) & (samples < after - TOLERANCE_NS)
        if missing.any() and not allowed:
            raise MappingError(
                f"{stream.at(row)}: {seconds(after - before)} s pass until the next row of '{settings.name}', which is "
                f"more than max_gap_s, {settings.max_gap_s:g}; say 'gaps: split' to begin a new episode there, or give "
                f"streams.{settings.name} a longer max_gap_s"
            )
        inside |= missing
    return inside


def wanted(selections: dict[str, Selection], available: list[str]) -> list[str]:
    """Returns the columns that a mapping uses, out of those available, in their order."""
    columns = {column for selection in selections.values() for column in selection.columns(available)}
    return [column for column in available if column in columns]


def align(take: Take, span: Span, mapping: Mapping, sampling: Sampling) -> Columns:
    """Returns the columns of an episode at its samples: arrays, or iterators of pictures.

    Raises:
        MappingError: a value is missing, or can't be read.
    """
    pictures = {
        selection.column_of_pictures(take.columns)
        for selection in mapping.selections.values()
        if selection.size is not None
    }
    vectors = {
        column
        for selection in mapping.selections.values()
        if selection.size is None
        for column in selection.columns(take.columns)
    }
    for column in sorted(vectors & pictures):
        raise MappingError(f"modalities: '{column}' is an image of one modality and numbers of another")
    columns: Columns = {}
    for column in pictures:
        stream = take.streams[column.partition(".")[0]]
        columns[column] = Pictures(stream, column, latest(stream.times, span.times(sampling.sample_rate_hz)))
    meanings: dict[str, Selection] = {}
    for selection in mapping.selections.values():
        own = [] if selection.size else selection.columns(take.columns)
        for column in own:
            before = meanings.setdefault(column, selection)
            for key in ("turn", "quaternion", "categories"):
                if getattr(before, key) != getattr(selection, key):
                    key = "angle" if key == "turn" else key
                    raise selection.error(f"'{column}' has another '{key}' in modalities.{before.modality}")
        # The values of a quaternion are aligned together, all others by themselves.
        for group in [own] if selection.quaternion and own else [[column] for column in own]:
            names = {column.partition(".")[0] for column in group}
            if len(names) > 1:
                raise selection.error(f"a quaternion is from one stream, not from {' and '.join(sorted(names))}")
            if not {*group} <= {*columns}:
                name = names.pop()
                how = "last" if selection.categories else sampling.streams[name].align
                columns |= _aligned(take.streams[name], group, span, sampling, how, selection)
    # In the order of the first file, by which patterns list them.
    return {column: columns[column] for column in wanted(mapping.selections, take.columns)}


@dataclass(frozen=True)
class Pictures:
    """The picture of each sample, uint8 [rows, columns, 3] or [rows, columns]. Each is read once, while iterating."""

    stream: Stream
    column: str
    rows: np.ndarray
    """The row of each sample's picture."""
    look: Look = Look()
    """What is done with the pictures."""

    def __len__(self) -> int:
        return len(self.rows)

    def __iter__(self) -> Iterator[Any]:
        distinct, counts = np.unique(self.rows, return_counts=True)
        pictures = self.stream.pictures(self.column, distinct)
        for row, picture, count in zip(distinct.tolist(), pictures, counts.tolist(), strict=True):
            try:
                pixels = shown(picture, self.look)
            except ValueError as error:
                raise MappingError(f"{self.stream.at(row)}: {error}") from None
            yield from itertools.repeat(pixels, count)


def _aligned(
    stream: Stream, columns: list[str], span: Span, sampling: Sampling, how: str, selection: Selection
) -> Columns:
    """Returns the values of columns at the samples, each float64 [samples, elements]."""
    samples = span.times(sampling.sample_rate_hz, before=1)
    rows = latest(stream.times, samples)
    # The rows after the sample before the first; the first sample of a take has at least its own.
    first = min(int(rows[0]) + 1, int(rows[1])) if how == "mean" else int(rows[1])
    last = min(int(rows[-1]) + 2, len(stream)) if how == "linear" else int(rows[-1]) + 1
    parts = [stream.read(column, first, last).reshape(last - first, -1) for column in columns]
    for column, part in zip(columns, parts, strict=True):
        wrong = np.argwhere(~np.isfinite(part))
        if len(wrong):
            row, element = wrong[0].tolist()
            which = f" element {element} of" if part.shape[1] > 1 else ""
            raise MappingError(
                f"{stream.at(first + row)}:{which} '{column}' is {part[row, element]}; it must be a finite number; to "
                f"leave out rows without a value, say 'missing: skip' in streams.{column.partition('.')[0]}"
            )
    values = np.concatenate(parts, axis=1)
    if selection.quaternion:
        selection.check_quaternions(values, lambda row: stream.at(first + row))
    rows, times, samples = rows - first, stream.times[first:last], samples[1:]
    if how == "linear":
        found = _interpolated(values, times, samples, rows[1:], selection)
    elif how == "mean":
        found = _means(values, rows, selection)
    else:
        found = values[rows[1:]]
    ends = np.cumsum([part.shape[1] for part in parts])
    return dict(zip(columns, np.split(found, ends[:-1], axis=1), strict=True))


def _interpolated(
    values: np.ndarray, times: np.ndarray, samples: np.ndarray, rows: np.ndarray, selection: Selection
) -> np.ndarray:
    """Returns what lies on the line from the last value to the next, or on the shorter arc of angles and rotations."""
    after = np.minimum(rows + 1, len(times) - 1)
    length = np.maximum(times[after] - times[rows], 1)
    share = np.clip((samples - times[rows]) / length, 0.0, 1.0)[:, None]
    if selection.quaternion:
        before, turn = _rotations(values[rows], selection), _rotations(values[after], selection)
        way = (before.inv() * turn).as_rotvec()
        return _quaternions(before * type(before).from_rotvec(share * way), selection)
    way = values[after] - values[rows]
    if selection.turn:
        way = wrapped(way, selection.turn)
    interpolated: np.ndarray = values[rows] + share * way
    return interpolated


def _means(values: np.ndarray, rows: np.ndarray, selection: Selection) -> np.ndarray:
    """Returns the means of the values since the sample before; the last value where there is none since. Angles and
    rotations have means on the circle and the sphere.

    `rows` has the row of the last value at the sample before the first, and at each sample.
    """
    begin, end = np.maximum(rows[:-1] + 1, 0), rows[1:] + 1
    counts = end - begin
    means: np.ndarray = values[rows[1:]].copy()
    full = counts > 0
    if not full.any():
        return means
    if selection.quaternion:
        for sample in np.flatnonzero(counts > 1).tolist():
            rotations = _rotations(values[begin[sample] : end[sample]], selection)
            means[sample] = _quaternions(rotations.mean(), selection)
        return means

    def sums(each: np.ndarray) -> np.ndarray:
        return np.add.reduceat(each[: end[-1]], begin[full], axis=0)

    if selection.turn:
        angles = values * (2 * np.pi / selection.turn)
        means[full] = np.arctan2(sums(np.sin(angles)), sums(np.cos(angles))) * (selection.turn / (2 * np.pi))
    else:
        means[full] = sums(values) / counts[full, None]
    return means


def _rotations(values: np.ndarray, selection: Selection) -> Any:
    """Returns quaternions as rotations of scipy."""
    with needing("scipy", "quaternions"):
        from scipy.spatial.transform import Rotation
    return Rotation.from_quat(np.roll(values, -1, axis=-1) if selection.quaternion == "wxyz" else values)


def _quaternions(rotations: Any, selection: Selection) -> np.ndarray:
    values: np.ndarray = rotations.as_quat()
    return np.roll(values, 1, axis=-1) if selection.quaternion == "wxyz" else values
