"""python -m imfvla.collect task=socket episodes=200"""

from imfvla.command import begin

if __name__ == "__main__":
    begin()

from typing import Any

from imfvla.entry import entry_point


@entry_point("collect")
def main(config: dict[str, Any]) -> None:
    # Imported late, so that a mistake in the config is reported at once.
    from imfvla.collection import collect

    demos = {key: value for key, value in config.items() if key not in ("task", "observation")}
    report = collect(config["task"], config["observation"], demos)
    found = report.recordings
    print(
        f"{found.directory}: {len(found.files)} demonstrations, {report.num_new} of them new in "
        f"{report.wall_s:.0f} s; {report.num_failed} failed and were discarded."
    )


if __name__ == "__main__":
    main()
