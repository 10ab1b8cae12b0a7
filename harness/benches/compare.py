"""Runs the harness and its peers in turn on this machine and prints one table of ratios.

    python harness/benches/compare.py [--rounds 3] [--samples 6000] [--skip training|collection]

Needs what requirements.txt beside this file lists, `cargo build --examples` done before, and an otherwise idle
machine: rounds alternate between the peers, and each figure is the median over the rounds, so that a drift of
the machine's speed does not favour one of them. A ratio above 1 means that the harness is faster.
"""

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

BENCHES = Path(__file__).parent
ROOT = BENCHES.parents[1]
TARGET = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")) / "debug"
SAMPLES_PER_EPISODE = 1000


def last_json(*command):
    """Runs a command and returns the JSON of the last line it prints."""
    printed = subprocess.run([str(part) for part in command], check=True, capture_output=True, text=True).stdout
    return json.loads(printed.strip().splitlines()[-1])


def harness_step(architecture, latent, steps):
    example = TARGET / "examples" / "training_step"
    return last_json(example, "--architecture", architecture, "--latent", latent, "--steps", steps)["median_seconds"]


def torch_step(architecture, latent, steps):
    script = BENCHES / "training_step.py"
    options = ("--architecture", architecture, "--latent", latent, "--steps", steps, "--mode", "eager")
    return last_json(sys.executable, script, *options)["median_seconds"]


def harness_collection(scenario, samples):
    """Samples a second of the whole command: start, simulation, rendering and writing to disk."""
    with tempfile.TemporaryDirectory() as results:
        begin = time.perf_counter()
        settings = [f"scenarios=[{scenario}]", f"simulation.episodes={samples // SAMPLES_PER_EPISODE}"]
        command = [TARGET / "harness", "collect", ROOT / "experiments" / "multi_to_multi.yaml", *settings]
        subprocess.run([*command, "--results", results], check=True, capture_output=True)
        return samples / (time.perf_counter() - begin)


def python_collection(scenario, samples, *options):
    script = BENCHES / "collect.py"
    return last_json(sys.executable, script, "--scenario", scenario, "--samples", samples, *options)["samples_per_second"]


def alternate(rounds, *measures):
    """The median of each measure over the rounds."""
    values = [[measure() for measure in measures] for _ in range(rounds)]
    return [statistics.median(column) for column in zip(*values)]


def training_rows(rounds):
    for architecture, latent, steps in (("convolutional", 64, 8), ("fully_connected", 4, 200)):
        ours, theirs = alternate(
            rounds,
            lambda: harness_step(architecture, latent, steps),
            lambda: torch_step(architecture, latent, steps),
        )
        name = f"training step, {architecture}, latent {latent}, batch 1024"
        yield name, f"{ours * 1e3:.1f} ms", "PyTorch eager", f"{theirs * 1e3:.1f} ms", theirs / ours


def collection_rows(rounds, samples):
    for scenario in ("empty", "cluttered"):
        ours, tuned = alternate(
            rounds,
            lambda: harness_collection(scenario, samples),
            lambda: python_collection(scenario, samples, "--processes", "2"),
        )
        untuned = python_collection(scenario, 200, "--untuned")
        name = f"collection, {scenario}"
        yield name, f"{ours:.0f} samples/s", "Python, tuned", f"{tuned:.0f} samples/s", ours / tuned
        yield name, f"{ours:.0f} samples/s", "Python, as first written", f"{untuned:.1f} samples/s", ours / untuned


def processor():
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return platform.processor()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--samples", type=int, default=6000, help="a whole number of thousands")
    parser.add_argument("--skip", choices=("training", "collection"))
    arguments = parser.parse_args()
    rows = []
    if arguments.skip != "training":
        rows.extend(training_rows(arguments.rounds))
    if arguments.skip != "collection":
        rows.extend(collection_rows(arguments.rounds, arguments.samples))
    print(f"{processor()}, {os.cpu_count()} cores; medians of {arguments.rounds} rounds\n")
    print("| what | harness | peer | | harness is faster by |\n|---|---|---|---|---|")
    for name, ours, peer, theirs, ratio in rows:
        print(f"| {name} | {ours} | {peer} | {theirs} | {ratio:.2f} x |")


if __name__ == "__main__":
    main()
