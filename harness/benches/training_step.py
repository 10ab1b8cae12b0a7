"""Times one PyTorch training step of the harness's CVAE on the CPU, for comparison with the harness.

A step does the same as the harness does for one batch: draw the noise, forward pass, loss, backward pass, fused Adam
(1e-3). Inputs and targets are random, standardized f32. Run it on an otherwise idle machine:

    .venv-bench/bin/python harness/benches/training_step.py --channels 16 --latent 64  # the paper's network
    .venv-bench/bin/python harness/benches/training_step.py --channels 8 16 32 32 --fusion late  # a deep network
    .venv-bench/bin/python harness/benches/training_step.py --latent 4  # a network for vectors

Prints JSON, with times in wall-clock seconds.
"""

import argparse
import json
import statistics
import sys
import time
from pathlib import Path

import torch

sys.path.append(str(Path(__file__).parents[2] / "tests" / "fixtures"))
from twin import Cvae, Dimensions, loss_terms, random_batch  # noqa: E402

WARM_UP_STEPS = 3


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Times one PyTorch training step of the harness's CVAE.")
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
    parser.add_argument(
        "--memory-format",
        choices=["contiguous", "channels_last"],
        default="contiguous",
        help="how images and convolutions' weights are stored in memory",
    )
    parser.add_argument("--batch", type=int, default=1024)
    parser.add_argument("--steps", type=int, default=10, help=f"timed steps, after {WARM_UP_STEPS} untimed steps")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    return parser.parse_args()


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
        return loss_terms(outputs, batch, weights, kl_weight=0.01)["loss.total"]

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
