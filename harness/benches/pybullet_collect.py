"""Collects samples with PyBullet, as SoMo simulates a soft finger, for comparison with the harness's rate.

    python harness/benches/pybullet_collect.py --scenario empty --courses courses.bin --samples-per-episode 100

It simulates the same finger, arm, ground, boxes and camera at 1 kHz, with the same commanded motions. The example
`courses` writes these motions to `courses.bin`. At each step, the torques of the joints' springs are computed in
Python from the angles, as in SoMo, and the normal forces of the finger's contacts are read. For each sample, the
angles, the arm, the forces and a frame of 64 x 64 pixels are recorded in memory. The frame is rendered by PyBullet's
TinyRenderer (its CPU renderer).

Differences from the harness's simulation:
- It uses Bullet's articulated bodies and sequential impulses instead of MuJoCo's. Contacts are hard, and the multi-body
  has no joint armature. DAMPING and INERTIA below keep the explicit springs stable.
- The angles and torques of all joints pass in one call each, which is faster than SoMo's one call per joint.
- PyBullet's position control drives the arm with a large force, and follows without the harness's lag of 7 ms.
- There are no joint limits, and no collisions with the arm's column.
- Shadows are off, as in the harness's frames. Boxes may sleep.

Needs pybullet and numpy. Prints JSON. The time runs from when all processes are ready until the last one is done.
Run it on an otherwise idle machine.
"""

import argparse
import math
import tempfile

import courses
import numpy as np

JOINTS = 20
ARM = 3
BOXES = 8
FRAME_SIDE = 64
# As in models/compose.py.
LINK_LENGTH, LINK_RADIUS, LINK_MASS = 0.05, 0.045, 0.01  # m, m, kg
STIFFNESS = 20.0  # N m/rad
BOX_HALF_SIZE, BOX_MASS = (0.15, 0.15, 0.20), 1.0  # m, kg
FINGER_FRICTION, BOX_FRICTION = 0.8, 0.5
CAMERA_POSITION, CAMERA_TARGET, CAMERA_FOVY = (-3.8, -2.55, 3.55), (-0.79, 0.44, 0.0), 34  # m, m, degrees
TIMESTEP = 1e-3  # s
# These replace the harness's 3 N m s/rad and its joints' armature of 1e-3 kg m2, see above.
DAMPING = 0.5  # N m s/rad
INERTIA = 1e-3  # kg m2, of each link about each of its axes
ARM_FORCE = 1e5  # N or N m, at most
ARM_RGBA, BOX_RGBA = (0.25, 0.28, 0.33), ((0.30, 0.50, 1.0, 1), (0.20, 0.75, 0.65, 1))
GROUND_RGBA = (0.85, 0.85, 0.82, 1)


def robot_urdf() -> str:
    """Returns the URDF. Joints 0 to 2 belong to the arm, the following ones to the finger, from base to tip."""

    def link(name, mass, inertia, center, shape, rgb, collides):
        geometry = f'<origin xyz="{center}"/><geometry>{shape}</geometry>'
        moments = f'ixx="{inertia}" iyy="{inertia}" izz="{inertia}" ixy="0" ixz="0" iyz="0"'
        collision = f"<collision>{geometry}</collision>" if collides else ""
        return (
            f'<link name="{name}"><inertial><origin xyz="{center}"/><mass value="{mass}"/>'
            f'<inertia {moments}/></inertial><visual>{geometry}<material name="{name}">'
            f'<color rgba="{rgb[0]} {rgb[1]} {rgb[2]} 1"/></material></visual>{collision}</link>'
        )

    def joint(name, kind, parent, child, place, axis):
        return (
            f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{place}"/><axis xyz="{axis}"/>'
            f'<limit lower="-10" upper="10" effort="1e6" velocity="1e3"/></joint>'
        )

    parts = ['<link name="world"/>']
    shaft = '<cylinder radius="0.05" length="1.4"/>'
    carriage, beam = '<box size="0.24 0.18 0.18"/>', '<box size="1.6 0.05 0.05"/>'
    parts.append(link("shaft", 5, 1, "0 0 1", shaft, ARM_RGBA, False))
    parts.append(joint("rotation", "continuous", "world", "shaft", "0 0 0", "0 0 1"))
    parts.append(link("carriage", 2, 0.1, "0 0 0", carriage, ARM_RGBA, False))
    parts.append(joint("lift", "prismatic", "shaft", "carriage", "0 0 1.5", "0 0 1"))
    parts.append(link("beam", 1, 0.1, "-0.8 0 0", beam, ARM_RGBA, False))
    parts.append(joint("extension", "prismatic", "carriage", "beam", "0.7 0 0", "1 0 0"))
    capsule = f'<capsule radius="{LINK_RADIUS}" length="{LINK_LENGTH}"/>'
    for index in range(JOINTS):
        share = index / (JOINTS - 1)
        rgb = (1 - 0.15 * share, 0.75 * (1 - share), 0.35 * share)
        parent, place = (f"link_{index - 1}", f"0 0 {-LINK_LENGTH}") if index else ("beam", "0 0 0")
        parts.append(link(f"link_{index}", LINK_MASS, INERTIA, f"0 0 {-LINK_LENGTH / 2}", capsule, rgb, True))
        axis = "1 0 0" if index % 2 else "0 1 0"
        parts.append(joint(f"joint_{index}", "continuous", parent, f"link_{index}", place, axis))
    # PyBullet's parser reads lines of at most 1024 characters.
    return "\n".join(['<robot name="robot">', *parts, "</robot>"])


class Collector:
    """One scene, used by the process that created it."""

    def __init__(self, options: argparse.Namespace):
        import pybullet

        self.bullet = bullet = pybullet
        bullet.connect(bullet.DIRECT)
        bullet.setTimeStep(TIMESTEP)
        bullet.setGravity(0, 0, -9.81)
        plane = bullet.createCollisionShape(bullet.GEOM_PLANE)
        seen = bullet.createVisualShape(
            bullet.GEOM_BOX,
            halfExtents=(10, 10, 0.001),
            rgbaColor=GROUND_RGBA,
            visualFramePosition=(0, 0, -0.001),
        )
        ground = bullet.createMultiBody(0, plane, seen)
        bullet.changeDynamics(ground, -1, lateralFriction=BOX_FRICTION)
        with tempfile.NamedTemporaryFile("w", suffix=".urdf") as urdf:
            urdf.write(robot_urdf())
            urdf.flush()
            self.robot = bullet.loadURDF(
                urdf.name, useFixedBase=True, flags=bullet.URDF_USE_INERTIA_FROM_FILE
            )
        self.arm, self.finger = list(range(ARM)), list(range(ARM, ARM + JOINTS))
        for joint in self.finger:
            bullet.changeDynamics(self.robot, joint, lateralFriction=FINGER_FRICTION)
        # By default a motor holds each joint. Without force it leaves the joints to the springs.
        bullet.setJointMotorControlArray(
            self.robot, self.finger, bullet.VELOCITY_CONTROL, forces=[0.0] * JOINTS
        )
        self.boxes = self.make_boxes() if options.scenario == "cluttered" else []
        self.view = bullet.computeViewMatrix(CAMERA_POSITION, CAMERA_TARGET, (0, 0, 1))
        self.projection = bullet.computeProjectionMatrixFOV(CAMERA_FOVY, 1, 0.1, 20)

    def make_boxes(self) -> list[int]:
        bullet = self.bullet
        shape = bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=BOX_HALF_SIZE)
        boxes = []
        for index in range(BOXES):
            seen = bullet.createVisualShape(
                bullet.GEOM_BOX, halfExtents=BOX_HALF_SIZE, rgbaColor=BOX_RGBA[index % 2]
            )
            # A contact multiplies the frictions of the finger and the box, like those of the finger and the ground.
            box = bullet.createMultiBody(BOX_MASS, shape, seen)
            bullet.changeDynamics(
                box,
                -1,
                lateralFriction=BOX_FRICTION,
                activationState=bullet.ACTIVATION_STATE_ENABLE_SLEEPING,
            )
            boxes.append(box)
        return boxes

    def start(self, course: courses.Course) -> None:
        """Moves the arm to the start, straightens the finger, and puts the boxes in their places, at rest."""
        for joint, value in zip(self.arm + self.finger, course.start):
            self.bullet.resetJointState(self.robot, joint, value)
        poses = course.start[ARM + JOINTS :].reshape(-1, 7)
        for box, (x, y, z, qw, qx, qy, qz) in zip(self.boxes, poses):
            self.bullet.resetBasePositionAndOrientation(box, (x, y, z), (qx, qy, qz, qw))
            self.bullet.resetBaseVelocity(box, (0, 0, 0), (0, 0, 0))

    def episode(self, course: courses.Course) -> np.ndarray:
        """Simulates one episode from rest, and records it."""
        bullet, robot, finger = self.bullet, self.robot, self.finger
        self.start(course)
        samples = course.samples
        proprioception = np.empty((samples, JOINTS), np.float32)
        arm = np.empty((samples, ARM), np.float32)
        contact_force = np.empty((samples, JOINTS), np.float32)
        contact_force_mean = np.empty((samples, JOINTS), np.float32)
        vision = np.empty((samples, FRAME_SIDE, FRAME_SIDE, 3), np.uint8)

        arm_forces = [ARM_FORCE] * ARM
        sums, steps = [0.0] * JOINTS, 0
        for index, setpoint in enumerate(course.controls.tolist()):
            row, phase = divmod(index, course.steps_per_sample)
            states = bullet.getJointStates(robot, finger)
            torques = [-STIFFNESS * state[0] - DAMPING * state[1] for state in states]
            bullet.setJointMotorControlArray(robot, finger, bullet.TORQUE_CONTROL, forces=torques)
            bullet.setJointMotorControlArray(
                robot, self.arm, bullet.POSITION_CONTROL, targetPositions=setpoint, forces=arm_forces
            )
            if phase == 0:
                proprioception[row] = [state[0] for state in states]
                arm[row] = [state[0] for state in bullet.getJointStates(robot, self.arm)]
            bullet.stepSimulation()
            steps += 1
            forces = [0.0] * JOINTS
            for contact in bullet.getContactPoints(bodyA=robot):
                forces[contact[3] - ARM] += contact[9]
            sums = [total + force for total, force in zip(sums, forces)]
            if phase == 0:
                contact_force[row] = forces
                contact_force_mean[row] = [total / steps for total in sums]
                sums, steps = [0.0] * JOINTS, 0
                vision[row] = self.frame()
        largest = np.abs(proprioception).max()
        if not largest < math.pi:  # nor is NaN
            raise RuntimeError(
                f"the simulation of episode {course.index} diverged: a joint turned by {largest}"
            )
        self.recorded = proprioception, arm, contact_force, contact_force_mean, vision
        return contact_force_mean

    def frame(self) -> np.ndarray:
        """Returns the present camera image, [64, 64, 3] u8."""
        bullet = self.bullet
        _, _, pixels, _, _ = bullet.getCameraImage(
            FRAME_SIDE,
            FRAME_SIDE,
            self.view,
            self.projection,
            shadow=0,
            renderer=bullet.ER_TINY_RENDERER,
            flags=bullet.ER_NO_SEGMENTATION_MASK,
        )
        return np.reshape(pixels, (FRAME_SIDE, FRAME_SIDE, 4))[..., :3]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    courses.add_arguments(parser)
    courses.collect(Collector, parser.parse_args())


if __name__ == "__main__":
    main()
