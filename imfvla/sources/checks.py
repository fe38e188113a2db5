"""What every reader of outside data refuses, and in which words: one sentence with file, key, wanted, found, remedy."""

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from imfvla.config.assets import folder, install_command, shown
from imfvla.errors import UserError, unreadable
from imfvla.options import Limit
from imfvla.recording.mcap_file import MAX_EPISODE_BYTES
from imfvla.robot import MAX_CHANNELS, bare_name, unit_of

MAX_EPISODES = 1_000_000  # of one source
MAX_STEPS = 1_000_000  # of one episode: 5 hours at 50 Hz
NARROWEST = 1e-3  # range of a channel that never moves, to both sides [its unit]
SENTENCE = Limit("a sentence", lambda text: bool(text.strip()))


def misfit(place: str | Path, key: str, wanted: str, found: Any, remedy: str) -> UserError:
    """The error for a value that is not as it must be."""
    return UserError(f"{place}: {key} must be {wanted}, found {shortened(found)}; {remedy}.")


def shortened(found: Any, limit: int = 120) -> str:
    """A value as a message shows it: long ones are cut, so that a file cannot fill the screen."""
    text = found if isinstance(found, str) else repr(found)
    return text if len(text) <= limit else f"{text[:limit]}..."


@contextmanager
def read_errors_told(
    path: Path,
    wanted: str,
    copy: str,
    unsupported: Callable[[Exception], str],
    damaged: Callable[[Exception], str],
    of_damage: tuple[type[Exception], ...],
) -> Iterator[None]:
    """Turns what a library raises while it reads `path` into a UserError that tells damage from what is not supported.

    Args:
      wanted: what should be at `path`, where nothing is.
      copy: the remedy for that.
      unsupported: the sentence after `path` for a NotImplementedError.
      damaged: the sentence after `path` for an error of `of_damage`.
    """
    try:
        yield
    except UserError:
        raise
    except FileNotFoundError as error:
        raise UserError(f"{path} is missing: wanted {wanted} there; {copy}.") from error
    except PermissionError as error:  # a file that may be intact is not called damaged
        raise unreadable(path, error) from error
    except NotImplementedError as error:
        raise UserError(f"{path} {unsupported(error)}") from error
    except of_damage as error:
        raise UserError(f"{path} {damaged(error)}") from error


def missing_extra(extra: str, error: ImportError) -> UserError:
    """The error of a reader whose package is not installed."""
    return UserError(
        f"Reading or writing {extra} data needs {error.name}, found it not installed: run `{install_command(extra)}`."
    )


def documented(kind: str) -> str:
    """Where a user reads what the options of a source mean: "see conf/demos/ros2.yaml"."""
    return f"see {shown(folder('conf') / 'demos' / f'{kind}.yaml')}"


def channels(names: Sequence[str], key: str, *, need_units: bool) -> tuple[str, ...]:
    """The names of channels that the options state, checked. Units are needed where no file has them.

    Raises UserError naming the key.
    """
    refuse_repeated(names, key)
    for name in names:
        if not bare_name(name).strip():
            raise UserError(
                f"{key} must have names of channels, found {name!r}: write one such as 'elbow [rad]'."
            )
        if need_units and not unit_of(name):
            raise UserError(
                f"{key} must name the unit of each channel in brackets, found {name!r}: "
                f"write it, as in '{bare_name(name)} [rad]' or 'gripper [0, 1]'."
            )
    if not 1 <= len(names) <= MAX_CHANNELS:
        raise UserError(f"{key} must have 1 to {MAX_CHANNELS} channels, found {len(names)}.")
    return tuple(names)


def refuse_repeated(names: Sequence[str], key: str) -> None:
    """Raises UserError where two channels have one name, whatever their units."""
    plain = [bare_name(name) for name in names]
    if repeated := sorted({name for name in plain if plain.count(name) > 1}):
        raise UserError(
            f"{key} must have names that all differ, found {shortened(', '.join(repeated))} more than once: rename one."
        )


def displaced(
    state: Sequence[str], action: Sequence[str], absolute: Sequence[str] | None, where: str
) -> tuple[int | None, ...]:
    """`relative_to` of a RobotSpec: the state channel of the same name for each action.

    absolute: names of the actions that stay absolute, with or without unit; None for those with "gripper" in their
    name. Raises UserError where one is no action, and where a state and its action differ in unit.
    """
    state_names, action_names = [bare_name(name) for name in state], [bare_name(name) for name in action]
    stay = [bare_name(name) for name in absolute or ()]
    for name in stay:
        if name not in action_names:
            raise UserError(
                f"{where}.absolute must name actions, found {name!r}: the actions are {', '.join(action_names)}."
            )
    if absolute is None:
        stay = [name for name in action_names if "gripper" in name.lower()]
    places = [
        state_names.index(name) if name in state_names and name not in stay else None for name in action_names
    ]
    for name, place in zip(action, places, strict=True):
        if place is not None and unit_of(name) != unit_of(state[place]):
            raise UserError(
                f"{where}: a state and the action of its name must have one unit, found {state[place]!r} and {name!r}; "
                f"give both the same unit, or list {bare_name(name)!r} in {where}.absolute."
            )
    return tuple(places)


def action_range(
    action: Sequence[str],
    stated: tuple[Sequence[float] | None, Sequence[float] | None],
    seen: tuple[np.ndarray, np.ndarray],
    where: str,
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Limits of the actions: those that the options state, else the least and greatest values seen (A,).

    A channel that never moves gets a narrow range. Raises UserError where the options state another number of limits,
    or one that is not below the other.
    """
    for key, given in zip(("action_min", "action_max"), stated, strict=True):
        if given is not None and len(given) != len(action):
            raise UserError(
                f"{where}.{key} must have {len(action)} values, one for each action, found {len(given)}."
            )
    low, high = (np.asarray(values, np.float64) for values in seen)
    still = ~(low < high)
    low, high = np.where(still, low - NARROWEST, low), np.where(still, high + NARROWEST, high)
    low, high = (
        given if given is not None else found for given, found in zip(stated, (low, high), strict=True)
    )
    for name, one, other in zip(action, low, high, strict=True):
        if not one < other:
            raise UserError(
                f"{where}.action_min must be below {where}.action_max for each action, found {one:g} and {other:g} for "
                f"{name}: correct them; null takes the least and greatest values in the data."
            )
    return tuple(map(float, low)), tuple(map(float, high))


def numbers(values: Any, width: int, place: str | Path, key: str, names: Sequence[str] = ()) -> np.ndarray:
    """float32 (T, width) of what a file has under `key`. Raises UserError on another shape, no steps and NaN."""
    array = np.asarray(values)
    if array.dtype.kind not in "fiub":
        raise misfit(
            place, key, "numbers", f"values of type {array.dtype}", "choose another key in the options"
        )
    if array.ndim != 2 or array.shape[1] != width or not len(array):
        raise misfit(
            place, key, f"of shape (steps, {width})", f"{array.shape}", "correct the channels in the options"
        )
    with np.errstate(over="ignore"):  # what is too large for a float32 is infinite
        array = array.astype(np.float32)
    if not (finite := np.isfinite(array)).all():
        step, channel = (int(place) for place in np.argwhere(~finite)[0])
        name = names[channel] if channel < len(names) else f"channel {channel}"
        raise misfit(
            place, key, "finite", f"{array[step, channel]} at step {step} in {name}", "leave this episode out"
        )
    return array


def bounded_pictures(count: int, height: int, width: int, place: str | Path, key: str) -> None:
    """Raises UserError where the decoded pictures of one view of an episode would fill the memory."""
    if count * height * width * 3 > MAX_EPISODE_BYTES:
        raise misfit(
            place,
            key,
            f"at most {MAX_EPISODE_BYTES / 2**30:g} GiB of decoded pictures in an episode",
            f"{count} of {height} x {width}",
            "set camera_every to a larger number, or leave this episode out",
        )


def chosen_episodes(
    chosen: Sequence[int] | None, total: int, place: str | Path, where: str
) -> tuple[int, ...]:
    """The numbers of the episodes that the options choose, all for None. Raises UserError where there are no such."""
    if chosen is None:
        return tuple(range(total))
    if beyond := [number for number in chosen if number >= total]:
        raise UserError(f"{where}.episodes must be below {total}, the number in {place}, found {beyond[0]}.")
    if not chosen or len(set(chosen)) < len(chosen):
        raise UserError(
            f"{where}.episodes must be null or numbers that all differ, found {shortened(list(chosen))}."
        )
    return tuple(chosen)


def digest_of(root: Path, files: Iterable[Path], options: Any) -> str:
    """Hex digits of names, sizes and times of change of files below `root`, as `make` tells changes, and of options.

    Contents are not read: a data set may have terabytes. Raises UserError where a file is missing.
    """
    digest = hashlib.sha256(json.dumps(options, default=str).encode())
    for path in sorted(files):
        try:
            status = path.stat()
        except FileNotFoundError as error:
            raise UserError(
                f"{path} is missing: the data set names it; copy or download it again."
            ) from error
        name = path.relative_to(root).as_posix() if path.is_relative_to(root) else path.name
        digest.update(json.dumps([name, status.st_size, status.st_mtime_ns]).encode())
    return digest.hexdigest()
