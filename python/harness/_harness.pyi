import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from typing_extensions import disjoint_base

__all__ = [
    "Dataset",
    "Model",
    "PolicyDataset",
    "Recorder",
    "Replays",
    "SimulationBatch",
    "Table",
    "Task",
    "add_metric",
    "answer",
    "attached",
    "claims",
    "collect",
    "export_onnx",
    "extract",
    "figures",
    "main",
    "may_have_network",
    "networks",
    "plot",
    "query",
    "read_mapping",
    "recorded",
    "recording_notes",
    "reserved_names",
    "report",
    "report_dataset",
    "run",
    "verify",
]

def main(arguments: list[str], program: list[str]) -> int:
    """Runs the command line; returns its exit code. program: the command that starts it, for scripts of Slurm jobs."""

def run(
    path: Path, overrides: list[str], quick: bool, results: Path, progress: bool, jobs: int, memory: int | None
) -> tuple[int, int]:
    """Numbers of runs that this call completed and that were done before; see `harness.run`."""

def query(sql: str, results: Path) -> Table:
    """See `harness.query`."""

def answer(question: dict[str, Any], results: Path) -> Table:
    """See `harness.answer`."""

def claims(
    chosen: list[str], file: Path, reading: str | None, quick: bool, settings: list[str], results: Path
) -> Table:
    """See `harness.claims`."""

def figures(
    names: list[str],
    folder: Path,
    formats: list[str],
    quick: bool,
    single: str | None,
    multi: str | None,
    reading: str | None,
    experiment: str | None,
    of: str | None,
    settings: list[str],
    results: Path,
) -> tuple[list[str], list[tuple[str, str]]]:
    """The figures that were drawn, and the others with the reason; see `harness.figures`."""

def plot(question: dict[str, Any], x: str, facet: str | None, output: Path, results: Path) -> None:
    """See `harness.plot`."""

def report(
    experiments: list[str],
    output: Path,
    claims: Path,
    quick: bool,
    settings: list[str],
    results: Path,
    progress: bool,
) -> None:
    """See `harness.report`."""

def report_dataset(dataset: str, output: Path, results: Path, progress: bool) -> None:
    """Writes the page of a dataset; see `harness.report`."""

def verify(results: Path) -> tuple[int, int, int, list[tuple[Path, str, str | None, bool]]]:
    """Numbers of runs, datasets and files, and the problems; see `harness.verify`."""

def collect(
    path: Path, overrides: list[str], quick: bool, results: Path, progress: bool, workers: int | None
) -> list[tuple[Path, int]]:
    """Each dataset's folder with the number of episodes that were simulated; see `harness.collect`."""

def reserved_names() -> list[str]:
    """The names that no modality may have, because they have another meaning."""

def read_mapping(path: Path) -> str:
    """Reads and checks a mapping. Returns its content as JSON, whose keys are in the file's order.

    Raises FileNotFoundError if the file does not exist, and ValueError for its first fault, with its line and column.
    """

def recording_notes(datasets: Path, name: str) -> tuple[str, list[str]]:
    """Returns how runs divide an imported dataset, and what may be wrong with it, in sentences.

    Raises OSError if the dataset can't be read.
    """

def networks(run: str, results: Path) -> list[tuple[str, Path]]:
    """Task, path and description, as JSON, of each network of a run; see `harness.load_network`."""

def may_have_network(run: str, results: Path) -> bool:
    """Whether a run of a results folder whose id, or `EXPERIMENT/ID`, begins with `run` may have a network."""

def attached(run: str, results: Path) -> Path | None:
    """Path of the file that was attached to a run of a model of another program; see `harness.load_network`."""

def add_metric(
    run: str,
    name: str,
    unit: str,
    values: list[tuple[str, int, str | None, float | None]],
    results: Path,
) -> None:
    """Writes the values of a user's metric to the tables of a run; see `harness.add_metric`."""

def recorded(experiment: str, run: str, results: Path) -> tuple[str, str]:
    """The record of a run, as JSON, and its resolved spec in YAML. Raises KeyError if there is no such run."""

def extract(run: str, folder: Path, results: Path) -> None:
    """Writes the files of a published run to a folder. Raises KeyError if there is no such run."""

def export_onnx(run: str, output: Path, task: str, results: Path) -> None:
    """See `harness.export_onnx`."""

@final
class Replays:
    """The compiled part of `harness.fitting.fit_world`."""

    def __new__(cls, datasets: Path, dataset: str, world: str, outputs: list[str]) -> Replays: ...
    def ranges(self) -> dict[str, list[float]]:
        """Returns the lowest and the highest value of each factor of variation of the world."""

    def errors(self, factors: dict[str, float]) -> NDArray[np.float64]:
        """Returns the errors of all values of the training episodes with these factors, in standard deviations."""

@final
class Table:
    """A table that readers of Arrow's C stream interface can read."""

    def __arrow_c_stream__(self, requested_schema: object | None = None) -> Any: ...

@final
class PolicyDataset:
    """A dataset whose setpoints a Python function gives; see `harness.collect`."""

    @staticmethod
    def of(
        path: Path, overrides: list[str], quick: bool, results: Path, policy: str, progress: bool
    ) -> list[PolicyDataset]:
        """Returns the datasets of an experiment with the policy `NAME@VERSION`. These are those in which
        `simulation.policy` names this policy, or all datasets if it names none. Writes nothing."""

    @property
    def name(self) -> str:
        """Name of the folder: the scenario, and a hash of everything that determines the dataset."""

    @property
    def folder(self) -> Path:
        """Path of the folder."""

    def claim(self) -> list[int]:
        """Locks the folder, for which it may wait, and returns the indices of the missing episodes."""

    def advance(self, samples: int) -> None:
        """Shows on the terminal that this number of samples has been simulated."""

    def release(self, discarded: list[int]) -> None:
        """Removes those of these episodes that have a file, and the folder if it has no others. Unlocks the folder."""

    def recorder(self) -> Recorder:
        """Returns a recorder of the dataset's episodes."""

@final
class Recorder:
    """Records the episodes of a dataset, one after the other, with the setpoints that its caller gives."""

    def start(self, episode: int) -> None:
        """Starts an episode, and records its first sample, which is at rest."""

    def step(self, setpoint: ArrayLike) -> None:
        """Records the next sample. Meanwhile the setpoint moves to the given one, `[elements]`, at constant speed."""

    def values(self, modality: str, first: int) -> NDArray[Any]:
        """Returns the recorded values of a modality from the sample `first` on, `[samples, ...]`."""

    def save(self) -> None:
        """Writes the episode, all of whose samples must be recorded."""

    @property
    def scenario(self) -> str:
        """Name of the world."""

    @property
    def seed(self) -> int:
        """Seed of the dataset."""

    @property
    def samples(self) -> int:
        """Number of samples in an episode."""

    @property
    def sample_seconds(self) -> float:
        """Time from one sample to the next, s."""

    @property
    def modalities(self) -> dict[str, tuple[int, ...]]:
        """The recorded modalities: the shape of a sample's values, by name."""

    @property
    def action(self) -> list[str]:
        """Names of the elements of a setpoint."""

    @property
    def setpoint_ranges(self) -> NDArray[np.float64]:
        """Lowest and highest value of each element of a setpoint, `[elements, 2]`, in rad or m."""

@disjoint_base
class Task:
    """The compiled part of `harness.PredictionTask`."""

    def __new__(
        cls,
        path: Path,
        text: str | None,
        overrides: list[str],
        quick: bool,
        cell: str | None,
        results: Path,
        progress: bool,
    ) -> Task: ...
    def description(self) -> str:
        """Returns the description of the task, as JSON."""

    def yaml(self) -> str:
        """Returns the spec of the task as YAML. Raises ValueError if its world is a file."""

    def bounds(self) -> NDArray[np.int64]:
        """Returns the samples of each episode, `[episodes, 2]`: index of the first one, of the last one plus 1."""

    def windows(self, part: str) -> NDArray[np.int64]:
        """Returns the present samples of the windows of a part, `[windows]`, int64."""

    def array(self, name: str) -> NDArray[Any]:
        """Returns all samples of a modality, as `Dataset` does."""

    def judge(
        self,
        predictions: list[tuple[str, int, NDArray[Any]]],
        model: str,
        seed: int,
        notes: dict[str, str],
        network: Path | None,
        command: list[str],
        progress: bool,
    ) -> tuple[str, bool]:
        """Judges predictions of the test windows. Returns the name of the run, and whether it was done before."""

@disjoint_base
class Dataset:
    """The compiled part of `harness.Dataset`."""

    def __new__(cls, folder: str | os.PathLike[str], frames: bool = True) -> Dataset: ...
    def __len__(self) -> int:
        """Number of samples of all episodes."""

    def __getitem__(self, name: str, /) -> NDArray[Any]:
        """All samples of a modality, `[samples, width]` or `[samples, rows, columns, 3]`. Raises KeyError."""

    def keys(self) -> list[str]:
        """Returns the names of the modalities that the dataset contains."""

    def split(
        self,
        part: str,
        *,
        by: str = "episode",
        validation: float = 0.1,
        test: float = 0.1,
        gap_seconds: float | None = None,
    ) -> NDArray[np.int64]:
        """Returns the samples from which the transitions of a part start.

        A transition leads from a sample to the next one of the same episode. The arguments and defaults are those of a
        spec's `split`, so the parts are those that a network is trained and tested on.

        Args:
            part: `training`, `validation` or `test`.
            by: what is divided: `episode` (whole episodes), `time` (each episode, with gaps between the parts) or
                `sample` (transitions, at random).
            validation: the share for validation, in (0, 1).
            test: the share for the test, in (0, 1).
            gap_seconds: the time between the parts of a split by time, s, in [0, 3600]. The default is 5.

        Returns:
            The indices of the samples, `[transitions]`, int64.

        Raises:
            ValueError: an argument is wrong, or a part would have no transitions.
        """

    def __reduce__(self) -> tuple[type[Dataset], tuple[Path, bool]]: ...
    def simulation(self, count: int = 1) -> SimulationBatch:
        """Creates simulations with the settings of the dataset. With `reset` and `follow` they go through its episodes.

        Args:
            count: number of simulations, 1 to 4096.

        Raises:
            ValueError: the dataset was imported or simulated in a world file, or the count is out of range.

        Example:
            >>> model = harness.load_model("smoke/empty-z4")
            >>> data = harness.Dataset(f"results/datasets/{model.dataset}")
            >>> simulation = data.simulation()
            >>> simulation.reset(0, data.seed, 3)                # the start of episode 3
            >>> simulation.follow()
            >>> bool((simulation.sense("arm")[0] == data.episode(3)["arm"][1]).all())
            True
        """

    @property
    def name(self) -> str:
        """Name of the folder: the scenario, and a hash of everything that determines the dataset."""
    @property
    def scenario(self) -> str:
        """Name of the world that was simulated, such as `empty`, or name of an imported dataset."""
    @property
    def sample_rate_hz(self) -> float:
        """Number of samples per second."""
    @property
    def seed(self) -> int | None:
        """Seed of the simulation; None for an imported dataset. The seed and an index determine an episode."""
    @property
    def bounds(self) -> NDArray[np.int64]:
        """The samples of each episode, `[episodes, 2]`: the index of the first one, and of the last one plus 1."""

@final
class Model:
    """The trained network of a finished run. `load_model` opens it.

    An observation is a dictionary of arrays by modality. It must have exactly the modalities in `input`. Vectors are
    `[batch, width]` in SI units. Images are `[batch, rows, columns, 3]`, either uint8 or floating-point numbers in
    [0, 1]. Changes of images, such as `frame_difference`, are floating-point numbers in [-1, 1]. Lists, and arrays of
    other numeric types, are converted to float32. A single sample can be given without the axis of the batch. Then the
    answer has no such axis either.

    The network computes on the CPU and never changes. It can be pickled. Only the name of its run and the folder are
    stored.

    Args:
        run: the beginning of the run's id, or of `EXPERIMENT/ID`, as in `load_model`.
        results: the folder of datasets and runs. The default is `results`.

    Example:
        >>> model = harness.load_model("smoke/empty-z4")
        >>> model.input, model.latent
        (['proprioception', 'vision'], 4)
        >>> observation = {"proprioception": [0.0] * 20, "vision": [[[0.5] * 3] * 64] * 64}      # a single sample
        >>> mean, log_variance = model.encode(observation)
        >>> mean.shape
        (4,)
        >>> model.predict(observation, [0.1, 0.0, 0.0])["contact_force"].shape
        (20,)
    """

    def __new__(cls, run: str, results: str | os.PathLike[str] = ...) -> Model: ...
    def __reduce__(self) -> tuple[type[Model], tuple[str, Path]]: ...
    def encode(
        self, observation: dict[str, ArrayLike]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Returns the posterior of the latent state for an observation.

        Args:
            observation: the values of the modalities in `input`, by name.

        Returns:
            The mean and the log-variance of the posterior, each `[batch, latent]`, float32.

        Raises:
            KeyError: a modality is missing, or there is one that the network does not take.
            ValueError: an array has the wrong shape, or a value that is not finite or out of range.
            TypeError: an array does not consist of numbers.
        """

    def predict(
        self, observation: dict[str, ArrayLike], action: ArrayLike | None = None
    ) -> dict[str, NDArray[np.float32]]:
        """Predicts the observation one sample later, from the mean of the posterior.

        Args:
            observation: the values of the modalities in `input`, by name.
            action: `[batch, elements]`, in the form that the property `action` names. The elements of the worlds
                `empty` and `cluttered` are rotation (rad), lift and extension (m). None for a network without action.

        Returns:
            The predicted values of the modalities in `output`, by name, float32, in SI units. Predicted images may be
            slightly outside of [0, 1].

        Raises:
            KeyError: a modality is missing, or there is one that the network does not take.
            ValueError: an array has the wrong shape, or a value that is not finite or out of range.
            TypeError: an array does not consist of numbers.
        """

    def reconstruct(self, latent: ArrayLike) -> dict[str, NDArray[np.float32]]:
        """Reconstructs the present observation from a latent state.

        Args:
            latent: `[batch, latent]`, such as the mean that `encode` returns.

        Returns:
            The reconstructed values of the modalities in `input`, by name, float32, in SI units.

        Raises:
            RuntimeError: the run did not train a reconstruction.
            ValueError: the array has the wrong shape, or a value that is not finite.
            TypeError: the array does not consist of numbers.
        """

    @property
    def run(self) -> str:
        """Id of the run, which is the name of its folder."""
    @property
    def experiment(self) -> str:
        """Name of the run's experiment."""
    @property
    def dataset(self) -> str:
        """Name of the dataset that the network was trained on, a folder in `results/datasets`."""
    @property
    def scenario(self) -> str:
        """Name of the simulated world, or of the imported dataset."""
    @property
    def input(self) -> list[str]:
        """Names of the modalities that the encoder takes."""
    @property
    def output(self) -> list[str]:
        """Names of the modalities that the decoder predicts."""
    @property
    def latent(self) -> int:
        """Size of the latent state."""
    @property
    def action(self) -> str:
        """Form of the action: `increment` (the setpoint's change) or `target` (the setpoint at the next sample)."""

@final
class SimulationBatch:
    """One simulation of a world, or many that are stepped in parallel.

    Each simulation is at a sample of an episode. A new one is at the start of the first episode. `reset` starts an
    episode, and `step` and `follow` go on to the next sample. `sense` returns what a dataset records at a sample.

    Any call raises RuntimeError while another thread is in a call, in a forked process, and after a simulation has
    become unstable, until it is reset. Simulations can't be pickled.

    Args:
        scenario: a built-in world, such as `empty` or `cluttered`, or the path of a world file.
        count: number of simulations, 1 to 4096.
        spec: an experiment, whose simulation settings are used: the path of a YAML file, or the name of a built-in
            experiment. The default is the world's own settings.

    Raises:
        ValueError: there is no such world, a world file or its model is wrong, the count is out of range, or the spec
            is wrong.
        FileNotFoundError: there is no such experiment.

    Example:
        >>> batch = harness.SimulationBatch("cluttered", 2)
        >>> batch.reset(0, seed=0, episode=5)
        >>> batch.reset(1, seed=0, episode=6)
        >>> batch.step(batch.setpoint + [0.05, 0.0, 0.0])        # rotates both arms by 0.05 rad
        >>> batch.sense("contact_force").shape
        (2, 20)
    """

    def __new__(
        cls, scenario: str | os.PathLike[str], count: int = 1, spec: str | os.PathLike[str] | None = None
    ) -> SimulationBatch: ...
    def reset(self, index: int, seed: int, episode: int) -> None:
        """Sets one simulation to the start of an episode.

        Args:
            index: the simulation, from 0.
            seed: the seed of a dataset, 0 to 2^53 - 1.
            episode: the index of an episode of that dataset.

        Raises:
            ValueError: an argument is out of range.
        """

    def step(self, setpoints: ArrayLike, active: Sequence[bool] | NDArray[np.bool_] | None = None) -> None:
        """Simulates until the next sample. Meanwhile the setpoint moves to the given one at constant speed.

        Args:
            setpoints: `[count, elements]`, clipped to `setpoint_ranges`. The elements of the worlds `empty` and
                `cluttered` are rotation (rad), lift and extension (m).
            active: `[count]`, booleans: which simulations to step. The default is all.

        Raises:
            ValueError: the shape is wrong, or a value is not finite.
            TypeError: the setpoints are not numbers, or `active` has other values than booleans.
        """

    def follow(self) -> None:
        """Simulates until the next sample, with the setpoints of the episode, as in a dataset."""

    def sense(self, modality: str) -> NDArray[Any]:
        """Returns the values of a modality at the present samples.

        Args:
            modality: one of `modalities`.

        Returns:
            A vector `[count, elements]`, float32, or an image `[count, rows, columns, 3]`, uint8.

        Raises:
            KeyError: the world does not have the modality.
        """

    def render(self, index: int, width: int, height: int) -> NDArray[np.uint8]:
        """Renders a picture of one simulation, in better quality than the images of datasets.

        Args:
            index: the simulation, from 0.
            width: number of columns, 1 to 4096 pixels.
            height: number of rows, 1 to 4096 pixels.

        Returns:
            The picture, `[height, width, 3]`, uint8.

        Raises:
            ValueError: an argument is out of range.
        """

    @property
    def scenario(self) -> str:
        """Name of the world."""
    @property
    def modalities(self) -> dict[str, tuple[int, ...]]:
        """The modalities that can be sensed: the shape of one simulation's values, by name."""
    @property
    def action(self) -> list[str]:
        """Names of the elements of a setpoint, such as `rotation`."""
    @property
    def count(self) -> int:
        """Number of simulations."""
    @property
    def seed(self) -> int:
        """Seed of the episodes' random streams. It is that of the dataset or, for the episodes of a test, a larger one."""
    @property
    def sample_seconds(self) -> float:
        """Time from one sample to the next, s."""
    @property
    def actuation_seconds(self) -> float:
        """Duration of one move of the setpoint in the episodes of datasets, s."""
    @property
    def setpoint_ranges(self) -> NDArray[np.float64]:
        """Lowest and highest value of each element of a setpoint, `[elements, 2]`, in rad or m."""
    @property
    def setpoint(self) -> NDArray[np.float64]:
        """The setpoints at the present samples, `[count, elements]`, in rad or m."""
    @property
    def fingertip(self) -> NDArray[np.float64]:
        """Positions of the finger's end, `[count, 3]`, m. Raises ValueError for a world without a finger."""
    @property
    def boxes(self) -> NDArray[np.float64]:
        """Poses of the boxes, `[count, boxes, 7]`: position (m) and orientation (unit quaternion w, x, y, z)."""
