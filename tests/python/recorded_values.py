"""Compares the values that the harness recorded with those that Python's `mujoco` computes at the same states.

    recorded_values.py FOLDER...

Each FOLDER has a file `comparison.json`: the path of the `model`, the `world` file as JSON, the folder of the
`dataset`, the `factors` that are on, what the episodes have `drawn`, and `steps_per_sample`. Its file `controls.f64`
has the setpoints of each step of the episodes, for the elements of the action, as little-endian 64-bit floats.

A dataset does not hold the whole state: that of free and ball joints, of soft bodies and of muscles is missing.
So each episode is simulated again from the start that docs/world-files.md describes, and each value is computed by
`mj_forward` on a copy of the state before the step. The recorded joint angles and velocities show that the states are
those of the recording.

Prints for each modality its source, how many values a sample has, how many of them vary, how many were compared, and
the largest difference, relative to values above 1. A line `agrees: FOLDER` or `differs: FOLDER` follows. Exits with 1
if a value differs or a recorded column was not compared.
"""

import copy
import csv
import fnmatch
import json
import os
import re
import sys
import traceback
from pathlib import Path

os.environ["MUJOCO_GL"] = "egl"  # the harness renders with EGL

import mujoco
import numpy as np
import pyarrow.parquet as parquet

GEOM, BODY, SITE, JOINT, SENSOR, FLEX, ACTUATOR, CAMERA, KEY = (
    getattr(mujoco.mjtObj, f"mjOBJ_{kind}")
    for kind in ("GEOM", "BODY", "SITE", "JOINT", "SENSOR", "FLEX", "ACTUATOR", "CAMERA", "KEY")
)
# The word for each kind of objects, and the attribute that has their number.
KINDS = {
    GEOM: ("geom", "ngeom"), BODY: ("body", "nbody"), SITE: ("site", "nsite"), JOINT: ("joint", "njnt"),
    SENSOR: ("sensor", "nsensor"), FLEX: ("flex", "nflex"), ACTUATOR: ("actuator", "nactuator"),
    CAMERA: ("camera", "ncam"), KEY: ("keyframe", "nkey"),
}  # fmt: skip

# Columns that no modality has.
PLACE = {"dataset", "scenario", "episode", "sample"}

# How much a value may differ, relative to values above 1. MuJoCo is the same library, and values are recorded as 32-bit
# floats.
TOLERANCE = 1e-6
# Renderers round colors differently.
COLOR_TOLERANCE = 1
# A recorded depth is rounded to a color, and the computed one is not: in the middle between two colors, a difference
# of less than 1e-3 of a color, as 32-bit depths have, decides which of them is recorded.
DEPTH_TOLERANCE = 0.5 + 1e-3


def name_of(model, kind, index):
    """The name of an object or, if it has none, its kind and its number; empty if another object has that name."""
    number = f"{KINDS[kind][0]}_{index}"
    return mujoco.mj_id2name(model, kind, index) or ("" if mujoco.mj_name2id(model, kind, number) >= 0 else number)


def matching(model, kind, patterns):
    """The indices of the objects that match, in the model's order. A name that looks like a pattern is a name."""
    names = [name_of(model, kind, index) for index in range(getattr(model, KINDS[kind][1]))]

    def matches(index, name):
        has_name = bool(mujoco.mj_id2name(model, kind, index))
        return any(name == p or has_name and p not in names and fnmatch.fnmatchcase(name, p) for p in patterns)

    return [index for index, name in enumerate(names) if name and matches(index, name)]


def find(model, kind, name):
    """The index of an object."""
    return matching(model, kind, [name])[0]


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


class Contacts:
    """The contacts of an instant: the two sides, each a geom or a flex, and the normal force.

    MuJoCo does not compute the contacts of bodies while they sleep. They keep the force that it computed when the
    bodies fell asleep or, if the model starts them asleep, the one that they would have awake.
    """

    def __init__(self, model, data):
        self.model, self.resting = model, []
        self.can_sleep = bool(model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP)
        if self.can_sleep and (data.tree_asleep >= 0).any():
            awake = copy.copy(model)
            awake.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
            instant, whole = mujoco.MjData(awake), mujoco.mjtState.mjSTATE_INTEGRATION
            state = np.zeros(mujoco.mj_stateSize(model, whole))
            mujoco.mj_getState(model, data, state, whole)
            mujoco.mj_setState(awake, instant, state, whole)
            instant.qvel[:] = 0
            mujoco.mj_forward(awake, instant)
            self.resting = self.asleep_in(instant, data)
        self.found = []

    def update(self, instant):
        """Finds the contacts of an instant, after `mj_forward`."""
        self.resting = [found for found in self.resting if self.sleeps(found, instant)]
        self.found = self.resting + self.computed(instant)

    def fall_asleep(self, data):
        """Keeps the contacts of bodies that a step, after which `data` is, let fall asleep."""
        if self.can_sleep:
            self.resting += self.asleep_in(data, data)

    def computed(self, data):
        """The sides, the force, the bodies that touch, and the normal from the first side to the second, of each
        contact."""
        return [
            (self.sides(each), self.normal_force(data, index), self.bodies(each), each.frame[:3].copy())
            for index, each in enumerate(data.contact)
        ]

    def asleep_in(self, data, sleeping):
        return [found for found in self.computed(data) if self.sleeps(found, sleeping)]

    def bodies(self, contact):
        """The bodies of geoms, and of the vertices of flexes, that touch in a contact."""
        model, found = self.model, []
        for geom, flex, element, vertex in zip(contact.geom, contact.flex, contact.elem, contact.vert):
            if geom >= 0:
                found.append(model.geom_bodyid[geom])
                continue
            size = model.flex_dim[flex] + 1
            start = model.flex_elemdataadr[flex] + element * size
            vertices = [vertex] if vertex >= 0 else model.flex_elem[start : start + size]
            found += [model.flex_vertbodyid[model.flex_vertadr[flex] + each] for each in vertices]
        return found

    def sleeps(self, found, data):
        """Whether a body that touches belongs to a kinematic tree that sleeps."""
        trees = [self.model.body_treeid[body] for body in found[2]]
        return any(tree >= 0 and data.tree_asleep[tree] >= 0 for tree in trees)

    @staticmethod
    def sides(contact):
        pairs = zip(contact.geom.tolist(), contact.flex.tolist())
        return tuple((GEOM, geom) if geom >= 0 else (FLEX, flex) for geom, flex in pairs)

    def normal_force(self, data, index):
        wrench = np.zeros(6)
        mujoco.mj_contactForce(self.model, data, index, wrench)
        return wrench[0]

    def forces(self, links):
        """For each link, a set of geoms and flexes, the sum of the normal forces of all its contacts."""
        on = [[force for sides, force, *_ in self.found if parts.intersection(sides)] for parts in links]
        return np.array([sum(forces) for forces in on], float)

    def kinds(self, links, kinds):
        """For each link, the sums of the forces of contacts by kind, a set of geoms, `[links, kinds + 2]`. The first
        column is 0, and the last is of contacts of no kind."""
        sums = np.zeros((len(links), len(kinds) + 2))
        for parts, own in zip(links, sums):
            for sides, force, *_ in self.found:
                if not parts.intersection(sides):
                    continue
                other = sides[1] if sides[0] in parts else sides[0]
                own[next((kind for kind, geoms in enumerate(kinds, 1) if other in geoms), len(kinds) + 1)] += force
        return sums

    def normals(self, links, frames):
        """For each link, the direction of the sum of the normal forces on it in the frame of a body, given by its axes."""
        directions = []
        for parts, axes in zip(links, frames):
            on = [(sides, force * normal) for sides, force, _, normal in self.found if parts.intersection(sides)]
            push = sum((-push if sides[0] in parts else push for sides, push in on), np.zeros(3))
            directions.append(axes.T @ push / (np.linalg.norm(push) or 1))
        return np.concatenate(directions)


def largest(sums):
    """The kind of each link with the largest sum. The sum is negative where adhesion pulls. Of equal sums, the later
    kind counts."""
    sums = np.abs(sums)
    last = sums.shape[1] - 1 - np.argmax(sums[:, ::-1], axis=1)
    return np.where(sums.max(axis=1) > 0, last, 0).astype(float)


def links_of(model, patterns):
    """The names and the parts of what is touched: geoms or, if none matches, bodies or flexes."""
    for kind in (GEOM, FLEX):
        found = matching(model, kind, patterns)
        if found and (kind == GEOM or not model.body_geomnum[matching(model, BODY, patterns)].any()):
            return [name_of(model, kind, index) for index in found], [{(kind, index)} for index in found]
    bodies = matching(model, BODY, patterns)
    of_body = [{(GEOM, geom) for geom in np.flatnonzero(model.geom_bodyid == body).tolist()} for body in bodies]
    return [name_of(model, BODY, body) for body in bodies], of_body


def columns_of(names, patterns=()):
    """The ends of the columns of these elements: what follows the fixed start of a single pattern, or else the whole
    names, in lower case, with `_` for other characters; or else numbers."""
    is_pattern = len(patterns) == 1 and patterns[0] not in names
    start = re.split(r"[*?\[]", patterns[0])[0] if is_pattern else ""
    for prefix in (start, ""):
        ends = [re.sub("[^a-z0-9]", "_", name.removeprefix(prefix).lower()) for name in names]
        if len(set(ends)) == len(ends) and all(ends):
            return ends
    return [str(index) for index in range(len(names))]


def seen_from(data, body, place, turn):
    """A pose in the frame of a body."""
    origin, back = np.zeros(3), np.zeros(4)
    mujoco.mju_negPose(origin, back, data.xpos[body], data.xquat[body])
    local, turned = np.zeros(3), np.zeros(4)
    mujoco.mju_mulPose(local, turned, origin, back, place, turn)
    return local, turned


def site_quaternion(data, site):
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, data.site_xmat[site])
    return quaternion


POSES = {
    "body_positions": (BODY, 0), "body_orientations": (BODY, 1),
    "site_positions": (SITE, 0), "site_orientations": (SITE, 1),
}  # fmt: skip


def pose(kind, part, frame):
    """Returns a function that reads a position (part 0) or an orientation (part 1) of a body or a site."""

    def read(data, index):
        if kind == BODY:
            found = data.xpos[index], data.xquat[index]
        else:
            found = data.site_xpos[index], site_quaternion(data, index)
        if frame is not None:
            found = seen_from(data, frame, *found)
        return upright(found[1]) if part else found[0].copy()

    return read


def reader(model, sensing):
    """Returns a modality's source, the ends of its columns, and a function that reads its values after `mj_forward`."""
    source = next(key for key in sensing if key in ("sensor", "normal_force", "contact_normal", *POSES, *PARTS_OF_JOINTS))
    patterns = sensing[source]
    if source in POSES:
        kind, part = POSES[source]
        frame = find(model, BODY, sensing["relative_to"]) if sensing.get("relative_to") else None
        found, value = matching(model, kind, patterns), pose(kind, part, frame)
        ends = columns_of([name_of(model, kind, index) for index in found], patterns)
        columns = [end + axis for end in ends for axis in (["_w", "_x", "_y", "_z"] if part else ["_x", "_y", "_z"])]
        return source, columns, lambda data, contacts: np.concatenate([value(data, index) for index in found])
    if source in PARTS_OF_JOINTS:
        found = matching(model, JOINT, patterns)
        ends = columns_of([name_of(model, JOINT, index) for index in found], patterns)
        parts = PARTS_OF_JOINTS[source]
        columns = [end + part for end, index in zip(ends, found) for part in parts[model.jnt_type[index]]]
        if source == "joint_positions":
            return source, columns, lambda data, contacts: np.concatenate(
                [joint_position(data.joint(index).qpos) for index in found]
            )
        return source, columns, lambda data, contacts: np.concatenate([data.joint(index).qvel for index in found])
    if source == "sensor":
        found = [model.sensor(index) for index in matching(model, SENSOR, patterns)]
        sizes = [sensor.dim[0] for sensor in found]
        parts = [[""] if size == 1 else [f"_{part}" for part in range(size)] for size in sizes]
        ends = columns_of([name_of(model, SENSOR, sensor.id) for sensor in found], patterns)
        columns = columns_of([end + part for end, own in zip(ends, parts) for part in own])
        return source, columns, lambda data, contacts: np.concatenate([data.sensor(sensor.id).data for sensor in found])
    names, links = links_of(model, patterns)
    if source == "contact_normal":
        columns = [end + axis for end in columns_of(names, patterns) for axis in ("_x", "_y", "_z")]
        bodies = [model.geom_bodyid[min(geom for _, geom in parts)] for parts in links]
        return source, columns, lambda data, contacts: contacts.normals(
            links, [data.xmat[body].reshape(3, 3) for body in bodies]
        )
    return source, columns_of(names, patterns), lambda data, contacts: contacts.forces(links)


def kinds_reader(model, sensing):
    """Returns a function that reads the sums of a force by kind of contact."""
    _, links = links_of(model, sensing["normal_force"])
    kinds = [set().union(*links_of(model, patterns)[1]) for patterns in sensing["contact_kinds"].values()]
    return lambda data, contacts: contacts.kinds(links, kinds)


def controls_of(model, actuator):
    """The index of each control of an actuator in `ctrl`, by its name."""
    first, spec = model.actuator_ctrladr[actuator], model.actuator_ctrlspec[actuator]
    if model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_SO3:
        names = ["rx", "ry", "rz"] if model.actuator_ctrlnum[actuator] == 3 else ["qw", "qx", "qy", "qz"]
    else:
        names = [name for bit, name in ((1, "pos"), (2, "vel"), (4, "ff")) if spec & bit]
    return dict(zip(names, range(first, first + model.actuator_ctrlnum[actuator])))


# The colors of the classes of a segmentation, in their order.
CLASSES = np.array(
    [[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 0], [0, 255, 255], [255, 0, 255], [255, 255, 255]], np.uint8
)


def depths(renderer, seen, low, high):
    """An image of the depths from `low` to `high`, where something is seen. Its colors are not rounded."""
    renderer.enable_depth_rendering()
    found = renderer.render()
    renderer.disable_depth_rendering()
    red, green = (found - low) / (high - low), low / found
    image = 255 * np.clip(np.stack([red, green, np.ones_like(found)], axis=2), 0, 1)
    image[~seen] = [255, 0, 0]
    return image


def viewer(model, sensing):
    """Returns an image's source, and a function that draws it after `mj_forward`."""
    source = next(key for key in ("camera", "depth", "segmentation") if key in sensing)
    renderer, camera = mujoco.Renderer(model, *sensing["size"]), find(model, CAMERA, sensing[source])
    classes = [set().union(*links_of(model, patterns)[1]) for patterns in sensing.get("classes", {}).values()]

    def draw(data):
        renderer.update_scene(data, camera=camera)
        if source == "camera":
            return renderer.render()
        renderer.enable_segmentation_rendering()
        numbers, kinds = np.moveaxis(renderer.render(), 2, 0)
        renderer.disable_segmentation_rendering()
        if source == "depth":
            return depths(renderer, numbers >= 0, *sensing["range_m"])
        image = np.zeros((*numbers.shape, 3), np.uint8)
        for parts, color in zip(classes, CLASSES):
            for kind, number in parts:
                image[(numbers == number) & (kinds == int(kind))] = color
        return image

    return source, draw


class Action:
    """The elements of a world's action."""

    def __init__(self, model, world):
        self.model, self.elements, self.keyframe = model, world["action"]["actuators"], world.get("keyframe")
        self.controls = [self.driven(name, own) for name, own in self.elements.items()]
        # The numbers of the mocap bodies that elements move.
        moved = {name: own["mocap"] for name, own in self.elements.items() if own.get("mocap")}
        self.mocaps = {name: model.body_mocapid[find(model, BODY, body)] for name, body in moved.items()}

    def driven(self, name, own):
        """The actuators that an element drives, each with the index of its control."""
        if own.get("mocap"):
            return []
        patterns = own.get("actuators") or [own.get("actuator") or name]
        found = matching(self.model, ACTUATOR, patterns)
        if own.get("control"):
            return [(actuator, controls_of(self.model, actuator)[own["control"]]) for actuator in found]
        return [(actuator, self.model.actuator_ctrladr[actuator]) for actuator in found]

    def apply(self, data, setpoint):
        """Applies a setpoint: to actuators, or to coordinates of mocap bodies."""
        for (name, own), controls, value in zip(self.elements.items(), self.controls, setpoint):
            for _, control in controls:
                data.ctrl[control] = value
            if name in self.mocaps:
                data.mocap_pos[self.mocaps[name], "xyz".index(own["axis"])] = value

    def first(self):
        """The setpoint at the start of an episode, without a course."""
        found = []
        key = self.model.key(find(self.model, KEY, self.keyframe)) if self.keyframe else None
        for (name, own), controls in zip(self.elements.items(), self.controls):
            low, high = own["range"]
            if key is None:
                found.append({"low": low, "middle": (low + high) / 2, "high": high}[own.get("start", "middle")])
            elif name in self.mocaps:
                place = key.mpos.reshape(-1, 3)[self.mocaps[name]]
                found.append(np.clip(place["xyz".index(own["axis"])], low, high))
            else:
                found.append(np.clip(key.ctrl.ravel()[controls[0][1]], low, high))
        return np.array(found)

    def servos(self, setpoint):
        """The joints that position servos move, with their setpoints."""
        for controls, value in zip(self.controls, setpoint):
            for actuator, control in controls:
                joint = self.model.actuator_trnid[actuator, 0]
                is_first = control == self.model.actuator_ctrladr[actuator]
                if is_first and holds_position(self.model, actuator) and drives_single(self.model, actuator):
                    yield joint, value


def drives_single(model, actuator):
    """Whether an actuator drives a hinge or a slide without a gear."""
    joint = model.actuator_trnid[actuator, 0]
    return (
        model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT
        and mujoco.mjtJoint(model.jnt_type[joint]).name in ("mjJNT_HINGE", "mjJNT_SLIDE")
        and model.actuator_gear[model.actuator_outadr[actuator], 0] == 1
    )


def is_spring(model, actuator):
    """Whether the force of an actuator is proportional to the difference between a control or state and its length."""
    gain = model.actuator_gainprm[actuator, 0]
    is_affine = model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_AFFINE
    return is_affine and gain != 0 and gain == -model.actuator_biasprm[actuator, 1]


def holds_position(model, actuator):
    """Whether an actuator comes to rest where its length is its first control."""
    takes_position = model.actuator_ctrlspec[actuator] & 1
    if model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_PID:
        return takes_position and model.actuator_biasprm[actuator, 1] != 0
    if model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_DCMOTOR:
        return takes_position and model.actuator_gainprm[actuator, 4] != 0
    follows = ("mjDYN_NONE", "mjDYN_FILTER", "mjDYN_FILTEREXACT")
    return is_spring(model, actuator) and mujoco.mjtDyn(model.actuator_dyntype[actuator]).name in follows


def couple(model, data, servos):
    """Sets the joints that equalities couple to others. The joints of servos stay."""
    couplings = []
    for index in range(model.neq):
        if model.eq_type[index] != mujoco.mjtEq.mjEQ_JOINT or not model.eq_active0[index]:
            continue
        if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_EQUALITY:
            continue
        joint, other, (shift, slope, *curve) = model.eq_obj1id[index], model.eq_obj2id[index], model.eq_data[index][:5]
        if joint not in servos:
            couplings.append((joint, other, [shift, slope, *curve]))
        elif other >= 0 and other not in servos and slope != 0 and not np.any(curve):
            couplings.append((other, joint, [-shift / slope, 1 / slope, 0, 0, 0]))
    place = lambda joint: model.jnt_qposadr[joint]  # noqa: E731
    for _ in couplings:  # a joint can be coupled to one that is coupled itself
        for joint, other, polynomial in couplings:
            away = data.qpos[place(other)] - model.qpos0[place(other)] if other >= 0 else 0.0
            data.qpos[place(joint)] = model.qpos0[place(joint)] + np.polynomial.polynomial.polyval(away, polynomial)


def settle(model, data):
    """Sets the states of actuators to those that the controls lead to, or at which an integrator has no force."""
    instant = copy.copy(data)
    mujoco.mj_forward(model, instant)
    for actuator in range(model.nactuator):
        first, count = model.actuator_actadr[actuator], model.actuator_actnum[actuator]
        if count == 0 or model.actuator_ctrlnum[actuator] == 0 or model.actuator_plugin[actuator] >= 0:
            continue
        kind = mujoco.mjtDyn(model.actuator_dyntype[actuator]).name
        control, last = data.ctrl[model.actuator_ctrladr[actuator]], first + count - 1
        limits = model.actuator_actrange[actuator] if model.actuator_actlimited[actuator] else [-np.inf, np.inf]
        if kind in ("mjDYN_FILTER", "mjDYN_FILTEREXACT"):
            data.act[last] = np.clip(control, *limits)
        elif kind == "mjDYN_MUSCLE":
            data.act[last] = np.clip(control, 0, 1)
        elif kind == "mjDYN_INTEGRATOR" and (
            is_spring(model, actuator) or model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_SO3
        ):
            output, size = model.actuator_outadr[actuator], model.actuator_outnum[actuator]
            data.act[last + 1 - size : last + 1] = np.clip(instant.actuator_length[output : output + size], *limits)
        elif kind in ("mjDYN_PID", "mjDYN_DCMOTOR"):
            slew = model.actuator_dynprm[actuator, 1 if kind == "mjDYN_PID" else 7]
            if slew > 0:
                data.act[first] = np.clip(control, *limits)


def start(model, action, setpoint, offsets):
    """The state in which an episode starts."""
    data = mujoco.MjData(model)
    servos = dict(action.servos(setpoint))
    if action.keyframe:
        mujoco.mj_resetDataKeyframe(model, data, find(model, KEY, action.keyframe))
    else:
        for joint, value in servos.items():
            data.qpos[model.jnt_qposadr[joint]] = value
    for joint, offset in offsets:
        place = model.jnt_qposadr[joint]
        data.qpos[place] += offset
        if model.jnt_limited[joint]:
            data.qpos[place] = np.clip(data.qpos[place], *model.jnt_range[joint])
    if not action.keyframe:
        couple(model, data, servos)
    action.apply(data, setpoint)
    if not action.keyframe:
        settle(model, data)
    for actuator in np.flatnonzero(model.actuator_delay > 0):
        first, count = model.actuator_ctrladr[actuator], model.actuator_ctrlnum[actuator]
        samples = model.actuator_history[actuator, 0]
        mujoco.mj_initCtrlHistory(model, data, actuator, None, np.tile(data.ctrl[first : first + count], (samples, 1)))
    return data


def states(model, data, controls, apply):
    """Simulates an episode. Yields for each step the contacts, and a copy of the state before it with all quantities
    that follow from it."""
    instant, contacts = mujoco.MjData(model), Contacts(model, data)
    for control in controls:
        apply(data, control)
        mujoco.mj_copyData(instant, model, data)
        mujoco.mj_forward(model, instant)
        contacts.update(instant)
        yield instant, contacts
        mujoco.mj_step(model, data)
        contacts.fall_asleep(data)


SCALED = {
    "joint_stiffness": (JOINT, ["jnt_stiffness", "jnt_stiffnesspoly"]),
    "body_mass": (BODY, ["body_mass", "body_inertia"]),
    "actuator_strength": (ACTUATOR, ["actuator_gainprm", "actuator_biasprm"]),
}


def varied(model, factors, drawn):
    """Returns the model with the factors of variation that an episode drew, the names of their columns, and the offsets
    of joints. `drawn` has the values in the order of the columns, not rounded to 32 bits."""
    columns, offsets = [], []
    if not factors:
        return model, columns, offsets
    model = copy.deepcopy(model)
    statistics = ("meaninertia", "meanmass", "meansize", "extent", "center")
    kept = {name: np.copy(getattr(model.stat, name)) for name in statistics}
    for name, factor in factors.items():
        key = next(key for key in ("gravity", "joint_start", "joint_damping", *SCALED) if key in factor)
        kind = SCALED[key][0] if key in SCALED else BODY if key == "gravity" else JOINT
        found = matching(model, kind, factor[key])
        ends = columns_of([name_of(model, kind, index) for index in found], factor[key])
        own = [f"factors_{name}_{end}" for end in ends] if factor.get("each") else [f"factors_{name}"]
        values = np.broadcast_to(drawn[len(columns) : len(columns) + len(own)], len(found))
        columns += own
        for index, value in zip(found, values):
            if key == "gravity":
                model.opt.gravity *= value
            elif key == "joint_start":
                offsets.append((index, value))
            elif key == "joint_damping":
                dofs = model.dof_jntid == index
                model.dof_damping[dofs] *= value
                model.dof_dampingpoly[dofs] *= value
            for field in SCALED.get(key, (None, []))[1]:
                getattr(model, field)[index] *= value
    mujoco.mj_setConst(model, mujoco.MjData(model))
    for name, value in kept.items():
        if value.ndim:
            getattr(model.stat, name)[:] = value
        else:
            setattr(model.stat, name, value)
    return model, columns, offsets


class Comparison:
    """The recorded and the computed values of one modality in all episodes."""

    def __init__(self, source, tolerance, color_tolerance=COLOR_TOLERANCE):
        self.source, self.tolerance, self.color_tolerance = source, tolerance, color_tolerance
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
            allowed = self.color_tolerance
        else:
            difference /= np.maximum(1.0, np.abs(computed))
            allowed = self.tolerance
        values = int(np.prod(computed.shape[1:]))
        varying = int(np.count_nonzero(np.ptp(computed, axis=0)))
        worst = difference.max(initial=0.0)
        line = f"{name}: {self.source}, {values} values, {varying} vary, {computed.size} compared"
        line += f", differ by {worst:.3g}"
        differing = ~(difference <= allowed)
        if not differing.any():
            return line, True
        places = np.argwhere(differing)
        first = tuple(places[0].tolist())
        return f"{line}; {len(places)} differ, first {recorded[first]} instead of {computed[first]} at {first}", False


def course(folder, world, episode, steps_per_sample, steps):
    """The setpoints of each step of an episode that follows a course: linear between the rows of samples."""
    with open(folder / world["action"]["course"], encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    own = [row for row in rows if int(row.get("episode") or episode) == episode]
    values = np.array([[float(row[name]) for name in world["action"]["actuators"]] for row in own])
    before, passed = np.divmod(np.arange(steps), steps_per_sample)
    start, end = (values[np.minimum(row, len(values) - 1)] for row in (before, before + 1))
    return start + (passed / steps_per_sample)[:, None] * (end - start)


def compare(folder):
    """Compares a dataset, prints what was compared, and returns whether everything agrees."""
    given = json.loads((folder / "comparison.json").read_text())
    model = mujoco.MjModel.from_xml_path(given["model"])
    world, every = given["world"], given["steps_per_sample"]
    files = sorted(Path(given["dataset"]).glob("episode_*.parquet"))
    driven = world["action"]["actuators"]
    action = Action(model, world)
    controls = np.fromfile(folder / "controls.f64", "<f8").reshape(len(files), -1, len(driven))
    factors = {name: own for name, own in world.get("factors", {}).items() if name in given.get("factors", [])}

    vectors, means, cameras = {}, {}, {}
    compared = {"time": Comparison("time", TOLERANCE), "setpoint": Comparison("controls", TOLERANCE)}
    planned = Comparison("plan", TOLERANCE)
    columns = {"time": ["time"], "setpoint": [f"setpoint_{name}" for name in driven]}
    for name, sensing in world["modalities"].items():
        if "size" in sensing:
            source, cameras[name] = viewer(model, sensing)
            compared[name] = Comparison(source, None, DEPTH_TOLERANCE if source == "depth" else COLOR_TOLERANCE)
        elif "difference_of" not in sensing:  # not recorded: samples are subtracted when they are read
            source, ends, read = reader(model, sensing)
            is_mean = "average_over" in sensing
            if is_mean:
                means[name] = read, lambda steps: np.mean(steps, axis=0)
            else:
                vectors[name] = read
            compared[name] = Comparison(source, TOLERANCE)
            columns[name] = [f"{name}_{end}" for end in ends]
            if sensing.get("contact_kinds"):
                kinds = f"{name}_kind"
                compared[kinds], sums = Comparison("contact_kinds", TOLERANCE), kinds_reader(model, sensing)
                if is_mean:
                    means[kinds] = sums, lambda steps: largest(np.sum(steps, axis=0))
                else:
                    vectors[kinds] = lambda data, contacts, sums=sums: largest(sums(data, contacts))
                columns[kinds] = [f"{kinds}_{end}" for end in ends]

    left_over = set()
    for episode, (file, control, drawn) in enumerate(zip(files, controls, given["drawn"])):
        table = parquet.read_table(file)
        of_episode, of_factors, offsets = varied(model, factors, drawn)
        if of_factors:
            columns["factors"] = of_factors
            compared.setdefault("factors", Comparison("plan", TOLERANCE))
        own_action = Action(of_episode, world)
        data = start(of_episode, own_action, control[0], offsets)
        if world["action"].get("course"):
            planned.add(control, course(folder, world, episode, every, len(control)))
        else:
            planned.add(control[:1], action.first()[None])
        computed, since = {name: [] for name in compared}, {name: [] for name in means}
        began = data.time
        for step, (instant, contacts) in enumerate(states(of_episode, data, control, own_action.apply)):
            for name, (read, _) in means.items():
                since[name].append(read(instant, contacts))
            if step % every:
                continue
            computed["time"].append([instant.time - began])
            computed["setpoint"].append(control[step])
            for name, read in vectors.items():
                computed[name].append(read(instant, contacts))
            for name, values in since.items():
                computed[name].append(means[name][1](values))
                since[name] = []
            if of_factors:
                computed["factors"].append(drawn)
            for name, draw in cameras.items():
                computed[name].append(draw(instant))
        for name, own in columns.items():
            compared[name].add(np.stack([table[column].to_numpy() for column in own], axis=1), computed[name])
        for name in cameras:
            frames = [np.frombuffer(frame.as_py(), np.uint8) for frame in table[name]]
            compared[name].add(np.stack(frames).reshape(np.shape(computed[name])), computed[name])
        known = PLACE.union(cameras, *columns.values())
        left_over |= set(table.column_names) - known

    reports = [comparison.report(name) for name, comparison in (compared | {"motion": planned}).items()]
    for line, _ in reports:
        print(line)
    if left_over:
        print(f"not compared: {', '.join(sorted(left_over))}")
    return bool(files) and not left_over and all(agrees for _, agrees in reports)


def main(*folders):
    agree = True
    for folder in folders:
        try:
            agrees = compare(Path(folder))
        except Exception:  # other folders are still compared
            agrees = False
            traceback.print_exc(file=sys.stdout)
        print(f"{'agrees' if agrees else 'differs'}: {folder}", flush=True)
        agree &= agrees
    sys.exit(0 if agree else 1)


if __name__ == "__main__":
    main(*sys.argv[1:])
