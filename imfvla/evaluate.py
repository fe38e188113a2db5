"""python -m imfvla.evaluate run=DIR episodes=100 first_seed=100000 nfe=1,2,3"""

from imfvla.command import begin

if __name__ == "__main__":
    begin()

from typing import Any

from imfvla.command.entry import entry_point
from imfvla.config.protocol import EvaluationOptions
from imfvla.errors import UserError
from imfvla.options import build, is_whole, require
from imfvla.robot_of import has_environment
from imfvla.storage.run_directory import RunDirectory


@entry_point("evaluate")
def main(config: dict[str, Any]) -> None:
    require(config["run"] is None or isinstance(config["run"], str), "run", "a directory", config["run"])
    if not config["run"]:
        raise UserError("evaluate needs the directory of a training run: run=runs/<experiment>/<name>.")
    wanted = {key: value for key, value in config.items() if key != "run"} | {"nfe": read_nfe(config["nfe"])}
    options = build(EvaluationOptions, wanted, "")
    run = RunDirectory(config["run"])
    trained = run.config()
    # Imported late, so that a mistake in the command is reported at once.
    from imfvla.deployment.ready import check_runtime, export_missing
    from imfvla.reporting.table_row import print_row
    from imfvla.rollouts.evaluation import evaluate
    from imfvla.training.checkpoint import check_weights

    check_runtime(trained, options)
    if not has_environment(trained):
        from imfvla.reporting.offline_tables import print_offline
        from imfvla.rollouts.offline import evaluate_offline

        evaluate_offline(run, trained, options)
        print_offline(run)
        return
    check_weights(run, options.checkpoint)
    export_missing(run, options)
    summaries = evaluate(run, options)
    folders = [run.rollouts(summary["name"]) for summary in summaries]
    print_row(run, only=[folder.name for folder in folders])
    for folder in folders:
        print(folder)


def read_nfe(value: Any) -> list[int]:
    """Numbers of flow steps from a number, a list, or a text such as "1,2,3". Raises UserError."""
    items = value.split(",") if isinstance(value, str) else value if isinstance(value, list) else [value]
    try:
        numbers = [item if is_whole(item) else int(str(item)) for item in items]
    except ValueError:
        numbers = []
    require(
        bool(numbers) and min(numbers) >= 1,
        "nfe",
        "one or more whole numbers of at least 1, such as 1,2,3",
        value,
    )
    return numbers


if __name__ == "__main__":
    main()
