"""Judges a transformer of PyTorch on a task: torch_transformer.py SPEC [SEEDS] [EPOCHS]

Each sample of the context, and each action after it, is a token. It predicts vectors, and sees no images.
"""

import sys

import torch
from torch import nn

import harness


class Network(nn.Module):
    """Joins the tokens of the inputs and of the actions by attention. A predicted sample sees nothing after it."""

    def __init__(self, task, targets, width=128):
        super().__init__()
        self.input, self.output = [name for name in task.input if len(task.shapes[name]) == 1], task.output
        inputs, elements = sum(task.shapes[name][0] for name in self.input), task.train()[0].actions.shape[-1]
        self.of_inputs, self.of_actions = nn.Linear(inputs, width), nn.Linear(elements, width)
        self.places = nn.Parameter(0.02 * torch.randn(task.context + task.horizon, width))
        layer = nn.TransformerEncoderLayer(width, 4, 2 * width, dropout=0.0, batch_first=True, norm_first=True)
        self.attention = nn.TransformerEncoder(layer, 2, enable_nested_tensor=False)
        self.heads = nn.ModuleDict({name: nn.Linear(width, task.shapes[name][0]) for name in task.output})
        self.means = {name: torch.tensor(targets[name].mean((0, 1))) for name in task.output}
        self.scales = {name: float(targets[name].std()) for name in task.output}

    def forward(self, context, actions):
        inputs = torch.cat([context[name] for name in self.input], 2)
        tokens = torch.cat([self.of_inputs(inputs), self.of_actions(actions)], 1) + self.places
        mask = nn.Transformer.generate_square_subsequent_mask(tokens.shape[1])
        states = self.attention(tokens, mask=mask, is_causal=True)[:, -actions.shape[1] :]
        return {name: self.heads[name](states) * self.scales[name] + self.means[name] for name in self.output}


def main(spec, seeds=3, epochs=30):
    task = harness.task(spec)
    for seed in range(seeds):
        torch.manual_seed(seed)
        network = Network(task, task.train()[:].targets)
        optimizer = torch.optim.Adam(network.parameters(), 5e-4)
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

        task.submit(predict, model="transformer", seed=seed, notes={"torch": torch.__version__, "epochs": epochs})


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:]))
