"""Renders states of a model with Python's `mujoco.Renderer`, for comparison with the harness.

    render_frames.py MODEL.xml POSITIONS.f64 SIDE FRAMES.u8

POSITIONS holds rows of generalized positions (little-endian 64-bit floats); FRAMES receives for each row the
image of the camera `external`, SIDE x SIDE x 3 bytes.
"""

import os
import sys

os.environ["MUJOCO_GL"] = "egl"  # the harness renders with EGL

import mujoco
import numpy as np


def main(model_path, positions_path, side, frames_path):
    model = mujoco.MjModel.from_xml_path(model_path)
    data = mujoco.MjData(model)
    frames = []
    with mujoco.Renderer(model, height=int(side), width=int(side)) as renderer:
        for position in np.fromfile(positions_path, "<f8").reshape(-1, model.nq):
            data.qpos[:] = position
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera="external")
            frames.append(renderer.render())
    np.asarray(frames, np.uint8).tofile(frames_path)


if __name__ == "__main__":
    main(*sys.argv[1:])
