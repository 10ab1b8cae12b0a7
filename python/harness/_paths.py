"""Paths for libraries that take letters of a path for a pattern, or for a protocol."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def plain_path(folder: Path) -> Iterator[Path]:
    """Yields a path of a folder without such letters: its own, or that of a link, which is removed at the end."""
    if re.fullmatch(r"[\w ./-]*", str(folder.absolute())):
        yield folder
        return
    with tempfile.TemporaryDirectory() as temporary:
        link = Path(temporary) / "link"
        link.symlink_to(folder.absolute(), target_is_directory=True)
        yield link
