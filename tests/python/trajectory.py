"""Simulates a model with Python's `mujoco`, under given controls, for comparison with the harness.

    trajectory.py MODEL.xml START.f64 CONTROLS.f64 STEPS_PER_SAMPLE POSITIONS.f64

START holds the first generalized positions, CONTROLS one row of controls a step; POSITIONS receives a row of
generalized positions before every STEPS_PER_SAMPLE-th step. All are little-endian 64-bit floats.
"""

import sys

import mujoco
import numpy as np


def main(model_path, start_path, controls_path, steps_per_sample, positions_path):
    model = mujoco.MjModel.from_xml_path(model_path)
    data = mujoco.MjData(model)
    data.qpos[:] = np.fromfile(start_path, "<f8")
    positions = []
    for step, control in enumerate(np.fromfile(controls_path, "<f8").reshape(-1, model.nu)):
        if step % int(steps_per_sample) == 0:
            positions.append(data.qpos.copy())
        data.ctrl[:] = control
        mujoco.mj_step(model, data)
    np.asarray(positions, "<f8").tofile(positions_path)


if __name__ == "__main__":
    main(*sys.argv[1:])
