"""The smoke experiment, done once for all tests by the package itself."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

# For the renderer of MuJoCo's own package, which reads it when it is imported.
os.environ.setdefault("MUJOCO_GL", "egl")

import polars
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


@pytest.fixture
def copy(results: Path, tmp_path: Path) -> Path:
    """A copy of the smoke experiment's results."""
    folder = tmp_path / "results"
    shutil.copytree(results, folder)
    return folder


def check_example(name: str, inputs: list[str], results: Path) -> None:
    """Runs an example on a task, and checks that its best model learned something."""
    dataset = next(path.name for path in (results / "datasets").iterdir() if path.name.startswith("empty"))
    outputs = ["arm", "contact_force"]
    task = harness.task(dataset=dataset, inputs=inputs, outputs=outputs, context=3, horizons=5, results=results)
    task.save(results.parent / "task.yaml")
    command = [sys.executable, ROOT / f"python/examples/{name}.py", "task.yaml", "1"]
    subprocess.run(command, cwd=results.parent, check=True)
    # The arm hardly moves in a sample, so any model that learned something is better than the mean.
    errors = task.compare(metrics="rmse", of="arm")
    best = dict(errors.group_by("model").agg(polars.col("mean").min()).iter_rows())
    others = {model: error for model, error in best.items() if model not in ("persistence", "ridge", "training_mean")}
    assert others and min(others.values()) < best["training_mean"], best
