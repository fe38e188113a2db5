"""python -m imfvla.report [run=DIR]"""

from imfvla.command import begin

if __name__ == "__main__":
    begin()

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.core.global_hydra import GlobalHydra

from imfvla.command.composition import Places, compose
from imfvla.command.entry import entry_point
from imfvla.options import build
from imfvla.robot_of import has_environment
from imfvla.storage.run_directory import RunDirectory


@dataclass(frozen=True, slots=True)
class ReportOptions:
    """conf/report.yaml."""

    run: str | None
    directories: tuple[str, ...]
    mapping: str | None
    method: tuple[str, ...]
    output: str
    media: bool


@entry_point("report")
def main(config: dict[str, Any]) -> None:
    """Prints the rows of one run, or publishes the tables of all runs: Markdown, CSV, LaTeX, figures and a page."""
    options = build(ReportOptions, config, "")
    if config["run"]:
        run = RunDirectory(config["run"])
        if has_environment(run.config()):
            from imfvla.reporting.table_row import print_row

            print_row(run)
        else:
            from imfvla.reporting.offline_tables import print_offline

            print_offline(run)
        return
    # Imported late, so that a mistake in the config is reported at once.
    from imfvla.command.publication import publish
    from imfvla.reporting.mapping import PATH, read_mapping

    mapping = read_mapping(Path(options.mapping) if options.mapping else PATH)
    directories = [Path(directory) for directory in options.directories]
    places = Places.of_command()
    GlobalHydra.instance().clear()  # the method is composed below
    method = compose("train", options.method, places)
    publication = publish(directories, Path(options.output), mapping, method, media=options.media)
    paths = publication.write()
    for table in publication.tables:
        table.print()
    for sentence in publication.left_out:
        print(sentence)
    for path in paths:
        print(path)


if __name__ == "__main__":
    main()
