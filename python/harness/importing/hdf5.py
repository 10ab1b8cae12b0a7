"""Reads HDF5 files."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from .arrays import Arrays, takes_of
from .mapping import Mapping
from .streams import Take, blaming, natural, needing, sources

SUFFIXES = (".h5", ".hdf5", ".hdf", ".he5")


def takes(mapping: Mapping) -> Iterator[Take]:
    """Yields the takes of HDF5 files."""
    return takes_of(mapping, sources(mapping, SUFFIXES), opened)


@contextlib.contextmanager
def opened(path: Path) -> Iterator[Arrays]:
    """Opens the datasets of a file.

    Raises:
        MappingError: it is no HDF5 file, or damaged.
        ImportError: the package h5py is not installed.
    """
    with needing("h5py", "HDF5 files"):
        import h5py
    with blaming(str(path)):
        file = h5py.File(path, "r")
    with file:
        found: Arrays = {}

        def visit(name: str, item: Any) -> None:
            if isinstance(item, h5py.Dataset) and item.shape is not None:
                found[name] = item

        with blaming(str(path)):
            file.visititems(visit)
        yield {name: found[name] for name in sorted(found, key=lambda name: natural(Path(name)))}
