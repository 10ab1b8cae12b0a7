"""Compares the step rate of the vector environment with Gymnasium's AsyncVectorEnv and Python's `mujoco`.

    make python
    .venv/bin/python harness/benches/vector_environments.py --scenario cluttered --environments 8

Both simulate the same MJCF with the same actions. An action takes 100 steps of 1 ms, and the setpoint moves evenly.
Both sum the normal forces on each link at every step for the observation's mean. Nothing is rendered. They take turns,
and the medians are compared. There are two peers. `contacts` reads the contacts after each step with NumPy, as the
harness does in Rust. `sensors` reads touch sensors, which are added to the model. Both must reach the same positions as
the harness, bit by bit.
"""

import argparse
import os
import statistics
import time
from functools import partial
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
from gymnasium.vector import AsyncVectorEnv, VectorEnv

import harness.gymnasium

ROOT = Path(__file__).resolve().parents[2]
LINKS = 20
STEPS = 100
SAMPLES = 100
ARM = ("arm_rotation", "arm_lift", "arm_extension")


class Peer(gymnasium.Env):
    """The finger in plain Python with `mujoco`, with the same world, actions and sensors as in the harness."""

    def __init__(self, scenario: str, ranges: np.ndarray, boxes: np.ndarray, touch_sensors: bool) -> None:
        """ranges: ranges of the setpoint, `[3, 2]`. boxes: initial poses of the boxes, `[boxes, 7]`."""
        self.ranges, self.boxes = ranges, boxes
        spec = mujoco.MjSpec.from_file(str(ROOT / "models" / f"{scenario}.xml"))
        if touch_sensors:
            for link in range(LINKS):
                body = spec.body(f"finger_link_{link:02}")
                # The site encloses the link, so that it detects all contacts of the body.
                body.add_site(name=f"touch_{link:02}", size=[0.2, 0.2, 0.2])
                spec.add_sensor(
                    name=f"touch_{link:02}",
                    type=mujoco.mjtSensor.mjSENS_TOUCH,
                    objtype=mujoco.mjtObj.mjOBJ_SITE,
                    objname=f"touch_{link:02}",
                )
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.touch_sensors = touch_sensors
        self.joints = [self.model.joint(f"finger_joint_{joint:02}").qposadr[0] for joint in range(LINKS)]
        self.arm = [self.model.joint(name).qposadr[0] for name in ARM]
        self.actuators = [self.model.actuator(name).id for name in ARM]
        links = {self.model.geom(f"finger_link_{link:02}").id: link for link in range(LINKS)}
        self.link_of_geom = np.array([links.get(geom, -1) for geom in range(self.model.ngeom)])
        self.observation_space = gymnasium.spaces.Dict(
            {
                "proprioception": gymnasium.spaces.Box(-np.pi, np.pi, (LINKS,), np.float32),
                "arm": gymnasium.spaces.Box(-10, 10, (3,), np.float32),
                "contact_force": gymnasium.spaces.Box(0, 1e4, (LINKS,), np.float32),
                "contact_force_mean": gymnasium.spaces.Box(0, 1e4, (LINKS,), np.float32),
            }
        )
        self.action_space = gymnasium.spaces.Box(-1, 1, (3,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.setpoint = np.array([self.ranges[0].mean(), self.ranges[1, 1], self.ranges[2, 0]])
        self.data.qpos[self.arm] = self.setpoint
        for index, pose in enumerate(self.boxes):
            self.data.joint(f"box_{index}").qpos[:] = pose
        self.taken = 0
        self._advance(self.setpoint[None])
        return self._observation(), {}

    def step(self, action):
        target = np.clip(self.setpoint + action.astype(np.float64), self.ranges[:, 0], self.ranges[:, 1])
        done = np.arange(1, STEPS + 1)[:, None] / STEPS
        path = self.setpoint + done * (target - self.setpoint)
        path[-1] = target
        self.setpoint = target
        self._advance(path)
        self.taken += 1
        return self._observation(), 0.0, False, self.taken == SAMPLES, {}

    def _advance(self, path: np.ndarray) -> None:
        """Takes one step for each setpoint, and keeps the positions and forces at the start of the last step."""
        controls = np.zeros((len(path), self.model.nu))
        controls[:, self.actuators] = path
        forces = np.zeros((len(path), LINKS))
        for step, control in enumerate(controls):
            self.data.ctrl[:] = control
            if step == len(controls) - 1:
                self.qpos = self.data.qpos.copy()
            mujoco.mj_step(self.model, self.data)
            if self.touch_sensors:
                forces[step] = self.data.sensordata
            else:
                self._sum_forces(forces[step])
        self.force, self.force_mean = forces[-1], forces.mean(axis=0)

    def _sum_forces(self, forces: np.ndarray) -> None:
        contact = self.data.contact
        if len(contact.dist) == 0:
            return
        link = self.link_of_geom[contact.geom].max(axis=1)
        touching = (link >= 0) & (contact.efc_address >= 0)
        # With elliptic cones, the first row of a contact is its normal force.
        np.add.at(forces, link[touching], self.data.efc_force[contact.efc_address[touching]])

    def _observation(self) -> dict[str, np.ndarray]:
        return {
            "proprioception": self.qpos[self.joints].astype(np.float32),
            "arm": self.qpos[self.arm].astype(np.float32),
            "contact_force": self.force.astype(np.float32),
            "contact_force_mean": self.force_mean.astype(np.float32),
        }


def processor_seconds(environment: VectorEnv) -> float:
    """Returns the processor time of this process and of the environment's processes so far."""
    ticks = 0
    for process in [os.getpid(), *(worker.pid for worker in getattr(environment, "processes", []))]:
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
        ticks += int(fields[11]) + int(fields[12])
    return ticks / os.sysconf("SC_CLK_TCK")


def rates(environment: VectorEnv, actions: np.ndarray) -> tuple[float, float]:
    """Returns environment steps per second, and per second of processor time, which other work affects less."""
    steps = len(actions) * environment.num_envs
    before, begin = processor_seconds(environment), time.perf_counter()
    for action in actions:
        environment.step(action)
    return steps / (time.perf_counter() - begin), steps / (processor_seconds(environment) - before)


def check_same_world(scenario: str, actions: np.ndarray) -> None:
    """Ends with an error unless both peers have the same positions and forces as the harness."""
    for touch_sensors in (False, True):
        episodes = harness.episodes.Episodes(scenario, "press")
        episodes.reset(0, seed=0)
        peer = Peer(scenario, episodes.ranges, episodes.simulations.boxes[0], touch_sensors)
        seen, _ = peer.reset()
        for action in actions:
            mine = episodes.observe()
            for name, values in seen.items():
                # Touch sensors and the mean sum in another order.
                exact = name in ("proprioception", "arm")
                same = np.array_equal(mine[name][0], values) if exact else np.allclose(mine[name][0], values, rtol=1e-5)
                if not same:
                    raise SystemExit(f"the peer's {name} differs by {np.abs(mine[name][0] - values).max()}")
            episodes.step(action[None])
            seen, *_ = peer.step(action)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", choices=["empty", "cluttered"], default="cluttered")
    parser.add_argument("--environments", type=int, default=8)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--actions", type=int, default=100, help="number of actions of each environment in a round")
    options = parser.parse_args()
    count = options.environments
    mine = gymnasium.make_vec(
        f"SoftFinger-{options.scenario.title()}-Press-v0", count, vectorization_mode="vector_entry_point"
    )
    space = mine.single_action_space
    random = np.random.default_rng(0)
    actions = random.uniform(space.low, space.high, (options.actions, count, 3)).astype(np.float32)
    check_same_world(options.scenario, actions[:30, 0])
    mine.reset(seed=0)
    world = mine.unwrapped.episodes
    boxes = world.simulations.boxes
    contenders: dict[str, VectorEnv] = {"harness": mine}
    for name, touch_sensors in {"contacts": False, "sensors": True}.items():
        make = [partial(Peer, options.scenario, world.ranges, boxes[index], touch_sensors) for index in range(count)]
        contenders[name] = AsyncVectorEnv(make)
    measured: dict[str, list[tuple[float, float]]] = {name: [] for name in contenders}
    for _ in range(options.rounds):
        for name, environment in contenders.items():
            environment.reset(seed=0)
            measured[name].append(rates(environment, actions))
    for environment in contenders.values():
        environment.close()
    rounds = f"{options.rounds} rounds of {options.actions} actions"
    print(f"{options.scenario}, {count} environments, {rounds}: environment steps")
    for name, values in measured.items():
        for unit, own, theirs in zip(("a second", "a processor second"), zip(*measured["harness"]), zip(*values)):
            ratio = statistics.median(mine / other for mine, other in zip(own, theirs))
            print(f"{name:9} {statistics.median(theirs):7.0f} {unit:18} harness / {name}: {ratio:.2f}")


if __name__ == "__main__":
    main()
