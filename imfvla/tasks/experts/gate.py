"""Expert of the gate task: it brings the bar to a pose straight ahead of the post, and there goes one of three ways."""

from collections.abc import Mapping

import numpy as np

from imfvla.tasks.bimanual import Pose
from imfvla.tasks.bimanual_environment import BimanualEnvironment
from imfvla.tasks.experts.base import Expert
from imfvla.tasks.experts.hand import CARROT_S, lift
from imfvla.tasks.gate import BAR_LENGTH
from imfvla.tasks.kinematics import about_z, rotation_vector
from imfvla.tasks.props import BAR_WIDTH, POST_HEIGHT, POST_RADIUS

CARRY_HEIGHT = (
    POST_HEIGHT - BAR_WIDTH / 2
)  # of the bar's centre: straight ahead, all of its end meets the post
STAGING, GATE = 0.10, 0.045  # from the bar's end to the post: where the bar is aligned, where the ways part
# Along the line, from the staging on, as a share of the speed before: an average meets the post within a chunk.
HASTE = 2.0
PAST = 0.03  # how far behind the post the bar's other end comes to rest
ALIGNED, ALIGNED_ANGLE = 0.006, 0.06  # m, rad
WIDTH = 0.058  # of a way from the line: beside the post, fingers pass with 17 mm to spare
# Directions across the line. Of two ways the median is one or the other. Of these three, a third of a turn apart, it is
# straight ahead and down, and the mean is straight ahead: no way is nearer to it than another.
WAYS = {
    "left": np.array([0, -np.sqrt(0.75), -0.5]),
    "right": np.array([0, np.sqrt(0.75), -0.5]),
    "over": np.array([0, 0, 1.0]),
}


class GateExpert(Expert):
    task_name = "gate"

    def draw_style(self, rng: np.random.Generator) -> Mapping[str, float]:
        self.grip_at = rng.uniform(-0.01, 0.01)
        # Nothing in the observation shows the way before the gate.
        self.way = str(rng.choice(list(WAYS)))
        return {"grip_at": self.grip_at, "way": self.way}

    def command(self, env: BimanualEnvironment, contacts: np.ndarray) -> None:
        left, right = self.hands["left"], self.hands["right"]
        left.move(left.home, 1.0, self.speed)
        bar, post = (self.task.prop_pose(env.physics, name) for name in ("bar", "post"))
        # half a turn changes nothing about a symmetric bar
        if abs(rotation_vector(bar.rotation)[2]) > np.pi / 2:
            bar = Pose(bar.position, bar.rotation @ about_z(np.pi))
        line = np.array([0, post.position[1], CARRY_HEIGHT])
        aside = bar.position - line
        gap = aside[0] - BAR_LENGTH / 2 - post.position[0] - POST_RADIUS
        staging = Pose(line + np.array([bar.position[0] - gap + STAGING, 0, 0]), np.eye(3))
        if not (right.closed and self.task.holds(contacts, "right", "bar")):
            self.pick(right, bar, np.array([self.grip_at, 0, 0]), staging.position)
            return
        aligned = (
            np.abs(aside[1:]).max() < ALIGNED
            and np.linalg.norm(rotation_vector(bar.rotation)) < ALIGNED_ANGLE
        )
        if gap > GATE and not (aligned and gap < STAGING + 0.01):
            goal = lift(bar, staging, self.task.props["bar"].rest_height)
            right.move(right.carry(bar, goal), 0.0, self.speed)
            return
        speed = HASTE * self.speed
        ahead = min(speed * CARROT_S, gap + BAR_LENGTH + 2 * POST_RADIUS + PAST)
        turning = GATE - (gap - ahead)  # how far behind the gate the goal lies
        turned = np.clip(turning, 0, WIDTH)
        goal = line + np.array([bar.position[0] - ahead, 0, 0]) + turned * WAYS[self.way]
        # At half a right angle to the line, and as fast along it as before.
        steep = 0 < turning < WIDTH + 0.01
        right.move(right.carry(bar, Pose(goal, np.eye(3))), 0.0, speed * np.sqrt(2) if steep else speed)
