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
    _refuse(_differences(wanted, found, views, with_frame=True), of, where, remedy)


def refuse_other_data(
    wanted: RobotSpec, found: RobotSpec, views: Iterable[str], *, of: str, where: str, remedy: str
) -> None:
    """The same for data to learn from.

    Neither limits nor displacements are compared: data sets rarely state them, and a policy takes its own.
    """
    _refuse(_differences(wanted, found, views, with_frame=False), of, where, remedy)


def _refuse(differences: Iterator[str], of: str, where: str, remedy: str) -> None:
    first = next(differences, None)
    if first is not None:
        raise UserError(f"{where} has another robot than {of}: {first}. {remedy}")


def _differences(
    wanted: RobotSpec, found: RobotSpec, views: Iterable[str], *, with_frame: bool
) -> Iterator[str]:
    for key in ("state", "action"):
        yield from _channels(key, getattr(wanted, key), getattr(found, key))
    if with_frame:
        for key in ("relative_to", "action_min", "action_max"):
            for name, one, other in zip(
                wanted.action, getattr(wanted, key), getattr(found, key), strict=True
            ):
                if one != other:
                    yield f"{key} of {name} must be {_shown(one)}, found {_shown(other)}"
    if wanted.control_hz != found.control_hz:
        yield f"control_hz must be {wanted.control_hz:g}, found {found.control_hz:g}"
    cameras = {camera.name: camera for camera in found.cameras}
    for view in views:
        camera = wanted.camera(view)
        if view not in cameras:
            yield f"there must be a camera {view}, found {', '.join(cameras) or 'none'}"
        elif not _is_alike(camera, cameras[view]):
            yield (
                f"camera {view} must have the proportions of {camera.height} x {camera.width} pixels, found "
                f"{cameras[view].height} x {cameras[view].width}"
            )


def _channels(key: str, wanted: tuple[str, ...], found: tuple[str, ...]) -> Iterator[str]:
    """Names must agree, and units where both state one: data sets often have none."""
    for number, (one, other) in enumerate(zip(wanted, found, strict=False)):
        units = unit_of(one), unit_of(other)
        if bare_name(one) != bare_name(other) or (all(units) and units[0] != units[1]):
            yield f"{key} channel {number} must be {one}, found {other}"
    if len(wanted) != len(found):
        yield f"{key} must have {len(wanted)} channels, found {len(found)}"


def _is_alike(one: Camera, other: Camera) -> bool:
    return one.height * other.width == other.height * one.width


def _shown(value: float | None) -> str:
    return "null" if value is None else f"{value:g}"
