"""Reads zarr stores, of version 2 and 3, as folders or ZIP files."""

from __future__ import annotations

import contextlib
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

from .arrays import Arrays, takes_of
from .mapping import Mapping, MappingError
from .streams import Take, blaming, natural, needing, sources

SUFFIXES = (".zarr", ".zip")
MARKS = ("zarr.json", ".zgroup", ".zmetadata")
"""Files at the top of a store."""


def takes(mapping: Mapping) -> list[Callable[[], Iterator[Take]]]:
    """Returns what yields the takes of each of the zarr stores."""
    return takes_of(mapping, sources(mapping, SUFFIXES, MARKS), opened)


@contextlib.contextmanager
def opened(path: Path) -> Iterator[Arrays]:
    """Opens the arrays of a store.

    Raises:
        MappingError: it is no zarr store, or damaged.
        ImportError: the package zarr is not installed.
    """
    with needing("zarr", "zarr stores"):
        import zarr
        from zarr.storage import ZipStore
    with contextlib.ExitStack() as stack:
        with blaming(str(path)):
            if path.is_file():
                # A store that can't be opened can't be closed either.
                zipfile.ZipFile(path).close()
            store = stack.enter_context(ZipStore(path, mode="r")) if path.is_file() else path
            root = zarr.open(store, mode="r")
            if not isinstance(root, zarr.Group):
                raise MappingError(f"{path}: is a single array; a recording is a group of arrays")
            found = {name: item for name, item in root.members(max_depth=None) if isinstance(item, zarr.Array)}
        names = sorted(found, key=lambda name: natural(Path(name)))
        yield Arrays({name: found[name] for name in names}, lambda group: (root[group] if group else root).attrs)
