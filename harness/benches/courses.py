"""Reads the courses of episodes that the example `courses` writes, and divides them among processes.

collect.py and pybullet_collect.py use it, so that both simulate the harness's episodes and are timed in the same way.
"""

import argparse
import dataclasses
import json
import multiprocessing
import time
from pathlib import Path

import numpy as np

START_TIMEOUT = 120  # s, until every process has opened its model and renderer


@dataclasses.dataclass
class Course:
    """The commands of one episode."""

    index: int
    start: np.ndarray  # [coordinates], MuJoCo's positions at the first sample
    end: np.ndarray | None  # the same at the last sample; None if the episode is cut short
    controls: np.ndarray  # [steps, 3], rotation (rad), lift and extension (m) during each step
    samples: int
    steps_per_sample: int


def read_courses(path: Path, samples: int | None) -> list[Course]:
    """Returns the courses in a file, each cut to `samples` samples. courses.rs describes the file."""
    episodes, recorded, steps_per_sample, steps, coordinates, controls = np.fromfile(
        path, np.int64, 6
    ).tolist()
    width = 2 * coordinates + steps * controls
    values = np.memmap(path, np.float64, "r", offset=6 * 8, shape=(episodes, width))
    kept = min(samples or recorded, recorded)
    kept_steps = (kept - 1) * steps_per_sample + 1
    return [
        Course(
            index,
            start=np.array(row[:coordinates]),
            end=np.array(row[coordinates : 2 * coordinates]) if kept == recorded else None,
            controls=np.array(row[2 * coordinates :]).reshape(steps, controls)[:kept_steps],
            samples=kept,
            steps_per_sample=steps_per_sample,
        )
        for index, row in enumerate(values)
    ]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--scenario", choices=["empty", "cluttered"], default="empty")
    parser.add_argument("--courses", type=Path, required=True, help="the file that the example `courses` wrote")
    parser.add_argument("--episodes", type=int, help="number of episodes, from the first one on; default: all")
    parser.add_argument("--samples-per-episode", type=int, help="number of samples, from the first on; default: all")
    parser.add_argument("--processes", type=int, default=2)


def _work(make_collector, options, next_episode, ready, results) -> None:
    """Simulates the next episode until none is left."""
    collector = make_collector(options)
    courses = read_courses(options.courses, options.samples_per_episode)[: options.episodes]
    ready.wait(START_TIMEOUT)
    samples = touched = 0
    while True:
        with next_episode.get_lock():
            index = next_episode.value
            next_episode.value += 1
        if index >= len(courses):
            break
        contact_force_mean = collector.episode(courses[index])
        samples += courses[index].samples
        touched += int((contact_force_mean > 0).any(axis=1).sum())
    results.put((samples, touched))


def collect(make_collector, options: argparse.Namespace) -> None:
    """Times all episodes, and prints JSON.

    Each process calls `make_collector(options)` once. The collector has a method `episode(course)`, which returns the
    mean contact forces of the episode, `[samples, 20]`. The time runs from when all processes are ready until the
    last one is done.
    """
    context = multiprocessing.get_context("spawn")
    next_episode = context.Value("q", 0)
    ready, results = context.Barrier(options.processes + 1), context.Queue()
    workers = [
        context.Process(target=_work, args=(make_collector, options, next_episode, ready, results))
        for _ in range(options.processes)
    ]
    for worker in workers:
        worker.start()
    ready.wait(START_TIMEOUT)
    begin = time.perf_counter()
    for worker in workers:
        worker.join()
    seconds = time.perf_counter() - begin
    if any(worker.exitcode for worker in workers):
        raise SystemExit("a process failed: its message is above")
    shares = [results.get() for _ in workers]
    samples, touched = (sum(column) for column in zip(*shares))
    report = {
        "seconds": round(seconds, 3),
        "samples": samples,
        "samples_per_second": round(samples / seconds, 2),
        "share_of_samples_in_contact": round(touched / samples, 3),
    }
    print(json.dumps(vars(options) | report, default=str))
