"""A research harness for multi-modal perception of a soft robot.

An arm presses a soft finger on the ground and into boxes in a simulation. Conditional variational auto-encoders are
trained on the recorded data. The simulation, the training and the tables are written in Rust, and this package makes
them available in Python:

- `run` does an experiment, `collect` only simulates its datasets. `query` queries the tables.
- `compare` computes means over seeds, `claims` judges the paper's statements, `figures` draws the paper's figures, and
  `verify` checks all files.
- `export_mlflow` and `export_tensorboard` write runs to the trackers of other projects.
- `Dataset` opens a dataset, `load_model` opens a trained network. `load_network` opens it for PyTorch, and
  `export_onnx` writes it for other programs.
- `harness.environments` has the finger as a `dm_env.Environment`, `harness.gymnasium` as Gymnasium environments.
- `SimulationBatch` is one simulation or many, stepped by setpoints.

Units are SI. Long calls let other threads run, and Ctrl-C stops them. The next call of `run` continues from there.
"""

import importlib.metadata
import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

# As in the program: the thread that requests a frame renders it, and candle starts no threads of its own. Mesa and
# candle read these variables at their first use. A value that is already set is kept.
os.environ.setdefault("LP_NUM_THREADS", "0")
os.environ.setdefault("CANDLE_NUM_THREADS", "1")

from . import _mujoco

_mujoco.load()

from . import _harness
from ._harness import Model, SimulationBatch

if TYPE_CHECKING:
    import numpy as np
    import polars
    from numpy.typing import NDArray

    from .networks import Network
    from .torch import Transitions

__all__ = [
    "Dataset",
    "Exported",
    "Model",
    "Problem",
    "SimulationBatch",
    "Summary",
    "claims",
    "collect",
    "compare",
    "export_mlflow",
    "export_onnx",
    "export_tensorboard",
    "figures",
    "load_model",
    "load_network",
    "query",
    "run",
    "verify",
]

__version__ = importlib.metadata.version("soft-harness")


class Summary(NamedTuple):
    """Numbers of an experiment's runs, by what `run` did with them."""

    done: int
    """Runs that this call completed."""
    skipped: int
    """Runs that were done before, or by another process."""


class Exported(NamedTuple):
    """Numbers of runs, by what an export did with them."""

    exported: int
    """Runs that this call wrote."""
    skipped: int
    """Runs that were there before and have not changed since."""


def run(
    path: str | os.PathLike[str],
    overrides: Mapping[str, Any] | None = None,
    *,
    quick: bool = False,
    results: str | os.PathLike[str] = "results",
    progress: bool = True,
    jobs: int = 1,
    memory: float | None = None,
) -> Summary:
    """Does every run of an experiment that isn't done yet, as `harness run` does.

    path: the experiment's YAML file. overrides: settings to change, by dotted key: `{"training.epochs": 5}`; instead of
    a list with one item, the item can be given. quick: applies the spec's `quick` settings. results: the folder of
    datasets and runs. progress: draws bars on the terminal. jobs: number of runs of a scenario to train at once.
    memory: a dataset's frames are kept in memory if they take at most this many GB, otherwise on disk; the default is
    an eighth of the free memory.

    Raises FileNotFoundError if there is no such file, ValueError if the spec is wrong (with file, line and column, or
    the override), RuntimeError with the reasons if some run failed, and KeyboardInterrupt if it is interrupted. After
    an interruption, the same call continues.
    """
    if jobs < 1:
        raise ValueError(f"jobs: {jobs} must be at least 1")
    if memory is not None and not 0 <= memory <= 1e9:
        raise ValueError(f"memory: {memory} must be a number of gigabytes")
    frames = None if memory is None else int(memory * 1e9)
    return Summary(*_harness.run(Path(path), _changes(overrides), quick, Path(results), progress, jobs, frames))


def collect(
    path: str | os.PathLike[str],
    overrides: Mapping[str, Any] | None = None,
    *,
    quick: bool = False,
    results: str | os.PathLike[str] = "results",
    progress: bool = True,
) -> dict[Path, int]:
    """Simulates the missing episodes of an experiment's datasets, as `harness collect` does, without training.

    The arguments are those of `run`. Returns the number of episodes that this call simulated, by the dataset's folder.
    Raises the same errors as `run`. After an interruption, the same call continues.
    """
    return dict(_harness.collect(Path(path), _changes(overrides), quick, Path(results), progress))


def _changes(overrides: Mapping[str, Any] | None) -> list[str]:
    """Overrides as on the command line."""
    return [f"{key}={json.dumps(value)}" for key, value in (overrides or {}).items()]


def _settings(where: Mapping[str, Any] | None) -> list[str]:
    """Settings that runs must have, as on the command line."""
    wanted = (where or {}).items()
    return [f"{key}={value if isinstance(value, str) else json.dumps(value)}" for key, value in wanted]


def query(sql: str, results: str | os.PathLike[str] = "results") -> "polars.DataFrame":
    """Answers an SQL query over the tables of a results folder, as `harness query` does, without copying the answer.

    The tables are runs, epochs, metrics, predictions, forces, frames and episodes. `harness schema --tables` lists
    their columns with units. Raises ValueError if the query is wrong or not supported, RuntimeError if a table is
    damaged, and FileNotFoundError if there is no results folder. Warns of each run or dataset that is left out.
    """
    import polars

    return polars.DataFrame(_harness.query(sql, Path(results)))


def compare(
    *experiments: str,
    where: Mapping[str, Any] | None = None,
    results: str | os.PathLike[str] = "results",
) -> "polars.DataFrame":
    """Computes means of metrics over seeds with 95 % intervals (Student's t), as `harness compare` does.

    experiments: names of experiments; all of them by default. where: settings that the runs must have, by dotted key:
    `{"training.batch_size": 64}`. results: the folder of datasets and runs.

    A row is a metric over all joints, links or pixels, of runs that differ only in their seed. If the runs of an
    experiment differ in other settings than scenario, latent size and variant, the column `settings` contains these.
    Baselines have no latent size. Raises KeyError if an experiment has no finished runs, ValueError if no run has a
    setting of `where`, and RuntimeError if a table is damaged.
    """
    import polars

    return polars.DataFrame(_harness.compare(list(experiments), _settings(where), Path(results)))


def claims(
    *names: str,
    file: str | os.PathLike[str] = "experiments/claims.yaml",
    quick: bool = False,
    where: Mapping[str, Any] | None = None,
    results: str | os.PathLike[str] = "results",
) -> "polars.DataFrame":
    """Judges which of the paper's statements hold, as `harness claims --output` does: a row for each verdict.

    names: claims to judge; all of them by default. file: the file of claims. quick: judges by the quick runs of the
    experiments. where: settings that the runs must have, as in `compare`. results: the folder of datasets and runs.

    Raises FileNotFoundError if there is no such file, and ValueError for an unknown claim or a wrong file.
    """
    import polars

    return polars.DataFrame(_harness.claims(list(names), Path(file), quick, _settings(where), Path(results)))


def figures(
    *names: str,
    folder: str | os.PathLike[str] = "figures",
    formats: Iterable[str] = ("svg", "png", "csv"),
    quick: bool = False,
    single: str | None = None,
    multi: str | None = None,
    where: Mapping[str, Any] | None = None,
    results: str | os.PathLike[str] = "results",
) -> list[Path]:
    """Draws the paper's figures from the tables, as `harness figures` does, and returns the files.

    names: figures to draw; by default all whose runs are there. folder: where to write `NAME.svg`, `NAME.png` and
    `NAME.csv`. formats: which of these files to write. quick: draws the quick runs. single, multi: experiments to draw
    instead of `single_to_multi` and `multi_to_multi`. where: settings that the runs must have, as in `compare`.

    Raises ValueError for an unknown figure or format, and RuntimeError with the reasons if a named figure, or every
    figure, can't be drawn.
    """
    formats = list(formats)
    drawn, missing = _harness.figures(
        list(names), Path(folder), formats, quick, single, multi, _settings(where), Path(results)
    )
    if missing and (names or not drawn):
        raise RuntimeError("; ".join(f"{name} was not drawn: {reason}" for name, reason in missing))
    return [Path(folder) / f"{name}.{format}" for name in drawn for format in formats]


class Problem(NamedTuple):
    """A problem that `verify` found."""

    path: Path
    """The file or folder."""
    problem: str
    """What is wrong with it."""
    repair: str | None
    """A command that repairs it, if one is known."""
    broken: bool
    """Whether data were lost or changed. If not, the problem is only a note."""


def verify(results: str | os.PathLike[str] = "results") -> list[Problem]:
    """Checks that all files of a results folder are as they were written, as `harness verify` does.

    Returns the problems; none if all files are intact. Raises FileNotFoundError if there is no results folder.
    """
    return [Problem(*problem) for problem in _harness.verify(Path(results))[3]]


def load_model(run: str, results: str | os.PathLike[str] = "results") -> Model:
    """Loads the network of the finished run whose id, or `experiment/id`, begins with `run`.

    Raises KeyError if no run or several runs match, FileNotFoundError if the run's network is missing, and RuntimeError
    if the run isn't done or the network is damaged.
    """
    return Model(run, Path(results))


def load_network(run: str, results: str | os.PathLike[str] = "results") -> "Network":
    """Loads the network of the finished run whose id, or `experiment/id`, begins with `run`, as a `torch.nn.Module`.

    See `harness.networks.Network`. Raises ImportError without the packages torch and safetensors, and otherwise the
    errors of `load_model`.
    """
    try:
        from .networks import Network, NetworkFile
    except ImportError as error:
        raise ImportError(f"load_network needs PyTorch: pip install torch safetensors ({error})") from error
    files = {task: NetworkFile(path, json.loads(text)) for task, path, text in _harness.networks(run, Path(results))}
    return Network(files["prediction"], files.get("reconstruction"))


def export_onnx(
    run: str,
    output: str | os.PathLike[str],
    task: str = "prediction",
    results: str | os.PathLike[str] = "results",
) -> None:
    """Writes the network of a finished run to an ONNX file, as `harness export --format onnx` does.

    task: `prediction` of the next observation, or `reconstruction` of the present one. Raises ValueError for another
    task, RuntimeError if the run did not train it, and the errors of `load_model`.
    """
    _harness.export_onnx(run, Path(output), task, Path(results))


def export_mlflow(
    *experiments: str,
    tracking_uri: str | None = None,
    condition: str | None = None,
    artifacts: bool = False,
    results: str | os.PathLike[str] = "results",
    progress: bool = True,
) -> Exported:
    """Writes runs to MLflow, each to the MLflow experiment of its own experiment's name.

    experiments: names of experiments; all of them by default. tracking_uri: MLflow's server or store, such as
    `sqlite:///mlflow.db`; MLflow's own default if None. condition: exports only the runs for which this SQL condition
    over the table `runs` is true, such as `status = 'done' and seed < 3`. artifacts: also uploads each run's files.
    results: the folder of datasets and runs. progress: shows a progress bar on stderr.

    A run has all settings as parameters, the losses by epoch and the final metrics as metrics, and tags with its
    name, hashes, seed, commit, versions and status. A run that was exported before is skipped, or replaced if it has
    changed.

    Raises ImportError if mlflow is not installed, KeyError if an experiment has no runs, ValueError if the condition is
    wrong, and RuntimeError with MLflow's message if MLflow refuses something.
    """
    from .export import mlflow, runs

    chosen = runs.read_runs(experiments, condition, Path(results))
    return mlflow.write(chosen, tracking_uri, artifacts, progress)


def export_tensorboard(
    *experiments: str,
    folder: str | os.PathLike[str],
    condition: str | None = None,
    results: str | os.PathLike[str] = "results",
    progress: bool = True,
) -> Exported:
    """Writes runs for TensorBoard, each to `folder/EXPERIMENT/RUN`; `tensorboard --logdir folder` shows them.

    experiments, condition, results and progress are those of `export_mlflow`. A run has the losses by epoch and the
    final metrics as scalars, the settings in which the exported runs of its experiment differ as hyperparameters, and
    the spec and tags as texts. TensorBoard stores scalars with 32 bits. A run that was exported before is skipped, or
    replaced if it has changed.

    Raises ImportError if tensorboard is not installed, KeyError if an experiment has no runs, ValueError if the
    condition is wrong, and OSError if the folder can't be written.
    """
    from .export import runs, tensorboard

    chosen = runs.read_runs(experiments, condition, Path(results))
    return tensorboard.write(chosen, Path(folder), progress)


class Dataset(_harness.Dataset):
    """A dataset in memory: all samples of all episodes, one after the other.

    `data["proprioception"]` and the other names of `data.keys()` are NumPy arrays `[samples, width]`. `data["vision"]`
    is `[samples, 64, 64, 3]`, uint8. The arrays are read-only views of the dataset's memory.
    """

    def episode(self, index: int) -> dict[str, Any]:
        """Returns the samples of one episode by name, as views. Raises IndexError if there is no such episode."""
        first, end = self.episodes[index]
        return {name: self[name][first:end] for name in self.keys()}

    def split(
        self,
        part: str,
        *,
        by: str = "episode",
        validation: float = 0.1,
        test: float = 0.1,
        gap_seconds: float | None = None,
    ) -> "NDArray[np.int64]":
        """Returns the samples from which the transitions of a part start: `training`, `validation` or `test`.

        A transition leads from a sample to the next one. The other arguments are those of a spec's `split`, with the
        same defaults, so the parts are those that a network is trained and tested on. Raises ValueError if a part
        would have no transitions.
        """
        parts = ("training", "validation", "test")
        if part not in parts:
            raise ValueError(f"part: there is no '{part}'; allowed: {', '.join(parts)}")
        if not (0 < validation < 1 and 0 < test < 1):
            raise ValueError(f"validation, test: {validation} and {test} must be in (0, 1)")
        if gap_seconds is not None and not 0 <= gap_seconds <= 3600:
            raise ValueError(f"gap_seconds: {gap_seconds} must be in [0, 3600]")
        return self.parts(by, validation, test, gap_seconds)[parts.index(part)]

    def torch(
        self,
        input: list[str],
        output: list[str],
        action: str = "increment",
        samples: "NDArray[np.int64] | None" = None,
    ) -> "Transitions":
        """Returns the transitions as a PyTorch map-style dataset; see `harness.torch.Transitions`.

        samples: the samples from which the transitions start, such as `split("training")`; all by default.
        """
        from .torch import Transitions

        return Transitions(self, input, output, action, samples)
