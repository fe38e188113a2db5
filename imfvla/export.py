"""python -m imfvla.export run=DIR nfe=1,2,3: the policy as ONNX graphs, which ONNX Runtime runs without torch."""

from imfvla.command import begin

if __name__ == "__main__":
    begin()

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from imfvla.command.entry import entry_point
from imfvla.config.protocol import CHECKPOINT
from imfvla.errors import UserError
from imfvla.evaluate import read_nfe
from imfvla.options import build, within
from imfvla.runtime.graphs import FOLDER
from imfvla.storage.files import refuse_existing
from imfvla.storage.run_directory import LAST, RunDirectory


@dataclass(frozen=True, slots=True)
class ExportOptions:
    """conf/export.yaml."""

    run: str | None
    nfe: Any  # see `read_nfe`
    output: str | None
    checkpoint: Annotated[int | str, CHECKPOINT] = LAST
    observations: Annotated[int, within(1, 10_000)] = 100
    calls: Annotated[int, within(1, 100_000)] = 200


@entry_point("export")
def main(config: dict[str, Any]) -> None:
    options = build(ExportOptions, config, "")
    if not options.run:
        raise UserError("export needs the directory of a training run: run=runs/<experiment>/<name>.")
    nfe, run = read_nfe(options.nfe), RunDirectory(options.run)
    run.config()
    folder = run.path / FOLDER if options.output is None else Path(options.output)
    refuse_existing(folder, "remove it, or name another folder with output=DIR")
    # Imported late, so that a mistake in the command is reported at once.
    from imfvla.deployment.exporting import export_policy

    table = export_policy(run, options.checkpoint, nfe, folder, options.observations, options.calls)
    table.print()
    print(folder)


if __name__ == "__main__":
    main()
