"""The finger as Gymnasium environments. Importing this module registers them::

    import gymnasium
    import harness.gymnasium

    environment = gymnasium.make("SoftFinger-Cluttered-v0", task="push")
    several = gymnasium.make_vec("SoftFinger-Cluttered-Push-v0", num_envs=8)

`gymnasium.make("HarnessWorld-v0", scenario="robots/gripper.yaml")` makes an environment of any world. It has no task,
and every reward is 0.

`gymnasium.make("harness.gymnasium:SoftFinger-Cluttered-v0")` imports this module and makes the environment.
`SoftFinger-Empty-v0` and `SoftFinger-Cluttered-v0` take the task as an argument (default `reach`). Other names contain
the task, such as `SoftFinger-Empty-Press-v0`. Vector environments are stepped in parallel, in Rust.
"""

import os
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from .episodes import Episodes, one_action
from .tasks import TASKS

Observation = dict[str, NDArray[Any]]

RENDER_FPS = 10
"""Samples per second."""


class SoftFinger(gymnasium.Env[Any, Any]):
    """One finger and its task. `harness.episodes.Episodes` explains actions and episodes.

    An episode is truncated after `samples` actions, and never terminated. With `render_mode="rgb_array"`, `render`
    returns pictures of `width` times `height` pixels.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": RENDER_FPS}

    def __init__(
        self,
        scenario: str,
        task: str | None = "reach",
        *,
        modalities: tuple[str, ...] | None = None,
        samples: int = 100,
        spec: str | os.PathLike[str] | None = None,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
    ) -> None:
        check_render_mode(render_mode)
        self.episodes = Episodes(scenario, task, modalities=modalities, samples=samples, spec=spec)
        self.render_mode = render_mode
        self.size = (width, height)
        self.observation_space, self.action_space = spaces(self.episodes)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begins the first episode of the dataset with this seed or, without a seed, the dataset's next episode.

        `info` contains the seed and the episode's index.
        """
        super().reset(seed=seed)
        self.episodes.reset(0, seed)
        return self._observation(), {"seed": self.episodes.seeds[0], "episode": int(self.episodes.indices[0])}

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        reward = float(self.episodes.step(one_action(action, self.episodes.names))[0])
        return self._observation(), reward, False, bool(self.episodes.ended[0]), {}

    def render(self) -> NDArray[np.uint8] | None:
        if self.render_mode is None:
            return None
        return self.episodes.simulations.render(0, *self.size)

    def _observation(self) -> Observation:
        return {name: values[0] for name, values in self.episodes.observe().items()}


class SoftFingerVector(VectorEnv[Any, Any, Any]):
    """`num_envs` fingers, stepped in parallel.

    autoreset_mode: when an episode that has ended begins anew, as in Gymnasium's own vector environments. `NextStep`:
    in the next step, which ignores the action. `SameStep`: in the step that ends it, with the last observation in
    `info["final_obs"]`. `Disabled`: by `reset(options={"reset_mask": ended})`.

    An episode is truncated after `samples` actions, or after `max_episode_steps` if that is fewer, as Gymnasium's
    `TimeLimit` does it for a single environment. -1 sets no such limit.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": RENDER_FPS}

    def __init__(
        self,
        num_envs: int,
        scenario: str,
        task: str | None = "reach",
        *,
        modalities: tuple[str, ...] | None = None,
        samples: int = 100,
        spec: str | os.PathLike[str] | None = None,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    ) -> None:
        check_render_mode(render_mode)
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {**type(self).metadata, "autoreset_mode": self.autoreset_mode}
        if max_episode_steps is not None and max_episode_steps != -1:
            samples = min(samples, max_episode_steps)
        self.episodes = Episodes(scenario, task, num_envs, modalities=modalities, samples=samples, spec=spec)
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.size = (width, height)
        self.single_observation_space, self.single_action_space = spaces(self.episodes)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begins an episode in each environment. With a single seed, environment `i` gets `seed + i`.

        options: `{"reset_mask": mask}` begins an episode only where `mask` `[num_envs]` is true.
        """
        mask = np.asarray((options or {}).get("reset_mask", np.ones(self.num_envs, dtype=bool)))
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_:
            raise ValueError(f"reset_mask: {mask!r} must be {self.num_envs} booleans")
        if isinstance(seed, (int, np.integer)):
            super().reset(seed=int(seed))
            seed = [int(seed) + index for index in range(self.num_envs)]
        seeds = [None] * self.num_envs if seed is None else seed
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed: {len(seeds)} seeds for {self.num_envs} environments")
        for index in np.flatnonzero(mask):
            self.episodes.reset(int(index), seeds[index])
        info = {"seed": np.array(self.episodes.seeds), "episode": self.episodes.indices.copy()}
        return self.episodes.observe(), info

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[Observation, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
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
        """Begins the next episode where one has ended. Returns the last observations, as Gymnasium's own environments."""
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
        if self.render_mode is None:
            return None
        return tuple(self.episodes.simulations.render(index, *self.size) for index in range(self.num_envs))


def check_render_mode(render_mode: str | None) -> None:
    if render_mode not in (None, "rgb_array"):
        raise ValueError(f"render_mode: there is no {render_mode!r}; allowed: None, 'rgb_array'")


def spaces(episodes: Episodes) -> tuple[gymnasium.spaces.Dict, gymnasium.spaces.Box]:
    """The spaces of one environment's observations and actions."""
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
