"""When grippers close and let go in predicted chunks: whether a sample decides, and whether it does so in order.

Shapes: T control steps, A action, N observations, K samples of each, Tp predicted steps.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from imfvla.robot import RobotSpec, bare_name

MIDDLE = 0.5  # 0 is closed, 1 open
CLOSED, OPEN = 0.2, 0.8  # between them a gripper is neither
MOST_BETWEEN = 3  # control steps that a gripper may take from one to the other
PROMPT = (3, 6)  # control steps from one hand's closing to the other one's opening in a hand-over
FATES = ("closes", "holds on", "lets go", "between", "waits")


@dataclass(frozen=True, slots=True)
class Event:
    """A gripper closes at `step` of an episode and, in a hand-over, the other one lets go soon after."""

    step: int
    closing: int  # channel of the action
    opening: int | None


@dataclass(frozen=True, slots=True)
class Closings:
    """Steps of chunks, (N, K) each; Tp where it does not happen within the chunk."""

    closes: np.ndarray
    lets_go: np.ndarray | None  # None where no other hand is to let go
    num_between: np.ndarray  # steps at which the closing gripper is neither open nor closed
    pred: int


def grippers_of(robot: RobotSpec) -> tuple[int, ...]:
    """The channels of a robot's actions that open and close a gripper."""
    names = (bare_name(channel).rpartition("/")[2] for channel in robot.action)
    return tuple(index for index, name in enumerate(names) if name == "gripper")


def event_of(actions: np.ndarray, grippers: Sequence[int]) -> Event | None:
    """The last closing of one of the grippers in the actions (T, A) of an episode; None where none closes."""
    closed = actions[:, list(grippers)] < MIDDLE
    steps, hands = np.nonzero(closed[1:] & ~closed[:-1])
    if not len(steps):
        return None
    step, hand = int(steps[-1]) + 1, int(hands[-1])
    opening = None
    for other in (channel for number, channel in enumerate(grippers) if number != hand):
        after = actions[step : step + PROMPT[1] + 1, other] > MIDDLE
        if not after[0] and after.any():
            opening = other
    return Event(step, grippers[hand], opening)


def release_delay(actions: np.ndarray, taking: int, giving: int) -> int | None:
    """Steps from the taking gripper's closing to the giving one's opening in actions (T, A); None without either.

    Counted from the giving one's first closing, since both begin open.
    """
    closed = actions < MIDDLE
    held = np.flatnonzero(closed[:, giving])
    if not len(held):
        return None
    closes = np.flatnonzero(closed[held[0] :, taking])
    opens = np.flatnonzero(~closed[held[0] :, giving])
    return int(opens[0] - closes[0]) if len(closes) and len(opens) else None


def closings(chunks: np.ndarray, events: Sequence[Event]) -> Closings:
    """When the hands of the event that each observation precedes close and let go in chunks (N, K, Tp, A)."""

    def openings(channels: Sequence[int]) -> np.ndarray:
        return np.stack([chunk[..., channel] for chunk, channel in zip(chunks, channels, strict=True)])

    opening = openings([event.closing for event in events])
    between = ((opening > CLOSED) & (opening < OPEN)).sum(axis=-1)
    others = [event.opening for event in events]
    lets_go = None if None in others else _first(openings(others) > MIDDLE)
    return Closings(_first(opening < MIDDLE), lets_go, between, chunks.shape[-2])


def measure_closings(found: Closings, executed: int) -> dict[str, float | None]:
    """Shares of samples: `closes` within the executed steps; of those that close with room for it, `in_order`;
    `lets_go` before or without closing, or too soon after it; `between` open and closed for too long."""
    in_order = lets_go = None
    if found.lets_go is not None:
        delay = found.lets_go - found.closes
        has_room = found.closes + PROMPT[1] < found.pred
        prompt = (delay >= PROMPT[0]) & (delay <= PROMPT[1])
        in_order = float(prompt[has_room].mean()) if has_room.any() else None
        lets_go = float(_too_soon(found).mean())
    return {
        "closes": float((found.closes < executed).mean()),
        "in_order": in_order,
        "lets_go": lets_go,
        "between": float((found.num_between > MOST_BETWEEN).mean()),
    }


def fates(found: Closings) -> dict[str, float]:
    """Share of samples of each of FATES; the first that holds of between, lets go, waits, holds on, closes."""
    rest = np.ones(found.closes.shape, bool)
    shares = dict.fromkeys(FATES, 0.0)
    late = np.zeros_like(rest)
    if found.lets_go is not None:
        late = (found.closes + PROMPT[1] < found.pred) & (found.lets_go > found.closes + PROMPT[1])
    for name, holds in (
        ("between", found.num_between > MOST_BETWEEN),
        ("lets go", _too_soon(found)),
        ("waits", found.closes == found.pred),
        ("holds on", late),
        ("closes", rest.copy()),
    ):
        shares[name] = float((rest & holds).mean())
        rest &= ~holds
    return shares


def closed_by(found: Closings) -> np.ndarray:
    """Share of samples that have closed by each step of the chunk, (Tp,)."""
    return (found.closes[..., None] <= np.arange(found.pred)).mean(axis=(0, 1))


def _too_soon(found: Closings) -> np.ndarray:
    if found.lets_go is None:
        return np.zeros(found.closes.shape, bool)
    return (found.lets_go < found.pred) & (found.lets_go - found.closes < PROMPT[0])


def _first(holds: np.ndarray) -> np.ndarray:
    """The first step (..., Tp) at which it holds, Tp where it never does."""
    return np.where(holds.any(axis=-1), holds.argmax(axis=-1), holds.shape[-1])
