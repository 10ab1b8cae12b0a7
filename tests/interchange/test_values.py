"""Values that could be changed without a word on their way into a dataset: each is kept, or refused with its place."""

import functools
import io
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import h5py
import numpy as np
import polars as pl
import pytest
from PIL import Image
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

from harness import _harness
from harness.importing import import_dataset
from harness.importing.inspection import first_mapping, inspect

ROWS = 4
GRADIENT = np.arange(64, dtype=np.uint8).reshape(8, 8) * 4


def imported(folder: Path, **keys: Any) -> Path:
    """Writes a mapping, imports it, and returns the dataset's folder."""
    path, results = folder / "lab.yaml", folder / "results"
    defaults = {"name": "lab", "source": "rec", "sample_rate_hz": 10, "max_gap_s": 0.5}
    path.write_text(json.dumps(defaults | keys))
    return results / "datasets" / import_dataset(path, results, progress=False)


def column(dataset: Path, name: str) -> list[Any]:
    return pl.read_parquet(dataset / "episode_00000.parquet")[name].to_list()


def frame(dataset: Path) -> np.ndarray:
    """The first image, 8 x 8 pixels."""
    return np.frombuffer(column(dataset, "eye")[0], np.uint8).reshape(8, 8, 3)


EYE = {"from": "eye", "size": [8, 8]}


def of_images(folder: Path, save: Callable[[Path], Any]) -> Path:
    """Imports folders of images that a function saves."""
    for trial in range(3):
        place = folder / f"rec/{trial}"
        (place / "eye").mkdir(parents=True)
        (place / "log.csv").write_text("t,u\n" + "".join(f"{row / 10},{row}\n" for row in range(ROWS)))
        for row in range(ROWS):
            save(place / "eye" / f"{row / 10}")
    streams = {"log": {"file": "*/log.csv", "time": "t"}, "eye": {"file": "*/eye", "time": "name"}}
    return imported(folder, format="csv", streams=streams, modalities={"setpoint": "log.u", "eye": EYE})


def saved(pixels: np.ndarray | Image.Image, ending: str = ".png", **options: Any) -> Callable[[Path], None]:
    image = Image.fromarray(pixels) if isinstance(pixels, np.ndarray) else pixels
    return lambda path: image.save(f"{path}{ending}", **options)


def turned(orientation: int) -> Image.Exif:
    exif = Image.Exif()
    exif[0x0112] = orientation
    return exif


def rgb16(path: Path) -> None:
    """A PNG of 16 bits per color, which Pillow reads, but does not write."""
    with av.open(f"{path}.png", "w", format="image2", options={"update": "1"}) as container:
        stream = container.add_stream("png", rate=1)
        stream.width = stream.height = 8
        stream.pix_fmt = "rgb48be"
        pixels = np.full((8, 8, 3), 1000, np.uint16)
        container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb48be")))
        container.mux(stream.encode())


DEPTH = GRADIENT.astype(np.uint16) * 16
GRAY = Image.fromarray(GRADIENT)
DEEP: dict[str, tuple[Callable[[Path], Any], str]] = {
    "16 bits": (saved(DEPTH), "I;16"),
    "16 bits, TIFF": (saved(DEPTH, ".tif"), "I;16"),
    "16 bits per color": (rgb16, "RGB with 16 bits"),
    "32 bits": (saved(DEPTH.astype(np.int32), ".tif"), "I"),
    "floats": (saved(DEPTH.astype(np.float32), ".tif"), "F"),
    "CMYK": (saved(GRAY.convert("CMYK"), ".jpg"), "CMYK"),
}


@pytest.mark.parametrize("kind", DEEP)
def test_pictures_that_would_lose_values_are_refused(tmp_path, kind):
    save, mode = DEEP[kind]
    with pytest.raises(
        ValueError, match=rf"rec/0/eye/0.0.\w+: has pixels of the kind {mode}; a picture has 8 bits per"
    ):
        of_images(tmp_path, save)
    assert not (tmp_path / "results").exists()


def test_a_file_of_several_pictures_is_refused(tmp_path):
    with pytest.raises(ValueError, match="rec/0/eye/0.0.tif: holds 2 pictures; save each as a file of its own"):
        of_images(tmp_path, saved(GRAY, ".tif", save_all=True, append_images=[GRAY]))


@pytest.mark.parametrize(
    ("save", "expected"),
    [
        (saved(GRADIENT), GRADIENT),
        (saved(GRAY.convert("P")), GRADIENT),
        (saved(Image.merge("LA", [GRAY, GRAY])), GRADIENT),
        (saved(Image.merge("RGBA", [GRAY] * 4)), GRADIENT),
        (saved(GRAY.convert("1")), np.asarray(GRAY.convert("1")) * np.uint8(255)),
        (saved(GRADIENT, exif=turned(6)), np.rot90(GRADIENT, -1)),
        (saved(GRADIENT, exif=turned(3)), np.rot90(GRADIENT, 2)),
    ],
    ids=["gray", "palette", "gray and alpha", "alpha", "bits", "turned right", "upside down"],
)
def test_pictures_are_imported_as_viewers_show_them(tmp_path, save, expected):
    np.testing.assert_array_equal(frame(of_images(tmp_path, save)), np.repeat(expected[..., None], 3, axis=2))


def video(path: Path, array: np.ndarray, format: str, codec: str) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=10)
        stream.height, stream.width = array.shape[:2]
        stream.pix_fmt = format
        for _ in range(ROWS):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(array, format=format)))
        container.mux(stream.encode())


def of_videos(folder: Path, write: Callable[[Path], Any], ending: str) -> Path:
    for trial in range(3):
        place = folder / f"rec/{trial}"
        place.mkdir(parents=True)
        (place / "log.csv").write_text("t,u\n" + "".join(f"{row / 10},{row}\n" for row in range(ROWS)))
        write(place / f"eye{ending}")
    streams = {"log": {"file": "*/log.csv", "time": "t"}, "eye": {"file": f"*/eye{ending}"}}
    return imported(folder, format="csv", streams=streams, modalities={"setpoint": "log.u", "eye": EYE})


def test_a_video_of_depths_is_refused(tmp_path):
    depth = np.full((48, 64), 4000, np.uint16)
    with pytest.raises(ValueError, match="rec/0/eye.mkv: frame 0, at 0.000 s: is no picture but uint16; a picture"):
        of_videos(tmp_path, lambda path: video(path, depth, "gray16le", "ffv1"), ".mkv")


def test_a_video_is_turned_as_players_show_it(tmp_path):
    halves = np.zeros((64, 64, 3), np.uint8)
    halves[:32] = 250

    def write(path: Path) -> None:
        video(path, halves, "rgb24", "libx264rgb")
        data, one, none = path.read_bytes(), (1 << 16).to_bytes(4), bytes(4)
        last = (1 << 30).to_bytes(4)
        plain = one + none * 3 + one + none * 3 + last
        start = data.rindex(plain)
        # The matrix of a quarter turn to the right, as phones write it.
        quarter = none + one + none + b"\xff\xff\x00\x00" + none * 2 + (64 << 16).to_bytes(4) + none + last
        path.write_bytes(data[:start] + quarter + data[start + len(plain) :])

    shown = frame(of_videos(tmp_path, write, ".mp4")).astype(int).mean(axis=2)
    assert (shown[:, 4:] > 200).all() and (shown[:, :4] < 50).all(), shown


@pytest.mark.parametrize(
    ("format", "words"),
    [
        ("16UC1; png compressed ", "has pixels of the kind I;16; a picture has 8 bits"),
        ("16UC1; compressedDepth png", "has pixels of the kind I;16; a picture has 8 bits"),
        (
            "32FC1; compressedDepth png",
            "has the format '32FC1; compressedDepth png'; compressed depths can be read as 16UC1",
        ),
    ],
)
def test_compressed_images_of_16_bits_in_a_bag_are_refused(tmp_path, format, words):
    store = get_typestore(Stores.ROS2_HUMBLE)
    types, buffer = store.types, io.BytesIO()
    Image.fromarray(DEPTH).save(buffer, "PNG")
    kind, number = "sensor_msgs/msg/CompressedImage", "std_msgs/msg/Float64"
    with Writer(tmp_path / "rec", version=9) as writer:
        eye = writer.add_connection("/eye", kind, typestore=store)
        command = writer.add_connection("/command", number, typestore=store)
        for row in range(ROWS):
            at = 10**18 + row * 10**8
            stamp = types["builtin_interfaces/msg/Time"](at // 10**9, at % 10**9)
            head = types["std_msgs/msg/Header"](stamp, "")
            picture = types[kind](head, format, np.frombuffer(buffer.getvalue(), np.uint8))
            writer.write(eye, at, store.serialize_cdr(picture, kind))
            writer.write(command, at, store.serialize_cdr(types[number](float(row)), number))
    streams = {"eye": {"topic": "/eye"}, "command": {"topic": "/command"}}
    with pytest.raises(ValueError, match=f"rec: /eye: message 0, .*: {words}"):
        imported(tmp_path, format="ros2", streams=streams, modalities={"setpoint": "command", "eye": EYE})


# --- rows of Parquet files ---

PARQUET = {"format": "parquet", "episode": "trial", "order": "row", "sample_rate_hz": 10, "max_gap_s": None}


def of_rows(folder: Path, modality: Any = "x", **columns: Any) -> Path:
    rows = {"trial": np.repeat([0, 1, 2], ROWS), "row": np.tile(np.arange(ROWS), 3), "u": np.zeros(3 * ROWS)}
    pl.DataFrame(rows | {name: values * 3 for name, values in columns.items()}).write_parquet(folder / "rec.parquet")
    keys = {key: value for key, value in PARQUET.items() if value is not None}
    path = folder / "lab.yaml"
    modalities = {"setpoint": "u", "eye" if isinstance(modality, dict) else "x": modality}
    path.write_text(json.dumps({"name": "lab", "source": "rec.parquet", "modalities": modalities} | keys))
    return folder / "results/datasets" / import_dataset(path, folder / "results", progress=False)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (["1", "2", "3", "4"], "modalities.x: 'x' holds no numbers"),
        (["1", None, "3", "4"], "modalities.x: 'x' holds no numbers"),
        ([["1", "2"]] * 4, "modalities.x: 'x' holds no numbers"),
        (
            [2_000_000_000 + row for row in range(4)],
            "modalities.x: value 0 changes by 3 only, near 2e.09; datasets store",
        ),
        ([1.7e9, 1.7e9 + 0.1, 1.7e9 + 0.2, 1.7e9 + 0.3], "modalities.x: value 0 changes by 0.3 only, near 1.7e.09"),
        ([1e39] * 4, "modalities.x: value 0 of row 0 is 1e.39; it must be a finite number"),
        ([1e-50, 2e-50, 3e-50, 0.0], "modalities.x: value 0 changes by 3e-50 only, near 0; .*; use a smaller unit"),
    ],
)
def test_numbers_that_a_dataset_cannot_store_are_refused(tmp_path, values, words):
    with pytest.raises(ValueError, match=words):
        of_rows(tmp_path, x=values)


@pytest.mark.parametrize(
    ("values", "stored"),
    [
        ([True, False, True, True], [1, 0, 1, 1]),
        ([2e9] * 4, [2e9] * 4),
        ([0, 10**9, 2 * 10**9, 10**7], [0, 1e9, 2e9, 1e7]),
        ([9.81, 9.81 + 1e-9, 9.81, 9.81], [np.float32(9.81)] * 4),
    ],
)
def test_numbers_that_a_dataset_can_store_are_imported(tmp_path, values, stored):
    assert column(of_rows(tmp_path, x=values), "x_00") == stored


def test_an_image_file_of_as_many_bytes_as_pixels_is_no_raw_image(tmp_path):
    buffer = io.BytesIO()
    Image.fromarray(GRADIENT).save(buffer, "PNG")
    data = buffer.getvalue()
    # PNG files end in a chunk without content; a comment before it makes the file as long as 8 x 8 pixels.
    file = data + bytes(8 * 8 * 3 - len(data))
    assert len(file) == 8 * 8 * 3
    dataset = of_rows(tmp_path, {"from": "picture", "size": [8, 8]}, picture=[file] * ROWS)
    np.testing.assert_array_equal(frame(dataset)[..., 0], GRADIENT)


# --- HDF5 ---


def of_hdf5(folder: Path, write: Callable[[h5py.File], Any], data: str = "x", **stream: Any) -> Path:
    (folder / "rec").mkdir(exist_ok=True)
    for trial in range(3):
        with h5py.File(folder / f"rec/{trial}.h5", "w") as file:
            file["u"], file["t"] = np.zeros(ROWS), np.arange(ROWS) / 10
            write(file)
    clock = {"time": "t"} | stream
    streams = {"u": {"data": "u"} | clock, "x": {"data": data} | clock}
    return imported(folder, format="hdf5", streams=streams, modalities={"setpoint": "u", "x": "x"})


@pytest.mark.parametrize(
    "data", ["joints/q", "alias/q", "soft", "outside", "hard/q", "a_hard_group/q", "joints/whole/soft"]
)
def test_data_is_found_by_every_link(tmp_path, data):
    def write(file: h5py.File) -> None:
        file["joints/q"] = np.arange(ROWS) * 2.0
        file["alias"], file["soft"] = h5py.SoftLink("/joints"), h5py.SoftLink("/joints/q")
        file["outside"] = h5py.ExternalLink("../other.h5", "/q")
        file["hard/q"], file["a_hard_group"] = file["joints/q"], file["joints"]
        file["joints/whole"], file["gone"] = h5py.SoftLink("/"), h5py.SoftLink("/nowhere")

    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["q"] = np.arange(ROWS) * 2.0
    if data == "joints/whole/soft":
        # A group that links to the one around it is not followed forever.
        with pytest.raises(ValueError, match="there is no 'joints/whole/soft' for streams.x.data; the arrays are"):
            of_hdf5(tmp_path, write, data)
    else:
        assert column(of_hdf5(tmp_path, write, data), "x_00") == [0, 2, 4, 6]


def test_packed_numbers_are_refused_and_missing_ones_are_no_values(tmp_path):
    def write(file: h5py.File, **attributes: Any) -> None:
        file["x"] = np.array([5, 6, -9999, 8], np.int16)
        file["x"].attrs.update(attributes)

    for name, value in (("scale_factor", 0.01), ("add_offset", np.array([3.0]))):
        words = f"rec/0.h5: x: 'x' has the attribute {name}, so that its numbers are not its values"
        with pytest.raises(ValueError, match=words):
            of_hdf5(tmp_path, functools.partial(write, **{name: value}))
    whole = functools.partial(write, scale_factor=1.0, _FillValue=np.array([-9999], np.int16))
    with pytest.raises(
        ValueError, match="rec/0.h5: x: row 2: 'x' is nan; it must be a finite number; to leave out rows"
    ):
        of_hdf5(tmp_path, whole)
    assert column(of_hdf5(tmp_path, whole, missing="skip"), "x_00") == [5, 6, 6, 8]


@pytest.mark.parametrize("type", [">f8", ">f4", ">i2", "u8", "f2", "?"])
def test_numbers_of_a_type_are_read_as_they_are(tmp_path, type):
    values = np.array([0, 1, 0, 1]).astype(type)
    assert column(of_hdf5(tmp_path, lambda file: file.create_dataset("x", data=values)), "x_00") == [0, 1, 0, 1]


@pytest.mark.parametrize(
    ("type", "start", "unit", "words"),
    [
        (
            "f4",
            1.7e9,
            "s",
            "row 0: 17000+.0 is float32, in which times so large are 128 s apart; store them as float64 or",
        ),
        ("f4", 1.7e18, "ns", "row 0: 1.7\\d+e.18 is float32, in which times so large are 137 s apart"),
        ("f2", 100, "s", "row 3: 100.\\d+ is float16, in which times so large are 0.0625 s apart"),
        ("f4", 100, "s", None),
        ("f8", 1.7e9, "s", None),
        ("f8", 1.7e18, "ns", None),
        (">f8", 1.7e9, "s", None),
        (">i8", 1_700_000_000_000, "ms", None),
    ],
)
def test_times_that_their_type_rounds_are_refused(tmp_path, type, start, unit, words):
    step = {"s": 0.1, "ms": 100, "ns": 1e8}[unit]

    def write(file: h5py.File) -> None:
        file["clock"] = (start + np.arange(ROWS) * step).astype(type)
        file["x"] = np.arange(ROWS) * 1.0

    if words is None:
        assert len(column(of_hdf5(tmp_path, write, time="clock", time_unit=unit), "x_00")) >= ROWS - 1
    else:
        with pytest.raises(ValueError, match=rf"rec/0.h5: clock: {words}"):
            of_hdf5(tmp_path, write, time="clock", time_unit=unit)


# --- what is in the results folder already ---


def infinite(path: Path) -> None:
    path.write_text(path.read_text().replace('"max_gap_s": 0.5', '"max_gap_s": Infinity'))


DAMAGES: dict[str, tuple[str, Callable[[Path], Any]]] = {
    "a number that JSON does not have": ("dataset.json", infinite),
    "half a description": ("dataset.json", lambda path: os.truncate(path, 40)),
    "no description": ("dataset.json", Path.unlink),
    "the description of another": ("dataset.json", lambda path: path.write_text('{"format": 2}')),
    "half an episode": ("episode_00001.parquet", lambda path: os.truncate(path, 900)),
    "a changed byte": (
        "episode_00001.parquet",
        lambda path: path.write_bytes(path.read_bytes().replace(b"lab", b"bal", 1)),
    ),
    "no episode": ("episode_00001.parquet", Path.unlink),
    "the file of another episode": (
        "episode_00001.parquet",
        lambda path: path.write_bytes((path.parent / "episode_00000.parquet").read_bytes()),
    ),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_importing_again_repairs_a_dataset(tmp_path, damage):
    file, change = DAMAGES[damage]

    def again() -> Path:
        return of_hdf5(tmp_path, lambda opened: opened.create_dataset("x", data=np.arange(ROWS)))

    dataset = again()
    whole = {path.name: path.read_bytes() for path in dataset.iterdir()}
    change(dataset / file)
    assert not (dataset / file).exists() or (dataset / file).read_bytes() != whole[file]
    assert again() == dataset
    assert {path.name: path.read_bytes() for path in dataset.iterdir()} == whole
    assert not list((tmp_path / "results").glob(".unfinished-*"))


def test_a_dataset_that_is_whole_is_not_written_again(tmp_path):
    def write(file: h5py.File) -> None:
        file["x"] = np.arange(ROWS)

    dataset = of_hdf5(tmp_path, write)
    before = {path: path.stat().st_ino for path in dataset.iterdir()}
    of_hdf5(tmp_path, write, offset_s=0)
    assert {path: path.stat().st_ino for path in dataset.iterdir()} == before


@pytest.mark.parametrize("gap", [float("inf"), float("nan"), -1, 0, ".inf"])
def test_a_longest_gap_is_a_positive_number_or_unlimited(tmp_path, gap):
    def write(file: h5py.File) -> None:
        file["x"] = np.arange(ROWS)

    with pytest.raises(
        ValueError,
        match=r"lab.yaml:1:\d+: 'streams.u.max_gap_s': expected a finite number above 0 or a text 'unlimited'",
    ):
        of_hdf5(tmp_path, write, max_gap_s=gap)
    dataset = of_hdf5(tmp_path, write, max_gap_s="unlimited")

    def refuse(constant: str) -> None:
        raise AssertionError(constant)

    json.loads((dataset / "dataset.json").read_text(), parse_constant=refuse)


# --- first mappings ---


def test_a_first_mapping_is_valid_whatever_the_names_are(tmp_path):
    names = ["force [N]", "a: b", "#c", "it's", 'say "x"', "no", "true", "1e3", "*", "[1, 2]", "{", "ä"]
    place = tmp_path / "rec: final #2"
    place.mkdir()
    for trial in range(3):
        rows = {"time": np.arange(ROWS) / 10} | {name: np.arange(ROWS) + index for index, name in enumerate(names)}
        pl.DataFrame(rows).write_csv(place / f"trial_{trial}.csv")
    mapping = tmp_path / "first.yaml"
    mapping.write_text(first_mapping(inspect(place), place, tmp_path))
    content = json.loads(_harness.read_mapping(mapping))
    assert content["source"] == place.name and content["modalities"]["setpoint"] == "none"
    assert content["modalities"]["log_force"] == {"from": "log.force [N]", "unit": "N"}
    import_dataset(mapping, tmp_path / "results", progress=False)
