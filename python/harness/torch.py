"""Datasets for PyTorch. The module needs the package torch: `pip install 'soft-harness[torch]'`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from ._arguments import name_tuple
from .recorded import difference_of

if TYPE_CHECKING:
    from . import Dataset
    from .prediction import Windows

__all__ = ["Transitions", "WindowDataset"]


class Transitions(torch.utils.data.Dataset[tuple[dict[str, torch.Tensor], torch.Tensor, dict[str, torch.Tensor]]]):
    """The transitions of a dataset, each from a sample to the next one of the same episode. `Dataset.torch` creates it.

    An item consists of the observation, the action and the next observation. Observations are dictionaries of tensors
    by modality. All values are in SI units. Vectors are `[width]`, float32. Images are `[3, rows, columns]`, uint8, the
    order of axes of PyTorch and of `load_network`. The change of an image since the previous sample
    (`frame_difference`, or `IMAGE_difference` for other images) is float32 in [-1, 1].

    The processes of a DataLoader share the dataset's memory if they are forked. Processes that are started by `spawn`
    or `forkserver` get the dataset's folder, and each reads the dataset again.

    Args:
        data: the dataset.
        input: modalities of the observation before each transition.
        output: modalities of the observation after it.
        action: `increment`, the change of the setpoint, or `target`, the setpoint after the transition.
        samples: the samples from which the transitions start. The default is all samples but the last one of each
            episode.

    Raises:
        KeyError: the dataset does not contain a modality.
        ValueError: there is no such action, or a transition can't start from a sample.

    Attributes:
        input: names of the modalities before each transition.
        output: names of the modalities after it.
        action: `increment` or `target`.
        samples: the samples from which the transitions start, `[transitions]`.

    Example:
        >>> import torch                                                                          # needs torch
        >>> model = harness.load_model("smoke/empty-z4")
        >>> data = harness.Dataset(f"results/datasets/{model.dataset}")
        >>> transitions = data.torch(["proprioception", "vision"], ["contact_force"])
        >>> observation, action, following = transitions[0]
        >>> observation["vision"].shape, action.shape, following["contact_force"].shape
        (torch.Size([3, 64, 64]), torch.Size([3]), torch.Size([20]))
        >>> len(torch.utils.data.DataLoader(transitions, batch_size=16))
        8
    """

    def __init__(
        self,
        data: Dataset,
        input: str | Iterable[str],
        output: str | Iterable[str],
        action: str = "increment",
        samples: ArrayLike | None = None,
    ) -> None:
        if action not in ("increment", "target"):
            raise ValueError(f"action: there is no '{action}'; allowed: increment, target")
        self.input, self.output, self.action = name_tuple(input), name_tuple(output), action
        self._data = data
        changes = {difference_of(image): image for image in data.keys() if data[image].ndim == 4}
        asked = sorted({*self.input, *self.output})
        # The image of which a name is the change.
        self._changing = {name: changes[name] for name in asked if name in changes and name not in data}
        self._arrays = {name: data[name] for name in (self._changing.get(name, name) for name in asked)}
        episodes = data.bounds
        # Without a setpoint, an action has no elements.
        empty = np.zeros((episodes[-1][1], 0), np.float32)
        self._setpoint = data["setpoint"] if "setpoint" in data.keys() else empty
        # The first sample of each sample's episode.
        self._first = np.concatenate([np.full(end - first, first) for first, end in episodes])
        starts = np.concatenate([np.arange(first, end - 1) for first, end in episodes])
        self.samples = starts if samples is None else np.asarray(samples)
        wrong = self.samples[~np.isin(self.samples, starts)]
        if wrong.size:
            raise ValueError(
                f"samples: no transition starts from {wrong[0]}; the dataset has {len(self._first)} samples, and none "
                "starts from the last sample of an episode"
            )

    def __repr__(self) -> str:
        given, found = ", ".join(self.input), ", ".join(self.output)
        return f"<harness.torch.Transitions: {len(self)} from {given} and {self.action} to {found}>"

    def __reduce__(self) -> tuple[type[Transitions], tuple[Any, ...]]:
        """Pickles the dataset's folder instead of its samples."""
        return type(self), (self._data, self.input, self.output, self.action, self.samples)

    def __len__(self) -> int:
        """Returns the number of transitions."""
        return len(self.samples)

    def __getitem__(self, index: int) -> tuple[dict[str, torch.Tensor], torch.Tensor, dict[str, torch.Tensor]]:
        """Returns a transition: the observation, the action `[elements]` and the next observation."""
        sample = int(self.samples[index])
        before = self._setpoint[sample] if self.action == "increment" else 0.0
        action = torch.from_numpy(self._setpoint[sample + 1] - before)
        return self._observation(sample, self.input), action, self._observation(sample + 1, self.output)

    def _observation(self, sample: int, names: tuple[str, ...]) -> dict[str, torch.Tensor]:
        return {name: self._value(sample, name) for name in names}

    def _value(self, sample: int, name: str) -> torch.Tensor:
        if name in self._changing:
            before = max(sample - 1, int(self._first[sample]))
            now, then = (self._planes(self._changing[name], at).astype(np.float32) for at in (sample, before))
            return torch.from_numpy((now - then) / np.float32(255))
        if self._arrays[name].ndim == 4:
            return torch.from_numpy(self._planes(name, sample).copy())
        return torch.from_numpy(self._arrays[name][sample].copy())

    def _planes(self, name: str, sample: int) -> NDArray[np.uint8]:
        planes: NDArray[np.uint8] = self._arrays[name][sample].transpose(2, 0, 1)
        return planes


class WindowDataset(torch.utils.data.Dataset[tuple[dict[str, torch.Tensor], torch.Tensor, dict[str, torch.Tensor]]]):
    """The windows of a part of a task's dataset. `PredictionTask.torch` creates it.

    An item consists of the context, the actions and the targets, as in `harness.prediction.Batch`, but as tensors.
    Images are `[samples, 3, rows, columns]`.

    Args:
        windows: the windows.

    Example:
        >>> task = harness.task("smoke", cell="empty")                                            # needs torch
        >>> context, actions, targets = task.torch()[0]
        >>> context["vision"].shape, actions.shape, targets["contact_force"].shape
        (torch.Size([1, 3, 64, 64]), torch.Size([1, 3]), torch.Size([1, 20]))
    """

    def __init__(self, windows: Windows) -> None:
        self._windows = windows

    def __len__(self) -> int:
        """Returns the number of windows."""
        return len(self._windows)

    def __getitem__(self, index: int) -> tuple[dict[str, torch.Tensor], torch.Tensor, dict[str, torch.Tensor]]:
        """Returns a window: the context, the actions `[horizon, elements]` and the targets."""
        context, actions, targets = self._windows[index]
        return _tensors(context), torch.from_numpy(actions.copy()), _tensors(targets)


def _tensors(arrays: dict[str, NDArray[Any]]) -> dict[str, torch.Tensor]:
    """Returns copies of arrays as tensors. The channels of images come before their rows and columns."""
    planes = {name: array.transpose(0, 3, 1, 2) if array.ndim == 4 else array for name, array in arrays.items()}
    return {name: torch.from_numpy(np.ascontiguousarray(array).copy()) for name, array in planes.items()}
