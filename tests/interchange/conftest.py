"""Datasets that the harness collected, for the tests of exporting and importing."""

import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SPEC = "experiments/smoke.yaml"
"""4 episodes of 30 samples a scenario."""


class Harness:
    """The program on a results folder."""

    def __init__(self, results: Path):
        self.results = results

    def __call__(self, *arguments: str) -> subprocess.CompletedProcess:
        program = ROOT / "target/debug/harness"
        assert program.exists(), f"{program} is missing; build it with `cargo build`"
        command = [program, "--results", self.results, *arguments]
        return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


@pytest.fixture(scope="session", params=["empty", "cluttered"])
def dataset(request, tmp_path_factory) -> Path:
    """A dataset's folder, beside which lies a smoke run on it."""
    harness = Harness(tmp_path_factory.mktemp("results"))
    answer = harness("run", SPEC, f"scenarios=[{request.param}]")
    assert answer.returncode == 0, answer.stderr
    (folder,) = (harness.results / "datasets").iterdir()
    return folder


@pytest.fixture
def harness(tmp_path) -> Harness:
    """The program on an empty results folder."""
    return Harness(tmp_path / "results")
