"""The tasks of environments: `Reach`, `Press` and `Push`.

    >>> from harness.tasks import TASKS
    >>> sorted(TASKS)                        # the names by which environments select them
    ['press', 'push', 'reach']
    >>> TASKS["push"].scenarios
    ('cluttered',)

A task draws a goal for each episode. After each action it computes a reward in [0, 1] from the simulation's sensors. It
computes the rewards of many simulations at once.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

__all__ = ["TASKS", "Press", "Push", "Reach", "State", "Task"]


@dataclass(frozen=True)
class State:
    """The state of `count` simulations at their present samples, from which tasks compute rewards.

    Attributes:
        setpoint_ranges: lowest and highest value of rotation (rad), lift and extension (m), `[3, 2]`.
        fingertip: position of the finger's end, `[count, 3]`, m.
        contact_force: normal force on each link, averaged over the time since the previous sample, `[count, 20]`, N.
        boxes: position (m) and orientation (unit quaternion w, x, y, z) of the boxes, `[count, boxes, 7]`.
    """

    setpoint_ranges: NDArray[np.float64]
    fingertip: NDArray[np.float64]
    contact_force: NDArray[np.float64]
    boxes: NDArray[np.float64]


class Task(ABC):
    """A goal, and a reward for reaching it. The base class of all tasks.

    Attributes:
        name: the name by which environments select the task.
        scenarios: names of the scenarios in which the task is possible.
        goal_low: lowest value of each element of the goal, which observations contain as `goal`.
        goal_high: highest value of each element of the goal.
    """

    name: ClassVar[str]
    scenarios: ClassVar[tuple[str, ...]]
    goal_low: ClassVar[tuple[float, ...]]
    goal_high: ClassVar[tuple[float, ...]]

    @abstractmethod
    def draw(self, random: np.random.Generator, start: State, index: int) -> NDArray[np.float64]:
        """Draws the goal of an episode.

        Args:
            random: the generator, whose seed is that of the episode.
            start: the state of all simulations.
            index: the simulation whose goal is drawn. It is at the start of an episode.

        Returns:
            The goal, with as many elements as `goal_low`.
        """

    @abstractmethod
    def reward(self, state: State, goal: NDArray[np.float64]) -> NDArray[np.float64]:
        """Computes the rewards of all simulations.

        Args:
            state: the state of all simulations.
            goal: their goals, `[count, elements]`.

        Returns:
            The rewards, `[count]`, in [0, 1].
        """


class Reach(Task):
    """The task `reach`: touch a point on the ground with the fingertip.

    The goal is the x and y coordinate of the point, m. It lies in the sector that the arm sweeps, away from the boxes.
    The reward is exp(-distance / 0.5 m) while the last link is in contact, and half of that otherwise.

    Attributes:
        scale_m: distance at which the reward has decreased to 1/e.
        clearance_m: smallest distance of the goal from a box's center.
    """

    name = "reach"
    scenarios = ("empty", "cluttered")
    goal_low, goal_high = (-4.0, -4.0), (4.0, 4.0)
    scale_m = 0.5
    # Half the box's diagonal is 0.17 m, and the finger's radius is 0.045 m.
    clearance_m = 0.3

    def draw(self, random: np.random.Generator, start: State, index: int) -> NDArray[np.float64]:
        while True:
            place = place_in_sector(random, start, index)
            if np.all(distance(start.boxes[index, :, :2], place) > self.clearance_m):
                return place

    def reward(self, state: State, goal: NDArray[np.float64]) -> NDArray[np.float64]:
        nearness = np.exp(-distance(state.fingertip[:, :2], goal) / self.scale_m)
        return np.asarray(np.where(state.contact_force[:, -1] > 0, 1.0, 0.5) * nearness)


class Press(Task):
    """The task `press`: press with a given force, summed over the finger.

    The goal is the force, 5 to 40 N. The reward is 1 at that force, falls linearly on both sides, and is 0 without
    contact and from twice the force on.
    """

    name = "press"
    scenarios = ("empty", "cluttered")
    goal_low, goal_high = (5.0,), (40.0,)

    def draw(self, random: np.random.Generator, start: State, index: int) -> NDArray[np.float64]:
        return np.asarray(random.uniform(self.goal_low, self.goal_high))

    def reward(self, state: State, goal: NDArray[np.float64]) -> NDArray[np.float64]:
        wanted = goal[:, 0]
        off = np.abs(state.contact_force.sum(axis=1) - wanted) / wanted
        return np.asarray(np.maximum(0.0, 1.0 - off))


class Push(Task):
    """The task `push`: push the first box to a place on the ground.

    The goal is the x and y coordinate of the box at the start, and those of the place, m. The reward is the fraction by
    which the distance to the place has decreased. The present position of the box is not observed directly.

    Attributes:
        way_m: smallest and largest distance from the box's start to the place.
    """

    name = "push"
    scenarios = ("cluttered",)
    goal_low, goal_high = (-4.0,) * 4, (4.0,) * 4
    way_m = (0.2, 0.5)

    def draw(self, random: np.random.Generator, start: State, index: int) -> NDArray[np.float64]:
        box = start.boxes[index, 0, :2]
        while True:
            place = place_in_sector(random, start, index)
            if self.way_m[0] <= distance(place, box) <= self.way_m[1]:
                return np.concatenate([box, place])

    def reward(self, state: State, goal: NDArray[np.float64]) -> NDArray[np.float64]:
        start, place = goal[:, :2], goal[:, 2:]
        left = distance(state.boxes[:, 0, :2], place) / distance(start, place)
        return np.clip(1.0 - left, 0.0, 1.0)


TASKS: dict[str, type[Task]] = {task.name: task for task in (Reach, Press, Push)}
"""The tasks by name."""


def task_named(name: str, scenario: str) -> Task:
    """Returns the task of that name. Raises ValueError if there is none, or if it is not possible in the scenario."""
    if name not in TASKS:
        raise ValueError(f"task: there is no '{name}'; allowed: {', '.join(TASKS)}")
    task = TASKS[name]()
    if scenario not in task.scenarios:
        raise ValueError(f"task: '{name}' needs one of the scenarios {', '.join(task.scenarios)}, not '{scenario}'")
    return task


def distance(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the distance between points, whose coordinates are along the last axis."""
    return np.asarray(np.linalg.norm(a - b, axis=-1))


def place_in_sector(random: np.random.Generator, start: State, index: int) -> NDArray[np.float64]:
    """Draws a point of the ground in the sector that the arm sweeps, uniformly over its area.

    `start` is the state at rest: the rotation is in the middle of its range, and the extension is at its lowest.
    """
    x, y = start.fingertip[index, :2]
    rotation, _, extension = start.setpoint_ranges
    radius = np.hypot(x, y)
    bearing = np.arctan2(y, x) + random.uniform(*(rotation - rotation.mean()))
    radius = np.sqrt(random.uniform(radius**2, (radius + extension[1] - extension[0]) ** 2))
    return np.asarray(radius * np.array([np.cos(bearing), np.sin(bearing)]))
