"""Says what each pixel of rendered states shows, by MuJoCo's segmentation.

    segment_frames.py MODEL.xml POSITIONS.f64 SIDE PARTS.u8

POSITIONS holds rows of generalized positions (little-endian 64-bit floats); PARTS receives for each row SIDE x SIDE
bytes of the image of the camera `external`: 1 where it shows the arm, 2 the finger, 0 anything else.
"""

import os
import sys

os.environ["MUJOCO_GL"] = "egl"  # the harness renders with EGL

import mujoco
import numpy as np

OTHER, ARM, FINGER = range(3)


def part(name: str) -> int:
    """The part that a geom belongs to; the arm's geoms have no names."""
    if name.startswith("finger_link_"):
        return FINGER
    return OTHER if name == "ground" or name.startswith(("box_", "pillar_")) else ARM


def main(model_path, positions_path, side, parts_path):
    model = mujoco.MjModel.from_xml_path(model_path)
    data = mujoco.MjData(model)
    of_geom = np.array([part(model.geom(index).name) for index in range(model.ngeom)] + [OTHER], np.uint8)
    parts = []
    with mujoco.Renderer(model, height=int(side), width=int(side)) as renderer:
        renderer.enable_segmentation_rendering()
        for position in np.fromfile(positions_path, "<f8").reshape(-1, model.nq):
            data.qpos[:] = position
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera="external")
            index, kind = np.moveaxis(renderer.render(), 2, 0)
            parts.append(of_geom[np.where(kind == mujoco.mjtObj.mjOBJ_GEOM, index, -1)])
    np.asarray(parts, np.uint8).tofile(parts_path)


if __name__ == "__main__":
    main(*sys.argv[1:])
