"""Socket peg insertion: the left arm lifts a square ring, the right arm a square bar, and they meet in the air."""

from dataclasses import dataclass

import numpy as np
from dm_control import mjcf

from imfvla.tasks.bimanual import BimanualTask, Pose, StartRange
from imfvla.tasks.props import BAR_WIDTH, RING_THICKNESS, Bar, Socket

PEG_LENGTH = 0.17
APERTURE = {"easy": 0.036, "default": 0.032, "hard": 0.028}
RANGES = {  # the socket's frame is its mouth, some 5 cm towards the middle of the table from its centre
    "easy": (
        StartRange((-0.18, -0.14), (-0.02, 0.02), (-0.1, 0.1)),
        StartRange((0.16, 0.20), (-0.02, 0.02), (-0.1, 0.1)),
    ),
    "default": (
        StartRange((-0.26, -0.06), (-0.125, 0.125), (-0.55, 0.55)),
        StartRange((0.08, 0.28), (-0.125, 0.125), (-0.55, 0.55)),
    ),
    "hard": (
        StartRange((-0.28, -0.06), (-0.15, 0.15), (-0.7, 0.7)),
        StartRange((0.08, 0.30), (-0.15, 0.15), (-0.7, 0.7)),
    ),
}
LIFTED = 0.03  # above the resting height
# stage 3: distance along the axis and off it, tilt [rad]
AT_MOUTH, AT_MOUTH_ASIDE, AT_MOUTH_ANGLE = 0.03, 0.015, 0.25
INSIDE, INSIDE_ANGLE = 0.005, 0.12  # stage 4
SEATED = RING_THICKNESS - 0.002  # stage 5: depth at which the tip is through the ring


@dataclass(frozen=True, slots=True)
class Fit:
    """The peg relative to the socket: depth of its tip along the hole [m], offset of the tip (2,) [m], tilt [rad]."""

    depth: float
    aside: np.ndarray
    angle: float


class SocketTask(BimanualTask):
    """Stages: 1 each arm holds its object, 2 both lifted, 3 tip at the mouth, 4 tip inside and aligned, 5 seated."""

    name = "socket"

    def __init__(self, variant: str) -> None:
        super().__init__(
            variant, {"socket": Socket("socket", APERTURE[variant]), "peg": Bar("peg", PEG_LENGTH)}
        )
        self.ranges = dict(zip(("socket", "peg"), RANGES[variant], strict=True))

    def stage(self, physics: mjcf.Physics) -> int:
        return insertion_stage(self, physics)


def insertion_stage(task: BimanualTask, physics: mjcf.Physics) -> int:
    """The stage, 0 to 5, of the objects "socket" and "peg" of a task."""
    contacts = task.contacts(physics)
    if not (task.holds(contacts, "left", "socket") and task.holds(contacts, "right", "peg")):
        return 0
    socket, peg = (task.prop_pose(physics, name) for name in ("socket", "peg"))
    for name, pose in (("socket", socket), ("peg", peg)):
        if pose.position[2] < task.props[name].rest_height + LIFTED:
            return 1
    fit = measure_fit(socket, peg)
    aside = float(np.abs(fit.aside).max())
    play = (task.props["socket"].aperture - BAR_WIDTH) / 2 + 0.002
    if fit.depth > INSIDE and aside < play and fit.angle < INSIDE_ANGLE:
        return 5 if fit.depth >= SEATED else 4
    near = abs(fit.depth) < AT_MOUTH and aside < AT_MOUTH_ASIDE and fit.angle < AT_MOUTH_ANGLE
    return 3 if near else 2


def measure_fit(socket: Pose, peg: Pose) -> Fit:
    """Fit of the peg's end that points into the hole; either end will do, the bar is symmetric."""
    inward = -socket.rotation[:, 0]
    along = peg.rotation[:, 0] if peg.rotation[:, 0] @ inward > 0 else -peg.rotation[:, 0]
    tip = socket.rotation.T @ (peg.position + along * PEG_LENGTH / 2 - socket.position)
    return Fit(depth=-tip[0], aside=tip[1:], angle=float(np.arccos(np.clip(along @ inward, -1, 1))))
