"""The finger as a `dm_env.Environment`, loaded as in dm_control::

    environment = harness.environments.load("cluttered", "push", seed=0)
    step = environment.reset()
    while not step.last():
        step = environment.step(policy(step.observation))

`load` describes the arguments.
"""

import os
from collections.abc import Mapping
from typing import Any

import dm_env
import numpy as np
from dm_env import specs
from numpy.typing import NDArray

from .episodes import Episodes, one_action


def load(
    scenario: str,
    task: str | None,
    *,
    seed: int | None = None,
    modalities: tuple[str, ...] | None = None,
    samples: int = 100,
    spec: str | os.PathLike[str] | None = None,
) -> "Environment":
    """Creates an environment.

    Args:
        scenario: a built-in world, or the path of a world file.
        task: one of the finger's tasks in `harness.tasks.TASKS`. Without one, there is no goal and every reward is 0.
        seed: the seed of a dataset, whose episodes the environment goes through from the first; random by default.
        modalities: the observed modalities besides the task's `goal`; all vectors by default.
        samples: actions per episode, 0.1 s each with the default settings.
        spec: an experiment's YAML file, whose simulation settings are used.

    Raises:
        ValueError: an argument is wrong.
        KeyError: the world does not have one of the modalities.
    """
    return Environment(Episodes(scenario, task, modalities=modalities, samples=samples, spec=spec), seed)


class Environment(dm_env.Environment):
    """One finger and its task. `harness.episodes.Episodes` explains actions and episodes."""

    def __init__(self, episodes: Episodes, seed: int | None = None) -> None:
        self._episodes = episodes
        self._seed = seed
        self._over = True

    def reset(self) -> dm_env.TimeStep:
        self._episodes.reset(0, self._seed)
        self._seed, self._over = None, False
        return dm_env.restart(self._observation())

    def step(self, action: NDArray[Any]) -> dm_env.TimeStep:
        """Takes an action. The first step after an episode's end ignores the action and begins the next episode."""
        if self._over:
            return self.reset()
        reward = float(self._episodes.step(one_action(action, self._episodes.names))[0])
        self._over = bool(self._episodes.ended[0])
        if self._over:
            return dm_env.truncation(reward, self._observation())
        return dm_env.transition(reward, self._observation())

    def action_spec(self) -> specs.BoundedArray:
        fastest = self._episodes.fastest
        return specs.BoundedArray(fastest.shape, np.float64, -fastest, fastest, name="increment")

    def observation_spec(self) -> Mapping[str, specs.BoundedArray]:
        bounds = self._episodes.bounds().items()
        return {name: specs.BoundedArray(shape, kind, low, high, name) for name, (low, high, shape, kind) in bounds}

    def reward_spec(self) -> specs.BoundedArray:
        return specs.BoundedArray((), np.float64, 0.0, 1.0, name="reward")

    def picture(self, width: int = 480, height: int = 480) -> NDArray[np.uint8]:
        """Renders the scene, `[height, width, 3]`."""
        return self._episodes.simulations.render(0, width, height)

    def _observation(self) -> dict[str, NDArray[Any]]:
        return {name: values[0] for name, values in self._episodes.observe().items()}
