"""Measures the values in the section "Measured" of models/README.md, and prints them as Markdown tables.

    .venv/bin/python models/measure.py             # all tables
    .venv/bin/python models/measure.py settling    # one table; --help lists all

The models in this folder are changed and simulated with MuJoCo's Python package. `rendering` depends on the machine. Of
all others, every call prints the same.

All values are in SI units, angles in radians.
"""

import argparse
import os
import pathlib
import time

os.environ.setdefault("MUJOCO_GL", "egl")
os.environ.setdefault("LP_NUM_THREADS", "0")  # Mesa then renders on the calling thread

import mujoco
import numpy as np

HERE = pathlib.Path(__file__).resolve().parent
SEED = 0  # of all random setpoints
MOVE_STEPS = 1000  # a move from one setpoint to the next takes 1 s, as in the datasets

LINKS = [f"finger_link_{link:02}" for link in range(20)]  # base to tip
JOINTS = [f"finger_joint_{joint:02}" for joint in range(20)]
LINK_END = (0, 0, -0.05)  # m, in the link's frame

MASSES = (0.01, 0.02, 0.05)  # kg, of a link
DAMPINGS = (1, 2, 2.5, 3, 3.5, 4, 6)  # N m s/rad, of a joint
BENDING_FORCE = (8, 0, 0)  # N, at the tip, along the arm
BENDING_DAMPING = 6  # N m s/rad, with which even the heaviest finger is at rest after the steps of bending
BENDING_STEPS = RELEASE_STEPS = 10_000
SETTLED = 0.05  # of the tip's deflection

CONES = {"pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL, "elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC}
CONE_MOVES = 1000

MODE_STEP = 1e-6  # rad, by which joints are moved to find the change of the forces

POSES = 100  # random poses of the arm, of which frames are rendered
RENDERING_ROUNDS = 5
LARGER = 640  # pixels, width and height of a larger buffer
FACTORS = (2, 4)  # width and height of larger frames, in those of the models' frames


def load(scene):
    """Returns the model of a scene for editing."""
    return mujoco.MjSpec.from_file(str(HERE / f"{scene}.xml"))


def at_rest(model):
    """Returns the state of the keyframe `rest`."""
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("rest").id)
    mujoco.mj_forward(model, data)
    return data


def random_setpoints(model, count):
    """Returns the arm's setpoint at rest and `count` uniformly random ones, `[count + 1, 3]`: rad, m, m."""
    low, high = model.actuator_ctrlrange.T
    drawn = np.random.default_rng(SEED).uniform(low, high, (count, model.nu))
    return np.vstack([model.key("rest").ctrl, drawn])


def move(model, data, setpoints):
    """Moves the arm from each setpoint to the next, smoothly as in the datasets. Yields after each step."""
    time = np.arange(MOVE_STEPS) / MOVE_STEPS
    for start, end in zip(setpoints, setpoints[1:]):
        for done in time**2 * (3 - 2 * time):
            data.ctrl[:] = start + done * (end - start)
            mujoco.mj_step(model, data)
            yield


def geom_forces(model, data):
    """Returns the sum of the normal forces of each geom's contacts, N, `[geoms]`."""
    forces, wrench = np.zeros(model.ngeom), np.zeros(6)
    for index, geoms in enumerate(data.contact.geom):
        mujoco.mj_contactForce(model, data, index, wrench)
        forces[geoms] += wrench[0]
    return forces


def last_link_forces(model, setpoints):
    """Returns the normal force on the last link in each step of moves that start at rest, N, `[moves, steps]`."""
    data, link = at_rest(model), model.geom(LINKS[-1]).id
    forces = [geom_forces(model, data)[link] for _ in move(model, data, setpoints)]
    return np.reshape(forces, (-1, MOVE_STEPS))


def number(value):
    """Returns a number as text: from 10 on a whole number, below it two significant digits."""
    return f"{value:.0f}" if value >= 9.95 else f"{value:#.2g}"


def percent(*shares):
    """Returns shares as text, in percent."""
    return ", ".join(number(100 * share) for share in shares) + " %"


def quantiles(forces):
    """Returns the median, the 95 % and 99 % quantiles and the maximum of forces in N, as text."""
    return ", ".join(number(force) for force in np.percentile(forces, [50, 95, 99, 100])) + " N"


def print_table(header, rows):
    """Prints a Markdown table with these cells."""
    first, *others = ("".join(f"| {cell} " if cell else "| " for cell in cells) + "|" for cells in (header, *rows))
    print(first, "|" + "---|" * len(header), *others, "", sep="\n", flush=True)


def settling():
    """Prints how fast the released finger settles with different dampings and masses."""
    own = load("empty")
    own_mass, own_damping = own.geom(LINKS[-1]).mass, own.joint(JOINTS[-1]).damping[0]
    rows = []
    for mass in MASSES:
        cells = []
        for damping in DAMPINGS:
            deflection, seconds, overshoot = release(mass, damping)
            cell = f"{seconds:.2f} ({100 * overshoot:.0f} %)"
            cells.append(f"**{cell}**" if (mass, damping) == (own_mass, own_damping) else cell)
        rows.append([f"links of {mass} kg, deflected by {deflection:.2f} m", *cells])
    print_table(["damping, N m s/rad", *map(str, DAMPINGS)], rows)


def release(mass, damping):
    """Bends the finger by a force at its tip, and releases it.

    Returns the tip's deflection in m, the time until the tip stays near its place at rest in s, and the overshoot: how
    far the tip moves against the deflection, as a share of the deflection.
    """
    spec = load("empty")
    for link in LINKS:
        spec.geom(link).mass = mass
    spec.body(LINKS[-1]).add_site(name="tip", pos=LINK_END)
    model = spec.compile()
    data, tip, body = at_rest(model), model.site("tip").id, model.body(LINKS[-1]).id
    rest = data.site_xpos[tip].copy()
    joints = [model.joint(joint).dofadr[0] for joint in JOINTS]

    model.dof_damping[joints] = BENDING_DAMPING
    for _ in range(BENDING_STEPS):
        data.qfrc_applied[:] = 0
        mujoco.mj_applyFT(model, data, BENDING_FORCE, np.zeros(3), data.site_xpos[tip], body, data.qfrc_applied)
        mujoco.mj_step(model, data)

    model.dof_damping[joints] = damping
    data.qfrc_applied[:] = 0
    places = np.empty((RELEASE_STEPS, 3))
    for step in range(RELEASE_STEPS):
        mujoco.mj_step(model, data)
        places[step] = data.site_xpos[tip]  # at the start of the step

    offsets = places - rest
    distances = np.linalg.norm(offsets, axis=1)
    deflection = distances[0]
    seconds = (np.flatnonzero(distances > SETTLED * deflection)[-1] + 1) * model.opt.timestep
    along = offsets @ offsets[0] / deflection**2
    return deflection, seconds, max(0, -along.min())


def cones():
    """Prints the forces on the last link with pyramidal and elliptic friction cones."""
    rows = []
    for name, cone in CONES.items():
        spec = load("empty")
        spec.option.cone = cone
        model = spec.compile()
        forces = last_link_forces(model, random_setpoints(model, CONE_MOVES))
        rows.append([name, percent((forces > 0).mean()), quantiles(forces[forces > 0])])
    print_table(["cones", "steps with contact", "force: median, 95 %, 99 %, maximum"], rows)


def modes():
    """Prints the slowest and the fastest mode of the hanging finger, with factors of variation at their extremes."""
    own = load("empty")
    step = own.option.timestep
    rows = []
    for name, mass, stiffness, armature in (
        ("the model's", 1, 1, None),
        ("the model's, without armature", 1, 1, 0),
        ("`finger_mass` 0.5, `finger_stiffness` 2", 0.5, 2, None),
        ("`finger_mass` 2, `finger_stiffness` 0.5", 2, 0.5, None),
    ):
        spec = load("empty")
        for link, joint in zip(LINKS, JOINTS):
            spec.geom(link).mass *= mass
            spec.joint(joint).stiffness *= stiffness
            if armature is not None:
                spec.joint(joint).armature = armature
        rates = mode_rates(spec.compile())
        rows.append([name, f"{rates.min():.1f} rad/s", f"{rates.max():.0f} rad/s", f"{rates.max() * step:.2f} rad"])
    print_table(["finger", "slowest mode", "fastest mode", "fastest mode in a step"], rows)


def mode_rates(model):
    """Returns the rates of the undamped modes of the finger at rest while the arm stands still, rad/s."""
    data = at_rest(model)
    joints = [model.joint(joint).dofadr[0] for joint in JOINTS]
    places = [model.joint(joint).qposadr[0] for joint in JOINTS]
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    rest = data.qpos.copy()

    def force():
        """Returns the forces that move the finger's joints: gravity and springs."""
        mujoco.mj_forward(model, data)
        return (data.qfrc_passive - data.qfrc_bias)[joints]

    stiffness = np.empty((len(joints), len(joints)))
    for column, place in enumerate(places):
        ends = []
        for sign in (1, -1):
            data.qpos[:] = rest
            data.qpos[place] += sign * MODE_STEP
            ends.append(force())
        stiffness[:, column] = (ends[1] - ends[0]) / (2 * MODE_STEP)
    squares = np.linalg.eigvals(np.linalg.solve(mass[np.ix_(joints, joints)], stiffness))
    return np.sqrt(squares.real)


def rendering():
    """Prints how many frames a core renders in a second with the models' settings, and with one of them changed."""

    def changed(**quality):
        spec = load("cluttered")
        for name, value in quality.items():
            setattr(spec.visual.quality, name, value)
        return spec

    unchanged = mujoco.MjSpec().visual.quality
    infinite, larger = changed(), changed()
    infinite.geom("ground").size = (0, 0, 1)
    larger.visual.global_.offwidth = larger.visual.global_.offheight = LARGER
    variants = {
        "the models'": changed(),
        "MuJoCo's `shadowsize`": changed(shadowsize=unchanged.shadowsize),
        "MuJoCo's `offsamples`": changed(offsamples=unchanged.offsamples),
        "MuJoCo's `shadowsize` and `offsamples`": changed(
            shadowsize=unchanged.shadowsize, offsamples=unchanged.offsamples
        ),
        "MuJoCo's `numslices`, `numstacks`, `numquads`": changed(
            numslices=unchanged.numslices, numstacks=unchanged.numstacks, numquads=unchanged.numquads
        ),
        "an infinite ground": infinite,
        f"`offwidth`, `offheight` {LARGER}": larger,
    }
    side = changed().visual.global_.offwidth
    sides = {name: side for name in variants}
    for factor in FACTORS:
        name = f"frames of {factor * side} x {factor * side} pixels"
        variants[name], sides[name] = changed(), factor * side
        variants[name].visual.global_.offwidth = variants[name].visual.global_.offheight = factor * side
    rows, own = [], None
    for name, spec in variants.items():
        seconds = frame_seconds(spec.compile(), sides[name])
        own = own or seconds
        rows.append([name, number(1 / seconds), f"{seconds / own:.1f}"])
    print_table(["settings", "frames in a second", "time of a frame, in those of the models' settings"], rows)


def frame_seconds(model, side):
    """Returns the processor time of a frame of side x side pixels, s: the least of some rounds over random poses."""
    data, poses = at_rest(model), []
    for setpoint in random_setpoints(model, POSES)[1:]:
        data.qpos[: model.nu] = setpoint
        poses.append(data.qpos.copy())
    with mujoco.Renderer(model, side, side) as renderer:
        times = []
        for _ in range(RENDERING_ROUNDS):
            spent = 0
            for pose in poses:
                data.qpos[:] = pose
                mujoco.mj_forward(model, data)
                start = time.process_time()
                renderer.update_scene(data, "external")
                renderer.render()
                spent += time.process_time() - start
            times.append(spent / len(poses))
    return min(times)


TABLES = {function.__name__: function for function in (settling, cones, modes, rendering)}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", nargs="?", choices=TABLES, help="the table to print; all if none is given")
    table = parser.parse_args().table
    for function in [TABLES[table]] if table else TABLES.values():
        function()


if __name__ == "__main__":
    main()
