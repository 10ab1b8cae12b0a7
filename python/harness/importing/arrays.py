"""Takes from files of named arrays: HDF5, zarr, MATLAB and NumPy."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from .mapping import Mapping, MappingError, StreamSettings
from .streams import Stream, Take, blaming, changes, divided, natural, regular, stamps

PACKING = {"scale_factor": 1, "add_offset": 0}
"""Attributes by which netCDF, which is HDF5, changes the stored numbers, with their values that change nothing."""
MISSING = "_FillValue"
"""The attribute with the number that netCDF stores where there is no value."""
FIRST_AXIS = "first_axis"
"""The value of `episodes` for arrays whose first axis counts the episodes."""
BLOCK_BYTES = 2**25
"""How much of an array of pictures is read at once."""
INTERNAL = ("CLASS", "TITLE", "VERSION", "FILTERS", "PYTABLES_FORMAT_VERSION")
"""Attributes that libraries write for themselves, besides those that begin with _."""
LABEL_LETTERS = 200
"""Longer attributes are no labels."""


class Arrays(dict[str, Any]):
    """Arrays by their path in a file, such as `observations/qpos`. Each has a shape, a dtype, and slices that are read."""

    def __init__(self, arrays: dict[str, Any], attributes: Callable[[str], Any] = lambda group: {}):
        """`attributes` returns those of a group by its path, of which the whole file is the empty one."""
        super().__init__(arrays)
        self.attributes = attributes


Opened = Callable[[Path], AbstractContextManager[Arrays]]
"""Opens the arrays of a file."""


def takes_of(
    mapping: Mapping, files: list[Path], opened: Opened, by_rows: bool = True
) -> list[Callable[[], Iterator[Take]]]:
    """Returns what yields the takes of each file: one, or as the mapping divides the file.

    Args:
        mapping: the mapping.
        files: the files, in order.
        opened: opens the arrays of a file.
        by_rows: whether the first axis always counts the rows. Otherwise, it is the axis as long as the times.
    """
    return [partial(_takes_of, mapping, path, opened, by_rows) for path in files]


def _takes_of(mapping: Mapping, path: Path, opened: Opened, by_rows: bool) -> Iterator[Take]:
    """Yields the takes of a file.

    Raises:
        MappingError: it is damaged, or does not fit the mapping.
    """
    assert mapping.sampling
    streams, division = mapping.sampling.streams, mapping.sampling.divided_by
    with opened(path) as file:
        labels, arrays = _labels(file, ""), Arrays(dict(_plain(file)))
        if division.get("episodes") == FIRST_AXIS:
            for index in range(_length(str(path), arrays, streams)):
                place = f"{path}, episode {index}"
                own = Arrays({name: _sliced(array, index) for name, array in arrays.items()})
                parts = {name: _stream(place, ": ", each, own, by_rows) for name, each in streams.items()}
                yield Take(place, parts, labels)
            return
        if "episodes" in division:
            for group, members in _groups(str(path), arrays, division["episodes"]):
                place = f"{path}: {group}"
                parts = {name: _stream(place, "/", each, members, by_rows) for name, each in streams.items()}
                yield Take(place, parts, labels | _labels(file, group))
            return
        whole = {name: _stream(str(path), ": ", each, arrays, by_rows) for name, each in streams.items()}
        key = next((key for key in ("episode", "episode_ends") if key in division), None)
        found = [Take(str(path), whole)] if key is None else _by_rows(path, whole, arrays, key, division[key])
        yield from (replace(take, labels=labels) for take in found)


def _labels(file: Arrays, group: str) -> dict[str, Any]:
    """Returns the attributes of a group that are texts or numbers."""
    found = {}
    for name, value in dict(file.attributes(group)).items():
        value = value.item() if isinstance(value, np.generic | np.ndarray) and value.size == 1 else value
        value = value.decode(errors="replace") if isinstance(value, bytes) else value
        is_label = isinstance(value, str | int | float) and len(str(value)) <= LABEL_LETTERS
        if is_label and name not in INTERNAL and not name.startswith("_"):
            found[name] = value
    return found


def _plain(arrays: Arrays) -> Iterator[tuple[str, Any]]:
    """Yields arrays by their names. The fields of a table are called `table/field`."""
    for name, array in arrays.items():
        fields = getattr(array.dtype, "names", None)
        yield from [(f"{name}/{field}", _Field(array, field)) for field in fields] if fields else [(name, array)]


def _length(place: str, arrays: Arrays, streams: dict[str, StreamSettings]) -> int:
    """Returns the number of episodes in arrays whose first axis counts them."""
    settings = next(iter(streams.values()))
    data = settings.where["data"].strip("/")
    shapes = [array.shape for name, array in arrays.items() if name == data or f"{name}/".startswith(f"{data}/")]
    shapes = [shape for shape in shapes if len(shape) > 1]
    if not shapes:
        raise MappingError(
            f"{place}: 'episodes: {FIRST_AXIS}' needs an array of [episodes, rows, …] for streams.{settings.name}.data; "
            + _listing(arrays)
        )
    return int(shapes[0][0])


def _sliced(array: Any, episode: int) -> Any:
    """Returns an episode of an array whose first axis counts them. A vector is the same in all, as times may be."""
    return array[episode] if len(array.shape) > 1 and episode < array.shape[0] else array


class _Field:
    """A field of an array of records."""

    def __init__(self, table: Any, name: str):
        self._table, self._name = table, name
        self.dtype, own = table.dtype[name].base, table.dtype[name].shape
        self.shape = (*table.shape, *own)

    def __getitem__(self, key: Any) -> np.ndarray:
        found: np.ndarray = self._table[key][self._name]
        return found


def _groups(place: str, arrays: Arrays, pattern: str) -> Iterator[tuple[str, Arrays]]:
    """Yields the groups that match a pattern, each with its arrays."""
    expression = re.compile("[^/]*".join(map(re.escape, pattern.strip("/").split("*"))) + "(?=/)")
    names = [found[0] for path in arrays if (found := expression.match(path))]
    if not names:
        raise MappingError(f"{place}: no group matches '{pattern}' of the key 'episodes'; {_listing(arrays)}")
    for name in sorted(dict.fromkeys(names), key=lambda name: natural(Path(name))):
        prefix = f"{name}/"
        yield (
            name,
            Arrays({path.removeprefix(prefix): array for path, array in arrays.items() if path.startswith(prefix)}),
        )


def _by_rows(path: Path, streams: dict[str, Stream], arrays: Arrays, key: str, name: str) -> Iterator[Take]:
    """Yields the stretches of rows that an array tells: by its changes, or by the rows at which they end."""
    array = _array(str(path), arrays, name, key)
    with blaming(f"{path}: {name}"):
        values = np.asarray(array[:]).reshape(-1)
    if key == "episode":
        starts, rows = changes(values), len(values)
    else:
        is_whole = values.dtype.kind in "iu" and len(values)
        if not is_whole or (np.diff(np.append(0, values.astype(np.int64))) <= 0).any():
            raise MappingError(f"{path}: {name}: must be growing row numbers, which say where each episode ends")
        ends = values.astype(np.int64)
        starts, rows = np.append(0, ends[:-1]), int(ends[-1])
    for stream in streams.values():
        if len(stream) != rows:
            raise MappingError(f"{stream.place}: has {len(stream)} rows, and {name} divides {rows} rows into episodes")
    parts = {each: divided(starts, stream) for each, stream in streams.items()}
    for index in range(len(starts)):
        yield Take(f"{path}, episode {index}", {each: parts[each][index] for each in streams})


def _stream(place: str, joint: str, settings: StreamSettings, arrays: Arrays, by_rows: bool) -> Stream:
    """Returns the stream of one array, or of all arrays in a group."""
    data = settings.where["data"].strip("/")
    # The data `/` are all arrays.
    prefix = f"{data}/" if data else ""
    below = {path.removeprefix(prefix): path for path in arrays if path.startswith(prefix)}
    given = settings.where.get("time", [])
    clocks = [name.strip("/") for name in (given if isinstance(given, list) else [given])]
    own = {f"{settings.name}.{name}": path for name, path in below.items() if path not in clocks}
    own = {settings.name: data} if data in arrays else own
    if not own:
        raise MappingError(f"{place}: there is no '{data}' for streams.{settings.name}.data; {_listing(arrays)}")
    times = None
    if clocks:
        at = f"{place}{joint}{', '.join(clocks)}"
        parts = [_numbers(place, joint, arrays, clock, settings) for clock in clocks]
        times = stamps(parts, settings, lambda row: f"{at}: row {row}")
    elif not settings.rate_hz:
        raise settings.error("needs the array 'time', or rate_hz")
    columns = {
        column: arrays[path] if by_rows else _RowsFirst(arrays[path], None if times is None else len(times))
        for column, path in own.items()
    }
    lengths = {own[column]: array.shape[0] if array.shape else 0 for column, array in columns.items()}
    rows = len(times) if times is not None else next(iter(lengths.values()))
    for path, length in lengths.items():
        if length != rows:
            other = f"its times {', '.join(clocks)} have" if clocks else f"{next(iter(lengths))} has"
            raise MappingError(f"{place}{joint}{path}: has {length} rows, and {other} {rows}")
    if times is None:
        assert settings.rate_hz
        times = regular(rows, settings.rate_hz)
    return ArrayStream(f"{place}{joint}{data}", columns, times)


def _numbers(place: str, joint: str, arrays: Arrays, name: str, settings: StreamSettings) -> np.ndarray:
    """Returns the numbers in an array of times."""
    array = _array(place, arrays, name, f"streams.{settings.name}.time")
    with blaming(f"{place}{joint}{name}"):
        values = np.asarray(array[:]).reshape(-1)
    if values.dtype.kind not in "iuf":
        raise MappingError(f"{place}{joint}{name}: holds no numbers; times must be numbers")
    return values


def _array(place: str, arrays: Arrays, name: str, key: str) -> Any:
    if name.strip("/") not in arrays:
        raise MappingError(f"{place}: there is no array '{name}' for {key}; {_listing(arrays)}")
    return arrays[name.strip("/")]


def _listing(arrays: Arrays) -> str:
    names = list(arrays)
    shown = ", ".join(names[:20]) + ", …" * (len(names) > 20)
    return f"the arrays are {shown}" if names else "there are no arrays of numbers"


class _RowsFirst:
    """An array in memory whose rows are the axis that is as long as the times; without times, a vector's only axis, the
    first of a matrix, and the last of pictures."""

    def __init__(self, array: Any, rows: int | None):
        values = np.asarray(array[:])
        if values.ndim == 2 and 1 in values.shape and (rows is None or values.shape[0] != rows):
            values = values.reshape(-1, 1) if rows in (None, values.size) else values
        is_first = values.shape[0] == rows or (values.shape[-1] != rows and values.ndim < 4)
        if not is_first:
            values = np.moveaxis(values, -1, 0)
        self._values, self.shape, self.dtype = values, values.shape, values.dtype

    def __getitem__(self, key: Any) -> np.ndarray:
        found: np.ndarray = self._values[key]
        return found


class ArrayStream(Stream):
    """Arrays with as many rows as times."""

    def __init__(self, place: str, arrays: Arrays, times: np.ndarray):
        self.place, self._arrays, self.times, self.columns = place, arrays, times, list(arrays)

    def read(self, column: str, first: int, last: int) -> np.ndarray:
        array = self._arrays[column]
        if np.dtype(array.dtype).kind not in "iufb":
            raise MappingError(f"{self.place}: '{column}' holds no numbers, but {array.dtype}")
        attributes = getattr(array, "attrs", {})
        packed = [name for name, none in PACKING.items() if np.any(np.asarray(attributes.get(name, none)) != none)]
        if packed:
            raise MappingError(
                f"{self.place}: '{column}' has the attribute {packed[0]}, so that its numbers are not its values; "
                "write the values to a file first, for example with xarray"
            )
        with blaming(f"{self.place}: '{column}', rows {first} to {last - 1}"):
            numbers = np.asarray(array[first:last])
        missing = np.asarray(attributes.get(MISSING, np.nan))
        is_missing = numbers == missing if missing.dtype.kind in "iuf" else False
        return np.where(is_missing, np.nan, numbers.astype(np.float64))

    def values(self, column: str, first: int, last: int) -> Any:
        array = self._arrays[column]
        if np.dtype(array.dtype).kind in "iufb":
            return self.read(column, first, last)
        with blaming(f"{self.place}: '{column}', rows {first} to {last - 1}"):
            return np.asarray(array[first:last]).tolist()

    def pictures(self, column: str, rows: np.ndarray) -> Iterator[Any]:
        array = self._arrays[column]
        block = max(1, BLOCK_BYTES // max(1, int(np.prod(array.shape[1:])) * max(1, np.dtype(array.dtype).itemsize)))
        for part in np.split(rows, np.flatnonzero(np.diff(rows // block)) + 1):
            with blaming(f"{self.place}: '{column}', rows {part[0]} to {part[-1]}"):
                values = array[int(part[0]) : int(part[-1]) + 1]
            for row in part.tolist():
                yield self._picture(values[row - int(part[0])], column, row)

    def _picture(self, value: Any, column: str, row: int) -> Any:
        """Returns a picture as [rows, columns, 3] or [rows, columns], or the bytes of an image file."""
        if isinstance(value, bytes):
            return value
        picture = np.asarray(value)
        channels = {*picture.shape[::2]} & {1, 3, 4} if picture.ndim == 3 else {1}
        if picture.dtype.kind not in "uif" or not 1 <= picture.ndim <= 3 or not channels:
            raise MappingError(
                f"{self.at(row)}: '{column}' is no picture but {picture.dtype} of shape {list(picture.shape)}; a "
                "picture is uint8, [rows, columns, 3], [3, rows, columns] or [rows, columns], or the bytes of an image"
            )
        if picture.ndim == 1:
            return picture.tobytes()
        if picture.ndim == 3 and picture.shape[0] in (1, 3) and picture.shape[2] not in (1, 3, 4):
            picture = picture.transpose(1, 2, 0)
        return np.ascontiguousarray(picture[..., 0] if picture.shape[2:] == (1,) else picture)
