"""The robot of this package's own tasks: two 7-joint arms with grippers. Needs neither mujoco nor dm_control."""

from collections.abc import Sequence

from imfvla.config.views import require_drawable
from imfvla.errors import UserError
from imfvla.robot import Camera, RobotSpec

SIDES = ("left", "right")
JOINT_LIMITS = ((-2.9, 2.9), (-2.0, 2.0), (-2.9, 2.9), (-0.1, 2.7), (-2.9, 2.9), (-2.2, 2.2), (-3.05, 3.05))
GRIPPER, GRIPPER_LIMITS = "gripper [0, 1]", (0.0, 1.0)
CONTROL_HZ = 50
TIME_LIMIT_STEPS = 700  # of an episode of every task
# By `task.expert.modes`: the wrists whose way is drawn. Hands point down, so that a wrist's roll is the gripper's yaw.
DRAWN_WRISTS = {1: (), 2: ("right/joint_7",), 4: ("left/joint_7", "right/joint_7")}
ALL_VIEWS = ("front", "top", "r_wrist", "l_wrist")
USUAL_VIEWS = ALL_VIEWS[:3]  # of a policy that is not told which cameras it sees
LARGEST_PICTURE = (960, 1280)  # (H, W) [px]; the scene has a buffer of this size to draw into


def bimanual_robot(views: Sequence[str], image_size: Sequence[int]) -> RobotSpec:
    """The robot as these cameras show it, all at `image_size` (H, W) [px].

    Of each arm, the left one first: 7 joint angles and the gripper's opening. Actions are targets of the same
    channels; a chunk has joints relative to their present angles and openings as they are. Raises UserError for a view
    that the scene does not have, and for pictures that it cannot draw.
    """
    require_drawable(image_size, LARGEST_PICTURE)
    for view in views:
        if view not in ALL_VIEWS:
            raise UserError(
                f"There is no view {view!r}; choose from {', '.join(ALL_VIEWS)} in observation.views."
            )
    joints = [(f"joint_{number} [rad]", limits) for number, limits in enumerate(JOINT_LIMITS, 1)]
    arm = [*joints, (GRIPPER, GRIPPER_LIMITS)]
    names = tuple(f"{side}/{name}" for side in SIDES for name, _ in arm)
    low, high = zip(*(limits for _ in SIDES for _, limits in arm), strict=True)
    height, width = image_size
    return RobotSpec(
        state=names,
        action=names,
        relative_to=tuple(None if name.endswith(GRIPPER) else index for index, name in enumerate(names)),
        action_min=low,
        action_max=high,
        control_hz=float(CONTROL_HZ),
        cameras=tuple(Camera(view, height, width) for view in views),
    )
