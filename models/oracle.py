"""Measures what an oracle adds that knows the place and height of each pillar, and prints it as a Markdown table.

    python models/oracle.py results/datasets/crowded-*   # a row for each dataset and target, and intervals of the gain

docs/crowded.md has the command that collects the datasets.

Two networks of the same size predict the contact forces of the next sample. Both know the joint angles of the finger,
the arm's position, and its setpoint now and at the next sample. The oracle also knows the pillars: a layer that all
share reads each one's place relative to the finger's mount now and at the next sample, and their sum and maximum are
further inputs. The first 70 % of the episodes are for training, the next 20 % choose the epoch, and R2 is that of the
last 10 %. It needs NumPy, Polars, PyTorch and SciPy.
"""

import argparse
import json
import pathlib

import numpy as np
import polars as pl
import torch
from scipy import stats

MOUNT_RADIUS = 0.7  # m, from the arm's axis to the finger at extension 0
TIP_HEIGHT = 0.5  # m, of the hanging finger's tip at lift 0
NEAR = 0.15  # m, the width of the function that tells whether a pillar is below the finger
TRAINING, VALIDATION = 0.7, 0.2  # parts of the episodes
EPOCHS, BATCH, RATE = 25, 128, 2e-3
WIDTH, SET_WIDTH, DROPOUT = 256, 64, 0.05
TARGETS = {
    "all links": (0, 20),
    "tip": (19, 20),
    "all links, mean over the sample": (20, 40),
    "tip, mean over the sample": (39, 40),
}


class Network(torch.nn.Module):
    """A perceptron. If there are `features` of objects, it also gets the sum and maximum of a layer that all share."""

    def __init__(self, inputs, features, outputs):
        super().__init__()
        if features:
            layers = [torch.nn.Linear(features, SET_WIDTH), torch.nn.ReLU(), torch.nn.Linear(SET_WIDTH, SET_WIDTH)]
            self.shared = torch.nn.Sequential(*layers, torch.nn.ReLU())
        joined = inputs + (2 * SET_WIDTH if features else 0)
        layers = []
        for width in (joined, WIDTH):
            layers += [torch.nn.Linear(width, WIDTH), torch.nn.ReLU(), torch.nn.Dropout(DROPOUT)]
        self.trunk = torch.nn.Sequential(*layers, torch.nn.Linear(WIDTH, outputs))
        self.has_objects = features > 0

    def forward(self, state, objects):
        if self.has_objects:
            each = self.shared(objects)
            state = torch.cat([state, each.sum(1), each.amax(1)], 1)
        return self.trunk(state)


def read(folder, episodes):
    """Returns the first episodes of a dataset, by modality, `[episodes, samples, elements]`."""
    files = sorted(folder.glob("episode_*.parquet"))[:episodes]
    table = pl.concat([pl.read_parquet(file) for file in files])

    def columns(modality):
        own = [name for name in table.columns if name.startswith(modality + "_")]
        if modality.startswith("contact_force"):
            own = [name for name in own if name.removeprefix(f"{modality}_").isdigit()]
        return table.select(own).to_numpy().reshape(len(files), -1, len(own)).astype(np.float32)

    forces = ("contact_force", "contact_force_mean", "contact_force_kind")
    return {name: columns(name) for name in ("proprioception", "arm", "setpoint", *forces, "pillars")}


def relative(pillars, setpoint):
    """Returns for each pillar how far it is from the finger's mount along and across the arm, how far the hanging tip
    is above its top (m), and how near it is to the place below the mount (0 to 1), also times its height.

    `pillars` is `[samples, pillars, 3]`, in which z is half of the height, and `setpoint` is `[samples, 3]`.
    """
    rotation, lift, extension = (setpoint[:, [element]] for element in range(3))
    x, y, half = np.moveaxis(pillars, 2, 0)
    along = x * np.cos(rotation) + y * np.sin(rotation) - MOUNT_RADIUS - extension
    across = y * np.cos(rotation) - x * np.sin(rotation)
    near = np.exp(-(along**2 + across**2) / (2 * NEAR**2))
    return np.stack([along, across, TIP_HEIGHT + lift - 2 * half, near, 2 * half * near], 2)


def windows(data, ahead):
    """Returns inputs, the pillars' features and forces of all samples, and the episode of each."""
    episodes, samples = data["arm"].shape[:2]
    present, later = np.s_[:, : samples - ahead], np.s_[:, ahead:]
    flat = lambda values: values.reshape(-1, values.shape[-1])
    courses = [flat(data["setpoint"][:, step : samples - ahead + step]) for step in range(ahead + 1)]
    state = np.concatenate([flat(data["proprioception"][present]), flat(data["arm"][present]), *courses], 1)
    pillars = flat(data["pillars"][present]).reshape(len(state), -1, 3)
    objects = np.concatenate([relative(pillars, courses[0]), relative(pillars, courses[-1]), 2 * pillars[..., 2:]], 2)
    forces = np.concatenate([flat(data["contact_force"][later]), flat(data["contact_force_mean"][later])], 1)
    return state, objects, forces, np.repeat(np.arange(episodes), samples - ahead)


def predicted(state, objects, forces, parts, seed):
    """Trains a network and returns its predictions of the test samples, N. `objects` is None without the oracle."""
    torch.manual_seed(seed)
    training, validation, test = (torch.from_numpy(part) for part in parts)

    def normalized(values):
        own = values[parts[0]].reshape(-1, values.shape[-1])
        return torch.from_numpy((values - own.mean(0)) / (own.std(0) + 1e-6))

    state = normalized(state)
    objects = torch.zeros(len(state), 0, 0) if objects is None else normalized(objects)
    scale = float(forces[parts[0]].std())
    target = torch.from_numpy(forces / scale)
    network = Network(state.shape[1], objects.shape[2], target.shape[1])
    optimizer = torch.optim.Adam(network.parameters())
    batches = len(training) // BATCH
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, total_steps=EPOCHS * batches)
    best = (float("inf"), None)
    for _ in range(EPOCHS):
        network.train()
        for batch in training[torch.randperm(len(training))][: batches * BATCH].split(BATCH):
            optimizer.zero_grad()
            torch.nn.functional.mse_loss(network(state[batch], objects[batch]), target[batch]).backward()
            optimizer.step()
            schedule.step()
        network.eval()
        with torch.no_grad():
            of = lambda part: network(state[part], objects[part])
            error = float(torch.nn.functional.mse_loss(of(validation), target[validation]))
            if error < best[0]:
                best = (error, of(test).numpy() * scale)
    return best[1]


def onsets(data):
    """Returns which part of the samples are the first three of a contact, and which part of the force's variance they
    have."""
    touched = (data["contact_force_kind"] > 0).any(2)
    first = touched & ~np.roll(touched, 1, 1)
    first[:, 0] = touched[:, 0]
    # A second or third sample counts only if the contact goes on.
    second = np.roll(first, 1, 1) & touched
    third = np.roll(second, 1, 1) & touched
    second[:, 0] = third[:, :2] = False
    begins = first | second | third
    deviations = ((data["contact_force"] - data["contact_force"].mean((0, 1))) ** 2).sum(2)
    return begins.mean(), deviations[begins].sum() / deviations.sum()


def r2(prediction, reference):
    """R2 over all links, each with its own mean, as docs/metrics.md defines it."""
    return 1 - ((prediction - reference) ** 2).sum() / ((reference - reference.mean(0)) ** 2).sum()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("datasets", nargs="+", type=pathlib.Path, help="folders of datasets of the world `crowded`")
    parser.add_argument("--ahead", type=int, default=1, help="samples ahead [default: 1]")
    parser.add_argument("--episodes", type=int, help="use only the first episodes [default: all]")
    parser.add_argument("--seed", type=int, default=0, help="of the networks [default: 0]")
    parser.add_argument("--onsets", action="store_true", help="print only how much of the variance contacts begin with")
    options = parser.parse_args()
    torch.set_num_threads(1)

    if options.onsets:
        for folder in options.datasets:
            samples, variance = onsets(read(folder, options.episodes))
            print(f"{folder.name}: {samples:.0%} of the samples, {variance:.0%} of the variance")
        return
    print("| seed | episodes | contacts with pillars, ground | target | without | oracle | gain |")
    print("|---|---|---|---|---|---|---|", flush=True)
    gains = {name: [] for name in TARGETS}
    for folder in options.datasets:
        data = read(folder, options.episodes)
        state, objects, forces, episode = windows(data, options.ahead)
        count = len(data["arm"])
        bounds = round(TRAINING * count), round((TRAINING + VALIDATION) * count)
        parts = [np.flatnonzero(np.digitize(episode, bounds) == part) for part in range(3)]
        both = [predicted(state, given, forces, parts, options.seed) for given in (None, objects)]
        kinds = data["contact_force_kind"]
        shares = ", ".join(f"{(kinds == kind).any(2).mean():.0%}" for kind in (2, 1))
        seed = json.loads((folder / "dataset.json").read_text())["simulation"]["seed"]
        for name, (first, last) in TARGETS.items():
            without, oracle = (r2(one[:, first:last], forces[parts[2], first:last]) for one in both)
            gains[name].append(oracle - without)
            gain = gains[name][-1]
            print(f"| {seed} | {count} | {shares} | {name} | {without:.3f} | {oracle:.3f} | {gain:.3f} |", flush=True)
    for name, of in gains.items():
        if len(of) > 1:
            half = stats.t.ppf(0.975, len(of) - 1) * np.std(of, ddof=1) / np.sqrt(len(of))
            print(f"{name}: gain {np.mean(of):.3f} [{np.mean(of) - half:.3f}, {np.mean(of) + half:.3f}], n = {len(of)}")


if __name__ == "__main__":
    main()
