"""Tasks with a reward that needs touch, each for any number of simulations side by side.

A task draws an episode's goal, and rewards what the simulation's own sensors say, from 0 to 1 a sample.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class State:
    """What tasks look at, of `count` simulations at a sample."""

    setpoint_ranges: Array
    """Lowest and highest rotation (rad), lift and extension (m), `[3, 2]`."""
    fingertip: Array
    """The finger's end in the world, m, `[count, 3]`."""
    contact_force: Array
    """Normal force on each link, averaged over the sample before, N, `[count, 20]`."""
    boxes: Array
    """Position (m) and orientation (quaternion) of the boxes in the world, `[count, boxes, 7]`."""


class Task(ABC):
    """What the finger is to do."""

    name: ClassVar[str]
    scenarios: ClassVar[tuple[str, ...]]
    goal_low: ClassVar[tuple[float, ...]]
    """Lowest value of each number of the goal, which observations hold as `goal`."""
    goal_high: ClassVar[tuple[float, ...]]

    @abstractmethod
    def draw(self, random: np.random.Generator, start: State, index: int) -> Array:
        """The goal of the simulation `index`, which is at the start of an episode."""

    @abstractmethod
    def reward(self, state: State, goal: Array) -> Array:
        """Rewards `[count]` in [0, 1], for goals `[count, …]`."""


class Reach(Task):
    """Touch a point on the ground with the fingertip: nearness, and twice as much while the last link is touched.

    The goal is the point's x and y, m: anywhere under the swept sector, clear of the boxes.
    """

    name = "reach"
    scenarios = ("empty", "cluttered")
    goal_low, goal_high = (-4.0, -4.0), (4.0, 4.0)
    scale_m = 0.5
    """Distance at which nearness is 1/e."""
    clearance_m = 0.3
    """From a box's middle; half its diagonal is 0.17 m, and the finger's radius 0.045 m."""

    def draw(self, random: np.random.Generator, start: State, index: int) -> Array:
        while True:
            place = place_in_sector(random, start, index)
            if np.all(distance(start.boxes[index, :, :2], place) > self.clearance_m):
                return place

    def reward(self, state: State, goal: Array) -> Array:
        nearness = np.exp(-distance(state.fingertip[:, :2], goal) / self.scale_m)
        return np.asarray(np.where(state.contact_force[:, -1] > 0, 1.0, 0.5) * nearness)


class Press(Task):
    """Press with a wanted force, summed over the finger: 1 at that force, 0 without contact or at twice as much.

    The goal is the force, N.
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
    """Push the first box to a place on the ground: the part of the way that it has come nearer.

    The goal is where the box starts and where it is to go, x and y of each, m. Where it is meanwhile, touch and vision
    have to tell.
    """

    name = "push"
    scenarios = ("cluttered",)
    goal_low, goal_high = (-4.0,) * 4, (4.0,) * 4
    way_m = (0.2, 0.5)
    """Shortest and longest way."""

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
    """The task of that name. Raises ValueError where there is none, or it can't be done in the scenario."""
    if name not in TASKS:
        raise ValueError(f"task: there is no '{name}'; allowed: {', '.join(TASKS)}")
    task = TASKS[name]()
    if scenario not in task.scenarios:
        raise ValueError(f"task: '{name}' needs one of the scenarios {', '.join(task.scenarios)}, not '{scenario}'")
    return task


def distance(a: Array, b: Array) -> Array:
    """Between points in the plane, along the last axis."""
    return np.asarray(np.linalg.norm(a - b, axis=-1))


def place_in_sector(random: np.random.Generator, start: State, index: int) -> Array:
    """A point of the ground under the swept sector, each area as likely as any other of its size.

    At the start the finger hangs in the middle of the rotation's range, with the extension at its lowest.
    """
    x, y = start.fingertip[index, :2]
    rotation, _, extension = start.setpoint_ranges
    radius = np.hypot(x, y)
    bearing = np.arctan2(y, x) + random.uniform(*(rotation - rotation.mean()))
    radius = np.sqrt(random.uniform(radius**2, (radius + extension[1] - extension[0]) ** 2))
    return np.asarray(radius * np.array([np.cos(bearing), np.sin(bearing)]))
