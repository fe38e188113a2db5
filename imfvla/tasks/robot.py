"""A 7-joint arm with a parallel gripper, built from primitives: spherical shoulder, elbow, spherical wrist.

Frames: the base's x axis points to the workspace, z up. At zero angles the arm stands straight up. Joints turn about
z (yaw), y (shoulder), z (upper arm), y (elbow), z (forearm), y (wrist pitch), z (wrist roll). Lengths in m.
"""

import math

import numpy as np
from dm_control import composer, mjcf

from imfvla.tasks.bimanual_robot import JOINT_LIMITS

SHOULDER_HEIGHT = 0.18
UPPER_ARM = 0.34
FOREARM = 0.34
HAND = 0.20  # wrist centre to the point between the fingertips
FINGER_TRAVEL = 0.045  # of each finger; the opening is twice that
FINGER_LENGTH = 0.08
FINGERTIP = 0.006  # how far the fingers reach beyond the grip point
# Motors have a large armature for their damping on purpose: the contact solver knows inertia but not damping. Where
# damping times the time step exceeds the inertia, its forces are wrong and held objects jump.
STIFFNESS = (2500.0, 2500.0, 1500.0, 1500.0, 400.0, 400.0, 200.0)  # [N m / rad]
ARMATURE = (1.0, 1.0, 0.7, 0.7, 0.2, 0.2, 0.15)  # [kg m^2]
LAG_S = 0.04  # damping over stiffness: joints follow their targets nearly like a first-order filter
FINGER_ARMATURE = 0.8  # [kg]
GRIP_GAIN, GRIP_LAG_S = 6.0, 0.045  # force per unit of opening: some 18 N at each finger around a 24 mm bar
HAND_BITS = {"left": 4, "right": 8}  # collision groups; table 1, objects 2
TABLE_BIT, OBJECT_BIT = 1, 2
HOME_REACH, HOME_HEIGHT = 0.26, 0.25  # of the point between the fingertips, from the base

_LIGHT = {"left": (0.35, 0.38, 0.45, 1.0), "right": (0.75, 0.76, 0.78, 1.0)}
_DARK = (0.18, 0.18, 0.20, 1.0)
_FINGER = (0.10, 0.55, 0.50, 1.0)


def home_joints() -> np.ndarray:
    """Joint angles (7,) [rad] of the start posture: hand pointing down, wrist roll neutral, elbow high."""
    rise = HOME_HEIGHT + HAND - SHOULDER_HEIGHT
    distance = math.hypot(HOME_REACH, rise)
    bend = math.acos((UPPER_ARM**2 + distance**2 - FOREARM**2) / (2 * UPPER_ARM * distance))
    shoulder = math.atan2(HOME_REACH, rise) - bend
    elbow = math.pi - math.acos((UPPER_ARM**2 + FOREARM**2 - distance**2) / (2 * UPPER_ARM * FOREARM))
    return np.array([0.0, shoulder, 0.0, elbow, 0.0, math.pi - shoulder - elbow, 0.0])


def look_at(position: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """MuJoCo's `xyaxes` (6,) of a camera at `position` that looks at `target`."""
    backward = np.subtract(position, target) / np.linalg.norm(np.subtract(position, target))
    right = np.cross(up, backward)
    right /= np.linalg.norm(right)
    return np.concatenate([right, np.cross(backward, right)])


class Arm(composer.Entity):
    """One arm. `side` is "left" or "right" and names the model, so that its elements are `left/joint_1` and so on."""

    def _build(self, side: str) -> None:
        self.side = side
        self._root = mjcf.RootElement(model=side)
        self._root.compiler.angle = "radian"
        self._root.default.geom.contype = 0
        self._root.default.geom.conaffinity = 0
        body = self._root.worldbody
        body.add("geom", type="cylinder", size=[0.07, 0.05], pos=[0, 0, 0.05], rgba=_DARK, mass=1)
        link = self._link(body, 1, [0, 0, SHOULDER_HEIGHT], "z")
        link.add(
            "geom", type="capsule", size=[0.055], fromto=[0, 0, -0.08, 0, 0, 0], rgba=_LIGHT[side], mass=2
        )
        link = self._link(link, 2, [0, 0, 0], "y")
        link.add(
            "geom",
            type="capsule",
            size=[0.045],
            fromto=[0, 0, 0, 0, 0, UPPER_ARM / 2],
            rgba=_LIGHT[side],
            mass=1.5,
        )
        link = self._link(link, 3, [0, 0, UPPER_ARM / 2], "z")
        link.add(
            "geom",
            type="capsule",
            size=[0.042],
            fromto=[0, 0, 0, 0, 0, UPPER_ARM / 2],
            rgba=_LIGHT[side],
            mass=1,
        )
        link = self._link(link, 4, [0, 0, UPPER_ARM / 2], "y")
        link.add(
            "geom",
            type="capsule",
            size=[0.04],
            fromto=[0, 0, 0, 0, 0, FOREARM / 2],
            rgba=_LIGHT[side],
            mass=1,
        )
        link = self._link(link, 5, [0, 0, FOREARM / 2], "z")
        link.add(
            "geom",
            type="capsule",
            size=[0.036],
            fromto=[0, 0, 0, 0, 0, FOREARM / 2],
            rgba=_LIGHT[side],
            mass=0.7,
        )
        link = self._link(link, 6, [0, 0, FOREARM / 2], "y")
        link.add("geom", type="capsule", size=[0.034], fromto=[0, 0, 0, 0, 0, 0.04], rgba=_DARK, mass=0.4)
        self._add_camera(link)
        self._add_gripper(self._link(link, 7, [0, 0, 0.05], "z"))
        for index, (stiffness, limits) in enumerate(zip(STIFFNESS, JOINT_LIMITS, strict=True), start=1):
            self._root.actuator.add(
                "position",
                name=f"joint_{index}",
                joint=f"joint_{index}",
                kp=stiffness,
                kv=LAG_S * stiffness,
                ctrllimited=True,
                ctrlrange=limits,
            )
        self._root.actuator.add(
            "position",
            name="gripper",
            tendon="opening",
            kp=GRIP_GAIN,
            kv=GRIP_LAG_S * GRIP_GAIN,
            ctrllimited=True,
            ctrlrange=[0, 1],
        )

    def _link(self, parent: mjcf.Element, index: int, pos: list[float], axis: str) -> mjcf.Element:
        link = parent.add("body", name=f"link_{index}", pos=pos, gravcomp=1)
        link.add(
            "joint",
            name=f"joint_{index}",
            type="hinge",
            axis=[0, 1, 0] if axis == "y" else [0, 0, 1],
            limited=True,
            range=JOINT_LIMITS[index - 1],
            armature=ARMATURE[index - 1],
        )
        return link

    def _add_camera(self, link: mjcf.Element) -> None:
        """The wrist camera sits before the wrist roll: what it sees does not turn with the gripper.

        In this link's frame the hand points along +z and, with the hand down, away from the base is -x.
        """
        side = 1 if self.side == "right" else -1
        position, target = np.array([-0.065, -0.115 * side, 0.03]), np.array([-0.05, 0.0, HAND + 0.015])
        link.add(
            "camera",
            name="wrist",
            pos=position,
            xyaxes=look_at(position, target, np.array([0, 0, -1.0])),
            fovy=66,
        )

    def _add_gripper(self, hand: mjcf.Element) -> None:
        """Two fingers on slides, coupled to move as mirror images, one actuator for the opening in [0, 1].

        A finger is a pair of capsules: against a box's face each makes two steady contacts, where two boxes' contacts
        come and go from step to step while their faces are nearly parallel, and objects fall.
        """
        solid = {
            "contype": HAND_BITS[self.side],
            "conaffinity": TABLE_BIT + OBJECT_BIT + sum(HAND_BITS.values()) - HAND_BITS[self.side],
            "friction": [1.5, 0.05, 0.001],
            "condim": 4,
            "solref": [0.01, 1],
            "solimp": [0.95, 0.99, 0.001],
        }
        tip = HAND - 0.05  # in this body's frame
        palm = tip + FINGERTIP - FINGER_LENGTH
        hand.add(
            "geom", name="palm", type="box", size=[0.058, 0.017, 0.014], pos=[0, 0, palm - 0.014], rgba=_DARK, mass=0.4,
            **solid,
        )  # fmt: skip
        quat = [0, 0, 1, 0] if self.side == "left" else [0, 1, 0, 0]  # world-aligned at home, for both arms
        hand.add("site", name="grip", pos=[0, 0, tip], quat=quat, size=[0.003], rgba=[0, 0, 0, 0])
        joints = []
        for name, sign in (("a", 1), ("b", -1)):
            finger = hand.add(
                "body", name=f"finger_{name}", pos=[sign * 0.006, 0, tip + FINGERTIP], gravcomp=1
            )
            joints.append(
                finger.add(
                    "joint", name=f"finger_{name}", type="slide", axis=[sign, 0, 0], limited=True,
                    range=[0, FINGER_TRAVEL], armature=FINGER_ARMATURE,
                )
            )  # fmt: skip
            for pad, aside in (("near", -0.008), ("far", 0.008)):
                finger.add(
                    "geom", name=f"finger_{name}_{pad}", type="capsule", size=[0.006],
                    fromto=[0, aside, -0.006, 0, aside, -FINGER_LENGTH], rgba=_FINGER, mass=0.025, **solid,
                )  # fmt: skip
        tendon = self._root.tendon.add("fixed", name="opening")
        for joint in joints:
            tendon.add("joint", joint=joint, coef=0.5 / FINGER_TRAVEL)
        self._root.equality.add(
            "joint", joint1=joints[0], joint2=joints[1], polycoef=[0, 1, 0, 0, 0], solref=[0.008, 1]
        )

    @property
    def mjcf_model(self) -> mjcf.RootElement:
        return self._root
