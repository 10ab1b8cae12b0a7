"""Makes a small recording of a bending finger, in every format that `harness import` reads, to try the import.

    python -m harness.importing.example recording

This writes a folder for each format, and the mapping of each, such as `recording/ros2.yaml`. A finger of four joints
follows commands and presses against a wall. The recording has four streams of different rates, with jitter.
"""

from __future__ import annotations

import argparse
import io
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from PIL import Image, ImageDraw

TRIALS = 6
"""Number of episodes."""
TRIAL_S = 8.0
"""Length of an episode, s."""
ROWS, COLUMNS = 96, 128
"""Size of the camera's images, pixels."""
WALL_RAD = 0.25
"""The angle of each joint at which the finger touches the wall."""
STIFFNESS_N_PER_RAD = 8.0
"""Force of the wall per angle beyond WALL_RAD."""


@dataclass(frozen=True)
class Trial:
    """An episode. All times are in s, from its start."""

    command_times: np.ndarray
    """[commands], 10 Hz."""
    commands: np.ndarray
    """The commanded mean angle, rad, [commands, 1]."""
    joint_times: np.ndarray
    """[rows], 100 Hz."""
    angles: np.ndarray
    """rad, [rows, 4]."""
    force_times: np.ndarray
    """[rows], 50 Hz."""
    forces: np.ndarray
    """N, [rows, 1]."""
    frame_times: np.ndarray
    """[frames], 30 Hz."""
    frames: np.ndarray
    """uint8 [frames, 96, 128, 3]."""


def simulate(index: int) -> Trial:
    """Returns an episode. The same index gives the same episode."""
    generator = np.random.default_rng(index)

    def clock(rate_hz: float, jitter_s: float) -> np.ndarray:
        times = np.arange(int(TRIAL_S * rate_hz)) / rate_hz
        return np.round(times + generator.uniform(0, jitter_s, len(times)), 6)

    command_times = clock(10, 0.0)
    commands = np.repeat(generator.permutation(np.linspace(-0.6, 0.6, int(TRIAL_S))), 10)  # each trial touches
    fine = np.arange(0, TRIAL_S, 0.001)
    target = commands[np.minimum((fine * 10).astype(int), len(commands) - 1)]
    bend = np.empty(len(fine))
    bend[0] = 0.0
    for step in range(1, len(fine)):
        pressed = max(0.0, bend[step - 1] - WALL_RAD)
        bend[step] = bend[step - 1] + 0.001 * ((target[step] - bend[step - 1]) / 0.2 - 12.0 * pressed)
    joint_times, force_times, frame_times = clock(100, 0.001), clock(50, 0.002), clock(30, 0.003)
    joints = np.interp(joint_times, fine, bend)[:, None] * np.array([0.7, 0.9, 1.1, 1.3])
    force = STIFFNESS_N_PER_RAD * np.maximum(0.0, np.interp(force_times, fine, bend) - WALL_RAD)
    return Trial(
        command_times=command_times,
        commands=commands[:, None],
        joint_times=joint_times,
        angles=joints + generator.normal(0, 0.002, joints.shape),
        force_times=force_times,
        forces=(force + generator.normal(0, 0.01, len(force)))[:, None],
        frame_times=frame_times,
        frames=np.stack([_drawn(angle) for angle in np.interp(frame_times, fine, bend)]),
    )


def _drawn(bend: float) -> np.ndarray:
    """Returns an image of the finger and the wall."""
    image = Image.new("RGB", (COLUMNS, ROWS), (235, 235, 230))
    draw = ImageDraw.Draw(image)
    draw.rectangle((98, 0, COLUMNS, ROWS), fill=(120, 90, 60))
    x, y, direction = 64.0, 6.0, 0.0
    for share in (0.7, 0.9, 1.1, 1.3):
        direction += bend * share
        tip = (x + 20 * np.sin(direction), y + 20 * np.cos(direction))
        draw.line((x, y, *tip), fill=(200, 60, 40), width=9)
        x, y = tip
    return np.asarray(image)


def write_csv(folder: Path, trials: list[Trial]) -> None:
    """Writes CSV files and videos: a folder for each trial."""
    import av

    for index, trial in enumerate(trials, 1):
        place = folder / f"trial_{index}"
        place.mkdir(parents=True)
        angles = {f"angle_{joint}": trial.angles[:, joint] for joint in range(4)}
        pl.DataFrame({"time": trial.joint_times, **angles}).write_csv(place / "joints.csv")
        pl.DataFrame({"time": trial.force_times, "newton": trial.forces[:, 0]}).write_csv(place / "force.csv")
        pl.DataFrame({"time": trial.command_times, "bend": trial.commands[:, 0]}).write_csv(place / "command.csv")
        pl.DataFrame({"time": trial.frame_times}).write_csv(place / "camera.csv")
        with av.open(str(place / "camera.mp4"), "w") as container:
            stream = container.add_stream("libx264", rate=30)
            stream.width, stream.height, stream.pix_fmt = COLUMNS, ROWS, "yuv420p"
            stream.codec_context.thread_count = 1
            for frame in trial.frames:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
            container.mux(stream.encode())


def write_hdf5(folder: Path, trials: list[Trial]) -> None:
    """Writes an HDF5 file for each trial."""
    import h5py

    folder.mkdir(parents=True)
    for index, trial in enumerate(trials, 1):
        with h5py.File(folder / f"trial_{index}.h5", "w") as file:
            for name, value in _arrays(trial).items():
                file.create_dataset(name, data=value, compression="gzip")


def write_zarr(folder: Path, trials: list[Trial]) -> None:
    """Writes a zarr store of all trials, in which all arrays have the frames' rate, as controllers often log."""
    import zarr

    rows: dict[str, list[np.ndarray]] = {"angles": [], "force": [], "command": [], "frames": []}
    for trial in trials:
        for name, times, values in (
            ("angles", trial.joint_times, trial.angles),
            ("force", trial.force_times, trial.forces),
            ("command", trial.command_times, trial.commands),
        ):
            latest = np.maximum(np.searchsorted(times, trial.frame_times, side="right") - 1, 0)
            rows[name].append(values[latest])
        rows["frames"].append(trial.frames)
    folder.mkdir(parents=True)
    root = zarr.open_group(folder / "recording.zarr", mode="w")
    for name, parts in rows.items():
        values = np.concatenate(parts)
        chunks = (100, *values.shape[1:])
        root.create_array(f"data/{name}", shape=values.shape, dtype=values.dtype, chunks=chunks)[:] = values
    ends = np.cumsum([len(trial.frame_times) for trial in trials])
    root.create_array("meta/episode_ends", shape=ends.shape, dtype=ends.dtype)[:] = ends


def write_matlab(folder: Path, trials: list[Trial]) -> None:
    """Writes a MATLAB file for each trial."""
    from scipy.io import savemat

    folder.mkdir(parents=True)
    for index, trial in enumerate(trials, 1):
        arrays = _arrays(trial)
        arrays["camera/frames"] = np.moveaxis(arrays["camera/frames"], 0, -1)
        variables: dict[str, dict[str, np.ndarray]] = {}
        for name, value in arrays.items():
            structure, _, field = name.partition("/")
            variables.setdefault(structure, {})[field] = value
        savemat(folder / f"trial_{index}.mat", variables, do_compression=True, oned_as="column")


def _arrays(trial: Trial) -> dict[str, np.ndarray]:
    return {
        "joints/time": trial.joint_times,
        "joints/angles": trial.angles,
        "force/time": trial.force_times,
        "force/newton": trial.forces,
        "command/time": trial.command_times,
        "command/bend": trial.commands,
        "camera/time": trial.frame_times,
        "camera/frames": trial.frames,
    }


def write_ros2(folder: Path, trials: list[Trial]) -> None:
    """Writes a ROS 2 bag for each trial. The bag receives each message 2 to 4 ms after its header's time."""
    from rosbags.rosbag2 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    types = store.types
    header, stamp = types["std_msgs/msg/Header"], types["builtin_interfaces/msg/Time"]
    vector = types["geometry_msgs/msg/Vector3"]
    folder.mkdir(parents=True)

    def joint_state(head: Any, row: np.ndarray) -> Any:
        names = [f"finger_{joint}" for joint in range(4)]
        return types["sensor_msgs/msg/JointState"](head, names, row, np.zeros(0), np.zeros(0))

    def wrench(head: Any, row: np.ndarray) -> Any:
        force, torque = vector(row[0], 0.0, 0.0), vector(0.0, 0.0, 0.0)
        return types["geometry_msgs/msg/WrenchStamped"](head, types["geometry_msgs/msg/Wrench"](force, torque))

    def command(_: Any, row: np.ndarray) -> Any:
        layout = types["std_msgs/msg/MultiArrayLayout"]([], 0)
        return types["std_msgs/msg/Float64MultiArray"](layout, row)

    def picture(head: Any, frame: np.ndarray) -> Any:
        buffer = io.BytesIO()
        Image.fromarray(frame).save(buffer, "JPEG", quality=90)
        return types["sensor_msgs/msg/CompressedImage"](head, "jpeg", np.frombuffer(buffer.getvalue(), np.uint8))

    for index, trial in enumerate(trials, 1):
        generator, start = np.random.default_rng(index), 1_700_000_000 * 10**9 + index * 60 * 10**9
        messages = []
        with Writer(folder / f"trial_{index}", version=9) as writer:
            for topic, kind, make, times, values in (
                ("/joint_states", "sensor_msgs/msg/JointState", joint_state, trial.joint_times, trial.angles),
                ("/wrench", "geometry_msgs/msg/WrenchStamped", wrench, trial.force_times, trial.forces),
                ("/command", "std_msgs/msg/Float64MultiArray", command, trial.command_times, trial.commands),
                ("/camera/compressed", "sensor_msgs/msg/CompressedImage", picture, trial.frame_times, trial.frames),
            ):
                connection = writer.add_connection(topic, kind, typestore=store)
                for time, row in zip(times.tolist(), values, strict=True):
                    at = start + round(time * 1e9)
                    head = header(stamp(at // 10**9, at % 10**9), "finger")
                    received = at + (generator.integers(2_000_000, 4_000_000).item() if make is not command else 0)
                    messages.append((received, connection, store.serialize_cdr(make(head, row), kind)))
            for received, connection, data in sorted(messages, key=lambda message: message[0]):
                writer.write(connection, received, data)


FORMATS = {
    "csv": write_csv,
    "hdf5": write_hdf5,
    "zarr": write_zarr,
    "matlab": write_matlab,
    "ros2": write_ros2,
}
"""The function that writes each format."""

_START = """name: finger_{format}
source: {format}
format: {format}
sample_rate_hz: 10
max_gap_s: 0.3
"""
_GROUPS = """streams:
  joints: {data: joints/angles, time: joints/time}
  force: {data: force/newton, time: force/time, align: mean}
  command: {data: command/bend, time: command/time}
  camera: {data: camera/frames, time: camera/time}
modalities:
  setpoint: command
  angles: {from: joints, unit: rad}
  force: {from: force, unit: N}
  vision: camera
"""
MAPPINGS = {
    "csv": """streams:
  joints: {file: "*/joints.csv", time: time}
  force: {file: "*/force.csv", time: time, align: mean}
  command: {file: "*/command.csv", time: time}
  camera: {file: "*/camera.mp4", times: "*/camera.csv", time: time}
modalities:
  setpoint: command.bend
  angles: {from: "joints.angle_?", unit: rad}
  force: {from: force.newton, unit: N}
  vision: camera
""",
    "hdf5": _GROUPS,
    "zarr": """episode_ends: meta/episode_ends
streams:
  log: {data: data, rate_hz: 30}
modalities:
  setpoint: log.command
  angles: {from: log.angles, unit: rad}
  force: {from: log.force, unit: N}
  vision: log.frames
""",
    "matlab": _GROUPS,
    "ros2": """streams:
  joints: {topic: /joint_states}
  force: {topic: /wrench, align: mean}
  command: {topic: /command}
  camera: {topic: /camera/compressed}
modalities:
  setpoint: command
  angles: {from: joints.position, unit: rad}
  force: {from: force.wrench.force.x, unit: N}
  vision: camera
""",
}
"""The mapping of each format, below its first lines."""


def mapping_of(format: str) -> str:
    """Returns the mapping of the recording in a format."""
    return _START.format(format=format) + MAPPINGS[format]


def write(folder: Path, formats: list[str]) -> None:
    """Writes the recording in some formats, each with its mapping.

    Raises:
        FileExistsError: one is there already.
        ImportError: a package is missing that writes a format.
    """
    trials = [simulate(index) for index in range(TRIALS)]
    for format in formats:
        if (folder / format).exists():
            raise FileExistsError(f"{folder / format} is there already; remove it, or name another folder")
        FORMATS[format](folder / format, trials)
        (folder / f"{format}.yaml").write_text(mapping_of(format))


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m harness.importing.example", description="Make a small recording to try `harness import`."
    )
    parser.add_argument("folder", type=Path, help="the folder to write, such as recording")
    parser.add_argument("--format", choices=FORMATS, help="only this format [default: all]")
    arguments = parser.parse_args()
    try:
        write(arguments.folder, [arguments.format] if arguments.format else list(FORMATS))
    except (OSError, ImportError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(f"{arguments.folder}: {TRIALS} trials of {TRIAL_S:g} s; import them with 'harness import'")
    return 0


if __name__ == "__main__":
    sys.exit(main())
