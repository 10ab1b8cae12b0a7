"""Collects samples with Python's `mujoco`, as the harness does, for comparison with the harness's rate.

    python harness/benches/collect.py --scenario cluttered --courses courses.bin
    python harness/benches/collect.py --scenario cluttered --courses courses.bin --samples-per-episode 100 --untuned

For each sample, the checked-in scene takes 100 steps with the commanded motion. The sample has the finger's angles,
the arm, the setpoint, each link's normal contact force at that time and its mean over the steps, and a frame of 64 x 64
pixels. Samples stay in memory, whereas the harness also writes them to disk. The example `courses` writes
`courses.bin`. The episodes are the harness's own: the last positions must be the same, bit by bit.

By default the program is tuned, which is the fastest that plain Python was found to be: the scene's visual quality and
sleeping, llvmpipe without its own threads, one process per core, and preallocated arrays. `--untuned` is a first
version: MuJoCo's default visual quality, no sleeping, and one process. `--no-sleep` is tuned, but without sleeping.
Needs mujoco, numpy and EGL.

Prints JSON. The time runs from when all processes have their model and renderer until the last one is done.
Run it on an otherwise idle machine.
"""

import argparse
import dataclasses
import os
from pathlib import Path

import courses
import numpy as np

MODELS = Path(__file__).parents[2] / "models"
JOINTS = 20
FRAME_SIDE = 64


@dataclasses.dataclass
class Episode:
    """The recording of one episode, with one row for each sample."""

    proprioception: np.ndarray  # [n, 20] rad
    arm: np.ndarray  # [n, 3] rad, m, m
    setpoint: np.ndarray  # [n, 3] rad, m, m
    contact_force: np.ndarray  # [n, 20] N, at the sample
    contact_force_mean: np.ndarray  # [n, 20] N, over the steps since the previous sample
    vision: np.ndarray  # [n, 64, 64, 3] u8

    @classmethod
    def empty(cls, samples: int) -> "Episode":
        def rows(*shape, dtype=np.float32):
            return np.empty((samples, *shape), dtype)

        frames = rows(FRAME_SIDE, FRAME_SIDE, 3, dtype=np.uint8)
        return cls(rows(JOINTS), rows(3), rows(3), rows(JOINTS), rows(JOINTS), frames)


class Collector:
    """One scene with its state and renderer, used by the process that created it."""

    def __init__(self, options: argparse.Namespace):
        import mujoco  # here, so that the environment is set before the library chooses its OpenGL

        self.mujoco = mujoco
        spec = mujoco.MjSpec.from_file(str(MODELS / f"{options.scenario}.xml"))
        self.is_harness_model = options.tuned and options.sleep
        if not options.tuned:
            set_default_quality(spec, mujoco)
        if not self.is_harness_model:
            spec.option.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.renderer = mujoco.Renderer(self.model, FRAME_SIDE, FRAME_SIDE)
        self.link_of_geom = [-1] * self.model.ngeom
        for link in range(JOINTS):
            self.link_of_geom[self.model.geom(f"finger_link_{link:02}").id] = link
        names = [f"finger_joint_{joint:02}" for joint in range(JOINTS)]
        self.finger = [self.model.joint(name).qposadr[0] for name in names]
        names = ["arm_rotation", "arm_lift", "arm_extension"]
        self.arm = [self.model.joint(name).qposadr[0] for name in names]

    def episode(self, course: courses.Course) -> np.ndarray:
        """Simulates one episode from rest.

        A step first computes the forces and poses for the present positions, and then changes the positions. So a
        sample takes its positions before a step, and its forces and frame after it.
        """
        data, step, link_forces = self.data, self.mujoco.mj_step, self.link_forces
        steps_per_sample = course.steps_per_sample
        self.mujoco.mj_resetData(self.model, data)
        data.qpos[:] = course.start

        recorded = Episode.empty(course.samples)
        sums, steps = [0.0] * JOINTS, 0
        ctrl, qpos = data.ctrl, data.qpos
        for index, setpoint in enumerate(course.controls):
            row, phase = divmod(index, steps_per_sample)
            if phase == 0:
                recorded.proprioception[row] = qpos[self.finger]
                recorded.arm[row] = qpos[self.arm]
                recorded.setpoint[row] = setpoint
                last = qpos.copy()
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
            raise RuntimeError(f"the simulation of episode {course.index} diverged: see MUJOCO_LOG.TXT")
        if self.is_harness_model and course.end is not None and not np.array_equal(last, course.end):
            raise RuntimeError(f"episode {course.index} did not end where its course says; is it another MuJoCo?")
        return recorded.contact_force_mean

    def link_forces(self) -> list[tuple[int, float]]:
        """Returns the link and the normal force (N) of each of the finger's contacts.

        These scenes use elliptic cones, with which the first constraint row of a contact is its normal force. (With
        pyramidal cones it would be the sum of all rows.) For a few contacts, a loop over plain lists is faster than
        NumPy's fancy indexing.
        """
        contact, rows = self.data.contact, self.data.efc_force
        link_of_geom = self.link_of_geom
        forces = []
        for (geom1, geom2), row in zip(contact.geom.tolist(), contact.efc_address.tolist()):
            link = max(link_of_geom[geom1], link_of_geom[geom2])
            if link >= 0 and row >= 0:
                forces.append((link, rows[row]))
        return forces


def set_default_quality(spec, mujoco) -> None:
    """Sets MuJoCo's default visual quality."""
    usual = mujoco.MjSpec()
    for field in ("shadowsize", "offsamples", "numslices", "numstacks", "numquads"):
        setattr(spec.visual.quality, field, getattr(usual.visual.quality, field))


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    courses.add_arguments(parser)
    tuning = parser.add_mutually_exclusive_group()
    tuning.add_argument("--untuned", dest="tuned", action="store_false", help="a first version, in one process")
    tuning.add_argument("--no-sleep", dest="sleep", action="store_false")
    options = parser.parse_args()
    if not options.tuned:
        options.processes = 1
    return options


def main() -> None:
    options = arguments()
    os.environ["MUJOCO_GL"] = "egl"
    if options.tuned:
        os.environ["LP_NUM_THREADS"] = "0"
    courses.collect(Collector, options)


if __name__ == "__main__":
    main()
