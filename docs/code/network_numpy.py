"""Predicts with a network without memory, images or layer normalization; docs/networks.md explains the steps."""

import numpy as np


def predict(network, tensors, observation, action):
    """Returns the predictions by name.

    network: the description in the file; tensors: the arrays in the file by name;
    observation, action: arrays [batch, width] in SI units, the observation by modality.
    """

    def scaled(entry, value):
        return (value - tensors[entry["mean"]]) / tensors[entry["deviation"]]

    def apply(layers, values):
        for layer in layers:
            x = np.concatenate([values[name] for name in layer["inputs"]], 1)
            if layer["kind"] == "dense":
                x = x @ np.concatenate([tensors[name] for name in layer["weights"]], 1).T + tensors[layer["bias"]]
                x = np.maximum(x, 0) if layer["activation"] == "relu" else x
            values[layer["name"]] = x
        return values

    vectors = np.concatenate([scaled(entry, observation[entry["name"]]) for entry in network["inputs"]], 1)
    latent = apply(network["encoder"], {"vectors": vectors})["posterior"][:, : network["latent"]]
    values = apply(network["decoder"], {"latent": latent, "action": scaled(network["action"], action)})
    predicted = {}
    for entry in network["outputs"]:
        name, columns, width = entry["name"], values[entry["value"]], entry["shape"][0]
        unit = tensors[entry.get("change", entry["deviation"])]
        base = observation[name] if "change" in entry else tensors[entry["mean"]]
        value = columns[:, entry["start"] : entry["start"] + width] * unit + base
        if "distribution" in entry:
            said = entry["distribution"]
            raw, logit = (columns[:, first : first + width] for first in (said["start"], said["start"] + width))
            predicted[f"{name}.scale"] = scale = unit * (np.exp(np.minimum(raw, said["greatest_logarithm"])) + said["least_scale"])
            if said["family"] == "hurdle":
                threshold = said["threshold"]
                predicted[f"{name}.touch"] = touch = 1 / (1 + np.exp(-logit))
                above = unit * np.logaddexp(0, (value - threshold) / unit)
                predicted[f"{name}.location"] = threshold + above
                below = np.exp(-above / scale) / 2
                value = touch * (threshold + above + (above + scale) * below / (1 - below))
        if entry.get("softmax"):
            value = np.exp(value - value.max(1, keepdims=True))
            value /= value.sum(1, keepdims=True)
        predicted[name] = np.maximum(value, entry.get("minimum", -np.inf))
    return predicted
