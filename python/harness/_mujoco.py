"""Loads MuJoCo's library from the package `mujoco`, wherever Python finds it. The extension needs the library."""

import ctypes
import importlib.util
from pathlib import Path

VERSION = "3.17.0"
"""The version of MuJoCo that the extension module was built for."""


def load() -> None:
    """Loads the library. Raises ImportError if the package is missing or has another version."""
    package = importlib.util.find_spec("mujoco")
    folders = package.submodule_search_locations if package else None
    for folder in folders or []:
        library = Path(folder) / f"libmujoco.so.{VERSION}"
        if library.exists():
            ctypes.CDLL(str(library))
            return
    raise ImportError(f"MuJoCo {VERSION} is missing; install its Python package: pip install mujoco=={VERSION}")
