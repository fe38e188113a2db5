"""python -m imfvla.train +exp=NAME: collects what is missing, trains, evaluates and prints the table row."""

from typing import Any

from imfvla.entry import entry_point, output_directory
from imfvla.run_directory import RunDirectory


@entry_point("train")
def main(config: dict[str, Any]) -> None:
    from imfvla.experiment import run_experiment  # after the config is composed: a slip is told at once

    run_experiment(config, RunDirectory(output_directory()))


if __name__ == "__main__":
    main()
