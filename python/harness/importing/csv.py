"""Reads CSV files, with videos and folders of images beside them."""

from __future__ import annotations

import csv
import io
import itertools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from .mapping import Mapping, MappingError, StreamSettings, listed
from .streams import Stream, Take, blaming, changes, divided, matching, nanoseconds, natural, regular
from .video import VIDEOS, Folder, Video

COMMENT = "#"
"""What the lines begin with that may be above the header."""
SEPARATORS = ",;\t"
"""What may separate the values of a line."""


def takes(mapping: Mapping) -> Iterator[Take]:
    """Yields the takes of a recording: one for each text that `*` stands for, and for each value of `episode`.

    Raises:
        MappingError: a file is damaged, or does not fit the mapping.
        FileNotFoundError: a file is missing.
    """
    assert mapping.sampling
    by_column, clocks = mapping.sampling.divided_by.get("episode"), _clocks(mapping.sampling.streams)
    for star in _stars(mapping, mapping.sampling.streams):
        tables: dict[Path, Table] = {}
        streams = {name: _open(mapping, each, star, tables, clocks) for name, each in mapping.sampling.streams.items()}
        files = {settings.where.get("file", "") for settings in mapping.sampling.streams.values()}
        place = files.pop().replace("*", star) if len(files) == 1 else star
        name = str(mapping.source / place)
        yield from [Take(name, streams)] if by_column is None else _by_column(name, streams, by_column)


def _stars(mapping: Mapping, streams: dict[str, StreamSettings]) -> list[str]:
    """Returns the texts that `*` stands for in the files of the streams, in order; `['']` if no file has a `*`."""
    if not mapping.source.is_dir():
        wrong = [each for each in streams.values() if "file" in each.where]
        if wrong:
            raise wrong[0].error(f"file: {mapping.source} is a file; a stream can only name files in a folder")
        if not mapping.source.exists():
            raise FileNotFoundError(f"source: {mapping.source} is not there; write a pattern in the key 'file' instead")
        return [""]
    for settings in streams.values():
        if "file" not in settings.where:
            raise settings.error(f"missing 'file': {mapping.source} is a folder; say which file in it, such as '*.csv'")
        if settings.where["file"].count("*") > 1:
            raise settings.error(f"file: '{settings.where['file']}' has several *; only one can stand for the episode")
    patterns = list(dict.fromkeys(each.where["file"] for each in streams.values() if "*" in each.where["file"]))
    found: set[str] = set()
    for pattern in patterns:
        before, _, after = pattern.partition("*")
        expression = re.compile(f"{re.escape(before)}([^/]*){re.escape(after)}")
        # The table of labels is no trial.
        labels = (mapping.folder / mapping.text.get("episodes", "")).resolve()
        files = [path for path in matching(mapping.source, pattern) if path.resolve() != labels]
        paths = [path.relative_to(mapping.source).as_posix() for path in files]
        found |= {match[1] for match in map(expression.fullmatch, paths) if match}
    if patterns and not found:
        raise FileNotFoundError(f"source: {mapping.source} holds no {' and no '.join(patterns)}")
    return sorted(found, key=lambda star: natural(Path(star))) or [""]


def _clocks(streams: dict[str, StreamSettings]) -> dict[str, set[str]]:
    """Returns the columns that are times of a stream, by the streams' file."""
    clocks: dict[str, set[str]] = {}
    for settings in streams.values():
        clocks.setdefault(settings.where.get("file", ""), set()).add(settings.where.get("time", ""))
    return clocks


def _open(
    mapping: Mapping, settings: StreamSettings, star: str, tables: dict[Path, Table], clocks: dict[str, set[str]]
) -> Stream:
    def file(key: str) -> Path:
        path = mapping.source / settings.where[key].replace("*", star) if key in settings.where else mapping.source
        if not path.exists():
            raise FileNotFoundError(f"streams.{settings.name}.{key}: {path} is not there")
        return path

    def table(key: str) -> Table:
        path = file(key)
        if path not in tables:
            tables[path] = Table(path)
        return tables[path]

    path, where = file("file"), settings.where
    if not path.is_dir() and path.suffix.lower() not in VIDEOS:
        if "times" in where:
            raise settings.error(f"times: is for videos and folders of images, and {path} is neither")
        return TableStream(table("file"), settings, clocks.get(where.get("file", ""), set()))
    frames: Video | Folder = Folder(settings.name, path) if path.is_dir() else Video(settings.name, path)
    if "times" in where:
        if "time" not in where:
            raise settings.error("missing 'time': the column of 'times' that has the times of the frames")
        frames.times = (listed := table("times")).times(where["time"], settings.time_unit)
        if len(frames.times) != frames.count:
            raise MappingError(
                f"{listed.path}: has {len(frames.times)} rows, and {path} has {frames.count} frames; they must be equal"
            )
    elif settings.rate_hz:
        if isinstance(frames, Folder):
            _check_numbers(frames)
        frames.times = regular(frames.count, settings.rate_hz)
    elif where.get("time") == "name" and isinstance(frames, Folder):
        frames.times = frames.times_in_names(settings.time_unit)
    elif "time" in where or isinstance(frames, Folder):
        name = "" if isinstance(frames, Video) else ", 'time: name' if the files are called by their time,"
        raise settings.error(f"the frames of {path} need rate_hz{name or ','} or a CSV file 'times' and its 'time'")
    return frames


def _check_numbers(frames: Folder) -> None:
    """Raises a MappingError if images are counted and one is missing, because those after it would come too early."""
    found = [re.search(r"(\d+)\D*$", file.stem) for file in frames.files]
    steps = [int(after[1]) - int(before[1]) for before, after in itertools.pairwise(found) if before and after]
    if len(steps) == len(found) - 1 and min(steps, default=0) == 1 and max(steps) > 1:
        row = next(row for row, step in enumerate(steps) if step > 1)
        raise MappingError(
            f"{frames.files[row]}: the next image is {frames.files[row + 1].name}; with rate_hz, no image may be "
            "missing; name a CSV file 'times' and its 'time' instead"
        )


def _by_column(name: str, streams: dict[str, Stream], column: str) -> Iterator[Take]:
    """Yields a take for each stretch of rows with one value of a column."""
    having = {
        key: stream
        for key, stream in streams.items()
        if isinstance(stream, TableStream) and column in stream.table.names
    }
    if not having:
        tables = [stream.table for stream in streams.values() if isinstance(stream, TableStream)]
        names = [f"; the columns of {table.path} are {', '.join(table.names)}" for table in tables[:1]]
        raise MappingError(f"episode: no stream has a column '{column}'{''.join(names)}")
    parts: dict[str, list[Stream]] = {}
    labels: dict[str, list[str]] = {}
    for key, stream in having.items():
        values = stream.table.frame[column].fill_null("").to_numpy()
        starts = changes(values)
        parts[key], labels[key] = divided(starts, stream), values[starts].tolist()
        if len(having) < len(streams) and (np.diff(stream.times) < 0).any():
            other = next(each for each in streams if each not in having)
            raise MappingError(
                f"episode: streams.{other} has no column '{column}', and the times of streams.{key} begin again in "
                "each episode, so nobody knows which times belong together"
            )
    first, *others = having
    for other in others:
        if labels[other] != labels[first]:
            raise MappingError(
                f"episode: '{column}' has the values {_some(labels[first])} in {streams[first].place}, and "
                f"{_some(labels[other])} in {streams[other].place}"
            )
    for index, label in enumerate(labels[first]):
        own = {key: parts[key][index] if key in parts else stream for key, stream in streams.items()}
        yield Take(f"{name}, {column} {label}", own, {column: label})


def _some(labels: list[str]) -> str:
    return ", ".join(labels[:5]) + ", …" * (len(labels) > 5)


class Table:
    """A CSV file, whose values stay text until they are used.

    Comments above the header begin with #. The values are separated by commas, semicolons or tabs.
    """

    def __init__(self, path: Path):
        self.path = path
        with blaming(str(path)):
            skipped, names_line = header(path)
        self.separator = max(SEPARATORS, key=names_line.count)
        self.first_line = skipped + 2
        """The line of row 0, if no value contains a line break."""
        line = f"{path}: line {skipped + 1}"
        with blaming(line):
            names = next(csv.reader(io.StringIO(names_line), delimiter=self.separator), [])
        self.names = [name.strip() for name in names]
        if not any(self.names):
            raise MappingError(f"{line}: there is no header with the names of the columns")
        for name in self.names:
            if self.names.count(name) > 1:
                raise MappingError(f"{line}: the column '{name}' is there twice")
        try:
            self.frame = pl.read_csv(
                path.absolute(),
                glob=False,
                has_header=False,
                # Unlike skip_rows, it does not take a quotation mark in a comment for the begin of a text.
                skip_lines=skipped + 1,
                separator=self.separator,
                schema=dict.fromkeys(self.names, pl.String),
                infer_schema=False,
            )
        except pl.exceptions.NoDataError:
            self.frame = pl.DataFrame()
        except (pl.exceptions.PolarsError, OSError) as error:
            raise MappingError(self._why(error)) from None
        if self.frame.is_empty():
            raise MappingError(f"{path}: line {self.first_line}: there are no rows below the header")
        self._numbers: dict[str, np.ndarray] = {}

    def numbers(self, column: str) -> np.ndarray:
        """Returns the values of a column, float64 [rows]. Empty ones and `nan` are NaN.

        Raises:
            MappingError: one is no number, or there is no such column.
        """
        if column not in self._numbers:
            text = self._texts(column)
            numbers = text.cast(pl.Float64, strict=False)
            wrong = (numbers.is_null() & text.is_not_null() & (text != "")).arg_true()
            if len(wrong):
                raise MappingError(
                    f"{self.at(wrong[0])}: '{column}' is {text[wrong[0]]!r}, which is no number; leave a missing value "
                    "empty, or write nan"
                )
            self._numbers[column] = numbers.fill_null(float("nan")).to_numpy()
        return self._numbers[column]

    def times(self, column: str, unit: int) -> np.ndarray:
        """Returns the times in a column, int64 [rows], ns. They are numbers, or dates with times of day.

        Raises:
            MappingError: one is neither, or there is no such column.
        """
        text = self._texts(column)
        whole = text.cast(pl.Int64, strict=False)
        if whole.null_count() == 0:
            return nanoseconds(whole.to_numpy(), unit, self.at)
        if text.cast(pl.Float64, strict=False).null_count() == len(text):
            try:
                dates = text.str.to_datetime(time_unit="ns", strict=False)
            except pl.exceptions.PolarsError:
                dates = pl.Series([None] * len(text), dtype=pl.Datetime("ns"))
            if (wrong := dates.is_null()).any():
                row = int(wrong.arg_true()[0])
                raise MappingError(f"{self.at(row)}: '{column}' is {text[row]!r}, which is no time")
            return dates.dt.epoch("ns").to_numpy()
        return nanoseconds(self.numbers(column), unit, self.at)

    def at(self, row: int) -> str:
        """Returns the place of a row."""
        return f"{self.path}: line {self.first_line + row}"

    def _texts(self, column: str) -> pl.Series:
        if column not in self.names:
            raise MappingError(f"{self.path}: there is no column '{column}'; the columns are {listed(self.names)}")
        text = self.frame[column].str.strip_chars()
        # Where values are not separated by commas, decimal places may be.
        return text if self.separator == "," else text.str.replace(",", ".", literal=True)

    def _why(self, error: Exception) -> str:
        """Returns what is wrong with a file that polars can't read, with the line."""
        line = self.first_line
        try:
            with open(self.path, encoding="utf-8", newline="") as file:
                for _ in range(self.first_line - 1):
                    file.readline()
                reader = csv.reader(file, delimiter=self.separator, strict=True)
                for row, values in enumerate(reader):
                    if len(values) > len(self.names) or (row == 0 and len(values) < len(self.names)):
                        return f"{self.path}: line {line}: has {len(values)} values, and the header {len(self.names)}"
                    line = self.first_line + reader.line_num
        except csv.Error:
            return f"{self.path}: line {line}: a quotation mark is not closed, or a text goes on after it"
        except ValueError:
            pass
        return f"{self.path}: can't be read: {' '.join(str(error).split())}"


def header(path: Path) -> tuple[int, str]:
    """Returns the number of lines above the header, and the header.

    Raises:
        MappingError: the file is empty, or no text.
    """
    with open(path, "rb") as file:
        skipped = 0
        for line in file:
            try:
                text = line.decode("utf-8-sig")
            except UnicodeDecodeError:
                raise MappingError(f"{path}: line {skipped + 1}: is no text in UTF-8") from None
            if "\0" in text:
                raise MappingError(f"{path}: line {skipped + 1}: is no text: it contains a byte 0")
            if text.strip() and not text.startswith(COMMENT):
                names = text.rstrip("\r\n")
                if "\r" in names:
                    raise MappingError(
                        f"{path}: line {skipped + 1}: the lines end in CR alone; save the file with lines that end in "
                        "LF or CR LF"
                    )
                return skipped, names
            skipped += 1
    raise MappingError(f"{path}: line {skipped + 1}: the file ends before a header with the names of the columns")


class TableStream(Stream):
    """The rows of a CSV file."""

    def __init__(self, table: Table, settings: StreamSettings, clocks: set[str]):
        self.table, self.place = table, str(table.path)
        self._prefix = f"{settings.name}."
        # No pattern means the times of the rows.
        self.columns = [f"{self._prefix}{name}" for name in table.names if name not in clocks]
        if "time" in settings.where:
            self.times = table.times(settings.where["time"], settings.time_unit)
        elif settings.rate_hz:
            self.times = regular(len(table.frame), settings.rate_hz)
        else:
            raise settings.error(
                f"needs a column 'time', or rate_hz; the columns of {table.path} are {', '.join(table.names)}"
            )

    def read(self, column: str, first: int, last: int) -> np.ndarray:
        return self.table.numbers(column.removeprefix(self._prefix))[first:last]

    def pictures(self, column: str, rows: np.ndarray) -> Iterator[Any]:
        names = self.table.frame[column.removeprefix(self._prefix)]
        for row in rows.tolist():
            path = self.table.path.parent / (names[row] or "").strip()
            if not path.is_file():
                raise MappingError(f"{self.at(row)}: there is no picture {path}")
            yield path.read_bytes()

    def at(self, row: int) -> str:
        return self.table.at(row)
