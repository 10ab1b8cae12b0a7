"""A research harness for multi-modal perception of a soft robot.

A soft finger presses on the ground and into boxes; what it senses is recorded, and conditional variational auto-encoders
are trained on it. The simulation, the training and the tables are Rust; this package gives them to Python:

- `run` does an experiment, `query` asks its tables, `compare` has means over seeds, `Dataset` and `load_model` open what it left,
- `harness.environments` has the finger as a `dm_env.Environment`, `harness.gymnasium` as Gymnasium's environments,
- `SimulationBatch` is the simulation itself, one or many, stepped by setpoints.

Units are SI. Calls that take long let other threads run, and Ctrl-C stops them; `run` goes on from there.
"""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

# Software rendering on the threads that ask for it, and candle's work on the harness's own, as in the program. Both are
# read when they are first used; a value that is set already stays.
os.environ.setdefault("LP_NUM_THREADS", "0")
os.environ.setdefault("CANDLE_NUM_THREADS", "1")

from . import _harness
from ._harness import Model, SimulationBatch

if TYPE_CHECKING:
    import polars

    from .torch import Transitions

__all__ = ["Dataset", "Model", "SimulationBatch", "Summary", "compare", "load_model", "query", "run"]


class Summary(NamedTuple):
    """What became of an experiment's runs."""

    done: int
    skipped: int
    """Done before, or by another process."""


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

    path: the experiment's YAML file. overrides: settings to change, by dotted key: `{"training.epochs": 5}`; a
    single value will do for a list. quick: applies the spec's own `quick` settings. results: the folder of datasets and
    runs. progress: draws bars on the terminal. jobs: runs of a scenario to train side by side. memory: a dataset's frames
    are kept in memory if they take so many GB at most, otherwise on disk; an eighth of the free memory by default.

    Raises FileNotFoundError without the file, ValueError where the spec is wrong (with file, line and column, or the
    override), RuntimeError with the reasons after some run failed, and KeyboardInterrupt when it is interrupted; the
    same call then goes on.
    """
    changed = [f"{key}={json.dumps(value)}" for key, value in (overrides or {}).items()]
    if jobs < 1:
        raise ValueError(f"jobs: {jobs} must be at least 1")
    if memory is not None and not 0 <= memory <= 1e9:
        raise ValueError(f"memory: {memory} must be a number of gigabytes")
    frames = None if memory is None else int(memory * 1e9)
    return Summary(*_harness.run(Path(path), changed, quick, Path(results), progress, jobs, frames))


def query(sql: str, results: str | os.PathLike[str] = "results") -> "polars.DataFrame":
    """Answers a question in SQL over the tables of a results folder, as `harness query` does, without copying.

    The tables are runs, epochs, metrics, predictions, forces, frames and episodes; `harness schema --tables` lists their
    columns with units. Raises ValueError where the query can't be answered, RuntimeError where a table is damaged, and
    FileNotFoundError without a results folder. Warns of each run or dataset that is left out.
    """
    import polars

    return polars.DataFrame(_harness.query(sql, Path(results)))


def compare(
    *experiments: str,
    where: Mapping[str, Any] | None = None,
    results: str | os.PathLike[str] = "results",
) -> "polars.DataFrame":
    """The metrics of finished runs as means over seeds, with 95 % intervals (Student's t), as `harness compare` has them.

    experiments: those to compare; all of them if none is named. where: settings that the runs must have, by dotted key:
    `{"training.batch_size": 64}`. results: the folder of datasets and runs.

    A row is a metric over all joints, links or pixels, of runs that differ in nothing but their seed. In what the runs of
    an experiment differ besides scenario, latent size and variant stands in the column `settings`. Baselines have no
    latent size. Raises KeyError where an experiment has no finished runs, ValueError where no run has a setting,
    RuntimeError where a table is damaged.
    """
    import polars

    wanted = (where or {}).items()
    settings = [f"{key}={value if isinstance(value, str) else json.dumps(value)}" for key, value in wanted]
    return polars.DataFrame(_harness.compare(list(experiments), settings, Path(results)))


def load_model(run: str, results: str | os.PathLike[str] = "results") -> Model:
    """Loads the network of a finished run: the one whose id, or `experiment/id`, begins with `run`.

    Raises KeyError where no run matches, or several; FileNotFoundError where its network isn't there; RuntimeError where
    the run isn't done, or the network is damaged.
    """
    return Model(run, Path(results))


class Dataset(_harness.Dataset):
    """A dataset in memory: all samples of all episodes, one after the other.

    `data["proprioception"]` and the others of `data.keys()` are NumPy arrays `[samples, width]`, `data["vision"]` is
    `[samples, 64, 64, 3]`, uint8: views of the dataset's own memory that can't be written.
    """

    def episode(self, index: int) -> dict[str, Any]:
        """The samples of one episode by name, views as well. Raises IndexError where there is no such episode."""
        first, end = self.episodes[index]
        return {name: self[name][first:end] for name in self.keys()}

    def torch(self, input: list[str], output: list[str], action: str = "increment") -> "Transitions":
        """The transitions as a PyTorch map-style dataset, see `harness.torch.Transitions`."""
        from .torch import Transitions

        return Transitions(self, input, output, action)
