"""Exported datasets, opened with the packages of the projects whose formats they are in."""

import io
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from harness.export import export
from harness.recorded import DamagedError, RecordedDataset, vector_columns

EPISODES, SAMPLES = 4, 30


def copy(dataset: Path, target: Path) -> Path:
    """A copy to damage, under the same name."""
    folder = target / dataset.name
    folder.mkdir()
    for file in dataset.glob("*.*"):
        (folder / file.name).write_bytes(file.read_bytes())
    return folder


def test_a_lerobot_dataset_opens_with_lerobot_and_holds_the_same(dataset, tmp_path):
    pytest.importorskip("lerobot", reason="lerobot is not installed; it needs Python 3.12: make interchange")
    from lerobot.datasets import LeRobotDataset

    output = export(dataset, "lerobot", tmp_path / "exported", progress=False)
    assert json.loads((output / "meta/info.json").read_text())["codebase_version"] == "v3.0"
    found = LeRobotDataset("local/exported", root=output, video_backend="pyav", return_uint8=True)
    assert (found.num_episodes, found.num_frames, found.fps) == (EPISODES, EPISODES * SAMPLES, 10)
    assert found.meta.features["action"]["names"] == [
        "setpoint_rotation [rad]",
        "setpoint_lift [m]",
        "setpoint_extension [m]",
    ]
    source = RecordedDataset(dataset)
    errors = []
    for index in source.episodes:
        episode = source.read(index)
        vectors = episode.vectors
        for sample in range(SAMPLES):
            item = found[index * SAMPLES + sample]
            assert item["episode_index"] == index and item["frame_index"] == sample
            assert item["timestamp"].item() == pytest.approx(episode.time[sample])
            assert item["task"] == f"random motion, {source.scenario} scenario"
            state = np.concatenate([vectors["proprioception"][sample], vectors["arm"][sample]])
            np.testing.assert_array_equal(item["observation.state"].numpy(), state)
            np.testing.assert_array_equal(item["observation.setpoint"].numpy(), vectors["setpoint"][sample])
            # The robot goes from the row's sample to the next by what is sent after the observation.
            following = min(sample + 1, SAMPLES - 1)
            np.testing.assert_array_equal(item["action"].numpy(), vectors["setpoint"][following])
            for force in ("contact_force", "contact_force_mean"):
                np.testing.assert_array_equal(item[f"observation.{force}"].numpy(), vectors[force][sample])
            frame = item["observation.images.external"].permute(1, 2, 0).numpy()
            errors.append(np.abs(frame.astype(int) - episode.images["vision"][sample]))
    # The frames went through H.264. A frame shifted by one sample differs by hundreds.
    assert np.mean(errors) < 1.5 and np.max(errors) < 40, (np.mean(errors), np.max(errors))


FEATURES = {
    "twelve": {
        "observation.state": ("proprioception", "arm"),
        "observation.contact_force": ("contact_force",),
        "observation.contact_force_kind": ("contact_force_kind",),
        "observation.contact_force_mean": ("contact_force_mean",),
        "observation.contact_force_mean_kind": ("contact_force_mean_kind",),
        "observation.contact_normal": ("contact_normal",),
        "observation.factors": ("factors",),
        "observation.setpoint": ("setpoint",),
    },
    "suite_finger": {
        "observation.joints": ("joints",),
        "observation.joint_velocities": ("joint_velocities",),
        "observation.contact_force": ("contact_force",),
        "observation.jointpos": ("jointpos",),
        "observation.jointvel": ("jointvel",),
        "observation.touch": ("touch",),
        "observation.framepos": ("framepos",),
        "observation.setpoint": ("setpoint",),
    },
}
"""LeRobot's features of the robots that the harness does not know, and the vectors that each is made of."""
CAMERAS = {
    "twelve": {"observation.images.external": "vision", "observation.images.wrist": "wrist"},
    "suite_finger": {"observation.images.cam0": "cam0", "observation.images.cam1": "cam1"},
}
ELEMENTS = {
    "twelve": ("observation.factors", ["factors_finger_stiffness [1]"]),
    "suite_finger": ("observation.touch", ["touch_touchtop [N]", "touch_touchbottom [N]"]),
}
"""One of the features, and the names of its elements."""


def test_a_foreign_robots_dataset_opens_the_same_with_lerobot(foreign, tmp_path):
    pytest.importorskip("lerobot", reason="lerobot is not installed; it needs Python 3.12: make interchange")
    from lerobot.datasets import LeRobotDataset

    output, source = export(foreign, "lerobot", tmp_path / "exported", progress=False), RecordedDataset(foreign)
    found = LeRobotDataset("local/exported", root=output, video_backend="pyav", return_uint8=True)
    assert (found.num_episodes, found.num_frames, found.fps) == (EPISODES, EPISODES * SAMPLES, 10)
    features, cameras = FEATURES[source.scenario], CAMERAS[source.scenario]
    exported = [name for name in found.meta.features if name == "action" or name.startswith("observation")]
    assert sorted(exported) == sorted([*features, *cameras, "action"])
    feature, names = ELEMENTS[source.scenario]
    assert found.meta.features[feature]["names"] == names
    errors = []
    for index in source.episodes:
        episode = source.read(index)
        for sample in range(SAMPLES):
            item = found[index * SAMPLES + sample]
            for feature, vectors in features.items():
                values = np.concatenate([episode.vectors[vector][sample] for vector in vectors])
                np.testing.assert_array_equal(item[feature].numpy(), values, feature)
            for feature, image in cameras.items():
                frame = item[feature].permute(1, 2, 0).numpy()
                errors.append(np.abs(frame.astype(int) - episode.images[image][sample]))
    assert np.mean(errors) < 1.5 and np.max(errors) < 60, (np.mean(errors), np.max(errors))


def test_a_foreign_robots_recording_opens_the_same_with_rerun(foreign, tmp_path):
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    from PIL import Image

    output, source = export(foreign, "rerun", tmp_path / "exported", progress=False), RecordedDataset(foreign)
    recordings = sorted(output.iterdir())
    assert len(recordings) == EPISODES
    subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "verify", *recordings], check=True, capture_output=True
    )
    for index, file in enumerate(recordings):
        episode, found = source.read(index), entities(file)
        vectors = {vector for part in FEATURES[source.scenario].values() for vector in part}
        assert vectors == set(vector_columns(source.layout))
        for vector in vectors:
            entity = found[f"/{vector}"]
            assert entity["sample"] == list(range(SAMPLES))
            np.testing.assert_array_equal(np.float32(entity["Scalars:scalars"]), episode.vectors[vector])
        for image in CAMERAS[source.scenario].values():
            entity = found["/world/camera" if image == "vision" else f"/world/{image}"]
            pictures = [blob[0] for blob in entity["EncodedImage:blob"]]
            frames = [np.array(Image.open(io.BytesIO(bytes(picture)))) for picture in pictures]
            np.testing.assert_array_equal(frames, episode.images[image])


def entities(path: Path) -> dict:
    """Every column of a recording that changes over time, by entity and component, and the timelines."""
    from rerun.chunk import RrdReader

    found = {}
    for chunk in RrdReader(path).stream():
        if not chunk.is_static:
            batch = chunk.to_record_batch()
            entity = found.setdefault(chunk.entity_path, {})
            for name in batch.schema.names:
                entity.setdefault(name, []).extend(batch[name].to_pylist())
    return found


def test_a_rerun_recording_opens_with_rerun_and_holds_the_same(dataset, tmp_path):
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    from PIL import Image

    output = export(dataset, "rerun", tmp_path / "exported", episodes=[1, 3], progress=False)
    recordings = sorted(output.iterdir())
    assert [file.name for file in recordings] == ["episode_00001.rrd", "episode_00003.rrd"]
    subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "verify", *recordings], check=True, capture_output=True
    )
    source = RecordedDataset(dataset)
    for index, file in zip([1, 3], recordings, strict=True):
        episode, found = source.read(index), entities(file)
        for vector in vector_columns(source.layout):
            entity = found[f"/{vector}"]
            assert entity["sample"] == list(range(SAMPLES))
            assert [time.total_seconds() for time in entity["time"]] == pytest.approx(episode.time)
            np.testing.assert_array_equal(np.float32(entity["Scalars:scalars"]), episode.vectors[vector])
        pictures = [blob[0] for blob in found["/world/camera"]["EncodedImage:blob"]]
        frames = [np.array(Image.open(io.BytesIO(bytes(picture)))) for picture in pictures]
        np.testing.assert_array_equal(frames, episode.images["vision"])
        assert [entity for entity in found if entity.startswith("/world/robot/finger_link_")] == sorted(
            f"/world/robot/finger_link_{link:02}" for link in range(20)
        )


def test_the_finger_in_space_is_where_the_camera_saw_it(dataset, tmp_path):
    """The recorded pose of a link, seen through the recorded camera, lies on a pixel of the link's color."""
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    from rerun.chunk import RrdReader

    file = export(dataset, "rerun", tmp_path / "exported", episodes=[2], progress=False) / "episode_00002.rrd"
    camera = {}
    for chunk in RrdReader(file).stream():
        if chunk.is_static and chunk.entity_path == "/world/camera":
            camera |= chunk.to_record_batch().to_pydict()
    position = np.array(camera["Transform3D:translation"][0][0])
    rotation = rotation_matrix(camera["Transform3D:quaternion"][0][0])
    focal, center = np.array(camera["Pinhole:image_from_camera"][0][0]).reshape(3, 3).T[[0, 0], [0, 2]]
    found, frames = entities(file), RecordedDataset(dataset).read(2).images["vision"]
    # The upper half of the finger, which no box hides; MuJoCo's camera looks along -z, with y up.
    for link in range(10):
        for sample, translation in enumerate(
            found[f"/world/robot/finger_link_{link:02}"]["Transform3D:translation"]
        ):
            x, y, z = rotation.T @ (np.array(translation[0]) - position)
            column, row = center + focal * x / -z, center - focal * y / -z
            red, _, blue = frames[sample, int(row), int(column)].astype(int)
            # The finger runs from yellow to crimson; everything else is gray, blue or green.
            assert red > blue + 50, (link, sample, frames[sample, int(row), int(column)])


def test_the_links_in_space_hang_together(dataset, tmp_path):
    """Each capsule ends where the next begins, whichever way the finger is bent."""
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    from rerun.chunk import RrdReader

    file = export(dataset, "rerun", tmp_path / "exported", episodes=[0], progress=False) / "episode_00000.rrd"
    begins = {}
    for chunk in RrdReader(file).stream():
        if chunk.is_static and "finger_link" in chunk.entity_path:
            shape = chunk.to_record_batch().to_pydict()
            begins[chunk.entity_path] = np.array(shape["Capsules3D:translations"][0][0])
            assert shape["Capsules3D:lengths"][0] == pytest.approx([0.05])
            assert shape["Capsules3D:radii"][0] == pytest.approx([0.045])
    assert len(begins) == 20
    found = entities(file)
    for sample in range(SAMPLES):
        ends = []
        for link in sorted(begins):
            position = np.array(found[link]["Transform3D:translation"][sample][0])
            rotation = rotation_matrix(found[link]["Transform3D:quaternion"][sample][0])
            # Rerun's capsule goes from where it begins along its z, which points up the finger.
            lower, upper = begins[link], begins[link] + [0, 0, 0.05]
            ends.append((position + rotation @ upper, position + rotation @ lower))
        for (_, lower), (upper, _) in zip(ends, ends[1:], strict=False):
            np.testing.assert_allclose(lower, upper, atol=1e-6)


def rotation_matrix(quaternion) -> np.ndarray:
    """Of a unit quaternion x, y, z, w."""
    x, y, z, w = quaternion
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


@pytest.mark.parametrize(
    ("problem", "error", "words"),
    [
        ("format", ValueError, "format: 'hdf5' is unknown; the formats are lerobot, rerun"),
        ("folder", FileNotFoundError, "contains no dataset"),
        ("episode", ValueError, "has 0 to 3; 7 is none of them"),
        ("no episode", ValueError, "none is named"),
        ("missing", FileNotFoundError, "1 of 4 episodes .* are not there, the first is 2"),
        ("output", FileExistsError, "exists already"),
        ("old", ValueError, "is in format 1; this version reads format 2"),
        ("model", ValueError, "was simulated with another model"),
        ("damaged", DamagedError, "episode_00003.parquet is damaged: .* its SHA-256 differs"),
        ("swapped", DamagedError, "episode_00003.parquet is damaged: it is not episode 3"),
        ("cut", DamagedError, "episode_00003.parquet is damaged: it has no seal"),
    ],
)
def test_a_mistake_is_an_error_with_reason_and_leaves_nothing(
    dataset, tmp_path, problem, error, words
):
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    (tmp_path / "datasets").mkdir()
    folder, last = copy(dataset, tmp_path / "datasets"), "episode_00003.parquet"
    arguments = {"format": "rerun", "episodes": None, "output": tmp_path / "out/exported"}
    if problem == "format":
        arguments["format"] = "hdf5"
    elif problem == "folder":
        folder = tmp_path
    elif problem == "episode":
        arguments["episodes"] = [0, 7]
    elif problem == "no episode":
        arguments["episodes"] = []
    elif problem == "missing":
        (folder / "episode_00002.parquet").unlink()
    elif problem == "output":
        arguments["output"] = folder
    elif problem in ("old", "model"):
        description = json.loads((folder / "dataset.json").read_text())
        description |= {"format": 1} if problem == "old" else {"model_sha256": "0" * 64}
        (folder / "dataset.json").write_text(json.dumps(description))
    elif problem == "swapped":
        (folder / last).write_bytes((folder / "episode_00000.parquet").read_bytes())
    else:
        data = bytearray((folder / last).read_bytes())
        data[len(data) // 2] ^= 1
        (folder / last).write_bytes(data if problem == "damaged" else data[: len(data) // 2])
    with pytest.raises(error, match=words):
        export(folder, progress=False, **arguments)
    out = tmp_path / "out"
    assert not out.exists() or not list(out.iterdir())


def test_the_command_says_what_is_wrong_in_one_line(dataset, tmp_path):
    command = [
        sys.executable,
        "-m",
        "harness.export",
        "--format",
        "rerun",
        tmp_path / "nowhere",
        tmp_path / "exported",
    ]
    answer = subprocess.run(command, capture_output=True, text=True, check=False)
    assert answer.returncode == 1 and answer.stdout == ""
    assert answer.stderr.startswith("error: ") and answer.stderr.count("\n") == 1, answer.stderr
