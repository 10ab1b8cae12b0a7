"""Trained networks for PyTorch.

`harness.load_network` rebuilds a network from its files. The page docs/networks.md describes these files, and how to
rebuild a network without this module. The module needs the packages torch and safetensors: `pip install
'soft-harness[torch]'`.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor
from torch.nn import functional

__all__ = ["Network", "NetworkFile", "State"]

Layer = dict[str, Any]
FORMATS = (1, 2, 3, 4, 5)
"""The versions of descriptions that this module can read: without and with memory, with predicted changes, with
distributions, and with categories."""
RECONSTRUCTION = "reconstruction."
"""First part of the names of the parameters of the reconstruction's decoder."""


class NetworkFile:
    """The tensors and the description in the file of a network, such as `prediction.safetensors`.

    Args:
        path: the file.

    Attributes:
        tensors: the tensors by name.
        description: the description of the network.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is not that of a network, or has no description, or one of another version.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        try:
            with safe_open(path, "pt") as file:
                self.tensors: dict[str, Tensor] = {name: file.get_tensor(name) for name in file.keys()}
                note = json.loads((file.metadata() or {}).get("harness", "{}"))
        except SafetensorError as error:
            raise ValueError(f"{path} is not the file of a network: {error}") from None
        found = note.get("network")
        if found is None:
            raise ValueError(f"{path} has no description of a network")
        if found["format"] not in FORMATS:
            known = ", ".join(map(str, FORMATS))
            raise ValueError(f"{path} has format {found['format']} of the description; this version reads {known}")
        self.description: dict[str, Any] = found


class State(NamedTuple):
    """What a network with memory knows of a batch of episodes at one sample. `Network.start` makes the first one.

    Attributes:
        latent: the latent state, `[batch, latent]`.
        action: the normalized action after the last sample, `[batch, elements]`; None for a sample that was seen. It
            has no elements if the network takes no action.
        memory: what the network has stored of earlier samples, `[batch, width]`.
        present: the values of the last sample that was seen to which predicted changes are added, by modality, in SI
            units.
    """

    latent: Tensor
    action: Tensor | None
    memory: Tensor
    present: Mapping[str, Tensor] = {}


class Network(torch.nn.Module):
    """A trained network as a `torch.nn.Module`. `harness.load_network` builds it.

    It takes and returns the same values as `harness.Model`, for a batch, but its images have PyTorch's order of axes.
    An observation is a dictionary by modality, with exactly the modalities of the network's input. Vectors are
    `[batch, width]` in SI units. Images are `[batch, 3, rows, columns]`, as `Dataset.torch` gives them, either uint8 or
    floating-point numbers in [0, 1]. Changes of images are floating-point numbers in [-1, 1]. NumPy arrays and lists of
    these shapes are converted to tensors.

    The parameters can be trained. They have the same names as in the network's file, and those of the decoder that
    reconstructs begin with `reconstruction.`.

    A network with memory sees the samples of an episode one after the other. `start` gives the state before the first
    one, `observe` the state of a sample, `act` the state that predicts the sample after an action, and `predict` that
    sample. `act` after `act` predicts further, without seeing the samples between.

    Args:
        prediction: the file of the network that predicts.
        reconstruction: the file of the decoder that reconstructs, if the run trained one.

    Attributes:
        description: the description in the file of the prediction, which docs/networks.md explains.
        reconstruction_description: the description in the file of the reconstruction; None if there is none.

    Example:
        >>> network = harness.load_network("smoke/empty-z4")                                      # needs torch
        >>> observation = {"proprioception": [[0.0] * 20], "vision": [[[[0.5] * 64] * 64] * 3]}
        >>> mean, log_variance = network.encode(observation)
        >>> mean.shape
        torch.Size([1, 4])
        >>> network(observation, [[0.1, 0.0, 0.0]])["contact_force"].shape
        torch.Size([1, 20])
        >>> network.reconstruct(mean)["vision"].shape
        torch.Size([1, 3, 64, 64])
    """

    def __init__(self, prediction: NetworkFile, reconstruction: NetworkFile | None = None) -> None:
        super().__init__()
        self.description = prediction.description
        self.reconstruction_description = reconstruction.description if reconstruction else None
        for prefix, file in (("", prediction), (RECONSTRUCTION, reconstruction)):
            for name, tensor in (file.tensors if file else {}).items():
                if not name.startswith("scale."):
                    self._add_parameter(prefix + name, tensor)
        # Both files have the same scales.
        for name, tensor in prediction.tensors.items():
            if name.startswith("scale."):
                self.register_buffer(_attribute(name), tensor)

    def __repr__(self) -> str:
        given, found = (", ".join(each["name"] for each in self.description[part]) for part in ("inputs", "outputs"))
        parameters = sum(parameter.numel() for parameter in self.parameters())
        size = f"latent {self.description['latent']}, {parameters:,} parameters"
        return f"<harness.networks.Network: {given} to {found}, {size}>"

    def forward(self, observation: Mapping[str, Any], action: Any = None) -> dict[str, Tensor]:
        """Predicts the observation one sample later, from the mean of the posterior.

        For a network with memory, the observation is the first one of an episode.

        Args:
            observation: the values of the input modalities, by name.
            action: `[batch, elements]`, in SI units. `description["action"]["form"]` says whether it is the change of
                the setpoint (`increment`) or the next setpoint (`target`). None if the network takes no action.

        Returns:
            The predicted values of the output modalities, by name, in SI units. With a distribution, they are its
            means, and `NAME.scale`, `NAME.touch` and `NAME.location` are its other parameters, as in the ONNX model.

        Raises:
            KeyError: a modality is missing, or there is one that the network does not take.
            ValueError: a tensor has the wrong shape.
            TypeError: an image consists of integers other than uint8.
        """
        if self.has_memory:
            return self.predict(self.act(self.observe(None, observation), action))
        return self.decode(self.encode(observation)[0], action, observation)

    @property
    def has_memory(self) -> bool:
        """Whether the network keeps a state from sample to sample."""
        return bool(self.description.get("memory"))

    def start(self, batch: int = 1) -> State:
        """Returns the state before the first samples of a batch of episodes.

        Raises:
            RuntimeError: the network has no memory.
        """
        zeros = self.get_parameter("decoder.hidden.bias").new_zeros
        return State(zeros(batch, self.description["latent"]), None, zeros(batch, self._memory_width()))

    def observe(self, state: State | None, observation: Mapping[str, Any]) -> State:
        """Returns the state of a sample that is seen.

        Args:
            state: the one that predicts this sample, which `act` returns; None for the first sample of an episode.
            observation: the values of the input modalities, by name.

        Raises:
            RuntimeError: the network has no memory.
            KeyError, ValueError, TypeError: the observation is wrong, as in `encode`.
        """
        values = self._run(self.description["encoder"], self._normalized(observation), "")
        encoded = values["posterior"]
        state = self._remember(self.start(len(encoded)) if state is None else state, encoded)
        return state._replace(present=self._present(observation))

    def act(self, state: State, action: Any = None) -> State:
        """Returns the state that predicts the sample after an action.

        Args:
            state: that of the present sample. If it is one that `act` returned, its sample was not seen.
            action: `[batch, elements]`, as in `forward`.

        Raises:
            ValueError: a tensor has the wrong shape.
        """
        if state.action is not None:
            state = self._remember(state, None)
        return state._replace(action=self._normalized_action(action, len(state.latent)))

    def predict(self, state: State) -> dict[str, Tensor]:
        """Returns the sample that a state of `act` predicts: the values of the output modalities, in SI units.

        Raises:
            ValueError: there is no action after the state's sample.
        """
        if state.action is None:
            raise ValueError("the state has no action; call act first")
        return self._decoded(self.description, {"latent": state.latent, "action": state.action}, "", state.present)

    def encode(self, observation: Mapping[str, Any]) -> tuple[Tensor, Tensor]:
        """Returns the posterior of the latent state for an observation.

        Args:
            observation: the values of the input modalities, by name.

        Returns:
            The mean and the log-variance of the posterior, each `[batch, latent]`.

        Raises:
            KeyError: a modality is missing, or there is one that the network does not take.
            ValueError: a tensor has the wrong shape.
            TypeError: an image consists of integers other than uint8.
        """
        values = self._normalized(observation)
        values = self._run(self.description["encoder"], values, "")
        mean, log_variance = values["posterior"].chunk(2, dim=1)
        return mean, log_variance

    def decode(
        self, latent: Any, action: Any = None, present: Mapping[str, Any] | None = None
    ) -> dict[str, Tensor]:
        """Predicts the observation one sample later from a latent state.

        Args:
            latent: `[batch, latent]`.
            action: `[batch, elements]`, as in `forward`.
            present: the present observation, to which a network adds the changes that it predicts. Networks that
                predict only values need none.

        Returns:
            The predicted values of the output modalities, by name, in SI units.

        Raises:
            ValueError: a tensor has the wrong shape.
            KeyError: `present` lacks a modality whose change is predicted.
        """
        given = {"latent": self._tensor(latent)}
        given["action"] = self._normalized_action(action, len(given["latent"]))
        return self._decoded(self.description, given, "", self._present(present or {}))

    def reconstruct(self, latent: Any) -> dict[str, Tensor]:
        """Reconstructs the present observation from a latent state.

        Args:
            latent: `[batch, latent]`, such as the mean that `encode` returns.

        Returns:
            The reconstructed values of the input modalities, by name, in SI units.

        Raises:
            RuntimeError: the run trained no reconstruction.
            ValueError: the tensor has the wrong shape.
        """
        if self.reconstruction_description is None:
            raise RuntimeError("the run trained no reconstruction")
        given = {"latent": self._tensor(latent)}
        return self._decoded(self.reconstruction_description, given, RECONSTRUCTION, {})

    def _present(self, observation: Mapping[str, Any]) -> dict[str, Tensor]:
        """Returns the values to which predicted changes are added."""
        changed = [quantity["name"] for quantity in self.description["outputs"] if "change" in quantity]
        for name in changed:
            if name not in observation:
                raise KeyError(f"the network predicts the change of '{name}', so it needs its present value")
        return {name: self._tensor(observation[name]) for name in changed}

    def _normalized_action(self, action: Any, batch: int) -> Tensor:
        form = self.description.get("action")
        values = self._tensor(np.zeros((batch, 0)) if action is None else action)
        self._check("action", values, [self._action_width()], batch)
        if form is None:
            return values
        mean, deviation = self._scales(form, values.shape[1:])
        return (values - mean) / deviation

    def _action_width(self) -> int:
        return len(self.description["action"]["elements"]) if "action" in self.description else 0

    def _memory_width(self) -> int:
        if not self.has_memory:
            raise RuntimeError("the network has no memory; call it with an observation and an action")
        layer = self.description["memory"][0]
        (width,) = layer["output"]
        # The oldest of the last samples is left out.
        return width // layer["samples"] * (layer["samples"] - 1) if layer["kind"] == "last_samples" else width

    def _remember(self, state: State, encoded: Tensor | None) -> State:
        """Returns the state of the next sample: encoded, or not seen."""
        batch, zeros = len(state.latent), state.latent.new_zeros
        values = {
            "encoded": zeros(batch, 2 * self.description["latent"]) if encoded is None else encoded,
            "seen": zeros(batch, 1) + (encoded is not None),
            "action": zeros(batch, self._action_width()) if state.action is None else state.action,
            "latent": state.latent,
        }
        first, *layers = self.description["memory"]
        inputs = torch.cat([values[name] for name in first["inputs"]], 1)
        if first["kind"] == "last_samples":
            joined = torch.cat([inputs, state.memory], 1)
            values["memory"], memory = joined, joined[:, : state.memory.shape[1]]
        else:
            values["memory"] = memory = self._gated(first, inputs, state.memory)
        values = self._run(layers, values, "")
        # A recurrent state-space model expects a sample that is not seen.
        belief = values["prior"] if encoded is None and "prior" in values else values["posterior"]
        return State(belief.chunk(2, dim=1)[0], None, memory, state.present)

    def _gated(self, layer: Layer, inputs: Tensor, state: Tensor) -> Tensor:
        """Returns the next state of a gated recurrent unit."""

        def product(x: Tensor, name: str) -> tuple[Tensor, ...]:
            weight, bias = (self.get_parameter(layer[f"{name}_{part}"]) for part in ("weight", "bias"))
            return functional.linear(x, weight, bias).chunk(3, dim=1)

        given, hidden = product(inputs, "input"), product(state, "hidden")
        reset, update = (torch.sigmoid(a + b) for a, b in list(zip(given, hidden, strict=True))[:2])
        candidate = torch.tanh(given[2] + reset * hidden[2])
        return candidate + update * (state - candidate)

    def _add_parameter(self, name: str, tensor: Tensor) -> None:
        """Adds a parameter under its dotted name."""
        module: torch.nn.Module = self
        *path, last = name.split(".")
        for part in path:
            if part not in module._modules:
                module.add_module(part, torch.nn.Module())
            module = module.get_submodule(part)
        module.register_parameter(last, torch.nn.Parameter(tensor))

    def _scales(self, quantity: dict[str, Any], shape: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Returns the mean, in the given shape, and the standard deviation of a quantity."""
        mean, deviation = (self.get_buffer(_attribute(quantity[key])) for key in ("mean", "deviation"))
        return mean.reshape(shape), deviation

    def _tensor(self, values: Any) -> Tensor:
        """Converts numbers to a tensor on the network's device, float32."""
        if not isinstance(values, Tensor):
            values = torch.tensor(np.asarray(values))
        return values.to(self.get_parameter("decoder.hidden.bias").device, torch.float32)

    def _image(self, name: str, values: Any) -> Tensor:
        """Converts images to a tensor like `_tensor`. Bytes become numbers in [0, 1]."""
        if not isinstance(values, Tensor):
            values = torch.tensor(np.asarray(values))
        if values.dtype == torch.uint8:
            return self._tensor(values) / self.description["images"]["bytes_divided_by"]
        if not values.is_floating_point():
            raise TypeError(f"'{name}' must be uint8, or float in [0, 1]")
        return self._tensor(values)

    @staticmethod
    def _check(name: str, values: Tensor, shape: Sequence[int], batch: int | None) -> None:
        """Raises ValueError unless the values are a batch of this size, or of any size if it is None."""
        found = list(values.shape)
        if found[1:] != list(shape) or not found or (batch is not None and found[0] != batch):
            wanted = ", ".join(str(size) for size in ["batch" if batch is None else batch, *shape])
            is_last = len(shape) == 3 and found[1:] == [*shape[1:], shape[0]]
            hint = "; channels come first in PyTorch, so use permute(0, 3, 1, 2)" if is_last else ""
            raise ValueError(f"'{name}' has the shape {found}, must be [{wanted}]{hint}")

    def _normalized(self, observation: Mapping[str, Any]) -> dict[str, Tensor]:
        """Returns what the encoder is given: vectors side by side, and images stacked by channel."""
        inputs = self.description["inputs"]
        names = [quantity["name"] for quantity in inputs]
        for what, wrong in (("lacks", set(names) - set(observation)), ("has", set(observation) - set(names))):
            if wrong:
                listed, taken = ", ".join(sorted(map(str, wrong))), ", ".join(names)
                raise KeyError(f"the observation {what} {listed}; the network takes {taken}")
        parts: dict[str, list[Tensor]] = {}
        batch = None
        for quantity in inputs:
            name, is_image = quantity["name"], quantity["kind"] == "image"
            values = self._image(name, observation[name]) if is_image else self._tensor(observation[name])
            self._check(name, values, _shape(quantity), batch)
            batch = len(values)
            mean, deviation = self._scales(quantity, values.shape[1:])
            parts.setdefault(quantity["value"], []).append((values - mean) / deviation)
        return {value: torch.cat(tensors, 1) for value, tensors in parts.items()}

    def _decoded(
        self, description: dict[str, Any], given: dict[str, Tensor], prefix: str, present: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Applies a decoder and converts its outputs to SI units."""
        self._check("latent", given["latent"], [description["latent"]], None)
        values = self._run(description["decoder"], given, prefix)
        found: dict[str, Tensor] = {}
        for quantity in description["outputs"]:
            found |= self._physical(quantity, values, present)
        return found

    def _physical(
        self, quantity: dict[str, Any], values: dict[str, Tensor], present: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Returns the values of a quantity, and the other parameters of its distribution if it has one."""
        name, columns = quantity["name"], values[quantity["value"]]
        part = columns.narrow(1, quantity["start"], _shape(quantity)[0])
        if "change" in quantity:
            deviation = self.get_buffer(_attribute(quantity["change"]))
            part = present[name] + part * deviation
        else:
            mean, deviation = self._scales(quantity, part.shape[1:])
            part = part * deviation + mean
        if quantity.get("softmax"):
            part = part.softmax(1)
        others: dict[str, Tensor] = {}
        if "distribution" in quantity:
            part, others = _distribution(quantity["distribution"], columns, part, deviation)
        if "minimum" in quantity:
            part = part.clamp(min=quantity["minimum"])
        return {name: part, **{f"{name}.{key}": value for key, value in others.items()}}

    def _run(self, layers: list[Layer], values: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
        """Applies layers one after the other, and returns the values with all outputs."""
        for layer in layers:
            inputs = [values[name] for name in layer["inputs"]]
            values = {**values, layer["name"]: self._compute(layer, inputs, prefix)}
        return values

    def _compute(self, layer: Layer, inputs: list[Tensor], prefix: str) -> Tensor:
        def tensor(key: str) -> Tensor:
            return self.get_parameter(prefix + layer[key])

        x = inputs[0]
        match layer["kind"]:
            case "concatenate":
                return torch.cat(inputs, 1)
            case "columns":
                return torch.cat([x.narrow(1, start, length) for start, length in layer["ranges"]], 1)
            case "objects":
                objects, width = layer["output"]
                return x.narrow(1, layer["start"], objects * width).reshape(-1, width)
            case "sum_and_maximum":
                objects = x.unflatten(0, (-1, layer["objects"]))
                return torch.cat([objects.sum(1), objects.amax(1)], 1)
            case "product_of_experts":
                means, logarithms = zip(*(expert.chunk(2, 1) for expert in inputs), strict=True)
                precisions = [torch.exp(-log.clamp(min=layer["least_log_variance"])) for log in logarithms]
                precision = 1 + sum(precisions)
                mean = sum(mean * own for mean, own in zip(means, precisions, strict=True)) / precision
                return torch.cat([mean, -torch.log(precision)], 1)
            case "average":
                return functional.avg_pool2d(x, layer["size"])
            case "flatten":
                return x.flatten(1)
            case "reshape":
                return x.unflatten(1, layer["output"])
            case "layer_normalization":
                return functional.layer_norm(x, layer["output"], tensor("weight"), tensor("bias"), layer["epsilon"])
            case "dense":
                weights = [self.get_parameter(prefix + name) for name in layer["weights"]]
                y = functional.linear(torch.cat(inputs, 1), torch.cat(weights, 1), tensor("bias"))
            case "convolution":
                y = functional.conv2d(x, tensor("weight"), tensor("bias"), layer["stride"], layer["padding"])
            case "transposed_convolution":
                y = functional.conv_transpose2d(x, tensor("weight"), tensor("bias"), layer["stride"], layer["padding"])
            case kind:
                raise ValueError(f"the network has a layer of the kind '{kind}', which this version cannot compute")
        return torch.relu(y) if layer["activation"] == "relu" else y


def _distribution(
    entry: dict[str, Any], columns: Tensor, value: Tensor, deviation: Tensor
) -> tuple[Tensor, dict[str, Tensor]]:
    """Returns the mean of a distribution in SI units, and its other parameters."""
    width = value.shape[1]
    raw = columns.narrow(1, entry["start"], width).clamp(max=entry["greatest_logarithm"])
    scale = (raw.exp() + entry["least_scale"]) * deviation
    if entry["family"] == "gaussian":
        return value, {"scale": scale}
    touch = torch.sigmoid(columns.narrow(1, entry["start"] + width, width))
    above = deviation * functional.softplus((value - entry["threshold"]) / deviation)
    location, place = entry["threshold"] + above, above / scale
    below = torch.exp(-place) / 2
    ratio = (place + 1) * below / (1 - below)
    return touch * (location + scale * ratio), {"scale": scale, "touch": touch, "location": location}


def _shape(quantity: dict[str, Any]) -> list[int]:
    """Returns the shape of a sample, with the channels of an image first."""
    *places, last = quantity["shape"]
    return [last, *places]


def _attribute(name: str) -> str:
    """Returns the name of a scale's buffer. A module with the name of a modality may be in conflict with a method."""
    return name.replace(".", "_")
