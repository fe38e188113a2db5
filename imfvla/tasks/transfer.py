"""Object transfer: the right arm lifts a bar and hands it over to the left arm in the air."""

from dm_control import mjcf

from imfvla.tasks.bimanual import BimanualTask, StartRange
from imfvla.tasks.props import BAR_WIDTH, Bar

BAR_LENGTH = 0.22
# A thin bar is held only where fingers close at most 6 mm above the expert's height, a usual one up to 16 mm above.
WIDTHS = {"easy": BAR_WIDTH, "default": BAR_WIDTH, "hard": 0.014}
RANGES = {
    "easy": (StartRange((0.14, 0.18), (-0.02, 0.02), (-0.1, 0.1))),
    "default": (StartRange((0.04, 0.24), (-0.125, 0.125), (-0.55, 0.55))),
    "hard": (StartRange((0.02, 0.26), (-0.15, 0.15), (-0.75, 0.75))),
}
LIFTED = 0.03  # above the resting height


class TransferTask(BimanualTask):
    """Stages: 1 right gripper holds the bar, 2 lifted, 3 left one holds it too, 4 left one alone, in the air."""

    name = "transfer"

    def __init__(self, variant: str) -> None:
        super().__init__(variant, {"bar": Bar("bar", BAR_LENGTH, width=WIDTHS[variant])})
        self.ranges = {"bar": RANGES[variant]}

    def stage(self, physics: mjcf.Physics) -> int:
        return transfer_stage(self, physics)


def transfer_stage(task: BimanualTask, physics: mjcf.Physics) -> int:
    """The stage, 0 to 4, of the object "bar" of a task."""
    contacts = task.contacts(physics)
    left, right = (task.holds(contacts, side, "bar") for side in ("left", "right"))
    height = task.prop_pose(physics, "bar").position[2] - task.props["bar"].rest_height
    lifted = height > LIFTED and not task.on_table(contacts, "bar")
    if left and lifted:
        if not task.touches(contacts, "right", "bar"):
            return 4
        return 3 if right else 0
    if right:
        return 2 if lifted else 1
    return 0
