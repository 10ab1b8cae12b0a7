"""Datasets for PyTorch."""

from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

if TYPE_CHECKING:
    from . import Dataset

Observation = dict[str, torch.Tensor]


class Transitions(torch.utils.data.Dataset[tuple[Observation, torch.Tensor, Observation]]):
    """The transitions of a dataset: a sample, the action, and the next sample of the same episode.

    An item consists of the observation by the modalities of `input`, the action `[3]` (`increment` or `target`, as in a
    spec), and the next observation by the modalities of `output`. All values are in physical units. Vectors are
    float32. Images are uint8, `[3, rows, columns]`. Their changes since the previous sample (`frame_difference`,
    `IMAGE_difference`) are float32 in [-1, 1]. The processes of a DataLoader share the dataset's memory.

    samples: the samples from which the transitions start; all but the last of each episode by default.
    """

    def __init__(
        self,
        data: "Dataset",
        input: list[str],
        output: list[str],
        action: str = "increment",
        samples: NDArray[np.int64] | None = None,
    ) -> None:
        if action not in ("increment", "target"):
            raise ValueError(f"action: there is no '{action}'; allowed: increment, target")
        needed = {self._source(name) for name in [*input, *output]}
        self.arrays = {name: data[name] for name in sorted(needed)}
        self.input, self.output, self.action = list(input), list(output), action
        self.setpoint = data["setpoint"]
        episodes = data.episodes.astype(np.int64)
        self.first = np.concatenate([np.full(end - first, first) for first, end in episodes])
        """The first sample of each sample's episode."""
        starts = np.concatenate([np.arange(first, end - 1) for first, end in episodes])
        if samples is not None and not np.isin(samples, starts).all():
            raise ValueError("samples: a transition can't start from the last sample of an episode")
        self.samples = starts if samples is None else np.asarray(samples)
        """The sample that each transition starts from."""

    def __len__(self) -> int:
        return len(self.samples)

    def __getitem__(self, index: int) -> tuple[Observation, torch.Tensor, Observation]:
        sample = int(self.samples[index])
        before = self.setpoint[sample] if self.action == "increment" else 0.0
        action = torch.from_numpy(self.setpoint[sample + 1] - before)
        return self._observation(sample, self.input), action, self._observation(sample + 1, self.output)

    def _observation(self, sample: int, names: list[str]) -> Observation:
        return {name: self._value(sample, name) for name in names}

    def _value(self, sample: int, name: str) -> torch.Tensor:
        source = self._source(name)
        if self.arrays[source].ndim != 4:
            return torch.from_numpy(self.arrays[name][sample].copy())
        if name == source:
            return torch.from_numpy(self._planes(source, sample).copy())
        before = max(sample - 1, int(self.first[sample]))
        now, then = (self._planes(source, at).astype(np.float32) for at in (sample, before))
        return torch.from_numpy((now - then) / np.float32(255))

    @staticmethod
    def _source(name: str) -> str:
        """Returns the image from which `frame_difference` or `IMAGE_difference` is computed, or else the name itself."""
        return "vision" if name == "frame_difference" else name.removesuffix("_difference")

    def _planes(self, name: str, sample: int) -> NDArray[np.uint8]:
        planes: NDArray[np.uint8] = self.arrays[name][sample].transpose(2, 0, 1)
        return planes
