"""Reads CSV and Parquet files, with videos and folders of images beside them."""

from __future__ import annotations

import csv
import gzip
import io
import itertools
import re
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import IO, Any

import numpy as np
import polars as pl

from .mapping import Mapping, MappingError, StreamSettings, Text, header_hint, listed
from .streams import NO_TIME, Stream, Take, blaming, changes, divided, matching, natural, regular, stamps
from .video import VIDEOS, Folder, Video

COMMENT = "#"
"""What the lines begin with that may be above the header."""
SEPARATORS = ",;\t"
"""What may separate the values of a line. White space does if the header has none of these."""
LARGE_BYTES = 2**27
"""CSV files of this size are converted to a temporary Parquet file, so that they need not be in memory."""
DATES = (None, "%m/%d/%Y %H:%M:%S%.f", "%d/%m/%Y %H:%M:%S%.f", "%m/%d/%Y %I:%M:%S%.f %p")
"""The formats of dates that are tried one after another. None are those that Polars recognizes."""
UNITS_HINT = "; if this line has units, say 'units_row: true'"
"""What is added to a message on the first row."""
BOOLEANS = {"true": 1.0, "false": 0.0}
"""The numbers that these texts become."""


def takes(mapping: Mapping) -> list[Callable[[], Iterator[Take]]]:
    """Returns what yields the takes of each text that `*` stands for: one, or one for each value of `episode`.

    Raises:
        FileNotFoundError: there is no file.
    """
    assert mapping.sampling
    return [partial(_takes_of, mapping, star) for star in _stars(mapping, mapping.sampling.streams)]


def _takes_of(mapping: Mapping, star: str) -> Iterator[Take]:
    """Yields the takes of the files of one text that `*` stands for.

    Raises:
        MappingError: a file is damaged, or does not fit the mapping.
        FileNotFoundError: a file is missing.
    """
    assert mapping.sampling
    by_column, clocks = mapping.sampling.divided_by.get("episode"), _clocks(mapping.sampling.streams)
    tables: dict[tuple[Path, Text], Table] = {}
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
        clocks.setdefault(settings.where.get("file", ""), set()).update(_time(settings))
    return clocks


def _time(settings: StreamSettings) -> list[str]:
    """Returns the columns of times of a stream: none, one, or two that form a time together."""
    time = settings.where.get("time", [])
    return time if isinstance(time, list) else [time]


def _open(
    mapping: Mapping,
    settings: StreamSettings,
    star: str,
    tables: dict[tuple[Path, Text], Table],
    clocks: dict[str, set[str]],
) -> Stream:
    def file(key: str) -> Path:
        path = mapping.source / settings.where[key].replace("*", star) if key in settings.where else mapping.source
        if not path.exists():
            raise FileNotFoundError(f"streams.{settings.name}.{key}: {path} is not there")
        return path

    def table(key: str) -> Table:
        read = (file(key), settings.text)
        if read not in tables:
            tables[read] = Table(*read)
        return tables[read]

    path, where = file("file"), settings.where
    if not path.is_dir() and path.suffix.lower() not in VIDEOS:
        if "times" in where:
            raise settings.error(f"times: is for videos and folders of images, and {path} is neither")
        return TableStream(table("file"), settings, clocks.get(where.get("file", ""), set()))
    frames: Video | Folder = Folder(settings.name, path) if path.is_dir() else Video(settings.name, path)
    if "times" in where:
        if "time" not in where:
            raise settings.error("missing 'time': the column of 'times' that has the times of the frames")
        frames.times = (listed := table("times")).times(_time(settings), settings)
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
        values = stream.table.column(column).cast(pl.String).fill_null("").to_numpy()
        starts = changes(values)
        parts[key], labels[key] = divided(starts, stream), values[starts].tolist()
        if len(having) < len(streams) and (np.diff(stream.times[stream.times != NO_TIME]) < 0).any():
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
    """A CSV or Parquet file. Values of a CSV file stay text until they are used."""

    def __init__(self, path: Path, text: Text = Text()):
        self.path, self._text, self.separator = path, text, ""
        self.first_line = 0
        """The line of row 0, if no value contains a line break; 0 for Parquet files, which have no lines."""
        self._frame = self._parquet() if path.suffix.lower() == ".parquet" else self._csv()
        self.names = self._frame.collect_schema().names()
        is_lazy = isinstance(self._frame, pl.LazyFrame)
        self.rows = self._frame.select(pl.len()).collect().item() if is_lazy else self._frame.height
        if self.rows == 0:
            where = f"line {self.first_line}: there are no rows below the header" if self.first_line else "has no rows"
            raise MappingError(f"{path}: {where}")

    def column(self, name: str, first: int = 0, last: int | None = None) -> pl.Series:
        """Returns the values of a column in the rows from `first` to before `last`.

        Raises:
            MappingError: there is no such column.
        """
        if name not in self.names:
            raise MappingError(f"{self.path}: there is no column '{name}'; the columns are {listed(self.names)}")
        with blaming(f"{self.path}: '{name}'"):
            rows = self._frame.select(name).slice(first, None if last is None else last - first)
            values = (rows.collect() if isinstance(rows, pl.LazyFrame) else rows).to_series()
        if values.dtype != pl.String:
            return values
        values = values.str.strip_chars().replace(["", *self._text.missing], None)
        # Where values are not separated by commas, decimal places may be.
        return values if self.separator in ("", ",") else values.str.replace(",", ".", literal=True)

    def numbers(self, name: str, first: int = 0, last: int | None = None) -> np.ndarray:
        """Returns the values of a column, float64 [rows, …]. Missing ones are NaN, and booleans 0 and 1.

        Raises:
            MappingError: one is no number, or there is no such column.
        """
        values = self.column(name, first, last)
        if isinstance(values.dtype, pl.List | pl.Array):
            with blaming(f"{self.path}: '{name}'"):
                return np.array(values.to_list(), np.float64)
        numbers = pl.Series([None] * len(values), dtype=pl.Float64)
        if not values.dtype.is_temporal() and not values.dtype.is_nested():
            numbers = values.cast(pl.Float64, strict=False)
        if values.dtype == pl.String and numbers.null_count() > values.null_count():
            words = values.str.to_lowercase().replace_strict(BOOLEANS, default=None, return_dtype=pl.Float64)
            numbers = numbers.fill_null(words)
        wrong = (numbers.is_null() & values.is_not_null()).arg_true()
        if len(wrong):
            raise MappingError(
                f"{self.at(first + wrong[0])}: '{name}' is {values[wrong[0]]!r}, which is no number; leave a missing "
                f"value empty, or name it in 'missing_values'{UNITS_HINT * (first + wrong[0] == 0)}"
            )
        return numbers.fill_null(float("nan")).to_numpy()

    def times(self, names: list[str], settings: StreamSettings) -> np.ndarray:
        """Returns the times in a column, or in two that form them together, int64 [rows], ns. They are numbers, dates
        with times of day, or times of day.

        Raises:
            MappingError: one is neither, or there is no such column.
        """
        parts = [self.column(name) for name in names]
        if all(_is_number(part) for part in parts):
            return stamps(
                [_whole(part, self, name) for part, name in zip(parts, names, strict=True)], settings, self.at
            )
        values = parts[0]
        if len(parts) == 2:
            values = pl.select(pl.concat_str([each.cast(pl.String) for each in parts], separator=" ")).to_series()
        times = _dates(values)
        wrong = times.is_null() & (values.is_not_null() if settings.skip_missing else True)
        if wrong.any():
            row = int(wrong.arg_true()[0])
            raise MappingError(
                f"{self.at(row)}: '{', '.join(names)}' is {values[row]!r}, which is no time"
                + "; to leave out rows without a time, say 'missing: skip'" * (values[row] is None)
                + UNITS_HINT * (row == 0 and values[row] is not None)
            )
        return times.fill_null(NO_TIME).to_numpy()

    def at(self, row: int) -> str:
        """Returns the place of a row."""
        return f"{self.path}: line {self.first_line + row}" if self.first_line else f"{self.path}: row {row}"

    def _parquet(self) -> pl.LazyFrame:
        with blaming(str(self.path)):
            frame = pl.scan_parquet(self.path.absolute(), glob=False, hive_partitioning=False)
            frame.collect_schema()
        return frame

    def _csv(self) -> pl.DataFrame | pl.LazyFrame:
        text = self._text
        with blaming(str(self.path)):
            skipped, names_line, below, blank = header(self.path, text)
        self.separator = max(SEPARATORS, key=names_line.count)
        # Only a table of several columns has as many words below the header.
        if self.separator not in names_line and len(names_line.split()) == len(below.split()) > 1:
            self.separator = " "
            names_line = "\t".join(names_line.split())
        line = f"{self.path}: line {skipped + 1}"
        with blaming(line):
            delimiter = "\t" if self.separator == " " else self.separator
            names = next(csv.reader(io.StringIO(names_line), delimiter=delimiter), [])
        names = [name.strip() for name in names]
        if text.header == "none":
            names = [f"column_{number}" for number, _ in enumerate(names, 1)]
            skipped -= 1
        if not any(names):
            raise MappingError(f"{line}: there is no header with the names of the columns")
        for name in names:
            if names.count(name) > 1:
                raise MappingError(f"{line}: the column '{name}' is there twice{header_hint(names)}")
        skipped += 1 + text.has_units + blank
        self.first_line = skipped + 1
        keys: dict[str, Any] = {
            "glob": False,
            "has_header": False,
            # Unlike skip_rows, it does not take a quotation mark in a comment for the begin of a text.
            "skip_lines": skipped,
            "separator": delimiter,
            "schema": dict.fromkeys(names, pl.String),
        }
        try:
            if self.separator == " ":
                with blaming(str(self.path)), opened(self.path, text.encoding) as file:
                    lines = "\n".join("\t".join(line.split()) for line in file)
                return pl.read_csv(io.BytesIO(lines.encode()), infer_schema=False, **keys)
            if text.encoding == "utf-8" and self.path.suffix != ".gz" and self.path.stat().st_size > LARGE_BYTES:
                self._converted = tempfile.NamedTemporaryFile(suffix=".parquet")
                pl.scan_csv(self.path.absolute(), **keys).sink_parquet(self._converted.name)
                return pl.scan_parquet(self._converted.name, glob=False)
            encoding = "utf8" if text.encoding == "utf-8" else text.encoding
            return pl.read_csv(self.path.absolute(), infer_schema=False, encoding=encoding, **keys)
        except pl.exceptions.NoDataError:
            return pl.DataFrame(schema=keys["schema"])
        except (pl.exceptions.PolarsError, OSError) as error:
            raise MappingError(self._why(error, names)) from None

    def _why(self, error: Exception, names: list[str]) -> str:
        """Returns what is wrong with a file that polars can't read, with the line."""
        line = self.first_line
        delimiter = "\t" if self.separator == " " else self.separator
        try:
            with opened(self.path, self._text.encoding) as file:
                for _ in range(self.first_line - 1):
                    file.readline()
                whole = (each if self.separator != " " else "\t".join(each.split()) for each in file)
                reader = csv.reader(whole, delimiter=delimiter, strict=True)
                for row, values in enumerate(reader):
                    if len(values) > len(names) or (row == 0 and len(values) < len(names)):
                        return f"{self.path}: line {line}: has {len(values)} values, and the header {len(names)}"
                    line = self.first_line + reader.line_num
        except UnicodeDecodeError as wrong:
            return _not_decoded(self.path, line, self._text, wrong)
        except csv.Error:
            return f"{self.path}: line {line}: a quotation mark is not closed, or a text goes on after it"
        except (ValueError, EOFError, OSError):
            pass
        return f"{self.path}: can't be read: {' '.join(str(error).split())}"


def _is_number(values: pl.Series) -> bool:
    """Returns whether a column has numbers, or texts of which at least one is a number."""
    if values.dtype == pl.String:
        return values.cast(pl.Float64, strict=False).null_count() < len(values) or values.null_count() == len(values)
    return values.dtype.is_numeric()


def _whole(values: pl.Series, table: Table, name: str) -> np.ndarray:
    """Returns the numbers in a column of times, as integers if all are, so that none is rounded."""
    whole = values.cast(pl.Int64, strict=False) if values.dtype == pl.String else values
    if whole.dtype.is_integer() and whole.null_count() == 0:
        return whole.to_numpy()
    return table.numbers(name)


def _dates(values: pl.Series) -> pl.Series:
    """Returns dates or times of day as Int64, ns, since 1970 or midnight; null for what is neither."""
    if values.dtype == pl.Time:
        return values.cast(pl.Int64)
    if isinstance(values.dtype, pl.Duration):
        return values.cast(pl.Duration("ns")).cast(pl.Int64)
    if values.dtype.is_temporal():
        return values.cast(pl.Datetime("ns")).cast(pl.Int64)
    found = pl.Series([None] * len(values), dtype=pl.Int64)
    if values.dtype != pl.String:
        return found
    for format in DATES:
        try:
            dates = values.str.to_datetime(format, time_unit="ns", strict=False).dt.epoch("ns")
        except pl.exceptions.PolarsError:
            continue
        found = min(found, dates, key=pl.Series.null_count)
    of_day = values.str.to_time("%H:%M:%S%.f", strict=False).cast(pl.Int64)
    return min(found, of_day, key=pl.Series.null_count)


def opened(path: Path, encoding: str) -> IO[str]:
    """Opens a text, which may be compressed by gzip. A mark of the byte order at its begin is left out.

    Raises:
        MappingError: there is no such encoding.
    """
    encoding = "utf-8-sig" if encoding == "utf-8" else encoding
    try:
        "".encode(encoding)
    except LookupError:
        raise MappingError(
            f"encoding: Python knows no '{encoding}'; usual ones are utf-8, utf-16, latin-1 and cp1252"
        ) from None
    if path.suffix == ".gz":
        return gzip.open(path, "rt", encoding=encoding, newline="\n")
    return open(path, encoding=encoding, newline="\n")


def header(path: Path, text: Text = Text()) -> tuple[int, str, str, int]:
    """Returns the number of lines above the header, the header, the first line below it, and the number of blank lines
    between both.

    Raises:
        MappingError: the file is empty, or no text.
    """
    number = 0
    with opened(path, text.encoding) as file:
        try:
            for number, line in enumerate(file, 1):
                if "\0" in line:
                    raise MappingError(f"{path}: line {number}: is no text: it contains a byte 0")
                is_header = number == text.header if isinstance(text.header, int) else not line.startswith(COMMENT)
                if not is_header or not line.strip():
                    continue
                names = line.rstrip("\r\n")
                if "\r" in names:
                    raise MappingError(
                        f"{path}: line {number}: the lines end in CR alone; save the file with lines that end in "
                        "LF or CR LF"
                    )
                names = names.removeprefix(COMMENT) if isinstance(text.header, int) else names
                if text.header == "none":
                    return number - 1, names, names, 0
                below, blank = file.readline(), 0
                while below and not below.strip():
                    below, blank = file.readline(), blank + 1
                return number - 1, names, below, blank if below else 0
        except UnicodeDecodeError as error:
            raise MappingError(_not_decoded(path, number, text, error)) from None
    raise MappingError(f"{path}: line {number + 1}: the file ends before a header with the names of the columns")


def _not_decoded(path: Path, read: int, text: Text, error: UnicodeDecodeError) -> str:
    """Returns what is wrong with a text that can't be decoded, of which some lines were read."""
    line = read + 1 + error.object[: error.start].count(b"\n")
    return (
        f"{path}: line {line}: is no text in {text.encoding.upper()}; name its encoding with the key 'encoding', such "
        "as latin-1 or utf-16"
    )


class TableStream(Stream):
    """The rows of a table."""

    def __init__(self, table: Table, settings: StreamSettings, clocks: set[str]):
        self.table, self.place = table, str(table.path)
        self._prefix = f"{settings.name}."
        # No pattern means the times of the rows.
        self.columns = [f"{self._prefix}{name}" for name in table.names if name not in clocks]
        if "time" in settings.where:
            self.times = table.times(_time(settings), settings)
        elif settings.rate_hz:
            self.times = regular(table.rows, settings.rate_hz)
        else:
            raise settings.error(
                f"needs a column 'time', or rate_hz; the columns of {table.path} are {', '.join(table.names)}"
            )

    def read(self, column: str, first: int, last: int) -> np.ndarray:
        return self.table.numbers(column.removeprefix(self._prefix), first, last)

    def values(self, column: str, first: int, last: int) -> Any:
        return self.table.column(column.removeprefix(self._prefix), first, last).to_list()

    def pictures(self, column: str, rows: np.ndarray) -> Iterator[Any]:
        names = self.table.column(column.removeprefix(self._prefix))
        for row in rows.tolist():
            if isinstance(names[row], bytes):
                yield names[row]
                continue
            path = self.table.path.parent / (names[row] or "")
            if not path.is_file():
                raise MappingError(f"{self.at(row)}: there is no picture {path}")
            yield path.read_bytes()

    def at(self, row: int) -> str:
        return self.table.at(row)
