"""Writes datasets as files of other projects: LeRobot datasets and Rerun recordings.

harness export --format lerobot results/datasets/empty-0123456789abcdef exported

The modules `mlflow` and `tensorboard` write runs; see `harness.export_mlflow` and `harness.export_tensorboard`.
"""

from __future__ import annotations

import importlib
import shutil
import sys
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

from harness.recorded import Episode, RecordedDataset

try:
    from tqdm import tqdm as tqdm
except ImportError as error:
    raise ImportError(f"exporting needs the package tqdm: pip install tqdm ({error})") from error

FORMATS = ("lerobot", "rerun")


def export(
    dataset: str | Path,
    format: str,
    output: str | Path,
    episodes: Iterable[int] | None = None,
    *,
    progress: bool = True,
) -> Path:
    """Writes a recorded dataset in the format of another project.

    Args:
        dataset: the dataset's folder, `results/datasets/SCENARIO-HASH`.
        format: `lerobot` for a LeRobot dataset of version 3, or `rerun` for a folder with one .rrd recording per episode.
        output: the folder to write, which must not exist. It appears only after all files are written.
        episodes: the episodes to export; all of them if None.
        progress: whether to show a progress bar on stderr.

    Returns:
        `output`.

    Raises:
        ValueError: the format is unknown, the dataset does not have an episode, or a file is damaged.
        FileNotFoundError: there is no dataset, or an episode is not collected yet.
        FileExistsError: `output` exists already.
        ImportError: a package that the format needs is not installed; the message names it.
    """
    if format not in FORMATS:
        raise ValueError(f"format: '{format}' is unknown; the formats are {', '.join(FORMATS)}")
    source, output = RecordedDataset(dataset), Path(output)
    chosen = source.choose(episodes)
    if output.exists():
        raise FileExistsError(f"{output} is there already; name a new folder, or remove it")
    writer = importlib.import_module(f"{__name__}.{format}")
    output.parent.mkdir(parents=True, exist_ok=True)
    unfinished = Path(tempfile.mkdtemp(prefix=f".unfinished-{output.name}-", dir=output.parent))
    try:
        written = unfinished / output.name
        writer.write(source, _read(source, chosen, format if progress else None), written)
        written.rename(output)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    return output


def _read(source: RecordedDataset, episodes: list[int], what: str | None) -> Iterator[Episode]:
    """Reads one episode after the other, and advances the progress bar `what` after each."""
    samples = len(episodes) * source.samples_per_episode
    with tqdm(total=samples, desc=what, unit=" samples", file=sys.stderr, disable=what is None) as bar:
        for index in episodes:
            episode = source.read(index)
            yield episode
            bar.update(len(episode))
