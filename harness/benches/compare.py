"""Runs the harness and other programs in turn on this machine, and prints one table of ratios.

    make bench                                                       everything, as published
    .venv-bench/bin/python harness/benches/compare.py --only collection --rounds 1 --episodes 4
    .venv-bench/bin/python harness/benches/compare.py --only training --match deep
    .venv-bench/bin/python harness/benches/compare.py --only registry --rounds 1
    .venv-bench/bin/python harness/benches/compare.py --only shards --rounds 2 --keep target/bench

`make bench` also installs and builds what this program needs. In each round, the contenders run one after the other.
Each number is the median over the rounds, so a change of the machine's speed favors none of them. A ratio above 1
means that the harness is faster. The column "at least" is the project's own target. Run this program on an otherwise
idle machine.

Training compares one step of the paper's networks with PyTorch (training_step.py), and with the step's matrix products
alone, computed by gemm (the example `products`) and by PyTorch (products.py). It also compares one step of a deep
network, with and without the processor's tile unit, with PyTorch in both of its memory formats, and one step of a
network with a gated recurrent unit, over 20 sequences of 50 samples, with PyTorch's nn.GRU and with a loop over its
cells, on one core and on all, and one of a recurrent state-space model.

Collection compares the whole command `harness collect`, including its start and writing to disk, with Python's `mujoco`
(collect.py), PyBullet (pybullet_collect.py), and MuJoCo's functions called from C without recording (raw_limit.c). The
start of these programs is not counted. All simulate the same episodes.

Registry compares lists of runs and a query of a metric over 10,008 made-up runs (the example `many_runs`) with MLflow's
file store and with DuckDB over the same files (registry.py). For the harness, the time is that of the whole command.
All must give the same answer. Root can empty the system's cache of files, and so also measures with files on disk only.

Shards compares an experiment that is divided among several processes with one process. All of them begin at the same
time, or as many at a time as there are cores.
"""

import argparse
import functools
import json
import os
import shlex
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import registry
import report

BENCHES = Path(__file__).parent
ROOT = BENCHES.parents[1]
TARGET = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")) / "release"
MODELS = ROOT / "models"
SAMPLES_PER_EPISODE = 1000
CORES = report.cores()

# The convolutions of the recommended network with a camera.
DEEP = ("--channels", 8, 16, 32, 32, "--fusion", "late", "--hidden", 256, "--latent", 64)
DEEP_STEPS = 8
# 20 sequences of 50 samples.
RECURRENT = ("--context", 50, "--batch", 1000, "--hidden", 256, "--latent", 64)
RECURRENT_TARGET = 1.5
UNTUNED_SAMPLES = 100  # at about 20 samples per second
PYBULLET_SAMPLES = 300  # of each episode


@dataclass(frozen=True)
class Contender:
    name: str
    measure: Callable[[], float]
    # Smallest ratio that the project aims for; None if the ratio is only reported.
    target: float | None = None


@dataclass(frozen=True)
class Comparison:
    """Contenders that do the same work. The first one is the harness."""

    name: str
    unit: str  # "s" for a time, "1/s" for a rate
    contenders: tuple[Contender, ...]


def run(*command, **options) -> str:
    """Returns the output of a command. If it fails, this program ends with the reason."""
    command = [str(part) for part in command]
    done = subprocess.run(command, capture_output=True, check=False, text=True, **options)
    if done.returncode:
        raise SystemExit(f"{shlex.join(command)} failed:\n{done.stdout}{done.stderr}")
    return done.stdout


def last_json(*command, **options) -> dict:
    """Returns the JSON in the last line of a command's output."""
    return json.loads(run(*command, **options).strip().splitlines()[-1])


def python(script: str, *arguments, **options) -> dict:
    return last_json(sys.executable, BENCHES / script, *arguments, **options)


def example(name: str, *arguments) -> dict:
    return last_json(TARGET / "examples" / name, *arguments)


# Training


@dataclass(frozen=True)
class PaperNetwork:
    """One of the paper's two networks, and the smallest ratios that the project aims for."""

    name: str
    options: tuple
    # The sizes in its experiment.
    latents: tuple[int, ...]
    # Timed steps in a round, which take a few seconds.
    steps: int
    eager_target: float
    compiled_target: float | None = None
    products_target: float | None = None
    bf16: bool = False


PAPER_NETWORKS = (
    PaperNetwork("convolutional", ("--channels", 16), (16, 64, 128), 8, 2.5, 1.0, 0.5, bf16=True),
    PaperNetwork("fully_connected", (), (2, 4, 16), 300, 2.0),
)


def training() -> list[Comparison]:
    paper = [paper_step(network, latent) for network in PAPER_NETWORKS for latent in network.latents]
    deep = [deep_step("with tiles", 2.5), deep_step("without tiles", 1.8, "--no-tiles")]
    recurrent = [
        recurrent_step(f"{inputs}, {tiles}", (*layers, *steps), *options)
        for inputs, layers, steps in (
            ("vectors", (), ("--steps", 50)),
            ("camera", ("--channels", 16), ("--steps", 8)),
        )
        for tiles, options in (("with tiles", ()), ("without tiles", ("--no-tiles",)))
    ]
    return [*paper, *deep, *recurrent, state_space_step()]


def harness_step(*options) -> Callable[[], float]:
    return lambda: example("training_step", *options)["median_seconds"]


def pytorch_step(*options) -> Callable[[], float]:
    return lambda: python("training_step.py", *options)["median_seconds"]


def paper_step(network: PaperNetwork, latent: int) -> Comparison:
    layers = (*network.options, "--latent", latent)
    steps = ("--steps", network.steps)
    work = (*layers, *steps)

    def pytorch_products():
        listed = json.dumps(example("products", *layers, "--steps", 1))
        return python("products.py", *steps, input=listed)["median_seconds"]

    return Comparison(
        f"training step, {network.name}, latent {latent}, batch 1024",
        "s",
        (
            Contender("harness", harness_step(*work)),
            Contender("PyTorch eager", pytorch_step(*work), network.eager_target),
            Contender("PyTorch compiled", pytorch_step(*work, "--mode", "compile"), network.compiled_target),
            Contender("PyTorch eager, bf16 autocast", pytorch_step(*work, "--precision", "bf16")),
            *([Contender("harness, bf16", harness_step(*work, "--precision", "bf16"))] * network.bf16),
            Contender(
                "matrix products alone, gemm",
                lambda: example("products", *work)["median_seconds"],
                network.products_target,
            ),
            Contender("matrix products alone, PyTorch", pytorch_products),
        ),
    )


def deep_step(name: str, target: float, *options) -> Comparison:
    """The target is the same for both memory formats of PyTorch, so it also applies to the faster one."""
    work = (*DEEP, "--steps", DEEP_STEPS)
    formats = {"contiguous": "contiguous", "channels last": "channels_last"}
    return Comparison(
        f"training step, deep, {name}, latent 64, batch 1024",
        "s",
        (
            Contender("harness", harness_step(*work, *options)),
            *(
                Contender(f"PyTorch eager, {shown}", pytorch_step(*work, "--memory-format", value), target)
                for shown, value in formats.items()
            ),
        ),
    )


def recurrent_step(name: str, layers: tuple, *options) -> Comparison:
    """The target is the same for all settings of PyTorch, so it also applies to the fastest one."""
    work = ("--memory", "gru", *RECURRENT, *layers)
    ways = {"nn.GRU": "module", "a loop over nn.GRUCell": "cells"}
    return Comparison(
        f"training step, recurrent, {name}, latent 64, 20 x 50 samples",
        "s",
        (
            Contender("harness", harness_step(*work, *options)),
            *(
                Contender(
                    f"PyTorch eager, {shown}, {threads} thread{'s' * (threads > 1)}",
                    pytorch_step(*work, "--recurrence", value, "--threads", threads),
                    RECURRENT_TARGET,
                )
                for shown, value in ways.items()
                for threads in sorted({1, CORES})
            ),
        ),
    )


def state_space_step() -> Comparison:
    """PyTorch has no module for it, so it is a loop over the times."""
    work = ("--memory", "rssm", *RECURRENT, "--steps", 20)
    return Comparison(
        "training step, state-space model, vectors, latent 64, 20 x 50 samples",
        "s",
        (
            Contender("harness", harness_step(*work)),
            *(
                Contender(
                    f"PyTorch eager, {threads} thread{'s' * (threads > 1)}",
                    pytorch_step(*work, "--threads", threads),
                    RECURRENT_TARGET,
                )
                for threads in sorted({1, CORES})
            ),
        ),
    )


# Collection


def collection(episodes: int, folder: Path) -> list[Comparison]:
    raw_limit = compile_raw_limit()
    return [collection_of(scenario, episodes, folder, raw_limit) for scenario in ("empty", "cluttered")]


def compile_raw_limit() -> Path:
    """Compiles the C program, linked to the library that the harness uses."""
    library = ROOT / ".venv" / "mujoco"
    include = (library / "libmujoco.so").resolve().parent / "include"
    program = TARGET / "examples" / "raw_limit"
    linked = ("-L", library, "-lmujoco", "-ldl", "-lpthread", f"-Wl,-rpath,{library}")
    run("cc", "-O2", "-I", include, BENCHES / "raw_limit.c", "-o", program, *linked)
    return program


def without_sleeping(folder: Path) -> Path:
    """Returns a folder with the cluttered model, changed so that boxes at rest are simulated too."""
    text = (MODELS / "cluttered.xml").read_text()
    changed = text.replace('sleep="enable"', 'sleep="disable"')
    if changed == text:
        raise SystemExit(
            "models/cluttered.xml has no sleep flag; change without_sleeping in compare.py"
        )
    models = folder / "without_sleeping"
    models.mkdir()
    (models / "cluttered.xml").write_text(changed)
    return models


def collection_of(scenario: str, episodes: int, folder: Path, raw_limit: Path) -> Comparison:
    file = folder / f"{scenario}.courses"
    run(TARGET / "examples" / "courses", "--scenario", scenario, "--episodes", episodes, "--output", file)
    work = ("--scenario", scenario, "--courses", file)

    def mujoco_python(*options):
        return lambda: python("collect.py", *work, "--processes", CORES, *options)["samples_per_second"]

    def raw(*options):
        """Runs the C program. With `--no-rendering`, it only calls mj_step."""
        return lambda: last_json(raw_limit, MODELS / f"{scenario}.xml", file, CORES, *options)

    def rendering():
        timed = raw()()
        return CORES * timed["samples"] / timed["rendering_seconds"]

    def pybullet():
        options = ("--processes", CORES, "--samples-per-episode", PYBULLET_SAMPLES)
        return python("pybullet_collect.py", *work, *options)["samples_per_second"]

    contenders = [
        Contender("harness", lambda: harness_collection(scenario, episodes)),
        Contender("raw limit: mj_step and mjr_render in C", lambda: raw()()["samples_per_second"], 0.9),
        Contender("mj_step alone in C, 100 a sample", lambda: raw("--no-rendering")()["samples_per_second"]),
        Contender("mjr_render alone in C", rendering),
        Contender("Python mujoco, tuned", mujoco_python(), 1.1),
    ]
    if scenario == "cluttered":
        models = without_sleeping(folder)
        contenders += [
            Contender(
                "harness, without sleeping",
                lambda: harness_collection(scenario, episodes, "--models", models),
            ),
            Contender("Python mujoco, tuned, without sleeping", mujoco_python("--no-sleep"), 1.9),
        ]
    untuned = ("--untuned", "--episodes", 1, "--samples-per-episode", UNTUNED_SAMPLES)
    contenders += [
        Contender("Python mujoco, as first written", mujoco_python(*untuned)),
        Contender("PyBullet, springs in Python", pybullet),
    ]
    return Comparison(f"collection, {scenario}", "1/s", tuple(contenders))


def harness_collection(scenario: str, episodes: int, *options) -> float:
    """Returns samples per second of the whole command: start, simulation, rendering and writing to disk."""
    with tempfile.TemporaryDirectory() as results:
        settings = (f"scenarios=[{scenario}]", f"simulation.episodes={episodes}")
        spec = ROOT / "experiments" / "multi_to_multi.yaml"
        begin = time.perf_counter()
        run(TARGET / "harness", "collect", spec, *settings, *options, "--results", results)
        return episodes * SAMPLES_PER_EPISODE / (time.perf_counter() - begin)


# Registry

SEEDS = 834
RUNS = 12 * SEEDS


def many_runs(folder: Path) -> list[Comparison]:
    results, store, complete = folder / "many", folder / "mlflow", folder / "many-complete"
    harness = (TARGET / "harness", "--results", results)
    mean = (*harness, "query", registry.MEAN.format(metrics="metrics"))

    @functools.cache
    def expected() -> list:
        """Writes the runs if they are not there, and returns the harness's answer."""
        if not complete.exists():
            note(f"writing {RUNS} runs, for the harness and for MLflow")
            run(TARGET / "examples" / "many_runs", "--results", results, "--seeds", SEEDS, "--epochs", 30)
            run(sys.executable, BENCHES / "registry.py", "fill", results, store)
            complete.touch()
            # Files that were written less than two seconds ago are not compacted.
            time.sleep(3)
        return answer(*mean)

    def ours(*command) -> Contender:
        def measure() -> float:
            expected()
            return seconds(*command)

        return Contender("harness", measure)

    def peer(name: str, what: str, files: Path, reader: str) -> Contender:
        def measure() -> float:
            rows = expected()
            told = python("registry.py", what, files, reader)
            check_same(name, told["answer"], rows if what == "mean" else None)
            return told["seconds"]

        return Contender(name, measure)

    comparisons = [
        Comparison(
            f"list of {RUNS} runs",
            "s",
            (
                ours(*harness, "ls"),
                peer("DuckDB over the records", "list", results, "duckdb"),
                peer("MLflow's file store", "list", store, "mlflow"),
            ),
        ),
        Comparison(
            f"mean of a metric over {RUNS} runs",
            "s",
            (
                ours(*mean),
                peer("DuckDB over the compacted tables", "mean", results, "duckdb-compacted"),
                peer("DuckDB over the runs' tables", "mean", results, "duckdb"),
                peer("MLflow's file store", "mean", store, "mlflow"),
            ),
        ),
    ]
    if os.geteuid() != 0:
        note("only root can empty the cache of files, so the first reading is not measured")
        return comparisons
    return comparisons + [
        Comparison(f"{one.name}, files on disk only", one.unit, tuple(map(cold, one.contenders)))
        for one in comparisons
    ]


def answer(*command) -> list:
    """Returns the rows of a query's answer."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "answer.json"
        run(*command, "--output", file)
        return [list(row.values()) for row in json.loads(file.read_text())]


def check_same(reader: str, found: list, means: list | None) -> None:
    """Ends this program if a reader has other means, beyond rounding, or does not list all runs."""

    def rounded(rows: list) -> list:
        return [[*cell, round(mean, 9)] for *cell, mean in rows]

    if len(found) != RUNS if means is None else rounded(found) != rounded(means):
        raise SystemExit(f"{reader} has another answer: {found[:3]} …")


def seconds(*command, **options) -> float:
    """Returns the time of a whole command."""
    begin = time.perf_counter()
    run(*command, **options)
    return time.perf_counter() - begin


def cold(contender: Contender) -> Contender:
    """The same after the system's cache of files was emptied."""

    def measure() -> float:
        os.sync()
        Path("/proc/sys/vm/drop_caches").write_text("3")
        return contender.measure()

    return Contender(contender.name, measure)


# Shards

# 16 runs on one of the paper's datasets.
DIVIDED = ("scenarios=[empty]", "latent=[4,16]", "seeds=[0,1,2,3,4,5,6,7]", "training.epochs=60")


def shards(folder: Path) -> list[Comparison]:
    spec = ROOT / "experiments" / "single_to_multi.yaml"

    @functools.cache
    def dataset() -> Path:
        note("collecting the dataset")
        run(TARGET / "harness", "--results", folder / "collected", "collect", spec, *DIVIDED)
        return folder / "collected" / "datasets"

    def measure(processes: list[tuple], at_once: int) -> float:
        """Returns the time until all processes have ended. Each item has the options of one process."""
        collected = dataset()
        with tempfile.TemporaryDirectory(dir=folder) as results, ThreadPoolExecutor(at_once) as pool:
            shutil.copytree(collected, Path(results) / "datasets", copy_function=os.link)
            command = (TARGET / "harness", "--results", results, "run", spec, *DIVIDED)
            begin = time.perf_counter()
            list(pool.map(lambda options: run(*command, *options), processes))
            return time.perf_counter() - begin

    count = 4 * CORES
    shares = [
        ("--threads", "1", "--shard", f"{number}/{count}", "--no-wait") for number in range(1, count + 1)
    ]
    whole = [("--jobs", str(CORES))]
    return [
        Comparison(
            f"16 runs of 60 epochs in {count} shards",
            "s",
            (
                Contender("harness", lambda: measure(shares, count)),
                Contender(f"one process with --jobs {CORES}", lambda: measure(whole, 1), 0.9),
                Contender(f"{CORES} shards at a time", lambda: measure(shares, CORES)),
            ),
        )
    ]


# All parts

# The parts of the measurement by name.
PARTS = {
    "training": lambda folder, options: training(),
    "collection": lambda folder, options: collection(options.episodes, folder),
    "registry": lambda folder, options: many_runs(options.keep or folder),
    "shards": lambda folder, options: shards(options.keep or folder),
}


def compare(comparison: Comparison, rounds: int) -> list[report.Measurement]:
    """Measures every contender once in each round, one after the other."""
    values = {contender.name: [] for contender in comparison.contenders}
    for number in range(1, rounds + 1):
        for contender in comparison.contenders:
            value = contender.measure()
            values[contender.name].append(value)
            shown = report.quantity(value, comparison.unit)
            note(f"{comparison.name}, round {number} of {rounds}: {contender.name} {shown}")
    ours = statistics.median(values[comparison.contenders[0].name])
    measurements = []
    for contender in comparison.contenders:
        value = statistics.median(values[contender.name])
        measurements.append(
            report.Measurement(
                name=comparison.name,
                contender=contender.name,
                value=value,
                lowest=min(values[contender.name]),
                highest=max(values[contender.name]),
                unit=comparison.unit,
                rounds=rounds,
                ratio=value / ours if comparison.unit == "s" else ours / value,
                target=contender.target,
            )
        )
    return measurements


def note(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument(
        "--episodes",
        type=int,
        default=max(3 * CORES, 6),
        help=f"episodes of a scenario, with {SAMPLES_PER_EPISODE} samples each",
    )
    parser.add_argument("--only", choices=tuple(PARTS))
    parser.add_argument("--match", default="", metavar="TEXT", help="run only comparisons whose name contains TEXT")
    parser.add_argument(
        "--keep",
        type=Path,
        metavar="DIR",
        help="keep the test data of the registry and the shards in DIR, for the next call",
    )
    parser.add_argument("--output", type=Path, help="Parquet file to which the measurements are written")
    parser.add_argument("--markdown", type=Path, help="file to which the printed table is written")
    options = parser.parse_args()
    if options.rounds < 1:
        parser.error("--rounds must be 1 or more")
    # A spec requires this too.
    if options.episodes < 3:
        parser.error("--episodes must be 3 or more")
    return options


def main() -> None:
    options = arguments()
    load, *_ = os.getloadavg()
    if load > 0.5:
        note(f"warning: the machine is not idle (load average {load:.1f}), so the ratios are not reliable")
    measurements = []
    if options.keep:
        options.keep.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        for name in [options.only] if options.only else PARTS:
            comparisons = PARTS[name](Path(folder), options)
            for comparison in (one for one in comparisons if options.match in one.name):
                measurements += compare(comparison, options.rounds)
    machine = report.Machine.this(ROOT, TARGET / "harness")
    table = report.markdown(measurements, machine)
    print(table)
    if options.markdown:
        options.markdown.write_text(table + "\n")
    if options.output:
        report.write_parquet(options.output, measurements, machine)


if __name__ == "__main__":
    main()
