"""Times epochs of PyTorch over a dataset with images that stays on the GPU, for comparison with the harness.

An epoch does the same as the harness does: Adam steps over the training episodes in a new order, then the losses of the
validation episodes without gradients, and one reading of the mean losses. The images are bytes: a sample's own one is
the input, and its change to the next one the target. Both are normalized on the GPU, when a batch is taken. The values
are random. Of all episodes, 80 % are for training and 10 % for validation, as in the harness.

    python3 harness/benches/epoch.py --device cuda --channels 8 16 32 32 --fusion late --mode compile compiled-graph
    python3 harness/benches/epoch.py --device cuda --channels 4 --hidden 256 256 --batch 1024

Prints a line of JSON for each combination of settings, with wall-clock seconds per epoch.
"""

import argparse
import math

import torch
from torch import Tensor
from training_step import KL_WEIGHT, adam, add_settings, compiled, placed, prepare, recorded, report, timed
from twin import ACTION_SIZE, FRAME_SIZE, Cvae, Dimensions, loss_terms

SAMPLES_PER_EPISODE = 1000
TARGETS = ("proprioception", "contact_force", "frame_difference")


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Times epochs of PyTorch over a dataset with images.")
    parser.add_argument("--episodes", type=int, default=40, help=f"with {SAMPLES_PER_EPISODE} samples each")
    parser.add_argument("--channels", type=int, nargs="+", default=[8, 16, 32, 32])
    parser.add_argument("--fusion", choices=["early", "late"], default="early")
    parser.add_argument("--hidden", type=int, nargs="+", default=[256])
    parser.add_argument("--latent", type=int, default=64)
    parser.add_argument("--batch", type=int, default=256)
    parser.add_argument("--epochs", type=int, default=5, help="timed epochs")
    add_settings(parser)
    return parser.parse_args()


class Dataset:
    """Random samples on a device: images as bytes, normalized vectors, and what normalizes the images."""

    def __init__(self, sizes: Dimensions, options: argparse.Namespace):
        count, device = options.episodes * SAMPLES_PER_EPISODE, options.device
        image = (3, FRAME_SIZE, FRAME_SIZE)
        self.images = placed(torch.randint(256, (count, *image), dtype=torch.uint8, device=device), options)
        self.vectors = {
            "input.vector": torch.randn(count, sizes.vector_in, device=device),
            "action": torch.randn(count, ACTION_SIZE, device=device),
        }
        # The targets are those of the next sample.
        self.targets = torch.randn(count, sizes.vector_out, device=device)
        # Of the image and of its change. A mean for each value, and one factor for all.
        self.means = [torch.rand(image, device=device), torch.zeros(image, device=device)]
        self.factors = [torch.tensor(3.5, device=device), torch.tensor(2.5, device=device)]

    def tensors(self) -> list[Tensor]:
        return [self.images, self.targets, *self.vectors.values(), *self.means, *self.factors]

    def batch(self, at: Tensor) -> dict[str, Tensor]:
        now, after = self.images[at].float(), self.images[at + 1].float()
        images = [
            (values / 255 - mean) * factor for values, mean, factor in zip((now, after - now), self.means, self.factors)
        ]
        targets = self.targets[at + 1].chunk(2, dim=1)
        return (
            {name: values[at] for name, values in self.vectors.items()}
            | {f"target.{name}": values for name, values in zip(TARGETS, (*targets, images[1]))}
            | {"input.frame": images[0]}
        )


class Passes:
    """The steps of one batch size over one part of the dataset. `at` holds the batch's samples."""

    def __init__(self, run: "Run", size: int, training: bool):
        self.run, self.training = run, training
        self.at = torch.arange(size, device=run.options.device)
        self.noise = torch.zeros(size, run.options.latent, device=run.options.device)
        self.terms = compiled(self.terms, run.options, (self.at, self.noise, *run.data.tensors()))
        self.step = recorded(self.step, run.options)

    def terms(self) -> Tensor:
        """The total loss and its terms, `[5]`."""
        options, batch = self.run.options, self.run.data.batch(self.at) | {"noise": self.noise}
        with torch.autocast(options.device, dtype=torch.bfloat16, enabled=options.precision == "bf16"):
            outputs = self.run.model(batch)
        outputs = {name: value.float() for name, value in outputs.items()}
        losses = loss_terms(outputs, batch, dict.fromkeys(TARGETS, 1.0), KL_WEIGHT)
        return torch.stack([losses.pop("loss.total"), *losses.values()])

    def step(self) -> None:
        """Adds the batch's losses to their sums, and trains on them. Validation is without noise."""
        with torch.set_grad_enabled(self.training):
            if self.training:
                self.noise.normal_()
                self.run.optimizer.zero_grad()
            terms = self.terms()
            self.run.sums[0 if self.training else 1].add_(terms.detach(), alpha=len(self.at))
            if self.training:
                terms[0].backward()
                self.run.optimizer.step()

    def __call__(self, at: Tensor) -> None:
        self.at.copy_(at)
        self.step()


class Run:
    def __init__(self, options: argparse.Namespace):
        sizes = Dimensions(
            channels_in=3,
            channels_out=3,
            channels=tuple(options.channels),
            hidden=tuple(options.hidden),
            latent=options.latent,
            fusion=options.fusion,
        )
        self.options, self.data = options, Dataset(sizes, options)
        self.model = placed(Cvae(sizes), options)
        self.optimizer = adam(self.model, options)
        self.sums = torch.zeros(2, 2 + len(TARGETS), device=options.device)
        episodes = torch.arange(options.episodes * SAMPLES_PER_EPISODE, device=options.device)
        # The last sample of an episode has no next one.
        windows = episodes.view(options.episodes, -1)[:, :-1]
        training, validation = options.episodes * 8 // 10, max(1, options.episodes // 10)
        self.parts = windows[:training].flatten(), windows[training : training + validation].flatten()
        self.passes: dict[tuple[int, bool], Passes] = {}

    def epoch(self) -> list[list[float]]:
        """Returns the mean losses of both parts."""
        self.sums.zero_()
        training, validation = self.parts
        order = training[torch.randperm(len(training), device=training.device)]
        for samples, trains in ((order, True), (validation, False)):
            for at in samples.split(self.options.batch):
                key = len(at), trains
                if key not in self.passes:
                    self.passes[key] = Passes(self, *key)
                self.passes[key](at)
        counts = torch.tensor([len(part) for part in self.parts]).unsqueeze(1)
        means = (self.sums.cpu() / counts).tolist()
        if not all(math.isfinite(mean) for part in means for mean in part):
            raise ArithmeticError(f"a loss is not finite: {means}")
        return means


def timed_epochs(options: argparse.Namespace) -> list[float]:
    prepare(options)
    run = Run(options)
    return timed(run.epoch, options, options.epochs)


if __name__ == "__main__":
    chosen = arguments()
    report(chosen, timed_epochs)
