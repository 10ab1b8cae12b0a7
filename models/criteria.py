"""Measures whether the worlds are fit for learning, by criteria that no trained network decides.

`measure.py criteria` prints them for each world, and `measure.py tried` for the versions that were tried. The arm moves
between uniformly random setpoints, as in datasets: ranges, start, and random places of objects are those of the world
file. All values are in SI units, angles in radians.
"""

import math
import pathlib
import subprocess
import time

import compose
import mujoco
import numpy as np
import yaml

HERE = pathlib.Path(__file__).resolve().parent
BEFORE = "eb6a2f02"  # the commit with the worlds before the limit of the arm's force, to which speeds are compared
WORLDS = compose.SCENES
EPISODES, TRIED_EPISODES, SPEED_EPISODES = 200, 40, 20
MOVES = {"crowded": 4, "crowded_moving": 4}  # in an episode; 20 in other worlds, as in the datasets
MOVE_STEPS, SAMPLE_STEPS = 1000, 100
FREE_STEPS = 500  # without contact, after which the arm must be at its setpoint
TOP = 0.01  # part of the samples, those with the largest deviation
MOVABLE = ("cluttered", "wrist", "crowded_moving")  # worlds in which the finger can pinch objects
BOXES = ("cluttered", "wrist")

# Name of a value, unit, number by which it is multiplied, whether it must be at most or at least the limit.
CRITERIA = (
    ("penetration, 99 %", "mm", 1000, "<=", lambda world: 3),
    ("penetration, most", "mm", 1000, "<=", lambda world: 15 if world in MOVABLE else 10),
    ("variance in the top 1 %, snapshot", "", 1, "<=", lambda world: 0.40),
    ("variance in the top 1 %, mean", "", 1, "<=", lambda world: 0.20),
    ("arm from its setpoint, rotation", "mrad", 1000, "<=", lambda world: 5),
    ("arm from its setpoint, lift and extension", "mm", 1000, "<=", lambda world: 5),
    ("joint beyond its limit", "degrees", 180 / math.pi, "<=", lambda world: 0.5),
    ("samples with contact", "", 1, ">=", lambda world: 0.3),
    ("pairs of link and box or pillar in a sample", "", 1, ">=", lambda world: 0.3 if world in BOXES else None),
    ("speed, in that before", "", 1, ">=", lambda world: 0.9),
)
# Further values that describe a world.
DESCRIPTIONS = (
    ("penetration, median", "mm", 1000),
    ("touched tip: variance in the top 1 %, snapshot", "", 1),
    ("touched tip: variance in the top 1 %, mean", "", 1),
    ("touched tip: force, median", "N", 1),
    ("touched tip: force, 99 %", "N", 1),
    ("touched tip: force, most", "N", 1),
    ("touched tip: mean force, 99 %", "N", 1),
    ("touched tip: mean force, most", "N", 1),
    ("tip: correlation of snapshot and mean", "", 1),
    ("links touched in at least 1 % of the samples", "", 1),
    ("ends of moves without contact for 0.5 s", "", 1),
    ("lift from its setpoint at the end of a move, average", "mm", 1000),
    ("samples with the arm at its limit of force", "", 1),
    ("largest joint angle", "degrees", 180 / math.pi),
)

# What was tried, by name: the world, and the values of compose.py or ranges of the world file that differ. Each was
# tried with the values that compose.py has now for everything else.
TRIED = {
    "no limit of force": ("empty", {"ARM_LIMIT": 1e6}),
    "no limit of force, contact of MuJoCo's default": ("empty", {"ARM_LIMIT": 1e6, "FINGER_SOLREF": (0.02, 1)}),
    "limit of 100 N": ("empty", {"ARM_LIMIT": 100.0}),
    "limit of 80 N": ("empty", {"ARM_LIMIT": 80.0}),
    "limit of 40 N": ("empty", {"ARM_LIMIT": 40.0}),
    "`solref` 0.02 1, MuJoCo's default": ("empty", {"FINGER_SOLREF": (0.02, 1)}),
    "`solref` 0.008 1": ("empty", {"FINGER_SOLREF": (0.008, 1)}),
    "`solref` 0.006 1": ("empty", {"FINGER_SOLREF": (0.006, 1)}),
    "`solref` 0.005 1": ("empty", {"FINGER_SOLREF": (0.005, 1)}),
    "`solref` 0.004 1": ("empty", {"FINGER_SOLREF": (0.004, 1)}),
    "`solref` 0.004 2": ("empty", {"FINGER_SOLREF": (0.004, 2)}),
    "`solref` 0.004 1, arm without damping": ("empty", {"FINGER_SOLREF": (0.004, 1), "ARM_DAMPING": 0.0}),
    "arm without damping": ("empty", {"ARM_DAMPING": 0.0}),
    "arm at 100 rad/s": (
        "empty",
        {"ROTATION_GAINS": (3.3e4, 660), "LIFT_GAINS": (3.2e4, 640), "EXTENSION_GAINS": (1.2e4, 240)},
    ),
    "joint damping 1": ("empty", {"JOINT_DAMPING": 1.0}),
    "joint damping 1, `solref` 0.004 1": ("empty", {"JOINT_DAMPING": 1.0, "FINGER_SOLREF": (0.004, 1)}),
    "joint damping 2": ("empty", {"JOINT_DAMPING": 2.0}),
    "links of 30 g": ("empty", {"LINK_MASS": 0.03}),
    "links of 30 g, `solref` 0.004 1": ("empty", {"LINK_MASS": 0.03, "FINGER_SOLREF": (0.004, 1)}),
    "armature 0.0002 kg m2": ("empty", {"JOINT_ARMATURE": 2e-4}),
    "boxes of 0.24 x 0.24 x 0.30 m, as before": ("cluttered", {"BOX_SIZE": (0.24, 0.24, 0.30)}),
    "boxes of 0.24 x 0.24 x 0.30 m, joint damping 1": (
        "cluttered",
        {"BOX_SIZE": (0.24, 0.24, 0.30), "JOINT_DAMPING": 1.0},
    ),
    "boxes of 0.24 x 0.24 x 0.30 m and 3 kg": ("cluttered", {"BOX_SIZE": (0.24, 0.24, 0.30), "BOX_MASS": 3.0}),
    "boxes of 0.24 x 0.24 x 0.40 m": ("cluttered", {"BOX_SIZE": (0.24, 0.24, 0.40)}),
    "boxes of 0.30 x 0.30 x 0.30 m": ("cluttered", {"BOX_SIZE": (0.30, 0.30, 0.30)}),
    "boxes of 2 kg": ("cluttered", {"BOX_MASS": 2.0}),
    "joint damping 1 in `cluttered`": ("cluttered", {"JOINT_DAMPING": 1.0}),
    "tendons, lift from -1 to 0 m": ("tendon", {"lift": [-1, 0]}),
    "tendons, lift from -1 to -0.2 m": ("tendon", {"lift": [-1, -0.2]}),
    "12 links below the same beam as 20": ("twelve", {"FEWER_TIP_HEIGHT": 0.9}),
    "12 links, tip at 0.5 m as with 20": ("twelve", {"FEWER_TIP_HEIGHT": 0.5}),
}


def model_of(world, changes):
    """Returns the compiled model of a world with other values of compose.py."""
    own = {name: getattr(compose, name) for name in changes if name.isupper()}
    try:
        for name in own:
            setattr(compose, name, changes[name])
        return mujoco.MjModel.from_xml_string(compose.to_mjcf(compose.scene(world)))
    finally:
        for name, value in own.items():
            setattr(compose, name, value)


def before(path):
    """Returns the text of a file of this folder before the limit of the arm's force."""
    return subprocess.check_output(["git", "show", f"{BEFORE}:models/{path}"], cwd=HERE, text=True)


class Plan:
    """The random setpoints and places of objects of a world's episodes."""

    def __init__(self, world, model, file, changes=None):
        self.model, self.file, self.moves = model, file, MOVES.get(world, 20)
        elements = {name: {**element, "range": (changes or {}).get(name, element["range"])}
                    for name, element in file["action"]["actuators"].items()}  # fmt: skip
        self.controls = [model.actuator(element["actuator"]).id for element in elements.values()]
        self.low, self.high = np.array([element["range"] for element in elements.values()]).T
        shares = [{"low": 0, "middle": 0.5, "high": 1}[element["start"]] for element in elements.values()]
        self.start = self.low + shares * (self.high - self.low)
        self.arm = [model.joint(f"arm_{name}").qposadr[0] for name in ("rotation", "lift", "extension")]

    def begin(self, data, episode):
        """Sets the start of an episode. Returns the setpoint of each step, the last of which is a setpoint at rest."""
        random = np.random.default_rng([0, episode])
        mujoco.mj_resetData(self.model, data)
        data.qpos[self.arm] = self.start[: len(self.arm)]
        for placement in self.file.get("placement", {}).values():
            self.place(data, placement, random)
        drawn = random.uniform(self.low, self.high, (self.moves, len(self.low)))
        time = np.arange(MOVE_STEPS)[:, None] / MOVE_STEPS
        done = time**2 * (3 - 2 * time)
        ends = np.vstack([self.start, drawn])
        return np.vstack([*(start + done * (end - start) for start, end in zip(ends, ends[1:])), ends[-1:]])

    def place(self, data, placement, random):
        """Places bodies on the ground, away from each other and, in a sector, from the finger."""
        model, area = self.model, placement.get("rectangle")
        prefix = placement["bodies"].rstrip("*") if placement["bodies"] else None
        taken = [] if area else [(-compose.MOUNT_RADIUS - self.start[2], 0, compose.LINK_RADIUS)]
        for name in (model.body(body).name for body in range(model.nbody)):
            if prefix is None or not name.startswith(prefix):
                continue
            size = model.geom(name).size
            radius = math.hypot(*size[:2]) if model.geom(name).type[0] == mujoco.mjtGeom.mjGEOM_BOX else size[0]
            fits = False
            while not fits:
                if area:
                    x, y = (random.uniform(*side) for side in area)
                else:
                    reach = compose.MOUNT_RADIUS + np.array([self.low[2], self.high[2]])
                    angle, far = random.uniform(self.low[0], self.high[0]), math.sqrt(random.uniform(*reach**2))
                    x, y = far * math.cos(angle), far * math.sin(angle)
                gap = radius + placement["clearance_m"]
                fits = all(math.hypot(x - a, y - b) >= gap + other for a, b, other in taken)
            taken.append((x, y, radius))
            yaw, first = random.uniform(-math.pi, math.pi), model.joint(name).qposadr[0]
            data.qpos[first : first + 2] = x, y
            data.qpos[first + 3 : first + 7] = math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)


def named(model, *prefixes):
    """Returns which geoms have names with one of the prefixes."""
    return np.array([model.geom(geom).name.startswith(prefixes) for geom in range(model.ngeom)])


def simulate(world, model, plan, episodes):
    """Simulates episodes of a world. Returns its values by name."""
    data, links, objects = mujoco.MjData(model), named(model, "finger_link_"), named(model, "box_", "pillar_")
    link = np.where(links, np.cumsum(links) - 1, -1)
    joints = [model.joint(joint).qposadr[0] for joint in range(model.njnt) if model.jnt_limited[joint]]
    bounds = model.jnt_range[model.jnt_limited.astype(bool)]
    servos = plan.controls[: len(plan.arm)]
    limit = model.actuator_forcerange[servos, 1] - 1e-9
    depths, snapshots, means, pairs, free_ends, ends = [], [], [], [], [], []
    beyond, largest, at_limit = -math.inf, 0, 0
    force = np.zeros(links.sum())
    for episode in range(episodes):
        total, free = np.zeros_like(force), 0
        for step, setpoint in enumerate(plan.begin(data, episode)):
            if step and step % MOVE_STEPS == 0:
                ends.append(np.abs(data.qpos[plan.arm] - setpoint[: len(plan.arm)]))
                free_ends += ends[-1:] if free >= FREE_STEPS else []
            angles = data.qpos[joints]
            beyond = max(beyond, (angles - bounds[:, 1]).max(), (bounds[:, 0] - angles).max())
            largest = max(largest, np.abs(angles).max())
            data.ctrl[plan.controls] = setpoint
            mujoco.mj_step(model, data)
            force[:], touched = 0, 0
            if data.ncon:
                geoms, address = data.contact.geom, data.contact.efc_address
                own = np.flatnonzero((link[geoms].max(1) >= 0) & (address >= 0))
                geoms, normal = geoms[own], data.efc_force[address[own]]
                np.add.at(force, link[geoms].max(1), normal)
                depths.append(-data.contact.dist[own])
                touched = len({tuple(pair) for pair in geoms[objects[geoms].any(1) & (normal > 0)]})
            free = 0 if force.any() else free + 1
            total += force
            if step % SAMPLE_STEPS == 0:
                snapshots.append(force.copy())
                means.append(total / (SAMPLE_STEPS if step else 1))
                total[:] = 0
                pairs.append(touched)
                at_limit += (np.abs(data.actuator_force[servos]) >= limit).any()
        if any(warning.number for warning in data.warning):
            raise SystemExit(f"{world}: a warning of MuJoCo in episode {episode}")
    depths = np.concatenate(depths)
    depths, free_ends, ends = depths[depths > 0], np.array(free_ends), np.array(ends)
    snapshots, means = np.array(snapshots), np.array(means)
    tip, tip_mean = snapshots[snapshots[:, -1] > 0, -1:], means[means[:, -1] > 0, -1:]
    return {
        "penetration, median": np.median(depths),
        "penetration, 99 %": np.quantile(depths, 0.99),
        "penetration, most": depths.max(),
        "variance in the top 1 %, snapshot": top(snapshots),
        "variance in the top 1 %, mean": top(means),
        "arm from its setpoint, rotation": free_ends[:, 0].max(),
        "arm from its setpoint, lift and extension": free_ends[:, 1:].max(),
        "joint beyond its limit": max(0, beyond),
        "samples with contact": (snapshots > 0).any(1).mean(),
        "pairs of link and box or pillar in a sample": np.mean(pairs),
        "touched tip: variance in the top 1 %, snapshot": top(tip),
        "touched tip: variance in the top 1 %, mean": top(tip_mean),
        "touched tip: force, median": np.median(tip),
        "touched tip: force, 99 %": np.quantile(tip, 0.99),
        "touched tip: force, most": tip.max(),
        "touched tip: mean force, 99 %": np.quantile(tip_mean, 0.99),
        "touched tip: mean force, most": tip_mean.max(),
        "tip: correlation of snapshot and mean": np.corrcoef(snapshots[:, -1], means[:, -1])[0, 1],
        "links touched in at least 1 % of the samples": ((snapshots > 0).mean(0) >= 0.01).sum(),
        "ends of moves without contact for 0.5 s": len(free_ends) / len(ends),
        "lift from its setpoint at the end of a move, average": ends[:, 1].mean(),
        "samples with the arm at its limit of force": at_limit / len(pairs),
        "largest joint angle": largest,
    }


def top(values):
    """Returns the share of the variance that the samples with the largest deviation from the mean hold."""
    deviations = np.sort(((values - values.mean(0)) ** 2).sum(1))
    return deviations[-max(1, round(TOP * len(deviations))) :].sum() / deviations.sum()


def relative_speed(world):
    """Returns steps in a second of processor time, in those before the limit, of episodes that are simulated in turns."""
    old = mujoco.MjModel.from_xml_string(before(f"{world}.xml"))
    new = mujoco.MjModel.from_xml_path(str(HERE / f"{world}.xml"))
    texts = before(f"{world}.yaml"), (HERE / f"{world}.yaml").read_text()
    both = [(model, mujoco.MjData(model), Plan(world, model, yaml.safe_load(text)))
            for model, text in zip((old, new), texts)]  # fmt: skip
    spent = [0.0, 0.0]
    for episode in range(SPEED_EPISODES):
        for version, (model, data, plan) in enumerate(both):
            setpoints = plan.begin(data, episode)
            start = time.process_time()
            for setpoint in setpoints:
                data.ctrl[plan.controls] = setpoint
                mujoco.mj_step(model, data)
            spent[version] += time.process_time() - start
    return spent[0] / spent[1]


def fails(world, values):
    """Returns the names of the criteria that a world's values do not meet. Values that were not measured are left out."""
    failed = []
    for name, _, factor, sign, limit in CRITERIA:
        bound, value = limit(world), values.get(name)
        if bound is not None and value is not None:
            holds = factor * value <= bound if sign == "<=" else factor * value >= bound
            failed += [] if holds else [name]
    return failed


def text(value, unit=""):
    """Returns a value as text, with two digits after the point, or one or none from 10 or 100 on."""
    return f"{value:.{2 if value < 9.95 else 1 if value < 99.5 else 0}f} {unit}".strip()


def criteria(worlds):
    """Returns a table of the criteria and further values of worlds: the header and the rows. What fails is bold."""
    columns = []
    for world in worlds:
        file = yaml.safe_load((HERE / f"{world}.yaml").read_text())
        model = mujoco.MjModel.from_xml_path(str(HERE / f"{world}.xml"))
        values = simulate(world, model, Plan(world, model, file), EPISODES)
        columns.append({**values, "speed, in that before": relative_speed(world)})
    rows = []
    for name, unit, factor, sign, limit in CRITERIA:
        cells = []
        for world, values in zip(worlds, columns):
            cell = text(factor * values[name])
            cells.append(f"**{cell}**" if name in fails(world, values) else cell)
        limits = sorted({limit(world) for world in WORLDS} - {None})
        rows.append([f"{name}, {unit}".rstrip(", "), f"{sign} " + " or ".join(map(str, limits)), *cells])
    for name, unit, factor in DESCRIPTIONS:
        cells = [text(factor * values[name]) for values in columns]
        rows.append([f"{name}, {unit}".rstrip(", "), "", *cells])
    return ["", "limit", *worlds], rows


def tried(worlds):
    """Returns a table of what was tried in worlds, and which criteria failed: the header and the rows."""
    shown = ("penetration, 99 %", "penetration, most", "variance in the top 1 %, snapshot")
    shown += ("variance in the top 1 %, mean", "arm from its setpoint, lift and extension", "samples with contact")
    shown += ("pairs of link and box or pillar in a sample",)
    units = {name: (factor, unit) for name, unit, factor, *_ in CRITERIA}
    versions = [(world, "the world before", None) for world in WORLDS]
    versions += [(world, name, changes) for name, (world, changes) in TRIED.items()]
    rows = []
    for world, name, changes in versions:
        if world in worlds:
            is_before = changes is None
            text_of = before if is_before else lambda path: (HERE / path).read_text()
            file = yaml.safe_load(text_of(f"{world}.yaml"))
            model = mujoco.MjModel.from_xml_string(before(f"{world}.xml")) if is_before else model_of(world, changes)
            values = simulate(world, model, Plan(world, model, file, changes), TRIED_EPISODES)
            failed = fails(world, values)
            cells = [(column, text(units[column][0] * values[column])) for column in shown]
            rows.append([world, name, *(f"**{cell}**" if column in failed else cell for column, cell in cells)])
    header = [f"{column}, {units[column][1]}".rstrip(", ") for column in shown]
    return ["world", "what differs", *header], rows
