"""Tasks whose rewards depend on contact, for any number of simulations at once.

A task draws a goal for each episode. At each sample it computes a reward from 0 to 1 from the simulation's sensors.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class State:
    """The state of `count` simulations at a sample, from which tasks compute rewards."""

    setpoint_ranges: Array
    """Lowest and highest rotation (rad), lift and extension (m), `[3, 2]`."""
    fingertip: Array
    """Position of the finger's end, m, `[count, 3]`."""
    contact_force: Array
    """Normal force on each link, averaged over the time since the previous sample, N, `[count, 20]`."""
    boxes: Array
    """Position (m) and orientation (quaternion) of the boxes, `[count, boxes, 7]`."""


class Task(ABC):
    """A goal for the finger and a reward for reaching it."""

    name: ClassVar[str]
    """The name by which environments select the task."""
    scenarios: ClassVar[tuple[str, ...]]
    """Names of the scenarios in which the task is possible."""
    goal_low: ClassVar[tuple[float, ...]]
    """Lowest value of each element of the goal, which observations contain as `goal`."""
    goal_high: ClassVar[tuple[float, ...]]
    """Highest value of each element of the goal."""

    @abstractmethod
    def draw(self, random: np.random.Generator, start: State, index: int) -> Array:
        """Draws a goal for the simulation `index`, which is at the start of an episode."""

    @abstractmethod
    def reward(self, state: State, goal: Array) -> Array:
        """Returns rewards `[count]` in [0, 1], for goals `[count, …]`."""


class Reach(Task):
    """Touch a point on the ground with the fingertip.

    The reward decreases with the distance, and is twice as large while the last link is in contact. The goal is the
    point's x and y, m. It lies in the sector that the arm sweeps, away from the boxes.
    """

    name = "reach"
    scenarios = ("empty", "cluttered")
    goal_low, goal_high = (-4.0, -4.0), (4.0, 4.0)
    scale_m = 0.5
    """Distance at which the reward has decreased to 1/e."""
    clearance_m = 0.3
    """Smallest distance from a box's center. Half the box's diagonal is 0.17 m, and the finger's radius is 0.045 m."""

    def draw(self, random: np.random.Generator, start: State, index: int) -> Array:
        while True:
            place = place_in_sector(random, start, index)
            if np.all(distance(start.boxes[index, :, :2], place) > self.clearance_m):
                return place

    def reward(self, state: State, goal: Array) -> Array:
        nearness = np.exp(-distance(state.fingertip[:, :2], goal) / self.scale_m)
        return np.asarray(np.where(state.contact_force[:, -1] > 0, 1.0, 0.5) * nearness)


class Press(Task):
    """Press with a given force, summed over the finger.

    The reward is 1 at that force, and 0 without contact or at twice the force. The goal is the force, N.
    """

    name = "press"
    scenarios = ("empty", "cluttered")
    goal_low, goal_high = (5.0,), (40.0,)

    def draw(self, random: np.random.Generator, start: State, index: int) -> Array:
        return np.asarray(random.uniform(self.goal_low, self.goal_high))

    def reward(self, state: State, goal: Array) -> Array:
        wanted = goal[:, 0]
        off = np.abs(state.contact_force.sum(axis=1) - wanted) / wanted
        return np.asarray(np.maximum(0.0, 1.0 - off))


class Push(Task):
    """Push the first box to a place on the ground.

    The reward is the fraction by which the distance to the place has decreased. The goal contains the box's start and
    the place, x and y of each, m. The box's present position is not observed directly.
    """

    name = "push"
    scenarios = ("cluttered",)
    goal_low, goal_high = (-4.0,) * 4, (4.0,) * 4
    way_m = (0.2, 0.5)
    """Smallest and largest distance from the box's start to the place."""

    def draw(self, random: np.random.Generator, start: State, index: int) -> Array:
        box = start.boxes[index, 0, :2]
        while True:
            place = place_in_sector(random, start, index)
            if self.way_m[0] <= distance(place, box) <= self.way_m[1]:
                return np.concatenate([box, place])

    def reward(self, state: State, goal: Array) -> Array:
        start, place = goal[:, :2], goal[:, 2:]
        left = distance(state.boxes[:, 0, :2], place) / distance(start, place)
        return np.clip(1.0 - left, 0.0, 1.0)


TASKS: dict[str, type[Task]] = {task.name: task for task in (Reach, Press, Push)}


def task_named(name: str, scenario: str) -> Task:
    """Returns the task of that name. Raises ValueError if there is none, or if it is not possible in the scenario."""
    if name not in TASKS:
        raise ValueError(f"task: there is no '{name}'; allowed: {', '.join(TASKS)}")
    task = TASKS[name]()
    if scenario not in task.scenarios:
        raise ValueError(f"task: '{name}' needs one of the scenarios {', '.join(task.scenarios)}, not '{scenario}'")
    return task


def distance(a: Array, b: Array) -> Array:
    """Returns the distance between points, whose coordinates are along the last axis."""
    return np.asarray(np.linalg.norm(a - b, axis=-1))


def place_in_sector(random: np.random.Generator, start: State, index: int) -> Array:
    """Draws a point of the ground in the sector that the arm sweeps, uniformly over its area.

    `start` is the state at rest: the rotation is in the middle of its range, and the extension is at its lowest.
    """
    x, y = start.fingertip[index, :2]
    rotation, _, extension = start.setpoint_ranges
    radius = np.hypot(x, y)
    bearing = np.arctan2(y, x) + random.uniform(*(rotation - rotation.mean()))
    radius = np.sqrt(random.uniform(radius**2, (radius + extension[1] - extension[0]) ** 2))
    return np.asarray(radius * np.array([np.cos(bearing), np.sin(bearing)]))
