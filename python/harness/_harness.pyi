from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from typing_extensions import disjoint_base

__all__ = [
    "Dataset",
    "Model",
    "SimulationBatch",
    "Table",
    "claims",
    "collect",
    "compare",
    "export_onnx",
    "figures",
    "main",
    "networks",
    "query",
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

def compare(experiments: list[str], settings: list[str], results: Path) -> Table:
    """See `harness.compare`."""

def claims(
    chosen: list[str], file: Path, quick: bool, settings: list[str], results: Path
) -> Table:
    """See `harness.claims`."""

def figures(
    names: list[str],
    folder: Path,
    formats: list[str],
    quick: bool,
    single: str | None,
    multi: str | None,
    settings: list[str],
    results: Path,
) -> tuple[list[str], list[tuple[str, str]]]:
    """The figures that were drawn, and the others with the reason; see `harness.figures`."""

def verify(results: Path) -> tuple[int, int, int, list[tuple[Path, str, str | None, bool]]]:
    """Numbers of runs, datasets and files, and the problems; see `harness.verify`."""

def collect(
    path: Path, overrides: list[str], quick: bool, results: Path, progress: bool
) -> list[tuple[Path, int]]:
    """Each dataset's folder with the number of episodes that were simulated; see `harness.collect`."""

def networks(run: str, results: Path) -> list[tuple[str, Path, str]]:
    """Task, path and description, as JSON, of each network of a run; see `harness.load_network`."""

def export_onnx(run: str, output: Path, task: str, results: Path) -> None:
    """See `harness.export_onnx`."""

@final
class Table:
    """A table that readers of Arrow's C stream interface can read."""

    def __arrow_c_stream__(self, requested_schema: object | None = None) -> Any: ...

@disjoint_base
class Dataset:
    def __new__(cls, folder: str | Path, frames: bool = True) -> Dataset:
        """Reads a dataset's folder, such as `results/datasets/empty-…`, with its frames (12 kB per sample) or without.

        Raises FileNotFoundError if there is no such folder, and RuntimeError if an episode is missing or damaged.
        """

    def __len__(self) -> int:
        """Number of samples of all episodes."""

    def __getitem__(self, name: str, /) -> NDArray[Any]:
        """All samples of a modality: `[samples, width]`, float32; vision `[samples, 64, 64, 3]`, uint8.

        proprioception: 20 joint angles, rad. arm, setpoint: rotation (rad), lift and extension (m). contact_force: the
        normal force on each of 20 links at the instant of the sample, N. contact_force_mean: the same averaged over the
        time since the previous sample. Raises KeyError for other names.
        """

    def keys(self) -> list[str]:
        """Names of the modalities that the dataset contains; an imported one may lack some."""

    def parts(
        self, by: str, validation: float, test: float, gap_seconds: float | None
    ) -> list[NDArray[np.int64]]:
        """First samples of the transitions for training, validation and test; see `harness.Dataset.split`."""

    def __reduce__(self) -> tuple[type[Dataset], tuple[Path, bool]]: ...
    def simulation(self, count: int = 1) -> SimulationBatch:
        """Simulations of the same scenario with the dataset's settings, so that its episodes can be followed.

        Raises ValueError if the dataset was imported.
        """

    @property
    def name(self) -> str:
        """The folder's name: the scenario, or an imported dataset's own name, and a hash of all that determines it."""
    @property
    def scenario(self) -> str:
        """`empty`, `cluttered`, or the name of an imported dataset."""
    @property
    def sample_rate_hz(self) -> float:
        """Samples per second."""
    @property
    def seed(self) -> int | None:
        """Seed of the dataset. With the scenario and an episode's index it determines the episode. None if imported."""
    @property
    def episodes(self) -> NDArray[np.int64]:
        """Range of each episode's samples, `[episodes, 2]`: the first, and one past the last."""

@final
class Model:
    """The network of a finished run. It computes in physical units on the CPU and never changes.

    Observations are dictionaries by the modalities of `input`: vectors `[batch, width]`; vision `[batch, 64, 64, 3]`,
    uint8 or numbers in [0, 1]; frame_difference `[batch, 64, 64, 3]`, numbers in [-1, 1]. Arrays of other numeric types
    and lists are converted to float32. A single sample can be given without the axis of the batch. The answer then has
    no such axis either.
    """

    def __new__(cls, run: str, results: Path) -> Model: ...
    def __reduce__(self) -> tuple[type[Model], tuple[str, Path]]: ...
    def encode(
        self, observation: dict[str, ArrayLike]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Mean and log-variance of the posterior, `[batch, latent]` each.

        Raises KeyError if a modality of `input` is missing or there is another one, ValueError if one has the wrong
        shape, and TypeError if one does not consist of numbers.
        """

    def predict(
        self, observation: dict[str, ArrayLike], action: ArrayLike
    ) -> dict[str, NDArray[np.float32]]:
        """Predicts the observation one sample later from the posterior's mean, by modality of `output`.

        action: `[batch, 3]`, rotation (rad), lift and extension (m), in the form that `self.action` names. Frames are
        `[batch, 64, 64, 3]`, those of vision in [0, 1]. Raises the same errors as `encode`.
        """

    def reconstruct(self, latent: ArrayLike) -> dict[str, NDArray[np.float32]]:
        """Reconstructs the observation from a latent state `[batch, latent]`, by modality of `input`.

        Raises RuntimeError if the run trained no reconstruction, and ValueError if `latent` has the wrong shape.
        """

    @property
    def run(self) -> str:
        """Id of the run, its folder's name."""
    @property
    def experiment(self) -> str:
        """Name of the run's experiment."""
    @property
    def dataset(self) -> str:
        """Name of the dataset that it was trained on, a folder of `results/datasets`."""
    @property
    def scenario(self) -> str:
        """Name of the world, or of the imported dataset."""
    @property
    def input(self) -> list[str]:
        """The modalities that the encoder takes."""
    @property
    def output(self) -> list[str]:
        """The modalities that the decoder predicts."""
    @property
    def latent(self) -> int:
        """Size of the latent state."""
    @property
    def action(self) -> str:
        """`increment` (the setpoint's change from this sample to the next) or `target` (the setpoint at the next)."""

@final
class SimulationBatch:
    """`count` independent simulations of a world, stepped in parallel.

    scenario: a built-in world's name (`empty`, `cluttered`) or the path of a world file. spec: an experiment's YAML
    file, whose simulation settings are used; the world's defaults without one.

    Each simulation is at a sample of an episode. It senses the same values that a dataset records. With a dataset's
    settings, `follow` gives the samples of the dataset's episode bit for bit; `Dataset.simulation` uses these settings.

    A call raises RuntimeError while a call in another thread is running, and in a forked process. A simulation that has
    become unstable raises RuntimeError until it is reset.
    """

    def __new__(cls, scenario: str, count: int = 1, spec: str | Path | None = None) -> SimulationBatch: ...
    def reset(self, index: int, seed: int, episode: int) -> None:
        """Sets a simulation to the start of the episode with this index in the dataset with this seed."""

    def step(self, setpoints: NDArray[np.float64], active: NDArray[np.bool_] | None = None) -> None:
        """Steps each simulation to its next sample, while the setpoint moves at constant speed to `setpoints[index]`.

        setpoints: `[count, elements]`, clipped to `setpoint_ranges`; for the finger rotation (rad), lift and extension
        (m). active: `[count]`, the simulations to step; all by default. Raises ValueError for the wrong shape or a
        value that is not finite.
        """

    def follow(self) -> None:
        """Steps each simulation to its next sample, with the setpoints of its episode."""

    def sense(self, modality: str) -> NDArray[Any]:
        """Values of one of `modalities`: a vector `[count, elements]`, float32, or an image
        `[count, rows, columns, 3]`, uint8. Raises KeyError for another modality."""

    def render(self, index: int, width: int, height: int) -> NDArray[np.uint8]:
        """Renders a simulation in good quality, `[height, width, 3]`, each side 1 to 4096 pixels."""

    @property
    def scenario(self) -> str:
        """The world's name."""
    @property
    def modalities(self) -> dict[str, tuple[int, ...]]:
        """Names of the modalities that are sensed, with the shape of one simulation's values."""
    @property
    def action(self) -> list[str]:
        """Names of the elements of the action."""
    @property
    def count(self) -> int:
        """Number of simulations."""
    @property
    def seed(self) -> int:
        """The seed of the spec's dataset."""
    @property
    def sample_seconds(self) -> float:
        """Time from one sample to the next, s."""
    @property
    def actuation_seconds(self) -> float:
        """Duration of a move from one setpoint to the next in a dataset's episode, s."""
    @property
    def setpoint_ranges(self) -> NDArray[np.float64]:
        """Lowest and highest setpoint of each element of the action, `[elements, 2]`."""
    @property
    def setpoint(self) -> NDArray[np.float64]:
        """The setpoints at this sample, `[count, elements]`."""
    @property
    def fingertip(self) -> NDArray[np.float64]:
        """Positions of the finger's end, m, `[count, 3]`. Raises ValueError if the world senses no forces of links."""
    @property
    def boxes(self) -> NDArray[np.float64]:
        """Positions (m) and orientations (unit quaternions w, x, y, z) of the boxes, `[count, boxes, 7]`."""
