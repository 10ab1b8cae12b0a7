"""Writes the versions of the world `crowded` that were tried before it: docs/crowded.md shows their numbers.

    python models/versions.py versions                                     # writes versions/deep.yaml and so on
    harness collect multi_to_multi 'scenarios=[versions/deep.yaml]' simulation.episodes=500 \\
        simulation.actuations_per_episode=4
    python models/oracle.py results/datasets/deep-*
"""

import argparse
import pathlib
import re
from dataclasses import dataclass

import compose
import numpy as np


@dataclass(frozen=True)
class Version:
    """What a version changes. Lengths are in m and angles in rad."""

    radius: float
    heights: tuple[float, float, int]  # lowest, highest, number of pillars
    rotation: tuple[float, float]
    lift: tuple[float, float]
    extension: tuple[float, float]
    place: str  # the lines of `placement.pillar` after `bodies`


SECTOR = "clearance_m: 0\n    sector: {rotation: rotation, extension: extension, body: finger_link_00}"
VERSIONS = {
    # The arm can't lift the finger above the pillars, and presses deep.
    "deep": Version(0.19, (0.2, 0.5, 5), (2.7416, 3.5416), (-0.6, -0.15), (0.2, 1.1), SECTOR),
    # The pillars have more room: fewer contacts.
    "wide": Version(
        0.17, (0.15, 0.45, 7), (2.8416, 3.4416), (-0.6, 0), (0.2, 1),
        "clearance_m: 0.02\n    rectangle: [[-1.85, -0.6], [-0.7, 0.6]]",
    ),
}  # fmt: skip


def write(name, version, folder):
    """Writes the model and the world file of a version."""
    compose.PILLAR_RADIUS = version.radius
    compose.PILLAR_HEIGHTS = np.linspace(*version.heights).round(4).tolist()
    compose.PILLAR_PARKING = [(-1.02 - 0.4 * index, 0) for index in range(len(compose.PILLAR_HEIGHTS))]
    (folder / f"{name}.xml").write_text(compose.to_mjcf(compose.scene("crowded")))
    world = (compose.HERE / "crowded.yaml").read_text().replace("model: crowded.xml", f"model: {name}.xml")
    for actuator, span in zip(("rotation", "lift", "extension"), (version.rotation, version.lift, version.extension)):
        world = re.sub(rf"(arm_{actuator}, .*range: )\[.*?\]", rf"\g<1>{list(span)}", world)
    world = re.sub(r"clearance_m: .*\n    rectangle: .*", version.place, world)
    (folder / f"{name}.yaml").write_text(world)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=pathlib.Path)
    folder = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    for name, version in VERSIONS.items():
        write(name, version, folder)


if __name__ == "__main__":
    main()
