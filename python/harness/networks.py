"""Trained networks for PyTorch, built from the description and the tensors in their files (docs/networks.md)."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import safe_open
from torch import Tensor
from torch.nn import functional

Layer = dict[str, Any]
Tensors = dict[str, Tensor]

FORMAT = 1
"""The version of descriptions that this module can read."""
RECONSTRUCTION = "reconstruction."
"""First part of the names of the parameters of the reconstruction's decoder."""


class NetworkFile:
    """The tensors and the description of a network's file."""

    def __init__(self, path: Path, description: dict[str, Any] | None = None) -> None:
        """Reads the file. description: used if the file has none, as those of earlier versions."""
        with safe_open(path, "pt") as file:
            self.tensors: Tensors = {name: file.get_tensor(name) for name in file.keys()}
            note = json.loads((file.metadata() or {}).get("harness", "{}"))
        found = note.get("network", description)
        if found is None:
            raise ValueError(f"{path} has no description of a network; load it by the name of its run")
        if found["format"] != FORMAT:
            raise ValueError(f"{path} has format {found['format']} of the description; this version reads {FORMAT}")
        self.description: dict[str, Any] = found


class Network(torch.nn.Module):
    """A trained network as a `torch.nn.Module`; `harness.load_network` builds it.

    It takes and returns the same values as `harness.Model`, as tensors: vectors `[batch, width]` in SI units, images
    `[batch, rows, columns, 3]`. Images are uint8, or float32 in [0, 1]; their differences are float32 in [-1, 1].
    NumPy arrays and lists are converted. The parameters are trainable, and have the same names as in the network's
    file, those of the reconstruction's decoder after `reconstruction.`.
    """

    def __init__(self, prediction: NetworkFile, reconstruction: NetworkFile | None = None) -> None:
        super().__init__()
        self.description = prediction.description
        """What the file of the prediction's network says about it."""
        self.reconstruction_description = reconstruction.description if reconstruction else None
        """The same for the reconstruction; None if there is none."""
        for prefix, file in (("", prediction), (RECONSTRUCTION, reconstruction)):
            for name, tensor in (file.tensors if file else {}).items():
                if not name.startswith("scale."):
                    self._add_parameter(prefix + name, tensor)
        # Both files have the same scales.
        for name, tensor in prediction.tensors.items():
            if name.startswith("scale."):
                self.register_buffer(_attribute(name), tensor)

    def forward(self, observation: Mapping[str, Any], action: Any) -> Tensors:
        """Predicts the observation one sample later from the posterior's mean, by modality.

        action: `[batch, elements]`, in SI units, in the form that `self.description["action"]` names. Raises KeyError
        if a modality is missing or unknown, and ValueError if one has the wrong shape.
        """
        return self.decode(self.encode(observation)[0], action)

    def encode(self, observation: Mapping[str, Any]) -> tuple[Tensor, Tensor]:
        """Returns the mean and the log-variance of the posterior, `[batch, latent]` each."""
        values = self._normalized(observation)
        values = self._run(self.description["encoder"], values, "")
        mean, log_variance = values["posterior"].chunk(2, dim=1)
        return mean, log_variance

    def decode(self, latent: Any, action: Any) -> Tensors:
        """Predicts the observation one sample later from a latent state `[batch, latent]` and an action."""
        given = {"latent": self._tensor(latent, torch.float32)}
        form = self.description["action"]
        values = self._tensor(action, torch.float32)
        self._check("action", values, [len(form["elements"])], len(given["latent"]))
        mean, deviation = self._scales(form, values.shape[1:])
        given["action"] = (values - mean) / deviation
        return self._decoded(self.description, given, "")

    def reconstruct(self, latent: Any) -> Tensors:
        """Reconstructs the observation from a latent state `[batch, latent]`, by modality of the input.

        Raises RuntimeError if the run trained no reconstruction.
        """
        if self.reconstruction_description is None:
            raise RuntimeError("the run trained no reconstruction")
        given = {"latent": self._tensor(latent, torch.float32)}
        return self._decoded(self.reconstruction_description, given, RECONSTRUCTION)

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

    def _tensor(self, values: Any, kind: torch.dtype) -> Tensor:
        """Converts values to a tensor on the network's device. Bytes become numbers in [0, 1]."""
        if not isinstance(values, Tensor):
            values = torch.tensor(np.asarray(values))
        device = self.get_parameter("decoder.hidden.bias").device
        if values.dtype == torch.uint8:
            return values.to(device, kind) / self.description["images"]["bytes_divided_by"]
        return values.to(device, kind)

    @staticmethod
    def _check(name: str, values: Tensor, shape: Sequence[int], batch: int) -> None:
        if list(values.shape) != [batch, *shape]:
            raise ValueError(f"'{name}' has the shape {list(values.shape)}, must be {[batch, *shape]}")

    def _normalized(self, observation: Mapping[str, Any]) -> Tensors:
        """Returns what the encoder is given: vectors side by side, and images stacked by channel."""
        inputs = self.description["inputs"]
        names = [quantity["name"] for quantity in inputs]
        for what, wrong in (("lacks", set(names) - set(observation)), ("has", set(observation) - set(names))):
            if wrong:
                raise KeyError(f"the observation {what} {', '.join(sorted(wrong))}; the network takes {', '.join(names)}")
        parts: dict[str, list[Tensor]] = {}
        batch = len(observation[names[0]])
        for quantity in inputs:
            values = self._tensor(observation[quantity["name"]], torch.float32)
            self._check(quantity["name"], values, quantity["shape"], batch)
            if quantity["kind"] == "image":
                values = values.permute(0, 3, 1, 2)
            mean, deviation = self._scales(quantity, values.shape[1:])
            parts.setdefault(quantity["value"], []).append((values - mean) / deviation)
        return {value: torch.cat(tensors, 1) for value, tensors in parts.items()}

    def _decoded(self, description: dict[str, Any], given: Tensors, prefix: str) -> Tensors:
        """Applies a decoder and converts its outputs to SI units."""
        self._check("latent", given["latent"], [description["latent"]], len(given["latent"]))
        values = self._run(description["decoder"], given, prefix)
        return {quantity["name"]: self._physical(quantity, values) for quantity in description["outputs"]}

    def _physical(self, quantity: dict[str, Any], values: Tensors) -> Tensor:
        image = quantity["kind"] == "image"
        columns = quantity["shape"][-1]
        part = values[quantity["value"]].narrow(1, quantity["start"], columns)
        mean, deviation = self._scales(quantity, part.shape[1:])
        part = part * deviation + mean
        if "minimum" in quantity:
            part = part.clamp(min=quantity["minimum"])
        return part.permute(0, 2, 3, 1) if image else part

    def _run(self, layers: list[Layer], values: Tensors, prefix: str) -> Tensors:
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


def _attribute(name: str) -> str:
    """Returns the name of a scale's buffer. A module with the name of a modality may be in conflict with a method."""
    return name.replace(".", "_")
