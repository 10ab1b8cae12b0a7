"""A research harness for soft-robot perception: simulation, training, tables and figures.

An experiment is a YAML file. It says which scenes to simulate, which networks to train on the recorded data, and on
what to test them. Results are tables in a folder, `results` by default.

    >>> import harness
    >>> harness.run("smoke", progress=False)                        # a small experiment, in seconds
    Summary(done=..., skipped=...)
    >>> runs = harness.query("select run, status from runs")        # a polars.DataFrame
    >>> model = harness.load_model("smoke/empty")                   # the trained network of a run
    >>> data = harness.Dataset(f"results/datasets/{model.dataset}") # the recorded data, as NumPy arrays
    >>> observation = {name: data[name][:10] for name in model.input}
    >>> mean, log_variance = model.encode(observation)
    >>> mean.shape
    (10, 4)

Experiments and results:

- `run` does an experiment. `collect` only simulates its datasets, with the motion of the world or with a policy.
- `query` answers SQL queries over the tables, and `answer` (or `compare`) computes means over seeds.
- `plot` draws a metric over a setting. `report` writes all results, or those of some experiments, to one HTML page.
- `claims` judges the paper's statements, and `figures` draws the paper's figures.
- `verify` checks all files of a results folder.
- `export_mlflow` and `export_tensorboard` write runs to MLflow and TensorBoard.
- `add_metric` adds a metric of your own to finished runs.

Data and networks:

- `Dataset` opens a dataset.
- `task` opens a task: what a model of PyTorch, JAX, scikit-learn or another program gets and predicts. The program then
  judges its predictions like those of its own networks.
- `load_model` opens a trained network. `load_network` opens it as a `torch.nn.Module`, and `export_onnx` writes it as
  an ONNX model.

Simulation:

- `SimulationBatch` is one simulation or many, which the caller steps.
- The module `harness.gymnasium` has the simulation as environments for Gymnasium, and `harness.environments` as
  environments for dm_env and dm_control.

The module `harness.export` writes datasets for LeRobot and Rerun. `harness.importing` makes datasets from recordings, and
`harness.fitting` fits a world to one.

All values are in SI units. Long calls let other threads run, and Ctrl-C stops them.
"""

import importlib.metadata
import json
import numbers
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
from ._arguments import integer, name_tuple
from ._harness import Model, SimulationBatch

if TYPE_CHECKING:
    import numpy as np
    import polars
    from numpy.typing import NDArray

    from .networks import Network
    from ._own_metrics import Metric
    from .policies import Policy
    from .prediction import PredictionTask
    from .torch import Transitions

__all__ = [
    "Dataset",
    "Exported",
    "Model",
    "Problem",
    "SimulationBatch",
    "Summary",
    "add_metric",
    "answer",
    "claims",
    "collect",
    "compare",
    "export_mlflow",
    "export_onnx",
    "export_tensorboard",
    "figures",
    "load_model",
    "load_network",
    "plot",
    "query",
    "report",
    "run",
    "task",
    "verify",
]

__version__ = importlib.metadata.version("soft-harness")


class Summary(NamedTuple):
    """What `run` did: the number of runs that it completed, and the number that were done before."""

    done: int
    skipped: int


class Exported(NamedTuple):
    """What an export did: the number of runs that it wrote, and the number that were exported before."""

    exported: int
    skipped: int


class Problem(NamedTuple):
    """A problem with a file, which `verify` found."""

    path: Path
    problem: str
    repair: str | None
    broken: bool


def _describe(kind: type, **meanings: str) -> None:
    """Sets the meanings of the fields of a named tuple, which `help` shows."""
    for field, meaning in meanings.items():
        getattr(kind, field).__doc__ = meaning


_describe(
    Summary,
    done="Number of runs that this call completed.",
    skipped="Number of runs that were done before, or by another process.",
)
_describe(
    Exported,
    exported="Number of runs that this call wrote.",
    skipped="Number of runs that were exported before and have not changed since.",
)
_describe(
    Problem,
    path="The file or folder.",
    problem="What is wrong with it, in words.",
    repair="A command that repairs it; None if none is known.",
    broken="Whether data were lost or changed. If not, the problem is only a note.",
)


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
    """Does all runs of an experiment that are not done yet, as `harness run` does.

    It simulates the missing episodes of the datasets, trains the networks, tests them, and writes the tables. Ctrl-C
    stops it. The same call continues from there.

    Args:
        path: the experiment: the path of a YAML file, or the name of a built-in experiment, such as `smoke`.
        overrides: settings to change, by dotted key: `{"training.epochs": 5, "latent": [8, 16]}`. A single value can
            replace a list.
        quick: applies the settings in the spec's section `quick`, for minutes instead of hours.
        results: the folder of datasets and runs.
        progress: shows progress bars on stderr.
        jobs: number of runs to train at the same time, each with its share of the threads. The results are the same.
        memory: the frames of a dataset are kept in memory if they take at most this many gigabytes, otherwise in a
            temporary file. The default is an eighth of the free memory.

    Returns:
        The numbers of runs that this call completed, and that were done before.

    Raises:
        FileNotFoundError: there is no such file or experiment.
        ValueError: the spec is wrong, an override, or a world file. The message says where.
        OSError: the results folder can't be written.
        RuntimeError: a run failed. The message has the reason of each failure. The other runs were done.
        KeyboardInterrupt: the call was interrupted.

    Example:
        >>> harness.run("smoke", {"latent": 3, "scenarios": "empty"}, progress=False)
        Summary(done=1, skipped=0)
    """
    if integer("jobs", jobs) < 1:
        raise ValueError(f"jobs: {jobs} must be at least 1")
    if memory is not None and not (isinstance(memory, numbers.Real) and 0 <= memory <= 1e9):
        raise ValueError(f"memory: {memory!r} must be a number of gigabytes")
    frames = None if memory is None else int(memory * 1e9)
    return Summary(*_harness.run(Path(path), _changes(overrides), quick, Path(results), progress, jobs, frames))


def collect(
    path: str | os.PathLike[str],
    overrides: Mapping[str, Any] | None = None,
    *,
    policy: "Policy | None" = None,
    version: str | None = None,
    workers: int | None = None,
    quick: bool = False,
    results: str | os.PathLike[str] = "results",
    progress: bool = True,
) -> dict[Path, int]:
    """Simulates the missing episodes of an experiment's datasets, as `harness collect` does, without training.

    Ctrl-C stops it. The same call continues from there.

    With a policy, a Python function gives the setpoints instead of the world's motion. It gets what has been recorded
    of the episode so far, a `harness.policies.Observations`, and returns the setpoint of the next sample. Setpoints
    outside their ranges are clipped. The spec's `simulation.policy` then names the policy and its version. An
    experiment with this setting is trained on the dataset.

    A dataset does not depend on the number of workers if the policy depends only on its observations, which include a
    random generator. Several workers are processes. They need a policy that can be pickled, such as a function at the
    top level of a module. In a script, call this function below `if __name__ == "__main__":`.

    Args:
        path: the experiment: the path of a YAML file, or the name of a built-in experiment, such as `smoke`.
        overrides: settings to change, by dotted key, as in `run`.
        policy: the policy.
        version: a text that changes whenever the policy does. The default is a hash of the file that defines the
            function. Objects and closures need a version, and so does a policy that depends on other files, such as
            the weights of a network.
        workers: number of episodes that are simulated at the same time. The default is the number of cores.
        quick: applies the settings in the spec's section `quick`.
        results: the folder of datasets and runs.
        progress: shows progress bars on stderr.

    Returns:
        The number of episodes that this call simulated, by the dataset's folder.

    Raises:
        FileNotFoundError: there is no such file or experiment.
        ValueError: the spec is wrong, an override, or a world file. The message says where. Or the policy needs a
            version, can't be sent to workers, or is not the one that the spec names.
        OSError: the results folder can't be written.
        RuntimeError: an episode can't be simulated or written. Or the policy raised an exception, or did not return
            finite numbers. Then the episodes that this call simulated are removed.
        KeyboardInterrupt: the call was interrupted.

    Example:
        >>> harness.collect("smoke", {"scenarios": "empty"}, progress=False)
        {PosixPath('results/datasets/empty-...'): 0}

        A policy that moves each element of the setpoint to a random place:

        >>> def anywhere(observations):
        ...     return observations.random.uniform(*observations.ranges.T)
        >>> made = harness.collect(
        ...     "smoke", {"scenarios": "empty"}, policy=anywhere, version="1", workers=1, progress=False
        ... )
        >>> len(made)                       # `run` trains on it with {"simulation.policy": "anywhere@1"}
        1
    """
    if workers is not None and integer("workers", workers) < 1:
        raise ValueError(f"workers: {workers} must be at least 1")
    settings = _changes(overrides)
    if policy is None:
        if version is not None:
            raise ValueError("version: there is no policy that it could be the version of")
        return dict(_harness.collect(Path(path), settings, quick, Path(results), progress, workers))
    from . import policies

    task = policies.PolicyTask(Path(path), settings, quick, Path(results), policies.identity(policy, version))
    return policies.collect(task, policy, workers, progress)


def query(sql: str, results: str | os.PathLike[str] = "results") -> "polars.DataFrame":
    """Answers an SQL query over the tables of a results folder, as `harness query` does.

    The tables are runs, epochs, metrics, predictions, forces, frames and episodes. `show tables` lists them, and
    `describe TABLE` lists the columns of one with their units. A run or dataset that can't be read is left out, with a
    warning.

    Args:
        sql: the query, a single SELECT, SHOW TABLES or DESCRIBE.
        results: the folder of datasets and runs.

    Returns:
        The answer as a table.

    Raises:
        ValueError: the query is wrong or not supported. The message says what is allowed.
        FileNotFoundError: there is no results folder.
        RuntimeError: a table is damaged.

    Example:
        >>> harness.query("select scenario, latent, status from runs where latent = 4 order by scenario")
        shape: (2, 3)
        ┌───────────┬────────┬────────┐
        │ scenario  ┆ latent ┆ status │
        │ ---       ┆ ---    ┆ ---    │
        │ str       ┆ i64    ┆ str    │
        ╞═══════════╪════════╪════════╡
        │ cluttered ┆ 4      ┆ done   │
        │ empty     ┆ 4      ┆ done   │
        └───────────┴────────┴────────┘
    """
    import polars

    return polars.DataFrame(_harness.query(sql, Path(results)))


def answer(
    *experiments: str,
    of: str | Iterable[str] = (),
    metrics: str | Iterable[str] = (),
    models: str | Iterable[str] = (),
    task: str | None = None,
    horizon: int | str | Iterable[int | str] = (),
    given: str | Iterable[str] = (),
    by: str | Iterable[str] = (),
    where: Mapping[str, Any] | None = None,
    against: str | None = None,
    interval: str = "mean",
    results: str | os.PathLike[str] = "results",
) -> "polars.DataFrame":
    """Computes the means of metrics over datasets and seeds, with 95 % intervals, as `harness compare` does.

    A metric is computed on the test samples over all joints, links or pixels. Runs that differ only in their seed, or
    in the seed of their dataset, share a row. The intervals are those of Student's t. Baselines have no latent size.
    `compare` is another name of this function, and `plot` takes the same arguments.

    Args:
        experiments: names of experiments. Without any, all experiments are compared.
        of: the predicted modality or modalities, or the part of one with one unit, such as `joints in rad`.
        metrics: the metric or metrics. The default is `smape`, `wmape`, `r2` and `relative_error`.
        models: `network`, which stands for all networks and models of other programs, the baselines `persistence`,
            `ridge`, `training_mean` and `nearest_neighbors`, or names of models of other programs. The default is
            all of them.
        task: `prediction` or `reconstruction`. The default is both.
        horizon: how far ahead the predictions are: numbers of samples, such as 5, or times, such as `"0.5s"`. The
            default is `window.horizon` of each run's spec, or all horizons if `horizon` is one of the keys.
        given: the modality or modalities that the models got, of models that got only some of their run's inputs.
        by: the key or keys that tell the columns of a table apart. Settings and axes are possible too, and are columns
            of their own in the answer.
        where: settings that the runs must have, by dotted key: `{"training.batch_size": 64}`.
        against: the heading of a column in the table of `harness compare`. The other rows are paired differences from
            it.
        interval: `mean` for the confidence interval of the mean, or `next-dataset` for the prediction interval of one
            more dataset.
        results: the folder of datasets and runs.

    Returns:
        One row for each mean. `horizon` says how many samples it is ahead, and `better` whether higher or lower values
        are better. `seeds` is the number of values: one for each seed on each dataset. A baseline has one for each
        dataset. With several `datasets`, the interval is over the means of the datasets. `low` and `high` are the ends
        of the interval, which a single value does not have. If the runs of an experiment differ in settings other than
        scenario, latent size and variant, the column `settings` contains these. With `against`, the column
        `difference_from` has the heading in rows with differences, and `p` their p-values, corrected for their number
        by Holm's method.

    Raises:
        KeyError: an experiment has no finished runs.
        ValueError: no run has a setting of `where`, a metric, model or modality, or predicts so far ahead.
        FileNotFoundError: there is no results folder.
        RuntimeError: a table is damaged.

    Example:
        >>> means = harness.answer("smoke", of="contact_force", metrics="r2", where={"latent": 4})
        >>> means.select("scenario", "model", "seeds", "mean", "low")
        shape: (8, 5)
        ...
    """
    import polars

    question = _question(experiments, of, metrics, models, task, horizon, given, by, where, against, interval)
    return polars.DataFrame(_harness.answer(question, Path(results)))


compare = answer


def add_metric(
    metric: "Metric",
    runs: str,
    *,
    name: str,
    unit: str = "1",
    modality: str | None = None,
    results: str | os.PathLike[str] = "results",
) -> int:
    """Computes a metric of your own from the stored predictions of finished runs, and adds it to their tables.

    `query`, `compare`, `plot`, `report` and `claims` then have it like every other metric. Predictions of images and of
    baselines are not stored, so these have no value. The metric is computed over all elements of a modality, for each
    horizon. Added again, a metric of the same name replaces the earlier one. A run that is done again loses it.

    Args:
        metric: a function of the reference and the prediction, each `[samples, elements]`, float64, in SI units. It
            returns a number, or None if the metric is not defined.
        runs: name of an experiment, or the beginning of the names of runs, as EXPERIMENT/RUN.
        name: name of the metric in tables: lowercase letters, digits and `_`.
        unit: unit of the values; `1` for a number without a unit.
        modality: the predicted modality. The default is all modalities whose predictions are stored.
        results: the folder of datasets and runs.

    Returns:
        The number of runs.

    Raises:
        FileNotFoundError: there is no results folder.
        KeyError: no finished run matches.
        TypeError: the metric is not a function, or returns something else than a number.
        ValueError: the name or the unit is wrong, a value is infinite, or a run has no stored predictions.
        RuntimeError: another process works on a run, it is a published copy, or a table is damaged.

    Example:
        >>> def within_1_newton(reference, predicted):
        ...     return 100 * (abs(reference - predicted) < 1).mean()
        >>> harness.add_metric(within_1_newton, "smoke", name="within_1n", unit="%", modality="contact_force")
        2
        >>> harness.query("select scenario, value from metrics where metric = 'within_1n' order by scenario")
        shape: (2, 2)
        ...
    """
    from ._own_metrics import add

    return add(metric, runs, name, unit, modality, Path(results))


def claims(
    *names: str,
    file: str | os.PathLike[str] = "claims",
    reading: str | None = None,
    quick: bool = False,
    where: Mapping[str, Any] | None = None,
    results: str | os.PathLike[str] = "results",
) -> "polars.DataFrame":
    """Judges which statements of a file of claims hold, as `harness claims` does. The built-in file has the paper's.

    Args:
        names: names of claims. Without any, all claims are judged.
        file: the YAML file of claims. `claims` is the built-in one, unless the folder has a file
            `experiments/claims.yaml`.
        reading: judges by the runs under this reading of the spec that the file names, such as "recommended", instead
            of the claims' own experiments.
        quick: judges by the quick runs of the experiments.
        where: settings that the runs must have, by dotted key, as in `compare`.
        results: the folder of datasets and runs.

    Returns:
        One row for each verdict, with the measured mean and its 95 % interval. `verdict` is `holds`, `does not hold`,
        `not testable`, or begins with `undecided`.

    Raises:
        FileNotFoundError: there is no such file, or no results folder.
        ValueError: a claim or a reading is unknown, the reading's spec has no runs, or the file is wrong.
        RuntimeError: a table is damaged.

    Example:
        >>> verdicts = harness.claims("vision_improves_force_r2", reading="recommended", results="results/reference")
        >>> verdicts["scenario"].to_list(), verdicts["verdict"].to_list()
        (['empty', 'cluttered'], ['holds', 'does not hold'])
    """
    import polars

    chosen = _names("names", names)
    return polars.DataFrame(_harness.claims(chosen, Path(file), reading, quick, _settings(where), Path(results)))


def figures(
    *names: str,
    folder: str | os.PathLike[str] = "figures",
    formats: str | Iterable[str] = ("svg", "png", "pdf", "csv"),
    quick: bool = False,
    single: str | None = None,
    multi: str | None = None,
    reading: str | None = None,
    experiment: str | None = None,
    of: str | None = None,
    where: Mapping[str, Any] | None = None,
    results: str | os.PathLike[str] = "results",
) -> list[Path]:
    """Draws the paper's figures from the tables, as `harness figures` does.

    Args:
        names: names of figures. Without any, all figures are drawn for which there are runs.
        folder: the folder to write `NAME.svg`, `NAME.png`, `NAME.pdf` and `NAME.csv` to.
        formats: which of these files to write: `svg`, `png`, `pdf`, `csv` or several of them.
        quick: draws the quick runs of the experiments.
        single: the experiment to draw instead of `single_to_multi`.
        multi: the experiment to draw instead of `multi_to_multi`.
        reading: the reading of an experiment to draw instead of both, such as `reproduction/base`.
        experiment: draws what the figures show of this experiment, of any robot, instead of the paper's experiments.
        of: the modality that `horizon` shows, or the part of it with one unit, such as `joints in rad`.
        where: settings that the runs must have, by dotted key, as in `answer`.
        results: the folder of datasets and runs.

    Returns:
        The files that were written.

    Raises:
        ValueError: there is no such figure, format or reading, or `reading` or `experiment` comes with an argument that
            it replaces.
        FileNotFoundError: there is no results folder.
        RuntimeError: a named figure, or every figure, can't be drawn. The message has the reasons.

    Example:
        >>> harness.figures("regression", formats="svg", results="results/reference")
        [PosixPath('figures/regression.svg')]
    """
    formats = name_tuple(formats)
    if not formats:
        raise ValueError("formats: there is none; allowed: svg, png, pdf, csv")
    if reading is not None and (single is not None or multi is not None):
        raise ValueError("reading: it replaces single and multi; leave these out")
    if experiment is not None and (quick or single is not None or multi is not None or reading is not None):
        raise ValueError("experiment: it replaces quick, single, multi and reading; leave these out")
    drawn, missing = _harness.figures(
        _names("names", names),
        Path(folder),
        list(formats),
        quick,
        single,
        multi,
        reading,
        experiment,
        of,
        _settings(where),
        Path(results),
    )
    if missing and (names or not drawn):
        raise RuntimeError("; ".join(f"{name} was not drawn: {reason}" for name, reason in missing))
    return [Path(folder) / f"{name}.{format}" for name in drawn for format in formats]


def plot(
    *experiments: str,
    x: str,
    metrics: str,
    facet: str | None = None,
    output: str | os.PathLike[str] = "plot.svg",
    results: str | os.PathLike[str] = "results",
    **question: Any,
) -> Path:
    """Draws a metric of networks and baselines over a key, as `harness plot` does.

    Points are the means of `answer`, and bars are its intervals. The keys are experiment, scenario, latent, variant,
    settings, horizon, given, task, modality, and any setting of a spec, such as `input`. A baseline has no latent state, so it
    has the same value at every latent size.

    Args:
        experiments: names of experiments; all of them by default.
        x: the key along the horizontal axis.
        metrics: the metric along the vertical axis, such as `r2`.
        facet: the key that distinguishes panels.
        output: the file to write. It ends in `.svg`, `.png`, `.pdf`, or `.csv` for the numbers.
        results: the folder of datasets and runs.
        question: the other arguments of `answer`. The keys of `by` distinguish series. The default of `models` is
            `network`, and that of `task` the prediction, or both if `task` is one of the keys.

    Returns:
        The path of the file.

    Raises:
        KeyError: an experiment has no finished runs.
        ValueError: there is no such key, metric, model, task, horizon or format, no run has the metric, or the means
            differ in a key that the plot does not show.
        FileNotFoundError: there is no results folder.
        OSError: the file can't be written.
        RuntimeError: a table is damaged.

    Example:
        >>> harness.plot("smoke", x="latent", metrics="r2", by="modality", facet="scenario", output="r2.png")
        PosixPath('r2.png')
    """
    asked = _question(experiments, metrics=metrics, **question)
    _harness.plot(asked, x, facet, Path(output), Path(results))
    return Path(output)


def report(
    *experiments: str,
    dataset: str | None = None,
    output: str | os.PathLike[str] = "report.html",
    claims: str | os.PathLike[str] = "claims",
    quick: bool = False,
    where: Mapping[str, Any] | None = None,
    results: str | os.PathLike[str] = "results",
    progress: bool = True,
) -> Path:
    """Writes an HTML page of all results, of some experiments, or of a dataset, as `harness report` does.

    The page needs no internet connection. If runs are missing, it says which command makes them.

    Args:
        experiments: names of experiments; all results by default.
        dataset: the name of a dataset, or its beginning. The page shows what it contains, and no results.
        output: the file to write.
        claims: the file of claims.
        quick: uses the quick runs of the experiments.
        where: settings that the runs must have, as in `compare`.
        results: the folder of datasets and runs.
        progress: shows progress bars on stderr.

    Returns:
        The path of the file.

    Raises:
        KeyError: one of the named experiments has no finished runs.
        FileNotFoundError: there is no results folder or no file of claims.
        ValueError: the file of claims or the spec is wrong, or experiments and a dataset are given.
        OSError: the page can't be written.
        RuntimeError: a table is damaged, or there is no such dataset.

    Example:
        >>> harness.report("smoke", output="smoke.html", progress=False)
        PosixPath('smoke.html')
    """
    chosen, settings = _names("experiments", experiments), _settings(where)
    if dataset is not None:
        if chosen or settings or quick:
            raise ValueError("dataset: the page of a dataset shows no experiments; leave out experiments, where and quick")
        _harness.report_dataset(dataset, Path(output), Path(results), progress)
        return Path(output)
    _harness.report(chosen, Path(output), Path(claims), quick, settings, Path(results), progress)
    return Path(output)


def verify(results: str | os.PathLike[str] = "results") -> list[Problem]:
    """Checks that no file of a results folder has changed or is missing, as `harness verify` does.

    Args:
        results: the folder of datasets and runs.

    Returns:
        The problems. The list is empty if all files are intact.

    Raises:
        FileNotFoundError: there is no results folder.

    Example:
        >>> harness.verify()
        []
    """
    return [Problem(*problem) for problem in _harness.verify(Path(results))[3]]


#: Results that are part of the package: the recommended networks of the built-in worlds, with their scores.
_TRAINED = Path(__file__).parent / "trained"


def _folder_of(run: str, results: str | os.PathLike[str]) -> Path:
    """The results folder that contains a run's network; that of the package if only it has one."""
    folder = Path(results)
    # The package has two runs, and a results folder may have thousands.
    is_packaged = _harness.may_have_network(run, _TRAINED) and not _harness.may_have_network(run, folder)
    return _TRAINED if is_packaged else folder


def load_model(run: str, results: str | os.PathLike[str] = "results") -> Model:
    """Loads the trained network of a finished run.

    The recommended networks of the worlds `empty` and `cluttered` are part of the package. They are used if the results
    folder has no such network: `recommended/empty` and `recommended/cluttered`.

    Args:
        run: the beginning of the run's id, or of `EXPERIMENT/ID`, such as `smoke/empty`. It must match a single run.
        results: the folder of datasets and runs.

    Returns:
        The network, which takes and returns NumPy arrays in SI units.

    Raises:
        KeyError: no run matches, or several do.
        FileNotFoundError: there is no results folder, or the run's network is missing, as in results
            that were published without `--networks`.
        RuntimeError: the run is not done, or the network is damaged.

    Example:
        >>> harness.load_model("smoke/empty-z4")
        <harness.Model smoke/empty-z4-...: proprioception, vision to proprioception, contact_force, ..., latent 4>
        >>> harness.load_model("recommended/cluttered").latent
        64
    """
    return Model(run, _folder_of(run, results))


def load_network(run: str, results: str | os.PathLike[str] = "results") -> "Network | Any":
    """Loads the trained network of a finished run as a `torch.nn.Module`.

    It computes the same as the network of `load_model`. Its parameters can be trained.

    Like `load_model`, it finds the networks that are part of the package. For a model of another program, it loads the
    file that was attached to its predictions: TorchScript and programs of
    `torch.export` as a `torch.nn.Module` on the CPU, and ONNX as an `onnxruntime.InferenceSession`.

    Args:
        run: the beginning of the run's id, or of `EXPERIMENT/ID`, such as `smoke/empty`. It must match a single run.
        results: the folder of datasets and runs.

    Returns:
        The network; see `harness.networks.Network`. For a model of another program, what its file contains.

    Raises:
        ImportError: the package torch or safetensors is not installed, or onnxruntime for an ONNX file.
        KeyError: no run matches, or several do.
        FileNotFoundError: there is no results folder, or the run's network is missing, as in results
            that were published without `--networks`.
        RuntimeError: the run is not done, its network is damaged, or no file was attached to the predictions.

    Example:
        >>> network = harness.load_network("smoke/empty-z4")                       # needs torch
        >>> sum(parameters.numel() for parameters in network.parameters()) > 10_000
        True
    """
    folder = _folder_of(run, results)
    if attached := _harness.attached(run, folder):
        from ._attachments import load

        return load(attached)
    try:
        from .networks import Network, NetworkFile
    except ImportError as error:
        raise ImportError(f"load_network needs PyTorch: pip install torch safetensors ({error})") from error
    files = {task: NetworkFile(path) for task, path in _harness.networks(run, folder)}
    return Network(files["prediction"], files.get("reconstruction"))


def export_onnx(
    run: str,
    output: str | os.PathLike[str],
    task: str = "prediction",
    results: str | os.PathLike[str] = "results",
) -> None:
    """Writes the trained network of a finished run to an ONNX file, as `harness export --format onnx` does.

    Normalization is part of the model, so it takes and returns SI units. The batch can have any size. Like
    `load_model`, it finds the networks that are part of the package.

    Args:
        run: the beginning of the run's id, or of `EXPERIMENT/ID`, such as `smoke/empty`. It must match a single run.
        output: the file to write. An existing file is replaced.
        task: `prediction` of the next observation, or `reconstruction` of the present one.
        results: the folder of datasets and runs.

    Raises:
        ValueError: there is no such task.
        KeyError: no run matches, or several do.
        FileNotFoundError: there is no results folder, or the run's network is missing, as in results
            that were published without `--networks`.
        RuntimeError: the run is not done, did not train the task, or the network is damaged.
        OSError: the file can't be written.

    Example:
        >>> harness.export_onnx("smoke/empty-z4", "network.onnx")
    """
    _harness.export_onnx(run, Path(output), task, _folder_of(run, results))


def export_mlflow(
    *experiments: str,
    tracking_uri: str | None = None,
    condition: str | None = None,
    artifacts: bool = False,
    results: str | os.PathLike[str] = "results",
    progress: bool = True,
) -> Exported:
    """Writes runs to MLflow. The MLflow experiment has the name of the experiment.

    An exported run has all settings as parameters. The losses by epoch and the final metrics are metrics. Name, hashes,
    seed, commit, versions and status are tags. A run that was exported before is skipped, or replaced if it has
    changed.

    Args:
        experiments: names of experiments. Without any, all experiments are exported.
        tracking_uri: MLflow's server or store, such as `sqlite:///mlflow.db`. The default is MLflow's own.
        condition: an SQL condition over the table `runs`, such as `status = 'done' and seed < 3`. Only the runs for
            which it is true are exported.
        artifacts: also uploads the files of each run.
        results: the folder of datasets and runs.
        progress: shows a progress bar on stderr.

    Returns:
        The numbers of runs that were written, and that were exported before.

    Raises:
        ImportError: the package mlflow-skinny or mlflow is not installed.
        KeyError: an experiment has no runs.
        ValueError: the condition is wrong.
        FileNotFoundError: there is no results folder.
        RuntimeError: MLflow refuses something. The message is MLflow's.

    Example:
        >>> harness.export_mlflow("smoke", tracking_uri="sqlite:///mlflow.db", progress=False)      # needs mlflow
        Exported(exported=..., skipped=0)
    """
    from .export import mlflow, runs

    chosen = runs.read_runs(_names("experiments", experiments), condition, Path(results))
    return mlflow.write(chosen, tracking_uri, artifacts, progress)


def export_tensorboard(
    *experiments: str,
    folder: str | os.PathLike[str],
    condition: str | None = None,
    results: str | os.PathLike[str] = "results",
    progress: bool = True,
) -> Exported:
    """Writes runs for TensorBoard, each to the folder `folder/EXPERIMENT/RUN`.

    An exported run has the losses by epoch and the final metrics as scalars, with 32 bits. The settings in which the
    exported runs of its experiment differ are hyperparameters. The spec and the tags are texts. A run that was exported
    before is skipped, or replaced if it has changed. `tensorboard --logdir FOLDER` shows the runs.

    Args:
        experiments: names of experiments. Without any, all experiments are exported.
        folder: the folder to write to.
        condition: an SQL condition over the table `runs`, such as `status = 'done' and seed < 3`. Only the runs for
            which it is true are exported.
        results: the folder of datasets and runs.
        progress: shows a progress bar on stderr.

    Returns:
        The numbers of runs that were written, and that were exported before.

    Raises:
        ImportError: the package tensorboard is not installed.
        KeyError: an experiment has no runs.
        ValueError: the condition is wrong.
        FileNotFoundError: there is no results folder.
        OSError: the folder can't be written.

    Example:
        >>> harness.export_tensorboard("smoke", folder="logs", progress=False)                 # needs tensorboard
        Exported(exported=..., skipped=0)
    """
    from .export import runs, tensorboard

    chosen = runs.read_runs(_names("experiments", experiments), condition, Path(results))
    return tensorboard.write(chosen, Path(folder), progress)


def task(
    spec: str | os.PathLike[str] | None = None,
    overrides: Mapping[str, Any] | None = None,
    *,
    dataset: str | os.PathLike[str] | None = None,
    inputs: str | Iterable[str] | None = None,
    outputs: str | Iterable[str] | None = None,
    context: int = 1,
    horizons: int | Iterable[int] = 1,
    split: Mapping[str, Any] | None = None,
    action: str = "increment",
    name: str | None = None,
    cell: str | None = None,
    quick: bool = False,
    results: str | os.PathLike[str] = "results",
    progress: bool = False,
) -> "PredictionTask":
    """Opens a task for a model of another program: of an experiment, or of a dataset.

    Every spec of an experiment is a task, because it says which data a model gets and what it predicts. A model that is
    judged on it stands beside the networks that `run` trains. For a dataset, the arguments say the same.

    Args:
        spec: the experiment: the path of a YAML file, which need not have a network, or the name of a built-in one.
        overrides: settings to change in the spec, as in `run`.
        dataset: name of a dataset in the results folder, instead of a spec.
        inputs: modalities that a model gets.
        outputs: modalities that it predicts.
        context: number of samples that it sees, with the present one.
        horizons: how many samples ahead predictions are judged. The longest is that of the task. Shorter ones must be
            among 1, 2, 5, 10, 20, 50, 100, 200 and 500, at all of which every task is judged. 0 asks for the outputs
            at the present sample.
        split: how the dataset is divided, as in a spec: `{"by": "time", "test": 0.2}`.
        action: `increment`, the change of the setpoint in a sample, or `target`, the setpoint after it.
        name: name of the experiment of the task. The default is made of a hash of the arguments.
        cell: the task, if the experiment has several: a scenario, or a name that `harness task` lists.
        quick: applies the `quick` settings of the spec.
        results: the folder of datasets and runs.
        progress: shows progress bars on stderr while the dataset is read.

    Returns:
        The task; see `harness.prediction.PredictionTask`.

    Raises:
        FileNotFoundError: there is no such spec or dataset, or the dataset is not complete.
        KeyError: the dataset lacks a modality.
        TypeError: both a spec and a dataset are given, or neither.
        ValueError: the spec or an argument is wrong, or the experiment has several tasks. The message lists them.

    Example:
        >>> model = harness.load_model("smoke/empty-z4")
        >>> harness.task(dataset=model.dataset, inputs="arm", outputs="contact_force", context=3, horizons=[1, 5])
        <harness.PredictionTask task-.../empty: arm to contact_force, task ...>
    """
    from .prediction import PredictionTask, check_horizons, task_text

    if (spec is None) == (dataset is None):
        raise TypeError("task: give either a spec or a dataset")
    folder = Path(results)
    if spec is not None:
        return PredictionTask(Path(spec), None, _changes(overrides), quick, cell, folder, progress)
    text = task_text(dataset, inputs, outputs, context, horizons, split, action, name, folder)
    try:
        opened = PredictionTask(Path("task"), text, [], False, None, folder, progress)
    except FileNotFoundError as error:
        raise ValueError(f"dataset: this version does not simulate {Path(dataset).name} as it is ({error})") from error
    check_horizons(opened, horizons)
    return opened


class Dataset(_harness.Dataset):
    """The recorded samples of a dataset, as NumPy arrays.

    `data["proprioception"]` has the values of a modality for all samples, `[samples, width]`, float32. The samples of
    all episodes follow one another. `data["vision"]` has the images, `[samples, 64, 64, 3]`, uint8. `data.keys()` lists
    the modalities. Those of the built-in worlds are:

    - `proprioception`: 20 joint angles of the finger, rad
    - `arm`: rotation (rad), lift and extension (m) of the arm
    - `setpoint`: the same three values, as commanded
    - `contact_force`: the normal force on each of the finger's 20 links at the time of the sample, N
    - `contact_force_mean`: the same, averaged over the time since the previous sample, N
    - `vision`: the camera's image, RGB

    The arrays are read-only views of the dataset's memory, so they cost nothing. `len(data)` is the number of samples.
    A dataset can be pickled. Only its folder is stored.

    Args:
        folder: the dataset's folder, such as `results/datasets/empty-5d8f5c7d1f9a3b64`.
        frames: also reads the images, which take 12 kB per sample. If they would take more than an eighth of the free
            memory, they stay on disk.

    Raises:
        FileNotFoundError: the folder contains no dataset.
        RuntimeError: an episode is missing or damaged.

    Example:
        >>> model = harness.load_model("smoke/empty-z4")
        >>> data = harness.Dataset(f"results/datasets/{model.dataset}")
        >>> data
        <harness.Dataset empty-...: 120 samples in 4 episodes>
        >>> data["contact_force"].shape, data["vision"].shape
        ((120, 20), (120, 64, 64, 3))
        >>> [data.episode(index)["arm"].shape for index in data.episodes("test")]
        [(30, 3)]
    """

    def __contains__(self, name: object) -> bool:
        """Returns whether the dataset contains a modality."""
        return name in self.keys()

    # Without it, Python would iterate over data[0], data[1] and so on.
    __iter__ = None

    def episode(self, index: int) -> dict[str, "NDArray[Any]"]:
        """Returns the samples of one episode by modality, as views.

        Args:
            index: the episode, from 0. A negative number counts from the last episode.

        Raises:
            IndexError: there is no such episode.
        """
        bounds = self.bounds
        index = integer("index", index)
        if not -len(bounds) <= index < len(bounds):
            raise IndexError(f"index: there are episodes 0 to {len(bounds) - 1}, not {index}")
        first, end = bounds[index]
        return {name: self[name][first:end] for name in self.keys()}

    def episodes(
        self, part: str | None = None, *, validation: float = 0.1, test: float = 0.1
    ) -> "NDArray[np.int64]":
        """Returns the indices of the episodes of a part of the dataset, when whole episodes are split.

        Args:
            part: `training`, `validation` or `test`. The default is all episodes.
            validation: the share of episodes for validation, in (0, 1), as in a spec's `split`.
            test: the share of episodes for the test, in (0, 1).

        Returns:
            The indices, `[episodes]`, in ascending order.

        Raises:
            ValueError: there is no such part, or a part would have no episodes.

        Example:
            >>> model = harness.load_model("smoke/empty-z4")
            >>> data = harness.Dataset(f"results/datasets/{model.dataset}")
            >>> data.episodes("training"), data.episodes("validation"), data.episodes("test")
            (array([0, 1]), array([2]), array([3]))
        """
        import numpy as np

        ends = self.bounds[:, 1]
        if part is None:
            return np.arange(len(ends))
        starts = self.split(part, validation=validation, test=test)
        return np.unique(np.searchsorted(ends, starts, side="right"))

    def torch(
        self,
        input: str | Iterable[str],
        output: str | Iterable[str],
        action: str = "increment",
        samples: "NDArray[np.int64] | None" = None,
    ) -> "Transitions":
        """Returns the transitions as a PyTorch map-style dataset; see `harness.torch.Transitions`.

        Args:
            input: modalities of the observation before each transition.
            output: modalities of the observation after it.
            action: `increment`, the change of the setpoint, or `target`, the setpoint after the transition.
            samples: the samples from which the transitions start, such as `split("training")`. The default is all.

        Raises:
            ImportError: the package torch is not installed.
            KeyError: the dataset does not contain a modality.
            ValueError: there is no such action, or a transition can't start from a sample.

        Example:
            >>> model = harness.load_model("smoke/empty-z4")
            >>> data = harness.Dataset(f"results/datasets/{model.dataset}")
            >>> data.torch(["proprioception"], ["contact_force"], samples=data.split("training"))      # needs torch
            <harness.torch.Transitions: 58 from proprioception and increment to contact_force>
        """
        try:
            from .torch import Transitions
        except ImportError as error:
            raise ImportError(f"Dataset.torch needs PyTorch: pip install torch ({error})") from error
        return Transitions(self, input, output, action, samples)


def _changes(overrides: Mapping[str, Any] | None) -> list[str]:
    """Returns changed settings as on the command line, `KEY=VALUE`."""
    return [f"{key}={_text('overrides', key, value)}" for key, value in _items("overrides", overrides)]


def _question(
    experiments: Iterable[str],
    of: str | Iterable[str] = (),
    metrics: str | Iterable[str] = (),
    models: str | Iterable[str] = (),
    task: str | None = None,
    horizon: int | str | Iterable[int | str] = (),
    given: str | Iterable[str] = (),
    by: str | Iterable[str] = (),
    where: Mapping[str, Any] | None = None,
    against: str | None = None,
    interval: str = "mean",
) -> dict[str, Any]:
    """Returns a question; see `answer`."""
    horizons = horizon if isinstance(horizon, Iterable) and not isinstance(horizon, str) else [horizon]
    return {
        "experiments": _names("experiments", experiments),
        "of": list(name_tuple(of)),
        "metrics": list(name_tuple(metrics)),
        "models": list(name_tuple(models)),
        "task": task,
        "horizon": [str(ahead) for ahead in horizons],
        "given": ",".join(name_tuple(given)) or None,
        "by": list(name_tuple(by)),
        "settings": _settings(where),
        "against": against,
        "interval": interval,
    }


def _settings(where: Mapping[str, Any] | None) -> list[str]:
    """Returns settings that runs must have, as on the command line, where texts have no quotes."""
    items = _items("where", where)
    return [f"{key}={value if isinstance(value, str) else _text('where', key, value)}" for key, value in items]


def _items(argument: str, settings: Mapping[str, Any] | None) -> Iterable[tuple[str, Any]]:
    """Returns the settings of a dictionary."""
    if not isinstance(settings, Mapping | None):
        raise TypeError(f"{argument}: {settings!r} must be a dictionary, such as {{'training.epochs': 5}}")
    return (settings or {}).items()


def _text(argument: str, key: str, value: Any) -> str:
    """Returns the value of a setting in JSON. Numbers and arrays of NumPy are converted, and paths."""

    def plain(other: Any) -> Any:
        return os.fspath(other) if isinstance(other, os.PathLike) else other.tolist()

    try:
        return json.dumps(value, default=plain)
    except (AttributeError, TypeError):
        kind = type(value).__name__
        raise TypeError(f"{argument}: '{key}' is a {kind}; allowed: text, number, boolean, None, list, dict") from None


def _names(argument: str, names: Iterable[str]) -> list[str]:
    """Returns names that were given as positional arguments."""
    for name in names:
        if not isinstance(name, str):
            raise TypeError(f"{argument}: {name!r} must be a text; give several names as several arguments")
    return list(names)


def __dir__() -> list[str]:
    """Lists the public names."""
    return sorted([*__all__, "__version__", "__doc__", "__file__", "__name__", "__path__"])
