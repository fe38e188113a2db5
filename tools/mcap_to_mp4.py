"""Turns recorded episodes into mp4 videos of the frames that they hold, in real time.

python tools/mcap_to_mp4.py episode.mcap                   # writes episode.mp4 beside it, unless that exists
python tools/mcap_to_mp4.py episode.mcap -o film.mp4 --views front top

A frame stays until the next one. A policy that seldom looks seldom changes the picture, while the caption keeps
updating time, stage and return.
"""

from imfvla.command import as_command, begin

if __name__ == "__main__":
    begin()

import argparse
import math
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from imfvla.errors import UserError
from imfvla.recording import Episode, read_episode, write_mp4
from imfvla.recording.video import side_by_side, status_line, steps_between_frames


def frames(episode: Episode, every: int) -> Iterator[np.ndarray]:
    """Captioned pictures uint8 (H, W, 3) of every `every`-th control step: what was seen last before it or at it."""
    returns = episode.reward.cumsum()
    has_stages = bool(episode.result.first_step_of_stage)
    for step in range(episode.image_steps[0], len(episode.state), every):
        row = np.searchsorted(episode.image_steps, step, side="right") - 1
        stage = episode.stage[step] if has_stages else None
        status = status_line(episode.time_s[step], stage, returns[step])
        pictures = [episode.images[view][row] for view in episode.images]
        yield side_by_side(pictures, f"{episode.info.task}  seed {episode.info.seed}  {status}")


def export(source: Path, target: Path, views: list[str] | None) -> None:
    """Writes the video of one recording. Raises UserError where it is damaged or has no frames."""
    episode = read_episode(source, images=views or True)
    if not len(episode.image_steps):
        raise UserError(f"{source} holds no frames that all of its views share: there is nothing to show.")
    # A step that the video passes over would hide its frame.
    control_hz = episode.info.robot.control_hz
    every = math.gcd(steps_between_frames(control_hz), *np.diff(episode.image_steps).tolist())
    write_mp4(target, frames(episode, every), control_hz / every)


def check_target(target: Path, overwrite: bool) -> None:
    """Raises UserError if the video would replace another file, such as an evaluation's own video."""
    if target.suffix != ".mp4":
        raise UserError(f"The video must be called *.mp4, found {target}.")
    if target.exists() and not overwrite:
        raise UserError(
            f"{target} exists: name another video with --output, or add --overwrite to replace it."
        )


@as_command
def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("recordings", nargs="+", type=Path, help="MCAP files")
    parser.add_argument("-o", "--output", type=Path, help="the video, where there is one recording")
    parser.add_argument("--views", nargs="+", help="the views to show, all by default")
    parser.add_argument("--overwrite", action="store_true", help="replace existing videos")
    arguments = parser.parse_args()
    if arguments.output and len(arguments.recordings) > 1:
        parser.error("--output is for one recording")
    for source in arguments.recordings:
        if not source.name:
            parser.error("a recording has no name: it must be an MCAP file")
    targets = [arguments.output or source.with_suffix(".mp4") for source in arguments.recordings]
    for target in targets:
        check_target(target, arguments.overwrite)
    for source, target in zip(arguments.recordings, targets, strict=True):
        export(source, target, arguments.views)
        print(target)
    return 0


if __name__ == "__main__":
    sys.exit(main())
