"""Builds the Python package: maturin, told where MuJoCo's library lies.

The wheel `mujoco` has only the library's versioned name, and the crate mujoco-rs links to `libmujoco.so`. A folder with
both names does, as setup.sh makes it in `.venv`; where there is none, it is made of the wheel in the build environment.
"""

import importlib.util
import os
from pathlib import Path

import maturin
from maturin import (  # noqa: F401  (hooks that need nothing)
    get_requires_for_build_editable,
    get_requires_for_build_wheel,
    prepare_metadata_for_build_editable,
    prepare_metadata_for_build_wheel,
)

ROOT = Path(__file__).resolve().parent.parent


def link_mujoco() -> None:
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
    link_mujoco()
    return maturin.build_wheel(*arguments, **settings)


def build_editable(*arguments, **settings):
    link_mujoco()
    return maturin.build_editable(*arguments, **settings)
