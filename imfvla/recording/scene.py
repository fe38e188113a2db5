"""The simulated bodies for Foxglove's 3D panel: their shapes once, their poses as they move.

Reads the arrays of a compiled MuJoCo model and its data, from any binding, without importing mujoco.
Quaternions become Foxglove's xyzw here and nowhere else.
"""

from typing import Any

import numpy as np

from imfvla.recording.messages import stamp

WORLD = "world"
NUM_VISIBLE_GROUPS = 3  # MuJoCo's renderer shows geom groups 0-2 by default
PLANE, SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX = 0, 2, 3, 4, 5, 6  # mjtGeom
PLANE_THICKNESS = 0.002  # [m]
PLANE_EXTENT = 4.0  # [m] half size drawn for an infinite plane
UNSET_RGBA = (0.5, 0.5, 0.5, 1.0)  # a geom of this colour takes the one of its material


def body_names(model: Any) -> list[str]:
    """Name of every body; an unnamed one is called `body_<index>`, the first `world`."""
    names = []
    for index, address in enumerate(model.name_bodyadr):
        name = bytes(model.names)[address:].split(b"\0", 1)[0].decode()
        names.append(WORLD if index == 0 else name or f"body_{index}")
    return names


def scene_update(model: Any) -> dict[str, Any]:
    """foxglove.SceneUpdate with one entity for each body that shows, its primitives in the body's frame."""
    entities: dict[int, dict[str, Any]] = {}
    names = body_names(model)
    for geom in range(model.ngeom):
        color = _color(model, geom)
        if model.geom_group[geom] >= NUM_VISIBLE_GROUPS or color["a"] == 0:
            continue
        body = int(model.geom_bodyid[geom])
        entity = entities.setdefault(body, _entity(names[body]))
        for kind, primitive in _primitives(model, geom):
            entity[kind].append(primitive | {"color": color})
    return {"deletions": [], "entities": list(entities.values())}


def frame_transforms(names: list[str], data: Any) -> dict[str, Any]:
    """foxglove.FrameTransforms of every body but the world, relative to the world; rounded to 1 um."""
    poses = zip(names, np.round(data.xpos, 6), np.round(data.xquat, 6), strict=True)
    return {
        "transforms": [
            {
                "parent_frame_id": WORLD,
                "child_frame_id": name,
                "translation": _vector(position),
                "rotation": _quaternion(quaternion),
            }
            for name, position, quaternion in poses
            if name != WORLD
        ]
    }


def at_time(message: dict[str, Any], log_time_ns: int) -> dict[str, Any]:
    """A scene update or frame transforms with the time at which it holds."""
    time = {"timestamp": stamp(log_time_ns)}
    return {name: [time | part for part in parts] for name, parts in message.items()}


def _entity(body: str) -> dict[str, Any]:
    lists = ("metadata", "arrows", "cubes", "spheres", "cylinders", "lines", "triangles", "texts", "models")
    return {
        "frame_id": body,
        "id": body,
        "lifetime": {"sec": 0, "nsec": 0},
        "frame_locked": True,
    } | {name: [] for name in lists}


def _primitives(model: Any, geom: int) -> list[tuple[str, dict[str, Any]]]:
    """(list of the entity, primitive without colour) of one geom; a mesh becomes its bounding box."""
    kind, size = int(model.geom_type[geom]), np.asarray(model.geom_size[geom], float)
    position, quaternion = np.asarray(model.geom_pos[geom], float), model.geom_quat[geom]

    def pose(offset: np.ndarray = np.zeros(3)) -> dict[str, Any]:  # noqa: B008
        return {
            "position": _vector(position + _rotate(quaternion, offset)),
            "orientation": _quaternion(quaternion),
        }

    if kind == SPHERE:
        return [("spheres", {"pose": pose(), "size": _vector([2 * size[0]] * 3)})]
    if kind == ELLIPSOID:
        return [("spheres", {"pose": pose(), "size": _vector(2 * size)})]
    if kind in (CYLINDER, CAPSULE):
        radius, half_length = size[:2]
        box = _vector([2 * radius, 2 * radius, 2 * half_length])
        shapes = [("cylinders", {"pose": pose(), "size": box, "bottom_scale": 1.0, "top_scale": 1.0})]
        if kind == CAPSULE:
            for end in (-half_length, half_length):
                cap = {"pose": pose(np.array([0, 0, end])), "size": _vector([2 * radius] * 3)}
                shapes.append(("spheres", cap))
        return shapes
    if kind == BOX:
        return [("cubes", {"pose": pose(), "size": _vector(2 * size)})]
    if kind == PLANE:
        half = [extent if extent > 0 else PLANE_EXTENT for extent in size[:2]]
        box = _vector([2 * half[0], 2 * half[1], PLANE_THICKNESS])
        return [("cubes", {"pose": pose(np.array([0, 0, -PLANE_THICKNESS / 2])), "size": box})]
    center, half = np.asarray(model.geom_aabb[geom], float).reshape(2, 3)
    return [("cubes", {"pose": pose(center), "size": _vector(2 * half)})]


def _color(model: Any, geom: int) -> dict[str, float]:
    rgba, material = tuple(np.round(model.geom_rgba[geom].astype(float), 6)), int(model.geom_matid[geom])
    if material >= 0 and rgba == UNSET_RGBA:
        rgba = np.round(model.mat_rgba[material].astype(float), 6)
    return dict(zip("rgba", map(float, rgba), strict=True))


def _rotate(wxyz: np.ndarray, vector: np.ndarray) -> np.ndarray:
    w, xyz = float(wxyz[0]), np.asarray(wxyz[1:], float)
    return vector + 2 * np.cross(xyz, np.cross(xyz, vector) + w * vector)


def _vector(xyz: Any) -> dict[str, float]:
    return dict(zip("xyz", map(float, xyz), strict=True))


def _quaternion(wxyz: Any) -> dict[str, float]:
    w, x, y, z = map(float, wxyz)
    return {"x": x, "y": y, "z": z, "w": w}
