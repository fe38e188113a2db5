"""Objects that are drawn into the pictures and are nowhere else: no body, no contact, no state."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

# Where they may lie on the table: x, y [m]; and how far from the middle of what the task is about.
AREA = ((-0.40, 0.40), (-0.26, 0.30))
CLEAR = 0.13
KINDS = (mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_ELLIPSOID)
HALF_SIZE = (0.012, 0.032)  # m


@dataclass(frozen=True, slots=True)
class Shape:
    """A geom of the picture: MuJoCo's kind, half sizes and position (3,) [m], turn about z [rad], colour (4,)."""

    kind: int
    size: np.ndarray
    position: np.ndarray
    yaw: float
    rgba: np.ndarray


def draw_shapes(count: int, rng: np.random.Generator, keep_clear: Sequence[np.ndarray]) -> tuple[Shape, ...]:
    """Shapes that lie on the table, away from the points (2,) of `keep_clear`."""
    shapes: list[Shape] = []
    while len(shapes) < count:
        place = np.array([rng.uniform(*limits) for limits in AREA])
        size, yaw, color = rng.uniform(*HALF_SIZE, 3), rng.uniform(0, np.pi), rng.uniform(0, 1, 3)
        kind = KINDS[rng.integers(len(KINDS))]
        if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
            size[1] = size[0]  # MuJoCo's scene takes two radii and half a length
        if all(np.linalg.norm(place - point) > CLEAR for point in keep_clear):
            shapes.append(Shape(kind, size, np.array([*place, size[2]]), yaw, np.array([*color, 1.0])))
    return tuple(shapes)


def add_to_scene(shapes: Sequence[Shape], scene: mujoco.MjvScene) -> None:
    """Draws the shapes into a scene that is about to be rendered."""
    for shape in shapes:
        cos, sin = np.cos(shape.yaw), np.sin(shape.yaw)
        turned = np.array([cos, -sin, 0, sin, cos, 0, 0, 0, 1])
        scene.ngeom += 1
        geom = scene.geoms[scene.ngeom - 1]
        mujoco.mjv_initGeom(
            geom, shape.kind, shape.size, shape.position, turned, shape.rgba.astype(np.float32)
        )
