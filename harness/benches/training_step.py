"""Times one PyTorch training step of the harness's networks, for comparison with the harness.

A step does the same as the harness does for one batch: draw the noise, forward pass, loss, backward pass, fused Adam
(1e-3). Inputs and targets are random, standardized f32. Run it on an otherwise idle machine:

    .venv-bench/bin/python harness/benches/training_step.py --channels 16 --latent 64  # the paper's network
    .venv-bench/bin/python harness/benches/training_step.py --channels 8 16 32 32 --fusion late  # a deep network
    .venv-bench/bin/python harness/benches/training_step.py --latent 4  # a network for vectors
    .venv-bench/bin/python harness/benches/training_step.py --memory gru --context 50 --batch 1000  # 20 sequences
    .venv-bench/bin/python harness/benches/training_step.py --memory rssm --context 50 --batch 1000

On a GPU, several settings can be given at once, and those that can't be combined or fail are reported as such:

    python3 harness/benches/training_step.py --device cuda --block 20 --steps 200 --channels 8 16 32 32 --fusion late \
        --mode eager compile compiled-graph --precision f32 tf32 --memory-format contiguous channels_last

Prints a line of JSON for each combination, with times in wall-clock seconds.
"""

import argparse
import gc
import itertools
import json
import statistics
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Iterator
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
# compile, reduce-overhead and max-autotune are torch.compile with its own CUDA graphs in the last two. In graph and
# compiled-graph, one CUDA graph holds the whole step with the optimizer, of which the loss is compiled in the second.
MODES = ("eager", "compile", "reduce-overhead", "max-autotune", "graph", "compiled-graph")


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
    add_settings(parser)
    parser.add_argument("--latent", type=int, default=64)
    parser.add_argument("--memory", choices=["none", "gru", "rssm"], default="none")
    parser.add_argument(
        "--recurrence",
        choices=["module", "cells"],
        default="module",
        help="the gated recurrent unit: nn.GRU over whole sequences, or a loop over nn.GRUCell",
    )
    parser.add_argument("--context", type=int, default=1, help="samples in a sequence")
    parser.add_argument("--batch", type=int, default=1024, help="samples in a step: those of whole sequences")
    parser.add_argument("--steps", type=int, default=10, help=f"timed steps, after {WARM_UP_STEPS} untimed blocks")
    parser.add_argument(
        "--block",
        type=int,
        default=1,
        help="steps that are timed together, because a GPU computes one step while the next ones are queued",
    )
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    return parser.parse_args()


def add_settings(parser: argparse.ArgumentParser) -> None:
    """The settings of PyTorch. Each combination of several modes, precisions and formats is timed."""
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    parser.add_argument("--mode", choices=MODES, nargs="+", default=["eager"])
    parser.add_argument(
        "--precision",
        choices=["f32", "tf32", "bf16"],
        nargs="+",
        default=["f32"],
        help="tf32: products and convolutions on a GPU; bf16: forward pass with autocast, f32 parameters",
    )
    parser.add_argument(
        "--memory-format",
        choices=["contiguous", "channels_last"],
        nargs="+",
        default=["contiguous"],
        help="how images and convolutions' weights are stored in memory",
    )


def combinations(options: argparse.Namespace) -> Iterator[argparse.Namespace]:
    names = ("precision", "memory_format", "mode")
    for values in itertools.product(*(getattr(options, name) for name in names)):
        yield argparse.Namespace(**vars(options) | dict(zip(names, values)))


def report(options: argparse.Namespace, timed: Callable[[argparse.Namespace], list[float]]) -> None:
    """Prints the times of each combination of settings, or the error. Without any times, the program fails."""
    found = False
    for one in combinations(options):
        begin = time.perf_counter()
        try:
            seconds = timed(one)
        except Exception as error:  # Of CUDA and of the compiler. The other settings may work.
            traceback.print_exc()
            told = {"error": f"{type(error).__name__}: {error}"[:500]}
        else:
            found = True
            told = {
                "median_seconds": statistics.median(seconds),
                "min_seconds": min(seconds),
                "max_seconds": max(seconds),
                "whole_seconds": time.perf_counter() - begin,
            }
        told |= {"threads": torch.get_num_threads(), "torch": torch.__version__}
        if options.device == "cuda":
            told |= {"cuda": torch.version.cuda, "card": torch.cuda.get_device_name()}
        print(json.dumps(vars(one) | told), flush=True)
        torch.compiler.reset()
        gc.collect()
        if options.device == "cuda":
            torch.cuda.empty_cache()
    if not found:
        raise SystemExit(1)


def prepare(options: argparse.Namespace) -> None:
    """Sets what holds for the whole process."""
    torch.manual_seed(0)
    if options.device == "cuda":
        torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = options.precision != "f32"
        torch.backends.cudnn.benchmark = True
    elif options.precision == "tf32" or "graph" in options.mode or options.mode == "reduce-overhead":
        raise ValueError(f"{options.precision} in mode {options.mode} needs a GPU")


def placed(value: nn.Module | Tensor, options: argparse.Namespace) -> nn.Module | Tensor:
    """The network or the tensor on its device and in its memory format, which concerns what has four dimensions."""
    value = value.to(options.device)
    if options.memory_format == "channels_last" and (isinstance(value, nn.Module) or value.dim() == 4):
        value = value.to(memory_format=torch.channels_last)
    return value


def adam(model: nn.Module, options: argparse.Namespace) -> torch.optim.Adam:
    recorded = options.mode.endswith("graph")
    return torch.optim.Adam(model.parameters(), lr=1e-3, fused=True, capturable=recorded)


def compiled(function: Callable, options: argparse.Namespace, constant: Iterable[Tensor] = ()) -> Callable:
    """The function, compiled if the mode says so. CUDA graphs read tensors at a constant address where they lie."""
    if options.mode in ("eager", "graph"):
        return function
    for tensor in constant:
        torch._dynamo.mark_static_address(tensor)
    own_graphs = options.mode in ("reduce-overhead", "max-autotune")
    return torch.compile(function, dynamic=False, mode=options.mode if own_graphs else None)


def recorded(step: Callable[[], None], options: argparse.Namespace) -> Callable[[], None]:
    """The step, recorded as a CUDA graph if the mode says so. The step is then done a few times before."""
    if not options.mode.endswith("graph"):
        return step
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(WARM_UP_STEPS):
            step()
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        step()
    return graph.replay


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


def divergence(posterior: Tensor, prior: Tensor) -> Tensor:
    """Of each row, in nats. torch.distributions has it too, but it can't be compiled, and waits for a GPU."""
    (mean, log_variance), (expected, expected_log_variance) = posterior.chunk(2, dim=1), prior.chunk(2, dim=1)
    squares = (log_variance.exp() + (mean - expected) ** 2) * torch.exp(-expected_log_variance)
    return 0.5 * (squares - 1 + expected_log_variance - log_variance).sum(dim=1)


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
        prior = self.memory.expected(memory)
        dynamics = divergence(posterior.detach(), prior).clamp(min=1.0)
        representation = divergence(posterior, prior.detach()).clamp(min=1.0)
        balanced = (dynamics + 0.1 * representation).mean()
        outputs = {"output.posterior": posterior, "output.vector": vector, "divergence": balanced}
        return outputs if frame is None else outputs | {"output.frame": frame}


def network(options: argparse.Namespace, sizes: Dimensions) -> nn.Module:
    if options.batch % options.context:
        raise SystemExit(f"{options.batch} samples are no whole sequences of {options.context}")
    sequences = options.batch // options.context
    if options.memory == "gru":
        return Recurrent(sizes, sequences, options.recurrence)
    return StateSpace(sizes, sequences) if options.memory == "rssm" else Cvae(sizes)


def timed_steps(options: argparse.Namespace) -> list[float]:
    """Returns the seconds of a step in each block, without the warm-up (which compiles the step)."""
    prepare(options)
    frame_channels = 3 if options.channels else 0
    sizes = Dimensions(
        channels_in=frame_channels,
        channels_out=frame_channels,
        channels=tuple(options.channels),
        hidden=tuple(options.hidden),
        latent=options.latent,
        fusion=options.fusion,
    )
    model = placed(network(options, sizes), options)
    batch = {name: placed(tensor, options) for name, tensor in random_batch(sizes, options.batch).items()}
    modalities = [name.removeprefix("target.") for name in batch if name.startswith("target.")]
    weights = dict.fromkeys(modalities, 1.0)
    optimizer = adam(model, options)

    def total_loss(batch: dict[str, Tensor]) -> Tensor:
        with torch.autocast(options.device, dtype=torch.bfloat16, enabled=options.precision == "bf16"):
            outputs = model(batch)
        outputs = {name: value.float() for name, value in outputs.items()}
        if "divergence" in outputs:
            return loss_terms(outputs, batch, weights, kl_weight=0.0)["loss.total"] + KL_WEIGHT * outputs["divergence"]
        return loss_terms(outputs, batch, weights, KL_WEIGHT)["loss.total"]

    total_loss = compiled(total_loss, options, batch.values())

    def step() -> None:
        batch["noise"].normal_()
        optimizer.zero_grad()
        loss = total_loss(batch)
        loss.backward()
        optimizer.step()
        if options.device == "cpu":
            loss.item()

    step = recorded(step, options)
    blocks = -(-options.steps // options.block)
    return timed(step, options, blocks, options.block)


def timed(work: Callable[[], None], options: argparse.Namespace, blocks: int, size: int = 1) -> list[float]:
    """Returns the seconds of the work in each block of `size` times, after a few blocks that are not timed."""
    seconds = []
    for _ in range(WARM_UP_STEPS + blocks):
        begin = time.perf_counter()
        for _ in range(size):
            work()
        if options.device == "cuda":
            torch.cuda.synchronize()
        seconds.append((time.perf_counter() - begin) / size)
    return seconds[WARM_UP_STEPS:]


def main() -> None:
    options = arguments()
    torch.set_num_threads(options.threads)
    report(options, timed_steps)


if __name__ == "__main__":
    main()
