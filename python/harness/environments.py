"""The simulation as environments for dm_env, which also fit the wrappers of dm_control.

    >>> from harness import environments
    >>> environment = environments.load("empty", "reach", seed=0, samples=10)
    >>> step = environment.reset()
    >>> while not step.last():
    ...     step = environment.step(environment.action_spec().maximum)
    >>> step.observation["contact_force"].shape
    (20,)

`load` creates an environment, as `dm_control.suite.load` does. The module needs the package dm-env: `pip install
'soft-harness[dm-env]'`.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

try:
    import dm_env
    from dm_env import specs
except ImportError as error:
    raise ImportError(f"harness.environments needs the package dm-env: pip install dm-env ({error})") from error

from .episodes import Episodes, checked_seed, one_action

__all__ = ["Environment", "load"]


def load(
    scenario: str | os.PathLike[str],
    task: str | None,
    *,
    seed: int | None = None,
    modalities: Iterable[str] | None = None,
    samples: int = 100,
    spec: str | os.PathLike[str] | None = None,
) -> Environment:
    """Creates an environment.

    Args:
        scenario: a built-in world, such as `empty` or `cluttered`, or the path of a world file.
        task: `reach`, `press` or `push`, see `harness.tasks`; or None, without a goal and with every reward 0.
        seed: the seed of a dataset, whose episodes the environment goes through from the first one. The default is
            random.
        modalities: names of the observed modalities, in addition to the task's `goal`. The default is all vectors, and
            no image.
        samples: number of actions in an episode. An action takes 0.1 s with the default settings.
        spec: an experiment, whose simulation settings are used: the path of a YAML file, or the name of a built-in
            experiment. The default is the world's own settings.

    Returns:
        The environment, before its first reset.

    Raises:
        ValueError: there is no such world or task, the world does not have the task, or a number is out of range.
        KeyError: the world does not have one of the modalities.
        FileNotFoundError: there is no such experiment.

    Example:
        >>> from harness import environments
        >>> environment = environments.load("cluttered", "push", seed=0, modalities=["arm", "vision"])
        >>> sorted(environment.reset().observation)
        ['arm', 'goal', 'vision']
    """
    return Environment(Episodes(scenario, task, modalities=modalities, samples=samples, spec=spec), seed)


class Environment(dm_env.Environment):
    """One simulation and its task. `load` creates it, and `harness.episodes.Episodes` explains actions and episodes.

    An episode ends with a truncation, whose discount is 1.
    """

    def __init__(self, episodes: Episodes, seed: int | None = None) -> None:
        self._episodes = episodes
        self._seed = checked_seed(seed)
        self._over = True

    def __repr__(self) -> str:
        return f"<harness.environments.Environment of {self._episodes!r}>"

    def reset(self) -> dm_env.TimeStep:
        """Starts the next episode, and returns its first observation."""
        self._episodes.reset(0, self._seed)
        self._seed, self._over = None, False
        return dm_env.restart(self._observation())

    def step(self, action: ArrayLike) -> dm_env.TimeStep:
        """Takes an action. The first step after an episode's end ignores the action and starts the next episode.

        Args:
            action: `[elements]`, the change of the setpoint, clipped to the bounds of `action_spec`.

        Raises:
            ValueError: the action has the wrong shape, or is not finite.
        """
        if self._over:
            return self.reset()
        reward = float(self._episodes.step(one_action(action, self._episodes.names))[0])
        self._over = bool(self._episodes.ended[0])
        if self._over:
            return dm_env.truncation(reward, self._observation())
        return dm_env.transition(reward, self._observation())

    def action_spec(self) -> specs.BoundedArray:
        """Returns the shape and the bounds of an action, in rad or m."""
        fastest = self._episodes.fastest
        return specs.BoundedArray(fastest.shape, np.float64, -fastest, fastest, name="increment")

    def observation_spec(self) -> Mapping[str, specs.BoundedArray]:
        """Returns the shape, the type and the bounds of each modality of an observation, by name."""
        bounds = self._episodes.bounds().items()
        return {name: specs.BoundedArray(shape, kind, low, high, name) for name, (low, high, shape, kind) in bounds}

    def reward_spec(self) -> specs.BoundedArray:
        """Returns the bounds of a reward, 0 and 1."""
        return specs.BoundedArray((), np.float64, 0.0, 1.0, name="reward")

    def picture(self, width: int = 480, height: int = 480) -> NDArray[np.uint8]:
        """Renders a picture of the scene, `[height, width, 3]`, uint8, each side 1 to 4096 pixels."""
        return self._episodes.simulations.render(0, width, height)

    def _observation(self) -> dict[str, NDArray[Any]]:
        return {name: values[0] for name, values in self._episodes.observe().items()}
