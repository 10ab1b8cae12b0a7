"""The simulation as environments for Gymnasium. Importing this module registers them.

    >>> import gymnasium
    >>> import harness.gymnasium
    >>> environment = gymnasium.make("SoftFinger-Cluttered-v0", task="push")
    >>> observation, info = environment.reset(seed=0)
    >>> observation["contact_force"].shape, info
    ((20,), {'seed': 0, 'episode': 0})
    >>> several = gymnasium.make_vec("SoftFinger-Empty-Press-v0", num_envs=8)      # stepped in parallel
    >>> several.reset(seed=0)[0]["contact_force"].shape
    (8, 20)

These names are registered:

- `SoftFinger-Empty-v0` and `SoftFinger-Cluttered-v0` take the task as an argument, `reach` by default.
- Other names contain the task: `SoftFinger-Empty-Reach-v0`, `SoftFinger-Empty-Press-v0`,
  `SoftFinger-Cluttered-Reach-v0`, `SoftFinger-Cluttered-Press-v0` and `SoftFinger-Cluttered-Push-v0`.
- `HarnessWorld-v0` is an environment of any world, which `scenario` names. It has no task, and every reward is 0.

`gymnasium.make` creates a `SoftFinger`, and `gymnasium.make_vec` a `SoftFingerVector`. They take the other arguments of
these classes. With the name `harness.gymnasium:NAME`, they also import this module. The module needs the package
gymnasium: `pip install 'soft-harness[gymnasium]'`.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

try:
    import gymnasium
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise ImportError(f"harness.gymnasium needs the package gymnasium: pip install gymnasium ({error})") from error

from ._arguments import integer
from .episodes import Episodes, checked_seed, one_action
from .tasks import TASKS

__all__ = ["SoftFinger", "SoftFingerVector"]

RENDER_FPS = 10
"""Samples per second."""

MAX_SIDE = 4096
"""Largest side of a rendered picture in pixels."""


class SoftFinger(gymnasium.Env[Any, Any]):
    """One simulation and its task. `harness.episodes.Episodes` explains actions and episodes.

    Observations are dictionaries by modality, with the task's `goal`. An episode is truncated after `samples` actions,
    and never terminated.

    Args:
        scenario: a built-in world, such as `empty` or `cluttered`, or the path of a world file.
        task: `reach`, `press` or `push`, see `harness.tasks`; or None, without a goal and with every reward 0.
        modalities: names of the observed modalities. The default is all vectors, and no image.
        samples: number of actions in an episode. An action takes 0.1 s with the default settings.
        spec: an experiment, whose simulation settings are used: the path of a YAML file, or the name of a built-in
            experiment. The default is the world's own settings.
        render_mode: `rgb_array`, or None if nothing is rendered.
        width: number of columns of a rendered picture, 1 to 4096 pixels.
        height: number of rows of a rendered picture, 1 to 4096 pixels.

    Raises:
        ValueError: there is no such world or task, the world does not have the task, or a number is out of range.
        KeyError: the world does not have one of the modalities.
        FileNotFoundError: there is no such experiment.

    Attributes:
        episodes: the simulation and its task, a `harness.episodes.Episodes`. An environment of `gymnasium.make` has it
            as `environment.unwrapped.episodes`.

    Example:
        >>> import gymnasium
        >>> import harness.gymnasium
        >>> size = {"width": 64, "height": 48}
        >>> environment = gymnasium.make("SoftFinger-Empty-v0", task="press", render_mode="rgb_array", **size)
        >>> observation, info = environment.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = environment.step([0.0, -0.02, 0.0])
        >>> reward, environment.render().shape
        (0.0, (48, 64, 3))
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": RENDER_FPS}

    def __init__(
        self,
        scenario: str | os.PathLike[str],
        task: str | None = "reach",
        *,
        modalities: Iterable[str] | None = None,
        samples: int = 100,
        spec: str | os.PathLike[str] | None = None,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
    ) -> None:
        check_rendering(render_mode, width, height)
        self.episodes = Episodes(scenario, task, modalities=modalities, samples=samples, spec=spec)
        self.render_mode = render_mode
        self._size = (width, height)
        self.observation_space, self.action_space = spaces(self.episodes)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Starts an episode.

        Args:
            seed: the seed of a dataset, whose first episode starts, 0 to 2^53 - 1. Without a seed, the next episode of
                the same dataset starts. At the first reset there is none yet, so a seed is drawn and its first episode
                starts.
            options: not used.

        Returns:
            The first observation, and a dictionary with the `seed` and the index of the `episode`.

        Raises:
            ValueError: the seed is out of range.
            TypeError: the seed is not an integer.
        """
        seed = checked_seed(seed)
        super().reset(seed=seed)
        self.episodes.reset(0, seed)
        return self._observation(), {"seed": self.episodes.seeds[0], "episode": int(self.episodes.indices[0])}

    def step(self, action: ArrayLike) -> tuple[dict[str, NDArray[Any]], float, bool, bool, dict[str, Any]]:
        """Takes an action.

        Args:
            action: `[elements]`, the change of the setpoint, in rad or m, clipped to the bounds of `action_space`.

        Returns:
            The next observation, the reward in [0, 1], False, whether the episode has ended, and an empty dictionary.

        Raises:
            ValueError: the action has the wrong shape, or is not finite.
            RuntimeError: the environment was not reset.
        """
        reward = float(self.episodes.step(one_action(action, self.episodes.names))[0])
        return self._observation(), reward, False, bool(self.episodes.ended[0]), {}

    def render(self) -> NDArray[np.uint8] | None:
        """Returns a picture `[height, width, 3]` of the scene, or None without a render mode."""
        if self.render_mode is None:
            return None
        return self.episodes.simulations.render(0, *self._size)

    def _observation(self) -> dict[str, NDArray[Any]]:
        return {name: values[0] for name, values in self.episodes.observe().items()}


class SoftFingerVector(VectorEnv[Any, Any, Any]):
    """Many simulations and their tasks, stepped in parallel. It gives the same values as many `SoftFinger`.

    Args:
        num_envs: number of simulations, 1 to 4096.
        max_episode_steps: a limit of the actions in an episode, in addition to `samples`. None and -1 mean no limit.
        autoreset_mode: when the next episode starts after one has ended. `NextStep` (default): in the next step, which
            ignores the action. `SameStep`: in the step that ends the first one. `Disabled`: only by
            `reset(options={"reset_mask": ended})`.

    The other arguments are those of `SoftFinger`.

    Raises:
        ValueError: there is no such world, task or mode, the world does not have the task, or a number is out of range.
        KeyError: the world does not have one of the modalities.
        FileNotFoundError: there is no such experiment.

    Attributes:
        episodes: the simulations and their tasks, a `harness.episodes.Episodes`.

    Example:
        >>> import gymnasium
        >>> import harness.gymnasium
        >>> several = gymnasium.make_vec("SoftFinger-Cluttered-Push-v0", num_envs=4, autoreset_mode="SameStep")
        >>> observations, info = several.reset(seed=7)
        >>> info["seed"]
        array([ 7,  8,  9, 10])
        >>> observations, rewards, terminated, truncated, info = several.step(several.action_space.sample())
        >>> rewards.shape
        (4,)
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": RENDER_FPS}

    def __init__(
        self,
        num_envs: int,
        scenario: str | os.PathLike[str],
        task: str | None = "reach",
        *,
        modalities: Iterable[str] | None = None,
        samples: int = 100,
        spec: str | os.PathLike[str] | None = None,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    ) -> None:
        check_rendering(render_mode, width, height)
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {**type(self).metadata, "autoreset_mode": self.autoreset_mode}
        if max_episode_steps is not None and max_episode_steps != -1:
            samples = min(samples, max_episode_steps)
        self.episodes = Episodes(scenario, task, num_envs, modalities=modalities, samples=samples, spec=spec)
        self.num_envs = num_envs
        self.render_mode = render_mode
        self._size = (width, height)
        self.single_observation_space, self.single_action_space = spaces(self.episodes)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Starts an episode in each simulation.

        Args:
            seed: a list of seeds, one for each simulation; or a single seed, with which simulation `i` gets `seed + i`.
                Without a seed, the next episode of each starts, as in `SoftFinger.reset`.
            options: `{"reset_mask": mask}` starts an episode only where `mask` is true, `[num_envs]`.

        Returns:
            The observations, and a dictionary with the `seed` and the index of the `episode` of each simulation.

        Raises:
            ValueError: the mask or the seeds have the wrong length, or a seed is out of range.
            TypeError: a seed is not an integer.
        """
        mask = np.asarray((options or {}).get("reset_mask", np.ones(self.num_envs, dtype=bool)))
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_:
            raise ValueError(f"reset_mask: {mask!r} must be {self.num_envs} booleans")
        if isinstance(seed, (int, np.integer)):
            super().reset(seed=checked_seed(seed))
            seed = [int(seed) + index for index in range(self.num_envs)]
        if seed is not None and not isinstance(seed, Iterable):
            raise TypeError(f"seed: {seed!r} must be an integer, or a list of them")
        seeds = [None] * self.num_envs if seed is None else [checked_seed(one) for one in seed]
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed: {len(seeds)} seeds for {self.num_envs} environments")
        for index in np.flatnonzero(mask):
            self.episodes.reset(int(index), seeds[index])
        info = {"seed": np.array(self.episodes.seeds), "episode": self.episodes.indices.copy()}
        return self.episodes.observe(), info

    def step(
        self, actions: ArrayLike
    ) -> tuple[dict[str, NDArray[Any]], NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Takes an action in each simulation. `autoreset_mode` says when the next episode starts after one has ended.

        Args:
            actions: `[num_envs, elements]`, the changes of the setpoints, clipped to the bounds of `action_space`.

        Returns:
            The next observations, the rewards in [0, 1], an array of False, whether each episode has ended, and a
            dictionary. With `SameStep`, the dictionary has the last observations of the episodes that have ended,
            `final_obs`, and the `seed` and the index of the next `episode`. Otherwise it is empty.

        Raises:
            ValueError: the actions have the wrong shape, or are not finite; or an episode has ended and there is no
                automatic reset.
            RuntimeError: a simulation was not reset.
        """
        over = self.episodes.ended
        if self.autoreset_mode == AutoresetMode.DISABLED and over.any():
            raise ValueError(f"episodes have ended in the environments {np.flatnonzero(over)}; reset these first")
        rewards = self.episodes.step(actions, ~over)
        ended, info = self.episodes.ended, {}
        if self.autoreset_mode == AutoresetMode.SAME_STEP:
            info = self._begin_anew(ended)
        else:
            for index in np.flatnonzero(over):
                self.episodes.reset(int(index))
            ended = self.episodes.ended
        return self.episodes.observe(), rewards, np.zeros(self.num_envs, dtype=bool), ended, info

    def _begin_anew(self, ended: NDArray[np.bool_]) -> dict[str, Any]:
        """Starts the next episode where one has ended. Returns the last observations, as Gymnasium does."""
        info: dict[str, Any] = {}
        last = self.episodes.observe() if ended.any() else {}
        for index in map(int, np.flatnonzero(ended)):
            final = {name: values[index] for name, values in last.items()}
            info = self._add_info(info, {"final_obs": final, "final_info": {}}, index)
            self.episodes.reset(index)
            begun = {"seed": self.episodes.seeds[index], "episode": int(self.episodes.indices[index])}
            info = self._add_info(info, begun, index)
        return info

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Returns a picture `[height, width, 3]` of each scene, or None without a render mode."""
        if self.render_mode is None:
            return None
        return tuple(self.episodes.simulations.render(index, *self._size) for index in range(self.num_envs))


def check_rendering(render_mode: str | None, width: int, height: int) -> None:
    """Raises ValueError for an unknown mode or a size out of range."""
    if render_mode not in (None, "rgb_array"):
        raise ValueError(f"render_mode: there is no {render_mode!r}; allowed: None, 'rgb_array'")
    for name, side in (("width", width), ("height", height)):
        if not 1 <= integer(name, side) <= MAX_SIDE:
            raise ValueError(f"{name}: {side} must be 1 to {MAX_SIDE} pixels")


def spaces(episodes: Episodes) -> tuple[gymnasium.spaces.Dict, gymnasium.spaces.Box]:
    """Returns the spaces of the observations and the actions of one simulation."""
    bounds = episodes.bounds().items()
    boxes: dict[str, gymnasium.Space[Any]] = {
        name: gymnasium.spaces.Box(np.full(shape, low, kind), np.full(shape, high, kind), dtype=kind)
        for name, (low, high, shape, kind) in bounds
    }
    fastest = episodes.fastest.astype(np.float32)
    return gymnasium.spaces.Dict(boxes), gymnasium.spaces.Box(-fastest, fastest, dtype=np.float32)


def register() -> None:
    """Registers the environments of every scenario and task, and one for any world."""
    gymnasium.register(
        "HarnessWorld-v0",
        entry_point="harness.gymnasium:SoftFinger",
        vector_entry_point="harness.gymnasium:SoftFingerVector",
        kwargs={"task": None},
    )
    for scenario in ("empty", "cluttered"):
        tasks = {f"-{name.title()}": {"task": name} for name, task in TASKS.items() if scenario in task.scenarios}
        for suffix, arguments in {"": {}, **tasks}.items():
            gymnasium.register(
                f"SoftFinger-{scenario.title()}{suffix}-v0",
                entry_point="harness.gymnasium:SoftFinger",
                vector_entry_point="harness.gymnasium:SoftFingerVector",
                kwargs={"scenario": scenario, **arguments},
            )


register()
