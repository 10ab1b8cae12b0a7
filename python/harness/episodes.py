"""Episodes of a task in parallel: the common part of the environments for dm_env and Gymnasium."""

import os
import secrets
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ._harness import SimulationBatch
from .tasks import State, task_named

MAX_SEED = 2**53 - 1
"""The largest seed of a dataset."""

FASTEST = 1.5
"""Largest slope of a dataset's smoothstep moves, in setpoint ranges per actuation. It limits the arm's speed here."""


class Episodes:
    """`count` episodes of a task, independent of each other.

    An action is the change of the setpoint until the next sample. For the finger it is `[3]`: rotation (rad), lift and
    extension (m), as in networks with `action: increment`. Each simulation runs an episode of a dataset, which the
    dataset's seed and the episode's index determine. A reset with a seed starts that dataset's first episode, and a
    reset without one starts the next episode. The boxes therefore have the same places as in the dataset. The goal
    depends only on the seed and the index.
    """

    def __init__(
        self,
        scenario: str,
        task: str | None,
        count: int = 1,
        *,
        modalities: tuple[str, ...] | None = None,
        samples: int = 100,
        spec: str | os.PathLike[str] | None = None,
    ) -> None:
        """Creates the simulations. `reset` starts their episodes.

        Args:
            scenario: a built-in world, or the path of a world file.
            task: one of the finger's tasks in `harness.tasks.TASKS`. Without one, there is no goal and every reward is 0.
            count: number of simulations.
            modalities: the observed modalities; all vectors by default.
            samples: actions per episode, 0.1 s each with the default settings.
            spec: an experiment's YAML file, whose simulation settings are used.

        Raises:
            ValueError: an argument is wrong.
            KeyError: the world does not have one of the modalities.
        """
        if samples < 1:
            raise ValueError(f"samples: {samples} must be at least 1")
        self.simulations = SimulationBatch(scenario, count, None if spec is None else os.fspath(spec))
        self.task = None if task is None else task_named(task, scenario)
        self.names = self.simulations.action
        """Names of the elements of an action."""
        self.shapes = self.simulations.modalities
        """Shapes of all modalities of one simulation, by name: `[elements]` or `[rows, columns, 3]`."""
        vectors = tuple(name for name, shape in self.shapes.items() if len(shape) == 1)
        self.modalities = vectors if modalities is None else tuple(modalities)
        self.samples = samples
        self.ranges = self.simulations.setpoint_ranges
        per_sample = FASTEST * self.simulations.sample_seconds / self.simulations.actuation_seconds
        self.fastest = per_sample * (self.ranges[:, 1] - self.ranges[:, 0])
        """The largest change of the setpoint in a sample, `[elements]`."""
        self.seeds: list[int | None] = [None] * count
        """Seed of each simulation's dataset; None before the first reset."""
        self.indices = np.zeros(count, dtype=np.int64)
        """Index of each simulation's episode in the dataset of its seed."""
        self.taken = np.zeros(count, dtype=np.int64)
        """Actions taken in each episode."""
        self.goals = np.zeros((count, len(self.task.goal_low) if self.task else 0))
        for modality in self.modalities:
            if len(self.shapes.get(modality, ())) != 3:
                self.simulations.sense(modality)

    def reset(self, index: int, seed: int | None = None) -> None:
        """Starts the first episode of the seed or, without a seed, the next episode."""
        if seed is not None and not 0 <= seed <= MAX_SEED:
            raise ValueError(f"seed: {seed} must be 0 to {MAX_SEED}")
        known = self.seeds[index] if seed is None else None
        if known is None:
            known = secrets.randbelow(MAX_SEED) if seed is None else int(seed)
            episode = 0
        else:
            episode = int(self.indices[index]) + 1
        self.simulations.reset(index, known, episode)
        self.seeds[index], self.indices[index], self.taken[index] = known, episode, 0
        if self.task is None:
            return
        self.goals[index] = self.task.draw(np.random.default_rng([known, episode]), self.state(), index)

    def step(self, actions: NDArray[Any], active: NDArray[np.bool_] | None = None) -> NDArray[np.float64]:
        """Takes actions `[count, elements]`, clipped to `fastest`. Returns rewards `[count]`, 0 for inactive ones."""
        change = np.clip(np.asarray(actions, dtype=np.float64), -self.fastest, self.fastest)
        self.simulations.step(self.simulations.setpoint + change, active)
        rewards = np.zeros(len(self.taken)) if self.task is None else self.task.reward(self.state(), self.goals)
        if active is None:
            self.taken += 1
            return rewards
        self.taken += active
        return np.where(active, rewards, 0.0)

    @property
    def ended(self) -> NDArray[np.bool_]:
        """Whether each episode has had all its samples, `[count]`."""
        return np.asarray(self.taken >= self.samples)

    def state(self) -> State:
        """The simulations' state at their present samples, as tasks need it."""
        return State(
            setpoint_ranges=self.ranges,
            fingertip=self.simulations.fingertip,
            contact_force=self.simulations.sense("contact_force_mean").astype(np.float64),
            boxes=self.simulations.boxes,
        )

    def observe(self) -> dict[str, NDArray[Any]]:
        """The observations by modality and the task's `goal`, each `[count, …]`."""
        observed = {modality: self.simulations.sense(modality) for modality in self.modalities}
        return observed if self.task is None else {**observed, "goal": self.goals.astype(np.float32)}

    def bounds(self) -> dict[str, tuple[Any, Any, tuple[int, ...], type]]:
        """Lowest and highest value, shape and type of each modality of one simulation's observation, by name."""
        # The arm is up to 0.01 rad or m away from its setpoint, and joints bend beyond their limits by less than that.
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


def one_action(action: NDArray[Any], names: list[str]) -> NDArray[np.float64]:
    """Returns one action as a batch `[1, elements]`. Raises ValueError unless it has a finite number for each name."""
    values = np.asarray(action, dtype=np.float64)
    if values.shape != (len(names),) or not np.all(np.isfinite(values)):
        raise ValueError(f"action: {action!r} must be {len(names)} finite numbers: {', '.join(names)}")
    return values[None]
