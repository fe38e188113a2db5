"""Which features of a LeRobot data set are state, action and cameras, and the robot that they make up."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from imfvla.errors import UserError
from imfvla.options import Limit, at_least, some
from imfvla.robot import Camera, RobotSpec, bare_name
from imfvla.sources.checks import SENTENCE, action_range, channels, displaced, misfit, refuse_repeated
from imfvla.sources.lerobot.layout import DOWNLOAD, NUMERIC, ROBOT, STATS, Feature, Info
from imfvla.storage.documents import read_json

PREFIX = "observation.images."
NAMES = some(Limit("the name of a feature", bool))
Range = tuple[np.ndarray, np.ndarray]  # least and greatest values (A,)


@dataclass(frozen=True, slots=True)
class Options:
    """What conf/demos/lerobot.yaml documents."""

    path: str
    episodes: tuple[Annotated[int, at_least(0)], ...] | None
    state: Annotated[tuple[str, ...], NAMES]
    action: Annotated[tuple[str, ...], NAMES]
    cameras: Mapping[str, str] | None  # view -> feature; null: all
    state_names: tuple[str, ...] | None
    action_names: tuple[str, ...] | None
    absolute: tuple[str, ...] | None
    action_min: tuple[float, ...] | None
    action_max: tuple[float, ...] | None
    camera_every: Annotated[int, at_least(1)]
    instruction: Annotated[str, SENTENCE] | None


def chosen(info: Info, keys: Sequence[str], where: str) -> list[Feature]:
    """The numeric features of these keys. Raises UserError where one is missing or no list of numbers."""
    numeric = [key for key, feature in info.features.items() if NUMERIC.fullmatch(feature.dtype)]
    remedy = f"choose among {', '.join(numeric)} in {where}"
    for key in keys:
        if key not in info.features:
            raise misfit(info.path, "features", f"with {key}", ", ".join(info.features), remedy)
        feature = info.features[key]
        if key not in numeric or len(feature.shape) != 1 or feature.shape[0] < 1:
            found = f"{feature.dtype} of shape {list(feature.shape)}"
            raise misfit(info.path, f"features.{key}", "a list of numbers", found, remedy)
    return [info.features[key] for key in keys]


def chosen_cameras(info: Info, views: Mapping[str, str] | None, where: str) -> dict[str, Feature]:
    """View -> feature: as `views` maps them, or all colour cameras where it is None."""
    known = {key: feature for key, feature in info.features.items() if feature.is_camera}
    if views is None:
        colour = {key: feature for key, feature in known.items() if not feature.is_depth}
        short = {key: key.removeprefix(PREFIX).rpartition(".")[2] for key in colour}
        is_unique = len(set(short.values())) == len(short)
        return {short[key] if is_unique else key: feature for key, feature in colour.items()}
    for view, name in views.items():
        if name not in known:
            raise UserError(
                f"{where}.cameras.{view} must be one of {', '.join(known) or 'none'}, found {name!r}: "
                f"choose a camera of {info.path}."
            )
    return {view: known[name] for view, name in views.items()}


def robot_of(
    info: Info,
    state: Sequence[Feature],
    action: Sequence[Feature],
    cameras: Mapping[str, Feature],
    options: Options,
    where: str,
    seen: Callable[[], Range],
) -> RobotSpec:
    """The robot of the data set; `seen` reads the range of all actions, where nothing states it."""
    state_names = _names(state, options.state_names, f"{where}.state_names")
    action_names = _names(action, options.action_names, f"{where}.action_names")
    sizes = tuple(Camera(view, *feature.picture_size(info.path)) for view, feature in cameras.items())
    stored = _stored_robot(info, state_names, action_names)
    if stored is not None and options.absolute is None:
        relative_to = stored.relative_to
    else:
        relative_to = displaced(state_names, action_names, options.absolute, where)
    stated = (options.action_min, options.action_max)
    if stored is not None:
        limits = np.array(stored.action_min), np.array(stored.action_max)
    elif None not in stated:
        limits = np.zeros(len(action_names)), np.ones(len(action_names))  # not used
    else:
        limits = _stated_range(info, action) or seen()
    low, high = action_range(action_names, stated, limits, where)
    return RobotSpec(state_names, action_names, relative_to, low, high, info.fps, sizes)


def _names(features: Sequence[Feature], given: tuple[str, ...] | None, key: str) -> tuple[str, ...]:
    """Names of channels: those of the options, else the data set's, with the feature where two are equal."""
    width = sum(feature.shape[0] for feature in features)
    if given is not None:
        if len(given) != width:
            wanted = " + ".join(f"{feature.key} ({feature.shape[0]})" for feature in features)
            raise UserError(f"{key} must have {width} names, of {wanted}, found {len(given)}.")
        return channels(given, key, need_units=False)
    pairs = [
        (feature, name)
        for feature in features
        for name in feature.names or [f"{feature.key}_{place}" for place in range(feature.shape[0])]
    ]
    names = [name for _, name in pairs]
    if len(set(map(bare_name, names))) < len(names):
        names = [f"{feature.key}/{name}" for feature, name in pairs]
        refuse_repeated([feature.key for feature in features], key.removesuffix("_names"))
    return channels(names, key, need_units=False)


def _stored_robot(info: Info, state: tuple[str, ...], action: tuple[str, ...]) -> RobotSpec | None:
    """The robot that imfvla wrote into the data set, if it did and the channels are the same."""
    path = info.root / ROBOT
    if not path.is_file():
        return None
    try:
        robot = RobotSpec.from_json(read_json(path, DOWNLOAD, mapping=True, home=info.home))
    except UserError as error:
        raise UserError(f"{path}: {error} Correct the file, or copy the data set again.") from error
    return robot if (robot.state, robot.action) == (state, action) else None


def _stated_range(info: Info, features: Sequence[Feature]) -> Range | None:
    """Least and greatest values in meta/stats.json, None where it has none."""
    path = info.root / STATS
    if not path.is_file():
        return None
    stats = read_json(path, DOWNLOAD, mapping=True, home=info.home)
    found = [_range_of(stats, feature, path) for feature in features]
    if None in found:
        return None
    return np.concatenate([low for low, _ in found]), np.concatenate([high for _, high in found])


def _range_of(stats: Mapping[str, Any], feature: Feature, path: Path) -> Range | None:
    entry = stats.get(feature.key)
    if not isinstance(entry, dict) or not {"min", "max"} <= entry.keys():
        return None
    found = []
    for key in ("min", "max"):
        try:
            values = np.array(entry[key], np.float64).reshape(-1)
        except (ValueError, TypeError):
            values = np.zeros(0)
        if values.shape != feature.shape or not np.isfinite(values).all():
            wanted = f"{feature.shape[0]} finite numbers"
            remedy = "state action_min and action_max in the options"
            raise misfit(path, f"{feature.key}.{key}", wanted, entry[key], remedy)
        found.append(values)
    return found[0], found[1]
