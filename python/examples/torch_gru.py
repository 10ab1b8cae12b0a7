"""Judges a recurrent network of PyTorch on a task: torch_gru.py SPEC [SEEDS] [EPOCHS]

A GRU reads the vectors of the context, and a second one unrolls the actions. It predicts vectors, and sees no images.
"""

import sys

import torch
from torch import nn

import harness


class Network(nn.Module):
    """Reads the inputs and the actions between them, then one action for each predicted sample."""

    def __init__(self, task, targets, width=128):
        super().__init__()
        self.input, self.output = [name for name in task.input if len(task.shapes[name]) == 1], task.output
        inputs, elements = sum(task.shapes[name][0] for name in self.input), task.train()[0].actions.shape[-1]
        self.read = nn.GRU(inputs + elements, width, batch_first=True)
        self.unroll = nn.GRU(elements, width, batch_first=True)
        self.heads = nn.ModuleDict({name: nn.Linear(width, task.shapes[name][0]) for name in task.output})
        self.means = {name: torch.tensor(targets[name].mean((0, 1))) for name in task.output}
        self.scales = {name: float(targets[name].std()) for name in task.output}

    def forward(self, context, actions):
        inputs = torch.cat([context[name] for name in self.input], 2)
        before = torch.zeros(*inputs.shape[:2], actions.shape[2])
        if "action" in context:
            before[:, 1:] = context["action"]
        _, state = self.read(torch.cat([inputs, before], 2))
        states, _ = self.unroll(actions, state)
        return {name: self.heads[name](states) * self.scales[name] + self.means[name] for name in self.output}


def main(spec, seeds=3, epochs=30):
    task = harness.task(spec)
    for seed in range(seeds):
        torch.manual_seed(seed)
        network = Network(task, task.train()[:].targets)
        optimizer = torch.optim.Adam(network.parameters(), 1e-3)
        for _ in range(epochs):
            for context, actions, wanted in torch.utils.data.DataLoader(task.torch("train"), 256, shuffle=True):
                found = network(context, actions)
                losses = [((found[name] - wanted[name]) / network.scales[name]).square().mean() for name in found]
                optimizer.zero_grad()
                sum(losses).backward()
                optimizer.step()

        def predict(context, actions, network=network):
            with torch.no_grad():
                return network({name: torch.tensor(array) for name, array in context.items()}, torch.tensor(actions))

        task.submit(predict, model="gru", seed=seed, notes={"torch": torch.__version__, "epochs": epochs})


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:]))
