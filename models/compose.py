"""Composes the models of the worlds with PyMJCF and writes them as plain MJCF.

    python models/compose.py           # writes models/empty.xml, cluttered.xml and so on
    python models/compose.py --check   # writes nothing; exit 1 and a diff where the files differ

All values are in SI units, angles in radians. models/README.md gives the reason for each value.
"""

import argparse
import difflib
import math
import pathlib
import sys

from dm_control import mjcf
from lxml import etree

SCENES = ("empty", "cluttered", "crowded", "crowded_moving", "wrist", "tendon", "twelve")
CROWDED = ("crowded", "crowded_moving")
PRECISION = 9  # significant digits in the files
HERE = pathlib.Path(__file__).resolve().parent

# Finger: 20 equal links and joints with alternating axes, as in the paper. The paper gives no other numbers.
JOINTS = 20
FEWER_JOINTS = 12  # of the scene `twelve`, an example for robots of other sizes
LINK_LENGTH = 0.05  # m, from hinge to hinge: a finger of 1 m, on the scale of the paper's strokes
LINK_RADIUS = 0.045  # m, a link is 2 to 3 pixels of a 64 x 64 frame wide
LINK_MASS = 0.01  # kg, 31 kg/m3: soft foam
JOINT_STIFFNESS = 20.0  # N m/rad
JOINT_DAMPING = 3.0  # N m s/rad, with which the released finger settles fastest (0.28 s)
JOINT_ARMATURE = 1e-3  # kg m2, keeps the explicit integration of the joint springs stable at 1 kHz
JOINT_RANGE = math.radians(60)  # rad, to either side
FINGER_FRICTION = 0.8  # sliding, as of rubber on a floor
# Stiff, so that links do not sink into what they touch, and overdamped, so that they do not bounce: time constant (s) and
# damping ratio. The impedance is MuJoCo's default.
FINGER_SOLREF = (0.003, 1.5)

# Arm: cylindrical (rotation, lift, extension). The ranges are the paper's.
ROTATION_RANGE = (0.75 * math.pi, 1.25 * math.pi)  # rad
LIFT_RANGE = (-1.0, 0.0)  # m
EXTENSION_RANGE = (0.0, 1.5)  # m
ROTATION_REST = math.pi  # rad, the middle of the range: the arm points along -x
MOUNT_RADIUS = 0.7  # m, from the shaft to the finger at extension 0
TIP_HEIGHT = 0.5  # m, of the hanging finger's end at lift 0
FEWER_TIP_HEIGHT = 0.6  # m, of the scene `twelve`
SHAFT_MASS = 5.0  # kg
CARRIAGE_MASS = 2.0  # kg
BEAM_MASS = 1.0  # kg
# Position gains, kp = m w^2 and kv = 2 m w: critically damped at w = 300 rad/s, with m the inertia or mass that the
# joint moves (3.3 kg m2 at full extension, 3.2 kg, 1.2 kg). The arm follows its setpoint with a lag of kv / kp = 7 ms.
ROTATION_GAINS = (3e5, 2e3)  # N m/rad, N m s/rad
LIFT_GAINS = (3e5, 2e3)  # N/m, N s/m
EXTENSION_GAINS = (1.2e5, 800)  # N/m, N s/m
# The limit makes the arm give way where the finger can't bend further, as a robot does that may touch people. The
# damping keeps the arm from overshooting when the finger comes free.
ARM_LIMIT = 60.0  # N, N m
ARM_DAMPING = 20.0  # N s/m, N m s/rad

# Boxes of the cluttered scene.
BOX_SIZE = (0.30, 0.30, 0.40)  # m, full side lengths
BOX_MASS = 1.0  # kg
BOX_FRICTION = 0.5  # sliding, against the ground and each other
BOX_PARKING = [(radius, math.radians(angle)) for radius in (1.05, 1.75) for angle in (147, 169, 191, 213)]

# Pillars of the crowded scenes, which the finger presses on from above.
PILLAR_RADIUS = 0.18  # m
PILLAR_HEIGHTS = (0.21, 0.25, 0.29, 0.33, 0.37, 0.41, 0.45)  # m, below the tip of the lifted finger (0.5 m)
PILLAR_DENSITY = 2400  # kg/m3, concrete: the finger can't move them
LIGHT_PILLAR_DENSITY = 15  # kg/m3, polystyrene foam, in crowded_moving: 0.3 to 0.7 kg, so the finger moves some of them
PILLAR_PARKING = [(x, y) for x in (-1.02, -1.43) for y in (-0.41, 0, 0.41)] + [(-1.84, 0)]  # m

TIMESTEP = 1e-3  # s

CAMERA_POSITION = (-3.8, -2.55, 3.55)  # m
CAMERA_TARGET = (-0.79, 0.44, 0.0)  # m
CAMERA_FOVY = 34  # degrees
# The crowded scenes' camera is steeper and sees a smaller part of the ground, so that the pillars' tops are large.
CROWDED_CAMERA_POSITION = (-3.7, -2.1, 4.4)  # m
CROWDED_CAMERA_TARGET = (-1.22, 0.05, 0.4)  # m
CROWDED_CAMERA_FOVY = 27  # degrees

# The wrist's camera is mounted on the beam, behind the finger. It looks down along the finger to the contacts.
WRIST_POSITION = (-0.45, 0.0, -0.05)  # m, relative to the finger's mount
WRIST_TARGET = (0.08, 0.0, -0.85)  # m, relative to the finger's mount
WRIST_FOVY = 50  # degrees

# Tendons run along the finger's surface, from the mount to the last link. A force of 100 N on a tendon bends each joint
# of its direction by 100 N x 0.045 m / 20 N m/rad = 0.23 rad.
TENDONS = {"front": (1, 0), "back": (-1, 0), "left": (0, 1), "right": (0, -1)}
TENDON_FORCE = (0.0, 100.0)  # N
# Tendons and sites of this group are not drawn, so that images show the same finger as without them and take no longer.
HIDDEN = 3

# m, the visible ground. For collisions the ground is infinite. With a visible infinite ground, a frame takes 3 times as
# long.
GROUND_SIDE = 20.0

# Collision bits: the finger collides with the ground, the boxes and the column, but not with itself. The arm's moving
# parts collide with nothing.
FINGER_BIT, BOX_BIT = 1, 2

GROUND_RGBA = (0.85, 0.85, 0.82, 1)
ARM_RGBA = (0.25, 0.28, 0.33, 1)
BASE_RGB, TIP_RGB = (1.0, 0.75, 0.0), (0.85, 0.0, 0.35)  # the finger's color changes linearly from base to tip
ODD_LINK_SHADE = 0.85  # odd links are darker, so that links are visible in a large picture
BOX_RGBA = ((0.30, 0.50, 1.0, 1), (0.20, 0.75, 0.65, 1))  # of even and odd boxes
LOW_RGB, HIGH_RGB = (0.10, 0.15, 0.55), (0.35, 0.95, 1.0)  # the pillars' color changes linearly with the height


def finger(mount, joints=JOINTS, tendons=False):
    """Adds the finger below the body `mount`: a chain of links along -z with one hinge each.

    Even joints turn about the arm's tangent, so the finger bends along the arm (flexion/extension). Odd joints turn
    about the arm's axis, so the finger bends sideways (adduction/abduction).
    """
    defaults = mount.root.default.add("default", dclass="finger")
    defaults.joint.set_attributes(
        stiffness=JOINT_STIFFNESS,
        damping=JOINT_DAMPING,
        armature=JOINT_ARMATURE,
        range=(-JOINT_RANGE, JOINT_RANGE),
    )
    defaults.geom.set_attributes(
        type="capsule",
        fromto=(0, 0, 0, 0, 0, -LINK_LENGTH),
        size=[LINK_RADIUS],
        mass=LINK_MASS,
        priority=1,  # contacts use the finger's friction and stiffness, not those of the other body
        friction=[FINGER_FRICTION],
        solref=FINGER_SOLREF,
        contype=FINGER_BIT,
        conaffinity=0,
    )
    paths = {name: [] for name in TENDONS} if tendons else {}
    guide(mount, "mount", 0, paths)
    parent = mount
    for link in range(joints):
        body = parent.add("body", name=f"finger_link_{link:02}")
        if link == 0:
            body.childclass = "finger"
        else:
            body.pos = (0, 0, -LINK_LENGTH)
        body.add("joint", name=f"finger_joint_{link:02}", axis=(1, 0, 0) if link % 2 else (0, 1, 0))
        body.add("geom", name=f"finger_link_{link:02}", rgba=link_rgba(link, joints))
        guide(body, f"link_{link:02}", -LINK_LENGTH / 2, paths)
        parent = body
    for name, sites in paths.items():
        tendon = mount.root.tendon.add("spatial", name=f"tendon_{name}", group=HIDDEN)
        for site in sites:
            tendon.add("site", site=site)
        # A positive control pulls.
        mount.root.actuator.add("motor", name=f"tendon_{name}", tendon=tendon, gear=[-1], ctrlrange=TENDON_FORCE)


def guide(body, name, height, paths):
    """Adds a site on the finger's surface for each tendon."""
    for tendon, (x, y) in TENDONS.items():
        if tendon in paths:
            place = (LINK_RADIUS * x, LINK_RADIUS * y, height)
            paths[tendon].append(body.add("site", name=f"{tendon}_{name}", pos=place, size=[0.001], group=HIDDEN))


def link_rgba(link, joints=JOINTS):
    """Returns the color of a link by its place along the finger. Odd links are darker."""
    place = link / (joints - 1)
    shade = ODD_LINK_SHADE if link % 2 else 1
    return [shade * ((1 - place) * base + place * tip) for base, tip in zip(BASE_RGB, TIP_RGB)] + [1]


def arm(world, height):
    """Adds the arm with its actuators at the world's origin. Returns the beam, to which the finger is mounted at `height`.

    In the rest pose the arm points along -x, with rotation `ROTATION_REST`, lift 0 and extension 0.
    """
    defaults = world.root.default.add("default", dclass="arm")
    defaults.geom.set_attributes(rgba=ARM_RGBA, contype=0, conaffinity=0)
    defaults.joint.damping = [ARM_DAMPING]
    world.add(
        "geom",
        name="arm_column",
        dclass="arm",
        type="cylinder",
        size=(0.12, 0.15),
        pos=(0, 0, 0.15),
        conaffinity=FINGER_BIT | BOX_BIT,
    )
    shaft = world.add("body", name="arm_shaft", childclass="arm", euler=(0, 0, ROTATION_REST), gravcomp=1)
    shaft.add("joint", name="arm_rotation", type="hinge", axis=(0, 0, 1), ref=ROTATION_REST)
    shaft.add("geom", name="arm_shaft", type="cylinder", size=(0.05, 0.7), pos=(0, 0, 1.0), mass=SHAFT_MASS)
    carriage = shaft.add("body", name="arm_carriage", pos=(0, 0, height), gravcomp=1)
    carriage.add("joint", name="arm_lift", type="slide", axis=(0, 0, 1))
    carriage.add("geom", name="arm_carriage", type="box", size=(0.12, 0.09, 0.09), mass=CARRIAGE_MASS)
    # Only visual: covers the beam's rear end at full extension.
    carriage.add("geom", name="arm_sleeve", type="box", size=(0.27, 0.035, 0.035), pos=(0.37, 0, 0), mass=0)
    beam = carriage.add("body", name="arm_beam", pos=(MOUNT_RADIUS, 0, 0), gravcomp=1)
    beam.add("joint", name="arm_extension", type="slide", axis=(1, 0, 0))
    beam.add("geom", name="arm_beam", type="box", size=(0.8, 0.025, 0.025), pos=(-0.8, 0, 0), mass=BEAM_MASS)

    actuators = world.root.actuator
    for joint, gains, ctrlrange in (
        ("arm_rotation", ROTATION_GAINS, ROTATION_RANGE),
        ("arm_lift", LIFT_GAINS, LIFT_RANGE),
        ("arm_extension", EXTENSION_GAINS, EXTENSION_RANGE),
    ):
        kp, kv = gains
        limits = {"ctrlrange": ctrlrange, "forcerange": (-ARM_LIMIT, ARM_LIMIT)}
        actuators.add("position", name=joint, joint=joint, kp=kp, kv=kv, **limits)
    return beam


def boxes(world):
    """Adds the movable boxes on two arcs in the sector that the arm sweeps."""
    defaults = world.root.default.add("default", dclass="box")
    defaults.geom.set_attributes(
        type="box",
        size=[side / 2 for side in BOX_SIZE],
        mass=BOX_MASS,
        friction=[BOX_FRICTION],
        contype=BOX_BIT,
        conaffinity=FINGER_BIT | BOX_BIT,
    )
    for index, (radius, angle) in enumerate(BOX_PARKING):
        body = world.add(
            "body",
            name=f"box_{index}",
            childclass="box",
            pos=(radius * math.cos(angle), radius * math.sin(angle), BOX_SIZE[2] / 2),
            euler=(0, 0, angle),
        )
        body.add("freejoint", name=f"box_{index}")
        body.add("geom", name=f"box_{index}", rgba=BOX_RGBA[index % 2])


def pillars(world, density):
    """Adds pillars of a `density` (kg/m3), each of its own height and color, in two rows and one behind."""
    defaults = world.root.default.add("default", dclass="pillar")
    defaults.geom.set_attributes(
        type="cylinder",
        density=density,
        friction=[BOX_FRICTION],
        contype=BOX_BIT,
        conaffinity=FINGER_BIT | BOX_BIT,
    )
    last = len(PILLAR_HEIGHTS) - 1
    for index, (height, (x, y)) in enumerate(zip(PILLAR_HEIGHTS, PILLAR_PARKING, strict=True)):
        name = f"pillar_{index}"
        body = world.add("body", name=name, childclass="pillar", pos=(x, y, height / 2))
        body.add("freejoint", name=name)
        rgb = [low + (high - low) * index / last for low, high in zip(LOW_RGB, HIGH_RGB)]
        body.add("geom", name=name, size=(PILLAR_RADIUS, height / 2), rgba=(*rgb, 1))


def scene(name):
    """Returns a scene, one of `SCENES`, as a PyMJCF model."""
    root = mjcf.RootElement(model=name)
    root.compiler.set_attributes(angle="radian", autolimits=True)
    # Elliptic cones, because the force peaks of a finger that is about to buckle are 1.5 times as high with pyramidal cones.
    root.option.set_attributes(timestep=TIMESTEP, integrator="implicitfast", cone="elliptic")
    # The rendering time of a small frame depends on vertices, shadows and MSAA. For larger pictures the program sets
    # the usual quality and buffer size before it makes the renderer. The light then casts shadows too.
    root.visual.quality.set_attributes(shadowsize=0, offsamples=0, numslices=12, numstacks=6, numquads=1)
    getattr(root.visual, "global").set_attributes(offwidth=64, offheight=64)

    world = root.worldbody
    world.add("light", name="sun", type="directional", pos=(-2, 1, 4), dir=(0.4, -0.25, -1))
    position, target, fovy = CAMERA_POSITION, CAMERA_TARGET, CAMERA_FOVY
    if name in CROWDED:
        position, target, fovy = CROWDED_CAMERA_POSITION, CROWDED_CAMERA_TARGET, CROWDED_CAMERA_FOVY
    world.add("camera", name="external", pos=position, xyaxes=look_at(position, target), fovy=fovy)
    world.add(
        "geom",
        name="ground",
        type="plane",
        size=(GROUND_SIDE / 2, GROUND_SIDE / 2, 1),
        rgba=GROUND_RGBA,
        friction=[BOX_FRICTION],
        contype=0,
        conaffinity=FINGER_BIT | BOX_BIT,
    )
    joints, tip = (FEWER_JOINTS, FEWER_TIP_HEIGHT) if name == "twelve" else (JOINTS, TIP_HEIGHT)
    beam = arm(world, tip + joints * LINK_LENGTH)
    finger(beam, joints, tendons=name == "tendon")
    axes = look_at(WRIST_POSITION, WRIST_TARGET)
    beam.add("camera", name="wrist", pos=WRIST_POSITION, xyaxes=axes, fovy=WRIST_FOVY)
    if name in ("cluttered", "wrist", *CROWDED):
        root.option.flag.sleep = "enable"  # objects at rest take no time; the actuated arm never sleeps
    if name in ("cluttered", "wrist"):
        boxes(world)
    if name in CROWDED:
        pillars(world, PILLAR_DENSITY if name == "crowded" else LIGHT_PILLAR_DENSITY)
    pulled = [0] * (len(TENDONS) if name == "tendon" else 0)
    root.keyframe.add("key", name="rest", ctrl=[ROTATION_REST, 0, 0, *pulled])
    return root


def look_at(position, target):
    """Returns `xyaxes` of a camera at `position` (m) that looks at `target` (m), with the world's z upwards."""
    dx, dy, dz = (t - p for t, p in zip(target, position))
    flat = math.hypot(dx, dy)
    length = math.hypot(flat, dz)
    right = (dy / flat, -dx / flat, 0)
    up = (-dz * dx / flat / length, -dz * dy / flat / length, flat / length)
    return right + up


def to_mjcf(root):
    """Returns the model as plain MJCF text, without the root class `/` that PyMJCF adds around all defaults."""
    tree = root.to_xml(precision=PRECISION)
    for element in tree.iter():
        if element.get("class") == "/":
            del element.attrib["class"]
    defaults = tree.find("default")
    (wrapper,) = defaults
    defaults[:] = list(wrapper)
    etree.indent(tree)
    comment = "<!-- Written by models/compose.py; edit that, and see models/README.md for every value. -->\n"
    return comment + etree.tostring(tree, encoding="unicode") + "\n"


def difference(path, text):
    """Returns a unified diff from the file at `path` to `text`, empty if they agree. A missing file counts as empty."""
    checked_in = path.read_text() if path.exists() else ""
    lines = difflib.unified_diff(
        checked_in.splitlines(keepends=True),
        text.splitlines(keepends=True),
        str(path),
        f"compose.py's {path.name}",
    )
    return "".join(lines)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--check", action="store_true", help="write nothing; exit 1 with a diff where files differ"
    )
    check = parser.parse_args().check

    differs = False
    for name in SCENES:
        path = HERE / f"{name}.xml"
        text = to_mjcf(scene(name))
        if check:
            diff = difference(path, text)
            sys.stdout.write(diff)
            differs |= bool(diff)
        else:
            path.write_text(text)
    return 1 if differs else 0


if __name__ == "__main__":
    sys.exit(main())
