"""What is read of a bag in one pass: numbers with their times, times of pictures, chosen pictures, texts."""

from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from imfvla.errors import UserError
from imfvla.sources.checks import shortened
from imfvla.sources.ros2.bag import Bag, Received, received, topics_of
from imfvla.sources.ros2.eye import Eye
from imfvla.sources.ros2.fields import Part
from imfvla.sources.ros2.resample import Series

MAX_MESSAGES = 10_000_000  # of one topic
TEXT = "std_msgs/msg/String"


@dataclass(frozen=True, slots=True)
class Wanted:
    """Which topics are read, and for what."""

    parts: tuple[Part, ...]
    cameras: Mapping[str, str]  # view -> topic
    texts: tuple[str, ...]  # topics of std_msgs/String
    by_stamp: bool  # time by header.stamp where it is set, else by the time of recording


@dataclass(frozen=True, slots=True)
class Contents:
    """Of one bag."""

    values: Mapping[Part, tuple[Series, np.ndarray]]  # float64 (N, width) in the order of the times
    cameras: Mapping[str, Series]
    sizes: Mapping[str, tuple[int, int]]  # (H, W) of the first picture of each view
    texts: Mapping[str, Sequence[tuple[int, str]]]  # topic -> times of recording and texts


Pictures = Mapping[str, np.ndarray]  # view -> uint8 (K, H, W, 3)
Shots = Mapping[str, np.ndarray]  # view -> int64 (K,)  which messages of its topic, as recorded


def read_bag(
    bag: Bag, wanted: Wanted, shots: Shots | None = None, pictures: Pictures | None = None
) -> Contents:
    """The contents; pictures are decoded only where `shots` says, into `pictures`.

    Raises UserError where a topic is missing, of a type that does not fit, or has numbers that are not finite.
    """
    times: dict[str, array] = {view: array("q") for view in wanted.cameras}
    values = {part: (array("q"), array("d")) for part in wanted.parts}
    eyes = {view: Eye() for view in wanted.cameras}
    if shots is not None:
        eyes = {view: Eye(shots[view], pictures[view]) for view in shots}
    others: dict[Part, Received] = {}  # messages with other joints
    texts: dict[str, list[tuple[int, str]]] = {topic: [] for topic in wanted.texts}
    topics = {part.topic for part in wanted.parts} | set(wanted.cameras.values()) | set(wanted.texts)
    for message in received(bag, topics):
        for part in wanted.parts:
            if part.topic == message.topic:
                numbers, stamp = part.values(message)
                if numbers is None:
                    others[part] = message
                    continue
                values[part][0].append(_time(message, stamp, wanted))
                values[part][1].extend(numbers)
                _check_number(len(values[part][0]), message)
        for view, topic in wanted.cameras.items():
            if topic == message.topic:
                if view in eyes:
                    eyes[view].see(message, len(times[view]))
                times[view].append(_time(message, message.stamp(), wanted))
                _check_number(len(times[view]), message)
        if message.topic in texts:
            texts[message.topic].append((message.log_time, _text(message)))
    for part, message in others.items():
        if not values[part][0]:
            raise part.unfit(message)
    missing = [part.topic for part in wanted.parts if not values[part][0]]
    missing += [topic for view, topic in wanted.cameras.items() if not times[view]]
    missing += [topic for topic, said in texts.items() if not said]
    if missing:
        known = shortened(
            ", ".join(f"{topic} ({kind})" for topic, kind in topics_of(bag).items()) or "none", 600
        )
        raise UserError(
            f"{bag.files[0]}: wanted messages of {', '.join(dict.fromkeys(missing))}, found the topics {known}; "
            "correct the topics in the options, or leave this bag out."
        )
    for eye in eyes.values():
        eye.end()
    return Contents(
        {part: _sorted(part, *found) for part, found in values.items()},
        {view: Series.of(wanted.cameras[view], taken) for view, taken in times.items()},
        {view: eye.size for view, eye in eyes.items() if eye.size is not None},
        texts,
    )


def _sorted(part: Part, times: array, flat: array) -> tuple[Series, np.ndarray]:
    series = Series.of(part.topic, times)
    return series, np.frombuffer(flat, np.float64).reshape(len(times), -1)[series.order]


def _time(message: Received, stamp: int, wanted: Wanted) -> int:
    return stamp if wanted.by_stamp and stamp > 0 else message.log_time


def _text(message: Received) -> str:
    if message.kind != TEXT:
        raise UserError(
            f"{message.file}: {message.topic} must have {TEXT} (others are not supported), found {message.kind}; "
            "choose another topic."
        )
    return message.decode().data


def _check_number(number: int, message: Received) -> None:
    if number > MAX_MESSAGES:
        raise UserError(
            f"{message.file}: {message.topic} must have at most {MAX_MESSAGES} messages, found more; split the bag."
        )
