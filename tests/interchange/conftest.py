"""Datasets that the harness collected, for the tests of exporting and importing."""

import shutil
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


FOREIGN = {
    "twelve": ("proprioception", "contact_force", ", factors: finger_stiffness"),
    "suite_finger": ("joints", "touch", ""),
}
"""Robots that the harness does not know: an input, an output, and further settings of the simulation."""


@pytest.fixture(scope="session", params=FOREIGN)
def foreign(request, tmp_path_factory) -> Path:
    """The folder of a dataset whose world is a file outside of the repository: a finger of 12 links with a second
    camera, whose episodes differ in stiffness, or the finger of dm_control's suite as its package has it."""
    world, folder = request.param, tmp_path_factory.mktemp("robot")
    harness = Harness(folder / "results")
    if world == "twelve":
        for name in ("twelve.xml", "twelve.yaml"):
            shutil.copy(ROOT / "models" / name, folder / name)
    else:
        (model,) = ROOT.glob(".venv/lib/python3*/site-packages/dm_control/suite/finger.xml")
        answer = harness("world", "new", str(model), "--output", str(folder / f"{world}.yaml"))
        assert answer.returncode == 0, answer.stderr
    given, predicted, settings = FOREIGN[world]
    spec = folder / "experiment.yaml"
    spec.write_text(
        f"name: foreign\nscenarios: {world}.yaml\ninput: {given}\noutput: {predicted}\nlatent: 2\n"
        "network: {preset: single_to_multi}\n"
        f"simulation: {{episodes: 4, actuations_per_episode: 3{settings}}}\n"
    )
    answer = harness("collect", str(spec))
    assert answer.returncode == 0, answer.stderr
    (dataset,) = (harness.results / "datasets").iterdir()
    return dataset


@pytest.fixture
def harness(tmp_path) -> Harness:
    """The program on an empty results folder."""
    return Harness(tmp_path / "results")
