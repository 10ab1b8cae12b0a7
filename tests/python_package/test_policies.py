"""Datasets of policies: what they contain, how they are collected, and mistakes."""

import functools
import hashlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROOT, SMOKE
from numpy.typing import NDArray

import harness
from harness.policies import Observations, identity

SHORT = {"simulation.actuations_per_episode": 2}
"""Episodes of 20 samples."""


def drift(observations: Observations) -> NDArray[np.float64]:
    """Depends on everything that a policy may use: the history, an image, the random generator and the sample."""
    low, high = observations.ranges.T
    forces = observations["contact_force"]
    assert forces.shape == (observations.sample + 1, 20) and not forces.flags.writeable
    red = observations["vision"][-1, :, :, 0].mean() / 255.0
    place = 0.5 + 0.3 * np.sin(0.5 * observations.sample + red) + 0.01 * np.tanh(forces.max())
    setpoint = low + (high - low) * (place + 0.1 * observations.random.uniform(-1.0, 1.0, len(low)))
    # As it is recorded, in 32 bits.
    return setpoint.astype(np.float32).astype(np.float64)


def press(observations: Observations) -> NDArray[np.float64]:
    """Lowers the arm until the finger touches the ground, and keeps it there."""
    setpoint = observations["setpoint"][-1].astype(np.float64)
    if observations["contact_force_mean"][-1].sum() < 0.5:
        setpoint[1] -= 0.02
    return setpoint


def raises(observations: Observations) -> NDArray[np.float64]:
    if observations.episode == 3 and observations.sample == 3:
        raise ZeroDivisionError("nothing to divide by")
    return observations["setpoint"][-1]


def too_short(observations: Observations) -> NDArray[np.float64]:
    return observations["setpoint"][-1][:2]


def not_a_number(observations: Observations) -> list[float]:
    return [0.0, float("nan"), 0.0]


def nothing(observations: Observations) -> None:
    return None


def slow(observations: Observations) -> NDArray[np.float64]:
    time.sleep(0.02)
    return drift(observations)


class Away:
    """A policy with a state."""

    def __init__(self, place: float) -> None:
        self.place = place

    def __call__(self, observations: Observations) -> NDArray[np.float64]:
        low, high = observations.ranges.T
        return low + self.place * (high - low)


def collect(results: Path, policy: Any, workers: int = 1, **others: Any) -> dict[Path, int]:
    overrides = {"scenarios": "cluttered", **SHORT, **others.pop("overrides", {})}
    return harness.collect(SMOKE, overrides, policy=policy, workers=workers, results=results, progress=False, **others)


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if not path.name.startswith(".")}


def test_the_bytes_are_those_of_any_number_of_workers(tmp_path: Path) -> None:
    folders = []
    for workers in (1, 2, 4):
        ((folder, made),) = collect(tmp_path / str(workers), drift, workers).items()
        assert made == 4
        folders.append(folder)
    first = files(folders[0])
    assert len(first) == 6  # four episodes, the description and the model
    assert all(files(folder) == first and folder.name == folders[0].name for folder in folders[1:])
    assert collect(tmp_path / "2", drift, 2) == {folders[1]: 0}


def test_a_dataset_has_the_setpoints_that_the_policy_gave(tmp_path: Path) -> None:
    ((folder, _),) = collect(tmp_path, drift).items()
    data = harness.Dataset(folder)
    batch = data.simulation()
    for index in range(4):
        batch.reset(0, data.seed, index)
        recorded = data.episode(index)
        for sample in range(20):
            if sample > 0:
                batch.step(recorded["setpoint"][None, sample].astype(np.float64))
            for name in ("proprioception", "contact_force", "arm", "vision"):
                assert np.array_equal(batch.sense(name)[0], recorded[name][sample]), (name, sample)
        assert np.ptp(recorded["setpoint"], axis=0).min() > 0.0
    with pytest.raises(RuntimeError, match="only Python can ask a policy"):
        batch.follow()


def test_a_policy_can_react_to_what_it_senses(tmp_path: Path) -> None:
    overrides = {"scenarios": "empty", "simulation.actuations_per_episode": 6}
    ((folder, _),) = collect(tmp_path, press, overrides=overrides).items()
    data = harness.Dataset(folder)
    for index in range(4):
        force = data.episode(index)["contact_force_mean"].sum(axis=1)
        assert force[0] < 0.5 < force[-1] < 100.0, force


def test_an_experiment_is_trained_on_the_data_of_a_policy(tmp_path: Path) -> None:
    named = {"scenarios": "empty", **SHORT, "simulation.policy": identity(press)}
    with pytest.raises(RuntimeError, match=r"simulation.policy is press@.*harness.collect\(SPEC, policy="):
        harness.run(SMOKE, named, results=tmp_path, progress=False)
    ((folder, _),) = collect(tmp_path, press, overrides={"scenarios": "empty"}).items()
    assert harness.run(SMOKE, named, results=tmp_path, progress=False) == (1, 0)
    assert harness.query("select dataset from runs", tmp_path)["dataset"].to_list() == [folder.name]
    # With the world's own motion, the same experiment has another dataset and another run.
    assert harness.run(SMOKE, {"scenarios": "empty", **SHORT}, results=tmp_path, progress=False) == (1, 0)
    assert harness.query("select count(distinct dataset) as n from runs", tmp_path)["n"].item() == 2
    assert not harness.verify(tmp_path)


def test_a_spec_can_name_the_policy_that_it_needs(tmp_path: Path) -> None:
    both = {"vary": {"simulation.policy": [None, "press@2"]}, "scenarios": "empty"}
    ((folder, made),) = collect(tmp_path, press, version="2", overrides=both).items()
    assert made == 4
    assert '"policy": "press@2"' in (folder / "dataset.json").read_text()
    with pytest.raises(ValueError, match="the experiment names press@2, but the given policy is press@3"):
        collect(tmp_path, press, version="3", overrides={"simulation.policy": "press@2"})


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (raises, r"policy raises@.*, episode 3, sample 3: it raised ZeroDivisionError: nothing to .* \(.*, line \d+\)"),
        (too_short, r"sample 0: the setpoint: array.* must be 3 finite numbers: rotation, lift, extension"),
        (not_a_number, r"sample 0: the setpoint: \[0.0, nan, 0.0\] must be 3 finite numbers"),
        (nothing, r"sample 0: the setpoint: None must be 3 finite numbers"),
    ],
)
def test_a_wrong_policy_leaves_nothing(
    tmp_path: Path, policy: Callable[[Observations], Any], message: str, workers: int
) -> None:
    with pytest.raises(RuntimeError, match=message):
        collect(tmp_path, policy, workers)
    assert not list((tmp_path / "datasets").iterdir())


def test_a_wrong_policy_keeps_the_episodes_of_earlier_calls(tmp_path: Path) -> None:
    ((folder, made),) = collect(tmp_path, raises, overrides={"simulation.episodes": 3}).items()
    before = files(folder)
    assert made == 3
    with pytest.raises(RuntimeError, match="ZeroDivisionError"):
        collect(tmp_path, raises, 2)
    after = files(folder)
    assert {name: after[name] for name in after if name != "dataset.json"} == {
        name: before[name] for name in before if name != "dataset.json"
    }


def test_a_killed_collection_continues(tmp_path: Path) -> None:
    ((whole, _),) = collect(tmp_path / "whole", slow, 2).items()
    script = (
        "from test_policies import *\n"
        "if __name__ == '__main__':\n"
        f"    collect(Path({str(tmp_path / 'killed')!r}), slow, 2)\n"
    )
    (tmp_path / "script.py").write_text(script)
    environment = with_this_folder()
    process = subprocess.Popen([sys.executable, tmp_path / "script.py"], env=environment, start_new_session=True)
    folder = tmp_path / "killed" / "datasets" / whole.name
    end = time.monotonic() + 60.0
    while not list(folder.glob("episode_*.parquet")) and time.monotonic() < end:
        time.sleep(0.01)
    process.kill()
    process.wait()
    assert ends(process.pid)
    ((_, made),) = collect(tmp_path / "killed", slow, 2).items()
    assert made < 4
    assert files(folder) == files(whole)


def with_this_folder() -> dict[str, str]:
    """The environment of a script that imports this module."""
    folders = [str(Path(__file__).parent), *filter(None, [os.environ.get("PYTHONPATH")])]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(folders)}


def ends(group: int) -> bool:
    """Whether all processes of a group end by themselves, within 30 s."""
    end = time.monotonic() + 30.0
    while time.monotonic() < end:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    return False


def test_a_collection_is_interrupted_by_ctrl_c(tmp_path: Path) -> None:
    script = (
        "from test_policies import *\n"
        "if __name__ == '__main__':\n"
        f"    collect(Path({str(tmp_path / 'results')!r}), slow, 2)\n"
    )
    (tmp_path / "script.py").write_text(script)
    environment = with_this_folder()
    process = subprocess.Popen(
        [sys.executable, tmp_path / "script.py"], env=environment, start_new_session=True, stderr=subprocess.PIPE
    )
    end = time.monotonic() + 60.0
    while not list((tmp_path / "results").glob("datasets/*/episode_*.parquet")) and time.monotonic() < end:
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGINT)
    _, said = process.communicate(timeout=30.0)
    assert process.returncode == -signal.SIGINT and said.count(b"Traceback") == 1, said.decode()
    assert ends(process.pid)


def test_a_script_without_a_guard_is_told_so(tmp_path: Path) -> None:
    script = (
        "from test_policies import *\n"
        "try:\n"
        f"    collect(Path({str(tmp_path / 'results')!r}), press, 2)\n"
        "except RuntimeError as error:\n"
        "    print(error)\n"
    )
    (tmp_path / "script.py").write_text(script)
    environment = with_this_folder()
    ended = subprocess.run(
        [sys.executable, tmp_path / "script.py"], env=environment, capture_output=True, text=True, timeout=60.0
    )
    assert "`if __name__ == '__main__':`" in ended.stdout and ended.stderr == "", ended


def test_the_version_is_a_hash_of_the_file_unless_it_is_given() -> None:
    digest = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()
    assert identity(press) == f"press@{digest[:16]}"
    assert identity(press, "1.2-rc+3") == "press@1.2-rc+3"
    assert identity(Away(0.5), "1") == "Away@1"
    place = 0.5
    wrong: list[tuple[Any, str | None, type[Exception], str]] = [
        (Away(0.5), None, ValueError, "version: Away is no plain function"),
        (functools.partial(press), None, ValueError, "version: partial is no plain function"),
        (press, "1 2", ValueError, "version: '1 2' must be 1 to 64 of the characters"),
        (press, 1, TypeError, "version: 1 must be a text"),
        (3, None, TypeError, "policy: 3 must be a function"),
        (lambda observations: [0.0] * 3, "1", ValueError, "'<lambda>' can't be a policy's name"),
    ]

    def closure(observations: Observations) -> list[float]:
        return [place] * 3

    wrong.append((closure, None, ValueError, "version: closure is no plain function"))
    typed: dict[str, Any] = {}
    exec("def typed(observations): return [0.0, 0.0, 0.0]", typed)
    wrong.append((typed["typed"], None, ValueError, "version: typed was not read from a file"))
    for policy, version, kind, message in wrong:
        with pytest.raises(kind, match=message):
            identity(policy, version)


def test_objects_and_closures_are_policies_with_a_version(tmp_path: Path) -> None:
    place = 0.25

    def closure(observations: Observations) -> NDArray[np.float64]:
        return Away(place)(observations)

    ((one, _),) = collect(tmp_path, Away(0.25), 2, version="a").items()
    ((other, _),) = collect(tmp_path, closure, version="a").items()
    first, second = harness.Dataset(one), harness.Dataset(other)
    assert one.name != other.name
    assert all(np.array_equal(first[name], second[name]) for name in first.keys())
    low, high = harness.SimulationBatch("cluttered").setpoint_ranges.T
    assert np.allclose(first.episode(0)["setpoint"][1:], low + 0.25 * (high - low))
    with pytest.raises(ValueError, match="can't be sent to 2 worker processes .* or use workers=1"):
        collect(tmp_path / "other", closure, 2, version="a")


def test_the_number_of_workers_is_at_least_one(tmp_path: Path) -> None:
    for workers, kind in ((0, ValueError), (1.5, TypeError)):
        with pytest.raises(kind, match="workers: "):
            harness.collect(SMOKE, results=tmp_path, workers=workers)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="version: there is no policy"):
        harness.collect(SMOKE, results=tmp_path, version="1")
    made = harness.collect(SMOKE, {"scenarios": "empty", **SHORT}, results=tmp_path, workers=1, progress=False)
    assert list(made.values()) == [4]


def test_the_world_can_be_a_file(tmp_path: Path) -> None:
    twelve = {**SHORT, "scenarios": str(ROOT / "models/twelve.yaml")}
    made = harness.collect(SMOKE, twelve, policy=Away(0.1), version="1", workers=2, results=tmp_path, progress=False)
    assert list(made.values()) == [4]
