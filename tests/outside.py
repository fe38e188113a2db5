"""Episodes of a small robot whose every picture tells its step, as sources and converters of outside data get them."""

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from imfvla.robot import Camera, RobotSpec
from imfvla.sources import EpisodeArrays

CONF = Path(__file__).resolve().parents[1] / "conf" / "demos"
ROBOT = RobotSpec(
    state=("shoulder [rad]", "elbow [rad]", "gripper [0, 1]"),
    action=("shoulder [rad]", "elbow [rad]", "gripper [0, 1]"),
    relative_to=(0, 1, None),
    action_min=(-2.0, -1.0, 0.0),
    action_max=(2.0, 1.0, 1.0),
    control_hz=10.0,
    cameras=(Camera("front", 64, 96), Camera("wrist", 64, 64)),
)


def picture(step: int, height: int, width: int, seed: int = 0) -> np.ndarray:
    """uint8 (H, W, 3): smooth, so that codecs err little, and as grey as no other step below 20."""
    shade = np.linspace(0, 20, width)[None, :, None] + np.linspace(0, 10, height)[:, None, None]
    return (shade + 11 * step + 3 * seed + np.zeros(3)).astype(np.uint8)


def episode(number: int, num_steps: int = 8, every: int = 1, robot: RobotSpec = ROBOT) -> EpisodeArrays:
    """Episode `number`: random numbers, pictures at every `every`-th step."""
    rng = np.random.default_rng(number)
    steps = np.arange(0, num_steps, every)
    return EpisodeArrays(
        name=f"made_{number}",
        task=f"task {number % 2}",
        instructions=(f"do task {number % 2}",),
        state=rng.uniform(-1, 1, (num_steps, len(robot.state))).astype(np.float32),
        action=rng.uniform(-1, 1, (num_steps, len(robot.action))).astype(np.float32),
        image_steps=steps,
        images={
            camera.name: np.stack([picture(step, camera.height, camera.width, number) for step in steps])
            for camera in robot.cameras
        },
    )


def options(name: str, **changes: Any) -> dict[str, Any]:
    """The options of conf/demos/<name>.yaml with these values, without what all sources share."""
    found = yaml.safe_load((CONF / f"{name}.yaml").read_text(encoding="utf-8"))
    return {key: value for key, value in found.items() if key not in ("source", "frames_directory")} | changes


EEF_STATE = {"eef_pos": ["x [m]", "y [m]"], "gripper_qpos": ["gripper [m]"]}
EEF_ACTION = ["x [m]", "y [m]", "gripper [m]"]
SMALL = (12, 20)


def arrays(number, num_steps=6):
    rng = np.random.default_rng(number)
    return rng.uniform(-1, 1, (num_steps, 3)), rng.uniform(-1, 1, (num_steps, 3))


def small_frames(number, num_steps=6):
    found = np.stack([picture(step, *SMALL, number) for step in range(num_steps)])
    found[..., 0] = 255 - found[..., 0]  # red differs from blue
    return found


def write_robomimic(path, numbers=(0, 1, 10)):
    """data/demo_<number> in an HDF5 file as robomimic's, each of 6 steps with one camera."""
    import h5py  # an extra

    with h5py.File(path, "w") as file:
        for number in numbers:
            demo = file.create_group(f"data/demo_{number}")
            state, action = arrays(number)
            demo["obs/eef_pos"], demo["obs/gripper_qpos"] = state[:, :2], state[:, 2:]
            demo["actions"], demo["actions_abs"] = action, action + 1
            demo.create_dataset(
                "obs/agentview_image", data=small_frames(number), compression="gzip", chunks=(1, *SMALL, 3)
            )
    return path
