"""Simulates a model with dm_control's own stepping, under given controls, for comparison with the harness.

    dm_control_trajectory.py MODEL.xml START.f64 CONTROLS.f64 STEPS_PER_SAMPLE STEPPING POSITIONS.f64

The files are those of trajectory.py. STEPPING is `legacy`, dm_control's default, which ends each step with the first
half of the next, or `plain`.
"""

import sys

import numpy as np
from dm_control import mujoco


def main(model_path, start_path, controls_path, steps_per_sample, stepping, positions_path):
    physics = mujoco.Physics.from_xml_path(model_path)
    physics.legacy_step = {"legacy": True, "plain": False}[stepping]
    with physics.reset_context():
        physics.data.qpos[:] = np.fromfile(start_path, "<f8")
    positions = []
    for step, control in enumerate(np.fromfile(controls_path, "<f8").reshape(-1, physics.model.nu)):
        if step % int(steps_per_sample) == 0:
            positions.append(physics.data.qpos.copy())
        physics.set_control(control)
        physics.step()
    np.asarray(positions, "<f8").tofile(positions_path)


if __name__ == "__main__":
    main(*sys.argv[1:])
