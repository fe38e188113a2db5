"""python -m imfvla.train +exp=NAME: collects what is missing, trains, evaluates and prints the table row.

With -m, or +sweep=NAME for a file of conf/sweep: many experiments, without those that are finished.
"""

from imfvla.command import begin

if __name__ == "__main__":
    begin()

from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig

from imfvla.command.composition import CONFIG_DIRECTORY
from imfvla.command.entry import entry_point, output_directory
from imfvla.storage.run_directory import RunDirectory
from imfvla.training.experiment import read_experiment


def usage() -> str:
    """What to type, printed where no override was given."""
    names = ", ".join(sorted(path.stem for path in (CONFIG_DIRECTORY / "exp").glob("*.yaml")))
    return (
        f"Name an experiment: python -m imfvla.train +exp=NAME [key=value ...]. There are {names}. Any other override "
        "works too: task=transfer trains on that task without a named experiment. --help shows all keys."
    )


def is_finished(config: dict[str, Any], directory: Path) -> bool:
    """Whether a job of a sweep has nothing left to do."""
    from imfvla.command.completion import is_complete  # late, as below

    return is_complete(config, directory)


@entry_point("train", is_finished, usage)
def main(config: dict[str, Any]) -> None:
    read_experiment(config)
    # Imported late, so that a mistake in the config is reported at once.
    from imfvla.command.experiment import run_experiment

    overrides = list(HydraConfig.get().overrides.task)
    run_experiment(config, RunDirectory(output_directory()), overrides)


if __name__ == "__main__":
    main()
