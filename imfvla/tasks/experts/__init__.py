"""Scripted demonstrators: they read the simulator, and their recorded actions are what policies learn."""

from imfvla.tasks.catalogue import class_at, entry_of
from imfvla.tasks.experts.base import Expert

__all__ = ["Expert", "make_expert"]


def make_expert(
    name: str,
    *,
    modes: int,
    noise: float,
    hold: int,
    dwell: int,
    recoveries: float = 0,
    max_turn: float | None = None,
) -> Expert:
    """The expert of the task `name`; see `Expert` for the rest. UserError on an unknown name."""
    made = class_at(entry_of(name).expert)
    return made(modes=modes, noise=noise, hold=hold, dwell=dwell, recoveries=recoveries, max_turn=max_turn)
