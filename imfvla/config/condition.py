"""Which condition an evaluation is under: the config group `condition`. `imfvla.conditions` has what each one does."""

from dataclasses import dataclass
from typing import Annotated

from imfvla.options import one_of, require, within

NONE = "none"  # the world as it was trained in
CONDITIONS = (
    "camera_pose",
    "light",
    "pixel_noise",
    "blur",
    "dropped_frames",
    "joint_bias",
    "action_lag",
    "friction",
    "mass",
    "object_size",
    "distractors",
    "bump",
)
SEVERITIES = (1, 2, 3)


@dataclass(frozen=True, slots=True)
class ConditionOptions:
    """A change of the world at evaluation, and how strong it is. Raises UserError on values out of range."""

    name: Annotated[str, one_of(NONE, *CONDITIONS)] = NONE
    severity: Annotated[int, within(SEVERITIES[0], SEVERITIES[-1])] | None = None

    def __post_init__(self) -> None:
        wanted = "null with condition=none" if self.name == NONE else f"1, 2 or 3 with condition={self.name}"
        require((self.severity is None) == (self.name == NONE), "condition.severity", wanted, self.severity)


UNCHANGED = ConditionOptions()
