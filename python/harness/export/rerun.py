"""Writes Rerun recordings: one .rrd per episode, with all modalities over time and the robot in space."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from harness.recorded import FINGER, Episode, Layout, RecordedDataset, image_shapes, vector_columns

try:
    import mujoco
    import rerun as rr
    import rerun.blueprint as rrb
    from PIL import Image
except ImportError as error:
    raise ImportError(
        f"exporting to Rerun needs the package rerun-sdk: pip install rerun-sdk ({error})"
    ) from error

MODELS = Path(__file__).parent.parent / "models"

# As integers, because the model's arrays contain integers.
CAPSULE, CYLINDER, BOX = (
    int(getattr(mujoco.mjtGeom, name)) for name in ("mjGEOM_CAPSULE", "mjGEOM_CYLINDER", "mjGEOM_BOX")
)


def write(source: RecordedDataset, episodes: Iterable[Episode], output: Path) -> None:
    """Writes each episode as a recording, `output/episode_00000.rrd`, over the timelines `time` and `sample`.

    The finger's pose in space is computed from the recorded joint angles with the model's kinematics. Other robots are
    not shown in space. The boxes of the cluttered scenario are not shown in space either, because datasets do not
    contain their poses. They are visible in the camera's frames.

    Raises:
        ValueError: the dataset was simulated with another model than the one in this package.
    """
    # Without strict mode, Rerun warns of a wrong value and leaves it out.
    rr.set_strict_mode(True)
    layout = source.layout
    robot = Robot(source) if source.is_finger else None
    output.mkdir()
    for episode in episodes:
        recording = rr.RecordingStream("harness", recording_id=f"{source.name}-episode-{episode.index:05}")
        with recording:
            recording.save(output / f"episode_{episode.index:05}.rrd", default_blueprint=_blueprint(layout))
            recording.send_recording_name(f"{source.name}, episode {episode.index}")
            _send_vectors(recording, episode, layout)
            _send_images(recording, episode)
            if robot:
                robot.send(recording, episode)
        recording.disconnect()


def _timelines(episode: Episode) -> list[rr.TimeColumn]:
    return [
        rr.TimeColumn("time", duration=episode.time),
        rr.TimeColumn("sample", sequence=np.arange(len(episode))),
    ]


def _send_vectors(recording: rr.RecordingStream, episode: Episode, layout: Layout) -> None:
    """Sends each vector as an entity with its name. Its elements are series with the columns' names and units."""
    for vector, columns in vector_columns(layout).items():
        series = [f"{column.name} [{column.unit}]" for column in columns]
        recording.log(vector, rr.SeriesLines(names=series), static=True)
        values = rr.Scalars.columns(scalars=episode.vectors[vector].astype(np.float64))
        recording.send_columns(vector, _timelines(episode), values)


def _send_images(recording: rr.RecordingStream, episode: Episode) -> None:
    for name, frames in episode.images.items():
        pictures = [_png(frame) for frame in frames]
        columns = rr.EncodedImage.columns(blob=pictures, media_type=["image/png"] * len(pictures))
        recording.send_columns(_entity(name), _timelines(episode), columns)


def _entity(image: str) -> str:
    """Returns the entity path of an image. The finger's camera is an entity with a pose in the world."""
    return "world/camera" if image == "vision" else f"world/{image}"


def _png(frame: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(frame).save(buffer, "PNG")
    return buffer.getvalue()


def _blueprint(layout: Layout) -> rrb.Blueprint:
    """Returns the viewer's initial arrangement: the robot in space, the frames and the series."""
    series = [rrb.TimeSeriesView(name=vector.replace("_", " "), origin=vector) for vector in vector_columns(layout)]
    space = rrb.Spatial3DView(name="robot", origin="world")
    frames = [rrb.Spatial2DView(name=name, origin=_entity(name)) for name in image_shapes(layout)]
    plots = rrb.Vertical(*series)
    left = rrb.Vertical(space, *frames, row_shares=[2, *(1 for _ in frames)])
    return rrb.Blueprint(rrb.Horizontal(left, plots), collapse_panels=True)


class Robot:
    """The geoms of the arm and the finger in space, computed by forward kinematics of the dataset's model."""

    def __init__(self, source: RecordedDataset):
        path = MODELS / f"{source.scenario}.xml"
        if hashlib.sha256(path.read_bytes()).hexdigest() != source.description["model_sha256"]:
            raise ValueError(
                f"{source.name} was simulated with another model than {path.name} of this version"
            )
        self.model = mujoco.MjModel.from_xml_path(str(path))
        self.data = mujoco.MjData(self.model)
        columns = vector_columns(source.layout)
        joints = [column.name for column in columns["arm"]]
        joints += [f"finger_joint_{index:02}" for index in range(len(columns["proprioception"]))]
        self.positions = [self.model.joint(name).qposadr[0] for name in joints]
        self.geoms = [geom for geom in range(self.model.ngeom) if self._is_robots(geom)]

    def _is_robots(self, geom: int) -> bool:
        """Returns whether a geom's pose can be computed from the recorded joints. A box's pose can't."""
        body = self.model.geom_bodyid[geom]
        moves_freely = self.model.body_dofnum[body] == 6
        return self.model.geom_type[geom] in (CAPSULE, CYLINDER, BOX) and not moves_freely

    def poses(self, episode: Episode) -> tuple[np.ndarray, np.ndarray]:
        """Positions of the geoms, m [geoms, samples, 3], and their orientations, quaternions [geoms, samples, 4]."""
        angles = np.concatenate([episode.vectors["arm"], episode.vectors["proprioception"]], axis=1)
        positions = np.empty((len(self.geoms), len(episode), 3))
        orientations = np.empty((len(self.geoms), len(episode), 4))
        quaternion = np.empty(4)
        for sample, row in enumerate(angles):
            self.data.qpos[self.positions] = row
            mujoco.mj_kinematics(self.model, self.data)
            for place, geom in enumerate(self.geoms):
                mujoco.mju_mat2Quat(quaternion, self.data.geom_xmat[geom])
                positions[place, sample] = self.data.geom_xpos[geom]
                orientations[place, sample] = np.roll(quaternion, -1)
        return positions, orientations

    def send(self, recording: rr.RecordingStream, episode: Episode) -> None:
        """Sends every geom with its pose at each sample, and the ground and the camera."""
        recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self._send_surroundings(recording)
        positions, orientations = self.poses(episode)
        for place, geom in enumerate(self.geoms):
            entity = f"world/robot/{self.model.geom(geom).name}"
            recording.log(entity, self._shape(geom), static=True)
            pose = rr.Transform3D.columns(translation=positions[place], quaternion=orientations[place])
            recording.send_columns(entity, _timelines(episode), pose)

    def _shape(self, geom: int) -> rr.AsComponents:
        """Returns a geom's shape around its own origin. MuJoCo's sizes are radii and half lengths, m."""
        size, color = self.model.geom_size[geom], self.model.geom_rgba[geom]
        kind = self.model.geom_type[geom]
        if kind == BOX:
            return rr.Boxes3D(half_sizes=[size], colors=[color], fill_mode="solid")
        lengths, radii = [2 * size[1]], [size[0]]
        if kind == CYLINDER:
            return rr.Cylinders3D(lengths=lengths, radii=radii, colors=[color], fill_mode="solid")
        # Rerun's capsule starts at its origin. MuJoCo's origin is in the middle of the capsule.
        middle = [[0, 0, -size[1]]]
        return rr.Capsules3D(
            lengths=lengths, radii=radii, translations=middle, colors=[color], fill_mode="solid"
        )

    def _send_surroundings(self, recording: rr.RecordingStream) -> None:
        ground, camera = self.model.geom("ground"), self.model.camera("external")
        surface = rr.Boxes3D(half_sizes=[[3, 3, 0.001]], colors=[ground.rgba], fill_mode="solid")
        recording.log("world/ground", surface, static=True)
        quaternion = np.roll(camera.quat, -1)
        recording.log(
            "world/camera", rr.Transform3D(translation=camera.pos, quaternion=quaternion), static=True
        )
        height, width, _ = image_shapes(FINGER)["vision"]
        pinhole = rr.Pinhole(
            # pixels, from the vertical field of view, degrees
            focal_length=float(0.5 * height / np.tan(0.5 * np.radians(camera.fovy[0]))),
            width=width,
            height=height,
            # MuJoCo's cameras look along their negative z axis, with x to the right and y up.
            camera_xyz=rr.ViewCoordinates.RUB,
            image_plane_distance=1.0,
        )
        recording.log("world/camera", pinhole, static=True)
