"""Reads MATLAB files. Their variables are read into memory.

The fields of a structure are called `trial/joints`, and the elements of arrays of structures and of cells are counted
from 1: `trials/1/joints`.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .arrays import Arrays, takes_of
from .hdf5 import members
from .mapping import Mapping
from .streams import Take, blaming, needing, sources

SUFFIXES = (".mat",)
HDF5_MARK = b"\x89HDF"
"""What an HDF5 file has at its begin, or 512 bytes later, as those of MATLAB 7.3 do."""


def takes(mapping: Mapping) -> list[Callable[[], Iterator[Take]]]:
    """Returns what yields the takes of each of the MATLAB files."""
    return takes_of(mapping, sources(mapping, SUFFIXES), opened, by_rows=False)


@contextlib.contextmanager
def opened(path: Path) -> Iterator[Arrays]:
    """Opens the variables of a file.

    Raises:
        MappingError: it is no MATLAB file, or damaged.
        ImportError: the package scipy is not installed, or h5py for files of version 7.3.
    """
    with blaming(str(path)), open(path, "rb") as file:
        begin = file.read(1024)
    if HDF5_MARK in (begin[:4], begin[512:516]):
        with needing("h5py", "MATLAB files of version 7.3"):
            import h5py
        with blaming(str(path)):
            opened_file = h5py.File(path, "r")
        with opened_file:
            with blaming(str(path)):
                found = dict(_of_hdf5(opened_file, "", opened_file, h5py))
            yield Arrays(found)
        return
    with needing("scipy", "MATLAB files"):
        from scipy.io import loadmat
    with blaming(str(path)):
        variables = loadmat(path)
        found = {
            place: array
            for name, value in variables.items()
            if not name.startswith("__")
            for place, array in _of_scipy(name, value)
        }
    yield Arrays(found)


def _of_scipy(place: str, value: Any) -> Iterator[tuple[str, np.ndarray]]:
    """Yields the arrays of numbers in a variable."""
    if not isinstance(value, np.ndarray):
        return
    if value.dtype.names is not None:
        for index, each in enumerate(value.flat, 1):
            inside = place if value.size == 1 else f"{place}/{index}"
            for name in value.dtype.names:
                yield from _of_scipy(f"{inside}/{name}", each[name])
    elif value.dtype.kind == "O":
        for index, each in enumerate(value.flat, 1):
            yield from _of_scipy(f"{place}/{index}", each)
    elif value.dtype.kind in "biuf" and value.ndim:
        yield place, value


def _of_hdf5(file: Any, prefix: str, group: Any, h5py: Any) -> Iterator[tuple[str, Any]]:
    """Yields the arrays of numbers in a group of a file of MATLAB 7.3, whose axes are in the opposite order."""
    for name, item in members(group):
        place = f"{prefix}{name}"
        if name.startswith("#"):
            continue
        if isinstance(item, h5py.Group):
            yield from _of_hdf5(file, f"{place}/", item, h5py)
        elif item.dtype.kind == "O":
            is_cell = item.attrs.get("MATLAB_class") == b"cell"
            for index, reference in enumerate(item[()].flat, 1):
                inside = f"{place}/{index}" if is_cell else f"{prefix}{index}/{name}"
                target = file[reference]
                if isinstance(target, h5py.Group):
                    yield from _of_hdf5(file, f"{inside}/", target, h5py)
                elif target.dtype.kind in "biuf":
                    yield inside, _Transposed(target)
        elif item.dtype.kind in "biuf" and item.shape and not _is_text_or_empty(item):
            yield place, _Transposed(item)


def _is_text_or_empty(dataset: Any) -> bool:
    return dataset.attrs.get("MATLAB_class") == b"char" or "MATLAB_empty" in dataset.attrs


class _Transposed:
    """A dataset of a file, with its axes in MATLAB's order."""

    def __init__(self, dataset: Any):
        self._dataset, self.shape, self.dtype = dataset, dataset.shape[::-1], dataset.dtype

    def __getitem__(self, key: Any) -> np.ndarray:
        found: np.ndarray = self._dataset[()].T[key]
        return found
