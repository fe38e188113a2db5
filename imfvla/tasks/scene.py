"""The table, the lights, the fixed cameras and the two arms in their places."""

import numpy as np
from dm_control import composer, mjcf

from imfvla.tasks.bimanual_robot import LARGEST_PICTURE
from imfvla.tasks.robot import TABLE_BIT, Arm, look_at

PHYSICS_TIMESTEP_S = 0.004
BASE_X = 0.62  # the arms' bases stand at -x (left) and +x (right) and face each other
# view -> MJCF name
CAMERAS = {"front": "front", "top": "top", "r_wrist": "right/wrist", "l_wrist": "left/wrist"}


class Scene(composer.Arena):
    """One table with two arms. World: x from left to right, y away from the front camera, z up, table top at 0."""

    def _build(self) -> None:
        super()._build(name="scene")
        root = self._mjcf_root
        root.compiler.angle = "radian"
        root.option.timestep = PHYSICS_TIMESTEP_S
        root.option.integrator = "implicitfast"
        root.option.cone = "pyramidal"
        root.option.iterations = 50
        root.option.ls_iterations = 50
        root.statistic.meansize = 0.05
        root.statistic.extent = 1.0
        self._draw_plainly(root)
        root.worldbody.add(
            "geom",
            name="table",
            # the third size is the spacing of the grid that is drawn: fine grids cost milliseconds
            type="plane",
            size=[3, 3, 1],
            rgba=[0.80, 0.77, 0.70, 1],
            contype=TABLE_BIT,
            conaffinity=0,
            friction=[0.6, 0.01, 0.0005],
            condim=3,
            solref=[0.01, 1],
        )
        for name, position, target, fovy in (
            ("front", (0.0, -0.74, 0.52), (0.0, 0.0, 0.10), 45),
            ("top", (0.0, 0.0, 0.95), (0.0, 0.0, 0.0), 42),
        ):
            up = np.array([0, 1.0, 0]) if name == "top" else np.array([0, 0, 1.0])
            root.worldbody.add(
                "camera",
                name=name,
                pos=position,
                xyaxes=look_at(np.array(position), np.array(target), up),
                fovy=fovy,
            )
        self.arms = {side: Arm(side) for side in ("left", "right")}
        for side, sign in (("left", -1), ("right", 1)):
            frame = self.attach(self.arms[side])
            frame.pos = [sign * BASE_X, 0, 0]
            frame.quat = [1, 0, 0, 0] if side == "left" else [0, 0, 0, 1]

    def _draw_plainly(self, root: mjcf.RootElement) -> None:
        """No shadows, reflections or multisampling, coarse round shapes: rendering is some 20 times faster."""
        root.visual.quality.shadowsize = 0
        root.visual.quality.offsamples = 0
        root.visual.quality.numslices = 12
        root.visual.quality.numstacks = 8
        root.visual.quality.numquads = 4
        getattr(root.visual, "global").offwidth = LARGEST_PICTURE[1]
        getattr(root.visual, "global").offheight = LARGEST_PICTURE[0]
        root.visual.map.znear = 0.01
        root.visual.headlight.ambient = [0.45, 0.45, 0.45]
        root.visual.headlight.diffuse = [0.15, 0.15, 0.15]
        root.visual.headlight.specular = [0, 0, 0]
        root.worldbody.add(
            "light", pos=[0.3, -0.6, 1.5], dir=[-0.2, 0.4, -1], directional=True, castshadow=False,
            diffuse=[0.5, 0.5, 0.5], specular=[0.1, 0.1, 0.1],
        )  # fmt: skip
