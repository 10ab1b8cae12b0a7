"""Compares the speed of collecting with a policy with that of collecting with the world's own motion.

The policy reads two modalities, and returns the setpoints that the built-in motion had, so that both simulate nearly
the same. Both are collected in alternating rounds, with the same number of workers and episodes, in a new folder each
time. The printed ratio is the number of samples per second with the policy, divided by that with the built-in motion.
Start-up times count.

    .venv/bin/python harness/benches/policy_collection.py cluttered --workers 1 --episodes 40 --rounds 5
    taskset --cpu-list 0 .venv/bin/python harness/benches/policy_collection.py empty --workers 4
"""

import argparse
import statistics
import tempfile
import time

import numpy as np

import harness
from harness.policies import Observations


class Replay:
    """Returns the setpoints of recorded episodes."""

    def __init__(self, setpoints: np.ndarray) -> None:
        """setpoints: `[episodes, samples, elements]`."""
        self.setpoints = setpoints

    def __call__(self, observations: Observations) -> np.ndarray:
        seen = observations["proprioception"][-1].sum() + observations["contact_force"][-1].sum()
        assert np.isfinite(seen)
        return self.setpoints[observations.episode, observations.sample + 1]


def collect(options: argparse.Namespace, policy: Replay | None) -> tuple[float, np.ndarray]:
    """The time of a collection, s, and the setpoints that it recorded, `[episodes, samples, elements]`."""
    with tempfile.TemporaryDirectory() as results:
        overrides = {"scenarios": options.scenario, "simulation.episodes": options.episodes}
        version = None if policy is None else "1"
        begin = time.perf_counter()
        ((folder, made),) = harness.collect(
            "multi_to_multi",
            overrides,
            policy=policy,
            version=version,
            workers=options.workers,
            results=results,
            progress=False,
        ).items()
        took = time.perf_counter() - begin
        assert made == options.episodes
        setpoints = harness.Dataset(folder, frames=False)["setpoint"].astype(np.float64)
        return took, setpoints.reshape(options.episodes, -1, setpoints.shape[1])


def main() -> None:
    parser = argparse.ArgumentParser(description="Compares the speeds of collecting with and without a policy.")
    parser.add_argument("scenario", help="a built-in world, such as empty")
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    ratios, speeds = [], {"motion": [], "policy": []}
    for _ in range(options.rounds):
        took, setpoints = collect(options, None)
        samples = setpoints.shape[0] * setpoints.shape[1]
        speeds["motion"].append(samples / took)
        took, _ = collect(options, Replay(setpoints))
        speeds["policy"].append(samples / took)
        ratios.append(speeds["policy"][-1] / speeds["motion"][-1])
        print(f"{speeds['motion'][-1]:.0f} {speeds['policy'][-1]:.0f} samples/s, ratio {ratios[-1]:.2f}", flush=True)
    medians = {name: statistics.median(values) for name, values in speeds.items()}
    print(
        f"{options.scenario}, {options.workers} workers, {options.episodes} episodes: built-in motion "
        f"{medians['motion']:.0f} samples/s, policy {medians['policy']:.0f} samples/s, "
        f"median ratio {statistics.median(ratios):.2f} of {options.rounds} rounds"
    )


if __name__ == "__main__":
    main()
