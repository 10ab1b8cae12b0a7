"""Prints what was tried before the worlds were chosen. docs/choice-of-worlds.md has a part of this table.

`harness world check` judges each version, whose files are in a temporary folder. `harness` must be on the path. All
values are in SI units, angles in radians.
"""

import json
import pathlib
import subprocess
import tempfile

import compose
import yaml

HERE = pathlib.Path(__file__).resolve().parent
BEFORE = "eb6a2f02"  # the commit with the worlds before the limit of the arm's force
EPISODES = 8

# The findings that the table shows, each with the name of its column.
SHOWN = {
    "penetration, 99 %, in half the thickness": "penetration, 99 %",
    "penetration, most, in half the thickness": "penetration, most",
    "variance in the top 1 %, force": "variance in the top 1 %, force",
    "variance in the top 1 %, mean force": "variance in the top 1 %, mean force",
    "slide from its setpoint, untouched": "lift and extension from their setpoints, mm",
    "samples with contact": "samples with contact",
    "pairs of link and placed body in a sample": "pairs of link and object in a sample",
}

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


def changed(world, changes):
    """Returns the MJCF of a world with other values of compose.py, and its world file with other ranges."""
    own = {name: getattr(compose, name) for name in changes if name.isupper()}
    file = yaml.safe_load((HERE / f"{world}.yaml").read_text())
    for name in changes.keys() - own.keys():
        file["action"]["actuators"][name]["range"] = changes[name]
    try:
        for name in own:
            setattr(compose, name, changes[name])
        return compose.to_mjcf(compose.scene(world)), yaml.safe_dump(file, sort_keys=False)
    finally:
        for name, value in own.items():
            setattr(compose, name, value)


def before(world):
    """Returns the MJCF of a world and its world file before the limit of the arm's force."""
    paths = (f"{BEFORE}:models/{world}.{ending}" for ending in ("xml", "yaml"))
    return [subprocess.check_output(["git", "show", path], cwd=HERE, text=True) for path in paths]


def judged(model, file):
    """Returns the findings of a version of a world, by name."""
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "tried.yaml"
        path.write_text(file)
        (path.parent / yaml.safe_load(file)["model"]).write_text(model)
        command = ["harness", "world", "check", path, "--episodes", str(EPISODES), "--format", "json"]
        return {found["finding"]: found for found in json.loads(subprocess.check_output(command))}


def cell(found):
    """Returns a value as text, bold if it is beyond its limit."""
    value = found["value"]
    if value is None:
        return "-"
    text = f"{value:.{3 if value < 0.0995 else 2 if value < 9.95 else 1 if value < 99.5 else 0}f}"
    return text if found["holds"] else f"**{text}**"


def print_row(*cells):
    print(f"| {' | '.join(cells)} |", flush=True)


def main():
    print_row("world", "what differs", *SHOWN.values())
    print("|" + "---|" * (2 + len(SHOWN)))
    versions = [(world, "the first version", *before(world)) for world in compose.SCENES]
    versions += [(world, name, *changed(world, changes)) for name, (world, changes) in TRIED.items()]
    for world, name, model, file in versions:
        found = judged(model, file)
        print_row(world, name, *(cell(found[shown]) for shown in SHOWN))


if __name__ == "__main__":
    main()
