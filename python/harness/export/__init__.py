"""Writes datasets for other programs, as LeRobot datasets or Rerun recordings.

`export` does the same as the command

    harness export --format lerobot results/datasets/empty-0123456789abcdef exported

Each format needs its own Python packages: `pip install 'soft-harness[lerobot]'` or `pip install 'soft-harness[rerun]'`.
The functions `harness.export_mlflow` and `harness.export_tensorboard` write runs, and `harness.export_onnx` a network.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from harness._unfinished import unfinished_folder
from harness.recorded import Episode, RecordedDataset

__all__ = ["FORMATS", "export"]

FORMATS = ("lerobot", "rerun")
"""The formats of datasets."""


def export(
    dataset: str | os.PathLike[str],
    format: str,
    output: str | os.PathLike[str],
    episodes: Iterable[int] | None = None,
    *,
    progress: bool = True,
) -> Path:
    """Writes a simulated dataset in the format of another program.

    Args:
        dataset: the dataset's folder, such as `results/datasets/empty-0123456789abcdef`.
        format: `lerobot` for a LeRobot dataset of version 3, or `rerun` for a folder with a Rerun recording (.rrd) of
            each episode.
        output: the folder to write, which must not exist. It appears only after all files are written.
        episodes: indices of the episodes to export. The default is all.
        progress: shows a progress bar on stderr.

    Returns:
        The folder that was written.

    Raises:
        ValueError: the format is unknown or can't hold the dataset, the dataset was imported or does not have an
            episode, or a file is damaged.
        FileNotFoundError: there is no dataset, or an episode is not collected yet.
        FileExistsError: the output exists already.
        ImportError: a package that the format needs is not installed. The message names it.

    Example:
        >>> from harness.export import export
        >>> model = harness.load_model("smoke/empty-z4")
        >>> export(f"results/datasets/{model.dataset}", "lerobot", "exported", progress=False)    # needs lerobot
        PosixPath('exported')
    """
    if format not in FORMATS:
        raise ValueError(f"format: '{format}' is unknown; the formats are {', '.join(FORMATS)}")
    source, output = RecordedDataset(Path(dataset)), Path(output)
    chosen = source.choose(episodes)
    if output.exists():
        raise FileExistsError(f"{output} exists already; name a new folder, or remove it")
    writer = importlib.import_module(f"{__name__}.{format}")
    output.parent.mkdir(parents=True, exist_ok=True)
    with unfinished_folder(output.parent, output.name) as unfinished:
        written = unfinished / output.name
        writer.write(source, _read(source, chosen, format if progress else None), written)
        written.rename(output)
    return output


def _read(source: RecordedDataset, episodes: list[int], what: str | None) -> Iterator[Episode]:
    """Reads one episode after the other, and advances the progress bar `what` after each."""
    samples = len(episodes) * source.samples_per_episode
    with bar(samples, what, " samples", what is not None) as shown:
        for index in episodes:
            episode = source.read(index)
            yield episode
            shown.update(len(episode))


def bar(total: int, what: str | None, unit: str, progress: bool) -> Any:
    """Returns a progress bar on stderr, which counts up to `total`."""
    # Imported only here, because the command can export a network without this package.
    try:
        from tqdm import tqdm
    except ImportError as error:
        raise ImportError(f"exporting needs the package tqdm: pip install tqdm ({error})") from error
    return tqdm(total=total, desc=what, unit=unit, file=sys.stderr, disable=not progress)
