"""Imports recordings as datasets: LeRobot datasets, Parquet, CSV, HDF5, zarr, MATLAB, NumPy files, videos, ROS 2 bags.

`import_dataset` does the same as the command

    harness import MAPPING.yaml

It returns the dataset's name, which specs use as a scenario: `scenarios: [lab_finger-0123456789abcdef]`. The mapping
defines which columns of the recording make up which modality:

    name: lab_finger                # the dataset becomes results/datasets/lab_finger-HASH
    source: recordings              # a LeRobot dataset's folder, a Parquet file, or a folder of Parquet files
    format: lerobot                 # or parquet
    modalities:
      setpoint: action                            # where the robot was commanded to be at the sample; or `none`
      proprioception: observation.state[0:20]     # elements of a column of lists
      arm: [rotation, lift, extension]            # several columns
      contact_force: force_??                     # all columns that match a pattern of * and ?, in the file's order
      contact_force_mean: {from: mean_??, scale: 9.81}      # values are multiplied by one factor, or one per element
      vision: observation.images.external         # pictures of any size
      touch: {from: "pad_?", unit: N}             # any other name is a new vector, with its unit
      wrist: {from: observation.images.wrist, size: [96, 96]}     # or a new image, with its rows and columns
      state: {from: grasp_state, categories: [open, closed]}      # or categories, of which a sample has one
      object: {label: object}                     # or the values of a label of the trials
    # These keys are required with `format: parquet`, and not allowed otherwise.
    episode: episode                # the column whose value differs between episodes
    order: sample                   # the column by which an episode's rows are sorted: a counter, or a time
    sample_rate_hz: 10              # samples per second

The formats csv, hdf5, zarr, matlab, numpy and ros2 have streams with times of their own, which are aligned to one rate.
So has parquet, if the mapping has `streams`:

    format: ros2
    sample_rate_hz: 10
    max_gap_s: 0.5                  # a longer gap is refused; `gaps: split` begins a new episode there
    streams:
      joints: {topic: /joint_states}
      force: {topic: /wrench, align: mean}
    modalities:
      setpoint: joints.position
      force: {from: force.wrench.force, unit: N}

docs/exchange.md describes their keys. `harness import --inspect FILE` writes a first mapping, and
`harness report --dataset NAME` a page with every modality of the dataset.

`source` is relative to the mapping's folder. `modalities` must have `setpoint` and at least one other. `setpoint: none`
is a recording without commands, whose models get no action. Vectors may have any width. The names of the finger's
modalities have a fixed meaning. Their values must be in rad, m and N, after they have been multiplied by `scale`.
`vision` is an image, which is resized to 64 x 64 pixels unless it has a `size`. A
recording needs at least one episode with at least 2 samples.

A row of a LeRobot dataset contains an observation and the action that is sent after it. Its `action` is therefore the
setpoint of the next sample. `setpoint: {from: COLUMN, shift: 1}` says so: each sample gets the value of the row before,
and the first row of each episode is left out. Columns of a LeRobot dataset that begin with `action` have `shift: 1`
unless the mapping says `shift: 0`, and all other columns have `shift: 0`.

The module needs the packages of the extra `import`: `pip install 'soft-harness[import]'`. It needs av, h5py, rosbags,
scipy and zarr only for the formats that they read. For LeRobot datasets, it also needs the package lerobot.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from harness import _harness
from harness.recorded import Episode

try:
    import PIL  # noqa: F401
    from tqdm import tqdm
except ImportError as error:
    raise ImportError(f"importing needs the packages pillow and tqdm: pip install pillow tqdm ({error})") from error

from .conversion import episode_of
from .lerobot import open_lerobot
from .mapping import Mapping, MappingError
from .parquet import open_parquet
from .recording import Recording, open_streams
from .writing import write_dataset

__all__ = ["MappingError", "import_dataset"]


def import_dataset(
    mapping: str | os.PathLike[str], results: str | os.PathLike[str] = "results", *, progress: bool = True
) -> str:
    """Imports a recording as a dataset. One episode at a time is in memory, but the whole of Parquet files.

    Args:
        mapping: the YAML file that says what to import; see `harness.importing`.
        results: the folder of datasets and runs. The dataset is written to `datasets` in it, unless it is there
            already.
        progress: shows a progress bar on stderr.

    Returns:
        The dataset's name, which ends in a hash of its content. Specs use it in `scenarios`.

    Raises:
        MappingError: the mapping or the recording is wrong. The message says where. A MappingError is a ValueError.
        FileNotFoundError: the mapping or its source does not exist.
        ImportError: the package that reads the format is not installed.
        OSError: the results folder can't be written.

    Example:
        >>> import polars
        >>> from pathlib import Path
        >>> from harness.importing import import_dataset
        >>> columns = {"trial": [0, 0, 1, 1, 2, 2], "row": [0, 1] * 3}
        >>> columns |= {"command": [0.0, 0.1] * 3, "angle": [0.0, 0.2] * 3}
        >>> polars.DataFrame(columns).write_parquet("lab.parquet")
        >>> keys = "name: lab, source: lab.parquet, format: parquet, episode: trial, order: row, sample_rate_hz: 10"
        >>> modalities = "{setpoint: command, bend: {from: angle, unit: rad}}"
        >>> _ = Path("lab.yaml").write_text(f"{{{keys}, modalities: {modalities}}}")
        >>> import_dataset("lab.yaml", progress=False)
        'lab-...'
    """
    done = run_import(Path(mapping), Path(results), progress)
    for note in done.notes:
        warnings.warn(f"{done.name}: {note}", stacklevel=2)
    return done.name


@dataclass(frozen=True)
class Import:
    """What an import has done."""

    name: str
    """The dataset's name."""
    recording: Recording
    """The recording, whose episodes are read."""
    split: str
    """How runs divide the dataset, in a sentence."""
    notes: list[str]
    """What may be wrong with it, in sentences."""
    cleaned: list[str]
    """What was left out or changed, with how much."""


def run_import(path: Path, results: Path, progress: bool) -> Import:
    """Imports a recording as `import_dataset` does, and returns what is known about it."""
    mapping = Mapping.load(path)
    try:
        recording = _open(mapping, progress)
    except MappingError as error:
        raise MappingError(f"{path}: {error}") from None
    episodes = _episodes(path, mapping, recording, progress)
    name = write_dataset(mapping, recording, episodes, results, progress)
    split, notes = _harness.recording_notes(results / "datasets", name)
    return Import(name, recording, split, notes, mapping.counts.lines)


def _open(mapping: Mapping, progress: bool) -> Recording:
    if mapping.sampling:
        return open_streams(mapping, mapping.sampling, progress)
    return open_parquet(mapping, mapping.rows) if mapping.rows else open_lerobot(mapping)


def _episodes(path: Path, mapping: Mapping, recording: Recording, progress: bool) -> Iterator[Episode]:
    """Yields the episodes of a recording. Shows how many are done."""
    count = 0
    bar = tqdm(
        desc=mapping.name,
        total=recording.length,
        bar_format="{desc}: {percentage:3.0f}%|{bar}| {n:.1f}/{total} episodes [{elapsed}<{remaining}]",
        file=sys.stderr,
        disable=not progress,
    )
    try:
        with bar:
            for place, labels, columns in zip(recording.places, recording.labels, recording.episodes, strict=True):
                try:
                    episode = episode_of(count, columns(), mapping, recording.sample_rate_hz, bar.update)
                except MappingError as error:
                    message = f"{place}: episode {count}: {error}"
                    if mapping.text.get("bad_episodes") != "skip":
                        raise MappingError(message) from None
                    mapping.counts.note_episode(message)
                    continue
                count += 1
                episode.labels.update(labels)
                yield episode
        if count == 0:
            raise MappingError("; ".join(["no episode was found", *mapping.counts.lines]))
    except MappingError as error:
        raise MappingError(f"{path}: {error}") from None
