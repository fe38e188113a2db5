"""Checks recorded episodes: checksums, counts, times and pictures. Exits with 1 if any file fails.

python tools/mcap_check.py data/demos                   # every *.mcap below a directory
python tools/mcap_check.py episode.mcap other.mcap
"""

from imfvla.command import as_command, begin

if __name__ == "__main__":
    begin()

import argparse
import sys
from collections import Counter
from pathlib import Path

from mcap.records import Message, Statistics

from imfvla.errors import UserError
from imfvla.recording import Episode, read_episode
from imfvla.recording.mcap_file import clear_read_errors, misplaced_end, records


def check(path: Path) -> tuple[Episode, list[str]]:
    """The episode at `path` and its faults. Raises UserError where it cannot be read at all."""
    episode = read_episode(path)  # checksums, steps against messages, channels, every picture
    problems = []
    counts: Counter[int] = Counter()
    statistics: Statistics | None = None
    last = 0
    with clear_read_errors(path):
        data = path.read_bytes()
        if misplaced := misplaced_end(data):
            problems.append(misplaced)
        for record in records(data):
            if isinstance(record, Message):
                counts[record.channel_id] += 1
                if record.log_time < last:
                    problems.append(f"log time {record.log_time} follows {last}")
                last = max(last, record.log_time)
            elif isinstance(record, Statistics):
                statistics = record
    if statistics is not None and not agree(statistics, counts):  # writers may leave them out
        problems.append("the counts of its statistics are not those of its messages")
    if lacking := set(episode.info.views) - set(episode.images):
        problems.append(f"no frames of view {', '.join(sorted(lacking))}")
    if len(episode.state) != episode.result.num_steps:
        problems.append(f"{len(episode.state)} steps recorded, {episode.result.num_steps} in its result")
    return episode, problems


def agree(statistics: Statistics, counts: Counter[int]) -> bool:
    """Whether a file's statistics count its messages; those by channel may be left out."""
    by_channel = Counter(statistics.channel_message_counts)
    return statistics.message_count == counts.total() and +by_channel in (counts, Counter())


def named_path(text: str) -> Path:
    """A path of the command line; an empty one, as of an unset shell variable, is refused."""
    if not text:
        raise argparse.ArgumentTypeError("a path is empty")
    return Path(text)


@as_command
def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument(
        "paths", nargs="+", type=named_path, help="MCAP files, or directories to search for them"
    )
    arguments = parser.parse_args()
    files = [
        file
        for path in arguments.paths
        for file in (sorted(path.rglob("*.mcap")) if path.is_dir() else [path])
    ]
    if not files:
        print("No *.mcap found.", file=sys.stderr)
        return 1
    failed = 0
    for file in files:
        try:
            episode, problems = check(file)
        except UserError as error:
            problems = [str(error)]
        if problems:
            failed += 1
            print(f"FAIL  {file}: {'; '.join(problems)}")
        else:
            info, result = episode.info, episode.result
            print(
                f"ok    {file}: {info.task} {info.kind} seed {info.seed}, {result.num_steps} steps, "
                f"{len(episode.image_steps)} x {len(episode.images)} pictures, "
                f"max reward {result.max_reward:g}"
            )
    print(f"{len(files) - failed} of {len(files)} files ok")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
