"""Turns recorded episodes into mp4 videos of the frames that they hold, in real time.

python tools/mcap_to_mp4.py episode.mcap                   # writes episode.mp4 beside it
python tools/mcap_to_mp4.py episode.mcap -o film.mp4 --views front top
"""

from imfvla.command import as_command, begin

if __name__ == "__main__":
    begin()

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from imfvla.episode import CONTROL_HZ
from imfvla.errors import UserError
from imfvla.recording import Episode, read_episode, write_mp4
from imfvla.recording.video import side_by_side


def frames(episode: Episode) -> Iterator[np.ndarray]:
    """Captioned pictures uint8 (H, W, 3), one for each step with frames."""
    returns = episode.reward.cumsum()
    for row, step in enumerate(episode.image_steps):
        status = f"{episode.time_s[step]:5.2f} s  stage {episode.stage[step]}  return {returns[step]:.0f}"
        pictures = [episode.images[view][row] for view in episode.images]
        yield side_by_side(pictures, f"{episode.info.task}  seed {episode.info.seed}  {status}")


def export(source: Path, target: Path, views: list[str] | None) -> None:
    """Writes the video of one recording. Raises UserError where it is damaged or has too few frames."""
    episode = read_episode(source, images=views or True)
    if len(episode.image_steps) < 2:
        raise UserError(f"{source} holds {len(episode.image_steps)} frames: a video wants at least 2.")
    steps_per_frame = float(np.diff(episode.image_steps).mean())
    write_mp4(target, frames(episode), CONTROL_HZ / steps_per_frame)


@as_command
def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("recordings", nargs="+", type=Path, help="MCAP files")
    parser.add_argument("-o", "--output", type=Path, help="the video, where there is one recording")
    parser.add_argument("--views", nargs="+", help="the views to show, all by default")
    arguments = parser.parse_args()
    if arguments.output and len(arguments.recordings) > 1:
        parser.error("--output is for one recording")
    for source in arguments.recordings:
        target = arguments.output or source.with_suffix(".mp4")
        export(source, target, arguments.views)
        print(target)
    return 0


if __name__ == "__main__":
    sys.exit(main())
