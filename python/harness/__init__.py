"""A research harness for multi-modal perception of a soft robot.

An arm presses a soft finger on the ground and into boxes in a simulation. Conditional variational auto-encoders are
trained on the recorded data. The simulation, the training and the tables are written in Rust, and this package makes
them available in Python:

- `run` does an experiment, `query` queries its tables, `compare` computes means over seeds.
- `export_mlflow` and `export_tensorboard` write runs to the trackers of other projects.
- `Dataset` opens a dataset, `load_model` opens a trained network.
- `harness.environments` has the finger as a `dm_env.Environment`, `harness.gymnasium` as Gymnasium environments.
- `SimulationBatch` is one simulation or many, stepped by setpoints.

Units are SI. Long calls let other threads run, and Ctrl-C stops them. The next call of `run` continues from there.
"""

import json
import os
from collections.abc import Mapping
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
    import polars

    from .torch import Transitions

__all__ = [
    "Dataset",
    "Exported",
    "Model",
    "SimulationBatch",
    "Summary",
    "compare",
    "export_mlflow",
    "export_tensorboard",
    "load_model",
    "query",
    "run",
]


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
    changed = [f"{key}={json.dumps(value)}" for key, value in (overrides or {}).items()]
    if jobs < 1:
        raise ValueError(f"jobs: {jobs} must be at least 1")
    if memory is not None and not 0 <= memory <= 1e9:
        raise ValueError(f"memory: {memory} must be a number of gigabytes")
    frames = None if memory is None else int(memory * 1e9)
    return Summary(*_harness.run(Path(path), changed, quick, Path(results), progress, jobs, frames))


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

    wanted = (where or {}).items()
    settings = [f"{key}={value if isinstance(value, str) else json.dumps(value)}" for key, value in wanted]
    return polars.DataFrame(_harness.compare(list(experiments), settings, Path(results)))


def load_model(run: str, results: str | os.PathLike[str] = "results") -> Model:
    """Loads the network of the finished run whose id, or `experiment/id`, begins with `run`.

    Raises KeyError if no run or several runs match, FileNotFoundError if the run's network is missing, and RuntimeError
    if the run isn't done or the network is damaged.
    """
    return Model(run, Path(results))


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

    def torch(self, input: list[str], output: list[str], action: str = "increment") -> "Transitions":
        """Returns the transitions as a PyTorch map-style dataset; see `harness.torch.Transitions`."""
        from .torch import Transitions

        return Transitions(self, input, output, action)
