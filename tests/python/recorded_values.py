"""Compares the values that the harness recorded with those that Python's `mujoco` computes at the same states.

    recorded_values.py MODEL.xml WORLD.json DATASET STARTS.f64 CONTROLS.f64 STEPS_PER_SAMPLE

WORLD is the world file as JSON, and DATASET a folder of recorded episodes. STARTS holds the first generalized
positions of each episode (and, if the action moves mocap bodies, the positions of all mocap bodies), and CONTROLS the
setpoints of each of its steps, for the elements of the action. Both are little-endian 64-bit floats.

A dataset does not hold the whole state: that of free and ball joints, of soft bodies and of muscles is missing.
So each episode is simulated again, and each value is computed by `mj_forward` from a copy of the state before the
step. The recorded joint angles and velocities show that the states are those of the recording.

Prints for each modality its source, how many values a sample has, how many of them vary, and the largest difference.
Exits with 1 if a value differs or a recorded column was not compared.
"""

import fnmatch
import json
import os
import re
import sys
from pathlib import Path

os.environ["MUJOCO_GL"] = "egl"  # the harness renders with EGL

import mujoco
import numpy as np
import pyarrow.parquet as parquet

GEOM, BODY, SITE, JOINT, SENSOR, FLEX = (
    getattr(mujoco.mjtObj, f"mjOBJ_{kind}") for kind in ("GEOM", "BODY", "SITE", "JOINT", "SENSOR", "FLEX")
)
COUNTS = {GEOM: "ngeom", BODY: "nbody", SITE: "nsite", JOINT: "njnt", SENSOR: "nsensor", FLEX: "nflex"}

# Columns that no modality has.
PLACE = {"dataset", "scenario", "episode", "sample"}

# How much a value of each kind may differ, relative to the largest value of its modality. MuJoCo is the same library,
# and values are recorded as 32-bit floats. Renderers round colors differently.
TOLERANCE = 1e-6
COLOR_TOLERANCE = 1


def matching(model, kind, patterns):
    """The indices of the named objects that match, in the model's order. A name that looks like a pattern is a name."""
    names = [mujoco.mj_id2name(model, kind, index) for index in range(getattr(model, COUNTS[kind]))]

    def matches(name):
        return any(name == p or p not in names and fnmatch.fnmatchcase(name, p) for p in patterns)

    return [index for index, name in enumerate(names) if name and matches(name)]


def upright(quaternion):
    """The same orientation, with w of at least 0."""
    return -quaternion if quaternion[0] < 0 else quaternion


def joint_position(values):
    """The position of a joint. Orientations, of ball and free joints, have w of at least 0."""
    if len(values) == 1:
        return values
    return np.concatenate([values[:-4], upright(values[-4:])])


# The ends of the columns of a joint, by its type: free, ball, slide, hinge.
AXES, QUATERNION, TURNING = ["_x", "_y", "_z"], ["_qw", "_qx", "_qy", "_qz"], ["_rx", "_ry", "_rz"]
PARTS_OF_JOINTS = {
    "joint_positions": [AXES + QUATERNION, QUATERNION, [""], [""]],
    "joint_velocities": [AXES + TURNING, TURNING, [""], [""]],
}


def site_orientation(data, site):
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, data.site_xmat[site])
    return upright(quaternion)


def normal_forces(model, data, links):
    """For each link, a set of geoms and flexes, the sum of the normal forces of all its contacts."""
    forces, wrench = np.zeros(len(links)), np.zeros(6)
    for index in range(data.ncon):
        mujoco.mj_contactForce(model, data, index, wrench)
        contact = data.contact[index]
        touching = {(GEOM, geom) for geom in contact.geom.tolist()} | {(FLEX, flex) for flex in contact.flex.tolist()}
        for link, parts in enumerate(links):
            if touching & parts:
                forces[link] += wrench[0]
    return forces


def links_of(model, patterns):
    """The names and the parts of the links whose contacts are sensed: geoms or, if none matches, bodies or flexes."""
    for kind in (GEOM, FLEX):
        found = matching(model, kind, patterns)
        if found and (kind == GEOM or not matching(model, BODY, patterns)):
            return [mujoco.mj_id2name(model, kind, index) for index in found], [{(kind, index)} for index in found]
    bodies = matching(model, BODY, patterns)
    of_body = [{(GEOM, geom) for geom in np.flatnonzero(model.geom_bodyid == body).tolist()} for body in bodies]
    return [model.body(body).name for body in bodies], of_body


def columns_of(names):
    """The ends of the columns of these elements: in lower case, with `_` for other characters, or else numbers."""
    ends = [re.sub("[^a-z0-9]", "_", name.lower()) for name in names]
    return ends if len(set(ends)) == len(ends) else [str(index) for index in range(len(ends))]


def reader(model, sensing):
    """Returns a modality's source, the ends of its columns, and a function that reads its values after `mj_forward`."""
    places, turns = ["_x", "_y", "_z"], ["_w", "_x", "_y", "_z"]
    sources = {
        "body_positions": (BODY, places, lambda data, body: data.xpos[body]),
        "body_orientations": (BODY, turns, lambda data, body: upright(data.xquat[body])),
        "site_positions": (SITE, places, lambda data, site: data.site_xpos[site]),
        "site_orientations": (SITE, turns, site_orientation),
        "joint_positions": (JOINT, None, lambda data, joint: joint_position(data.joint(joint).qpos)),
        "joint_velocities": (JOINT, None, lambda data, joint: data.joint(joint).qvel),
    }
    for source, (kind, parts, value) in sources.items():
        if source in sensing:
            found = matching(model, kind, sensing[source])
            ends = columns_of([mujoco.mj_id2name(model, kind, index) for index in found])
            of_joint = PARTS_OF_JOINTS[source] if kind == JOINT else None
            columns = [
                end + part
                for end, index in zip(ends, found)
                for part in (of_joint[model.jnt_type[index]] if of_joint else parts)
            ]
            return source, columns, lambda data: np.concatenate([value(data, index) for index in found])
    if "sensor" in sensing:
        found = [model.sensor(index) for index in matching(model, SENSOR, sensing["sensor"])]
        sizes = [sensor.dim[0] for sensor in found]
        parts = [[""] if size == 1 else [f"_{part}" for part in range(size)] for size in sizes]
        columns = columns_of([sensor.name + part for sensor, own in zip(found, parts) for part in own])
        return "sensor", columns, lambda data: np.concatenate([data.sensor(sensor.id).data for sensor in found])
    names, links = links_of(model, sensing["normal_force"])
    return "normal_force", columns_of(names), lambda data: normal_forces(model, data, links)


def drive(model, driven):
    """Returns a function that applies a setpoint: to actuators, or to coordinates of mocap bodies."""
    mocaps = {place: own for place, own in enumerate(driven.values()) if "mocap" in own}
    moved = {
        place: (model.body(own["mocap"]).mocapid[0], "xyz".index(own["axis"])) for place, own in mocaps.items()
    }
    names = {place: own.get("actuator") or name for place, (name, own) in enumerate(driven.items())}
    actuators = {place: model.actuator(name).id for place, name in names.items() if place not in mocaps}
    controls = {place: model.actuator_ctrladr[actuator] for place, actuator in actuators.items()}

    def apply(data, setpoint):
        for place, control in controls.items():
            data.ctrl[control] = setpoint[place]
        for place, (body, axis) in moved.items():
            data.mocap_pos[body, axis] = setpoint[place]

    return apply


def states(model, start, controls, apply):
    """Simulates an episode, and yields the state before each step with all quantities that follow from it."""
    data, instant = mujoco.MjData(model), mujoco.MjData(model)
    whole = mujoco.mjtState.mjSTATE_INTEGRATION
    state = np.zeros(mujoco.mj_stateSize(model, whole))
    data.qpos[:] = start[: model.nq]
    for control in controls:
        apply(data, control)
        mujoco.mj_getState(model, data, state, whole)
        mujoco.mj_setState(model, instant, state, whole)
        mujoco.mj_forward(model, instant)
        yield instant
        mujoco.mj_step(model, data)


class Comparison:
    """The recorded and the computed values of one modality in all episodes."""

    def __init__(self, source, tolerance):
        self.source, self.tolerance = source, tolerance
        self.recorded, self.computed = [], []

    def add(self, recorded, computed):
        self.recorded.append(recorded)
        self.computed.append(np.asarray(computed))

    def report(self, name):
        """Returns a line, and whether all values agree."""
        recorded, computed = np.concatenate(self.recorded), np.concatenate(self.computed)
        if recorded.shape != computed.shape:
            return f"{name}: {recorded.shape} values instead of {computed.shape}", False
        difference = np.abs(recorded.astype(float) - computed)
        if self.tolerance is None:
            allowed = COLOR_TOLERANCE
        else:
            allowed = self.tolerance * max(1.0, np.abs(computed).max(initial=0.0))
        values = int(np.prod(computed.shape[1:]))
        varying = int(np.count_nonzero(np.ptp(computed, axis=0)))
        worst = difference.max(initial=0.0)
        line = f"{name}: {self.source}, {values} values, {varying} vary, differ by {worst:.3g}"
        if worst <= allowed:
            return line, True
        places = np.argwhere(difference > allowed)
        first = tuple(places[0].tolist())
        return f"{line}; {len(places)} differ, first {recorded[first]} instead of {computed[first]} at {first}", False


def main(model_path, world_path, dataset, starts_path, controls_path, steps_per_sample):
    model = mujoco.MjModel.from_xml_path(model_path)
    world = json.loads(Path(world_path).read_text())
    files = sorted(Path(dataset).glob("episode_*.parquet"))
    driven = world["action"]["actuators"]
    apply = drive(model, driven)
    starts = np.fromfile(starts_path, "<f8").reshape(len(files), -1)
    controls = np.fromfile(controls_path, "<f8").reshape(len(files), -1, len(driven))

    vectors, means, cameras = {}, {}, {}
    compared = {"time": Comparison("time", TOLERANCE), "setpoint": Comparison("controls", TOLERANCE)}
    columns = {"time": ["time"], "setpoint": [f"setpoint_{name}" for name in driven]}
    for name, sensing in world["modalities"].items():
        if "camera" in sensing:
            cameras[name] = sensing["camera"], mujoco.Renderer(model, *sensing["size"])
            compared[name] = Comparison("camera", None)
        elif "difference_of" not in sensing:  # not recorded: samples are subtracted when they are read
            source, ends, read = reader(model, sensing)
            (means if "average_over" in sensing else vectors)[name] = read
            compared[name] = Comparison(source, TOLERANCE)
            columns[name] = [f"{name}_{end}" for end in ends]

    left_over = set()
    for file, start, control in zip(files, starts, controls):
        computed, since = {name: [] for name in compared}, {name: [] for name in means}
        for step, instant in enumerate(states(model, start, control, apply)):
            for name, read in means.items():
                since[name].append(read(instant))
            if step % int(steps_per_sample):
                continue
            computed["time"].append([instant.time])
            computed["setpoint"].append(control[step])
            for name, read in vectors.items():
                computed[name].append(read(instant))
            for name, values in since.items():
                computed[name].append(np.mean(values, axis=0))
                since[name] = []
            for name, (camera, renderer) in cameras.items():
                renderer.update_scene(instant, camera=camera)
                computed[name].append(renderer.render())
        table = parquet.read_table(file)
        for name, own in columns.items():
            compared[name].add(np.stack([table[column].to_numpy() for column in own], axis=1), computed[name])
        for name in cameras:
            frames = [np.frombuffer(frame.as_py(), np.uint8) for frame in table[name]]
            compared[name].add(np.stack(frames).reshape(np.shape(computed[name])), computed[name])
        known = PLACE.union(cameras, *columns.values())
        left_over |= set(table.column_names) - known

    reports = [comparison.report(name) for name, comparison in compared.items()]
    for line, _ in reports:
        print(line)
    if left_over:
        print(f"not compared: {', '.join(sorted(left_over))}")
    sys.exit(0 if files and not left_over and all(agrees for _, agrees in reports) else 1)


if __name__ == "__main__":
    main(*sys.argv[1:])
