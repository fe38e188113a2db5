"""How two hands move in gym-aloha's tasks: waypoints as ACT's authors use them (arXiv 2304.13705). Needs numpy only.

Positions are of the fingertips in the world [m]: x from the left arm to the right one, y away from the camera "angle",
z up, table top at 0. Orientations are quaternions (w, x, y, z); at (1, 0, 0, 0) an arm points at the other one with its
fingers side by side. Times are control steps.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

SIDES = ("left", "right")
HOME = {"left": np.array([-0.182, 0.5, 0.297]), "right": np.array([0.182, 0.5, 0.297])}
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
OPEN, CLOSED, AT_START = 1.0, 0.0, 0.1  # openings of a gripper
CUBE_REST, SOCKET_REST = 0.02, 0.022  # height of the centre of an object on the table [m]
# The peg is held above its centre: fingers at its own height would press on the table.
PEG_GRIP = 0.02
# While a peg is lifted it sags in the fingers by this much more than a socket.
PEG_SAG = 0.01
TOUCHING = 0.1  # between the centres of peg and socket when the peg meets the pin [m]


@dataclass(frozen=True, slots=True)
class Style:
    """What varies from episode to episode."""

    pace: float  # factor on all times
    hover: float  # height above an object before the hand goes down [m]
    pitch: float  # how far a hand that picks looks down [rad]
    meet: tuple[float, float, float]  # displacement of the meeting point [m]

    @classmethod
    def draw(cls, rng: np.random.Generator, spread: float) -> "Style":
        """A style around the usual one; `spread` 0 is the usual one."""

        def around(middle: float, width: float) -> float:
            return float(middle + spread * width * rng.uniform(-1, 1))

        return cls(
            pace=around(1.0, 0.1),
            hover=around(0.1, 0.02),
            pitch=around(np.pi / 3, 0.1),
            meet=(around(0, 0.015), around(0, 0.015), around(0, 0.015)),
        )

    def to_json(self) -> dict[str, float]:
        x, y, z = self.meet
        return {
            "pace": self.pace,
            "hover": self.hover,
            "pitch": self.pitch,
            "meet_x": x,
            "meet_y": y,
            "meet_z": z,
        }


@dataclass(slots=True)
class Track:
    """The way of one hand: straight lines from waypoint to waypoint."""

    position: np.ndarray
    orientation: np.ndarray = field(default_factory=LEVEL.copy)
    opening: float = AT_START
    _points: list[np.ndarray] = field(default_factory=list)  # (9,): time, position, orientation, opening

    def __post_init__(self) -> None:
        self.until(0)

    def until(
        self,
        step: float,
        position: np.ndarray | None = None,
        orientation: np.ndarray | None = None,
        opening: float | None = None,
    ) -> "Track":
        """Arrives at `step`; what is not given stays as it is. Steps rise from call to call."""
        self.position = self.position if position is None else position
        self.orientation = self.orientation if orientation is None else orientation
        self.opening = self.opening if opening is None else opening
        self._points.append(np.concatenate([[step], self.position, self.orientation, [self.opening]]))
        return self

    @property
    def end(self) -> float:
        """The step of the last waypoint."""
        return float(self._points[-1][0])

    def at(self, step: float) -> np.ndarray:
        """(8,): position, orientation and opening at `step`."""
        points = np.array(self._points)
        values = np.array([np.interp(step, points[:, 0], column) for column in points[:, 1:].T])
        values[3:7] /= np.linalg.norm(values[3:7])
        return values


def about(axis: tuple[float, float, float], angle: float) -> np.ndarray:
    """The quaternion of a rotation about a unit axis by `angle` [rad]."""
    return np.array([np.cos(angle / 2), *(np.sin(angle / 2) * np.array(axis))])


def transfer_tracks(objects: np.ndarray, style: Style) -> Mapping[str, Track]:
    """The right hand lifts the cube and holds it out; the left hand takes it from the side. objects: pose (7,)."""
    cube, above = _resting(objects[:3], CUBE_REST), np.array([0, 0, style.hover])
    meet = np.array([0, 0.5, 0.25]) + style.meet
    aside = np.array([-0.12, 0, 0])
    t = _times(style, (80, 110, 120, 155, 220, 245, 285, 305, 350))
    right = (
        _looking_down("right", style).until(t[0], cube + above, opening=OPEN).until(t[1], cube).until(t[2])
    )
    right.until(t[3], opening=CLOSED).until(t[4], meet).until(t[6])
    right.until(t[7], opening=OPEN).until(t[8], meet - aside + [0, 0, 0.05])
    left = Track(HOME["left"]).until(t[0], meet + aside, about((1, 0, 0), np.pi / 2), OPEN).until(t[4])
    # A centimetre beyond the cube's middle, so that the fingers hold it and do not pinch its edge.
    left.until(t[5], meet + [0.01, 0, 0]).until(t[6], opening=CLOSED).until(t[7]).until(
        t[8], meet + aside / 2
    )
    return {"left": left, "right": right}


def insertion_tracks(objects: np.ndarray, style: Style) -> Mapping[str, Track]:
    """Both hands lift, meet in the air and push. objects: poses (14,) of peg and socket."""
    peg, socket = _resting(objects[:3], PEG_GRIP), _resting(objects[7:10], SOCKET_REST)
    meet, above = np.array([0, 0.5, 0.15]) + style.meet, np.array([0, 0, style.hover])
    t = _times(style, (80, 110, 120, 160, 240, 255, 320, 340))
    tracks = {}
    for side, sign, grip, sag in (("left", -1, socket, 0.0), ("right", 1, peg, PEG_SAG)):
        apart, together = (np.array([sign * x, 0, sag]) for x in (0.12, TOUCHING / 2 - 0.002))
        track = _looking_down(side, style).until(t[0], grip + above, opening=OPEN)
        track.until(t[1], grip).until(t[2]).until(t[3], opening=CLOSED).until(t[4], meet + apart).until(t[5])
        tracks[side] = track.until(t[6], meet + together).until(t[7])
    return tracks


def _looking_down(side: str, style: Style) -> Track:
    """A hand that turns down before it goes anywhere.

    Between level and down the wrist is straight, and a hand that moves aside meanwhile may turn its forearm over: its
    wrist then ends at a limit, askew.
    """
    sign = {"left": -1, "right": 1}[side]
    return Track(HOME[side]).until(25 * style.pace, orientation=about((0, 1, 0), -sign * style.pitch))


def _resting(position: np.ndarray, height: float) -> np.ndarray:
    """An object is measured where it is let go, and falls onto the table."""
    return np.array([position[0], position[1], height])


def _times(style: Style, steps: tuple[int, ...]) -> list[float]:
    return [style.pace * step for step in steps]
