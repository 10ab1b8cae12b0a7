"""Judges a convolutional network of PyTorch on a task with the image `vision`: torch_cnn.py SPEC [SEEDS] [EPOCHS]

It sees the present sample only, and predicts the vectors of all samples of the horizon at once.
"""

import sys

import torch
from torch import nn

import harness


class Network(nn.Module):
    """Convolutions on the image, joined with the vectors and the actions."""
    def __init__(self, task, targets):
        super().__init__()
        self.vectors = [name for name in task.input if len(task.shapes[name]) == 1]
        layers = [layer for channels in (16, 32, 32) for layer in (nn.LazyConv2d(channels, 4, 2, 1), nn.ReLU())]
        self.image = nn.Sequential(*layers, nn.Flatten(), nn.LazyLinear(64), nn.ReLU())
        self.widths = {name: task.shapes[name][0] for name in task.output}
        outputs = task.horizon * sum(self.widths.values())
        self.last = nn.Sequential(nn.LazyLinear(128), nn.ReLU(), nn.Linear(128, outputs))
        self.means = {name: torch.tensor(targets[name].mean(0)) for name in task.output}
        self.scales = {name: float(targets[name].std()) for name in task.output}

    def forward(self, context, actions):
        image = context["vision"][:, -1] / 255
        image = self.image(image if image.shape[1] == 3 else image.permute(0, 3, 1, 2))
        joined = torch.cat([image, *(context[name][:, -1] for name in self.vectors), actions.flatten(1)], 1)
        parts = self.last(joined).unflatten(1, (actions.shape[1], -1)).split(list(self.widths.values()), 2)
        return {name: part * self.scales[name] + self.means[name] for name, part in zip(self.widths, parts)}


def main(spec, seeds=3, epochs=20):
    task = harness.task(spec)
    for seed in range(seeds):
        torch.manual_seed(seed)
        network = Network(task, task.train()[:].targets)
        loader = torch.utils.data.DataLoader(task.torch(), 64, shuffle=True)
        network(*next(iter(loader))[:2])  # gives the lazy layers their sizes
        optimizer = torch.optim.Adam(network.parameters(), 1e-3)
        for _ in range(epochs):
            for context, actions, wanted in loader:
                found = network(context, actions)
                losses = [((found[name] - wanted[name]) / network.scales[name]).square().mean() for name in found]
                optimizer.zero_grad()
                sum(losses).backward()
                optimizer.step()

        def predict(context, actions, network=network):
            with torch.no_grad():
                return network({name: torch.tensor(array) for name, array in context.items()}, torch.tensor(actions))

        task.submit(predict, model="cnn", seed=seed, notes={"torch": torch.__version__, "epochs": epochs})


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:]))
