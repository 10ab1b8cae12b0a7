"""The keys of a mapping that clean a recording: each is imported right, and the report counts what it left out."""

import gzip
import json
from pathlib import Path

import h5py
import numpy as np
import polars as pl
import pytest
from PIL import Image
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation, Slerp

from harness.importing import MappingError, run_import
from harness.importing.inspection import first_mapping, inspect

ROS2 = get_typestore(Stores.ROS2_HUMBLE)
X = {"setpoint": "none", "x": "log.x"}
LOG = {"file": "*.csv", "time": "t"}


def imported(folder: Path, log: dict | None = None, **keys) -> tuple[list[pl.DataFrame], list[str]]:
    """Imports the recording in `folder/rec`. Returns its episodes, and what the report says was left out."""
    mapping = {"name": "lab", "source": "rec", "format": "csv", "sample_rate_hz": 10, "max_gap_s": 0.25}
    mapping |= {"streams": {"log": LOG | (log or {})}, "modalities": X} | keys
    (folder / "lab.yaml").write_text(json.dumps(mapping))
    done = run_import(folder / "lab.yaml", folder / "results", progress=False)
    description = json.loads((folder / "results/datasets" / done.name / "dataset.json").read_text())
    assert description["import"]["cleaned"] == done.cleaned
    paths = sorted((folder / "results/datasets" / done.name).glob("episode_*.parquet"))
    return [pl.read_parquet(path) for path in paths], done.cleaned


def written(folder: Path, text: str | bytes, name: str = "a.csv") -> Path:
    (folder / "rec").mkdir(exist_ok=True)
    (folder / "rec" / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    return folder


ROWS = "0.0,0\n0.1,1\n0.2,2\n0.3,3\n"
ONE = "rows of streams.log left out, without a value or a time: 1"
TEXTS = {
    "texts that are missing values": (
        "t,x\n0.0,0\n0.1,NA\n0.2,2\n0.3,-\n0.4,4\n",
        {"missing_values": ["NA", "-"], "missing": "skip"},
        [0, 0, 2, 2, 4],
        ONE.replace("1", "2"),
    ),
    "a number that is a missing value": (
        "t,x\n0.0,0\n0.1,-9999.0\n0.2,2\n",
        {"missing_values": [-9999], "missing": "skip"},
        [0, 0, 2],
        ONE,
    ),
    "blank lines": ("t,x\n0.0,0\n\n0.1,1\n0.2,2\n\n", {"missing": "skip"}, [0, 1, 2], ONE.replace("1", "2")),
    "an empty stamp": ("t,x\n0.0,0\n,9\n0.1,1\n0.2,2\n", {"missing": "skip"}, [0, 1, 2], ONE),
    "no header": (ROWS, {"header": "none", "time": "column_1"}, [0, 1, 2, 3], ""),
    "a header below other lines": (f"device 7\n1,2,3\nt,x\n{ROWS}", {"header": 3}, [0, 1, 2, 3], ""),
    "a header behind a mark": (f"# note\n# t,x\n{ROWS}", {"header": 2}, [0, 1, 2, 3], ""),
    "a row of units": (f"t,x\ns,N\n{ROWS}", {"units_row": True}, [0, 1, 2, 3], ""),
    "latin-1": (
        f"t,x,Größe\n{ROWS.replace(chr(10), ',°' + chr(10))}".encode("latin-1"),
        {"encoding": "latin-1"},
        [0, 1, 2, 3],
        "",
    ),
    "utf-16": (f"t,x\n{ROWS}".encode("utf-16"), {"encoding": "utf-16"}, [0, 1, 2, 3], ""),
    "white space": (f"  t   x\n{ROWS.replace(',', '    ')}", {}, [0, 1, 2, 3], ""),
    "seconds and nanoseconds": ("s,ns,x\n5,900000000,0\n6,0,1\n6,100000000,2\n", {"time": ["s", "ns"]}, [0, 1, 2], ""),
    "date and time of day": (
        "d,c,x\n2024-05-31,23:59:59.9,0\n2024-06-01,00:00:00,1\n",
        {"time": ["d", "c"]},
        [0, 1],
        "",
    ),
    "a date of America": ("t,x\n12/31/2023 23:59:59.9,0\n01/01/2024 00:00:00,1\n", {}, [0, 1], ""),
    "time of day": ("t,x\n09:59:59.9,0\n10:00:00,1\n", {}, [0, 1], ""),
    "booleans": ("t,x\n0.0,true\n0.1,False\n0.2,TRUE\n", {}, [1, 0, 1], ""),
}


@pytest.mark.parametrize("case", TEXTS)
def test_a_text_is_cleaned_of(tmp_path, case):
    text, log, expected, count = TEXTS[case]
    modalities = X | ({"x": "log.column_2"} if "header" in log and log["header"] == "none" else {})
    (episode,), cleaned = imported(written(tmp_path, text), log, modalities=modalities)
    assert episode[:, -1].to_list() == expected
    assert len(cleaned) == bool(count) and all(line.startswith(count) for line in cleaned)


def test_a_text_may_be_compressed_or_large(tmp_path, monkeypatch):
    monkeypatch.setattr("harness.importing.tables.LARGE_BYTES", 10)
    written(tmp_path, f"t,x\n{ROWS}", "b.csv")
    written(tmp_path, gzip.compress(f"t,x\n{ROWS}".encode()), "a.csv.gz")
    for name in ("a.csv.gz", "b.csv"):
        (episode,), _ = imported(tmp_path, {"file": name})
        assert episode["x_00"].to_list() == [0, 1, 2, 3]


def test_times_that_go_back_are_refused_sorted_or_split(tmp_path):
    written(tmp_path, "t,x\n0.0,0\n0.2,2\n0.1,1\n0.3,3\n")
    with pytest.raises(MappingError, match=r"a.csv: line 4: the time goes back from 0.2 to 0.1 s; 'steps_back: sort'"):
        imported(tmp_path)
    (episode,), cleaned = imported(tmp_path, steps_back="sort")
    assert episode["x_00"].to_list() == [0, 1, 2, 3]
    assert cleaned == ["rows of streams.log that are sorted, because their time goes back: 1"]
    written(tmp_path, "t,x\n0.0,0\n0.1,1\n0.2,2\n0.0,5\n0.1,6\n")
    episodes, cleaned = imported(tmp_path, steps_back="split")
    assert [each["x_00"].to_list() for each in episodes] == [[0, 1, 2], [5, 6]]
    assert [each["trial"][0] for each in episodes] == ["a, part 1", "a, part 2"]
    assert cleaned == ["places where the time goes back, at which episodes are split: 1"]


def test_a_part_of_each_trial_is_kept_as_a_table_says(tmp_path):
    for name in ("a.csv", "b.csv"):
        written(tmp_path, "t,x\n" + "".join(f"{row / 10},{row}\n" for row in range(10)), name)
    (tmp_path / "trials.csv").write_text("trial,start,late\na,0.2,0.1\nb,0.3,0\n")
    keys = {"episodes": "trials.csv", "from_s": "start", "to_s": 0.6}
    episodes, cleaned = imported(tmp_path, **keys)
    assert [each["x_00"].to_list() for each in episodes] == [[2, 3, 4, 5, 6], [3, 4, 5, 6]]
    assert cleaned == ["samples left out by from_s and to_s: 11, in 2 recordings"]
    streams = {"log": LOG, "late": LOG | {"offset_s": "late"}}
    episodes, _ = imported(tmp_path, episodes="trials.csv", streams=streams, modalities=X | {"y": "late.x"})
    assert [(each["y_00"] - each["x_00"]).to_list()[0] for each in episodes] == [-1, 0]
    with pytest.raises(MappingError, match="from_s: there is no label 'begin'; the labels are trial, start, late"):
        imported(tmp_path, **keys | {"from_s": "begin"})
    with pytest.raises(
        MappingError, match=r"a.csv: from_s 5 to to_s 6 leaves no sample; the streams are all there for"
    ):
        imported(tmp_path, from_s=5, to_s=6)


def test_bad_episodes_are_left_out_and_named(tmp_path):
    written(tmp_path, f"t,x\n{ROWS}", "a.csv")
    written(tmp_path, "t,y\n0.0,1\n", "b.csv")
    written(tmp_path, "t,x\n0.0,1\n0.1,oops\n", "c.csv")
    written(tmp_path, "t,x\n0.0,1\n9.0,2\n", "d.csv")
    written(tmp_path, "", "e.csv")
    written(tmp_path, f"t,x\n{ROWS}", "f.csv")
    with pytest.raises(MappingError, match="b: there is no column|b.csv: .*there is no column 'log.x'"):
        imported(tmp_path)
    episodes, cleaned = imported(tmp_path, bad_episodes="skip")
    assert [each["trial"][0] for each in episodes] == ["a", "f"]
    assert len(cleaned) == 4 and all(line.startswith("episode left out: ") for line in cleaned)
    for part in ("b.csv", "c.csv: line 3", "d.csv: line 2", "e.csv: line 1"):
        assert sum(part in line for line in cleaned) == 1, part
    for name in ("a.csv", "f.csv"):
        (tmp_path / "rec" / name).unlink()
    with pytest.raises(MappingError, match="b.csv: "):
        imported(tmp_path, bad_episodes="skip")


TURNS = [170.0, 178.0, -174.0, -166.0, -158.0]
"""An angle that grows by 8 degrees each 0.1 s, and passes 180."""


@pytest.mark.parametrize(("unit", "factor"), [("deg", 1.0), ("rad", np.pi / 180)])
def test_angles_have_circular_means_and_the_shorter_way(tmp_path, unit, factor):
    rows = "".join(f"{index / 10},{angle * factor}\n" for index, angle in enumerate(TURNS))
    written(tmp_path, f"t,x\n{rows}")
    modalities = {"setpoint": "none", "x": {"from": "log.x", "angle": unit}}

    def found(**keys):
        (episode,), _ = imported(tmp_path, modalities=modalities, **keys)
        return episode["x_00"].to_numpy() / factor

    np.testing.assert_allclose(
        found(sample_rate_hz=20, align="linear")[:6], [170, 174, 178, -178, -174, -170], rtol=1e-5
    )
    # The means of 178 and -174, and of -166 and -158.
    np.testing.assert_allclose(found(sample_rate_hz=5, align="mean"), [170, -178, -162], rtol=1e-5)


@pytest.mark.parametrize("order", ["xyzw", "wxyz"])
def test_quaternions_have_slerp_and_means_of_rotations(tmp_path, order):
    true = Rotation.from_rotvec(np.outer(np.arange(5) * 0.5, [0.0, 0.6, 0.8]))
    quaternions = true.as_quat() * np.array([1, -1, 1, -1, 1])[:, None]  # q and -q are the same rotation
    values = quaternions if order == "xyzw" else np.roll(quaternions, 1, axis=1)
    table = {"t": np.arange(5) / 10} | {f"q_{letter}": values[:, order.index(letter)] for letter in "xyzw"}
    (tmp_path / "rec").mkdir()
    pl.DataFrame(table).write_csv(tmp_path / "rec/a.csv")
    terms = [f"log.q_{letter}" for letter in order]
    modalities = {"setpoint": "none", "q": {"from": terms, "quaternion": order}}

    def found(**keys) -> np.ndarray:
        (episode,), _ = imported(tmp_path, modalities=modalities, **keys)
        return episode.select([f"q_{letter}" for letter in "xyzw"]).to_numpy()

    expected = Slerp(np.arange(5) / 10, true)(np.arange(9) / 20).as_quat()
    np.testing.assert_allclose(found(sample_rate_hz=20, align="linear"), expected, atol=1e-6)
    expected = np.stack([true[[1, 2]].mean().as_quat(), true[[3, 4]].mean().as_quat()])
    means = found(sample_rate_hz=5, align="mean")[1:]
    np.testing.assert_allclose(means, expected * np.sign(expected[:, 3:]), atol=1e-6)
    modalities["q"]["from"] = terms[:3]
    with pytest.raises(MappingError, match="modalities.q: a quaternion has 4 values, and .* has 3"):
        found()


def test_images_are_swapped_cropped_and_depths_have_a_range(tmp_path):
    (tmp_path / "rec/frames").mkdir(parents=True)
    colors = np.zeros((8, 8, 3), np.uint8)
    colors[2:6, 4:8] = [10, 20, 30]
    depth = np.full((8, 8), 500, np.uint16)
    depth[:, 4:] = 1500
    with h5py.File(tmp_path / "rec/a.h5", "w") as file:
        file["t"], file["x"] = np.arange(4) / 10, np.arange(4.0)
        file["color"], file["depth"] = np.stack([colors] * 4), np.stack([depth] * 4)
    streams = {name: {"data": name, "time": "t"} for name in ("x", "color", "depth")}
    image = {"size": [4, 4], "crop": [2, 4, 4, 4]}
    modalities = {"setpoint": "none", "x": "x", "swapped": {"from": "color", "order": "bgr", **image}}
    modalities |= {"plain": {"from": "color", **image}, "far": {"from": "depth", "size": [1, 2], "range": [500, 2500]}}
    (episode,), _ = imported(tmp_path, format="hdf5", streams=streams, modalities=modalities)
    assert {*episode["swapped"][0]} == {30, 20, 10} and episode["swapped"][0][:3] == bytes([30, 20, 10])
    assert episode["plain"][0] == bytes([10, 20, 30] * 16)
    assert episode["far"][0] == bytes([0] * 3 + [128] * 3)
    del modalities["far"]["range"]
    with pytest.raises(MappingError, match=r"a.h5: depth: row 0: is no picture but uint16; .* give a depth a range"):
        imported(tmp_path, format="hdf5", streams=streams, modalities=modalities)
    modalities["plain"]["crop"] = [5, 0, 4, 4]
    del modalities["far"]
    with pytest.raises(MappingError, match="color: row 0: has 8 x 8 pixels, and its crop ends at 9 x 4"):
        imported(tmp_path, format="hdf5", streams=streams, modalities=modalities)
    for row in range(4):
        Image.fromarray(depth).save(tmp_path / f"rec/frames/{row}.png")
    streams = {"far": {"file": "frames", "rate_hz": 10, "missing": "skip"}, "log": LOG}
    written(tmp_path, f"t,x\n{ROWS}")
    modalities = X | {"far": {"from": "far", "size": [1, 2], "range": [500, 2500]}}
    (episode,), _ = imported(tmp_path, streams=streams, modalities=modalities)
    assert episode["far"][0] == bytes([0] * 3 + [128] * 3)


def test_parquet_numpy_and_tables_of_hdf5_are_streams(tmp_path):
    (tmp_path / "rec").mkdir()
    records = np.zeros(4, [("t", "f8"), ("x", "f4"), ("pair", "f4", (2,))])
    records["t"], records["x"], records["pair"] = np.arange(4) / 10, np.arange(4), [[row, -row] for row in range(4)]
    pl.DataFrame({"t": records["t"], "x": records["x"], "pair": records["pair"]}).write_parquet(
        tmp_path / "rec/a.parquet"
    )
    np.savez(tmp_path / "rec/a.npz", t=records["t"], x=records["x"], pair=records["pair"], notes=np.array([None]))
    np.save(tmp_path / "rec/a.npy", records)
    with h5py.File(tmp_path / "rec/a.h5", "w") as file:
        file["log"] = records
    streams = {
        ("parquet", "a.parquet"): {"file": "*.parquet", "time": "t"},
        ("numpy", "a.npz"): {"data": "/", "time": "t"},
        ("numpy", "a.npy"): {"data": "array", "time": "array/t"},
        ("hdf5", "a.h5"): {"data": "log", "time": "log/t"},
    }
    modalities = X | {"pair": "log.pair"}
    for (format, file), stream in streams.items():
        source = "rec" if format == "parquet" else f"rec/{file}"
        (episode,), _ = imported(tmp_path, format=format, source=source, streams={"log": stream}, modalities=modalities)
        assert episode["x_00"].to_list() == [0, 1, 2, 3], file
        assert episode["pair_01"].to_list() == [0, -1, -2, -3], file


def test_the_first_axis_of_arrays_may_count_the_episodes(tmp_path):
    (tmp_path / "rec").mkdir()
    values = np.arange(24.0).reshape(2, 4, 3)
    values[1, 3] = np.nan  # the second episode is shorter
    np.savez(tmp_path / "rec/a.npz", time=np.arange(4) / 10, x=values)
    keys = {"format": "numpy", "streams": {"log": {"data": "x", "time": "time", "missing": "skip"}}}
    episodes, cleaned = imported(tmp_path, modalities={"setpoint": "none", "x": "log"}, episodes="first_axis", **keys)
    assert [each["x_01"].to_list() for each in episodes] == [[1, 4, 7, 10], [13, 16, 19]]
    assert cleaned == [ONE] and [each["trial"][0] for each in episodes] == ["a.npz, episode 0", "a.npz, episode 1"]
    keys["streams"]["log"]["data"] = "time"
    with pytest.raises(MappingError, match=r"a.npz: 'episodes: first_axis' needs an array of \[episodes, rows, …\]"):
        imported(tmp_path, modalities={"setpoint": "none", "x": "log"}, episodes="first_axis", **keys)


def test_attributes_of_files_and_groups_are_labels(tmp_path):
    (tmp_path / "rec").mkdir()
    with h5py.File(tmp_path / "rec/a.h5", "w") as file:
        file.attrs.update({"Robot": "hand 2", "_NCProperties": "x", "gains": [1.0, 2.0]})
        for name, mass in (("demo_0", 0.5), ("demo_1", 2)):
            file[f"{name}/t"], file[f"{name}/x"] = np.arange(3) / 10, np.arange(3.0)
            file[name].attrs["mass"] = mass
    keys = {"streams": {"log": {"data": "x", "time": "t"}}, "modalities": {"setpoint": "none", "x": "log"}}
    episodes, _ = imported(tmp_path, format="hdf5", episodes="demo_*", **keys)
    assert [each.select("trial", "robot", "mass").row(0) for each in episodes] == [
        ("a.h5: demo_0", "hand 2", 0.5),
        ("a.h5: demo_1", "hand 2", 2.0),
    ]
    assert "ncproperties" not in episodes[0].columns and "gains" not in episodes[0].columns
    np.savez(tmp_path / "rec/b.npz", t=np.arange(3) / 10, x=np.arange(3), object="book", mass=np.float32(0.25))
    (episode,), _ = imported(tmp_path, format="numpy", source="rec/b.npz", **keys)
    assert episode.select("object", "mass").row(0) == ("book", 0.25)


def test_several_publishers_of_a_topic_and_a_simulated_clock(tmp_path):
    Time, Header = ROS2.types["builtin_interfaces/msg/Time"], ROS2.types["std_msgs/msg/Header"]
    Stamped, Vector = ROS2.types["geometry_msgs/msg/Vector3Stamped"], ROS2.types["geometry_msgs/msg/Vector3"]
    (tmp_path / "rec").mkdir()
    with Writer(tmp_path / "rec/bag", version=8) as bag:
        topic = bag.add_connection("/imu", Stamped.__msgtype__, typestore=ROS2)
        for row in range(8):
            header = Header(Time(0, row // 2 * 10**8), ("left", "right")[row % 2])
            message = Stamped(header, Vector(row, row % 2, 0.0))
            bag.write(topic, 10**18 + row * 10**7, ROS2.serialize_cdr(message, Stamped.__msgtype__))
    streams = {"log": {"topic": "/imu", "frame_id": "right"}}
    modalities = {"setpoint": "none", "x": "log.vector.x", "side": "log.vector.y"}
    (episode,), _ = imported(tmp_path, format="ros2", streams=streams, modalities=modalities)
    assert episode["x_00"].to_list() == [1, 3, 5, 7] and episode["side_00"].to_list() == [1] * 4
    streams["log"]["frame_id"] = "top"
    with pytest.raises(MappingError, match="/imu: no message has the frame_id 'top'; there are left, right"):
        imported(tmp_path, format="ros2", streams=streams, modalities=modalities)


@pytest.mark.parametrize(
    ("name", "content", "keys", "expected"),
    [
        (
            "a.csv",
            "t,x\nms,N\n0,0\n100,NA\n200,2\n300,3\n",
            ["units_row: true", 'missing_values: ["NA"]', 'unit: "N"'],
            [0, 0, 2, 3],
        ),
        ("a.csv.gz", gzip.compress(f"t,x\n{ROWS}".encode()), ["file: a.csv.gz"], [0, 1, 2, 3]),
        ("a.txt", f"t   x\n{ROWS.replace(',', '   ')}", ["file: a.txt"], [0, 1, 2, 3]),
    ],
    ids=["units and missing values", "compressed", "white space"],
)
def test_the_first_mapping_of_an_odd_table_can_be_imported(tmp_path, name, content, keys, expected):
    source = written(tmp_path, content, name) / "rec"
    mapping = first_mapping(inspect(source), source, tmp_path)
    assert all(key in mapping for key in keys), mapping
    (tmp_path / "first.yaml").write_text(mapping)
    done = run_import(tmp_path / "first.yaml", tmp_path / "results", progress=False)
    (episode,) = (pl.read_parquet(path) for path in (tmp_path / "results/datasets" / done.name).glob("*.parquet"))
    assert episode[:, -1].to_list() == expected


def test_the_first_mapping_of_a_table_without_a_header_says_what_is_missing(tmp_path):
    source = written(tmp_path, "1,0\n2,1\n3,2\n") / "rec"
    assert "{file: a.csv, header: none, rate_hz: }" in first_mapping(inspect(source), source, tmp_path)
