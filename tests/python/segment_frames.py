"""Says what each pixel of rendered states shows and how far away it is, by MuJoCo's segmentation and depth.

    segment_frames.py MODEL.xml POSITIONS.f64 SIDE GEOMS.i32 DEPTHS.f32

POSITIONS holds rows of generalized positions (little-endian 64-bit floats). For each row, GEOMS and DEPTHS receive
SIDE x SIDE values of the image of the camera `external`: the index of the geom, or -1 where there is none, and the
distance from the camera's plane, m.
"""

import os
import sys

os.environ["MUJOCO_GL"] = "egl"  # the harness renders with EGL

import mujoco
import numpy as np


def main(model_path, positions_path, side, geoms_path, depths_path):
    model = mujoco.MjModel.from_xml_path(model_path)
    data = mujoco.MjData(model)
    geoms, depths = [], []
    with mujoco.Renderer(model, height=int(side), width=int(side)) as renderer:
        for position in np.fromfile(positions_path, "<f8").reshape(-1, model.nq):
            data.qpos[:] = position
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera="external")
            renderer.enable_segmentation_rendering()
            index, kind = np.moveaxis(renderer.render(), 2, 0)
            geoms.append(np.where(kind == mujoco.mjtObj.mjOBJ_GEOM, index, -1))
            renderer.disable_segmentation_rendering()
            renderer.enable_depth_rendering()
            depths.append(renderer.render())
            renderer.disable_depth_rendering()
    np.asarray(geoms, "<i4").tofile(geoms_path)
    np.asarray(depths, "<f4").tofile(depths_path)


if __name__ == "__main__":
    main(*sys.argv[1:])
