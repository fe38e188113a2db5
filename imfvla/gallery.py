"""python -m imfvla.gallery task=socket: a contact sheet of every view, for both outcomes of the hidden choice.

With of=conditions, one of every condition and severity of an evaluation.
"""

from imfvla.command import begin

if __name__ == "__main__":
    begin()

from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from imfvla.command.entry import entry_point
from imfvla.environment import Environment
from imfvla.episode import Actor
from imfvla.errors import UserError
from imfvla.options import build, one_of, within
from imfvla.process.progress import Progress
from imfvla.storage.files import write_together

if TYPE_CHECKING:
    from imfvla.tasks.bimanual_environment import BimanualEnvironment

MOMENTS = (0, 0.25, 0.5, 1)  # of an episode
VIEWS = ("front",)  # of conditions
LATER_S = 1.6  # when the expert has reached the objects
NOTICED = 16, 0.001  # levels of 255 by which a pixel differs, share of such pixels


@dataclass(frozen=True, slots=True)
class GalleryOptions:
    """conf/gallery.yaml without the task."""

    of: Annotated[str, one_of("views", "conditions")]
    seed: Annotated[int, within(0, 2**31)]
    size: Annotated[int, within(16, 960)]
    directory: str


@entry_point("gallery")
def main(config: dict[str, Any]) -> None:
    options = build(GalleryOptions, {key: value for key, value in config.items() if key != "task"}, "")
    write = write_gallery if options.of == "views" else write_conditions
    for path in write(config["task"], options.seed, options.size, Path(options.directory)):
        print(path)


def write_gallery(task: Mapping[str, Any], seed: int, size: int, directory: Path) -> list[Path]:
    """Writes one PNG for each way the right gripper can turn, from the same start state; returns their paths.

    Columns are the views, rows the moments of the episode: start, a quarter, middle and end.
    """
    # Imported late, so that a mistake in the config is reported at once.
    from imfvla import tasks
    from imfvla.figures.contact_sheet import contact_sheet, png

    if task.get("name") not in tasks.NAMES or "expert" not in task:
        raise UserError(
            f"task must be one of {', '.join(tasks.NAMES)}, whose experts have a hidden choice to show, found "
            f"{task.get('name')!r}: an evaluation films other environments."
        )
    directory.mkdir(parents=True, exist_ok=True)
    paths = []
    with closing(tasks.load(task["name"], variant=task["variant"])) as env:
        seed, experts = _both_ways(env, task, seed)
        for label, expert in experts.items():
            frames = _play(env, expert, seed, size)
            chosen = [frames[round(share * (len(frames) - 1))] for share in MOMENTS]
            rows = [(f"{step / env.robot.control_hz:.1f} s", pictures) for step, pictures in chosen]
            path = directory / f"{task['name']}-{task['variant']}-seed{seed}-{label}.png"
            write_together({path: png(contact_sheet(rows, env.all_views))})
            paths.append(path)
    return paths


def write_conditions(task: Mapping[str, Any], seed: int, size: int, directory: Path) -> list[Path]:
    """Writes one PNG: a row for every condition, and for every severity what the first camera shows a policy at the
    start and after the expert has worked for a while; returns its path. Rows say where that is hardly different.
    """
    from imfvla import tasks
    from imfvla.conditions import changed
    from imfvla.config.condition import CONDITIONS, NONE, SEVERITIES
    from imfvla.figures.contact_sheet import contact_sheet, png
    from imfvla.tasks.experts import make_expert

    rows = []
    with Progress("pictures of conditions", 1 + len(CONDITIONS)) as bar:
        for name in (NONE, *CONDITIONS):
            pictures = []
            for severity in SEVERITIES:
                # One for each, since some conditions change the simulation.
                env = tasks.load(task["name"], variant=task["variant"], image_size=(size, size), views=VIEWS)
                world = changed(env, name, None if name == NONE else severity)
                expert = make_expert(task["name"], **task["expert"])
                pictures += _start_and_later(world, expert, seed)
                env.close()
            is_seen = name == NONE or _differ(pictures, rows[0][1])
            rows.append((name if is_seen else f"{name}: hardly seen in these pictures", pictures))
            bar.advance(name)
    columns = [
        f"severity {severity}, {moment}" for severity in SEVERITIES for moment in ("start", f"{LATER_S:g} s")
    ]
    path = directory / f"{task['name']}-{task['variant']}-seed{seed}-conditions.png"
    directory.mkdir(parents=True, exist_ok=True)
    write_together({path: png(contact_sheet(rows, columns))})
    return [path]


def _start_and_later(env: Environment, expert: Actor, seed: int) -> list[np.ndarray]:
    env.reset(seed)
    expert.reset(env, seed)
    pictures = [env.look()[VIEWS[0]]]
    for step in range(round(LATER_S * env.robot.control_hz)):
        env.step(expert.act(env, env.state(), step).executed)
    return [*pictures, env.look()[VIEWS[0]]]


def _differ(pictures: Sequence[np.ndarray], others: Sequence[np.ndarray]) -> bool:
    """Whether a reader would see a difference."""
    levels, share = NOTICED
    difference = np.abs(np.array(pictures, int) - np.array(others, int)).max(axis=-1)
    return bool((difference > levels).mean() > share)


def _both_ways(
    env: "BimanualEnvironment", task: Mapping[str, Any], seed: int
) -> tuple[int, dict[str, Actor]]:
    """A seed whose hidden draw differs from the unimodal expert's choice, and both experts."""
    from imfvla.tasks.experts import make_expert

    usual, other = (make_expert(task["name"], **{**task["expert"], "modes": modes}) for modes in (1, 2))
    while True:
        env.reset(seed)
        usual.reset(env, seed)
        other.reset(env, seed)
        if usual.style["turn_right"] != other.style["turn_right"]:
            return seed, {"turn-plus": usual, "turn-minus": other}
        seed += 1


def _play(
    env: "BimanualEnvironment", expert: Actor, seed: int, size: int, every: int = 10
) -> list[tuple[int, list[np.ndarray]]]:
    """Steps done and pictures of all views every few steps of an episode, including its first and last state."""
    env.reset(seed)
    expert.reset(env, seed)
    frames = []
    for step in range(env.time_limit_steps):
        if step % every == 0:
            frames.append((step, [env.render(view, size, size) for view in env.all_views]))
        env.step(expert.act(env, env.state(), step).executed)
        if expert.done(env):
            break
    frames.append((step + 1, [env.render(view, size, size) for view in env.all_views]))
    return frames


if __name__ == "__main__":
    main()
