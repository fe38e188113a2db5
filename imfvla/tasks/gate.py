"""Gate: the right arm carries a short bar past a post that blocks its way: on either side of it, or over it."""

import numpy as np
from dm_control import mjcf

from imfvla.tasks.bimanual import BimanualTask, StartRange
from imfvla.tasks.props import POST_RADIUS, Bar, Post

BAR_LENGTH = 0.10
RANGES = {  # of the bar and of the post, which stands between the bar and the middle of the table
    "easy": (
        StartRange((0.24, 0.28), (-0.02, 0.02), (-0.1, 0.1)),
        StartRange((0.095, 0.105), (-0.01, 0.01), (0.0, 0.0)),
    ),
    "default": (
        StartRange((0.21, 0.31), (-0.10, 0.10), (-0.55, 0.55)),
        StartRange((0.085, 0.115), (-0.03, 0.03), (0.0, 0.0)),
    ),
    "hard": (
        StartRange((0.20, 0.32), (-0.14, 0.14), (-0.75, 0.75)),
        StartRange((0.075, 0.125), (-0.05, 0.05), (0.0, 0.0)),
    ),
}
LIFTED = 0.03  # above the resting height


class GateTask(BimanualTask):
    """Stages: 1 the right gripper holds the bar, 2 lifted, 3 its end is beside or above the post, 4 all of it is past.

    After a touch of the post, by a hand or by the bar, the stage is 0 and the episode has failed.
    """

    name = "gate"

    def __init__(self, variant: str) -> None:
        super().__init__(variant, {"bar": Bar("bar", BAR_LENGTH, cap=0.01), "post": Post("post")})
        self.ranges = dict(zip(("bar", "post"), RANGES[variant], strict=True))
        self.touched_post = False  # whether the post has been touched in this episode

    @property
    def failed(self) -> bool:
        return self.touched_post

    def initialize_episode(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        self.touched_post = False
        super().initialize_episode(physics, random_state)

    def after_substep(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        """A touch may last less than a control step."""
        self.touched_post = self.touched_post or self.post_is_touched(physics)

    def post_is_touched(self, physics: mjcf.Physics) -> bool:
        """Whether anything but the table touches the post now."""
        return bool(self.partners(self.contacts(physics), "post") - {self.table})

    def stage(self, physics: mjcf.Physics) -> int:
        if self.touched_post:
            return 0
        contacts = self.contacts(physics)
        if not self.holds(contacts, "right", "bar"):
            return 0
        bar, post = (self.prop_pose(physics, name) for name in ("bar", "post"))
        if bar.position[2] < self.props["bar"].rest_height + LIFTED or self.on_table(contacts, "bar"):
            return 1
        ahead, behind = bar_ends(bar.position[0], bar.rotation[0, 0])
        if behind < post.position[0] - POST_RADIUS:
            return 4
        return 3 if ahead < post.position[0] else 2


def bar_ends(x: float, along: float) -> tuple[float, float]:
    """x of the bar's ends, the one that goes ahead (towards -x) first, where its axis has the x component `along`."""
    half = abs(along) * BAR_LENGTH / 2
    return x - half, x + half
