"""The objects of the tasks: a square bar, a square ring on a tab, a post. Lengths in m, densities in kg / m^3."""

import numpy as np
from dm_control import composer, mjcf

from imfvla.tasks.robot import HAND_BITS, OBJECT_BIT, TABLE_BIT

BAR_WIDTH = 0.024
RING_OUTSIDE = 0.068
RING_THICKNESS = 0.024
FLARE = 0.011  # length of the lips that guide a peg into the mouth
TAB_LENGTH = 0.07
TAB_WIDTH = 0.024
TAB_HEIGHT = 0.022
POST_RADIUS, POST_HEIGHT = 0.007, 0.125
FOOT_RADIUS, FOOT_HEIGHT, FOOT_DENSITY = 0.03, 0.01, 7800  # heavy enough that a grazed post stays up

ORANGE = (0.95, 0.45, 0.05, 1.0)
YELLOW = (0.98, 0.90, 0.10, 1.0)
BLUE = (0.10, 0.25, 0.90, 1.0)
MAGENTA = (0.90, 0.10, 0.65, 1.0)
GREEN = (0.05, 0.60, 0.25, 1.0)

Color = tuple[float, float, float, float]

_SOLID = {
    "type": "box",
    "contype": OBJECT_BIT,
    "conaffinity": TABLE_BIT + OBJECT_BIT + sum(HAND_BITS.values()),
    "friction": [0.3, 0.01, 0.0005],  # in the hole; the larger friction of table or finger replaces it
    "condim": 3,  # 4 in contacts with a finger, which asks for 4
    "solref": [0.01, 1],
    "solimp": [0.95, 0.99, 0.001],
    "density": 900,
}


class Prop(composer.Entity):
    """A rigid object whose frame lies at the centre of what the task aligns; `rest_height` is its z on the table."""

    rest_height: float

    def _build(self, name: str) -> None:
        self._root = mjcf.RootElement(model=name)
        self._root.compiler.angle = "radian"

    def _box(self, name: str, pos: tuple[float, ...], half: tuple[float, ...], rgba: Color, **more) -> None:
        self._root.worldbody.add("geom", name=name, pos=pos, size=half, rgba=rgba, **_SOLID, **more)

    def _paint(self, pos: tuple[float, ...], half: tuple[float, ...], rgba: Color) -> None:
        self._root.worldbody.add(
            "geom", type="box", pos=pos, size=half, rgba=rgba, contype=0, conaffinity=0, mass=0
        )  # fmt: skip

    @property
    def mjcf_model(self) -> mjcf.RootElement:
        return self._root


class Bar(Prop):
    """A square bar along x. Both ends carry the same cap, so that half a turn makes no visible difference."""

    def _build(
        self, name: str, length: float, color: Color = ORANGE, cap: float = 0.02, width: float = BAR_WIDTH
    ) -> None:
        super()._build(name)
        self.length = length
        half = width / 2
        self.rest_height = half
        self._box("bar", (0, 0, 0), (length / 2, half, half), color)
        for sign in (-1, 1):
            skin = half + 3e-4
            self._paint((sign * (length - cap) / 2, 0, 0), (cap / 2 + 2e-4, skin, skin), YELLOW)


class Socket(Prop):
    """A square ring, its aperture along x with the mouth at +x, standing on a tab that reaches to -x.

    The frame lies in the middle of the mouth, so that a peg's depth is minus the x of its tip.
    """

    def _build(self, name: str, aperture: float) -> None:
        super()._build(name)
        self.aperture = aperture
        self.rest_height = RING_OUTSIDE / 2
        half, wall = RING_OUTSIDE / 2, (RING_OUTSIDE - aperture) / 4
        middle, depth = (aperture / 2 + wall), RING_THICKNESS / 2
        for side, sign in (("bottom", -1), ("top", 1)):
            self._box(side, (-depth, 0, sign * middle), (depth, half, wall), BLUE)
        for side, sign in (("near", -1), ("far", 1)):
            self._box(side, (-depth, sign * middle, 0), (depth, wall, aperture / 2), BLUE)
        tab = (-RING_THICKNESS - TAB_LENGTH / 2, 0, TAB_HEIGHT / 2 - half)
        self._box("tab", tab, (TAB_LENGTH / 2, TAB_WIDTH / 2, TAB_HEIGHT / 2), BLUE)
        reach, thickness = FLARE / np.sqrt(2), 0.0015
        width, ahead = aperture / 2 + reach / 2, np.array([1, 0, 0])
        for side, turn in (("above", (0, -1)), ("below", (0, 1)), ("left", (1, 0)), ("right", (-1, 0))):
            out = np.array([0, turn[0], -turn[1]])  # the lip leans 45 degrees to this side
            pos = out * (aperture / 2) + reach / 2 * (out + ahead) + thickness / np.sqrt(2) * (out - ahead)
            half = (FLARE / 2, thickness, width) if turn[0] else (FLARE / 2, width, thickness)
            self._box(f"lip_{side}", pos, half, MAGENTA, euler=(0, turn[1] * np.pi / 4, turn[0] * np.pi / 4))
        self.tab_centre = tab


class Post(Prop):
    """An upright post on a round foot, free to be knocked over. The frame lies on its axis where it stands."""

    rest_height = 0.0

    def _build(self, name: str) -> None:
        super()._build(name)
        for part, radius, low, high, density in (
            ("foot", FOOT_RADIUS, 0.0, FOOT_HEIGHT, FOOT_DENSITY),
            ("shaft", POST_RADIUS, FOOT_HEIGHT, POST_HEIGHT, _SOLID["density"]),
        ):
            self._root.worldbody.add(
                "geom",
                name=part,
                pos=(0, 0, (low + high) / 2),
                size=(radius, (high - low) / 2),
                rgba=MAGENTA,
                **(_SOLID | {"type": "cylinder", "density": density}),
            )
