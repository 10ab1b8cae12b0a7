"""From the files of a lab to a table with intervals over groups and a figure, with one mapping and one spec."""

import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

ROOT = Path(__file__).parents[2]
ROS2 = get_typestore(Stores.ROS2_HUMBLE)
TRIALS = [(name, number) for name in ("book", "cup", "ball") for number in (1, 2, 3)]
"""An object and a number for each trial."""


def pressed(trial: int, rate_hz: float = 20, seconds: float = 6) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The times, two strains and the force of a trial. The force follows from the strains."""
    random = np.random.default_rng(trial)
    times = np.arange(0, seconds, 1 / rate_hz)
    first, second = (np.abs(np.sin(times * random.uniform(1, 2) + random.uniform(0, 6))) for _ in range(2))
    return times, np.stack([first, second], axis=1), (1 + trial % 3) * first * second


def write_clocks(folder: Path) -> None:
    """A table for each trial, with seven columns of times: of six gauges and of a pose."""
    for trial, (name, number) in enumerate(TRIALS):
        times, strains, force = pressed(trial)
        table: dict[str, np.ndarray] = {}
        for gauge in range(6):
            table |= {f"adc{gauge}_time": times + gauge / 1000, f"adc{gauge}_data": strains[:, gauge % 2]}
        pl.DataFrame(table | {"pose_time": times, "pose_x": force}).write_csv(folder / f"{name}_{number}.csv")


def write_records(folder: Path) -> None:
    """A text for each trial with records of 7 lines, which ten lines of Python convert."""
    for trial, (name, number) in enumerate(TRIALS):
        rows = zip(*pressed(trial), strict=True)
        records = [f"---\nstamp: {t}\nleft: {a}\nright: {b}\nforce: {f}\nstate: ok\n\n" for t, (a, b), f in rows]
        (folder / f"{name}_{number}.txt").write_text("".join(records))
    for path in folder.glob("*.txt"):
        rows = ["stamp,left,right,force"]
        values = {}
        for line in path.read_text().splitlines():
            key, _, value = line.partition(": ")
            values[key] = value
            if key == "state":
                rows.append(",".join(values[each] for each in ("stamp", "left", "right", "force")))
        path.with_suffix(".csv").write_text("\n".join(rows))


def write_trials(folder: Path) -> None:
    """A table for each trial, called by its object, with units below the header."""
    for trial, (name, number) in enumerate(TRIALS):
        times, strains, force = pressed(trial)
        rows = "".join(f"{1000 * t:.0f},{a},{b},{f}\n" for t, (a, b), f in zip(times, strains, force, strict=True))
        (folder / f"{name}_{number:03}.csv").write_text(f"Time,Left,Right,Force\nms,V,V,N\n{rows}")


def write_continuous(folder: Path) -> None:
    """One long table without times."""
    parts = [pressed(trial) for trial in range(9)]
    rows = [np.column_stack([strains, force]) for _, strains, force in parts]
    pl.DataFrame(np.concatenate(rows), ["left", "right", "force"]).write_csv(folder / "log.csv")


def write_bags(folder: Path) -> None:
    """An MCAP file for each trial, with the clock of a simulation, which begins at 0."""
    stamp, header = ROS2.types["builtin_interfaces/msg/Time"], ROS2.types["std_msgs/msg/Header"]
    vector, stamped = ROS2.types["geometry_msgs/msg/Vector3"], ROS2.types["geometry_msgs/msg/Vector3Stamped"]
    for trial, (name, number) in enumerate(TRIALS):
        with Writer(folder / f"{name}_{number}", version=9, storage_plugin=StoragePlugin.MCAP) as bag:
            topic = bag.add_connection("/press", stamped.__msgtype__, typestore=ROS2)
            for t, (a, b), f in zip(*pressed(trial), strict=True):
                at = round(t * 1e9)
                message = stamped(header(stamp(at // 10**9, at % 10**9), ""), vector(a, b, f))
                bag.write(topic, at, ROS2.serialize_cdr(message, stamped.__msgtype__))


def write_arrays(folder: Path) -> None:
    """The arrays of a simulation for each trial."""
    for trial, (name, number) in enumerate(TRIALS):
        times, strains, force = pressed(trial)
        np.savez(folder / f"{name}_{number}.npz", time=times, strain=strains, force=force, settings=np.array([None]))


CLOCKS = "".join(f'  adc{gauge}: {{file: "*.csv", time: adc{gauge}_time}}\n' for gauge in range(6))
GAUGES = [f"adc{gauge}.adc{gauge}_data" for gauge in range(6)]
LABELED = """trial: "{object}_{n:int}"
name: press
source: rec
sample_rate_hz: 10
max_gap_s: 0.2
"""
STRAIN = "{from: [log.left, log.right], unit: V}"
KINDS: dict[str, tuple[Callable[[Path], None], str, str]] = {
    "seven clocks": (
        write_clocks,
        f'{LABELED}format: csv\nstreams:\n{CLOCKS}  pose: {{file: "*.csv", time: pose_time}}\n'
        f"modalities: {{setpoint: none, strain: [{', '.join(GAUGES)}], force: pose.pose_x}}\n",
        "object",
    ),
    "records of lines": (
        write_records,
        f'{LABELED}format: csv\nstreams:\n  log: {{file: "*.csv", time: stamp}}\n'
        f"modalities:\n  setpoint: none\n  strain: {STRAIN}\n  force: log.force\n",
        "object",
    ),
    "trials called by their object": (
        write_trials,
        f'{LABELED}format: csv\nstreams:\n  log: {{file: "*.csv", time: Time, time_unit: ms, units_row: true}}\n'
        "modalities:\n  setpoint: none\n  strain: [log.Left, log.Right]\n  force: log.Force\n",
        "object",
    ),
    "one table without times": (
        write_continuous,
        f"{LABELED[LABELED.index('name') :]}format: csv\nmax_episode_s: 6\nstreams:\n  log: {{file: log.csv, rate_hz: 20}}\n"
        f"modalities:\n  setpoint: none\n  strain: {STRAIN}\n  force: log.force\n",
        "episode",
    ),
    "MCAP with simulated time": (
        write_bags,
        f"{LABELED}format: ros2\nstreams:\n  log: {{topic: /press}}\n"
        'modalities:\n  setpoint: none\n  strain: ["log.vector.x", "log.vector.y"]\n  force: log.vector.z\n',
        "object",
    ),
    "npz of a simulation": (
        write_arrays,
        f"{LABELED}format: numpy\nstreams:\n  log: {{data: /, time: time}}\n"
        "modalities:\n  setpoint: none\n  strain: log.strain\n  force: log.force\n",
        "object",
    ),
}
SPEC = """name: press
scenarios: DATASET
input: strain
output: force
latent: 2
tasks: prediction
window: {horizon: 0}
split: {by: GROUP, folds: 3}
network: {preset: single_to_multi, hidden: 8}
training: {epochs: 2}
"""


@pytest.mark.parametrize("kind", KINDS)
def test_files_become_a_table_with_intervals_over_groups_and_a_figure(tmp_path, harness, kind):
    write, mapping, group = KINDS[kind]
    (tmp_path / "rec").mkdir()
    write(tmp_path / "rec")
    (tmp_path / "press.yaml").write_text(mapping)
    command = [sys.executable, "-m", "harness.importing", tmp_path / "press.yaml", "--results", harness.results]
    told = subprocess.run(command, capture_output=True, text=True, check=False)
    assert told.returncode == 0, told.stderr
    dataset = re.findall(r"scenarios=\[(press-\w+)\]", told.stdout)[0]
    spec = SPEC.replace("GROUP", group).replace("DATASET", dataset)
    assert len((mapping + spec).splitlines()) <= 25
    (tmp_path / "spec.yaml").write_text(spec)
    episodes = pl.read_parquet(harness.results / f"datasets/{dataset}/*.parquet")
    assert episodes["episode"].n_unique() == len(TRIALS)
    assert group == "episode" or {*episodes["object"]} == {"book", "cup", "ball"}
    # 10 samples of each second, and the force that follows from the strains.
    strains = episodes.select(pl.col("^strain_.*$")).to_numpy().reshape(len(TRIALS), -1, 6 if "clocks" in kind else 2)
    assert 50 <= strains.shape[1] <= 60
    expected = [pressed(trial)[1][: 2 * strains.shape[1] : 2] for trial in range(len(TRIALS))]
    order = range(len(TRIALS)) if group == "episode" else _by_name()
    np.testing.assert_allclose(strains[:, :, :2], np.stack([expected[trial] for trial in order]), atol=1e-6)
    answer = harness("run", str(tmp_path / "spec.yaml"))
    assert answer.returncode == 0, answer.stderr
    table = json.loads(harness("compare", "press", "--metrics", "r2", "--format", "json").stdout)
    rows = {row["model"]: row for row in table}
    assert (
        rows["network"]["datasets"] == 3 and rows["network"]["low"] < rows["network"]["mean"] < rows["network"]["high"]
    )
    figure = tmp_path / "press.svg"
    answer = harness("plot", "press", "--x", "variant", "--metrics", "r2", "--output", str(figure))
    assert answer.returncode == 0 and "<svg" in figure.read_text(), answer.stderr


def _by_name() -> list[int]:
    """The trials in the order of their files."""
    return sorted(range(len(TRIALS)), key=TRIALS.__getitem__)
