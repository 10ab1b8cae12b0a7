"""Collects samples with Python's `mujoco`, doing the harness's work, to set beside the harness's own rate.

    python harness/benches/collect.py --scenario cluttered --samples 4000
    python harness/benches/collect.py --scenario cluttered --samples 400 --untuned

A sample is 100 steps of the checked-in scene under smoothstep moves, then the finger's angles, the arm, the
setpoint, each link's normal contact force at the instant and its mean over the steps, and a 64 x 64 frame.
Samples stay in memory; the harness writes them to disk besides.

Tuned (the default) is as fast as plain Python was found to get: the scene's visual quality and sleeping,
llvmpipe without threads of its own, one process a core, preallocated arrays. `--untuned` is what one writes
first: MuJoCo's default visual quality, no sleeping, one process. Needs mujoco and numpy, and EGL.

Prints JSON. The time runs from when every process has its model and renderer until the last one is done.
Run it on an otherwise idle machine.
"""

import argparse
import dataclasses
import json
import multiprocessing
import os
import time
from pathlib import Path

import numpy as np

MODELS = Path(__file__).parents[2] / "models"
JOINTS = 20
FRAME_SIDE = 64
STEPS_PER_ACTUATION = 1000  # 1 s at 1 kHz
STEPS_PER_SAMPLE = 100
SAMPLES_PER_EPISODE = 1000
BOXES = 8
BOX_CLEARANCE = 0.05  # m
START_TIMEOUT = 120  # s, for every process to open its model and renderer


@dataclasses.dataclass
class Episode:
    """What one episode recorded; one row a sample."""

    proprioception: np.ndarray  # [n, 20] rad
    arm: np.ndarray  # [n, 3] rad, m, m
    setpoint: np.ndarray  # [n, 3] rad, m, m
    contact_force: np.ndarray  # [n, 20] N, at the instant
    contact_force_mean: np.ndarray  # [n, 20] N, over the steps since the previous sample
    vision: np.ndarray  # [n, 64, 64, 3] u8

    @classmethod
    def empty(cls, samples: int) -> "Episode":
        def rows(*shape, dtype=np.float32):
            return np.empty((samples, *shape), dtype)

        frames = rows(FRAME_SIDE, FRAME_SIDE, 3, dtype=np.uint8)
        return cls(rows(JOINTS), rows(3), rows(3), rows(JOINTS), rows(JOINTS), frames)


class Collector:
    """One scene with its state and renderer, in the process that made it."""

    def __init__(self, scenario: str, tuned: bool):
        import mujoco  # here, so that the environment is set before the library chooses its OpenGL

        self.mujoco = mujoco
        spec = mujoco.MjSpec.from_file(str(MODELS / f"{scenario}.xml"))
        if not tuned:
            untune(spec, mujoco)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.renderer = mujoco.Renderer(self.model, FRAME_SIDE, FRAME_SIDE)
        self.has_boxes = scenario == "cluttered"
        self.link_of_geom = [-1] * self.model.ngeom
        for link in range(JOINTS):
            self.link_of_geom[self.model.geom(f"finger_link_{link:02}").id] = link
        names = [f"finger_joint_{joint:02}" for joint in range(JOINTS)]
        self.finger = [self.model.joint(name).qposadr[0] for name in names]
        names = ["arm_rotation", "arm_lift", "arm_extension"]
        self.arm = [self.model.joint(name).qposadr[0] for name in names]
        self.low, self.high = self.model.actuator_ctrlrange.T

    def episode(self, seed: int, samples: int) -> Episode:
        """Simulates one episode from rest.

        A step computes the forces and poses of the instant it starts from, then moves the positions on; so a
        sample takes its positions before a step, and forces and frame after it.
        """
        data, step, link_forces = self.data, self.mujoco.mj_step, self.link_forces
        rng = np.random.default_rng(seed)
        self.mujoco.mj_resetDataKeyframe(self.model, data, 0)
        if self.has_boxes:
            self.place_boxes(rng)
        setpoints = self.setpoints(rng, data.ctrl.copy(), (samples - 1) * STEPS_PER_SAMPLE + 1)

        recorded = Episode.empty(samples)
        sums, steps = [0.0] * JOINTS, 0
        ctrl, qpos = data.ctrl, data.qpos
        for index, setpoint in enumerate(setpoints):
            row, phase = divmod(index, STEPS_PER_SAMPLE)
            if phase == 0:
                recorded.proprioception[row] = qpos[self.finger]
                recorded.arm[row] = qpos[self.arm]
                recorded.setpoint[row] = setpoint
            ctrl[:] = setpoint
            step(self.model, data)
            steps += 1
            if data.ncon:
                for link, force in link_forces():
                    sums[link] += force
            if phase == 0:
                recorded.contact_force[row] = 0
                for link, force in link_forces():
                    recorded.contact_force[row, link] += force
                recorded.contact_force_mean[row] = np.divide(sums, steps)
                sums, steps = [0.0] * JOINTS, 0
                self.renderer.update_scene(data, "external")
                self.renderer.render(out=recorded.vision[row])
        if any(warning.number for warning in data.warning):
            raise RuntimeError(f"the simulation of episode {seed} diverged: see MUJOCO_LOG.TXT")
        return recorded

    def link_forces(self) -> list[tuple[int, float]]:
        """Link and normal force (N) of each of the finger's contacts.

        With elliptic cones, as in these scenes, the first of a contact's constraint rows is its normal force
        (with pyramidal ones it would be the sum of all its rows). For a few contacts a loop over plain lists
        is quicker than NumPy's fancy indexing.
        """
        contact, rows = self.data.contact, self.data.efc_force
        link_of_geom = self.link_of_geom
        forces = []
        for (geom1, geom2), row in zip(contact.geom.tolist(), contact.efc_address.tolist()):
            link = max(link_of_geom[geom1], link_of_geom[geom2])
            if link >= 0 and row >= 0:
                forces.append((link, rows[row]))
        return forces

    def setpoints(self, rng: np.random.Generator, rest: np.ndarray, steps: int) -> np.ndarray:
        """The arm's setpoint at each step, [steps, 3]: smoothstep moves between uniform random ones."""
        moves = -(-steps // STEPS_PER_ACTUATION)
        knots = np.vstack([rest, rng.uniform(self.low, self.high, (moves, 3))])
        u = np.arange(STEPS_PER_ACTUATION) / STEPS_PER_ACTUATION
        smooth = (u * u * (3 - 2 * u))[None, :, None]
        path = knots[:-1, None] + smooth * np.diff(knots, axis=0)[:, None]
        return path.reshape(-1, 3)[:steps]

    def place_boxes(self, rng: np.random.Generator) -> None:
        """Stands the boxes uniformly over the swept sector, apart from each other and the finger."""
        mount_radius = abs(self.model.body("arm_beam").pos[0])
        finger_radius = self.model.geom("finger_link_00").size[0]
        half_x, half_y, half_z = self.model.geom("box_0").size
        box_radius = np.hypot(half_x, half_y)
        rest = self.data.ctrl[0]
        taken = [(mount_radius * np.cos(rest), mount_radius * np.sin(rest), finger_radius)]
        while len(taken) <= BOXES:
            inner, outer = (mount_radius + self.low[2]) ** 2, (mount_radius + self.high[2]) ** 2
            radius, angle = np.sqrt(rng.uniform(inner, outer)), rng.uniform(self.low[0], self.high[0])
            x, y = radius * np.cos(angle), radius * np.sin(angle)
            if all(np.hypot(x - a, y - b) - box_radius - r >= BOX_CLEARANCE for a, b, r in taken):
                half_yaw = rng.uniform(-np.pi, np.pi) / 2
                pose = [x, y, half_z, np.cos(half_yaw), 0, 0, np.sin(half_yaw)]
                self.data.joint(f"box_{len(taken) - 1}").qpos[:] = pose
                taken.append((x, y, box_radius))


def untune(spec, mujoco) -> None:
    """Sets MuJoCo's default visual quality, and no sleeping."""
    usual = mujoco.MjSpec()
    for field in ("shadowsize", "offsamples", "numslices", "numstacks", "numquads"):
        setattr(spec.visual.quality, field, getattr(usual.visual.quality, field))
    spec.option.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)


def work(options: argparse.Namespace, process: int, episodes: list[int], ready, results) -> None:
    """Collects this process's share of the episodes, given by their number of samples."""
    collector = Collector(options.scenario, options.tuned)
    ready.wait(START_TIMEOUT)
    touched = 0
    for index, samples in enumerate(episodes):
        episode = collector.episode(options.seed + index * options.processes + process, samples)
        touched += int((episode.contact_force_mean > 0).any(axis=1).sum())
    results.put(touched)


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenario", choices=["empty", "cluttered"], default="empty")
    parser.add_argument("--samples", type=int, default=4000, help="altogether, divided among the processes")
    parser.add_argument("--processes", type=int, help="2; 1 with --untuned")
    parser.add_argument("--seed", type=int, default=0)
    tuning = parser.add_mutually_exclusive_group()
    tuning.add_argument("--tuned", action="store_true", default=True)
    tuning.add_argument("--untuned", dest="tuned", action="store_false")
    options = parser.parse_args()
    options.processes = options.processes or (2 if options.tuned else 1)
    if options.samples < 1 or options.samples % options.processes:
        parser.error("--samples must be positive and a multiple of --processes")
    return options


def main() -> None:
    options = arguments()
    os.environ["MUJOCO_GL"] = "egl"
    if options.tuned:
        os.environ["LP_NUM_THREADS"] = "0"
    share = options.samples // options.processes
    episodes = [min(SAMPLES_PER_EPISODE, share - first) for first in range(0, share, SAMPLES_PER_EPISODE)]

    context = multiprocessing.get_context("spawn")
    ready, results = context.Barrier(options.processes + 1), context.Queue()
    workers = [
        context.Process(target=work, args=(options, process, episodes, ready, results))
        for process in range(options.processes)
    ]
    for worker in workers:
        worker.start()
    ready.wait(START_TIMEOUT)
    start = time.perf_counter()
    for worker in workers:
        worker.join()
    seconds = time.perf_counter() - start
    if any(worker.exitcode for worker in workers):
        raise SystemExit("a process failed: its message is above")
    touched = sum(results.get() for _ in workers)
    report = {
        "seconds": round(seconds, 2),
        "samples_per_second": round(options.samples / seconds, 1),
        "share_of_samples_in_contact": round(touched / options.samples, 3),
    }
    print(json.dumps(vars(options) | report))


if __name__ == "__main__":
    main()
