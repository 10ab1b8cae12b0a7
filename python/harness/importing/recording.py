"""Opened recordings, whose episodes are read one after another."""

from __future__ import annotations

import contextlib
import importlib
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, TypeVar

import numpy as np
from tqdm import tqdm

from .alignment import Plan, Quality, align, plan, wanted
from .labels import Labeling, number
from .mapping import Columns, Mapping, MappingError, Sampling
from .streams import NO_TIME, Coded, Take, checked, divided, seconds

T = TypeVar("T")
READERS = {"csv": "tables", "parquet": "tables"}
"""The modules that read the streams of formats, if they are not called like the format."""


@dataclass(frozen=True)
class Recording:
    """An opened recording."""

    sample_rate_hz: float
    """Samples per second."""
    length: int
    """Number of episodes."""
    episodes: Iterator[Callable[[], Columns]]
    """What reads the values of the needed columns in each episode, [samples, …]."""
    places: list[str]
    """Where each episode is in the recording."""
    qualities: list[Quality] = field(default_factory=list)
    """What is known about the times of each stream."""
    labels: list[dict[str, Any]] = field(default_factory=list)
    """The labels of each episode."""


def open_streams(mapping: Mapping, sampling: Sampling, progress: bool) -> Recording:
    """Opens a recording of streams. Reads the times of all streams, but no other values.

    Raises:
        MappingError: a file is damaged, does not fit the mapping, or has a gap.
        FileNotFoundError: a file is missing.
        ImportError: a package is missing that reads the files.
    """
    takes = Takes(mapping, sampling)
    qualities = {name: Quality(name) for name in sampling.streams}
    bar = tqdm(takes, desc="reading times", unit=" takes", file=sys.stderr, disable=not progress)
    names, plans, labels = [], [], []
    for take in bar:
        part = (number("from_s", sampling.begin_s, take.labels), number("to_s", sampling.end_s, take.labels))
        planned = takes.tried(partial(plan, take, mapping, sampling, qualities, part)) or Plan([], 0, 0)
        names.append(take.name)
        plans.append(planned)
        labels += [take.labels] * len(planned.spans)
        mapping.counts.note("samples left out by from_s and to_s", take.name, planned.outside)
        mapping.counts.note("samples left out, because a stream has a gap there", take.name, planned.left_out)
    if not labels and takes.errors:
        raise next(iter(takes.errors.values()))
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
        labels=labels,
    )


def _episodes(takes: Takes, plans: list[Plan], mapping: Mapping, sampling: Sampling) -> Iterator[Callable[[], Columns]]:
    for take, each in zip(takes, plans, strict=True):
        for span in each.spans:
            yield partial(align, take, span, mapping, sampling)


class Takes:
    """The takes of a recording, which are opened anew each time. Bad ones are left out if the mapping says so."""

    def __init__(self, mapping: Mapping, sampling: Sampling):
        self.mapping, self.sampling = mapping, sampling
        self.errors: dict[str, Exception] = {}
        """Why takes were left out."""
        self._labeling = Labeling(mapping)
        self._reader = importlib.import_module(f".{READERS.get(mapping.format, mapping.format)}", __package__)

    def __iter__(self) -> Iterator[Take]:
        first = None
        for opened in self._reader.takes(self.mapping):
            # An error would otherwise leave the file open.
            with contextlib.closing(opened()) as takes:
                while (take := self.tried(partial(next, takes, None))) is not None:
                    for part in self.tried(partial(self._parts, take)) or []:
                        whole = self.tried(partial(self._checked, part, first))
                        if whole is not None:
                            first = first or whole
                            yield whole

    def tried(self, step: Callable[[], T]) -> T | None:
        """Returns what a step returns; None if it fails, and the mapping says that bad episodes are left out."""
        try:
            return step()
        except (MappingError, FileNotFoundError) as error:
            if not self.sampling.skip_bad:
                raise
            self.errors[str(error)] = error
            self.mapping.counts.note_episode(str(error))
            return None

    def _parts(self, take: Take) -> list[Take]:
        """Returns the parts of a take between which the times go back, if the mapping says that they are episodes."""
        starts = {}
        for name, stream in take.streams.items():
            rows = np.flatnonzero(stream.times != NO_TIME)
            starts[name] = np.append(0, rows[1:][np.diff(stream.times[rows]) < 0])
        counts = {name: len(each) for name, each in starts.items()}
        if self.sampling.steps_back != "split" or {*counts.values()} == {1}:
            return [take]
        if len({*counts.values()}) > 1:
            told = ", ".join(f"that of {name} {count - 1} times" for name, count in counts.items())
            raise MappingError(f"{take.name}: the time must go back as often in all streams to split them: {told}")
        parts = {name: divided(starts[name], stream) for name, stream in take.streams.items()}
        count = len(next(iter(starts.values())))
        self.mapping.counts.note("places where the time goes back, at which episodes are split", take.name, count - 1)
        return [
            Take(f"{take.name}, part {index + 1}", {name: each[index] for name, each in parts.items()}, take.labels)
            for index in range(count)
        ]

    def _checked(self, take: Take, first: Take | None) -> Take:
        """Returns a take with its labels, and the streams and columns that a mapping uses, with their final times.

        The columns are in the order of the first take, because files may list the same columns in different orders.
        """
        selections = self.mapping.selections
        try:
            columns = wanted(selections, take.columns)
        except MappingError as error:
            raise MappingError(f"{take.name}: {error}") from None
        if first and columns != first.columns:
            _check_equal(take, first, self.mapping)
            columns = first.columns
        labels = self._labeling.of(take.name, take.labels)
        pictures = {each.column_of_pictures(take.columns) for each in selections.values() if each.size is not None}
        having = [each for each in selections.values() if each.categories]
        coded = {column: each for each in having for column in each.columns(take.columns)}
        streams = {}
        for name in dict.fromkeys(map(_stream_of, columns)):
            settings, own = self.sampling.streams[name], [each for each in columns if _stream_of(each) == name]
            offset_ns = round(number(f"streams.{name}.offset_s", settings.offset_s, labels) * 1e9)
            is_sorted = self.sampling.steps_back == "sort"
            of_categories = {column: coded[column] for column in own if column in coded}
            stream = take.streams[name]
            stream = Coded(stream, of_categories, settings.missing) if of_categories else stream
            streams[name] = checked(stream, settings, own, pictures, take.name, offset_ns, is_sorted)
        return Take(take.name, {name: streams[name] for name in take.streams if name in streams}, labels)


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


def times(recording: Recording) -> list[tuple[str, ...]]:
    """Returns a table of the times of streams, with its head; nothing for a recording without streams."""
    head = ("stream", "rows", "rate", "jitter", "longest gap", "after", "delay", "transport")
    rows = [
        (
            each.name,
            str(each.rows),
            f"{each.rate_hz:.4g} Hz",
            duration(each.jitter_s),
            duration(each.gap_ns / 1e9),
            each.gap_at or "-",
            duration(each.delay_s),
            "-" if each.transport_s is None else duration(each.transport_s),
        )
        for each in recording.qualities
        if each.rows
    ]
    return [head, *rows] if rows else []


def aligned(rows: Sequence[tuple[str, ...]]) -> list[str]:
    """Returns the lines of a table, whose rows have the same number of cells."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def duration(time_s: float) -> str:
    """Returns a time as text, in ms if it is short."""
    return f"{time_s:.3g} s" if abs(time_s) >= 1 else f"{round(time_s * 1e3, 3):.3g} ms"
