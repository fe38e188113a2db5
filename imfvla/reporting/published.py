"""What other papers print for a task: `experiments/paper/published.csv`, one line each."""

import csv
from dataclasses import dataclass
from functools import cache

from imfvla.reporting.paper import DIRECTORY


@dataclass(frozen=True, slots=True)
class PublishedRow:
    """A success rate as another paper prints it. Data, training and simulator are that paper's."""

    task: str
    method: str
    setting: str
    success_percent: float
    source: str

    @property
    def label(self) -> str:
        return f"{self.method} ({self.setting})"


@cache
def published_rows(task: str | None) -> tuple[PublishedRow, ...]:
    """The lines of a task, in their order."""
    with open(DIRECTORY / "published.csv", newline="", encoding="utf-8") as file:
        lines = [line for line in csv.DictReader(file) if line["task"] == task]
    return tuple(
        PublishedRow(**{**line, "success_percent": float(line["success_percent"])}) for line in lines
    )
