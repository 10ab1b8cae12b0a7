"""Episodes of a task in parallel: the common part of the environments for dm_env and Gymnasium."""

from __future__ import annotations

import os
import secrets
import textwrap
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ._arguments import integer, name_tuple
from ._harness import SimulationBatch
from .tasks import State, task_named

__all__ = ["Episodes"]

MAX_SEED = 2**53 - 1
"""The largest seed of a dataset."""

FASTEST = 1.5
"""Largest slope of a dataset's smoothstep moves, in setpoint ranges per actuation. It limits the arm's speed here."""


class Episodes:
    """Episodes of a task, one in each of `count` simulations.

    Actions: an action is the change of the setpoint until the next sample, with one number for each element of the
    setpoint. For the worlds `empty` and `cluttered` these are rotation (rad), lift and extension (m). It is clipped
    to `fastest`, the largest change that occurs in datasets. Networks with `action: increment` take the same action.

    Episodes: a seed determines a dataset, and the seed and an index determine an episode of it. A reset with a seed
    starts the dataset's first episode, and a reset without a seed starts the next one. The boxes have the same places
    as in the dataset. The goal depends only on the seed and the index.

    Rewards: the reward of an action is between 0 and 1, and depends on the task. Without a task it is 0. An episode
    ends after a given number of actions.

    Args:
        scenario: a built-in world, such as `empty` or `cluttered`, or the path of a world file.
        task: `reach`, `press` or `push`, see `harness.tasks`; or None, without a goal and with every reward 0.
        count: number of simulations, 1 to 4096.
        modalities: names of the observed modalities. The default is all vectors, and no image.
        samples: number of actions in an episode. An action takes 0.1 s with the default settings.
        spec: an experiment, whose simulation settings are used: the path of a YAML file, or the name of a built-in
            experiment. The default is the world's own settings.

    Raises:
        ValueError: there is no such world or task, the world does not have the task, or a number is out of range.
        KeyError: the world does not have one of the modalities.
        FileNotFoundError: there is no such experiment.

    Attributes:
        simulations: the simulations, a `harness.SimulationBatch`.
        task: the task, a `harness.tasks.Task`; or None.
        names: names of the elements of an action.
        shapes: shapes of all modalities of one simulation, by name: `(elements,)` or `(rows, columns, 3)`.
        modalities: names of the observed modalities.
        samples: number of actions in an episode.
        ranges: lowest and highest value of each element of the setpoint, `[elements, 2]`, in rad or m.
        fastest: the largest change of the setpoint from one sample to the next, `[elements]`, in rad or m.
        seeds: seed of each simulation's dataset; None before its first reset.
        indices: index of each simulation's episode in the dataset of its seed, `[count]`.
        taken: number of actions that were taken in each episode, `[count]`.
        goals: goal of each episode, `[count, elements]`.

    Example:
        >>> from harness.episodes import Episodes
        >>> episodes = Episodes("empty", "press", count=2, samples=50)
        >>> episodes
        <harness.episodes.Episodes press in empty: 2 at once, 50 samples each>
        >>> episodes.reset(0, seed=1)
        >>> episodes.reset(1, seed=2)
        >>> episodes.step([[0.0, -0.02, 0.0], [0.0, -0.02, 0.0]])
        array([0., 0.])
        >>> {name: values.shape for name, values in episodes.observe().items()}["proprioception"]
        (2, 20)
    """

    def __init__(
        self,
        scenario: str | os.PathLike[str],
        task: str | None,
        count: int = 1,
        *,
        modalities: Iterable[str] | None = None,
        samples: int = 100,
        spec: str | os.PathLike[str] | None = None,
    ) -> None:
        if integer("samples", samples) < 1:
            raise ValueError(f"samples: {samples} must be at least 1")
        self.simulations = SimulationBatch(scenario, count, spec)
        self.task = None if task is None else task_named(task, self.simulations.scenario)
        self.names = self.simulations.action
        self.shapes = self.simulations.modalities
        vectors = tuple(name for name, shape in self.shapes.items() if len(shape) == 1)
        self.modalities = vectors if modalities is None else name_tuple(modalities)
        self.samples = samples
        self.ranges = self.simulations.setpoint_ranges
        per_sample = FASTEST * self.simulations.sample_seconds / self.simulations.actuation_seconds
        self.fastest = per_sample * (self.ranges[:, 1] - self.ranges[:, 0])
        self.seeds: list[int | None] = [None] * count
        self.indices = np.zeros(count, dtype=np.int64)
        self.taken = np.zeros(count, dtype=np.int64)
        self.goals = np.zeros((count, len(self.task.goal_low) if self.task else 0))
        for modality in self.modalities:
            if len(self.shapes.get(modality, ())) != 3:
                self.simulations.sense(modality)

    def __repr__(self) -> str:
        task = f"{self.task.name} in " if self.task else ""
        what = f"{len(self.taken)} at once, {self.samples} samples each"
        return f"<harness.episodes.Episodes {task}{self.simulations.scenario}: {what}>"

    def reset(self, index: int, seed: int | None = None) -> None:
        """Starts an episode in one simulation.

        Args:
            index: the simulation, from 0.
            seed: the seed of a dataset, whose first episode starts, 0 to 2^53 - 1. Without a seed, the next episode of
                the same dataset starts. At the first reset there is none yet, so a seed is drawn and its first episode
                starts.

        Raises:
            ValueError: the index or the seed is out of range.
            TypeError: the seed is not an integer.
        """
        seed = checked_seed(seed)
        if not 0 <= integer("index", index) < len(self.seeds):
            raise ValueError(f"index: there are simulations 0 to {len(self.seeds) - 1}, not {index}")
        known = self.seeds[index] if seed is None else None
        if known is None:
            known = secrets.randbelow(MAX_SEED) if seed is None else seed
            episode = 0
        else:
            episode = int(self.indices[index]) + 1
        self.simulations.reset(index, known, episode)
        self.seeds[index], self.indices[index], self.taken[index] = known, episode, 0
        if self.task is None:
            return
        self.goals[index] = self.task.draw(np.random.default_rng([known, episode]), self.state(), index)

    def step(self, actions: ArrayLike, active: NDArray[np.bool_] | None = None) -> NDArray[np.float64]:
        """Takes an action in each simulation.

        Args:
            actions: `[count, elements]`, clipped to `fastest`.
            active: `[count]`, booleans: which simulations take their action. The default is all.

        Returns:
            The rewards, `[count]`; 0 for a simulation that takes no action.

        Raises:
            ValueError: the actions have the wrong shape, or are not finite numbers.
            RuntimeError: a simulation was not reset before its first action.
        """
        if None in self.seeds:
            raise RuntimeError(f"simulation {self.seeds.index(None)} has no episode; call reset first")
        change = np.clip(checked_actions("actions", actions, len(self.taken), self.names), -self.fastest, self.fastest)
        self.simulations.step(self.simulations.setpoint + change, active)
        rewards = np.zeros(len(self.taken)) if self.task is None else self.task.reward(self.state(), self.goals)
        if active is None:
            self.taken += 1
            return rewards
        self.taken += active
        return np.where(active, rewards, 0.0)

    @property
    def ended(self) -> NDArray[np.bool_]:
        """Whether each episode has ended, `[count]`."""
        return np.asarray(self.taken >= self.samples)

    def state(self) -> State:
        """Returns the state at the present samples, from which tasks compute rewards."""
        return State(
            setpoint_ranges=self.ranges,
            fingertip=self.simulations.fingertip,
            contact_force=self.simulations.sense("contact_force_mean").astype(np.float64),
            boxes=self.simulations.boxes,
        )

    def observe(self) -> dict[str, NDArray[Any]]:
        """Returns the observations at the present samples, by modality, and the task's `goal`, each `[count, …]`."""
        observed = {modality: self.simulations.sense(modality) for modality in self.modalities}
        return observed if self.task is None else {**observed, "goal": self.goals.astype(np.float32)}

    def bounds(self) -> dict[str, tuple[Any, Any, tuple[int, ...], type]]:
        """Returns the lowest and highest value, the shape and the type of each modality of one simulation, by name."""
        # The arm is up to 0.02 rad or m away from its setpoint, and joints bend beyond their limits by less than that.
        # The bound of the forces is more than ten times the largest force of a dataset.
        arm = self.ranges + np.array([-0.5, 0.5])
        known: dict[str, tuple[Any, Any]] = {
            "proprioception": (-np.pi, np.pi),
            "contact_force": (0.0, 1e4),
            "contact_force_mean": (0.0, 1e4),
        }
        # In other worlds, the action may have more elements than the modality `arm`.
        if self.shapes.get("arm") == (len(arm),):
            known["arm"] = (arm[:, 0], arm[:, 1])
        bounds: dict[str, tuple[Any, Any, tuple[int, ...], type]] = {}
        for modality in self.modalities:
            shape = self.shapes[modality]
            is_image = len(shape) == 3
            low, high = (0, 255) if is_image else known.get(modality, (-np.inf, np.inf))
            bounds[modality] = (low, high, shape, np.uint8 if is_image else np.float32)
        if self.task is None:
            return bounds
        goal = (np.array(self.task.goal_low), np.array(self.task.goal_high), self.goals.shape[1:], np.float32)
        return {**bounds, "goal": goal}


def one_action(action: ArrayLike, names: list[str]) -> NDArray[np.float64]:
    """Returns one action `[elements]` as a batch `[1, elements]`. Raises ValueError if it is wrong."""
    return checked_actions("action", action, None, names)[None]


def checked_actions(what: str, actions: ArrayLike, count: int | None, names: list[str]) -> NDArray[np.float64]:
    """Returns actions `[count, elements]`, or a single one `[elements]` if `count` is None.

    Raises:
        ValueError: the shape is wrong, or a value is not a finite number.
    """
    shape = (len(names),) if count is None else (count, len(names))
    try:
        values = np.asarray(actions, dtype=np.float64)
    except (TypeError, ValueError):
        values = np.empty(0)
    if values.shape != shape or not np.all(np.isfinite(values)):
        many = "" if count is None else f"{count} times "
        given = textwrap.shorten(repr(actions), 80, placeholder=" …")
        raise ValueError(f"{what}: {given} must be {many}{len(names)} finite numbers: {', '.join(names)}")
    return values


def checked_seed(seed: int | None) -> int | None:
    """Returns a seed as an integer. Raises TypeError if it is none, and ValueError if it is out of range."""
    if seed is None:
        return None
    if not 0 <= integer("seed", seed) <= MAX_SEED:
        raise ValueError(f"seed: {seed} must be 0 to {MAX_SEED}")
    return integer("seed", seed)
