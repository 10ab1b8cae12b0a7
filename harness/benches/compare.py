"""Runs the harness and its peers in turn on this machine and prints one table of ratios.

    make bench                                                       everything, as published
    .venv-bench/bin/python harness/benches/compare.py --only collection --rounds 1 --episodes 4

`make bench` also installs and builds what this needs. Rounds alternate between the contenders, and each figure is the
median over the rounds, so that a drift of the machine's speed favours none of them. A ratio above 1 means that the
harness is faster; "at least" is what the project has set itself. Run it on an otherwise idle machine.

Training: one step of both networks beside PyTorch (training_step.py) and beside its matrix products alone, through
gemm (the example `products`) and PyTorch (products.py).

Collection: the whole command `harness collect`, with its start and writing to disk, beside Python's `mujoco`
(collect.py), PyBullet (pybullet_collect.py), and MuJoCo's own functions called from C without recording
(raw_limit.c), whose start is not counted. All simulate the same episodes.
"""

import argparse
import json
import os
import shlex
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import report

BENCHES = Path(__file__).parent
ROOT = BENCHES.parents[1]
TARGET = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")) / "debug"
MODELS = ROOT / "models"
SAMPLES_PER_EPISODE = 1000
CORES = report.cores()

# Latent sizes as in multi_to_multi.yaml and single_to_multi.yaml.
LATENTS = {"convolutional": (16, 64, 128), "fully_connected": (2, 4, 16)}
# Timed steps a round: some seconds each.
STEPS = {"convolutional": 8, "fully_connected": 300}
UNTUNED_SAMPLES = 100  # at about 20 a second
PYBULLET_SAMPLES = 300  # of each episode


@dataclass(frozen=True)
class Contender:
    name: str
    measure: Callable[[], float]
    # How many times as fast the harness is to be; None where that is only reported.
    target: float | None = None


@dataclass(frozen=True)
class Comparison:
    """Contenders at the same work; the first is the harness."""

    name: str
    unit: str  # "s" for a time, "1/s" for a rate
    contenders: tuple[Contender, ...]


def run(*command, **options) -> str:
    """What a command prints; if it fails, the reason ends this program."""
    command = [str(part) for part in command]
    done = subprocess.run(command, capture_output=True, check=False, text=True, **options)
    if done.returncode:
        raise SystemExit(f"{shlex.join(command)} failed:\n{done.stdout}{done.stderr}")
    return done.stdout


def last_json(*command, **options) -> dict:
    """The JSON of the last line that a command prints."""
    return json.loads(run(*command, **options).strip().splitlines()[-1])


def python(script: str, *arguments, **options) -> dict:
    return last_json(sys.executable, BENCHES / script, *arguments, **options)


def example(name: str, *arguments) -> dict:
    return last_json(TARGET / "examples" / name, *arguments)


# Training


def training() -> list[Comparison]:
    return [
        training_step(architecture, latent)
        for architecture, latents in LATENTS.items()
        for latent in latents
    ]


def training_step(architecture: str, latent: int) -> Comparison:
    steps = ("--steps", STEPS[architecture])
    network = ("--architecture", architecture, "--latent", latent)

    def harness(*options):
        return lambda: example("training_step", *network, *steps, *options)["median_seconds"]

    def pytorch(*options):
        return lambda: python("training_step.py", *network, *steps, *options)["median_seconds"]

    def pytorch_products():
        listed = json.dumps(example("products", *network, "--steps", 1))
        return python("products.py", *steps, input=listed)["median_seconds"]

    convolutional = architecture == "convolutional"
    return Comparison(
        f"training step, {architecture}, latent {latent}, batch 1024",
        "s",
        (
            Contender("harness", harness()),
            Contender("PyTorch eager", pytorch("--mode", "eager"), 2.5 if convolutional else 2.0),
            Contender("PyTorch compiled", pytorch("--mode", "compile"), 1.0 if convolutional else None),
            Contender("PyTorch eager, bf16 autocast", pytorch("--mode", "eager", "--precision", "bf16")),
            *([Contender("harness, bf16", harness("--precision", "bf16"))] if convolutional else []),
            Contender(
                "matrix products alone, gemm",
                lambda: example("products", *network, *steps)["median_seconds"],
                0.5 if convolutional else None,
            ),
            Contender("matrix products alone, PyTorch", pytorch_products),
        ),
    )


# Collection


def collection(episodes: int, folder: Path) -> list[Comparison]:
    raw_limit = compile_raw_limit()
    return [collection_of(scenario, episodes, folder, raw_limit) for scenario in ("empty", "cluttered")]


def compile_raw_limit() -> Path:
    """The C program, linked to the library that the harness uses."""
    library = ROOT / ".venv" / "mujoco"
    include = (library / "libmujoco.so").resolve().parent / "include"
    program = TARGET / "examples" / "raw_limit"
    linked = ("-L", library, "-lmujoco", "-ldl", "-lpthread", f"-Wl,-rpath,{library}")
    run("cc", "-O2", "-I", include, BENCHES / "raw_limit.c", "-o", program, *linked)
    return program


def without_sleeping(folder: Path) -> Path:
    """A folder with the cluttered model, in which boxes at rest are simulated too."""
    text = (MODELS / "cluttered.xml").read_text()
    changed = text.replace('sleep="enable"', 'sleep="disable"')
    if changed == text:
        raise SystemExit(
            "models/cluttered.xml has no sleep flag any more: change without_sleeping in compare.py"
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
        """With `--no-rendering`, mj_step alone."""
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
    """Samples a second of the whole command: start, simulation, rendering and writing to disk."""
    with tempfile.TemporaryDirectory() as results:
        settings = (f"scenarios=[{scenario}]", f"simulation.episodes={episodes}")
        spec = ROOT / "experiments" / "multi_to_multi.yaml"
        begin = time.perf_counter()
        run(TARGET / "harness", "collect", spec, *settings, *options, "--results", results)
        return episodes * SAMPLES_PER_EPISODE / (time.perf_counter() - begin)


# Both


def compare(comparison: Comparison, rounds: int) -> list[report.Measurement]:
    """Measures every contender once a round, in turn."""
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
        help=f"of a scenario, {SAMPLES_PER_EPISODE} samples each",
    )
    parser.add_argument("--only", choices=("training", "collection"))
    parser.add_argument("--output", type=Path, help="a Parquet file for the measurements")
    parser.add_argument("--markdown", type=Path, help="a file for the printed table")
    options = parser.parse_args()
    if options.rounds < 1:
        parser.error("--rounds must be 1 or more")
    # As a spec has.
    if options.episodes < 3:
        parser.error("--episodes must be 3 or more")
    return options


def main() -> None:
    options = arguments()
    load, *_ = os.getloadavg()
    if load > 0.5:
        note(f"warning: the machine is not idle (load average {load:.1f}), so the ratios will not hold")
    measurements = []
    with tempfile.TemporaryDirectory() as folder:
        comparisons = []
        if options.only != "collection":
            comparisons += training()
        if options.only != "training":
            comparisons += collection(options.episodes, Path(folder))
        for comparison in comparisons:
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
