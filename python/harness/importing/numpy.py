"""Reads NumPy files: `.npz` with several arrays, and `.npy` with one array, which is called `array`."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .arrays import Arrays, takes_of
from .mapping import Mapping
from .streams import Take, blaming, natural, sources

SUFFIXES = (".npz", ".npy")


def takes(mapping: Mapping) -> list[Callable[[], Iterator[Take]]]:
    """Returns what yields the takes of each NumPy file."""
    return takes_of(mapping, sources(mapping, SUFFIXES), opened)


@contextlib.contextmanager
def opened(path: Path) -> Iterator[Arrays]:
    """Opens the arrays of a file, of which single values are its attributes. Objects are not read, because reading them could run a program.

    Raises:
        MappingError: it is no NumPy file, or damaged.
    """
    with blaming(str(path)):
        if path.suffix == ".npy":
            found = {"array": np.load(path, mmap_mode="r", allow_pickle=False)}
        else:
            with np.load(path, allow_pickle=False) as file:
                found = {
                    name: array for name in sorted(file.files, key=_order) if (array := _read(file, name)) is not None
                }
    single = {name: array for name, array in found.items() if array.ndim == 0}
    yield Arrays({name: array for name, array in found.items() if array.ndim}, lambda group: {} if group else single)


def _order(name: str) -> list[object]:
    return natural(Path(name))


def _read(file: Any, name: str) -> np.ndarray | None:
    """Returns an array of a file; None if it holds objects."""
    try:
        found: np.ndarray = file[name]
        return found
    except ValueError as error:
        if "allow_pickle" not in str(error):
            raise
        return None
