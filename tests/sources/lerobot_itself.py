"""Run by the Python of a virtual environment with LeRobot: opens what we wrote, and writes what we read.

python lerobot_itself.py open FOLDER FILE.npz     all items, with delta_timestamps, as arrays
python lerobot_itself.py write FILE.npz FOLDER    episodes of arrays as a data set, with videos and with images
"""

import sys

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

VIEWS = ("front", "wrist")


def open_all(folder: str, file: str) -> None:
    delta = {"action": [0.0, 0.1, 0.2], "observation.images.front": [-0.1, 0.0]}
    data = LeRobotDataset("made/here", root=folder, delta_timestamps=delta, video_backend="pyav")
    items = [data[index] for index in range(len(data))]
    np.savez(
        file,
        tasks=np.array([item["task"] for item in items]),
        fps=data.fps,
        action_is_pad=np.stack([item["action_is_pad"].numpy() for item in items]),
        q50=np.asarray(data.meta.stats["observation.images.front"]["q50"]),
        **{
            key: np.stack([item[key].numpy() for item in items])
            for key in ("observation.state", "action", *(f"observation.images.{view}" for view in VIEWS))
        },
    )


def write_all(file: str, folder: str) -> None:
    arrays = np.load(file, allow_pickle=False)
    names = ["shoulder", "elbow", "gripper"]
    pictures = ["height", "width", "channels"]
    for kind in ("video", "image"):
        features = {
            "observation.state": {"dtype": "float32", "shape": (3,), "names": names},
            "action": {"dtype": "float32", "shape": (3,), "names": names},
            "observation.images.front": {"dtype": kind, "shape": (64, 96, 3), "names": pictures},
            "observation.images.wrist": {"dtype": kind, "shape": (64, 64, 3), "names": pictures},
        }
        data = LeRobotDataset.create(
            "made/there", fps=10, features=features, root=f"{folder}/{kind}", use_videos=kind == "video"
        )
        for number in range(int(arrays["num_episodes"])):
            for step in range(len(arrays[f"state{number}"])):
                frame = {f"observation.images.{view}": arrays[f"{view}{number}"][step] for view in VIEWS}
                frame |= {
                    key: arrays[f"{key.rpartition('.')[2]}{number}"][step] for key in list(features)[:2]
                }
                data.add_frame(frame | {"task": f"do task {number % 2}"})
            data.save_episode()
        data.finalize()


if __name__ == "__main__":
    {"open": open_all, "write": write_all}[sys.argv[1]](*sys.argv[2:])
