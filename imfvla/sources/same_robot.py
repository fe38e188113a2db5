"""Whether two sources of truth speak of the same robot, and the one sentence that says where they first differ."""

from collections.abc import Iterable, Iterator

from imfvla.errors import UserError
from imfvla.robot import Camera, RobotSpec, bare_name, unit_of


def refuse_other_robot(
    wanted: RobotSpec, found: RobotSpec, views: Iterable[str], *, of: str, where: str, remedy: str
) -> None:
    """Raises UserError naming the first difference between the robot `of` a policy and that found `where`.

    Compared are channels, displacements, limits, rate and the cameras of `views`: their sizes may differ, since
    pictures are resampled, but not their proportions.
    """
    for what, one, other in _differences(wanted, found, views, with_frame=True):
        raise UserError(f"{where} has another robot than {of}: {what} must be {one}, found {other}. {remedy}")


def refuse_other_data(
    wanted: RobotSpec, found: RobotSpec, views: Iterable[str], *, of: str, where: str, remedy: str
) -> None:
    """The same for data to learn from, where either side may be the wrong one: `of` a task and `where` say both values.

    Neither limits nor displacements are compared: data sets rarely state them, and a policy takes its own.
    """
    for what, one, other in _differences(wanted, found, views, with_frame=False):
        raise UserError(f"Different robots: {what} is {one} in {of}, but {other} in {where}. {remedy}")


def _differences(
    wanted: RobotSpec, found: RobotSpec, views: Iterable[str], *, with_frame: bool
) -> Iterator[tuple[str, str, str]]:
    """What differs, as it is in `wanted`, as it is in `found`."""
    for key in ("state", "action"):
        yield from _channels(key, getattr(wanted, key), getattr(found, key))
    if with_frame:
        for key in ("relative_to", "action_min", "action_max"):
            for name, one, other in zip(
                wanted.action, getattr(wanted, key), getattr(found, key), strict=True
            ):
                if one != other:
                    yield f"{key} of {name}", _shown(one), _shown(other)
    if wanted.control_hz != found.control_hz:
        yield "control_hz", f"{wanted.control_hz:g}", f"{found.control_hz:g}"
    cameras = {camera.name: camera for camera in found.cameras}
    for view in views:
        camera = wanted.camera(view)
        if view not in cameras:
            yield f"camera {view}", "there", f"not among its cameras ({', '.join(cameras) or 'none'})"
        elif not _is_alike(camera, cameras[view]):
            yield f"the proportions of camera {view}", _size(camera), _size(cameras[view])


def _channels(key: str, wanted: tuple[str, ...], found: tuple[str, ...]) -> Iterator[tuple[str, str, str]]:
    """Names must agree, and units where both state one: data sets often have none."""
    for number, (one, other) in enumerate(zip(wanted, found, strict=False)):
        units = unit_of(one), unit_of(other)
        if bare_name(one) != bare_name(other) or (all(units) and units[0] != units[1]):
            yield f"{key} channel {number}", one, other
    if len(wanted) != len(found):
        yield f"the number of {key} channels", f"{len(wanted)}", f"{len(found)}"


def _is_alike(one: Camera, other: Camera) -> bool:
    return one.height * other.width == other.height * one.width


def _size(camera: Camera) -> str:
    return f"{camera.height} x {camera.width} pixels"


def _shown(value: float | None) -> str:
    return "null" if value is None else f"{value:g}"
