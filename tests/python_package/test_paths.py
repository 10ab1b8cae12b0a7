"""Folders whose names have letters that have a meaning elsewhere: in patterns, URIs, shells and YAML."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import polars
import pytest
from conftest import ROOT, SMOKE

import harness
from harness.policies import Observations

SPECIAL = "a b [1] * ? # %41 {x,y} é 漢"
DECOYS = ("a b 1 * ? # %41 {x,y} é 漢", "a b [1] * ? # A {x,y} é 漢")
"""What a reader makes of SPECIAL that takes it as a pattern or as a part of a URI."""


def hold(observations: Observations) -> np.ndarray:
    return observations["setpoint"][-1]


@pytest.fixture(scope="module")
def special(results: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a copy of the smoke experiment's results, beside folders with half of its runs."""
    parent = tmp_path_factory.mktemp("parent")
    shutil.copytree(results, parent / SPECIAL / "results [1]")
    for decoy in DECOYS:
        shutil.copytree(results, parent / decoy / "results [1]")
        shutil.rmtree(next((parent / decoy / "results [1]/runs/smoke").iterdir()))
    return parent / SPECIAL


@pytest.fixture(params=["absolute", "relative"])
def inside(special: Path, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The same folder, or its path from itself, as a user types it."""
    monkeypatch.chdir(special)
    return special if request.param == "absolute" else Path()


def test_results_are_read_in_a_folder_of_any_name(results: Path, inside: Path) -> None:
    found = inside / "results [1]"
    for sql in ("select * from metrics", "select * from runs", "select episode, sample, arm_lift from episodes"):
        assert harness.query(sql, found).equals(harness.query(sql, results))
    assert harness.compare(results=found).equals(harness.compare(results=results))
    assert harness.claims(results=found).equals(harness.claims(results=results))
    assert harness.verify(found) == []
    assert harness.run(SMOKE, results=found, progress=False) == (0, 2)
    for folder in (results / "datasets").iterdir():
        data, original = harness.Dataset(found / "datasets" / folder.name), harness.Dataset(folder)
        assert np.array_equal(data["arm"], original["arm"])
        assert np.array_equal(data.episode(1)["vision"], original.episode(1)["vision"])
    observation = {name: original[name][:3] for name in ("proprioception", "vision")}
    means = [harness.load_model("smoke/cluttered", each).encode(observation)[0] for each in (found, results)]
    assert np.array_equal(*means)
    actions = [harness.task(SMOKE, cell="empty", results=each).train()[:].actions for each in (found, results)]
    assert np.array_equal(*actions)


def test_files_are_written_to_a_folder_of_any_name(
    special: Path, results: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(special)
    found, new = Path("results [1]"), Path("new [1] * ? # %41")
    new.mkdir()
    shutil.copy(SMOKE, spec := new / "spec [1] # %41.yaml")
    calls: dict[str, Any] = {
        "plot.svg": lambda path: harness.plot(
            "smoke", x="scenario", metrics="r2", by="modality", output=path, results=found
        ),
        "report.html": lambda path: harness.report("smoke", output=path, results=found, progress=False),
        "model.onnx": lambda path: harness.export_onnx("smoke/empty", path, results=found),
        "task.yaml": lambda path: harness.task(spec, cell="empty", results=found).save(path),
    }
    for name, write in calls.items():
        write(path := new / f"t[1] * ? # %41 {name}")
        assert path.stat().st_size > 100, name
    reopened = harness.task(new / "t[1] * ? # %41 task.yaml", results=found)
    assert reopened.hash == harness.task(SMOKE, cell="empty", results=results).hash
    (drawn, *_) = harness.figures("forces_dataset", single="smoke", folder=new / "f[1]", formats="csv", results=found)
    assert drawn.parent == new / "f[1]" and drawn.stat().st_size > 100
    assert harness.run(spec, {"scenarios": "empty"}, results=new / "r[1]", progress=False) == (1, 0)
    sql = "select value from metrics where run like '%empty%' order by task, model, modality, metric, value"
    assert harness.query(sql, new / "r[1]").equals(harness.query(sql, found))
    assert len(polars.read_parquet(next((new / "r[1]/datasets").glob("*/episode_00000.parquet")).read_bytes())) == 30


def test_a_world_is_read_from_a_folder_of_any_name(special: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("twelve.yaml", "twelve.xml"):
        shutil.copy(ROOT / "models" / name, special / name)
    monkeypatch.chdir(special)
    for world in (special / "twelve.yaml", Path("twelve.yaml")):
        batch = harness.SimulationBatch(world, 1, SMOKE)
        batch.reset(0, 0, 0)
        assert np.isfinite(batch.sense("contact_force")).all()
    shutil.copy(SMOKE, special / "spec [1].yaml")
    short = {"scenarios": "twelve.yaml", "simulation.actuations_per_episode": 1, "simulation.episodes": 3}
    made = harness.collect(
        "spec [1].yaml", short, policy=hold, version="1", workers=2, results="of a policy [1]", progress=False
    )
    assert list(made.values()) == [3]
