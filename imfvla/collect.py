"""python -m imfvla.collect task=socket episodes=200, or those of an experiment: python -m imfvla.collect +exp=gate"""

from imfvla.command import begin

if __name__ == "__main__":
    begin()

import sys
from collections.abc import Mapping, Sequence
from typing import Any

from imfvla.command.composition import key_of
from imfvla.command.entry import entry_point

# Of an experiment's config, which a training would write a run directory for.
NOTHING_WRITTEN = ("hydra/output=plain", "hydra/job_logging=plain")


def main(argv: Sequence[str] | None = None) -> None:
    """Composes conf/collect.yaml or, where an experiment is named, the conf/train.yaml that it changes."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if any(key_of(text) == "exp" for text in arguments):
        of_experiment([*arguments, *NOTHING_WRITTEN])
    else:
        of_options(arguments)


@entry_point("collect")
def of_options(config: dict[str, Any]) -> None:
    demos = {key: value for key, value in config.items() if key not in ("task", "observation")}
    _collect(config["task"], config["observation"], demos, "")


@entry_point("train")
def of_experiment(config: dict[str, Any]) -> None:
    _collect(config["task"], config["observation"], config["demos"], "demos")


def _collect(
    task: Mapping[str, Any], observation: Mapping[str, Any], demos: Mapping[str, Any], where: str
) -> None:
    # Imported late, so that a mistake in the config is reported at once.
    from imfvla.sources.collection import collect

    report = collect(task, observation, demos, where)
    found = report.recordings
    print(
        f"{found.directory}: {len(found.files)} demonstrations, {report.num_new} of them new in "
        f"{report.wall_s:.0f} s; {report.num_failed} failed and were discarded."
    )


if __name__ == "__main__":
    main()
