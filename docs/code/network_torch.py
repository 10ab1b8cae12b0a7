"""Computes a layer of a network of any kind with PyTorch; docs/networks.md explains the layers."""

import torch
from torch.nn import functional


def compute(layer, inputs, tensors):
    """Returns what a layer computes from its inputs; layer: its description, tensors: those in the file by name."""
    weight, bias = (tensors.get(layer.get(key)) for key in ("weight", "bias"))
    match layer["kind"]:
        case "concatenate": y = torch.cat(inputs, 1)
        case "flatten": y = inputs[0].flatten(1)
        case "reshape": y = inputs[0].unflatten(1, layer["output"])
        case "average": y = functional.avg_pool2d(inputs[0], layer["size"])
        case "columns": y = torch.cat([inputs[0].narrow(1, *columns) for columns in layer["ranges"]], 1)
        case "objects":
            objects, width = layer["output"]
            y = inputs[0].narrow(1, layer["start"], objects * width).reshape(-1, width)
        case "sum_and_maximum":
            objects = inputs[0].unflatten(0, (-1, layer["objects"]))
            y = torch.cat([objects.sum(1), objects.amax(1)], 1)
        case "product_of_experts":
            means, logs = zip(*(x.chunk(2, 1) for x in inputs))
            precisions = [(-log.clamp(min=layer["least_log_variance"])).exp() for log in logs]
            total = 1 + sum(precisions)
            y = torch.cat([sum(m * p for m, p in zip(means, precisions)) / total, -total.log()], 1)
        case "dense": y = sum(x @ tensors[name].T for x, name in zip(inputs, layer["weights"])) + bias
        case "convolution": y = functional.conv2d(inputs[0], weight, bias, layer["stride"], layer["padding"])
        case "transposed_convolution":
            y = functional.conv_transpose2d(inputs[0], weight, bias, layer["stride"], layer["padding"])
        case "layer_normalization":
            y = functional.layer_norm(inputs[0], layer["output"], weight, bias, layer["epsilon"])
    return torch.relu(y) if layer.get("activation") == "relu" else y
