"""python -m imfvla.convert from=lerobot from.path=FOLDER to=mcap to.path=NEW_FOLDER"""

from imfvla.command import begin

if __name__ == "__main__":
    begin()

from typing import Any

from imfvla.command.entry import entry_point

USAGE = (
    "Choose a source and a target, such as python -m imfvla.convert from=lerobot from.path=FOLDER to=mcap "
    "to.path=NEW_FOLDER. Sources are lerobot, mcap, ros2 and hdf5, with the options of conf/demos; targets are lerobot "
    "and mcap."
)


@entry_point("convert", usage=lambda: USAGE)
def main(config: dict[str, Any]) -> None:
    # Imported late, so that a mistake in the config is reported at once.
    from imfvla.sources.conversion import convert

    done = convert(config["from"], config["to"])
    repeats = f", the picture of an earlier step at {done.num_repeats} of them" if done.num_repeats else ""
    print(f"{done.path}: {done.num_episodes} episodes, {done.num_steps} steps{repeats}.")


if __name__ == "__main__":
    main()
