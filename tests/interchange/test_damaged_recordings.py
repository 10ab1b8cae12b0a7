"""Damaged and odd recordings: each is an error with the file and the place, and leaves nothing behind."""

import copy
import io
import json
import re
import shutil
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import h5py
import numpy as np
import pytest
import scipy.io
import zarr
from PIL import Image
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from harness.importing import import_dataset

ROS2 = get_typestore(Stores.ROS2_HUMBLE)
ROWS = 20
"""Rows of each stream, at 10 Hz."""

Change = Callable[[Path, dict[str, Any]], None]
"""What is done to a recording's folder and to its mapping."""


def is_refused(folder: Path, mapping: dict[str, Any], words: str) -> None:
    path, results = folder / "lab.yaml", folder / "results"
    defaults = {"name": "lab", "sample_rate_hz": 10, "max_gap_s": 0.5}
    path.write_text(json.dumps(defaults | mapping, sort_keys=True))
    with pytest.raises((ValueError, FileNotFoundError)) as error:
        import_dataset(path, results, progress=False)
    assert re.search(words, str(error.value)), f"{words}\n{error.value}"
    assert "\n" not in str(error.value)
    assert not results.exists()


def edited(file: str, change: Callable[[bytes], bytes]) -> Change:
    """Changes the bytes of a file."""
    return lambda folder, _: (folder / file).write_bytes(change((folder / file).read_bytes())) and None


def line(number: int, text: str) -> Callable[[bytes], bytes]:
    """Replaces a line, counted from 1."""

    def change(data: bytes) -> bytes:
        lines = data.split(b"\n")
        lines[number - 1] = text.encode()
        return b"\n".join(lines)

    return change


def setting(*keys: str, to: Any) -> Change:
    """Changes a value of the mapping; None removes it."""

    def change(_: Path, mapping: dict[str, Any]) -> None:
        for key in keys[:-1]:
            mapping = mapping[key]
        mapping[keys[-1]] = to
        if to is None:
            del mapping[keys[-1]]

    return change


def both(*changes: Change) -> Change:
    def change(folder: Path, mapping: dict[str, Any]) -> None:
        for each in changes:
            each(folder, mapping)

    return change


def half(data: bytes) -> bytes:
    return data[: len(data) // 2]


def jpeg(value: int) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(np.full((24, 32, 3), value, np.uint8)).save(buffer, "JPEG")
    return buffer.getvalue()


# --- CSV ---


@pytest.fixture(scope="module")
def csv_trials(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("csv")
    for trial in (1, 2, 3):
        place = folder / "rec" / f"trial_{trial}"
        (place / "wrist").mkdir(parents=True)
        rows = [f"{row / 10},{row % 3},{row},{row % 4:05}.jpg" for row in range(ROWS)]
        (place / "log.csv").write_text("\n".join(["t,u,x,picture", *rows]) + "\n")
        for index in range(4):
            (place / f"{index:05}.jpg").write_bytes(jpeg(index * 50))
        for index in range(ROWS):
            (place / "wrist" / f"{index * 100}.jpg").write_bytes(jpeg(index * 10))
        with av.open(str(place / "camera.mp4"), "w") as container:
            stream = container.add_stream("libx264", rate=10)
            stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
            noise = np.random.default_rng(trial)
            for _ in range(ROWS):
                frame = noise.integers(0, 255, (48, 64, 3)).astype(np.uint8)
                container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
            container.mux(stream.encode())
    return folder


CSV = {
    "source": "rec",
    "format": "csv",
    "streams": {
        "log": {"file": "*/log.csv", "time": "t"},
        "camera": {"file": "*/camera.mp4"},
        "wrist": {"file": "*/wrist", "time": "name", "time_unit": "ms"},
    },
    "modalities": {
        "setpoint": "log.u",
        "x": "log.x",
        "vision": "camera",
        "wrist": {"from": "wrist", "size": [8, 8]},
        "hand": {"from": "log.picture", "size": [8, 8]},
    },
}
LOG, CAMERA = "rec/trial_2/log.csv", "rec/trial_2/camera.mp4"


def sound_only(folder: Path, _: dict[str, Any]) -> None:
    with av.open(str(folder / CAMERA), "w") as container:
        stream = container.add_stream("aac", rate=44100)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        frame.sample_rate = 44100
        container.mux(stream.encode(frame))
        container.mux(stream.encode())


def without_pictures(folder: Path, _: dict[str, Any]) -> None:
    for path in (folder / "rec/trial_2/wrist").iterdir():
        path.unlink()


def garbled_frames(data: bytes) -> bytes:
    start = data.index(b"mdat") + 3000
    return data[:start] + bytes(6000) + data[start + 6000 :]


CSV_CASES: dict[str, tuple[Change, str]] = {
    "a missing file": (lambda folder, _: (folder / LOG).unlink(), "streams.log.file: .*trial_2/log.csv is not there"),
    "a line that was cut": (edited(LOG, lambda data: data[: data.rindex(b",19,")]), "log.csv: line 21: 'log.x' is nan"),
    "an empty header": (edited(LOG, line(1, ",,,")), "trial_2/log.csv: line 1: there is no header with the names"),
    "no text": (edited(LOG, lambda _: bytes(range(128, 256)) * 9), "trial_2/log.csv: line 1: is no text in UTF-8"),
    "a letter of another encoding": (edited(LOG, line(7, "0.5,2,\u20ac,1.jpg")), "log.csv: line 7: 'x' is '€'"),
    "Latin-1": (
        edited(LOG, lambda data: data.replace(b",7,", b",\xb5,")),
        "trial_2/log.csv: line 9: is no text in UTF-8; name its encoding",
    ),
    "times in ns": (
        edited(LOG, lambda data: re.sub(rb"(?m)^(\d)\.(\d)", rb"1700000000\g<1>\g<2>0000000", data)),
        "trial_2/log.csv: line 2: 1700000000000000000 is no time; .* time_unit of ms, us or ns",
    ),
    "no video": (lambda folder, _: (folder / CAMERA).unlink(), "streams.camera.file: .*camera.mp4 is not there"),
    "an empty video": (edited(CAMERA, lambda _: b""), "trial_2/camera.mp4: can't be read: .*Invalid data"),
    "a video that is text": (edited(CAMERA, lambda _: b"no video" * 99), "camera.mp4: can't be read: .*Invalid data"),
    "a video that was cut": (edited(CAMERA, half), "trial_2/camera.mp4: can't be read: .*Invalid data"),
    "a video with garbled frames": (edited(CAMERA, garbled_frames), "trial_2/camera.mp4: frame \\d+, at .* s: "),
    "a video of sound": (sound_only, "trial_2/camera.mp4: holds no stream of pictures"),
    "frames without times": (
        both(setting("streams", "camera", "times", to="*/log.csv"), setting("streams", "camera", "time", to="u2")),
        "trial_1/log.csv: there is no column 'u2'; the columns are t, u, x, picture",
    ),
    "fewer times than frames": (
        both(
            setting("streams", "camera", to={"file": "*/camera.mp4", "times": "*/log.csv", "time": "t"}),
            edited(LOG, lambda data: b"\n".join(data.split(b"\n")[:-2])),
        ),
        "trial_2/log.csv: has 19 rows, and .*camera.mp4 has 20 frames; they must be equal",
    ),
    "an empty folder of images": (without_pictures, "rec/trial_2/wrist: holds no image: no file that ends in .bmp"),
    "an image that was cut": (edited("rec/trial_2/wrist/500.jpg", half), "wrist/500.jpg: is no picture, or damaged"),
    "an image that is text": (edited("rec/trial_2/wrist/500.jpg", lambda _: b"text"), "wrist/500.jpg: is no picture"),
    "an image without a time": (
        lambda folder, _: (folder / "rec/trial_2/wrist/500.jpg").rename(folder / "rec/trial_2/wrist/last.jpg"),
        "trial_2/wrist/last.jpg: the file is not called by a time",
    ),
    "a picture that is not there": (
        lambda folder, _: (folder / "rec/trial_2/00003.jpg").unlink(),
        "trial_2/log.csv: line 5: there is no picture .*trial_2/00003.jpg",
    ),
    "a column that a trial lacks": (
        edited("rec/trial_3/log.csv", line(1, "t,u,y,picture")),
        "rec/trial_3: modalities.x: there is no column 'log.x'; the columns are .*log.u, log.y",
    ),
    "numbers from a video": (
        both(setting("modalities", "x", to="camera"), setting("modalities", "vision", to=None)),
        "camera.mp4: 'camera' holds pictures, no numbers",
    ),
    "a folder of nothing": (
        lambda folder, _: (shutil.rmtree(folder / "rec"), (folder / "rec").mkdir()) and None,
        "source: .*rec holds no .*camera.mp4 and no .*/log.csv",
    ),
}


@pytest.mark.parametrize("case", CSV_CASES)
def test_a_csv_recording_is_refused_with(csv_trials, tmp_path, case):
    change, words = CSV_CASES[case]
    shutil.copytree(csv_trials / "rec", tmp_path / "rec")
    mapping = copy.deepcopy(CSV)
    change(tmp_path, mapping)
    is_refused(tmp_path, mapping, words)


# --- arrays ---

SUFFIX = {"hdf5": "h5", "zarr": "zarr", "matlab": "mat"}


def good_arrays() -> dict[str, Any]:
    times = np.arange(ROWS) / 10
    return {
        "log/t": times,
        "log/u": (times % 0.3)[:, None],
        "log/x": np.stack([times, -times], axis=1),
        "camera/t": times.copy(),
        "camera/frames": np.random.default_rng(0).integers(0, 255, (ROWS, 6, 8, 3)).astype(np.uint8),
    }


def write_arrays(path: Path, arrays: dict[str, Any]) -> None:
    """Writes arrays to a file of the format that its name tells."""
    if path.suffix == ".h5":
        with h5py.File(path, "w") as file:
            for name, value in arrays.items():
                chunked = (
                    {"chunks": True, "compression": "gzip"} if isinstance(value, np.ndarray) and value.size else {}
                )
                file.create_dataset(name, data=value, **chunked)
    elif path.suffix == ".zarr":
        root = zarr.create_group(path)
        for name, value in arrays.items():
            value = np.asarray(value)
            array = root.create_array(name, shape=value.shape, dtype=value.dtype, chunks=value.shape or "auto")
            array[...] = value
    else:
        variables: dict[str, Any] = {}
        for name, value in arrays.items():
            group, _, field = name.rpartition("/")
            value = np.moveaxis(value, 0, -1) if np.ndim(value) == 4 else value
            (variables.setdefault(group, {}) if group else variables)[field] = value
        scipy.io.savemat(path, variables, do_compression=True, oned_as="column")


def of_arrays(format: str) -> dict[str, Any]:
    return {
        "source": "rec",
        "format": format,
        "streams": {
            "u": {"data": "log/u", "time": "log/t"},
            "x": {"data": "log/x", "time": "log/t"},
            "camera": {"data": "camera/frames", "time": "camera/t"},
        },
        "modalities": {"setpoint": "u", "x": "x", "vision": "camera"},
    }


def put(name: str, value: Any) -> Callable[[dict[str, Any]], None]:
    return lambda arrays: arrays.__setitem__(name, value)


def put_at(name: str, place: Any, value: float) -> Callable[[dict[str, Any]], None]:
    return lambda arrays: arrays[name].__setitem__(place, value)


def drop(name: str) -> Callable[[dict[str, Any]], None]:
    return lambda arrays: arrays.pop(name) is None and None


def shortened(name: str, rows: int) -> Callable[[dict[str, Any]], None]:
    return lambda arrays: arrays.__setitem__(name, arrays[name][:rows])


def short(arrays: dict[str, Any]) -> None:
    for name in arrays:
        arrays[name] = arrays[name][:1]


def keep(_: dict[str, Any]) -> None:
    pass


ENDS = {"source": "rec/trial_2.SUFFIX", "episode_ends": "meta/ends"}
ARRAY_CASES: dict[str, tuple[Callable[[dict[str, Any]], None], dict[str, Any], str]] = {
    "data that is not there": (
        drop("log/x"),
        {},
        r"trial_2.\w+: there is no 'log/x' for streams.x.data; the arrays are",
    ),
    "times that are not there": (
        drop("log/t"),
        {},
        r"trial_2.\w+: there is no array 'log/t' for streams.u.time; the arr",
    ),
    "fewer rows than times": (
        shortened("log/x", 12),
        {},
        r"trial_2.\w+: log/x: has 12 rows, and its times log/t have 20",
    ),
    "fewer times than rows": (
        shortened("log/t", 12),
        {},
        r"trial_2.\w+: log/u: has 20 rows, and its times log/t have 12",
    ),
    "fewer frames than times": (
        shortened("camera/frames", 3),
        {},
        "camera/frames: has [38] rows, and its times camera/t",
    ),
    "a time that goes back": (
        put_at("log/t", 9, 0.1),
        {},
        r"trial_2.\w+: log/u: row 9: the time goes back from 0.8 to 0.1",
    ),
    "a time that is nan": (put_at("log/t", 9, np.nan), {}, r"trial_2.\w+: log/t: row 9: nan is no time"),
    "a time that is infinite": (put_at("log/t", 9, np.inf), {}, r"trial_2.\w+: log/t: row 9: inf is no time"),
    "times in ns": (
        put("log/t", 17 * 10**17 + np.arange(ROWS) * 10**8),
        {},
        r"log/t: row 0: 1700000000000000000 is no time; .*time_unit",
    ),
    "complex times": (
        put("log/t", np.arange(ROWS) * 1j),
        {},
        r"trial_2.\w+: (log/t: holds no numbers|.*no array 'log/t')",
    ),
    "a gap": (
        put_at("log/t", slice(9, None), np.arange(11) / 10 + 2),
        {},
        "row 8: 1.2 s pass until the next row of 'u'",
    ),
    "streams that do not overlap": (
        put("camera/t", np.arange(ROWS) / 10 + 9),
        {},
        r"trial_2.\w+: the streams are at no",
    ),
    "a nan": (put_at("log/x", (7, 1), np.nan), {}, r"trial_2.\w+: log/x: row 7: element 1 of 'x' is nan; it must be"),
    "an infinite value": (put_at("log/u", (7, 0), -np.inf), {}, r"trial_2.\w+: log/u: row 7: 'u' is -inf; it must be"),
    "complex values": (
        put("log/x", np.ones((ROWS, 2)) * 1j),
        {},
        r"trial_2.\w+: (log/x: 'x' holds no numbers, but complex|there is no 'log/x')",
    ),
    "another width": (
        put("log/x", np.zeros((ROWS, 3))),
        {},
        "modalities.x: has 3 values in episode 1 and 2 in the first",
    ),
    "frames of floats": (
        put("camera/frames", np.zeros((ROWS, 6, 8, 3))),
        {},
        r"trial_2.\w+: camera/frames: row 0: is no picture but float64; .* give a depth a range",
    ),
    "frames of 16 bits": (
        put("camera/frames", np.zeros((ROWS, 6, 8, 3), np.uint16)),
        {},
        "row 0: is no picture but uint16",
    ),
    "frames of five channels": (
        put("camera/frames", np.zeros((ROWS, 6, 8, 5), np.uint8)),
        {},
        "row 0: .*no picture.*5",
    ),
    "one row": (short, {}, "episode 1: it has 1 sample; it must have 2 or more"),
    "ends that are not there": (
        keep,
        ENDS,
        r"trial_2.\w+: there is no array 'meta/ends' for episode_ends; the arrays are",
    ),
    "ends that go back": (
        put("meta/ends", np.array([8, 4, 20])),
        ENDS,
        r"trial_2.\w+: meta/ends: must be growing row num",
    ),
    "ends that are not whole": (
        put("meta/ends", np.array([1.5, 9, 20])),
        ENDS,
        r"trial_2.\w+: meta/ends: must be growing",
    ),
    "ends beyond the rows": (put("meta/ends", np.array([8, 16, 24])), ENDS, "has 20 rows, and meta/ends divides 24"),
    "ends before the rows": (put("meta/ends", np.array([4, 8, 12])), ENDS, "has 20 rows, and meta/ends divides 12"),
    "labels of another length": (
        put("meta/label", np.repeat([1, 2, 3], 6)),
        {"source": "rec/trial_2.SUFFIX", "episode": "meta/label"},
        r"has 20 rows, and meta/label divides 18 rows into episodes",
    ),
    "no such groups": (
        keep,
        {"episodes": "data/demo_*"},
        r"trial_1.\w+: no group matches 'data/demo_\*' of the key 'epi",
    ),
    "a group instead of times": (
        keep,
        {"streams": {"u": {"data": "log/u", "time": "log"}}, "modalities": {"setpoint": "u", "x": "u"}},
        r"trial_1.\w+: there is no array 'log' for streams.u.time",
    ),
}


@pytest.fixture(scope="module", params=SUFFIX)
def array_trials(request, tmp_path_factory) -> tuple[str, Path]:
    folder = tmp_path_factory.mktemp(request.param)
    (folder / "rec").mkdir()
    for trial in (1, 2, 3):
        write_arrays(folder / "rec" / f"trial_{trial}.{SUFFIX[request.param]}", good_arrays())
    return request.param, folder


@pytest.mark.parametrize("case", ARRAY_CASES)
def test_a_recording_of_arrays_is_refused_with(array_trials, tmp_path, case):
    format, folder = array_trials
    shutil.copytree(folder / "rec", tmp_path / "rec")
    path = tmp_path / "rec" / f"trial_2.{SUFFIX[format]}"
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    change, keys, words = ARRAY_CASES[case]
    arrays = good_arrays()
    change(arrays)
    write_arrays(path, arrays)
    mapping = of_arrays(format) | keys
    mapping["source"] = mapping["source"].replace("SUFFIX", SUFFIX[format])
    is_refused(tmp_path, mapping, words)


H5, ZARR, MAT = "rec/trial_2.h5", "rec/trial_2.zarr", "rec/trial_2.mat"


def in_hdf5(change: Callable[[h5py.File], Any]) -> Change:
    def changed(folder: Path, _: dict[str, Any]) -> None:
        with h5py.File(folder / H5, "r+") as file:
            del file["log/x"]
            change(file)

    return changed


def garbled_chunk(folder: Path, _: dict[str, Any]) -> None:
    with h5py.File(folder / H5) as file:
        chunk = file["log/x"].id.get_chunk_info(0)
    data = bytearray((folder / H5).read_bytes())
    data[chunk.byte_offset : chunk.byte_offset + chunk.size] = bytes(chunk.size)
    (folder / H5).write_bytes(data)


def broken_jpegs(file: h5py.File) -> None:
    frames = [np.frombuffer(half(jpeg(9)), np.uint8)] * ROWS
    del file["camera/frames"]
    data = file.create_dataset("camera/frames", (ROWS,), dtype=h5py.vlen_dtype(np.uint8))
    for index, frame in enumerate(frames):
        data[index] = frame
    file["log/x"] = np.zeros((ROWS, 2))


def changed_zarr(name: str, change: Callable[[bytes], bytes] | None) -> Change:
    """Changes or removes a file of a store."""

    def changed(folder: Path, _: dict[str, Any]) -> None:
        path = folder / ZARR / name
        data = path.read_bytes()
        path.unlink()
        if change is not None:
            path.write_bytes(change(data))

    return changed


def emptied(folder: Path, _: dict[str, Any]) -> None:
    shutil.rmtree(folder / ZARR)
    (folder / ZARR).mkdir()


def replaced_zarr(data: bytes) -> Change:
    def changed(folder: Path, _: dict[str, Any]) -> None:
        shutil.rmtree(folder / ZARR)
        (folder / ZARR).write_bytes(data)

    return changed


def of_matlab(variables: dict[str, Any]) -> Change:
    """Writes a file with these variables. No modality is from the camera."""

    def changed(folder: Path, mapping: dict[str, Any]) -> None:
        del mapping["streams"]["camera"], mapping["modalities"]["vision"]
        scipy.io.savemat(folder / MAT, variables)

    return changed


def mat_73(change: Callable[[bytes], bytes]) -> Change:
    def changed(folder: Path, _: dict[str, Any]) -> None:
        with h5py.File(folder / MAT, "w", userblock_size=512) as file:
            for name, value in good_arrays().items():
                file[name] = value.T
        (folder / MAT).write_bytes(change((folder / MAT).read_bytes()))

    return changed


ONE_FORMAT_CASES: dict[str, dict[str, tuple[Change, str]]] = {
    "hdf5": {
        "text": (edited(H5, lambda _: b"no HDF5\n"), "trial_2.h5: can't be read: .*(signature|truncated)"),
        "an empty file": (edited(H5, lambda _: b""), "trial_2.h5: can't be read: "),
        "half a file": (edited(H5, half), "trial_2.h5: can't be read: .*truncated"),
        "a garbled head": (edited(H5, lambda data: data[:40] + bytes(60) + data[100:]), "trial_2.h5: "),
        "a garbled chunk": (garbled_chunk, "trial_2.h5: log/x: 'x', rows 0 to 19: can't be read: "),
        "words": (
            in_hdf5(lambda file: file.create_dataset("log/x", data=["a"] * ROWS)),
            "log/x: 'x' holds no numbers, but obj",
        ),
        "a table of fields": (
            in_hdf5(lambda file: file.create_dataset("log/x", (ROWS,), [("a", "f4"), ("b", "i4")])),
            "trial_2.h5: modalities.x: there is no column 'x'; the columns are .*x.a, x.b",
        ),
        "a single number": (
            in_hdf5(lambda file: file.create_dataset("log/x", data=3.0)),
            "log/x: has 0 rows, and its times",
        ),
        "no rows": (
            in_hdf5(lambda file: file.create_dataset("log/x", (0, 2))),
            "log/x: has 0 rows, and its times log/t",
        ),
        "no columns": (
            in_hdf5(lambda file: file.create_dataset("log/x", (ROWS, 0))),
            "episode 1: modalities.x: x gives no val",
        ),
        "nothing": (
            in_hdf5(lambda file: file.create_dataset("log/x", dtype="f4")),
            "there is no 'log/x' for streams.x.data",
        ),
        "a link to nowhere": (
            in_hdf5(lambda file: file.__setitem__("log/x", h5py.SoftLink("/gone"))),
            "trial_2.h5: there is no 'log/x' for streams.x.data",
        ),
        "a link to a file that is gone": (
            in_hdf5(lambda file: file.__setitem__("log/x", h5py.ExternalLink("gone.h5", "/x"))),
            "trial_2.h5: there is no 'log/x' for streams.x.data",
        ),
        "pictures that were cut": (
            in_hdf5(broken_jpegs),
            "trial_2.h5: camera/frames: row 0: is no picture, or damaged",
        ),
    },
    "zarr": {
        "an empty folder": (emptied, "trial_2.zarr: can't be read: "),
        "a file": (replaced_zarr(b"no ZIP"), "trial_2.zarr: can't be read: .*zip"),
        "a ZIP file that was cut": (replaced_zarr(b"PK\x03\x04" + bytes(99)), "trial_2.zarr: can't be read: .*zip"),
        "no metadata of an array": (
            changed_zarr("log/x/zarr.json", None),
            "trial_2.zarr: there is no 'log/x' for streams.x",
        ),
        "metadata that is no JSON": (changed_zarr("log/x/zarr.json", half), "trial_2.zarr: .*can't be read: "),
        "metadata of another kind": (
            changed_zarr("log/x/zarr.json", lambda _: b"[]"),
            "trial_2.zarr: .*can't be read: ",
        ),
        "a chunk that was cut": (
            changed_zarr("log/x/c/0/0", half),
            "trial_2.zarr: log/x: 'x', rows 0 to 19: can't be read: ",
        ),
        "an empty chunk": (
            changed_zarr("log/x/c/0/0", lambda _: b""),
            "trial_2.zarr: log/x: 'x', rows 0 to 19: can't be read",
        ),
        "a garbled chunk": (
            changed_zarr("log/x/c/0/0", lambda data: bytes(len(data))),
            "log/x: 'x', rows 0 to 19: can't be",
        ),
        "garbled times": (
            changed_zarr("log/t/c/0", lambda data: bytes(len(data))),
            "trial_2.zarr: log/t: can't be read: ",
        ),
        "garbled frames": (
            changed_zarr("camera/frames/c/0/0/0/0", half),
            "camera/frames: 'camera', rows 0 to 19: can't be",
        ),
        "a single array": (
            lambda folder, _: (shutil.rmtree(folder / ZARR), zarr.save_array(folder / ZARR, np.ones(3))) and None,
            "trial_2.zarr: is a single array; a recording is a group",
        ),
        "an unknown codec": (
            changed_zarr("log/x/zarr.json", lambda data: data.replace(b"zstd", b"zstx")),
            "trial_2.zarr: .*zstx",
        ),
    },
    "matlab": {
        "text": (edited(MAT, lambda _: b"no variables\n" * 40), "trial_2.mat: can't be read: "),
        "an empty file": (edited(MAT, lambda _: b""), "trial_2.mat: can't be read: "),
        "half a file": (edited(MAT, half), "trial_2.mat: can't be read: "),
        "a head alone": (
            edited(MAT, lambda data: data[:128]),
            "trial_2.mat: there is no 'camera/frames' for .*; there are no arr",
        ),
        "a garbled variable": (
            edited(MAT, lambda data: data[:300] + bytes(300) + data[600:]),
            "trial_2.mat: can't be read: ",
        ),
        "words": (
            of_matlab({"log": {"u": "word", "t": np.arange(4.0)}}),
            "trial_2.mat: there is no 'log/u' for streams.u",
        ),
        "a variable instead of a structure": (
            of_matlab({"log": np.zeros(9)}),
            "there is no 'log/u' for .*the arrays are log",
        ),
        "an empty matrix": (
            of_matlab({"log": {"u": np.zeros((0, 0)), "t": np.arange(4.0)}}),
            "trial_2.mat: log/u: has 0 rows, and its times log/t have 4",
        ),
        "version 7.3 that was cut": (mat_73(half), "trial_2.mat: can't be read: .*truncated"),
        "version 7.3 with a garbled head": (
            mat_73(lambda data: data[:520] + bytes(200) + data[720:]),
            "trial_2.mat: can't be read: ",
        ),
    },
}


@pytest.mark.parametrize(
    ("array_trials", "case"),
    [(format, case) for format, cases in ONE_FORMAT_CASES.items() for case in cases],
    indirect=["array_trials"],
)
def test_a_file_of_arrays_is_refused_with(array_trials, tmp_path, case):
    format, folder = array_trials
    shutil.copytree(folder / "rec", tmp_path / "rec")
    change, words = ONE_FORMAT_CASES[format][case]
    mapping = of_arrays(format)
    change(tmp_path, mapping)
    is_refused(tmp_path, mapping, words)


# --- bags ---

START = 17 * 10**17
Message = tuple[str, str, int, Any]
"""Topic, type, when it was received (ns), and the message."""


def message(kind: str, *fields: Any) -> Any:
    return ROS2.types[kind](*fields)


def header(time: int) -> Any:
    return message("std_msgs/msg/Header", message("builtin_interfaces/msg/Time", time // 10**9, time % 10**9), "")


def joints(row: int, position: list[float], names: list[str] | None = None, time: int | None = None) -> Message:
    at = START + row * 10**8
    kind, none = "sensor_msgs/msg/JointState", np.zeros(0)
    head = header(at if time is None else time)
    return "/joints", kind, at, message(kind, head, names or ["a", "b"], np.array(position, np.float64), none, none)


def command(row: int, value: float) -> Message:
    return "/command", "std_msgs/msg/Float64", START + row * 10**8, message("std_msgs/msg/Float64", value)


def image(row: int, encoding: str = "rgb8", height: int = 6, size: int = 144) -> Message:
    kind, at = "sensor_msgs/msg/Image", START + row * 10**8
    return "/image", kind, at, message(kind, header(at), height, 8, encoding, 0, 24, np.zeros(size, np.uint8))


def packed(row: int, data: bytes) -> Message:
    kind, at = "sensor_msgs/msg/CompressedImage", START + row * 10**8
    return "/packed", kind, at, message(kind, header(at), "jpeg", np.frombuffer(data, np.uint8))


def good_messages() -> list[Message]:
    rows = range(ROWS)
    return [
        *(joints(row, [row, -row]) for row in rows),
        *(command(row, row % 3) for row in rows),
        *(image(row) for row in rows),
        *(packed(row, jpeg(row)) for row in rows),
    ]


def write_bag(path: Path, messages: list[Message], storage: StoragePlugin = StoragePlugin.SQLITE3) -> None:
    with Writer(path, version=9, storage_plugin=storage) as writer:
        connections: dict[tuple[str, str], Any] = {}
        for topic, kind, received, content in sorted(messages, key=lambda each: each[2]):
            if (topic, kind) not in connections:
                connections[topic, kind] = writer.add_connection(topic, kind, typestore=ROS2)
            data = content if isinstance(content, bytes) else bytes(ROS2.serialize_cdr(content, kind))
            writer.write(connections[topic, kind], received, data)


@pytest.fixture(scope="module")
def bags(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("ros2")
    (folder / "rec").mkdir()
    for trial in (1, 2, 3):
        write_bag(folder / "rec" / f"trial_{trial}", good_messages())
    return folder


BAGS = {
    "source": "rec",
    "format": "ros2",
    "streams": {
        "joints": {"topic": "/joints"},
        "command": {"topic": "/command"},
        "image": {"topic": "/image"},
        "packed": {"topic": "/packed"},
    },
    "modalities": {
        "setpoint": "command",
        "x": "joints.position",
        "vision": "image",
        "hand": {"from": "packed", "size": [8, 8]},
    },
}
META, DB = "rec/trial_2/metadata.yaml", "rec/trial_2/trial_2.db3"


def rewritten(change: Callable[[list[Message]], Any], storage: StoragePlugin = StoragePlugin.SQLITE3) -> Change:
    """Writes the second bag again, with other messages."""

    def changed(folder: Path, _: dict[str, Any]) -> None:
        shutil.rmtree(folder / "rec/trial_2")
        messages = good_messages()
        change(messages)
        write_bag(folder / "rec/trial_2", messages, storage)

    return changed


def swapped(index: int, message: Message) -> Change:
    return rewritten(lambda messages: messages.__setitem__(index, message))


def without_topic(topic: str) -> Change:
    return rewritten(
        lambda messages: messages.__setitem__(slice(None), [each for each in messages if each[0] != topic])
    )


def cut(index: int, length: int) -> Callable[[list[Message]], None]:
    def change(messages: list[Message]) -> None:
        topic, kind, received, content = messages[index]
        messages[index] = topic, kind, received, bytes(ROS2.serialize_cdr(content, kind))[:length]

    return change


def in_mcap(change: Callable[[bytes], bytes]) -> Change:
    whole = rewritten(lambda _: None, StoragePlugin.MCAP)
    return both(whole, edited("rec/trial_2/trial_2.mcap", change))


def sql(text: str) -> Change:
    def changed(folder: Path, _: dict[str, Any]) -> None:
        with sqlite3.connect(folder / DB) as connection:
            connection.execute(text)

    return changed


def garbled_middle(data: bytes) -> bytes:
    middle = len(data) // 2
    return data[:middle] + bytes(400) + data[middle + 400 :]


BAG_CASES: dict[str, tuple[Change, str]] = {
    "no metadata": (lambda folder, _: (folder / META).unlink(), "rec/trial_2: can't be read: "),
    "empty metadata": (edited(META, lambda _: b""), "rec/trial_2: can't be read: "),
    "metadata that is no YAML": (edited(META, lambda _: b"a: ["), "rec/trial_2: can't be read: "),
    "metadata of nothing": (edited(META, lambda _: b"rosbag2_bagfile_information: {}"), "rec/trial_2: can't be read: "),
    "metadata of a later version": (
        edited(META, lambda data: re.sub(rb"version: \d+", b"version: 99", data, count=1)),
        "rec/trial_2: can't be read: .*99",
    ),
    "no messages' file": (lambda folder, _: (folder / DB).unlink(), "rec/trial_2: can't be read: "),
    "an empty file": (edited(DB, lambda _: b""), "rec/trial_2: can't be read: "),
    "text": (edited(DB, lambda _: b"no database" * 99), "rec/trial_2: can't be read: "),
    "half a database": (edited(DB, half), "rec/trial_2: "),
    "a garbled database": (edited(DB, lambda data: data[:4096] + bytes(8192) + data[12288:]), "rec/trial_2: "),
    "no table of messages": (sql("drop table messages"), "rec/trial_2: can't be read: .*missing tables"),
    "no table of topics": (sql("drop table topics"), "rec/trial_2: can't be read: .*missing tables"),
    "half an MCAP file": (in_mcap(half), "rec/trial_2: .*can't be read: "),
    "an MCAP file that is text": (in_mcap(lambda _: b"no MCAP" * 99), "rec/trial_2: .*can't be read: "),
    "an empty MCAP file": (in_mcap(lambda _: b""), "rec/trial_2: .*can't be read: "),
    "a garbled MCAP file": (in_mcap(garbled_middle), "rec/trial_2: /\\w+: message \\d+"),
    "no such topic": (
        without_topic("/joints"),
        "rec/trial_2: there is no topic '/joints' for streams.joints.topic; the top",
    ),
    "no messages of a topic": (sql("delete from messages where topic_id = 1"), "rec/trial_2: /\\w+: holds no messages"),
    "no such field": (
        setting("modalities", "x", to="joints.positions"),
        "trial_1: modalities.x: there is no column 'joints.positions'; the columns are .*joints.position",
    ),
    "a message that was cut": (rewritten(cut(7, 20)), "rec/trial_2: /joints: message 7: can't be read: "),
    "an empty message": (rewritten(cut(7, 0)), "rec/trial_2: /joints: message 7: can't be read: "),
    "a head of a message": (rewritten(cut(7, 4)), "rec/trial_2: /joints: message 7: can't be read: "),
    "other joints": (
        swapped(7, joints(7, [7, -7], ["a", "c"])),
        r"rec/trial_2: /joints: message 7: its names are \['a', 'c'\], and those of message 0 \['a', 'b'\]",
    ),
    "a joint too many": (
        swapped(7, joints(7, [7, -7, 0])),
        "/joints: message 7, .*'joints.position' has 3 values, and 2 in m",
    ),
    "a header without a time": (
        swapped(7, joints(7, [7, -7], time=0)),
        "/joints: message 7: its header has no time; .*received",
    ),
    "a header's time that goes back": (
        swapped(7, joints(7, [7, -7], time=START + 10**8)),
        "/joints: message 7, received at 1700000000.7 s: the time goes back from 1700000000.6 to 1700000000.1 s",
    ),
    "a nan": (swapped(7, joints(7, [7, np.nan])), "/joints: message 7, .* element 1 of 'joints.position' is nan"),
    "an infinite command": (swapped(ROWS + 7, command(7, np.inf)), "/command: message 7, .*'command' is inf"),
    "a gap": (
        rewritten(lambda messages: messages.__delitem__(slice(5, 12))),
        "/joints: message 4, .*0.8 s pass until the next row of 'joints'",
    ),
    "depth images": (
        swapped(2 * ROWS + 7, image(7, "16UC1")),
        "/image: message 7, .*is no picture but uint16; .* give a depth a range",
    ),
    "pixels that are missing": (
        swapped(2 * ROWS + 7, image(7, size=99)),
        "/image: message 7, .*has 99 bytes for 6 x 8 pixels",
    ),
    "an image without pixels": (swapped(2 * ROWS + 7, image(7, height=0, size=0)), "/image: message 7, .*pixels"),
    "a picture that was cut": (
        swapped(3 * ROWS + 7, packed(7, half(jpeg(1)))),
        "/packed: message 7, .*is no picture, or dam",
    ),
    "a picture that is text": (
        swapped(3 * ROWS + 7, packed(7, b"text")),
        "/packed: message 7, .*: is no picture, or damaged",
    ),
    "two types on a topic": (
        rewritten(lambda messages: messages.append(("/joints", "std_msgs/msg/Float64", START, command(0, 1)[3]))),
        "rec/trial_2: /joints: has messages of several types",
    ),
    "numbers from pictures": (
        both(setting("modalities", "x", to="image"), setting("modalities", "vision", to=None)),
        "trial_1: /image: 'image' holds pictures, no numbers",
    ),
    "pictures from numbers": (
        setting("modalities", "vision", to="joints.effort"),
        "/joints: holds no pictures, but sensor",
    ),
    "pictures that are also numbers": (
        setting("modalities", "x", to="image"),
        "modalities: 'image' is an image of one",
    ),
    "an episode's topic that is not there": (
        setting("episode", to="/trial"),
        "trial_1: there is no topic '/trial' for epis",
    ),
    "an episode's topic of joints": (
        setting("episode", to="/joints"),
        "trial_1: /joints: is a .*; a topic 'episode' has one",
    ),
    "a time of another kind": (
        setting("streams", "joints", "time", to="sent"),
        "lab.yaml:1:\\d+: unknown message_time 'sent' in 'streams.joints.time'. Allowed: header, received",
    ),
}


@pytest.mark.parametrize("case", BAG_CASES)
def test_a_bag_is_refused_with(bags, tmp_path, case):
    change, words = BAG_CASES[case]
    shutil.copytree(bags / "rec", tmp_path / "rec")
    mapping = copy.deepcopy(BAGS)
    change(tmp_path, mapping)
    is_refused(tmp_path, mapping, words)



def test_the_undamaged_recordings_are_imported(csv_trials, bags, tmp_path):
    """Otherwise, the tests above would prove nothing."""
    for folder, mapping in ((csv_trials, CSV), (bags, BAGS)):
        path = folder / "lab.yaml"
        path.write_text(json.dumps({"name": "lab", "sample_rate_hz": 10, "max_gap_s": 0.5} | mapping))
        assert import_dataset(path, tmp_path / "results", progress=False)


def test_the_undamaged_arrays_are_imported(array_trials, tmp_path):
    format, folder = array_trials
    path = folder / "lab.yaml"
    path.write_text(json.dumps({"name": "lab", "sample_rate_hz": 10, "max_gap_s": 0.5} | of_arrays(format)))
    assert import_dataset(path, tmp_path / "results", progress=False)
