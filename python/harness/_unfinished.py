"""Folders that appear under their name when they are complete."""

from __future__ import annotations

import fcntl
import os
import shutil
import socket
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

LOCK = ".unfinished-lock"
"""The file of a folder that a process locks while it works there, as the Rust program does."""


@contextmanager
def unfinished_folder(parent: Path, purpose: str) -> Iterator[Path]:
    """Makes a folder in `parent`, and removes it at the end unless it was renamed.

    The process holds the lock of the folder. Folders of the same purpose that killed processes have left are removed.
    """
    prefix = f".unfinished-{purpose}-"
    for left in [path for path in parent.iterdir() if path.name.startswith(prefix)]:
        lock = _attempt(left)
        if lock is not None:
            with lock:
                shutil.rmtree(left, ignore_errors=True)
    folder = Path(tempfile.mkdtemp(prefix=prefix, dir=parent))
    lock = _attempt(folder)
    try:
        yield folder
    finally:
        if lock is not None:
            lock.close()
        shutil.rmtree(folder, ignore_errors=True)


def _attempt(folder: Path) -> IO[str] | None:
    """Locks a folder until the returned file is closed. Returns `None` if another process has locked it."""
    try:
        lock = open(folder / LOCK, "a")
    except OSError:
        return None
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        lock.close()
        return None
    lock.truncate(0)
    lock.write(f"process {os.getpid()} on {socket.gethostname()}")
    lock.flush()
    return lock
