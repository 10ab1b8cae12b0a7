"""Times one PyTorch training step of the harness's networks on the CPU, for comparison with the harness.

A step does the same as the harness does for one batch: draw the noise, forward pass, loss, backward pass, fused Adam
(1e-3). Inputs and targets are random, standardized f32. Run it on an otherwise idle machine:

    .venv-bench/bin/python harness/benches/training_step.py --channels 16 --latent 64  # the paper's network
    .venv-bench/bin/python harness/benches/training_step.py --channels 8 16 32 32 --fusion late  # a deep network
    .venv-bench/bin/python harness/benches/training_step.py --latent 4  # a network for vectors
    .venv-bench/bin/python harness/benches/training_step.py --memory gru --context 50 --batch 1000  # 20 sequences
    .venv-bench/bin/python harness/benches/training_step.py --memory rssm --context 50 --batch 1000

Prints JSON, with times in wall-clock seconds.
"""

import argparse
import json
import statistics
import sys
import time
from pathlib import Path

import torch
from torch import Tensor, nn

sys.path.append(str(Path(__file__).parents[2] / "tests" / "fixtures"))
from twin import (  # noqa: E402
    ACTION_SIZE,
    Cvae,
    Decoder,
    Dimensions,
    EarlyEncoder,
    LateEncoder,
    Rssm,
    loss_terms,
    random_batch,
)

WARM_UP_STEPS = 3
KL_WEIGHT = 0.01


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Times one PyTorch training step of a network of the harness.")
    parser.add_argument(
        "--channels",
        type=int,
        nargs="*",
        default=[],
        help="output channels of each convolution; without any, the network is for vectors alone",
    )
    parser.add_argument("--fusion", choices=["early", "late"], default="early")
    parser.add_argument("--hidden", type=int, nargs="+", default=[256])
    parser.add_argument("--mode", choices=["eager", "compile"], default="eager")
    parser.add_argument(
        "--precision",
        choices=["f32", "bf16"],
        default="f32",
        help="bf16: forward pass with autocast, f32 parameters",
    )
    parser.add_argument("--latent", type=int, default=64)
    parser.add_argument("--memory", choices=["none", "gru", "rssm"], default="none")
    parser.add_argument(
        "--recurrence",
        choices=["module", "cells"],
        default="module",
        help="the gated recurrent unit: nn.GRU over whole sequences, or a loop over nn.GRUCell",
    )
    parser.add_argument("--context", type=int, default=1, help="samples in a sequence")
    parser.add_argument(
        "--memory-format",
        choices=["contiguous", "channels_last"],
        default="contiguous",
        help="how images and convolutions' weights are stored in memory",
    )
    parser.add_argument("--batch", type=int, default=1024, help="samples in a step: those of whole sequences")
    parser.add_argument("--steps", type=int, default=10, help=f"timed steps, after {WARM_UP_STEPS} untimed steps")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    return parser.parse_args()


class Recurrent(nn.Module):
    """The CVAE with a gated recurrent unit between the encoder and the posterior.

    The rows of one time lie together. The unit takes the encoded sample, a one because there is a sample, and the
    action before it. The posterior takes the unit and the encoded sample.
    """

    def __init__(self, sizes: Dimensions, sequences: int, recurrence: str):
        super().__init__()
        inputs, width = 2 * sizes.latent + 1 + ACTION_SIZE, sizes.hidden[-1]
        self.sequences = sequences
        self.encoder = LateEncoder(sizes) if sizes.fusion == "late" else EarlyEncoder(sizes)
        self.unit = nn.GRU(inputs, width) if recurrence == "module" else nn.GRUCell(inputs, width)
        self.posterior = nn.Linear(width + 2 * sizes.latent, 2 * sizes.latent)
        self.decoder = Decoder(sizes)

    def states(self, inputs: Tensor) -> Tensor:
        """Of the unit at each time, `[times, sequences, width]`, from zero."""
        if isinstance(self.unit, nn.GRU):
            return self.unit(inputs)[0]
        state = inputs.new_zeros(self.sequences, self.unit.hidden_size)
        states = []
        for now in inputs:
            state = self.unit(now, state)
            states.append(state)
        return torch.stack(states)

    def forward(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        encoded, action = self.encoder(batch["input.vector"], batch.get("input.frame")), batch["action"]
        before = torch.cat([action.new_zeros(self.sequences, ACTION_SIZE), action[: -self.sequences]])
        inputs = torch.cat([encoded, encoded.new_ones(len(encoded), 1), before], dim=1)
        states = self.states(inputs.unflatten(0, (-1, self.sequences)))
        posterior = self.posterior(torch.cat([states.flatten(0, 1), encoded], dim=1))
        mean, log_variance = posterior.chunk(2, dim=1)
        latent = mean + torch.exp(log_variance / 2) * batch["noise"]
        vector, frame = self.decoder(latent, action)
        outputs = {"output.posterior": posterior, "output.vector": vector}
        return outputs if frame is None else outputs | {"output.frame": frame}


class StateSpace(nn.Module):
    """The CVAE with a recurrent state-space model between the encoder and the latent state.

    The rows of one time lie together. The prior and the divergence are computed for all times at once.
    """

    def __init__(self, sizes: Dimensions, sequences: int):
        super().__init__()
        self.sizes, self.sequences = sizes, sequences
        self.encoder = LateEncoder(sizes) if sizes.fusion == "late" else EarlyEncoder(sizes)
        self.memory = Rssm(sizes)
        self.decoder = Decoder(sizes)

    def forward(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        encoded, action = self.encoder(batch["input.vector"], batch.get("input.frame")), batch["action"]
        before = torch.cat([action.new_zeros(self.sequences, ACTION_SIZE), action[: -self.sequences]])
        memory = action.new_zeros(self.sequences, self.sizes.hidden[-1])
        latent = action.new_zeros(self.sequences, self.sizes.latent)
        steps = []
        for now in zip(*(rows.split(self.sequences) for rows in (before, encoded, batch["noise"]))):
            memory, posterior = self.memory.step(memory, latent, *now[:2])
            mean, log_variance = posterior.chunk(2, dim=1)
            latent = mean + torch.exp(log_variance / 2) * now[2]
            steps.append((memory, posterior, latent))
        memory, posterior, latent = (torch.cat(part) for part in zip(*steps))
        vector, frame = self.decoder(latent, action)
        divergence = self.memory.balanced(memory, posterior).mean()
        outputs = {"output.posterior": posterior, "output.vector": vector, "divergence": divergence}
        return outputs if frame is None else outputs | {"output.frame": frame}


def timed_steps(options: argparse.Namespace) -> list[float]:
    """Returns the seconds of each step, without the warm-up (which compiles the step in mode `compile`)."""
    frame_channels = 3 if options.channels else 0
    sizes = Dimensions(
        channels_in=frame_channels,
        channels_out=frame_channels,
        channels=tuple(options.channels),
        hidden=tuple(options.hidden),
        latent=options.latent,
        fusion=options.fusion,
    )
    if options.batch % options.context:
        raise SystemExit(f"{options.batch} samples are no whole sequences of {options.context}")
    sequences = options.batch // options.context
    if options.memory == "gru":
        model = Recurrent(sizes, sequences, options.recurrence)
    elif options.memory == "rssm":
        model = StateSpace(sizes, sequences)
    else:
        model = Cvae(sizes)
    batch = random_batch(sizes, options.batch)
    if options.memory_format == "channels_last":
        model = model.to(memory_format=torch.channels_last)
        for name, tensor in batch.items():
            if tensor.dim() == 4:
                batch[name] = tensor.contiguous(memory_format=torch.channels_last)
    modalities = [name.removeprefix("target.") for name in batch if name.startswith("target.")]
    weights = dict.fromkeys(modalities, 1.0)
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-3, fused=True)

    def total_loss(batch: dict[str, torch.Tensor]) -> torch.Tensor:
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=options.precision == "bf16"):
            outputs = model(batch)
        outputs = {name: value.float() for name, value in outputs.items()}
        if "divergence" in outputs:
            return loss_terms(outputs, batch, weights, kl_weight=0.0)["loss.total"] + KL_WEIGHT * outputs["divergence"]
        return loss_terms(outputs, batch, weights, KL_WEIGHT)["loss.total"]

    if options.mode == "compile":
        total_loss = torch.compile(total_loss)

    seconds = []
    for _ in range(WARM_UP_STEPS + options.steps):
        start = time.perf_counter()
        batch["noise"].normal_()
        optimizer.zero_grad()
        loss = total_loss(batch)
        loss.backward()
        optimizer.step()
        loss.item()
        seconds.append(time.perf_counter() - start)
    return seconds[WARM_UP_STEPS:]


def main() -> None:
    options = arguments()
    torch.set_num_threads(options.threads)
    torch.manual_seed(0)
    seconds = timed_steps(options)
    report = {
        "median_seconds": statistics.median(seconds),
        "min_seconds": min(seconds),
        "max_seconds": max(seconds),
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
    }
    print(json.dumps(vars(options) | report))


if __name__ == "__main__":
    main()
