"""Writes random MuJoCo models, whose recorded values tests/random_models.rs compares with those of Python's `mujoco`.

    random_model.py FOLDER FIRST COUNT

writes `model.xml` and `simulation.json`, settings of a spec, to `FOLDER/SEED` for COUNT seeds from FIRST on. A model
depends only on its seed. Half of the models also get a world file, `world.yaml`, with what `harness world new` does not
offer: a keyframe, a recorded course, mocap bodies beside actuators, factors, kinds of contact, and poses in the frame
of a body. `harness world new` writes the world files of the others.

Each model compiles, and 0.2 s of it are simulated without a warning, under random controls.
"""

import json
import math
import sys
import xml.etree.ElementTree as xml
from pathlib import Path

import mujoco
import numpy as np
from recorded_values import controls_of

# Parts of a model that only a few models have, and how likely each is.
RARE = {
    "flex": 0.15, "cable": 0.06, "touch_grid": 0.08, "mesh": 0.3, "hfield": 0.12, "mocap": 0.3, "sleep": 0.3,
    "cameras": 0.25,
}  # fmt: skip

# Sensors that can't have a cutoff.
UNCUT = ("framequat", "framexaxis", "frameyaxis", "framezaxis", "ballquat", "normal", "fromto", "contact", "user")

SINGLE = ("hinge", "slide")


class Random:
    """Random choices of a seed."""

    def __init__(self, *seed):
        self.generator = np.random.default_rng(seed)

    def chance(self, probability):
        return self.generator.random() < probability

    def one(self, things):
        return things[self.generator.integers(len(things))]

    def some(self, things, most):
        """Some of the things, in a random order."""
        count = min(len(things), int(self.generator.integers(0, most + 1)))
        return [things[index] for index in self.generator.permutation(len(things))[:count]]

    def number(self, low, high):
        return float(self.generator.uniform(low, high))

    def numbers(self, count, low, high):
        return [self.number(low, high) for _ in range(count)]

    def count(self, low, high):
        return int(self.generator.integers(low, high + 1))

    def maybe(self, probability, draw):
        """What `draw` returns, or else None."""
        return draw() if self.chance(probability) else None

    def direction(self):
        vector = self.generator.normal(size=3)
        return (vector / np.linalg.norm(vector)).tolist()

    def quaternion(self):
        vector = self.generator.normal(size=4)
        return (vector / np.linalg.norm(vector)).tolist()


def text(value):
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (list, tuple)):
        return " ".join(text(each) for each in value)
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def add(parent, tag, **attributes):
    """Adds an element with those attributes that are not None. `class_` stands for `class`."""
    given = {key.rstrip("_"): text(value) for key, value in attributes.items() if value is not None}
    return xml.SubElement(parent, tag, given)


class Model:
    """A model under construction."""

    def __init__(self, seed, attempt):
        self.random = Random(seed, attempt)
        self.has = {part: self.random.chance(probability) for part, probability in RARE.items()}
        self.root = xml.Element("mujoco", model=f"random_{seed}")
        self.names = {}
        # What other elements refer to: bodies, joints by type, geoms that a tendon can wrap, sites, tendons, actuators.
        self.bodies, self.geoms, self.wrapped, self.sites, self.tendons, self.actuators = [], [], [], [], [], []
        self.joints = {"hinge": [], "slide": [], "ball": [], "free": []}
        self.ranged, self.mocap, self.flexes, self.with_geom, self.cameras = [], [], [], [], []
        self.options()
        self.assets()
        self.world = add(self.root, "worldbody")
        self.ground()
        self.trees()
        self.soft()
        self.contacts()
        self.pulls()
        self.equalities()
        self.actuation()
        self.sensors()

    def name(self, kind):
        """A new name for a thing of this kind. A few names have capitals, or characters that no column has."""
        number = self.names[kind] = self.names.get(kind, -1) + 1
        style = self.random.one(["{}_{}"] * 8 + ["{}-{}", "{}.{}", "{} [{}]", "{}/{}*"])
        name = style.format(kind, number)
        return name.upper() if self.random.chance(0.05) else name

    def options(self):
        draw = self.random
        add(self.root, "compiler", autolimits=True, angle=draw.one(["radian", "degree"]))
        self.in_degrees = self.root[0].get("angle") == "degree"
        option = add(
            self.root, "option",
            timestep=draw.one([0.002, 0.002, 0.004, 0.005]),
            integrator=draw.one(["Euler", "RK4", "implicit", "implicitfast", "implicitfast", "discrete"]),
            cone=draw.one(["pyramidal", "elliptic"]),
            solver=draw.one(["Newton", "Newton", "CG", "PGS"]),
            jacobian=draw.maybe(0.3, lambda: draw.one(["dense", "sparse", "auto"])),
            gravity=draw.maybe(0.2, lambda: draw.numbers(2, -2, 2) + [-9.81]),
            wind=draw.maybe(0.1, lambda: draw.numbers(3, -1, 1)),
            density=draw.maybe(0.1, lambda: draw.number(0.5, 100)),
            viscosity=draw.maybe(0.1, lambda: draw.number(0, 0.2)),
            impratio=draw.maybe(0.2, lambda: draw.number(1, 10)),
            noslip_iterations=draw.maybe(0.1, lambda: 3),
            magnetic=draw.maybe(0.2, lambda: draw.numbers(3, -1, 1)),
            actuatorgroupdisable=draw.maybe(0.1, lambda: 2),
            sleep_tolerance=draw.maybe(0.5 * self.has["sleep"], lambda: draw.number(1e-4, 1e-1)),
            o_margin=draw.maybe(0.1, lambda: draw.number(0, 0.02)),
        )  # fmt: skip
        unusual = {
            "multiccd": "enable", "energy": "enable", "fwdinv": "enable", "override": "enable", "eulerdamp": "disable",
            "island": "disable", "filterparent": "disable", "warmstart": "disable", "nativeccd": "disable",
            "spring": "disable", "damper": "disable", "refsafe": "disable", "clampctrl": "disable",
            "frictionloss": "disable", "limit": "disable", "midphase": "disable", "gravity": "disable",
            "contact": "disable", "equality": "disable", "invdiscrete": "enable",
        }  # fmt: skip
        flags = {flag: unusual[flag] for flag in draw.some(list(unusual), 2) if draw.chance(0.4)}
        add(option, "flag", sleep="enable" if self.has["sleep"] else None, **flags)
        visual = add(self.root, "visual")
        add(visual, "quality", shadowsize=0, offsamples=0)

    def assets(self):
        draw = self.random
        asset = add(self.root, "asset")
        if self.has["mesh"]:
            corners = draw.generator.uniform(-0.08, 0.08, (draw.count(6, 10), 3)).ravel().tolist()
            add(asset, "mesh", name="mesh", vertex=corners)
        if self.has["hfield"]:
            heights = draw.generator.uniform(0, 1, 36).tolist()
            add(asset, "hfield", name="hills", nrow=6, ncol=6, elevation=heights, size=[2.0, 2.0, 0.05, 0.1])

    def touch(self):
        """Attributes of whatever can touch."""
        draw = self.random
        return dict(
            condim=draw.maybe(0.5, lambda: draw.one([1, 3, 4, 6])),
            friction=draw.maybe(0.4, lambda: [draw.number(0.1, 1.5), 0.005, 0.0001]),
            margin=draw.maybe(0.2, lambda: draw.number(0.001, 0.03)),
            gap=draw.maybe(0.2, lambda: draw.number(0.001, 0.03)),
            solref=draw.maybe(0.2, lambda: [draw.number(0.015, 0.04), draw.number(0.7, 1.2)]),
            solimp=draw.maybe(0.2, lambda: [0.8, 0.95, draw.number(0.001, 0.01)]),
        )

    def surface(self):
        draw = self.random
        return self.touch() | dict(
            adhesion=draw.maybe(0.15, lambda: draw.number(0.5, 5)),
            surfacevel=draw.maybe(0.07, lambda: draw.numbers(3, -0.3, 0.3)),
            priority=draw.maybe(0.15, lambda: draw.count(0, 2)),
            solmix=draw.maybe(0.1, lambda: draw.number(0.5, 2)),
        )

    def ground(self):
        draw = self.random
        shape = dict(type="hfield", hfield="hills") if self.has["hfield"] else dict(type="plane", size=[3, 3, 0.1])
        name = self.name("floor")
        self.geoms.append(name)
        add(self.world, "geom", name=name, **shape, **self.surface())
        for _ in range(draw.count(0, 1)):
            add(self.world, "light", pos=[0, 0, 3])
        for _ in range(draw.count(0, 2)):
            self.site(self.world, self.random.numbers(2, -0.5, 0.5) + [draw.number(0.2, 1)])

    def site(self, body, place):
        name = self.name("site")
        self.sites.append(name)
        kind = self.random.one(["sphere", "box"])
        size = self.random.number(0.05, 0.2)
        add(body, "site", name=name, pos=place, quat=self.random.quaternion(), type=kind, size=[size] * 3)

    def geom(self, body):
        draw = self.random
        kind = draw.one(["sphere", "capsule", "ellipsoid", "cylinder", "box"] + ["mesh"] * self.has["mesh"])
        name = draw.maybe(0.85, lambda: self.name("geom"))
        shape = dict(mesh="mesh") if kind == "mesh" else dict(size=draw.numbers(3, 0.04, 0.09))
        weight = draw.one([dict(mass=draw.number(0.1, 1)), dict(density=draw.number(200, 2000))])
        add(
            body, "geom", name=name, type=kind, pos=draw.numbers(3, -0.04, 0.04), quat=draw.quaternion(), **shape,
            **weight, **self.surface(), fluidshape=draw.maybe(0.1, lambda: "ellipsoid"),
            conaffinity=draw.maybe(0.1, lambda: 0), group=draw.maybe(0.1, lambda: draw.count(0, 4)),
        )  # fmt: skip
        if name:
            self.geoms.append(name)
            if kind in ("sphere", "cylinder"):
                self.wrapped.append(name)

    def joint(self, body, kind):
        draw = self.random
        name = draw.maybe(0.9, lambda: self.name(kind))
        if kind == "free":
            if draw.chance(0.5):
                add(body, "freejoint", name=name, align=draw.maybe(0.5, lambda: draw.chance(0.5)))
            else:
                add(body, "joint", name=name, type="free", damping=draw.maybe(0.5, lambda: draw.number(0, 0.1)))
        else:
            turn = 180 / math.pi if self.in_degrees and kind != "slide" else 1.0
            reach = draw.number(0.3, 1.2) if kind != "slide" else draw.number(0.05, 0.3)
            limits = [0.0, reach * turn] if kind == "ball" else [-reach * turn, draw.number(0.3, 1) * reach * turn]
            limits = draw.maybe(0.5, lambda: limits)
            single = kind in SINGLE
            add(
                body, "joint", name=name, type=kind, axis=draw.direction() if single else None, range=limits,
                pos=draw.maybe(0.2, lambda: draw.numbers(3, -0.05, 0.05)), damping=draw.number(0.02, 2),
                stiffness=draw.maybe(0.4, lambda: draw.number(0.1, 20)),
                armature=draw.maybe(0.5, lambda: draw.number(0.001, 0.1)),
                frictionloss=draw.maybe(0.2, lambda: draw.number(0.01, 0.3)),
                margin=draw.maybe(0.1, lambda: draw.number(0.001, 0.05)),
                ref=draw.maybe(0.2 * single, lambda: draw.number(-0.2, 0.2) * turn),
                springref=draw.maybe(0.2 * single, lambda: draw.number(-0.3, 0.3) * turn),
                actuatorfrcrange=draw.maybe(0.1 * single, lambda: [-draw.number(1, 10), draw.number(1, 10)]),
                actuatorgravcomp=draw.maybe(0.1 * single, lambda: True),
            )  # fmt: skip
            if name and single and limits:
                self.ranged.append(name)
        if name:
            self.joints[kind].append(name)

    def body(self, parent, place, joints, depth):
        draw = self.random
        name = draw.maybe(0.95, lambda: self.name("body"))
        is_mocap = joints == ["mocap"]
        is_root = parent is self.world
        body = add(
            parent, "body", name=name, pos=place, quat=draw.maybe(0.4, draw.quaternion),
            gravcomp=draw.maybe(0.15, lambda: draw.number(0, 1)), mocap=is_mocap or None,
            sleep=draw.maybe(0.2 * (self.has["sleep"] and is_root and not is_mocap and bool(joints)),
                             lambda: draw.one(["never", "allowed", "init"])),
        )  # fmt: skip
        for kind in [] if is_mocap else joints:
            self.joint(body, kind)
        for _ in range(draw.count(1, 2)):
            self.geom(body)
        for _ in range(draw.count(0, 2)):
            self.site(body, draw.numbers(3, -0.1, 0.1))
        if self.has["cameras"] and draw.chance(0.3):
            camera = self.name("camera")
            self.cameras.append(camera)
            add(body, "camera", name=camera, pos=[0, 0, 0.3], resolution=[8, 6])
        if name:
            self.bodies.append(name)
            self.with_geom.append(name)
            if is_mocap:
                self.mocap.append(name)
        if not is_mocap:
            for _ in range(draw.count(0, 2) if depth == 0 else draw.count(0, 1)):
                if depth < 3:
                    kinds = draw.one([["hinge"], ["hinge"], ["slide"], ["ball"], ["hinge", "hinge"], []])
                    self.body(body, draw.numbers(2, -0.15, 0.15) + [-draw.number(0.1, 0.2)], kinds, depth + 1)
        return body

    def trees(self):
        draw = self.random
        roots = [["free"], ["free"], ["hinge"], ["slide"], ["ball"], ["slide", "hinge"], ["slide", "slide", "hinge"]]
        chosen = [draw.one(roots) for _ in range(draw.count(2, 4))] + [["mocap"]] * self.has["mocap"]
        for index, kinds in enumerate(chosen):
            height = draw.number(0.12, 0.35) if kinds == ["free"] else draw.number(0.3, 0.9)
            place = [0.35 * (index % 3) - 0.3, 0.4 * (index // 3) - 0.2, height]
            self.body(self.world, place, kinds, 0)
        if not any(self.joints[kind] for kind in SINGLE):
            self.body(self.world, [0, 0.8, 0.4], ["slide"], 3)

    def soft(self):
        draw = self.random
        extensions = []
        if self.has["flex"]:
            dim = draw.count(1, 3)
            count = {1: [5, 1, 1], 2: [3, 3, 1], 3: [3, 3, 2]}[dim]
            name = self.name("flex")
            flex = add(
                self.world, "flexcomp", name=name, type="grid", count=count, spacing=[0.08, 0.08, 0.08], dim=dim,
                radius=0.015, mass=0.3, pos=[-0.8, 0, draw.number(0.1, 0.3)],
            )  # fmt: skip
            # An elasticity holds a body of dimension 2 or 3 together, and equalities of edges any.
            if dim > 1 and draw.chance(0.5):
                add(flex, "elasticity", young=5e3, poisson=0.1, damping=0.01,
                    thickness=0.02 if dim == 2 else None, elastic2d="both" if dim == 2 else None)  # fmt: skip
            else:
                add(flex, "edge", equality=True, damping=1.0)
            # Passive contacts and implicit elasticities need this integrator.
            if draw.chance(0.6):
                self.root.find("option").set("integrator", "discrete")
            is_discrete = self.root.find("option").get("integrator") == "discrete"
            passive = draw.maybe(0.6 * is_discrete, lambda: True)
            add(flex, "contact", selfcollide="none", passive=passive, condim=draw.one([1, 3]))
            if draw.chance(0.3):
                add(flex, "pin", id=0)
            self.flexes.append(name)
        if self.has["cable"]:
            extensions.append("mujoco.elasticity.cable")
            cable = add(
                self.world, "composite", type="cable", prefix="rope_", curve="s", count=[6, 1, 1], size=0.4,
                offset=[-0.2, -0.9, 0.4], initial=draw.one(["none", "ball", "free"]),
            )  # fmt: skip
            plugin = add(cable, "plugin", plugin="mujoco.elasticity.cable")
            for key, value in (("twist", 1e6), ("bend", 4e5), ("vmax", 0)):
                add(plugin, "config", key=key, value=value)
            add(cable, "joint", kind="main", damping=0.015)
            add(cable, "geom", type="capsule", size=0.01, condim=1)
        if self.has["touch_grid"]:
            extensions.append("mujoco.sensor.touch_grid")
        if extensions:
            extension = add(self.root, "extension")
            for plugin in extensions:
                add(extension, "plugin", plugin=plugin)

    def contacts(self):
        draw = self.random
        contact = add(self.root, "contact")
        if draw.chance(0.3) and len(self.geoms) > 2:
            first, second = draw.generator.permutation(len(self.geoms))[:2]
            shared = self.touch() | dict(adhesion=draw.maybe(0.3, lambda: draw.number(0.5, 3)))
            shared["friction"] = None
            add(contact, "pair", geom1=self.geoms[first], geom2=self.geoms[second], **shared)
        if draw.chance(0.2) and len(self.bodies) > 2:
            add(contact, "exclude", body1=self.bodies[0], body2=self.bodies[1])

    def pulls(self):
        draw = self.random
        single = [name for kind in SINGLE for name in self.joints[kind]]
        tendons = add(self.root, "tendon")

        def shared():
            return dict(
                name=self.name("tendon"), damping=draw.maybe(0.4, lambda: draw.number(0.01, 0.5)),
                stiffness=draw.maybe(0.4, lambda: draw.number(0.1, 10)),
                frictionloss=draw.maybe(0.2, lambda: draw.number(0.01, 0.2)),
                armature=draw.maybe(0.15, lambda: draw.number(0.001, 0.05)),
                springlength=draw.maybe(0.2, lambda: sorted(draw.numbers(2, 0.1, 0.5))),
                range=draw.maybe(0.3, lambda: [-draw.number(0.2, 0.5), draw.number(0.3, 1)]),
                actuatorfrcrange=draw.maybe(0.1, lambda: [-3, 3]),
            )  # fmt: skip

        if single and draw.chance(0.4):
            fixed = add(tendons, "fixed", **shared())
            for joint in draw.some(single, 3) or single[:1]:
                add(fixed, "joint", joint=joint, coef=draw.number(-1.5, 1.5))
            self.tendons.append(fixed.get("name"))
        if len(self.sites) >= 3 and draw.chance(0.4):
            attributes = shared()
            if attributes["range"]:
                attributes["range"] = [0.0, draw.number(0.5, 1.5)]
            # An armature has no meaning for a tendon that wraps around a geom.
            wrapped = draw.maybe(0.4, lambda: draw.one(self.wrapped)) if self.wrapped else None
            attributes["armature"] = None if wrapped else attributes["armature"]
            spatial = add(tendons, "spatial", **attributes)
            order = draw.generator.permutation(len(self.sites)).tolist()
            add(spatial, "site", site=self.sites[order[0]])
            if wrapped:
                add(spatial, "geom", geom=wrapped)
            add(spatial, "site", site=self.sites[order[1]])
            if draw.chance(0.2):
                add(spatial, "pulley", divisor=2)
                add(spatial, "site", site=self.sites[order[1]])
                add(spatial, "site", site=self.sites[order[2]])
            self.tendons.append(attributes["name"])

    def equalities(self):
        draw = self.random
        equality = add(self.root, "equality")
        active = lambda: draw.maybe(0.15, lambda: False)  # noqa: E731
        single = self.joints["hinge"] + self.joints["slide"]
        if single and draw.chance(0.25):
            first, *others = draw.some(single, len(single)) or single[:1]
            curve = draw.maybe(0.5, lambda: [0.0, draw.number(-1, 1), draw.number(-0.2, 0.2), 0.0, 0.0])
            add(equality, "joint", joint1=first, joint2=others[0] if others else None, active=active(),
                solref=[0.05, 1], polycoef=curve)  # fmt: skip
        if len(self.bodies) > 1 and draw.chance(0.2):
            first, second = draw.generator.permutation(len(self.bodies))[:2]
            kind = draw.one(["connect", "weld"])
            add(equality, kind, body1=self.bodies[first], body2=draw.maybe(0.7, lambda: self.bodies[second]),
                anchor=draw.numbers(3, -0.05, 0.05), active=active(),
                torquescale=draw.number(0.2, 2) if kind == "weld" else None)  # fmt: skip
        # MuJoCo ends the process where a tendon's equality meets sleeping.
        if self.tendons and not self.has["sleep"] and draw.chance(0.3):
            add(equality, "tendon", tendon1=self.tendons[0], active=active(), solref=[0.05, 1])
        if self.mocap and draw.chance(0.6):
            others = [body for body in self.bodies if body not in self.mocap]
            add(equality, "weld", body1=self.mocap[0], body2=draw.one(others) if others else None, solref=[0.05, 1])

    def transmission(self):
        """What an actuator pulls."""
        draw = self.random
        single = [name for kind in SINGLE for name in self.joints[kind]]
        choices = [lambda: dict(joint=draw.one(single))] * (6 * bool(single))
        choices += [lambda: dict(jointinparent=draw.one(single))] * bool(single)
        others = self.joints["ball"] + self.joints["free"]
        turned = lambda key: (  # noqa: E731
            {key: draw.one(others), "gear": [0.0, 0.0, 0.0] + draw.numbers(3, -1, 1)}
            if others and self.joints["free"]
            else {key: draw.one(others), "gear": draw.numbers(3, -1, 1) + [0.0, 0.0, 0.0]}
        )
        choices += [lambda: turned(draw.one(["joint", "jointinparent"]))] * bool(others)
        choices += [lambda: dict(tendon=draw.one(self.tendons))] * (2 * bool(self.tendons))
        choices += [
            lambda: dict(site=draw.one(self.sites), gear=draw.numbers(6, -1, 1),
                         refsite=draw.maybe(0.4, lambda: draw.one(self.sites)))
        ] * bool(self.sites)  # fmt: skip
        if len(self.sites) > 1:
            ends = draw.generator.permutation(len(self.sites))[:2]
            crank = dict(cranksite=self.sites[ends[0]], slidersite=self.sites[ends[1]], cranklength=2.0)
            choices.append(lambda: crank)
        return draw.one(choices)() if choices else None

    def actuation(self):
        draw = self.random
        actuators = add(self.root, "actuator")
        kinds = [
            "motor", "position", "velocity", "intvelocity", "damper", "cylinder", "muscle", "adhesion", "dcmotor",
            "pid", "orientation", "general",
        ]  # fmt: skip
        for kind in [draw.one(kinds) for _ in range(draw.count(1, 5))]:
            pulls = self.transmission()
            if kind == "orientation":
                if not self.joints["ball"]:
                    continue
                pulls = dict(joint=draw.one(self.joints["ball"]))
            if kind == "muscle":
                pulls = dict(tendon=draw.one(self.tendons)) if self.tendons else None
            if kind == "adhesion":
                pulls = dict(body=draw.one(self.with_geom)) if self.with_geom else None
            if pulls is None:
                continue
            name = draw.maybe(0.92, lambda: self.name(kind))
            reach = draw.number(0.3, 1)
            limits = [-reach, draw.number(0.2, 1)]
            delay = draw.maybe(0.1, lambda: draw.number(0.002, 0.02))
            shared = dict(
                name=name, **pulls, forcerange=draw.maybe(0.2, lambda: [-draw.number(1, 9), draw.number(1, 9)]),
                delay=delay, nsample=None if delay is None else draw.count(1, 8),
                interp=None if delay is None else draw.one(["zoh", "linear", "cubic"]),
                group=draw.maybe(0.2, lambda: draw.count(0, 3)),
            )  # fmt: skip
            limited = dict(ctrlrange=draw.maybe(0.7, lambda: limits))
            geared = {} if "gear" in pulls else dict(gear=draw.maybe(0.2, lambda: [draw.number(-1.5, 1.5)]))
            damped = dict(kv=draw.maybe(0.5, lambda: draw.number(0.1, 2)))
            inherit = pulls.get("joint") in self.ranged and draw.chance(0.3)
            specific = {
                "motor": lambda: limited | geared,
                "position": lambda: (dict(inheritrange=draw.number(0.5, 1)) if inherit else limited)
                | geared | dict(kp=draw.number(1, 40), timeconst=draw.maybe(0.25, lambda: draw.number(0.02, 0.3)))
                | (draw.one([damped, dict(dampratio=1.0)])),
                "velocity": lambda: limited | geared | dict(kv=draw.number(0.1, 3)),
                "intvelocity": lambda: dict(ctrlrange=limits, actrange=[-1.0, 1.0], kp=draw.number(1, 20)) | damped,
                "damper": lambda: dict(kv=draw.number(0.1, 2), ctrlrange=[0.0, reach]),
                "cylinder": lambda: limited | dict(timeconst=draw.number(0.02, 0.3), area=draw.number(0.5, 3)),
                "muscle": lambda: dict(ctrlrange=[0.0, 1.0], lengthrange=[0.1, 1.5], force=draw.number(1, 20)),
                "adhesion": lambda: dict(ctrlrange=[0.0, draw.number(0.5, 1)], gain=draw.number(0.5, 5)),
                "dcmotor": lambda: limited | dict(
                    motorconst=draw.number(0.05, 0.2), resistance=draw.number(0.5, 2),
                    inductance=draw.maybe(0.3, lambda: draw.number(0.005, 0.02)),
                ) | draw.one([
                    dict(input=draw.one([None, "voltage", "none", "vel"])),
                    dict(
                        input=draw.one(["pos", "pos vel"]),
                        controller=[draw.number(1, 20), draw.one([0.0, 1.0]), 0.1, draw.one([0.0, 3.0])],
                    ),
                ]),
                "pid": lambda: geared | damped | dict(kp=draw.number(1, 30)) | draw.one([
                    dict(input=draw.one(["vel", "ff", "vel ff"])),
                    dict(
                        input=draw.maybe(0.7, lambda: draw.one(["pos", "pos vel", "pos ff", "pos vel ff"])),
                        ki=draw.maybe(0.4, lambda: draw.number(0.1, 5)), imax=draw.maybe(0.2, lambda: 1.0),
                        slewmax=draw.maybe(0.3, lambda: draw.number(1, 5)),
                        posrange=draw.maybe(0.3, lambda: limits),
                    ),
                ]),
                "orientation": lambda: damped | dict(
                    kp=draw.number(0.2, 5), input=draw.maybe(0.7, lambda: draw.one(["quat", "expmap"]))
                ),
                "general": lambda: limited | geared | dict(
                    dyntype=draw.one(["none", "integrator", "filter", "filterexact"]), dynprm=draw.number(0.02, 0.3),
                    gainprm=draw.numbers(1, 0.5, 5), biastype=draw.one(["none", "affine"]), biasprm=[0.1, -1.0, -0.1],
                    actlimited=True, actrange=[-1.0, 1.0], actearly=draw.maybe(0.4, lambda: True),
                ),
            }[kind]()  # fmt: skip
            if kind == "general" and specific["dyntype"] == "none":
                del specific["actlimited"], specific["actrange"], specific["actearly"]
            if kind in ("dcmotor", "orientation"):
                del shared["forcerange"]
            add(actuators, kind, **(shared | specific))
            self.actuators.append(name)

    def sensors(self):
        draw = self.random
        sensors = add(self.root, "sensor")
        single = self.joints["hinge"] + self.joints["slide"]
        on = {
            "site": self.sites, "joint": single, "ball": self.joints["ball"], "tendon": self.tendons,
            "actuator": [name for name in self.actuators if name], "body": self.bodies, "ranged": self.ranged,
            "geom": self.geoms, "camera": self.cameras,
        }  # fmt: skip
        kinds = {
            "site": ["touch", "accelerometer", "velocimeter", "gyro", "force", "torque", "magnetometer", "rangefinder"],
            "joint": ["jointpos", "jointvel", "jointactuatorfrc"],
            "ball": ["ballquat", "ballangvel"],
            "ranged": ["jointlimitpos", "jointlimitvel", "jointlimitfrc"],
            "tendon": ["tendonpos", "tendonvel", "tendonactuatorfrc"],
            "actuator": ["actuatorpos", "actuatorvel", "actuatorfrc"],
            "body": ["subtreecom", "subtreelinvel", "subtreeangmom"],
        }
        frames = [
            "framepos", "framequat", "framexaxis", "frameyaxis", "framezaxis", "framelinvel", "frameangvel",
            "framelinacc", "frameangacc",
        ]  # fmt: skip
        choices = [(kind, thing) for thing, own in kinds.items() for kind in own if on[thing]]
        choices += [(kind, "frame") for kind in frames]
        choices += [(kind, "two") for kind in ("distance", "normal", "fromto") if len(self.with_geom) > 1]
        choices += [("contact", "contact"), ("insidesite", "inside"), ("camprojection", "projection")] * 2
        choices += [(kind, "world") for kind in ("clock", "e_potential", "e_kinetic", "user")]
        choices += [("rangefinder", "camera")]
        for place in draw.generator.permutation(len(choices))[: draw.count(3, 14)]:
            kind, thing = choices[place]
            delay = draw.maybe(0.1, lambda: draw.number(0.002, 0.02))
            attributes = dict(
                name=draw.maybe(0.95, lambda: self.name(kind)), delay=delay,
                nsample=None if delay is None else draw.count(1, 8),
                interval=draw.maybe(0.1, lambda: draw.number(0.004, 0.03)),
                cutoff=draw.maybe(0.1 * (kind not in UNCUT), lambda: draw.number(0.5, 5)),
            )  # fmt: skip
            if attributes["interval"] and not attributes["nsample"]:
                attributes["nsample"] = draw.count(1, 8)
            if attributes["nsample"]:
                attributes["interp"] = draw.one(["zoh", "linear", "cubic"])
            if kind == "user":
                attributes = dict(name=attributes["name"])
            own = self.sensed(kind, thing, on)
            if own is not None:
                add(sensors, kind, **(attributes | own))
        if self.has["touch_grid"] and self.sites:
            grid = add(sensors, "plugin", name=self.name("grid"), plugin="mujoco.sensor.touch_grid", objtype="site",
                       objname=draw.one(self.sites))  # fmt: skip
            for key, value in (("size", "3 2"), ("fov", "45 45"), ("gamma", "0"), ("nchannel", "3")):
                add(grid, "config", key=key, value=value)

    def sensed(self, kind, thing, on):
        """What a sensor is attached to; None if the model has no such thing."""
        draw = self.random
        if thing in ("site", "tendon", "actuator", "body", "joint"):
            return {thing: draw.one(on[thing])}
        if thing in ("ball", "ranged"):
            return {"joint": draw.one(on[thing])}
        framed = [(word, on[where]) for word, where in
                  (("body", "body"), ("xbody", "body"), ("geom", "geom"), ("site", "site")) if on[where]]  # fmt: skip
        if thing == "frame":
            objtype, names = draw.one(framed)
            found = dict(objtype=objtype, objname=draw.one(names))
            if kind not in ("framelinacc", "frameangacc") and draw.chance(0.4):
                reftype, names = draw.one(framed)
                found |= dict(reftype=reftype, refname=draw.one(names))
            return found
        if thing == "two":
            first, second = draw.generator.permutation(len(self.with_geom))[:2]
            return dict(body1=self.with_geom[first], body2=self.with_geom[second], cutoff=draw.number(0.5, 2))
        if thing == "contact":
            one = draw.one([dict(geom1=draw.one(self.geoms)), dict(subtree1=draw.one(self.bodies))])
            parts = ("found", "force", "torque", "dist", "pos", "normal", "tangent")
            data = [part for part in parts if draw.chance(0.4)]
            return one | dict(data=data or None, num=draw.count(1, 3),
                              reduce=draw.one(["none", "mindist", "maxforce", "netforce"]))  # fmt: skip
        if thing == "inside":
            objtype, names = draw.one(framed)
            return dict(objtype=objtype, objname=draw.one(names), site=draw.one(self.sites)) if self.sites else None
        if thing == "projection":
            has_both = self.cameras and self.sites
            return dict(camera=draw.one(self.cameras), site=draw.one(self.sites)) if has_both else None
        if thing == "camera":
            return dict(camera=draw.one(self.cameras)) if self.cameras else None
        return dict(dim=draw.count(1, 4)) if kind == "user" else {}

    def keyframes(self, compiled):
        """Adds keyframes with states that the model reaches under random controls."""
        draw = self.random
        data = mujoco.MjData(compiled)
        keyframe = add(self.root, "keyframe")
        self.keys = []
        for _ in range(draw.count(0, 3)):
            moved(compiled, data, draw, 30)
            whole = dict(qpos=data.qpos, qvel=data.qvel, act=data.act, ctrl=data.ctrl, mpos=data.mocap_pos,
                         mquat=data.mocap_quat)  # fmt: skip
            own = {key: values.ravel().tolist() for key, values in whole.items() if values.size and draw.chance(0.7)}
            name = self.name("key")
            add(keyframe, "key", name=name, time=draw.maybe(0.3, lambda: draw.number(0.5, 3)), **own)
            self.keys.append(name)


def control_ranges(model):
    """The lowest and the highest of each control."""
    limits = np.where(model.actuator_ctrllimited.astype(bool)[:, None], model.actuator_ctrlrange, [-1.0, 1.0])
    return limits[:, 0], limits[:, 1]


def moved(model, data, draw, steps):
    """Simulates under random controls, and returns whether MuJoCo gave no warning."""
    low, high = control_ranges(model)
    for step in range(steps):
        if step % 20 == 0:
            data.ctrl[:] = draw.generator.uniform(low, high)
        mujoco.mj_step(model, data)
    return not any(warning.number for warning in data.warning) and np.isfinite(data.qpos).all()


def draw_model(seed):
    """Returns a model that compiles and can be simulated, its text, and the number of models before it."""
    for attempt in range(100):
        model = Model(seed, attempt)
        try:
            compiled = mujoco.MjModel.from_xml_string(xml.tostring(model.root, "unicode"))
            if not moved(compiled, mujoco.MjData(compiled), Random(seed, attempt, 1), int(0.2 / compiled.opt.timestep)):
                continue
            model.keyframes(compiled)
            xml.indent(model.root)
            written = xml.tostring(model.root, "unicode")
            return model, mujoco.MjModel.from_xml_string(written), written
        except (ValueError, mujoco.FatalError) as error:
            print(f"seed {seed}, attempt {attempt}: {' '.join(str(error).split())}", file=sys.stderr)
    raise RuntimeError(f"seed {seed}: no model compiles")


def timing(draw, step):
    """Settings of a simulation with 10 to 24 samples, which takes 0.2 to 1 s of the model's time."""
    moves, samples = draw.count(2, 3), draw.count(5, 8)
    steps = max(1, round(draw.number(0.2, 1.0) / (moves * samples * step)))
    return dict(episodes=3, actuations_per_episode=moves, sample_rate_hz=1 / (steps * step),
                actuation_seconds=samples * steps * step)  # fmt: skip


class World:
    """A world file of a model, with what `harness world new` does not offer."""

    def __init__(self, model, compiled, simulation):
        self.model, self.compiled, self.random = model, compiled, model.random
        self.file = dict(
            model="model.xml", step_rate_hz=1 / compiled.opt.timestep, sample_rate_hz=simulation["sample_rate_hz"],
            modalities=self.modalities(), action=dict(seconds=simulation["actuation_seconds"]),
        )  # fmt: skip
        if model.keys and self.random.chance(0.7):
            self.file["keyframe"] = self.random.one(model.keys)
        self.file["action"]["actuators"] = self.elements()
        self.file["action"]["motion"] = self.random.one(["random_setpoints", "random_walk", "sinusoids"])
        self.file["factors"] = self.factors()

    def modalities(self):
        draw, model = self.random, self.model
        joints = [name for kind in model.joints.values() for name in kind]
        chosen = dict(q=dict(joint_positions=draw.one(["*", joints])), v=dict(joint_velocities=draw.one(["*", joints])))
        for name, key in (("places", "body_positions"), ("turns", "body_orientations")):
            chosen[name] = {key: draw.one(["*", model.bodies])}
        if model.sites:
            for name, key in (("site_places", "site_positions"), ("site_turns", "site_orientations")):
                chosen[name] = {key: "*"}
        for own in chosen.values():
            if not own.keys() & {"joint_positions", "joint_velocities"} and draw.chance(0.4):
                own["relative_to"] = draw.one(model.bodies)
        # A pattern does not match the names in capitals.
        has_several = sum(name.startswith("geom") for name in model.geoms) > 1
        touched = draw.one([model.geoms, model.with_geom] + ["geom*"] * has_several)
        chosen["force"] = dict(normal_force=touched, minimum=None)
        if draw.chance(0.5):
            half = len(model.geoms) // 2
            kinds = {"ground": model.geoms[:1], "low": model.geoms[1:half], "high": model.geoms[half:]}
            chosen["force"]["contact_kinds"] = {kind: geoms for kind, geoms in kinds.items() if geoms}
        if draw.chance(0.6):
            chosen["mean"] = chosen["force"] | dict(average_over="sample")
        chosen["push"] = dict(contact_normal=touched)
        if model.flexes:
            chosen["flex"] = dict(normal_force=model.flexes, minimum=None)
        if model.cameras:
            parts = {"ground": model.geoms[:1], "bodies": model.with_geom[:2], "soft": model.flexes}
            shared = dict(size=[12, 16])
            chosen["see"] = dict(camera=draw.one(model.cameras)) | shared
            chosen["depth"] = dict(depth=draw.one(model.cameras), range_m=[0.1, draw.number(0.5, 3)]) | shared
            classes = {name: things for name, things in parts.items() if things}
            chosen["parts"] = dict(segmentation=draw.one(model.cameras), classes=classes) | shared
        names = [self.compiled.sensor(index).name for index in range(self.compiled.nsensor)]
        if any(names):
            chosen["sensed"] = dict(sensor="*", unit="1")
        return chosen

    def elements(self):
        draw, compiled = self.random, self.compiled
        found = {}
        for place, name in enumerate(self.model.actuators):
            joint, first = compiled.actuator_trnid[place, 0], compiled.actuator_ctrladr[place]
            controls = list(controls_of(compiled, place)) or [None] * compiled.actuator_ctrlnum[place]
            for index, control in enumerate(controls):
                if name is None or draw.chance(0.15):
                    continue
                low, high = (limit[first + index] for limit in control_ranges(compiled))
                if compiled.actuator_trntype[place] == mujoco.mjtTrn.mjTRN_JOINT and compiled.jnt_limited[joint]:
                    low, high = max(low, compiled.jnt_range[joint, 0]), min(high, compiled.jnt_range[joint, 1])
                if high - low > 0.05:
                    inner = sorted(draw.numbers(2, low, high))
                    own = dict(actuator=name, range=draw.one([[float(low), float(high)], inner]))
                    if len(controls) > 1:
                        own["control"] = control
                    found[f"a{place}_{index}"] = own | dict(start=draw.one(["low", "middle", "high"]), unit="1")
        alone = [name for name, own in found.items() if "control" not in own]
        if len(alone) > 1 and draw.chance(0.3):
            one, other = found[alone[0]], found[alone[1]]
            low, high = (pick(bounds) for pick, bounds in zip((max, min), zip(one["range"], other["range"])))
            if high - low > 0.05:
                one |= dict(actuators=[one.pop("actuator"), other["actuator"]], range=[low, high])
                del found[alone[1]]
        for name in self.model.mocap:
            place = compiled.body(name).pos
            for index, axis in enumerate("xyz"):
                if draw.chance(0.6) or not found:
                    reach = [float(place[index] - 0.1), float(place[index] + draw.number(0.05, 0.2))]
                    found[f"{axis}{len(found)}"] = dict(mocap=name, axis=axis, unit="m", range=reach)
        return found

    def factors(self):
        draw, model, compiled = self.random, self.model, self.compiled
        single = model.joints["hinge"] + model.joints["slide"]
        stiff = [name for name in single if compiled.joint(name).stiffness[0] > 0]
        driven = {compiled.actuator_trnid[place, 0] for place in range(compiled.nactuator)}
        of_joint = compiled.eq_type == mujoco.mjtEq.mjEQ_JOINT
        driven |= {*compiled.eq_obj1id[of_joint], *compiled.eq_obj2id[of_joint]}
        free = [name for name in single if compiled.joint(name).id not in driven]
        gains = (mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtGain.mjGAIN_AFFINE)
        is_strong = np.isin(compiled.actuator_gaintype, gains)
        strong = [name for place, name in enumerate(model.actuators) if name and is_strong[place]]
        scale = dict(scale_by=dict(uniform=[0.6, 1.8]))
        offset = dict(offset_by=dict(uniform=[-0.1, 0.1]))
        choices = [("gravity", ["world"], scale)]
        choices += [("body_mass", model.with_geom, scale)] * bool(model.with_geom)
        choices += [("joint_damping", single, scale)] * bool(single)
        choices += [("joint_stiffness", stiff, scale)] * bool(stiff)
        choices += [("actuator_strength", strong, scale)] * bool(strong)
        choices += [("joint_start", free, offset)] * bool(free)
        found = {}
        for place, (key, names, drawing) in enumerate(draw.some(choices, 3) if draw.chance(0.6) else []):
            moved = [name for name in names if name not in model.mocap]
            if moved:
                # The offsets of hinges and slides have different units.
                each = {"each": True} if key == "joint_start" or key != "gravity" and draw.chance(0.5) else {}
                found[f"f{place}"] = {key: moved} | drawing | each
        return found

    def course(self, simulation):
        """Setpoints for each sample of the episodes, as a CSV file."""
        draw, elements = self.random, self.file["action"]["actuators"]
        samples = simulation["actuations_per_episode"] * round(
            simulation["actuation_seconds"] * simulation["sample_rate_hz"]
        )
        episodes = simulation["episodes"] if draw.chance(0.5) else 1
        # The order of the columns is not that of the elements.
        names = list(reversed(elements))
        rows = [",".join((["episode"] if episodes > 1 else []) + names)]
        for episode in range(episodes):
            for _ in range(samples):
                values = [draw.number(*elements[name]["range"]) for name in names]
                rows.append(",".join(map(repr, ([episode] if episodes > 1 else []) + values)))
        return "\n".join(rows) + "\n"


def main(folder, first, count):
    for seed in range(int(first), int(first) + int(count)):
        own = Path(folder) / str(seed)
        own.mkdir(parents=True, exist_ok=True)
        model, compiled, written = draw_model(seed)
        (own / "model.xml").write_text(written + "\n")
        simulation = timing(model.random, compiled.opt.timestep)
        if model.random.chance(0.5):
            world = World(model, compiled, simulation)
            if world.file["action"]["actuators"]:
                if model.random.chance(0.4):
                    world.file["action"]["course"] = "course.csv"
                    del world.file["action"]["motion"]
                    (own / "course.csv").write_text(world.course(simulation))
                simulation["factors"] = list(world.file["factors"])
                (own / "world.yaml").write_text(json.dumps(world.file, indent=1))
        (own / "simulation.json").write_text(json.dumps(simulation))


if __name__ == "__main__":
    main(*sys.argv[1:])
