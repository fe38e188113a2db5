"""LeRobot opens what we write, and we read what it writes. It needs Python 3.12, so it lives in an environment apart.

    python3.12 -m venv .venvs/lerobot && .venvs/lerobot/bin/pip install 'lerobot[dataset]'

Another place is named by IMFVLA_LEROBOT_VENV.
"""

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="needs the extra lerobot")
from outside import ROBOT, episode, options

from imfvla.sources.lerobot import LeRobotWriter, open_source

ROOT = Path(__file__).resolve().parents[2]
VENV = Path(os.environ.get("IMFVLA_LEROBOT_VENV", ROOT / ".venvs" / "lerobot"))
LENGTHS = (8, 5, 7)
CODEC_ERROR = 5.0  # mean over the pixels of an episode, of 255; pictures of two steps differ by 11

pytestmark = pytest.mark.skipif(
    not (VENV / "bin" / "python").exists(),
    reason="needs a virtual environment with LeRobot in .venvs/lerobot or where IMFVLA_LEROBOT_VENV says",
)


def lerobot(*arguments):
    environment = os.environ | {"HF_HUB_OFFLINE": "1", "SVT_LOG": "1"}
    environment.pop("PYTHONPATH", None)
    command = [VENV / "bin" / "python", Path(__file__).with_name("lerobot_itself.py"), *arguments]
    done = subprocess.run(
        list(map(str, command)), env=environment, capture_output=True, encoding="utf-8", check=False
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("pictures", ["av1", "h264", "png"])
def test_lerobot_opens_what_we_wrote(tmp_path, pictures):
    episodes = [episode(number, length) for number, length in enumerate(LENGTHS)]
    with LeRobotWriter(tmp_path / "set", ROBOT, pictures=pictures) as writer:
        for made in episodes:
            writer.add(made)
    lerobot("open", tmp_path / "set", tmp_path / "items.npz")
    items = np.load(tmp_path / "items.npz", allow_pickle=False)
    assert items["fps"] == 10
    assert items["tasks"].tolist() == [made.instructions[0] for made in episodes for _ in made.state]
    assert np.array_equal(items["observation.state"], np.concatenate([made.state for made in episodes]))
    row = 0
    for made in episodes:
        last = len(made.state) - 1
        for step in range(last + 1):
            ahead = np.arange(step, step + 3)
            assert np.array_equal(items["action"][row], made.action[np.minimum(ahead, last)])
            assert np.array_equal(items["action_is_pad"][row], ahead > last)
            before = [max(0, step - 1), step]
            check(items["observation.images.front"][row], made.images["front"][before], pictures)
            check(items["observation.images.wrist"][row], made.images["wrist"][step], pictures)
            row += 1
    shades = np.concatenate([made.images["front"] for made in episodes])
    assert items["q50"].shape == (3, 1, 1)
    assert np.abs(items["q50"] * 255 - np.median(shades)).max() < 15


def check(seen, made, pictures):
    """seen: float32 (..., 3, H, W) in [0, 1]."""
    error = np.abs(np.moveaxis(seen, -3, -1) * 255 - made).mean()
    assert error <= (0.01 if pictures == "png" else CODEC_ERROR)


def test_we_read_what_lerobot_wrote(tmp_path):
    episodes = [episode(number, length) for number, length in enumerate(LENGTHS)]
    arrays = {"num_episodes": np.array(len(episodes))}
    for number, made in enumerate(episodes):
        arrays |= {f"state{number}": made.state, f"action{number}": made.action}
        arrays |= {f"{view}{number}": frames for view, frames in made.images.items()}
    np.savez(tmp_path / "made.npz", **arrays)
    lerobot("write", tmp_path / "made.npz", tmp_path / "sets")
    for kind, most in (("video", CODEC_ERROR), ("image", 0)):
        source = open_source(options("lerobot", path=str(tmp_path / "sets" / kind)))
        assert source.robot.state == ("shoulder", "elbow", "gripper")
        assert source.robot.relative_to == (0, 1, None)
        assert source.robot.cameras == ROBOT.cameras
        actions = np.concatenate([made.action for made in episodes])
        assert np.allclose(source.robot.action_min, actions.min(0))
        assert len(source) == 3
        for index in (2, 0, 1):
            read, made = source.episode(index, ("front", "wrist")), episodes[index]
            assert np.array_equal(read.state, made.state)
            assert np.array_equal(read.action, made.action)
            assert read.instructions == made.instructions
            for view, frames in made.images.items():
                assert np.abs(read.images[view].astype(float) - frames).mean() <= most
