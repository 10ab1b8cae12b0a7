"""Recordings of streams, written by other libraries, as datasets of the harness."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import av
import h5py
import numpy as np
import polars as pl
import pytest
import scipy.io
import zarr
from PIL import Image
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from harness import _harness
from harness.importing import example, import_dataset

ROOT = Path(__file__).parents[2]
ROS2 = get_typestore(Stores.ROS2_HUMBLE)


def read_episodes(results: Path, name: str) -> list[pl.DataFrame]:
    return [pl.read_parquet(path) for path in sorted((results / "datasets" / name).glob("episode_*.parquet"))]


def content(mapping: Path) -> dict:
    return json.loads(_harness.read_mapping(mapping))


def write_mapping(folder: Path, **keys) -> Path:
    defaults = {"name": "lab", "source": ".", "sample_rate_hz": 10, "max_gap_s": 1}
    path = folder / "lab.yaml"
    path.write_text(json.dumps(defaults | keys, sort_keys=True))
    return path


def imported(folder: Path, **keys) -> list[pl.DataFrame]:
    """Writes a mapping, imports it, and returns the episodes."""
    results = folder / "results"
    return read_episodes(results, import_dataset(write_mapping(folder, **keys), results, progress=False))


@pytest.fixture(scope="session")
def recording(tmp_path_factory) -> Path:
    """The example in every format."""
    folder = tmp_path_factory.mktemp("recording")
    example.write(folder, list(example.FORMATS))
    return folder


def last_values(times: np.ndarray, values: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """The last value at each sample, by a loop over the samples."""
    return np.array([values[[index for index, time in enumerate(times) if time <= at + 1e-6][-1]] for at in samples])


@pytest.mark.parametrize("format", ["csv", "hdf5", "matlab", "ros2"])
def test_the_example_comes_back_in_a_format(recording, harness, format):
    name = import_dataset(recording / f"{format}.yaml", harness.results, progress=False)
    episodes = read_episodes(harness.results, name)
    assert len(episodes) == example.TRIALS
    for index, episode in enumerate(episodes):
        trial = example.simulate(index)
        clocks = (trial.command_times, trial.joint_times, trial.force_times, trial.frame_times)
        start, end = max(clock[0] for clock in clocks), min(clock[-1] for clock in clocks)
        samples = np.arange(start, end, 0.1)
        np.testing.assert_allclose(episode["time"].to_numpy(), samples - start, atol=1e-9)
        values = {key: episode.select(pl.col(f"^{key}_.*$")).to_numpy() for key in ("setpoint", "angles", "force")}
        for key, times, expected in (
            ("setpoint", trial.command_times, trial.commands),
            ("angles", trial.joint_times, trial.angles),
        ):
            np.testing.assert_allclose(values[key], last_values(times, expected, samples), rtol=1e-6)
        means = [
            trial.forces[(trial.force_times > at - 0.1 + 1e-6) & (trial.force_times <= at + 1e-6)].mean()
            for at in samples
        ]
        np.testing.assert_allclose(values["force"][:, 0], means, rtol=1e-5, atol=1e-6)
        found = np.stack([np.frombuffer(frame, np.uint8).reshape(64, 64, 3) for frame in episode["vision"]])
        frames = last_values(trial.frame_times, trial.frames, samples)
        resized = [np.asarray(Image.fromarray(frame).resize((64, 64), Image.Resampling.BOX)) for frame in frames]
        difference = np.abs(found.astype(int) - np.stack(resized)).mean(axis=(1, 2, 3))
        # H.264 and JPEG change values. A frame earlier or later would differ by more than this while the finger moves.
        assert difference.max() <= (0 if format in ("hdf5", "matlab") else 3.0)
    answer = harness("verify")
    assert answer.returncode == 0, answer.stdout


def test_the_example_comes_back_from_a_zarr_store_by_rows(recording, harness):
    name = import_dataset(recording / "zarr.yaml", harness.results, progress=False)
    for index, episode in enumerate(read_episodes(harness.results, name)):
        trial = example.simulate(index)
        # Rows follow each other at 30 Hz, so that every third one is a sample.
        rows = np.arange(0, len(trial.frame_times), 3)
        latest = np.maximum(np.searchsorted(trial.joint_times, trial.frame_times[rows], side="right") - 1, 0)
        angles = episode.select(pl.col("^angles_.*$")).to_numpy()
        np.testing.assert_allclose(angles, trial.angles[latest], rtol=1e-6)


def test_the_same_numbers_have_the_same_hash_in_any_format(recording, harness):
    names = []
    for format in ("hdf5", "matlab"):
        mapping = content(recording / f"{format}.yaml") | {"name": "finger"}
        path = recording / f"same_{format}.yaml"
        path.write_text(json.dumps(mapping))
        names.append(import_dataset(path, harness.results, progress=False))
    assert names[0] == names[1]


def test_the_command_prints_the_clocks_and_shows_progress(recording, tmp_path):
    command = [
        sys.executable,
        "-m",
        "harness.importing",
        str(recording / "ros2.yaml"),
        "--results",
        str(tmp_path / "r"),
    ]
    answer = subprocess.run(command, capture_output=True, text=True, check=False, env=os.environ)
    assert answer.returncode == 0, answer.stderr
    lines = [line.split() for line in answer.stdout.splitlines()]
    assert lines[0] == ["stream", "rows", "rate", "jitter", "longest", "gap", "delay", "transport"]
    joints, command_stream = lines[1], lines[3]
    assert joints[:2] == ["joints", "4800"] and joints[3] == "Hz" and 99 < float(joints[2]) < 101
    # The messages have between 2 and 4 ms on the way, and commands have no header.
    assert 2.5 < float(joints[-2]) < 3.5 and command_stream[-1] == "-"
    assert "reading times" in answer.stderr and "100%" in answer.stderr and "6.0/6 episodes" in answer.stderr


# --- alignment, on numbers that can be computed by hand ---

SLOW = {"t": [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6], "u": [0.0] * 7}


def three_trials(folder: Path, **columns) -> Path:
    """Writes CSV files of three equal trials: `slow.csv`, 10 Hz, and `fast.csv` with the given columns."""
    for trial in range(3):
        place = folder / f"trial_{trial}"
        place.mkdir()
        pl.DataFrame(SLOW).write_csv(place / "slow.csv")
        pl.DataFrame(columns).write_csv(place / "fast.csv")
    return folder


STREAMS = {"slow": {"file": "*/slow.csv", "time": "t"}, "fast": {"file": "*/fast.csv", "time": "t"}}
TWO = {"setpoint": "slow.u", "value": "fast.x"}
FAST = {
    "t": [0.0, 0.04, 0.1, 0.13, 0.18, 0.34, 0.38, 0.52, 0.61],
    "x": [0.0, 4.0, 10.0, 13.0, 18.0, 34.0, 38.0, 52.0, 61.0],
}
"""A stream without a rate, whose value is a hundred times its time."""


@pytest.mark.parametrize(
    ("align", "expected"),
    [
        ("last", [0, 10, 18, 18, 38, 38, 52]),
        ("linear", [0, 10, 20, 30, 40, 50, 60]),
        # (4 + 10) / 2; (13 + 18) / 2; nothing since 0.2, so the last; (34 + 38) / 2; nothing; 52
        ("mean", [0, 7, 15.5, 18, 36, 38, 52]),
    ],
)
def test_a_stream_is_aligned_by(tmp_path, align, expected):
    three_trials(tmp_path, **FAST)
    for keys in ({"align": align}, {"streams": STREAMS | {"fast": STREAMS["fast"] | {"align": align}}}):
        episodes = imported(tmp_path, format="csv", modalities=TWO, **({"streams": STREAMS} | keys))
        assert len(episodes) == 3
        np.testing.assert_allclose(episodes[0]["value_00"].to_numpy(), expected, rtol=1e-6)


def test_an_offset_moves_a_stream_in_time(tmp_path):
    three_trials(tmp_path, **FAST)
    streams = STREAMS | {"fast": STREAMS["fast"] | {"offset_s": -0.1}}
    (first, *_) = imported(tmp_path, format="csv", modalities=TWO, streams=streams)
    # The values at 0.1, 0.2 … become those at 0, 0.1 …, until the stream ends at 0.51.
    assert first["value_00"].to_list() == [10, 18, 18, 38, 38, 52]


def test_clocks_with_different_zeros_can_begin_at_zero(tmp_path):
    three_trials(tmp_path, t=[1.7e9 + time for time in FAST["t"]], x=FAST["x"])
    with pytest.raises(
        ValueError, match="trial_0: the streams are at no time all there: fast lasts from 1700000000 to"
    ):
        imported(tmp_path, format="csv", modalities=TWO, streams=STREAMS)
    streams = STREAMS | {"fast": STREAMS["fast"] | {"begin_at_zero": True}}
    (first, *_) = imported(tmp_path, format="csv", modalities=TWO, streams=streams)
    assert first["value_00"].to_list() == [0, 10, 18, 18, 38, 38, 52]


def test_a_gap_is_refused_or_splits_an_episode(tmp_path):
    times = [0.0, 0.1, 0.2, 0.5, 0.6]
    three_trials(tmp_path, t=times, x=[100 * time for time in times])
    keys = {"format": "csv", "modalities": TWO, "streams": STREAMS, "max_gap_s": 0.15}
    words = r"trial_0/fast.csv: line 4: 0.3 s pass until the next row of 'fast', which is more than max_gap_s, 0.15"
    with pytest.raises(ValueError, match=words):
        imported(tmp_path, **keys)
    assert not (tmp_path / "results").exists()
    episodes = imported(tmp_path, gaps="split", **keys)
    assert [episode["value_00"].to_list() for episode in episodes] == [[0, 10, 20], [50, 60]] * 3
    assert episodes[1]["time"].to_list() == [0.0, 0.1]
    relaxed = STREAMS | {"fast": STREAMS["fast"] | {"max_gap_s": 0.4}}
    episodes = imported(tmp_path, **(keys | {"streams": relaxed}))
    assert [len(episode) for episode in episodes] == [7, 7, 7]


def test_a_stream_without_longest_gap_keeps_its_last_value(tmp_path):
    three_trials(tmp_path, t=[0.0, 0.25], x=[1.0, 2.0])
    streams = STREAMS | {"fast": STREAMS["fast"] | {"max_gap_s": "unlimited"}}
    (first, *_) = imported(tmp_path, format="csv", modalities=TWO, streams=streams)
    assert first["value_00"].to_list() == [1, 1, 1, 2, 2, 2, 2]


def test_a_long_take_is_cut_into_episodes(tmp_path):
    times = np.arange(0, 10.01, 0.1)
    pl.DataFrame({"t": times, "u": times, "x": times}).write_csv(tmp_path / "log.csv")
    keys = {"format": "csv", "source": "log.csv", "streams": {"log": {"time": "t"}}, "max_episode_s": 3}
    episodes = imported(tmp_path, modalities={"setpoint": "log.u", "value": "log.x"}, **keys)
    assert [len(episode) for episode in episodes] == [30, 30, 30, 11]
    np.testing.assert_allclose(pl.concat(episodes)["value_00"], times, rtol=1e-6)


# --- CSV, videos and pictures ---


def test_rows_of_several_streams_may_share_a_file(tmp_path):
    lines = ["time;force;angle"]
    for step in range(30):
        lines.append(f"{step / 10:.1f};{step},5;".replace(".", ","))
        lines.append(f"{step / 10 + 0.05:.2f};;{step}".replace(".", ","))
    (tmp_path / "log.csv").write_text("# a logger's comment\n" + "\n".join(lines) + "\n")
    stream = {"time": "time"}
    keys = {"format": "csv", "source": "log.csv", "max_episode_s": 1}
    modalities = {"setpoint": "a.force", "angle": "b.angle"}
    with pytest.raises(ValueError, match="log.csv: line 4: 'a.force' is nan; it must be a finite number; to leave out"):
        imported(tmp_path, streams={"a": stream, "b": stream}, modalities=modalities, **keys)
    skipping = stream | {"missing": "skip"}
    episodes = imported(tmp_path, streams={"a": skipping, "b": skipping}, modalities=modalities, **keys)
    # The first angle comes at 0.05 s, which is then the first sample.
    assert pl.concat(episodes)["setpoint_00"].to_list()[:3] == [0.5, 1.5, 2.5]
    assert pl.concat(episodes)["angle_00"].to_list()[:3] == [0, 1, 2]


@pytest.mark.parametrize(
    ("first", "second", "unit"),
    [
        ("2026-01-05 10:00:00.0", "2026-01-05 10:00:00.1", "s"),
        ("2026-01-05T10:00:00.000", "2026-01-05T10:00:00.100", "s"),
        ("1700000000000000000", "1700000000100000000", "ns"),
        ("1700000000000", "1700000000100", "ms"),
    ],
)
def test_times_may_be_dates_or_in_another_unit(tmp_path, first, second, unit):
    for trial in range(3):
        (tmp_path / f"{trial}.csv").write_text(f"t,u,x\n{first},0,1\n{second},0,2\n")
    streams = {"log": {"file": "*.csv", "time": "t", "time_unit": unit}}
    episodes = imported(tmp_path, format="csv", streams=streams, modalities={"setpoint": "log.u", "x": "log.x"})
    assert [episode["x_00"].to_list() for episode in episodes] == [[1, 2]] * 3


def test_a_column_tells_the_episodes_of_a_csv_file(tmp_path):
    rows = {"trial": ["a"] * 4 + ["b"] * 3 + ["c"] * 2, "t": [0.0, 0.1, 0.2, 0.3, 0.0, 0.1, 0.2, 0.0, 0.1]}
    pl.DataFrame(rows | {"u": range(9), "x": range(9)}).write_csv(tmp_path / "log.csv")
    keys = {"format": "csv", "source": "log.csv", "episode": "trial", "streams": {"log": {"time": "t"}}}
    episodes = imported(tmp_path, modalities={"setpoint": "log.u", "x": "log.x"}, **keys)
    assert [episode["x_00"].to_list() for episode in episodes] == [[0, 1, 2, 3], [4, 5, 6], [7, 8]]


def shade(value: int) -> np.ndarray:
    return np.full((48, 64, 3), value, np.uint8)


def shades(episode: pl.DataFrame) -> list[int]:
    """The mean value of each frame, rounded to a multiple of 10."""
    return [int(round(np.frombuffer(frame, np.uint8).mean(), -1)) for frame in episode["vision"]]


def write_video(path: Path, values: range, rate: int = 10) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=rate)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for value in values:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(shade(value), format="rgb24")))
        container.mux(stream.encode())


@pytest.mark.parametrize(
    ("camera", "suffix"),
    [
        ({"file": "*/camera.mp4"}, ".mp4"),
        ({"file": "*/camera.mkv"}, ".mkv"),
        ({"file": "*/camera.mp4", "rate_hz": 10}, ".mp4"),
        ({"file": "*/camera.mp4", "times": "*/slow.csv", "time": "t"}, ".mp4"),
        ({"file": "*/camera", "rate_hz": 10}, ""),
        ({"file": "*/camera", "times": "*/slow.csv", "time": "t"}, ""),
        ({"file": "*/camera", "time": "name", "time_unit": "ms"}, "named"),
    ],
)
def test_frames_come_from_videos_and_folders(tmp_path, camera, suffix):
    three_trials(tmp_path, **FAST)
    for trial in range(3):
        place = tmp_path / f"trial_{trial}"
        if suffix.startswith("."):
            write_video(place / f"camera{suffix}", range(0, 210, 30))
            continue
        (place / "camera").mkdir()
        for index in range(7):
            name = f"{index * 100}" if suffix == "named" else f"frame_{index + 5}"
            Image.fromarray(shade(index * 30)).save(place / "camera" / f"{name}.png")
    episodes = imported(
        tmp_path, format="csv", streams=STREAMS | {"camera": camera}, modalities=TWO | {"vision": "camera"}
    )
    assert [shades(episode) for episode in episodes] == [[0, 30, 60, 90, 120, 150, 180]] * 3


def test_a_video_at_half_the_rate_shows_each_frame_twice(tmp_path):
    times = np.arange(50) / 10
    pl.DataFrame({"t": times, "u": times}).write_csv(tmp_path / "log.csv")
    write_video(tmp_path / "camera.mp4", range(0, 250, 10), rate=5)
    streams = {"log": {"file": "log.csv", "time": "t"}, "camera": {"file": "camera.mp4"}}
    modalities = {"setpoint": "log.u", "vision": "camera"}
    # Episodes of 1.5 s begin with the frame that the one before ended with.
    episodes = imported(tmp_path, format="csv", streams=streams, modalities=modalities, max_episode_s=1.5)
    found = [value for episode in episodes for value in shades(episode)]
    assert found == [10 * (index // 2) for index in range(49)]


def test_a_column_may_name_the_pictures(tmp_path):
    for value in range(3):
        Image.fromarray(shade(value * 50)).save(tmp_path / f"{value}.jpg")
    for trial in range(3):
        rows = {"t": [0.0, 0.1, 0.2], "u": [0.0] * 3, "picture": ["2.jpg", "0.jpg", "1.jpg"]}
        pl.DataFrame(rows).write_csv(tmp_path / f"log_{trial}.csv")
    streams = {"log": {"file": "log_*.csv", "time": "t"}}
    modalities = {"setpoint": "log.u", "vision": "log.picture"}
    episodes = imported(tmp_path, format="csv", streams=streams, modalities=modalities)
    assert [shades(episode) for episode in episodes] == [[100, 0, 50]] * 3


# --- arrays ---

ARRAYS = {"data": "log", "rate_hz": 10}
OF_ARRAYS = {"setpoint": "log.u", "x": "log.x"}


def test_groups_of_an_hdf5_file_are_episodes(tmp_path):
    with h5py.File(tmp_path / "all.h5", "w") as file:
        for trial in (10, 9, 2):
            file[f"data/demo_{trial}/log/x"] = np.arange(4.0)[:, None] + trial
            file[f"data/demo_{trial}/log/u"] = np.zeros(4)
    keys = {"format": "hdf5", "source": "all.h5", "episodes": "data/demo_*", "streams": {"log": ARRAYS}}
    episodes = imported(tmp_path, modalities=OF_ARRAYS, **keys)
    assert [episode["x_00"][0] for episode in episodes] == [2, 9, 10]


def test_an_array_of_labels_tells_the_episodes(tmp_path):
    with h5py.File(tmp_path / "all.h5", "w") as file:
        file["log/x"], file["log/u"] = np.arange(9.0), np.zeros(9)
        file["which"] = [7, 7, 7, 3, 3, 3, 5, 5, 5]
    keys = {"format": "hdf5", "source": "all.h5", "episode": "which", "streams": {"log": ARRAYS}}
    episodes = imported(tmp_path, modalities=OF_ARRAYS, **keys)
    assert [episode["x_00"].to_list() for episode in episodes] == [[0, 1, 2], [3, 4, 5], [6, 7, 8]]


@pytest.mark.parametrize("kind", ["rows last", "channels first", "gray", "jpeg"])
def test_pictures_in_an_hdf5_file_may_be(tmp_path, kind):
    frames = np.stack([shade(value) for value in (0, 50, 100)])
    for trial in range(3):
        with h5py.File(tmp_path / f"{trial}.h5", "w") as file:
            file["u"] = np.zeros((3, 1))
            if kind == "jpeg":
                files = file.create_dataset("frames", (3,), dtype=h5py.vlen_dtype(np.uint8))
                for index, frame in enumerate(frames):
                    Image.fromarray(frame).save(tmp_path / "frame.jpg")
                    files[index] = np.frombuffer((tmp_path / "frame.jpg").read_bytes(), np.uint8)
            else:
                moved = {"rows last": frames, "channels first": frames.transpose(0, 3, 1, 2), "gray": frames[..., 0]}
                file["frames"] = moved[kind]
    streams = {"u": {"data": "u", "rate_hz": 10}, "camera": {"data": "frames", "rate_hz": 10}}
    episodes = imported(tmp_path, format="hdf5", streams=streams, modalities={"setpoint": "u", "vision": "camera"})
    assert [shades(episode) for episode in episodes] == [[0, 50, 100]] * 3


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("store", ["folder", "zip"])
def test_zarr_stores_of_a_version_are_read(tmp_path, version, store):
    path = tmp_path / ("all.zarr.zip" if store == "zip" else "all.zarr")
    target = zarr.storage.ZipStore(path, mode="w") if store == "zip" else path
    root = zarr.create_group(store=target, zarr_format=version)
    for name, values in (("log/x", np.arange(9.0)), ("log/u", np.zeros(9)), ("meta/ends", np.array([3, 6, 9]))):
        root.create_array(name, data=values, chunks=(2,))
    if store == "zip":
        target.close()
    keys = {"format": "zarr", "source": path.name, "episode_ends": "meta/ends", "streams": {"log": ARRAYS}}
    episodes = imported(tmp_path, modalities=OF_ARRAYS, **keys)
    assert [episode["x_00"].to_list() for episode in episodes] == [[0, 1, 2], [3, 4, 5], [6, 7, 8]]


def test_an_array_of_structures_in_matlab_has_the_episodes(tmp_path):
    trials = np.zeros((1, 3), dtype=[("log", object)])
    for trial in range(3):
        # MATLAB's vectors are often rows.
        trials[0, trial]["log"] = {"x": np.arange(4.0)[None] + 10 * trial, "u": np.zeros((1, 4))}
    scipy.io.savemat(tmp_path / "all.mat", {"trials": trials, "note": "text"})
    keys = {"format": "matlab", "source": "all.mat", "episodes": "trials/*", "streams": {"log": ARRAYS}}
    episodes = imported(tmp_path, modalities=OF_ARRAYS, **keys)
    assert [episode["x_00"].to_list() for episode in episodes] == [[0, 1, 2, 3], [10, 11, 12, 13], [20, 21, 22, 23]]


def test_matlab_files_of_version_7_3_are_read(tmp_path):
    """MATLAB 7.3 writes HDF5 with 512 bytes before it, axes in the opposite order, and structures by reference."""
    with h5py.File(tmp_path / "all.mat", "w", userblock_size=512) as file:
        references = []
        for trial in range(3):
            log = file.create_group(f"#refs#/{trial}")
            # 4 rows and 2 columns in MATLAB.
            log["x"] = np.stack([np.arange(4.0) + 10 * trial, np.arange(4.0)])
            log["u"] = np.zeros((1, 4))
            references.append([log.ref])
        file["trials/log"] = np.array(references, dtype=h5py.ref_dtype)
    keys = {"format": "matlab", "source": "all.mat", "episodes": "trials/*", "streams": {"log": ARRAYS}}
    episodes = imported(tmp_path, modalities=OF_ARRAYS, **keys)
    assert [episode["x_00"].to_list() for episode in episodes] == [[0, 1, 2, 3], [10, 11, 12, 13], [20, 21, 22, 23]]
    assert episodes[2]["x_01"].to_list() == [0, 1, 2, 3]


# --- bags ---


def write_bag(path: Path, messages: list[tuple[str, str, int, object]], storage=StoragePlugin.SQLITE3) -> None:
    """Writes messages: topic, type, when they were received (ns), and the message."""
    with Writer(path, version=9, storage_plugin=storage) as writer:
        connections = {}
        for topic, kind, received, message in sorted(messages, key=lambda each: each[2]):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=ROS2)
            writer.write(connections[topic], received, ROS2.serialize_cdr(message, kind))


def number(topic: str, received: int, value: float) -> tuple[str, str, int, object]:
    return topic, "std_msgs/msg/Float64", received, ROS2.types["std_msgs/msg/Float64"](value)


def header(time: int) -> object:
    stamp = ROS2.types["builtin_interfaces/msg/Time"](time // 10**9, time % 10**9)
    return ROS2.types["std_msgs/msg/Header"](stamp, "")


TENTH = 10**8
BAG = {"u": {"topic": "/u"}, "x": {"topic": "/x"}}
OF_BAG = {"setpoint": "u", "x": "x"}


@pytest.mark.parametrize("storage", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
@pytest.mark.parametrize("part", ["folder", "file"])
def test_bags_of_a_storage_are_read(tmp_path, storage, part):
    (tmp_path / "bags").mkdir()
    for trial in range(3):
        values = [number(topic, 10**18 + step * TENTH, trial + step) for step in range(4) for topic in ("/u", "/x")]
        write_bag(tmp_path / f"bag_{trial}", values, storage)
        (file,) = [path for path in (tmp_path / f"bag_{trial}").iterdir() if path.suffix in (".db3", ".mcap")]
        os.link(file, tmp_path / "bags" / f"{trial}{file.suffix}")
    source = "bag_*" if part == "folder" else "bags"
    episodes = imported(tmp_path, format="ros2", source=source, streams=BAG, modalities=OF_BAG)
    assert [episode["x_00"].to_list() for episode in episodes] == [[0, 1, 2, 3], [1, 2, 3, 4], [2, 3, 4, 5]]


def test_bags_of_ros_1_are_read(tmp_path):
    store = get_typestore(Stores.ROS1_NOETIC)
    for trial in range(3):
        with Writer1(tmp_path / f"{trial}.bag") as writer:
            topics = {
                name: writer.add_connection(name, "std_msgs/msg/Float64", typestore=store) for name in ("/u", "/x")
            }
            for step in range(4):
                for connection in topics.values():
                    message = store.types["std_msgs/msg/Float64"](float(step))
                    data = store.serialize_ros1(message, "std_msgs/msg/Float64")
                    writer.write(connection, 10**18 + step * TENTH, data)
    episodes = imported(tmp_path, format="ros2", streams=BAG, modalities=OF_BAG)
    assert [episode["x_00"].to_list() for episode in episodes] == [[0, 1, 2, 3]] * 3


def test_a_topic_tells_the_episodes_of_a_bag(tmp_path):
    values = [number(topic, 10**18 + step * TENTH, step) for step in range(12) for topic in ("/u", "/x")]
    for step, trial in ((0, 1), (4, 2), (6, 2), (8, 3)):
        kind = "std_msgs/msg/Int32"
        values.append(("/trial", kind, 10**18 + step * TENTH - 1, ROS2.types[kind](trial)))
    write_bag(tmp_path / "bag", values)
    episodes = imported(tmp_path, format="ros2", source="bag", episode="/trial", streams=BAG, modalities=OF_BAG)
    assert [episode["x_00"].to_list() for episode in episodes] == [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9, 10, 11]]


@pytest.mark.parametrize("time", ["header", "received"])
def test_the_times_of_messages_are_those_of_the(tmp_path, time):
    kind = "geometry_msgs/msg/PointStamped"
    for trial in range(3):
        values = [number("/u", 10**18 + step * TENTH, 0) for step in range(5)]
        for step in range(5):
            point = ROS2.types["geometry_msgs/msg/Point"](float(step), 0.0, -1.0)
            stamped = ROS2.types[kind](header(10**18 + step * TENTH), point)
            # Each message arrives a sample late.
            values.append(("/x", kind, 10**18 + (step + 1) * TENTH, stamped))
        write_bag(tmp_path / f"bag_{trial}", values)
    streams = BAG | {"x": {"topic": "/x", "time": time}}
    modalities = {"setpoint": "u", "x": "x.point.x", "all": "x.point"}
    (first, *_) = imported(tmp_path, format="ros2", source="bag_*", streams=streams, modalities=modalities)
    assert first["x_00"].to_list() == ([0, 1, 2, 3, 4] if time == "header" else [0, 1, 2, 3])
    assert first["all_02"].unique().to_list() == [-1]


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "rgba8", "bgra8", "mono8"])
def test_images_of_a_bag_may_have_the_encoding(tmp_path, encoding):
    kind, channels = "sensor_msgs/msg/Image", {"a": 4, "8": 3}.get(encoding[3], 1)
    color = {"rgb8": (250, 0, 0), "bgr8": (0, 0, 250), "rgba8": (250, 0, 0, 9), "bgra8": (0, 0, 250, 9), "mono8": (90,)}
    for trial in range(3):
        values = [number("/u", 10**18 + step * TENTH, 0) for step in range(3)]
        for step in range(3):
            # Rows have two bytes more than their pixels.
            rows = np.full((6, 8 * channels + 2), 77, np.uint8)
            rows[:, :-2] = np.tile(color[encoding], 8)
            head = header(10**18 + step * TENTH)
            image = ROS2.types[kind](head, 6, 8, encoding, 0, rows.shape[1], rows.reshape(-1))
            values.append(("/x", kind, 10**18 + step * TENTH, image))
        write_bag(tmp_path / f"bag_{trial}", values)
    keys = {"format": "ros2", "source": "bag_*", "streams": BAG}
    (first, *_) = imported(tmp_path, modalities={"setpoint": "u", "vision": "x"}, **keys)
    frame = np.frombuffer(first["vision"][0], np.uint8).reshape(64, 64, 3)
    assert (frame == ([90, 90, 90] if encoding == "mono8" else [250, 0, 0])).all()


def test_a_missing_package_is_named_with_the_command(recording, harness, monkeypatch):
    for format, package in (("csv", "av"), ("hdf5", "h5py"), ("zarr", "zarr"), ("ros2", "rosbags")):
        with monkeypatch.context() as patch:
            for name in [name for name in sys.modules if name.split(".")[0] == package]:
                patch.setitem(sys.modules, name, None)
            with pytest.raises(ImportError, match=f"needs the package {package}: pip install {package}"):
                import_dataset(recording / f"{format}.yaml", harness.results, progress=False)
    assert not harness.results.exists()


def test_the_mapping_is_in_the_datasets_description(recording, harness):
    name = import_dataset(recording / "csv.yaml", harness.results, progress=False)
    description = json.loads((harness.results / "datasets" / name / "dataset.json").read_text())
    assert description["mapping"] == content(recording / "csv.yaml")


# --- inspection and the page ---


def command(*words: str | Path) -> subprocess.CompletedProcess:
    line = [sys.executable, "-m", "harness.importing", *map(str, words)]
    return subprocess.run(line, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("format", "listed"),
    [
        ("csv", r"\*/joints.csv: 800 rows\n    time  numbers: 0"),
        ("hdf5", r"trial_1.h5:\n  camera/frames  \[240, 96, 128, 3\]  uint8"),
        ("zarr", r"recording.zarr:\n  data/angles  \[1440, 4\]  float64"),
        ("matlab", r"trial_1.mat:\n  joints/time  \[800, 1\]  float64"),
        ("ros2", r"/joint_states  sensor_msgs/msg/JointState  800 messages, 100 Hz|    wrench.force  3 values"),
    ],
)
def test_inspecting_lists_a_format_and_writes_a_mapping(recording, tmp_path, format, listed):
    mapping = tmp_path / "first.yaml"
    answer = command("--inspect", recording / format, "--output", mapping)
    assert answer.returncode == 0, answer.stderr
    assert re.search(listed, answer.stdout), answer.stdout
    if format == "zarr":
        # The store has no times, so the user must say the rate.
        refused = command(mapping, "--results", tmp_path / "results")
        words = r"first.yaml:\d+:\d+: 'streams.\w+.rate_hz': expected a finite number .*, found nothing"
        assert refused.returncode == 1 and re.search(words, refused.stderr)
        mapping.write_text(mapping.read_text().replace("rate_hz: }", "rate_hz: 30}"))
    name = import_dataset(mapping, tmp_path / "results", progress=False)
    (first, *_) = read_episodes(tmp_path / "results", name)
    commands = example.simulate(0).commands[:, 0]
    assert np.isin(first["setpoint_00"].to_numpy(), commands.astype(np.float32)).all()
    joints = [name for name in first.columns if "angle" in name or "position" in name]
    assert "vision" in first.columns and len(joints) == 4
    again = command("--inspect", recording / format, "--output", mapping)
    assert again.returncode == 1 and "is there already, and was not changed; name another file" in again.stderr


def rows_of(columns: dict[str, float]) -> str:
    """A CSV file whose columns grow by these numbers."""
    rows = [",".join(f"{step * row:.3f}" for step in columns.values()) for row in range(30)]
    return "\n".join([",".join(columns), *rows])


SEVERAL_TIMES = {"a_stamp": 0.1, "a_x_0": 1, "a_x_1": 2, "b_stamp": 0.05, "b_y": 3}


@pytest.mark.parametrize(
    ("names", "columns", "streams", "modalities", "trial"),
    [
        (
            ["3D-Printed Part_001.csv", "3D-Printed Part_002.csv", "book_001.csv"],
            {"time": 0.1, "x": 1},
            {"log": {"file": "*.csv", "time": "time"}},
            {"log_x": {"from": "log.x", "unit": ""}},
            "{object}_{number:int}",
        ),
        (
            ["t1.txt", "t2.txt", "t3.txt"],
            {"Time [ms]": 100, "Force [N]": 1, "pad[0]": 2, "pad[1]": 3},
            {"log": {"file": "*.txt", "time": "Time [ms]", "time_unit": "ms"}},
            {"log_force": {"from": "log.Force [N]", "unit": "N"}, "log_pad": {"from": "log.pad*", "unit": ""}},
            None,
        ),
        (
            ["r1.csv", "r2.csv", "r3.csv"],
            SEVERAL_TIMES,
            {"a": {"file": "*.csv", "time": "a_stamp"}, "b": {"file": "*.csv", "time": "b_stamp"}},
            {"a_a_x": {"from": "a.a_x*", "unit": ""}, "b_b_y": {"from": "b.b_y", "unit": ""}},
            None,
        ),
    ],
)
def test_inspecting_guesses_trials_times_and_units_of_tables(tmp_path, names, columns, streams, modalities, trial):
    (tmp_path / "rec").mkdir()
    for name in names:
        (tmp_path / "rec" / name).write_text(rows_of(columns))
    answer = command("--inspect", tmp_path / "rec", "--output", tmp_path / "first.yaml")
    assert answer.returncode == 0 and "could not be guessed" not in answer.stdout, answer.stderr
    found = content(tmp_path / "first.yaml")
    assert (found["streams"], found.get("trial")) == (streams, trial)
    assert found["modalities"] == {"setpoint": "none"} | modalities
    assert len(read_episodes(tmp_path / "results", import_dataset(tmp_path / "first.yaml", tmp_path / "results"))) == 3


def test_a_pattern_does_not_mean_the_times_of_a_stream(tmp_path):
    for trial in range(3):
        (tmp_path / f"{trial}.csv").write_text(rows_of(SEVERAL_TIMES))
    streams = {"a": {"file": "*.csv", "time": "a_stamp"}, "b": {"file": "*.csv", "time": "b_stamp"}}
    (first, *_) = imported(tmp_path, format="csv", streams=streams, modalities={"setpoint": "none", "all": "a.*"})
    assert [name for name in first.columns if name.startswith("all_")] == ["all_a_x_0", "all_a_x_1", "all_b_y"]


def test_inspecting_finds_parquet_and_lerobot_columns(tmp_path):
    rows = {"trial": [0, 0], "time": [0.0, 0.1], "command": [[1.0], [2.0]], "angle": [1.0, 2.0]}
    pl.DataFrame(rows).write_parquet(tmp_path / "lab.parquet")
    answer = command("--inspect", tmp_path / "lab.parquet")
    assert answer.returncode == 0 and "command  List(Float64)" in answer.stdout, answer.stderr
    mapping = content(tmp_path / "lab.yaml")
    assert mapping["episode"] == "trial" and mapping["order"] == "time"
    assert mapping["modalities"] == {"setpoint": "command", "angle": {"from": "angle", "unit": ""}}
    (tmp_path / "robot/meta").mkdir(parents=True)
    camera = {"shape": [9, 9, 3], "dtype": "video"}
    features = {"action": {"shape": [3], "dtype": "float32"}, "observation.images.top": camera}
    (tmp_path / "robot/meta/info.json").write_text(json.dumps({"fps": 30, "features": features}))
    answer = command("--inspect", tmp_path / "robot")
    assert answer.returncode == 0 and "action  [3]  float32" in answer.stdout, answer.stderr
    modalities = content(tmp_path / "robot.yaml")["modalities"]
    assert modalities == {"setpoint": "action", "vision": "observation.images.top"}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "name a mapping, or a recording with --inspect FILE"),
        (["lab.yaml", "--inspect", "x"], "name a mapping, or a recording with --inspect FILE"),
        (["lab.yaml", "--output", "x"], "--output needs --inspect FILE"),
        (["--inspect", "/nowhere.h5"], "error: /nowhere.h5 is not there"),
        (["--inspect", "/dev/null"], "error: /dev/null: holds no recording: no .csv, .h5"),
    ],
)
def test_the_command_refuses_with_one_message(words, message):
    answer = command(*words)
    assert answer.returncode in (1, 2) and message in answer.stderr and "Traceback" not in answer.stderr


def test_a_dataset_says_what_its_page_shows_of_the_import(recording, harness):
    name = import_dataset(recording / "ros2.yaml", harness.results, progress=False)
    report = json.loads((harness.results / "datasets" / name / "dataset.json").read_text())["import"]
    assert set(report["sources"]) == {"setpoint", "angles", "force", "vision"} and report["cleaned"] == []
    head, *rows = report["streams"]
    assert head[0] == "stream" and len(rows) == 4 and all(len(row) == len(head) for row in rows)


def test_the_commands_of_the_tutorial_work_as_it_shows_them(tmp_path):
    """Those that need only this package. The page's mapping and its table of streams are compared as well."""
    page = (ROOT / "docs/recordings.md").read_text()
    blocks = re.findall(r"```(\w+)\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    (mapping,) = [text for language, text in blocks if language == "yaml" and "streams:" in text]
    (tmp_path / "press.yaml").write_text(mapping)
    commands = [text for language, text in blocks if language == "sh" and re.search(r"harness import|example", text)]
    assert len(commands) == 4
    functions = f"""
    python() {{ "{sys.executable}" "$@"; }}
    harness() {{ "{sys.executable}" -m harness.importing "${{@:2}}"; }}
    """
    script = f"set -e\n{functions}\n" + "\n".join(commands)
    answer = subprocess.run(["bash", "-c", script], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert answer.returncode == 0, answer.stderr
    (table,) = [text for language, text in blocks if language == "text"]
    assert table in answer.stdout, answer.stdout
    (name,) = re.findall(r"scenarios: (press-\w+)", page)
    datasets = [path.name for path in (tmp_path / "results/datasets").iterdir()]
    assert len(datasets) == 6 and name in datasets
