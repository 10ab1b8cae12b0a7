from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray
from typing_extensions import disjoint_base

__all__ = ["Dataset", "Model", "SimulationBatch", "Table", "compare", "main", "query", "run"]

def main(arguments: list[str]) -> int:
    """Runs the command line; returns its exit code."""

def run(
    path: Path, overrides: list[str], quick: bool, results: Path, progress: bool, jobs: int, memory: int | None
) -> tuple[int, int]:
    """Numbers of runs that were done now and before; see `harness.run`."""

def query(sql: str, results: Path) -> Table:
    """See `harness.query`."""

def compare(experiments: list[str], settings: list[str], results: Path) -> Table:
    """See `harness.compare`."""

@final
class Table:
    """An answer, for whoever reads Arrow's C stream interface."""

    def __arrow_c_stream__(self, requested_schema: object | None = None) -> Any: ...

@disjoint_base
class Dataset:
    def __new__(cls, folder: str | Path, frames: bool = True) -> Dataset:
        """Reads a dataset's folder, as `results/datasets/empty-…`, with its frames (12 kB a sample) or without.

        Raises FileNotFoundError where there is no such folder, RuntimeError where an episode is missing or damaged.
        """

    def __len__(self) -> int:
        """Samples in all."""

    def __getitem__(self, name: str, /) -> NDArray[Any]:
        """All samples of what was recorded: `[samples, width]`, float32; vision `[samples, 64, 64, 3]`, uint8.

        proprioception: 20 joint angles, rad. arm, setpoint: rotation (rad), lift and extension (m). contact_force,
        contact_force_mean: the normal force on each of 20 links at the instant, and averaged over the sample before it, N.
        Raises KeyError for other names.
        """

    def keys(self) -> list[str]:
        """What the dataset holds; an imported one may lack some."""

    def simulation(self, count: int = 1) -> SimulationBatch:
        """Simulations of the same scenario with the dataset's own settings, in which its episodes can be followed.

        Raises ValueError where the dataset was imported.
        """

    @property
    def name(self) -> str:
        """The folder's name: the scenario, or an imported dataset's own name, and a hash of what decides the content."""
    @property
    def scenario(self) -> str:
        """`empty`, `cluttered`, or the name of an imported dataset."""
    @property
    def sample_rate_hz(self) -> float:
        """Samples a second."""
    @property
    def seed(self) -> int | None:
        """Seed of the dataset; an episode is decided by it, the scenario and the episode's index. None of an import."""
    @property
    def episodes(self) -> NDArray[np.uint64]:
        """Where each episode's samples lie, `[episodes, 2]`: the first, and one past the last."""

@final
class Model:
    """The network of a finished run, in physical units; it works on the CPU and never changes.

    Observations are dictionaries by modality: vectors `[batch, width]`, float32; vision `[batch, 64, 64, 3]`, uint8 or
    float32 in [0, 1]; frame_difference `[batch, 64, 64, 3]`, float32 in [-1, 1]. What the encoder is not given is
    ignored.
    """

    def __new__(cls, run: str, results: Path) -> Model: ...
    def encode(
        self, observation: dict[str, NDArray[Any]]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Mean and log-variance of the posterior, `[batch, latent]` each.

        Raises KeyError where a modality of `input` lacks, ValueError where one has another shape, TypeError where it has
        another type.
        """

    def predict(
        self, observation: dict[str, NDArray[Any]], action: NDArray[np.float32]
    ) -> dict[str, NDArray[np.float32]]:
        """The observation one sample later, by modality of `output`, from the posterior's mean.

        action: `[batch, 3]`, float32, rotation (rad), lift and extension (m), in the form that `self.action` says. Frames
        are `[batch, 64, 64, 3]`, those of vision in [0, 1]. Raises as `encode`.
        """

    def reconstruct(self, latent: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
        """The observation that a latent state `[batch, latent]`, float32, holds, by modality of `input`.

        Raises RuntimeError where the run trained no reconstruction, ValueError where `latent` has another shape.
        """

    @property
    def run(self) -> str: ...
    @property
    def experiment(self) -> str: ...
    @property
    def dataset(self) -> str:
        """Name of the dataset that it was trained on, a folder of `results/datasets`."""
    @property
    def scenario(self) -> str: ...
    @property
    def input(self) -> list[str]:
        """The modalities that the encoder is given."""
    @property
    def output(self) -> list[str]:
        """The modalities that the decoder predicts."""
    @property
    def latent(self) -> int:
        """Size of the latent state."""
    @property
    def action(self) -> str:
        """`increment`, the setpoint's change from this sample to the next, or `target`, the setpoint at the next."""

@final
class SimulationBatch:
    """`count` simulations of a world, by its name (`empty`, `cluttered`) or the path of its file, independent of each other and stepped in parallel.

    Each is at a sample of an episode. What it senses is what a dataset records: `follow` goes through a dataset's episode
    bit by bit, where the settings are the dataset's: a spec's where one is given, or by `Dataset.simulation`.

    A call while another thread's is at work, or in a forked process, raises RuntimeError. A simulation that diverges
    raises RuntimeError too, until it is reset.
    """

    def __new__(cls, scenario: str, count: int = 1, spec: str | Path | None = None) -> SimulationBatch: ...
    def reset(self, index: int, seed: int, episode: int) -> None:
        """Takes a simulation to the start of the episode of that index in the dataset of that seed."""

    def step(self, setpoints: NDArray[np.float64], active: NDArray[np.bool_] | None = None) -> None:
        """Takes each simulation to its next sample, while the setpoint moves evenly to `setpoints[index]`.

        setpoints: `[count, elements]`, of the finger rotation (rad), lift and extension (m); held to `setpoint_ranges`. active: `[count]`,
        the simulations that are stepped; all by default. Raises ValueError for another shape or a value that is not
        finite.
        """

    def follow(self) -> None:
        """Takes each simulation to its next sample along its episode's own course."""

    def sense(self, modality: str) -> NDArray[Any]:
        """What the simulations sense, by one of `modalities`: a vector `[count, elements]`, float32, or an image
        `[count, rows, columns, 3]`, uint8. Raises KeyError for another modality."""

    def render(self, index: int, width: int, height: int) -> NDArray[np.uint8]:
        """A picture of a simulation in good quality, `[height, width, 3]`, each side 1 to 4096 pixels."""

    @property
    def scenario(self) -> str:
        """The world's name."""
    @property
    def modalities(self) -> dict[str, tuple[int, ...]]:
        """What is sensed, with the shape of one simulation's values."""
    @property
    def action(self) -> list[str]:
        """Names of the elements of the action."""
    @property
    def count(self) -> int: ...
    @property
    def seed(self) -> int:
        """The seed of the spec's dataset."""
    @property
    def sample_seconds(self) -> float:
        """Time from a sample to the next, s."""
    @property
    def actuation_seconds(self) -> float:
        """Duration of one arm move in a dataset's episode, s."""
    @property
    def setpoint_ranges(self) -> NDArray[np.float64]:
        """Lowest and highest setpoint of each element of the action, `[elements, 2]`."""
    @property
    def setpoint(self) -> NDArray[np.float64]:
        """The setpoints at this sample, `[count, elements]`."""
    @property
    def fingertip(self) -> NDArray[np.float64]:
        """Where the fingers end in the world, m, `[count, 3]`. Raises ValueError in a world without forces of links."""
    @property
    def boxes(self) -> NDArray[np.float64]:
        """Position (m) and orientation (unit quaternion w, x, y, z) of the boxes in the world, `[count, boxes, 7]`."""
