"""Episodes of ROS 2 bags, resampled to one rate. Shapes: T control steps, K steps with frames, S state, A action."""

import logging
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from imfvla.errors import UserError
from imfvla.options import build
from imfvla.robot import Camera, RobotSpec
from imfvla.sources.base import EpisodeArrays
from imfvla.sources.checks import (
    action_range,
    bounded_pictures,
    chosen_episodes,
    digest_of,
    displaced,
    refuse_repeated,
    shortened,
)
from imfvla.sources.ros2.bag import Bag, find_bags
from imfvla.sources.ros2.contents import Contents, Wanted, read_bag
from imfvla.sources.ros2.fields import Part
from imfvla.sources.ros2.options import Marks, Options, read_parts, read_paths
from imfvla.sources.ros2.resample import Steps, common_steps, largest_gap_s, last_before, nearest

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class _Plan:
    """What is known of an episode without its pictures."""

    bag: Bag
    name: str
    steps: Steps  # one more than the episode has where the next state is the action
    instruction: str
    shots: Mapping[str, np.ndarray]  # view -> which message at each step with frames
    action_range: tuple[np.ndarray, np.ndarray]


class Ros2Source:
    """An `EpisodeSource` on bags. All numbers are read once at the beginning, so that every bag is checked."""

    robot: RobotSpec

    def __init__(self, options: Options, where: str) -> None:
        self._options, self._where = options, where
        self._state = read_parts(options.state, f"{where}.state")
        self._action = None if options.action is None else read_parts(options.action, f"{where}.action")
        self._marks = options.marks
        texts = (options.instruction_topic, self._marks and self._marks.topic)
        self._wanted = Wanted(
            tuple(dict.fromkeys((*self._state, *(self._action or ())))),
            options.cameras,
            tuple(dict.fromkeys(topic for topic in texts if topic)),
            options.clock == "stamp",
        )
        if options.instruction is None and options.instruction_topic is None:
            raise UserError(
                f"{where}.instruction must be a sentence, found null: write what the robot does, or name the topic "
                f"that says it in {where}.instruction_topic."
            )
        self._bags = find_bags(read_paths(options.path, where), where)
        self._plans, self._sizes = self._planned()
        self.robot = self._spec()

    def __len__(self) -> int:
        return len(self._plans)

    def num_frames(self, index: int) -> int:
        return next((len(shots) for shots in self._plans[index].shots.values()), 0)

    def episode(self, index: int, views: Collection[str] = ()) -> EpisodeArrays:
        plan = self._plans[index]
        pictures = {}
        for view in views:
            camera = self.robot.camera(view)
            count = len(plan.shots[view])
            bounded_pictures(
                count, camera.height, camera.width, plan.bag.files[0], self._wanted.cameras[view]
            )
            pictures[view] = np.empty((count, camera.height, camera.width, 3), np.uint8)
        shots = {view: plan.shots[view] for view in views}
        contents = read_bag(plan.bag, self._wanted, shots, pictures)
        state, action = self._numbers(contents, plan.steps)
        return EpisodeArrays(
            name=plan.name,
            task=plan.instruction,
            instructions=(plan.instruction,),
            state=state,
            action=action,
            image_steps=self._image_steps(len(state)),
            images=pictures,
        )

    def digest(self) -> str:
        """Of the sizes and times of change of the files, and of the options."""
        files = [file for bag in self._bags for file in bag.files]
        options = {key: value for key, value in asdict(self._options).items() if key != "path"}
        return digest_of(files[0].parent, files, [options, self.robot.to_json()])

    def _image_steps(self, length: int) -> np.ndarray:
        return np.arange(0, length if self._wanted.cameras else 0, self._options.camera_every)

    def _planned(self) -> tuple[list[_Plan], Mapping[str, tuple[int, int]]]:
        """The chosen episodes and the sizes of the pictures. Raises UserError where one of them does not fit."""
        chosen, found, sizes = self._options.episodes, [], {}
        for bag in self._bags:
            contents = None
            windows: list[tuple[int, int] | None] = [None]
            if self._marks is not None:
                contents = read_bag(bag, self._wanted)
                windows = list(_between(contents.texts[self._marks.topic], self._marks, bag))
            for number, window in enumerate(windows):
                if chosen is not None and len(found) not in chosen:
                    found.append(None)
                    continue
                contents = contents or read_bag(bag, self._wanted)
                _join(sizes, contents, bag)
                name = bag.name if self._marks is None else f"{bag.name}#{number}"
                found.append(self._plan(bag, name, contents, window))
        if not found:
            raise UserError(
                f"{self._where}.marks must enclose at least one episode, found no {self._marks.start!r} in "
                f"{self._marks.topic}; correct its texts."
            )
        numbers = chosen_episodes(
            chosen, len(found), ", ".join(map(str, read_paths(self._options.path, ""))), self._where
        )
        plans = [found[number] for number in numbers]
        names = [plan.name for plan in plans]
        if repeated := {name for name in names if names.count(name) > 1}:
            raise UserError(
                f"{self._where}.path must have bags whose names differ, found {shortened(sorted(repeated))} more than "
                "once; rename one."
            )
        return plans, sizes

    def _plan(self, bag: Bag, name: str, contents: Contents, window: tuple[int, int] | None) -> _Plan:
        options, place = self._options, f"{bag.files[0]} ({name})"
        series = [series for series, _ in contents.values.values()]
        steps = common_steps([*series, *contents.cameras.values()], window, options.control_hz, place)
        if self._action is None and steps.count < 2:
            raise UserError(
                f"{place}: an episode must have at least 2 steps, found {steps.count}; leave it out."
            )
        gap = max(((largest_gap_s(one, steps.times), one.topic) for one in series), default=(0.0, ""))
        if gap[0] > options.max_gap_s:
            raise UserError(
                f"{place}: {gap[1]} must have no gap above {options.max_gap_s:g} s, found one of {gap[0]:.3f} s; "
                f"raise {self._where}.max_gap_s, or leave the episode out with {self._where}.episodes."
            )
        length = steps.count - (self._action is None)
        times = steps.times[self._image_steps(length)]
        shots, skews = {}, [(0.0, "")]
        for view, one in contents.cameras.items():
            places = nearest(one, times)
            shots[view] = one.order[places]
            skews.append((float(np.abs(one.times[places] - times).max()) / 1e9, one.topic))
        skew = max(skews)
        if skew[0] > options.max_skew_s:
            raise UserError(
                f"{place}: pictures of {skew[1]} must be within {options.max_skew_s:g} s of their step, found "
                f"{skew[0]:.3f} s; raise {self._where}.max_skew_s, or leave the episode out with "
                f"{self._where}.episodes."
            )
        disordered = sum(one.num_disordered for one in (*series, *contents.cameras.values()))
        log.info(
            "%s: %d steps at %g Hz; largest gap %.3f s%s, largest skew %.3f s%s; %d messages out of order.",
            name, length, options.control_hz, gap[0], f" ({gap[1]})", skew[0], f" ({skew[1]})" if skew[1] else "",
            disordered,
        )  # fmt: skip
        _, action = self._numbers(contents, steps)
        return _Plan(
            bag, name, steps, self._instruction(contents, steps, place), shots, (action.min(0), action.max(0))
        )

    def _numbers(self, contents: Contents, steps: Steps) -> tuple[np.ndarray, np.ndarray]:
        """State and action: float32 (T, S), (T, A)."""
        state = _resampled(contents, self._state, steps)
        if self._action is None:
            return state[:-1], state[1:]
        return state, _resampled(contents, self._action, steps)

    def _instruction(self, contents: Contents, steps: Steps, place: str) -> str:
        topic = self._options.instruction_topic
        if self._options.instruction is not None or topic is None:
            return self._options.instruction
        said = [text for time, text in contents.texts[topic] if time <= steps.times[-1]]
        if not said or not said[-1].strip():
            raise UserError(
                f"{place}: {topic} must have a sentence before the episode ends, found none; "
                f"set {self._where}.instruction."
            )
        return said[-1]

    def _spec(self) -> RobotSpec:
        options, where = self._options, self._where
        state = [name for part in self._state for name in part.names]
        action = state if self._action is None else [name for part in self._action for name in part.names]
        refuse_repeated(state, f"{where}.state")
        refuse_repeated(action, f"{where}.action")
        relative_to = displaced(state, action, options.absolute, where)
        ranges = [plan.action_range for plan in self._plans]
        seen = np.min([low for low, _ in ranges], 0), np.max([high for _, high in ranges], 0)
        low, high = action_range(action, (options.action_min, options.action_max), seen, where)
        cameras = tuple(Camera(view, *self._sizes[view]) for view in self._wanted.cameras)
        return RobotSpec(tuple(state), tuple(action), relative_to, low, high, options.control_hz, cameras)


def _join(sizes: dict[str, tuple[int, int]], contents: Contents, bag: Bag) -> None:
    """Keeps the sizes of pictures. Raises UserError where those of a bag are others."""
    for view, size in contents.sizes.items():
        if sizes.setdefault(view, size) != size:
            wanted, found = (f"{height} x {width}" for height, width in (sizes[view], size))
            raise UserError(
                f"{bag.files[0]}: pictures of {contents.cameras[view].topic} must be {wanted}, as in other bags, found "
                f"{found}; leave this bag out."
            )


def _resampled(contents: Contents, parts: Sequence[Part], steps: Steps) -> np.ndarray:
    columns = []
    for part in parts:
        series, values = contents.values[part]
        columns.append(values[last_before(series, steps.times)])
    with np.errstate(over="ignore"):
        return np.concatenate(columns, 1).astype(np.float32)


def _between(texts: Sequence[tuple[int, str]], marks: Marks, bag: Bag) -> Sequence[tuple[int, int]]:
    """Times of start and stop. Raises UserError where one lacks the other."""
    found, start = [], None
    for time, text in texts:
        if text == marks.start and start is None:
            start = time
        elif text == marks.stop and start is not None:
            found.append((start, time))
            start = None
        elif text in (marks.start, marks.stop):
            raise UserError(
                f"{bag.files[0]}: {marks.topic} must have {marks.start!r} and {marks.stop!r} in turn, found {text!r} "
                f"twice at {time / 1e9:.3f} s; correct the bag or leave it out."
            )
    if start is not None:
        raise UserError(
            f"{bag.files[0]}: {marks.topic} must have {marks.stop!r} after {marks.start!r} at {start / 1e9:.3f} s, "
            "found none; correct the bag or leave it out."
        )
    return found


def open_source(options: Mapping[str, Any], *, where: str = "demos") -> Ros2Source:
    """The episodes of ROS 2 bags, as `conf/demos/ros2.yaml` documents; `where` heads every message.

    Raises UserError naming file, topic or key where the options or a bag are not as they must be.
    """
    return Ros2Source(build(Options, options, where), where)
