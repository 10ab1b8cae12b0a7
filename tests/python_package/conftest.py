"""The smoke experiment, done once for all tests by the package itself."""

import os
from pathlib import Path

# For the renderer of MuJoCo's own package, which reads it when it is imported.
os.environ.setdefault("MUJOCO_GL", "egl")

import pytest

import harness

ROOT = Path(__file__).resolve().parents[2]
SMOKE = ROOT / "experiments" / "smoke.yaml"


@pytest.fixture(scope="session")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A results folder with the smoke experiment's two runs."""
    folder = tmp_path_factory.mktemp("results")
    assert harness.run(SMOKE, results=folder, progress=False) == (2, 0)
    return folder


@pytest.fixture(scope="session")
def folders(results: Path) -> dict[str, Path]:
    """The smoke experiment's datasets by scenario."""
    return {folder.name.split("-")[0]: folder for folder in (results / "datasets").iterdir()}
