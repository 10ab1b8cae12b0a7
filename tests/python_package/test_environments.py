"""Live simulations and environments: the projects' own checkers, and a dataset's samples."""

import os
import subprocess
import sys
import threading
import warnings
from pathlib import Path
from typing import Any

import dm_env
import gymnasium
import mujoco
import numpy as np
import pytest
from absl.testing import absltest
from conftest import ROOT, SMOKE
from dm_control.suite.wrappers import action_scale
from dm_env import test_utils
from gymnasium.utils.env_checker import check_env

import harness
import harness.gymnasium
from harness import environments
from harness.tasks import Press, Push, Reach, State

PAIRS = [("empty", "reach"), ("empty", "press"), ("cluttered", "reach"), ("cluttered", "press"), ("cluttered", "push")]


@pytest.mark.parametrize(("module", "missing"), [("environments", "dm_env"), ("gymnasium", "gymnasium")])
def test_a_missing_package_is_named_with_the_command_that_installs_it(module: str, missing: str) -> None:
    program = f"import sys; sys.modules['{missing}'] = None; import harness.{module}"
    answer = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    package = missing.replace("_", "-")
    expected = f"ImportError: harness.{module} needs the package {package}: pip install {package} ("
    assert answer.stderr.splitlines()[-1].startswith(expected), answer.stderr


def test_images_are_observed_if_they_are_named() -> None:
    images = {"vision"}
    assert not images & set(gymnasium.make("SoftFinger-Empty-v0").observation_space)
    seeing = gymnasium.make("SoftFinger-Empty-v0", modalities=["arm", "vision"])
    assert set(seeing.observation_space) == {"arm", "vision", "goal"}


@pytest.mark.parametrize("scenario", ["empty", "cluttered"])
def test_the_same_seed_gives_a_datasets_samples(folders: dict[str, Path], scenario: str) -> None:
    data = harness.Dataset(folders[scenario])
    # With other settings the same seed would lead elsewhere.
    simulation = data.simulation(2)
    for index in range(2):
        simulation.reset(index, data.seed, index + 1)
    for sample in range(30):
        for name in ("proprioception", "arm", "contact_force", "contact_force_mean", "vision"):
            sensed = simulation.sense(name)
            for index in range(2):
                assert np.array_equal(sensed[index], data.episode(index + 1)[name][sample]), (name, sample)
        simulation.follow()


def test_boxes_stand_as_in_the_datasets_episode() -> None:
    environment = gymnasium.make("SoftFinger-Cluttered-Push-v0", spec=SMOKE).unwrapped
    environment.reset(seed=3)
    _, info = environment.reset()
    assert info == {"seed": 3, "episode": 1}
    simulation = harness.SimulationBatch("cluttered", 1, SMOKE)
    simulation.reset(0, 3, 1)
    assert np.array_equal(environment.episodes.simulations.boxes, simulation.boxes)


def class_for(pair: tuple[str, str]) -> type:
    class Checked(test_utils.EnvironmentTestMixin, absltest.TestCase):
        """dm_env's own checks."""

        def make_object_under_test(self) -> dm_env.Environment:
            return environments.load(*pair, samples=5, seed=0)

        def make_action_sequence(self) -> Any:
            spec = self.environment.action_spec()
            random = np.random.default_rng(0)
            for _ in range(20):
                yield random.uniform(spec.minimum, spec.maximum)

    return Checked


for _pair in PAIRS:
    globals()[f"TestDmEnv{_pair[0].title()}{_pair[1].title()}"] = class_for(_pair)


@pytest.mark.parametrize(
    "name", [f"SoftFinger-{scenario.title()}-{task.title()}-v0" for scenario, task in PAIRS]
    + ["SoftFinger-Empty-v0", "SoftFinger-Cluttered-v0"],
)
def test_gymnasiums_checker_finds_nothing(name: str) -> None:
    modalities = ("proprioception", "arm", "contact_force", "contact_force_mean", "vision")
    environment = gymnasium.make(name, render_mode="rgb_array", modalities=modalities, samples=5, width=64, height=48)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(environment.unwrapped)
    environment.reset(seed=0)
    assert environment.render().shape == (48, 64, 3)
    assert np.ptp(environment.render()) > 100
    environment.close()


@pytest.mark.parametrize("limit", [{"samples": 4}, {"max_episode_steps": 3}])
def test_a_vector_environment_is_as_many_single_ones(limit: dict[str, int]) -> None:
    name, arguments = "SoftFinger-Cluttered-Press-v0", {**limit, "modalities": ("contact_force", "vision")}
    together = gymnasium.make_vec(name, 3, vectorization_mode="vector_entry_point", **arguments)
    apart = gymnasium.make_vec(name, 3, vectorization_mode="sync", **arguments)
    assert together.single_observation_space == apart.single_observation_space
    assert together.action_space == apart.action_space
    together.action_space.seed(1)
    observations = together.reset(seed=7)[0], apart.reset(seed=7)[0]
    for _ in range(11):  # over two ends of episodes
        for key, values in observations[0].items():
            assert np.array_equal(values, observations[1][key]), key
            assert values in together.observation_space[key]
        actions = together.action_space.sample()
        steps = together.step(actions), apart.step(actions)
        for mine, theirs in zip(steps[0][1:4], steps[1][1:4]):
            assert np.array_equal(mine, theirs)
        observations = steps[0][0], steps[1][0]


def test_an_episode_can_begin_anew_in_the_step_that_ends_it() -> None:
    name, arguments = "SoftFinger-Cluttered-Press-v0", {"samples": 3, "modalities": ("contact_force",)}
    mode = gymnasium.vector.AutoresetMode.SAME_STEP
    together = gymnasium.make_vec(name, 2, vectorization_mode="vector_entry_point", autoreset_mode=mode, **arguments)
    apart = gymnasium.make_vec(name, 2, vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode}, **arguments)
    assert together.metadata["autoreset_mode"] == apart.metadata["autoreset_mode"] == mode
    together.action_space.seed(1)
    together.reset(seed=7), apart.reset(seed=7)
    ends = 0
    for _ in range(7):
        actions = together.action_space.sample()
        mine, theirs = together.step(actions), apart.step(actions)
        for key, values in mine[0].items():
            assert np.array_equal(values, theirs[0][key]), key
        for one, other in zip(mine[1:4], theirs[1:4]):
            assert np.array_equal(one, other)
        assert mine[4].keys() == theirs[4].keys()
        if mine[3].any():
            ends += 1
            assert np.array_equal(mine[4]["episode"], theirs[4]["episode"])
            for one, other in zip(mine[4]["final_obs"], theirs[4]["final_obs"]):
                assert all(np.array_equal(one[key], other[key]) for key in other)
    assert ends == 2


def test_dm_controls_wrappers_fit() -> None:
    plain = environments.load("cluttered", "push", seed=0, samples=5, modalities="arm")
    fastest = plain.action_spec().maximum
    plain.reset()
    expected = plain.step(0.5 * fastest).observation["arm"]
    scaled = action_scale.Wrapper(environments.load("cluttered", "push", seed=0, samples=5), minimum=-1, maximum=1)
    assert np.all(scaled.action_spec().maximum == 1.0)
    scaled.reset()
    assert np.array_equal(scaled.step(np.full(3, 0.5)).observation["arm"], expected)
    assert repr(plain) == (
        "<harness.environments.Environment of <harness.episodes.Episodes push in cluttered: 1 at once, 5 samples each>>"
    )


def test_without_automatic_resets_ended_episodes_must_be_reset() -> None:
    several = gymnasium.make_vec("SoftFinger-Empty-Reach-v0", 2, samples=1, autoreset_mode="Disabled")
    several.reset(seed=0)
    actions = np.zeros((2, 3), np.float32)
    *_, ended, _ = several.step(actions)
    assert ended.all()
    with pytest.raises(ValueError, match=r"environments \[0 1\]; reset these first"):
        several.step(actions)
    _, info = several.reset(options={"reset_mask": ended})
    assert info["episode"].tolist() == [1, 1]
    *_, ended, _ = several.step(actions)
    several.reset(options={"reset_mask": np.array([True, False])})
    assert several.episodes.indices.tolist() == [2, 1]
    with pytest.raises(ValueError, match="reset_mask"):
        several.reset(options={"reset_mask": [1, 0]})


def test_gymnasiums_own_processes_can_run_environments() -> None:
    several = gymnasium.make_vec("SoftFinger-Empty-Reach-v0", 2, vectorization_mode="async")
    several.reset(seed=0)
    observed, *_ = several.step(several.action_space.sample())
    assert observed["proprioception"].shape == (2, 20)
    several.close()


def state(**values: Any) -> State:
    at_rest = {
        "setpoint_ranges": np.array([[2.4, 3.9], [-1, 0], [0, 1.5]]),
        "fingertip": np.zeros((1, 3)),
        "contact_force": np.zeros((1, 20)),
        "boxes": np.zeros((1, 8, 7)),
    }
    return State(**{**at_rest, **values})


def test_rewards_are_as_worked_by_hand() -> None:
    force = np.zeros((1, 20))
    force[0, [3, 19]] = 4.0, 6.0
    for wanted, reward in [(10.0, 1.0), (20.0, 0.5), (8.0, 0.75), (5.0, 0.0), (4.0, 0.0)]:
        assert Press().reward(state(contact_force=force), np.array([[wanted]])) == pytest.approx(reward)
    assert Press().reward(state(), np.array([[10.0]])) == 0.0
    there = {"fingertip": np.array([[0.3, 0.4, 0.1]])}
    assert Reach().reward(state(**there, contact_force=force), np.array([[0.3, 0.4]])) == 1.0
    assert Reach().reward(state(**there), np.array([[0.3, 0.4]])) == 0.5
    # 0.5 m away, where nearness is 1/e.
    assert Reach().reward(state(**there), np.array([[0.0, 0.0]])) == pytest.approx(0.5 / np.e)
    boxes = np.zeros((1, 8, 7))
    for x, reward in [(0.0, 0.0), (0.1, 0.25), (0.4, 1.0), (0.6, 0.5), (-0.2, 0.0)]:
        boxes[0, 0, 0] = x
        assert Push().reward(state(boxes=boxes), np.array([[0.0, 0.0, 0.4, 0.0]])) == pytest.approx(reward)


def test_goals_lie_under_the_swept_sector_and_clear_of_boxes() -> None:
    episodes = harness.episodes.Episodes("cluttered", "reach")
    for index in range(50):
        episodes.reset(0, 5 if index == 0 else None)
        (goal,) = episodes.goals
        # The models' column stands at the origin; the finger hangs 0.7 m from it, and 1.5 m more at most.
        assert 0.7 <= np.hypot(*goal) <= 2.2
        assert abs(np.arctan2(goal[1], -goal[0])) <= np.pi / 4 + 1e-9
        assert np.all(np.linalg.norm(episodes.simulations.boxes[0, :, :2] - goal, axis=1) > 0.3)
    assert episodes.indices[0] == 49


def test_reward_needs_touch() -> None:
    press = environments.load("empty", "press", seed=0)
    press.reset()
    hanging = [press.step(np.zeros(3)).reward for _ in range(5)]
    assert hanging == [0.0] * 5
    # The finger hangs 0.5 m above the ground, on which it stands upright. Slowly, so that a sample has a part of the force.
    down = [press.step(np.array([0, -lowered, 0])) for lowered in [0.03] * 14 + [0.003] * 20]
    for step in down:
        assert (step.reward > 0) <= (step.observation["contact_force_mean"].sum() > 0)
    assert max(step.reward for step in down) > 0


def test_the_same_seed_is_the_same_episode() -> None:
    def rewards(seed: int) -> list[float]:
        environment = environments.load("cluttered", "reach", seed=seed)
        environment.reset()
        return [environment.step(np.array([0.1, -0.1, 0.05])).reward for _ in range(10)]

    assert rewards(1) == rewards(1) != rewards(2)


def test_seeds_are_integers_of_any_type_and_others_are_named() -> None:
    single = gymnasium.make("SoftFinger-Empty-v0")
    several = gymnasium.make_vec("SoftFinger-Empty-v0", num_envs=2)
    assert single.reset(seed=np.int64(3))[1]["seed"] == 3
    assert several.reset(seed=np.int64(3))[1]["seed"].tolist() == [3, 4]
    for environment in (single, several):
        with pytest.raises(ValueError, match=r"seed: -1 must be 0 to"):
            environment.reset(seed=-1)
        with pytest.raises(TypeError, match=r"seed: 1.5 must be an integer"):
            environment.reset(seed=1.5 if environment is single else [1.5, 1])
    before = list(several.unwrapped.episodes.seeds)
    with pytest.raises(ValueError, match=r"seed: -1 must be 0 to"):
        several.reset(seed=[7, -1])
    assert several.unwrapped.episodes.seeds == before, "no simulation was restarted"
    with pytest.raises(ValueError, match="index: there are simulations 0 to 1, not 2"):
        several.unwrapped.episodes.reset(2)


def test_two_threads_on_one_simulation_are_refused_not_mixed() -> None:
    batch = harness.SimulationBatch("cluttered", 4)
    wrong: list[Exception] = []
    over = threading.Event()

    def step() -> None:
        while not over.is_set():
            try:
                batch.follow()
            except Exception as error:
                wrong.append(error)

    other = threading.Thread(target=step)
    other.start()
    for _ in range(100_000):
        try:
            batch.sense("arm")
        except Exception as error:
            wrong.append(error)
        if wrong:
            break
    over.set()
    other.join()
    assert wrong and all(isinstance(error, RuntimeError) and "another thread" in str(error) for error in wrong)
    batch.follow()


def test_a_simulation_goes_from_thread_to_thread() -> None:
    batch = harness.SimulationBatch("empty", 2)
    seen: list[np.ndarray] = []
    for _ in range(2):
        thread = threading.Thread(target=lambda: seen.append(batch.sense("vision")))
        thread.start()
        thread.join()
    assert np.array_equal(seen[0], seen[1]) and np.array_equal(seen[0], batch.sense("vision"))


def test_mujocos_own_package_works_beside_it() -> None:
    batch = harness.SimulationBatch("empty")
    frame = batch.sense("vision")
    model = mujoco.MjModel.from_xml_path(str(ROOT / "models" / "empty.xml"))
    data = mujoco.MjData(model)
    with pytest.raises(mujoco.FatalError, match="actuator"):
        mujoco.mj_setLengthRange(model, data, 99, mujoco.MjLROpt())
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, 64, 64) as renderer:
        renderer.update_scene(data, camera="external")
        assert np.ptp(renderer.render()) > 100
    assert np.array_equal(batch.sense("vision"), frame)


@pytest.mark.parametrize("count", [1, 2])
def test_a_forked_simulation_is_refused(count: int) -> None:
    batch = harness.SimulationBatch("empty", count)
    child = os.fork()
    if child == 0:
        try:
            batch.follow()
        except RuntimeError as error:
            os._exit(0 if "forked" in str(error) else 2)
        os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def reset_vector() -> harness.gymnasium.SoftFingerVector:
    environment = harness.gymnasium.SoftFingerVector(2, "empty")
    environment.reset(seed=0)
    return environment


WRONG = {
    "scenario": (lambda: harness.SimulationBatch("attic"), ValueError, "attic.*empty, cluttered"),
    "count": (lambda: harness.SimulationBatch("empty", 0), ValueError, "count"),
    "spec": (lambda: harness.SimulationBatch("empty", 1, "none.yaml"), FileNotFoundError, "none.yaml"),
    "index": (lambda: harness.SimulationBatch("empty").reset(1, 0, 0), ValueError, "index"),
    "seed": (lambda: harness.SimulationBatch("empty").reset(0, 2**60, 0), ValueError, "seed"),
    "shape": (lambda: harness.SimulationBatch("empty").step(np.zeros((2, 3))), ValueError, "setpoints"),
    "type": (lambda: harness.SimulationBatch("empty").step(np.full((1, 3), "one")), (TypeError, ValueError), "."),
    "value": (lambda: harness.SimulationBatch("empty").step(np.full((1, 3), np.nan)), ValueError, "finite"),
    "active": (lambda: harness.SimulationBatch("empty").step(np.zeros((1, 3)), [True] * 2), ValueError, "active"),
    "modality": (lambda: harness.SimulationBatch("empty").sense("smell"), KeyError, "smell.*vision"),
    "picture": (lambda: harness.SimulationBatch("empty").render(0, 0, 10), ValueError, "0 x 10"),
    "negative count": (lambda: harness.SimulationBatch("empty", -1), ValueError, "count: -1 must not be negative"),
    "negative index": (lambda: harness.SimulationBatch("empty").reset(-1, 0, 0), ValueError, "index: -1 must not be"),
    "late episode": (lambda: harness.SimulationBatch("empty").reset(0, 0, 2**40), ValueError, "episode: .* too large"),
    "negative width": (lambda: harness.SimulationBatch("empty").render(0, -1, 9), ValueError, "width: -1 must not be"),
    "task": (lambda: environments.load("empty", "juggle"), ValueError, "juggle.*reach"),
    "task there": (lambda: environments.load("empty", "push"), ValueError, "push.*cluttered"),
    "samples": (lambda: environments.load("empty", "reach", samples=0), ValueError, "samples"),
    "modalities": (lambda: environments.load("empty", "reach", modalities=("smell",)), KeyError, "smell"),
    "samples' type": (lambda: environments.load("empty", "reach", samples=1.5), TypeError, "1.5 must be an integer"),
    "environment's seed": (lambda: environments.load("empty", "reach", seed=-1), ValueError, "seed: -1 must be 0 to"),
    "seed's type": (lambda: environments.load("empty", "reach", seed=1.5), TypeError, "seed: 1.5 must be an integer"),
    "no reset": (lambda: harness.gymnasium.SoftFinger("empty").step(np.zeros(3)), RuntimeError, "call reset first"),
    "width's type": (
        lambda: harness.gymnasium.SoftFinger("empty", width=1.5),
        TypeError,
        "width: 1.5 must be an integer",
    ),
    "width": (lambda: harness.gymnasium.SoftFinger("empty", width=0), ValueError, "width: 0 must be 1 to 4096 pixels"),
    "actions": (lambda: reset_vector().step(np.zeros(3)), ValueError, "2 times 3 finite numbers: rotation, lift, ext"),
    "an action": (lambda: reset_vector().step(np.full((2, 3), np.nan)), ValueError, "actions: .* finite numbers"),
    "words": (lambda: reset_vector().step("left"), ValueError, "actions: 'left' must be 2 times 3 finite numbers"),
    "render mode": (lambda: harness.gymnasium.SoftFinger("empty", render_mode="human"), ValueError, "human"),
    "no seeds": (lambda: reset_vector().reset(seed=1.0), TypeError, "seed: 1.0 must be an integer, or a list of them"),
    "seeds": (lambda: harness.gymnasium.SoftFingerVector(2, "empty").reset(seed=[1]), ValueError, "seed"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_call_raises_what_fits_and_names_what_is_wrong(name: str) -> None:
    call, exception, message = WRONG[name]
    with pytest.raises(exception, match=message):
        call()


@pytest.mark.parametrize("action", [np.zeros(2), np.array([np.inf, 0, 0]), np.zeros((1, 3)), "left", None])
def test_a_wrong_action_is_named(action: Any) -> None:
    environment = environments.load("empty", "reach", seed=0)
    environment.reset()
    with pytest.raises(ValueError, match="action: .* must be 3 finite numbers: rotation, lift, extension"):
        environment.step(action)


def test_any_world_is_an_environment_without_a_task():
    """The observations are the world's own, the action has its elements, and Gymnasium's checker is content."""
    own = Path(__file__).parents[2] / "models" / "twelve.yaml"
    for scenario, elements, joints in [(str(own), 3, 12), ("tendon", 7, 20)]:
        environment = gymnasium.make("HarnessWorld-v0", scenario=scenario)
        observation, _ = environment.reset(seed=0)
        assert environment.action_space.shape == (elements,) and observation["proprioception"].shape == (joints,)
        assert "goal" not in observation and "vision" not in observation
        _, reward, terminated, truncated, _ = environment.step(environment.action_space.sample())
        assert (reward, terminated, truncated) == (0.0, False, False)
        check_env(environment.unwrapped, skip_render_check=True)
