"""Builds the Python package with maturin, after setting the path of MuJoCo's library.

The wheel `mujoco` contains the library only under its versioned name, but the crate mujoco-rs links to `libmujoco.so`.
The build therefore needs a folder with links of both names. setup.sh makes one in `.venv`. Without it, this module
makes one in `target`, for the wheel in the build environment.
"""

import importlib.util
import os
from pathlib import Path

import maturin
from maturin import (  # noqa: F401  (hooks that need no library)
    get_requires_for_build_editable,
    get_requires_for_build_wheel,
    prepare_metadata_for_build_editable,
    prepare_metadata_for_build_wheel,
)

ROOT = Path(__file__).resolve().parent.parent


def link_mujoco() -> None:
    """Makes the links if they are missing, and sets MUJOCO_DYNAMIC_LINK_DIR. Ends the build if there is no wheel."""
    folder = ROOT / ".venv" / "mujoco"
    if not (folder / "libmujoco.so").exists():
        wheel = importlib.util.find_spec("mujoco")
        if wheel is None or wheel.origin is None:
            raise SystemExit("mujoco is not installed in the build environment; build with isolation, or install it")
        library = next(Path(wheel.origin).parent.glob("libmujoco.so.*"))
        folder = ROOT / "target" / "mujoco"
        folder.mkdir(parents=True, exist_ok=True)
        for name in ("libmujoco.so", library.name):
            (folder / name).unlink(missing_ok=True)
            (folder / name).symlink_to(library)
    os.environ["MUJOCO_DYNAMIC_LINK_DIR"] = str(folder)


def build_wheel(*arguments, **settings):
    """The hook for `pip install .`, with maturin's arguments."""
    link_mujoco()
    return maturin.build_wheel(*arguments, **settings)


def build_editable(*arguments, **settings):
    """The hook for `pip install --editable .`, with maturin's arguments."""
    link_mujoco()
    return maturin.build_editable(*arguments, **settings)
