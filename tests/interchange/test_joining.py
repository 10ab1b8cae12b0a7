"""Recordings whose files order their elements differently, that miss rows, or whose paths have special letters."""

import json
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import types
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import av
import h5py
import numpy as np
import polars as pl
import pytest
import scipy.io
import zarr
from PIL import Image
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from harness.importing import import_dataset, ros2

ROS2 = get_typestore(Stores.ROS2_HUMBLE)
TENTH = 10**8
START = 17 * 10**17


def imported(folder: Path, **keys: Any) -> list[pl.DataFrame]:
    """Writes a mapping, imports it, and returns the episodes."""
    path, results = folder / "lab.yaml", folder / "results"
    path.write_text(json.dumps({"name": "lab", "source": "rec", "sample_rate_hz": 10} | keys))
    name = import_dataset(path, results, progress=False)
    files = sorted((results / "datasets" / name).iterdir())
    return [pl.read_parquet(file.read_bytes()) for file in files if file.suffix == ".parquet"]


def is_refused(folder: Path, words: str, **keys: Any) -> None:
    with pytest.raises(ValueError, match=words) as error:
        imported(folder, **keys)
    assert "\n" not in str(error.value) and not (folder / "results").exists()


# --- elements by name ---


def write_table(path: Path, columns: dict[str, Any]) -> None:
    """Writes columns to a file of the format that its name tells."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".csv":
        path.write_bytes(pl.DataFrame(columns).write_csv().encode())
    elif path.suffix == ".h5":
        with h5py.File(path, "w", track_order=True) as file:
            for name, values in columns.items():
                file.create_dataset(f"s/{name}", data=values)
    elif path.suffix == ".zarr":
        root = zarr.create_group(path, overwrite=True)
        for name, values in columns.items():
            root.create_array(f"s/{name}", shape=(len(values),), dtype="f8")[:] = values
    else:
        scipy.io.savemat(path, {"s": columns}, oned_as="column")


def of_table(suffix: str) -> dict[str, Any]:
    """The keys of a mapping of such files, whose columns are `s.NAME`."""
    format = {".csv": "csv", ".h5": "hdf5", ".zarr": "zarr", ".mat": "matlab"}[suffix]
    stream = {"file": "*.csv", "time": "time"} if format == "csv" else {"data": "s", "time": "s/time"}
    return {"format": format, "max_gap_s": 1, "streams": {"s": stream}}


def trial(*names: str) -> dict[str, Any]:
    """Columns whose values are the digit in their names."""
    rows = np.arange(4.0)
    return {"time": rows / 10, "cmd": rows} | {name: np.full(4, float(name[-1])) for name in names}


@pytest.mark.parametrize("suffix", [".csv", ".h5", ".zarr", ".mat"])
def test_columns_are_joined_by_name_whatever_their_order_in_a_file(tmp_path, suffix):
    modalities = {"setpoint": "s.cmd", "a": "s.a_*"}
    for index, names in enumerate([("a_2", "a_1"), ("a_1", "a_2"), ("a_2", "a_1")]):
        write_table(tmp_path / f"rec/t{index}{suffix}", trial(*names))
    episodes = imported(tmp_path, modalities=modalities, **of_table(suffix))
    assert len({episode.select(pl.col("^a_.*$")).row(0) for episode in episodes}) == 1, "each file in its own order"
    shutil.rmtree(tmp_path / "results")
    for names, listed in ((("a_1", "a_3"), "s.a_1, s.a_3"), (("a_1",), "s.a_1"), (("a_1", "a_2", "a_3"), "s.a_3")):
        write_table(tmp_path / f"rec/t1{suffix}", trial(*names))
        words = rf"modalities.a: .*rec/t1{suffix}.* has the columns .*{listed}, and .*rec/t0{suffix}.* has .*s.a_"
        is_refused(tmp_path, words, modalities=modalities, **of_table(suffix))


def test_a_pattern_has_the_files_order_whatever_other_modalities_name(tmp_path):
    for index in range(3):
        write_table(tmp_path / f"rec/t{index}.csv", trial("a_1", "a_2"))
    modalities = {"setpoint": "s.a_2", "a": {"from": "s.a_*", "scale": [10, 100]}}
    first = imported(tmp_path, modalities=modalities, **of_table(".csv"))[0]
    assert first.select("setpoint_00", "a_1", "a_2").row(0) == (2, 10, 200)


Message = tuple[str, str, int, Any]
"""Topic, type, when it was received (ns), and the message."""


def joints(row: int, positions: dict[str, float], topic: str = "/joints") -> Message:
    at, kind, none = START + row * TENTH, "sensor_msgs/msg/JointState", np.zeros(0)
    stamp = ROS2.types["builtin_interfaces/msg/Time"](at // 10**9, at % 10**9)
    head = ROS2.types["std_msgs/msg/Header"](stamp, "")
    values = np.array(list(positions.values()), np.float64)
    return topic, kind, at, ROS2.types[kind](head, list(positions), values, none, none)


def command(row: int) -> Message:
    kind = "std_msgs/msg/Float64"
    return "/command", kind, START + row * TENTH, ROS2.types[kind](float(row))


def write_bag(path: Path, messages: list[Message], storage: StoragePlugin = StoragePlugin.SQLITE3) -> None:
    with Writer(path, version=9, storage_plugin=storage) as writer:
        connections: dict[str, Any] = {}
        for topic, kind, received, content in sorted(messages, key=lambda each: each[2]):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=ROS2)
            writer.write(connections[topic], received, ROS2.serialize_cdr(content, kind))


def write_bags(folder: Path, positions: Any, rows: int = 5) -> None:
    """Writes three bags. `positions` gets the bag and the row, and returns the positions by the joints' names."""
    shutil.rmtree(folder / "rec", ignore_errors=True)
    (folder / "rec").mkdir()
    for bag in range(3):
        messages = [joints(row, positions(bag, row)) for row in range(rows)]
        write_bag(folder / f"rec/b{bag}", [*messages, *map(command, range(rows))])


OF_BAGS = {"format": "ros2", "max_gap_s": 1, "streams": {"c": {"topic": "/command"}, "j": {"topic": "/joints"}}}


@pytest.mark.parametrize("which", ["bag", "message"])
def test_joints_are_joined_by_name_whatever_their_order_in_a(tmp_path, which):
    def positions(bag: int, row: int) -> dict[str, float]:
        swapped = bag == 1 if which == "bag" else row % 2 == 1
        return {"b": 2.0, "a": 1.0} if swapped else {"a": 1.0, "b": 2.0}

    write_bags(tmp_path, positions)
    modalities = {
        "setpoint": "c",
        "q": "j.position",
        "b": "j.position.b",
        "all": "j.position.*",
        "second": "j.position[1]",
    }
    for episode in imported(tmp_path, modalities=modalities, **OF_BAGS):
        columns = ["q_00", "q_01", "b_00", "all_position_a", "all_position_b", "second_00"]
        assert set(episode.select(columns).rows()) == {(1, 2, 2, 1, 2, 2)}


def test_bags_of_other_joints_are_refused(tmp_path):
    write_bags(tmp_path, lambda bag, _: {"a": 1.0, "c" if bag == 1 else "b": 2.0})
    words = (
        r"rec/b1: /joints: message 0: its names are \['a', 'c'\], and those of message 0 \['a', 'b'\] in .*rec/b0: "
        r"/joints; a stream must have the same in all messages; select joints by their names, such as j.position.a"
    )
    is_refused(tmp_path, words, modalities={"setpoint": "c", "q": "j.position"}, **OF_BAGS)
    words = "rec/b1: modalities.q: there is no column 'j.position.b'; the columns are .*j.position.a, j.position.c"
    is_refused(tmp_path, words, modalities={"setpoint": "c", "q": "j.position.b"}, **OF_BAGS)
    assert len(imported(tmp_path, modalities={"setpoint": "c", "q": "j.position.a"}, **OF_BAGS)) == 3


def test_named_elements_of_other_messages_must_have_one_order(tmp_path):
    kind = "sensor_msgs/msg/MultiDOFJointState"
    (tmp_path / "rec").mkdir()
    for bag in range(3):
        head = joints(0, {})[3].header
        names = ["b", "a"] if bag == 1 else ["a", "b"]
        vector, turn = ROS2.types["geometry_msgs/msg/Vector3"], ROS2.types["geometry_msgs/msg/Quaternion"]
        transforms = [ROS2.types["geometry_msgs/msg/Transform"](vector(1, 2, 3), turn(0, 0, 0, 1))] * 2
        message = ROS2.types[kind](head, names, transforms, [], [])
        write_bag(tmp_path / f"rec/b{bag}", [("/joints", kind, START, message), command(0), command(1)])
    words = r"rec/b1: /joints: message 0: its names are \['b', 'a'\], and those of message 0 \['a', 'b'\] in .*rec/b0"
    is_refused(tmp_path, words, modalities={"setpoint": "c", "q": "j.transforms"}, **OF_BAGS)


def test_two_publishers_of_a_topic_are_told_apart_by_their_joints(tmp_path):
    def positions(_: int, row: int) -> dict[str, float]:
        return {"arm_1": row, "arm_2": -row} if row % 2 == 0 else {"finger": 10.0 * row}

    write_bags(tmp_path, positions, rows=9)
    keys = OF_BAGS | {"modalities": {"setpoint": "c", "arm": ["j.position.arm_1", "j.position.arm_2"]}}
    keys["modalities"] = {"setpoint": "c", "q": ["j.position.arm_1", "j.position.arm_2"], "f": "hand.position.finger"}
    stream = {"topic": "/joints"}
    both = {"c": {"topic": "/command"}, "j": stream, "hand": stream}
    words = "b0: /joints: message 1, .*'j.position.arm_1' is nan; .*say 'missing: skip' in streams.j"
    is_refused(tmp_path, words, **(keys | {"streams": both}))
    skipping = both | {"j": stream | {"missing": "skip"}, "hand": stream | {"missing": "skip"}}
    for episode in imported(tmp_path, **(keys | {"streams": skipping})):
        first, second = episode["q_position_arm_1"].to_list(), episode["q_position_arm_2"].to_list()
        assert first == [0, 2, 2, 4, 4, 6, 6] and second[-1] == -6
        assert episode["f_00"].to_list() == [10, 10, 30, 30, 50, 50, 70]
    # The first mapping has a stream for each of them.
    first = tmp_path / "first.yaml"
    line = [sys.executable, "-m", "harness.importing", "--inspect", tmp_path / "rec", "--output", first]
    answer = subprocess.run(line, capture_output=True, text=True, check=False)
    assert "5 messages of the joints arm_1, arm_2\n" in answer.stdout, answer.stderr
    first.write_text(first.read_text().replace("setpoint: command ", "setpoint: command #"))
    name = import_dataset(first, tmp_path / "first", progress=False)
    columns = pl.read_parquet(tmp_path / f"first/datasets/{name}/episode_00000.parquet").columns
    assert [each for each in columns if "position" in each] == [
        "joints_position_position_arm_1",
        "joints_position_position_arm_2",
        "joints_2_position_00",
    ]


# --- the rows of Parquet files and LeRobot datasets ---

OF_ROWS = {"format": "parquet", "episode": "ep", "order": "t", "modalities": {"setpoint": "u", "x": "x"}}
DAY = datetime(2026, 1, 5, 10)


def rows(order: Any = None, **columns: Any) -> pl.DataFrame:
    """Three episodes of eight rows, in disorder, in which `x` counts the rows."""
    index = np.tile(np.arange(8), 3)
    values = {"ep": np.repeat([0, 1, 2], 8), "t": index if order is None else order, "u": index, "x": index}
    return pl.DataFrame(values | columns).sample(fraction=1, shuffle=True, seed=1)


def write_rows(folder: Path, table: pl.DataFrame) -> None:
    (folder / "rec").mkdir()
    # The second file has its columns in another order.
    table[:10].write_parquet(folder / "rec/a.parquet")
    table[10:].select(reversed(table.columns)).write_parquet(folder / "rec/b.parquet")


INDEX = np.tile(np.arange(8), 3)
JITTER = np.tile([0, 30, -30, 10, -40, 0, 40, 0], 3)
"""How late rows come, ms."""


@pytest.mark.parametrize(
    "order",
    {
        "a counter": INDEX,
        "a counter over all episodes": np.arange(24) + 7,
        "a counter as float": INDEX * 1.0,
        "s": INDEX / 10,
        "s since 1970": 1.7e9 + INDEX / 10 + JITTER / 1000,
        "ms": INDEX * 100 + JITTER,
        "us": INDEX * 100_000,
        "ns": START + INDEX * TENTH,
        "dates": [DAY + timedelta(milliseconds=int(each)) for each in INDEX * 100 + JITTER],
        "durations": [timedelta(milliseconds=int(each)) for each in INDEX * 100],
    }.items(),
    ids=lambda each: each[0],
)
def test_rows_of_parquet_files_are_sorted_by(tmp_path, order):
    write_rows(tmp_path, rows(order[1]))
    assert [episode["x_00"].to_list() for episode in imported(tmp_path, **OF_ROWS)] == [list(range(8))] * 3


@pytest.mark.parametrize("rate_hz", [700, 800, 1000])
def test_rows_of_parquet_files_have_rounded_times(tmp_path, rate_hz):
    write_rows(tmp_path, rows(np.rint(INDEX * 1000 / rate_hz).astype(int)))
    given = OF_ROWS | {"sample_rate_hz": rate_hz}
    assert [episode["x_00"].to_list() for episode in imported(tmp_path, **given)] == [list(range(8))] * 3


PLACE = r"rec/[ab].parquet: row \d+"
ROW_CASES: dict[str, tuple[pl.DataFrame, str]] = {
    "text": (rows(pl.Series(INDEX).cast(pl.String)), "order: 't' holds String, .*as text, 10 comes before 2; name"),
    "no order in a row": (
        rows(pl.Series([*INDEX[:-3], None, *INDEX[-2:]])),
        f"order: .*{PLACE}: 't' is null; every row needs a value of it",
    ),
    "NaN as order": (
        rows(np.where(INDEX == 5, np.nan, INDEX)),
        f"order: .*{PLACE}: 't' is nan; every row needs a value",
    ),
    "no episode in rows": (
        rows(ep=pl.Series([0] * 8 + [1] * 8 + [None] * 8)),
        f"episode: .*{PLACE}: 'ep' is null; every row needs a value of it",
    ),
    "a row twice": (
        rows(np.where(INDEX == 5, 4, INDEX)),
        f"order: two rows of an .* same 't': .*{PLACE} and .*{PLACE}",
    ),
    "missing rows": (
        rows().filter((pl.col("t") != 5) | (pl.col("ep") != 1)),
        f"order: .*{PLACE}: the row with t 6 of episode 1 comes 2 samples after the row before it at sample_rate_hz 10",
    ),
    "a gap in time": (
        rows(INDEX * 100 + np.where(INDEX > 4, 310, 0)),
        f"{PLACE}: the row with t 810 of episode 0 comes 4.1 samples after the row before it",
    ),
    "a rate of 20 Hz": (
        rows(INDEX * 50),
        "a.parquet: 't' grows by 50 from row to row, which does not fit sample_rate_hz 10: a counter grows by 1, and a "
        r"time by 0.1 s or 100 ms or 100000 us or 1e\+08 ns; write the rate of the rows, .* 20 if it is in ms",
    ),
    "dates at 20 Hz": (
        rows([DAY + timedelta(milliseconds=int(each)) for each in INDEX * 50]),
        "'t' grows by 50000 from .* and a time by 100000 us; write the rate of the rows, which is 20 if it is in us",
    ),
    "a rate of 9 Hz": (
        rows(INDEX / 9 * np.repeat([0.9, 1.2, 0.9], 8)),
        "the row with t .* of episode 1 is row 7, and comes 9.333 samples after row 0",
    ),
}


@pytest.mark.parametrize("case", ROW_CASES)
def test_parquet_files_are_refused_with(tmp_path, case):
    table, words = ROW_CASES[case]
    write_rows(tmp_path, table)
    is_refused(tmp_path, words, **OF_ROWS)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (pl.col("x").cast(pl.Int32), "rec/b.parquet: has 'x' as Int32, and .*rec/a.parquet has 'x' as Int64; save all"),
        (pl.lit(0).alias("y"), "rec/b.parquet: has 'y' as Int32, and .*rec/a.parquet has no column 'y'; save all"),
    ],
)
def test_parquet_files_of_other_columns_are_refused(tmp_path, change, words):
    write_rows(tmp_path, rows())
    second = tmp_path / "rec/b.parquet"
    pl.read_parquet(second).with_columns(change).write_parquet(second)
    is_refused(tmp_path, words, **OF_ROWS)


@pytest.fixture
def lerobot(monkeypatch) -> types.SimpleNamespace:
    """A stand-in for the package lerobot, which other tests use. It has `times`, and the `root` that it was given."""
    shape = (4, 4, 3)
    features = {"action": ("float32", [1]), "pads": ("float32", list(shape))}
    features |= {"camera": ("video", [6, 8, 3]), "photo": ("image", [6, 8, 3])}
    state = types.SimpleNamespace(times=INDEX / 10, root=None)

    class Dataset:
        fps = 10

        def __init__(self, *_: Any, root: Path, **__: Any):
            state.root = root
            episodes = [{"dataset_from_index": first, "dataset_to_index": first + 8} for first in (0, 8, 16)]
            kinds = {name: {"dtype": kind, "shape": size} for name, (kind, size) in features.items()}
            self.meta = types.SimpleNamespace(features=kinds, episodes=episodes)

        def __getitem__(self, row: int) -> dict[str, Any]:
            assert (state.root / "meta/info.json").exists()
            picture = np.zeros((3, 6, 8), np.uint8)
            picture[1] = 250
            tensors = {"action": np.ones(1), "pads": np.arange(48.0).reshape(shape) + row, "camera": picture}
            tensors["photo"] = (picture / 255).astype(np.float32)
            named = {name: types.SimpleNamespace(numpy=lambda value=value: value) for name, value in tensors.items()}
            return named | {"timestamp": state.times[row]}

    monkeypatch.setitem(sys.modules, "lerobot", types.ModuleType("lerobot"))
    monkeypatch.setitem(sys.modules, "lerobot.datasets", types.SimpleNamespace(LeRobotDataset=Dataset))
    return state


def imported_lerobot(folder: Path) -> pl.DataFrame:
    """Imports a dataset of the stand-in, and returns the first episode."""
    (folder / "rec/meta").mkdir(parents=True, exist_ok=True)
    (folder / "rec/meta/info.json").write_text("{}")
    modalities = {"setpoint": "action", "pads": "pads", "vision": "camera", "eye": {"from": "photo", "size": [6, 8]}}
    mapping = {"name": "lab", "source": "rec", "format": "lerobot", "modalities": modalities}
    (folder / "lab.yaml").write_text(json.dumps(mapping))
    name = import_dataset(folder / "lab.yaml", folder / "results", progress=False)
    return pl.read_parquet((folder / f"results/datasets/{name}/episode_00000.parquet").read_bytes())


def test_values_of_a_lerobot_dataset_keep_the_order_of_their_axes(tmp_path, lerobot):
    first = imported_lerobot(tmp_path)
    assert first.select(pl.col("^pads_.*$")).row(0) == tuple(range(1, 49))
    for image in ("vision", "eye"):
        assert (np.frombuffer(first[image][0], np.uint8).reshape(-1, 3) == [0, 250, 0]).all()


def test_a_gap_between_frames_of_a_lerobot_dataset_is_refused(tmp_path, lerobot):
    lerobot.times = lerobot.times + np.where(INDEX > 5, 0.31, 0)
    with pytest.raises(ValueError, match="rec, episode 0: frame 6: comes 4.1 samples after the row before it at 10"):
        imported_lerobot(tmp_path)
    assert not (tmp_path / "results").exists()


# --- paths ---

SPECIAL = "a b [1] * ? # %41 {x,y} é 漢"
DECOYS = ("a b 1 * ? # %41 {x,y} é 漢", "a b [1] * ? # A {x,y} é 漢", "a b [1] * ")
"""What a reader makes of SPECIAL that takes it as a pattern or as a part of a URI."""


def write_special(place: Path, kind: str, value: float) -> None:
    """Writes three recordings of one value."""
    place.mkdir(parents=True, exist_ok=True)
    x, u, times = np.full(5, float(value)), np.arange(5.0), np.arange(5) / 10
    for index in range(3):
        stem = f"t[{index}] %41#"
        if kind in ("db3", "mcap"):
            storage = StoragePlugin.SQLITE3 if kind == "db3" else StoragePlugin.MCAP
            plain = Path(tempfile.mkdtemp()) / f"t{index}"
            messages = [command(row) for row in range(5)] + [joints(row, {"x": value}) for row in range(5)]
            write_bag(plain, messages, storage)
            # The package that writes bags can't write to such paths.
            (plain / f"t{index}.{kind}").rename(plain / f"{stem}.{kind}")
            metadata = plain / "metadata.yaml"
            metadata.write_text(metadata.read_text().replace(f"t{index}.{kind}", f"{stem}.{kind}"))
            shutil.move(plain, place / stem)
            plain.parent.rmdir()
        elif kind == "parquet":
            table = pl.DataFrame({"ep": [index] * 5, "t": range(5), "u": u, "x": x})
            with open(place / f"{stem}.parquet", "wb") as file:
                table.write_parquet(file)
        else:
            write_table(place / f"{stem}.{kind}", {"time": times, "u": u, "x": x})
        if kind == "csv":
            with av.open(f"file:{place / stem}.mp4", "w") as container:
                stream = container.add_stream("mpeg4", rate=10)
                stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
                for _ in range(5):
                    picture = np.full((48, 64, 3), value * 10, np.uint8)
                    container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
                container.mux(stream.encode())


def of_special(kind: str) -> dict[str, Any]:
    if kind == "parquet":
        return OF_ROWS
    if kind in ("db3", "mcap"):
        return OF_BAGS | {"modalities": {"setpoint": "c", "x": "j.position"}}
    keys = of_table(f".{kind}") | {"modalities": {"setpoint": "s.u", "x": "s.x"}}
    if kind == "csv":
        files = "t[*] %41#"
        keys["streams"] = {"s": {"file": f"{files}.csv", "time": "time"}, "v": {"file": f"{files}.mp4"}}
        keys["modalities"] = keys["modalities"] | {"vision": "v"}
    return keys


@pytest.mark.parametrize("kind", ["csv", "parquet", "h5", "zarr", "mat", "db3", "mcap"])
def test_letters_of_a_path_stand_for_themselves(tmp_path, kind, monkeypatch):
    folder = tmp_path / SPECIAL
    write_special(folder / "rec:[x]", kind, 7)
    write_special(folder / "rec:x", kind, 9)
    for decoy in DECOYS:
        write_special(tmp_path / decoy / "rec:[x]", kind, 9)
    monkeypatch.chdir(folder)
    patterns = [] if kind in ("csv", "parquet") else ["rec:[x]/t[?]*"]
    for source in ["rec:[x]", str(folder / "rec:[x]"), *patterns]:
        for relative in (Path(), folder):
            episodes = imported(relative, source=source, **of_special(kind))
            assert len(episodes) == 3
            for episode in episodes:
                assert episode["x_00"].to_list() == [7] * 5
                assert kind != "csv" or abs(np.frombuffer(episode["vision"][0], np.uint8).mean() - 70) < 5


def test_lerobot_gets_no_letters_that_it_takes_for_a_pattern(tmp_path, lerobot):
    """Its libraries would read `rec 1` instead of `rec [1]`."""
    assert len(imported_lerobot(tmp_path)) == 7 and lerobot.root == tmp_path / "rec"
    assert len(imported_lerobot(tmp_path / SPECIAL)) == 7
    assert not {*str(lerobot.root)} & {*"*?[]:"} and not lerobot.root.exists()


def test_lerobot_itself_reads_the_dataset_that_the_path_names(tmp_path):
    pytest.importorskip("lerobot", reason="lerobot is not installed; it needs Python 3.12: make interchange")
    from lerobot.datasets import LeRobotDataset

    features = {
        "action": {"dtype": "float32", "shape": (1,), "names": None},
        "pads": {"dtype": "float32", "shape": (2, 4, 3), "names": None},
        "camera": {"dtype": "image", "shape": (6, 8, 3), "names": ["height", "width", "channels"]},
    }
    pads, green = np.arange(24, dtype=np.float32).reshape(2, 4, 3), np.zeros((6, 8, 3), np.uint8)
    green[..., 1] = 250
    for name, value in (("rec [1]", 0), ("rec 1", 100)):
        dataset = LeRobotDataset.create("local/made", 10, features, root=tmp_path / "made", use_videos=False)
        for _ in range(3):
            for _ in range(4):
                frame = {"action": np.ones(1, np.float32), "pads": pads + value, "camera": green, "task": "none"}
                dataset.add_frame(frame)
            dataset.save_episode()
        dataset.finalize()
        (tmp_path / "made").rename(tmp_path / name)
    mapping = {"name": "lab", "source": "rec [1]", "format": "lerobot"}
    mapping["modalities"] = {"setpoint": "action", "pads": "pads", "vision": "camera"}
    (tmp_path / "lab.yaml").write_text(json.dumps(mapping))
    name = import_dataset(tmp_path / "lab.yaml", tmp_path / "results", progress=False)
    first = pl.read_parquet(tmp_path / f"results/datasets/{name}/episode_00000.parquet")
    assert first.select(pl.col("^pads_.*$")).row(0) == tuple(range(24))
    assert (np.frombuffer(first["vision"][0], np.uint8).reshape(-1, 3) == [0, 250, 0]).all()


def test_the_command_that_inspecting_proposes_can_be_pasted(tmp_path):
    source = tmp_path / SPECIAL / "it's"
    write_table(source / "t1.csv", trial("a_1"))
    line = [sys.executable, "-m", "harness.importing", "--inspect", source]
    answer = subprocess.run(line, capture_output=True, text=True, check=False)
    (proposed,) = re.findall("`harness import (.*)`", answer.stdout)
    assert shlex.split(proposed) == [f"{source}.yaml"] and Path(f"{source}.yaml").exists()


# --- the place of a fault ---


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("time,cmd,a_1\n0,1\n0.1,1,3\n", "rec/t1.csv: line 2: has 2 values, and the header 3$"),
        ('time,cmd,a_1,label\n0,1,2,"a\nb"\n0.1,1,3,"c\n0.2,1,3,d\n', "t1.csv: line 4: a quotation mark is not closed"),
        ("time,cmd,b_1\n0,1,2\n0.1,1,2\n", "rec/t1.csv: modalities.a: there is no column 's.a_1'; the columns are"),
        (f"time,cmd,a_1,{'x' * 200_000}\n0,1,2,3\n", "rec/t1.csv: line 1: can't be read: field larger than"),
    ],
)
def test_a_fault_in_a_csv_file_is_told_with_the_file(tmp_path, text, words):
    for index in range(3):
        write_table(tmp_path / f"rec/t{index}.csv", trial("a_1"))
    (tmp_path / "rec/t1.csv").write_bytes(text.encode())
    is_refused(tmp_path, words, modalities={"setpoint": "s.cmd", "a": "s.a_1"}, **of_table(".csv"))


def test_a_comment_above_the_header_may_have_a_quotation_mark(tmp_path):
    lines = ['# a pad of 5"', "time,cmd,a_1,label", *(f'{row / 10},1,{row},"a"' for row in range(5))]
    for index in range(3):
        (tmp_path / "rec").mkdir(exist_ok=True)
        (tmp_path / f"rec/t{index}.csv").write_text("\n".join(lines))
    for episode in imported(tmp_path, modalities={"setpoint": "s.cmd", "a": "s.a_1"}, **of_table(".csv")):
        assert episode["a_00"].to_list() == [0, 1, 2, 3, 4]


def test_a_counted_image_that_is_missing_is_refused_with_a_rate(tmp_path):
    keys = of_table(".csv") | {"modalities": {"setpoint": "s.cmd", "vision": "v"}}
    keys["streams"] = {"s": {"file": "*/log.csv", "time": "time"}, "v": {"file": "*/camera", "rate_hz": 10}}
    for index in range(3):
        write_table(tmp_path / f"rec/t{index}/log.csv", trial())
        (tmp_path / f"rec/t{index}/camera").mkdir()
        for frame in range(8, 12):
            Image.new("RGB", (8, 6)).save(tmp_path / f"rec/t{index}/camera/frame_{frame}_left.png")
    assert len(imported(tmp_path, **keys)) == 3
    shutil.rmtree(tmp_path / "results")
    (tmp_path / "rec/t1/camera/frame_10_left.png").unlink()
    words = "t1/camera/frame_9_left.png: the next image is frame_11_left.png; with rate_hz, no image may be missing"
    is_refused(tmp_path, words, **keys)


def test_a_bag_is_closed_before_its_messages_are_all_read(tmp_path):
    """As after an error. Otherwise, its database is locked, and Python prints a traceback."""
    write_bag(tmp_path / "bag", [command(row) for row in range(20)])
    with ros2.opened(tmp_path / "bag") as bag:
        messages = bag.messages(bag.connection("/command", "streams.c.topic"))
        assert next(messages)[1].data == 0
    assert list(messages) == []
