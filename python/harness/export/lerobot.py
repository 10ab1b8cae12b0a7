"""Writes LeRobot datasets of version 3 (Parquet, MP4 and metadata) with LeRobot's own writer."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from harness._paths import plain_path
from harness.recorded import Episode, Layout, RecordedDataset, image_shapes, vector_columns

try:
    import av
    import datasets
    from lerobot.configs import RGBEncoderConfig
    from lerobot.datasets import LeRobotDataset
except ImportError as error:
    raise ImportError(
        f"exporting to LeRobot needs the package lerobot: pip install 'lerobot[dataset]' ({error})"
    ) from error

STATE = ("proprioception", "arm")
"""The vectors that become LeRobot's `observation.state`, if a dataset has both."""


def features_of(layout: Layout) -> dict[str, tuple[str, ...]]:
    """Returns LeRobot's features, each with the vectors that are concatenated for it.

    A row of a LeRobot dataset contains an observation and the action that is sent after it. `observation.setpoint` is
    therefore the setpoint of the row's sample, and `action` is that of the next one. In an episode's last row, which no
    sample follows, `action` is the last setpoint again.
    """
    vectors = vector_columns(layout)
    state: tuple[str, ...] = STATE if all(name in vectors for name in STATE) else ()
    others = [name for name in vectors if name not in state]
    features: dict[str, tuple[str, ...]] = {"observation.state": state} if state else {}
    features |= {f"observation.{name}": (name,) for name in others}
    return features | {"action": ("setpoint",)}


def cameras_of(layout: Layout) -> dict[str, str]:
    """Returns the LeRobot feature of each image. The feature of `vision` is named `external`, after the camera."""
    names = {name: "external" if name == "vision" else name for name in image_shapes(layout)}
    return {image: f"observation.images.{name}" for image, name in names.items()}


# The finger is two or three pixels wide. LeRobot's own settings change colors of the cluttered scene by up to 208 of
# 255. These settings change them by up to 16 (mean 0.7), at 2 KB per frame. The full color resolution (4:4:4) matters
# most. ffmpeg can play it, but few browsers can.
VIDEO = {"vcodec": "h264", "pix_fmt": "yuv444p", "crf": 1}


def write(source: RecordedDataset, episodes: Iterable[Episode], output: Path) -> None:
    """Writes episodes as a LeRobot dataset. The numbers are exact; the frames are compressed by H.264.

    Raises:
        ValueError: the dataset's sample rate is not a whole number, as LeRobot requires.
    """
    if source.sample_rate_hz % 1 != 0:
        raise ValueError(
            f"LeRobot's frames a second are a whole number; {source.name} has {source.sample_rate_hz} Hz"
        )
    # Both libraries would print messages for every episode next to the progress bar.
    datasets.disable_progress_bars()
    av.logging.set_libav_level(av.logging.ERROR)
    with plain_path(output.parent) as folder:
        written = folder / "written"
        dataset = LeRobotDataset.create(
            repo_id=f"harness/{source.name}",
            fps=int(source.sample_rate_hz),
            features=_features(source.layout),
            root=written,
            robot_type="soft_finger" if source.is_finger else source.scenario,
            # Sets the decoder, which is not used here. Without it, LeRobot searches for the fastest decoder and warns
            # of missing ones.
            video_backend="pyav",
            rgb_encoder=RGBEncoderConfig(**VIDEO),
        )
        task = f"random motion, {source.scenario} scenario"
        for episode in episodes:
            _add(dataset, episode, task, source.layout)
        dataset.finalize()
        written.rename(output)


def _features(layout: Layout) -> dict[str, dict[str, Any]]:
    """Returns LeRobot's description of the features. Elements have the columns' names with their units."""
    columns, features = vector_columns(layout), {}
    for feature, vectors in features_of(layout).items():
        names = [f"{column.name} [{column.unit}]" for vector in vectors for column in columns[vector]]
        features[feature] = {"dtype": "float32", "shape": (len(names),), "names": names}
    shapes = image_shapes(layout)
    for image, feature in cameras_of(layout).items():
        features[feature] = {"dtype": "video", "shape": shapes[image], "names": ["height", "width", "channels"]}
    return features


def _add(dataset: LeRobotDataset, episode: Episode, task: str, layout: Layout) -> None:
    rows = {
        feature: np.concatenate([episode.vectors[vector] for vector in vectors], axis=1)
        for feature, vectors in features_of(layout).items()
    }
    rows["action"] = np.concatenate([rows["action"][1:], rows["action"][-1:]])
    rows |= {feature: episode.images[image] for image, feature in cameras_of(layout).items()}
    for sample in range(len(episode)):
        dataset.add_frame({feature: values[sample] for feature, values in rows.items()} | {"task": task})
    dataset.save_episode()
