"""Reads HDF5 files."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from .arrays import Arrays, takes_of
from .mapping import Mapping
from .streams import Take, blaming, natural, needing, sources

SUFFIXES = (".h5", ".hdf5", ".hdf", ".he5")


def takes(mapping: Mapping) -> list[Callable[[], Iterator[Take]]]:
    """Returns what yields the takes of each of the HDF5 files."""
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
        with blaming(str(path)):
            found = {name: item for name, item in _datasets(file) if item.shape is not None}
        names = sorted(found, key=lambda name: natural(Path(name)))
        yield Arrays({name: found[name] for name in names}, lambda group: file[group or "/"].attrs)


def members(group: Any) -> Iterator[tuple[str, Any]]:
    """Yields the groups and datasets in a group by their names, also those of other places and files, to which links
    lead. Links to nowhere are left out."""
    import h5py

    for name in group:
        try:
            item = group[name]
        except (KeyError, OSError):
            if isinstance(group.get(name, getlink=True), h5py.HardLink):
                raise
            continue
        if isinstance(item, h5py.Group | h5py.Dataset):
            yield name, item


def _datasets(group: Any, prefix: str = "", above: tuple[Any, ...] = ()) -> Iterator[tuple[str, Any]]:
    """Yields the datasets in a group and below it with their paths. Does not follow links to groups above them."""
    above = (*above, group)
    for name, item in members(group):
        if not hasattr(item, "keys"):
            yield f"{prefix}{name}", item
        elif item not in above:
            yield from _datasets(item, f"{prefix}{name}/", above)
