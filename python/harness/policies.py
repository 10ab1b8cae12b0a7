"""Datasets of a policy: a Python function that gives each setpoint from what has been observed so far."""

from __future__ import annotations

import hashlib
import inspect
import multiprocessing
import multiprocessing.connection
import os
import pickle
import re
import signal
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ._harness import PolicyDataset, Recorder
from .episodes import checked_actions

__all__ = ["Observations", "Policy", "identity"]

NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,63}")
"""The name of a policy in a spec."""

VERSION = re.compile(r"[A-Za-z0-9_.+-]{1,64}")
"""The version of a policy in a spec."""

REPORT_SECONDS = 0.2
"""Time between two messages of a worker about its progress."""


class Observations(Mapping[str, NDArray[Any]]):
    """What has been recorded of an episode so far: a read-only array of each modality, by name.

    The arrays are `[samples, elements]`, or `[samples, rows, columns, 3]` for images. The last row is the present
    sample. The modalities are those of the dataset. `setpoint` is the setpoint at each sample.

    Attributes:
        scenario: name of the world.
        episode: index of the episode in the dataset.
        sample: index of the present sample in the episode. The first one, at rest, is 0.
        samples: number of samples in an episode.
        sample_seconds: time from one sample to the next, s.
        action: names of the elements of a setpoint, such as `rotation`.
        ranges: lowest and highest value of each element of a setpoint, `[elements, 2]`, in rad or m.
        random: a random generator for this episode, seeded with the dataset's seed and the episode's index.
    """

    def __init__(self, recorder: Recorder, episode: int) -> None:
        self.scenario = recorder.scenario
        self.episode = episode
        self.sample = 0
        self.samples = recorder.samples
        self.sample_seconds = recorder.sample_seconds
        self.action = recorder.action
        self.ranges = recorder.setpoint_ranges
        self.random = np.random.default_rng([recorder.seed, episode])
        self._recorder = recorder
        self._shapes = recorder.modalities
        # The rows that were read so far, with room for all.
        self._read: dict[str, tuple[int, NDArray[Any]]] = {}

    def __getitem__(self, name: str) -> NDArray[Any]:
        if name not in self._shapes:
            raise KeyError(f"the dataset has no '{name}'; it has {', '.join(self._shapes)}")
        known, rows = self._read.get(name, (0, np.empty(0)))
        if known <= self.sample:
            new = self._recorder.values(name, known)
            if known == 0:
                rows = np.empty((self.samples, *self._shapes[name]), new.dtype)
            rows[known : self.sample + 1] = new
            self._read[name] = (self.sample + 1, rows)
        seen = rows[: self.sample + 1]
        seen.flags.writeable = False
        return seen

    def __iter__(self) -> Iterator[str]:
        return iter(self._shapes)

    def __len__(self) -> int:
        return len(self._shapes)

    def __repr__(self) -> str:
        return f"<harness.policies.Observations sample {self.sample} of episode {self.episode} in {self.scenario}>"


Policy = Callable[[Observations], ArrayLike]
"""A function that returns the setpoint of the next sample, `[elements]`, in rad or m."""


class PolicyFailure(Exception):
    """A policy raised an exception, or returned no setpoint. The text is the message."""


class PolicyTask(NamedTuple):
    """What a worker needs to simulate episodes of an experiment, in addition to the policy."""

    path: Path
    settings: list[str]
    quick: bool
    results: Path
    identity: str

    def datasets(self, progress: bool) -> list[PolicyDataset]:
        """The datasets of the experiment."""
        return PolicyDataset.of(self.path, self.settings, self.quick, self.results, self.identity, progress)


def identity(policy: Policy, version: str | None = None) -> str:
    """Returns the name and version of a policy, `NAME@VERSION`, as `simulation.policy` names it.

    Args:
        policy: the policy. Its name is that of the function, or that of the class of an object.
        version: a text that changes whenever the policy does. The default is a hash of the file that defines the
            function: the first 16 digits of its SHA-256.

    Raises:
        TypeError: the policy can't be called, or the version is no text.
        ValueError: the name or the version has wrong characters, or a version is needed.
    """
    if not callable(policy):
        raise TypeError(f"policy: {policy!r} must be a function of the observations")
    name = getattr(policy, "__name__", type(policy).__name__)
    if NAME.fullmatch(name) is None:
        raise ValueError(f"policy: '{name}' can't be a policy's name; define the policy with `def` and a name of ASCII")
    if version is None:
        version = _source_hash(policy, name)
    if not isinstance(version, str):
        raise TypeError(f"version: {version!r} must be a text")
    if VERSION.fullmatch(version) is None:
        raise ValueError(f"version: '{version}' must be 1 to 64 of the characters A-Z, a-z, 0-9, '_', '.', '+', '-'")
    return f"{name}@{version}"


def _source_hash(policy: Policy, name: str) -> str:
    """Returns the first digits of the SHA-256 of the file that defines a function."""
    why = "is no plain function, so its source does not tell what it does"
    if inspect.isfunction(policy) and policy.__closure__ is None:
        try:
            return hashlib.sha256(Path(inspect.getfile(policy)).read_bytes()).hexdigest()[:16]
        except (OSError, TypeError):
            why = "was not read from a file"
    raise ValueError(f"version: {name} {why}; give `version`, and change it whenever the policy changes")


def collect(task: PolicyTask, policy: Policy, workers: int | None, progress: bool) -> dict[Path, int]:
    """Simulates the missing episodes of the datasets of a policy; see `harness.collect`."""
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        # A worker imports a script that calls this function when it is imported. The other process says why.
        raise SystemExit(1)
    made: dict[Path, int] = {}
    for place, dataset in enumerate(task.datasets(progress)):
        missing = dataset.claim()
        done: list[int] = []
        discarded: list[int] = []
        try:
            count = min(_cores() if workers is None else workers, len(missing))
            if count == 1:
                _here(dataset, task.identity, policy, missing, done)
            elif count > 1:
                _in_processes(dataset, place, task, policy, missing, done, count)
        except PolicyFailure as failure:
            discarded = missing
            raise RuntimeError(str(failure)) from failure.__cause__
        finally:
            dataset.release(discarded)
        made[dataset.folder] = len(done)
    return made


def _cores() -> int:
    """The number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _here(dataset: PolicyDataset, identity: str, policy: Policy, missing: list[int], done: list[int]) -> None:
    """Simulates episodes in this process, and appends them to `done`."""
    recorder = dataset.recorder()
    for episode in missing:
        _record(recorder, identity, policy, episode, dataset.advance)
        done.append(episode)


def _record(
    recorder: Recorder, identity: str, policy: Policy, episode: int, advance: Callable[[int], None]
) -> None:
    """Simulates and writes one episode. Calls `advance` with the number of samples that were simulated since the last
    call.

    Raises:
        PolicyFailure: the policy raised an exception, or returned no setpoint.
    """
    recorder.start(episode)
    observations = Observations(recorder, episode)
    advanced, last = 0, time.monotonic()
    for sample in range(1, recorder.samples):
        recorder.step(_ask(policy, observations, identity))
        observations.sample = sample
        if time.monotonic() - last > REPORT_SECONDS:
            advance(sample - advanced)
            advanced, last = sample, time.monotonic()
    recorder.save()
    advance(recorder.samples - advanced)


def _ask(policy: Policy, observations: Observations, identity: str) -> NDArray[np.float64]:
    """Returns the policy's next setpoint."""
    where = f"policy {identity}, episode {observations.episode}, sample {observations.sample}"
    try:
        answer = policy(observations)
    except Exception as error:
        # The first frame is this function's.
        frames = traceback.extract_tb(error.__traceback__)[1:]
        place = f" ({frames[-1].filename}, line {frames[-1].lineno})" if frames else ""
        said = f": {error}" if str(error) else ""
        raise PolicyFailure(f"{where}: it raised {type(error).__name__}{said}{place}") from error
    try:
        return checked_actions(f"{where}: the setpoint", answer, None, observations.action)
    except ValueError as error:
        raise PolicyFailure(str(error)) from None


def _in_processes(
    dataset: PolicyDataset,
    place: int,
    task: PolicyTask,
    policy: Policy,
    missing: list[int],
    done: list[int],
    count: int,
) -> None:
    """Simulates episodes in `count` processes, and appends them to `done`.

    Each process gets the next episode when it has written one. Processes are spawned, because a forked process has
    neither the threads nor the OpenGL contexts of its parent.
    """
    try:
        pickled = pickle.dumps(policy)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise ValueError(
            f"policy: {task.identity} can't be sent to {count} worker processes ({error}); define it at the top level "
            "of a module, or use workers=1"
        ) from None
    spawn = multiprocessing.get_context("spawn")
    workers: dict[Any, Any] = {}
    waiting = iter(missing)
    ready: Any
    try:
        for _ in range(count):
            ours, theirs = spawn.Pipe()
            arguments = (theirs, task, place, dataset.name, pickled)
            worker = spawn.Process(target=_work, args=arguments, name=f"worker of {task.identity}")
            worker.start()
            theirs.close()
            workers[ours] = worker
            ours.send(next(waiting))
        while len(done) < len(missing):
            # Workers without an episode have ended, or will.
            for ready in multiprocessing.connection.wait([ours for ours in workers if not ours.closed]):
                try:
                    kind, value = ready.recv()
                    if kind == "done":
                        done.append(value)
                        ready.send(following := next(waiting, None))
                        if following is None:
                            ready.close()
                except (EOFError, OSError):
                    workers[ready].join()
                    raise RuntimeError(_ended(task.identity, workers[ready].exitcode)) from None
                if kind == "advanced":
                    dataset.advance(value)
                elif kind == "failed":
                    raise PolicyFailure(value)
                elif kind == "broken":
                    raise RuntimeError(value)
    finally:
        for connection, worker in workers.items():
            if len(done) < len(missing):
                worker.kill()
            connection.close()
            worker.join()


def _ended(identity: str, code: int | None) -> str:
    """The message about a worker process that ended too early."""
    return (
        f"a worker process of {identity} ended with the exit code {code}; in a script, call harness.collect below "
        "`if __name__ == '__main__':`, because each worker imports the script; if the worker ran out of memory, use "
        "fewer workers"
    )


def _work(
    connection: multiprocessing.connection.Connection, task: PolicyTask, place: int, name: str, pickled: bytes
) -> None:
    """Simulates the episodes whose indices it receives, until it receives None or the other process ends."""
    # Ctrl-C is handled by the other process, which ends this one.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        try:
            policy = pickle.loads(pickled)
        except Exception as error:
            message = f"policy: a worker process can't load {task.identity} ({error}); define it at the top level of a "
            raise RuntimeError(message + "module that can be imported, or use workers=1") from None
        dataset = task.datasets(False)[place]
        if dataset.name != name:
            raise RuntimeError(f"the experiment has changed while its dataset {name} was collected; collect it again")
        recorder = dataset.recorder()
        while (episode := connection.recv()) is not None:
            _record(recorder, task.identity, policy, episode, lambda count: connection.send(("advanced", count)))
            connection.send(("done", episode))
    except (EOFError, BrokenPipeError):
        return
    except PolicyFailure as failure:
        connection.send(("failed", str(failure)))
    except Exception as error:
        connection.send(("broken", str(error)))
