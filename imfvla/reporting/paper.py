"""The paper's printed tables, from `experiments/paper`. `mapping` says which run fills a row."""

import csv
import re
from dataclasses import dataclass
from functools import cache

from imfvla.config.assets import folder

DIRECTORY = folder("experiments") / "paper"


@dataclass(frozen=True, slots=True)
class PaperRow:
    """One printed row of a table of methods."""

    table: int  # its number in the paper
    method: str
    setting: str
    avg_reward: float
    median: float
    avg_max: float
    nonzero: int
    success: int
    episodes: int
    latency_ms: float | None  # None where the table does not print it
    inference_fps: float | None  # None where the table does not print it

    @property
    def label(self) -> str:
        """Unique within its table."""
        return f"{self.method} ({self.setting})"


@dataclass(frozen=True, slots=True)
class PaperComparison:
    """One printed comparison of two rows; `result` is the text as printed."""

    comparison: str
    metric: str
    result: str

    @property
    def label(self) -> str:
        """Unique within its table."""
        return f"{self.comparison}, {self.metric}"


@cache
def paper_numbers() -> tuple[int, ...]:
    """The numbers of the printed tables that there are."""
    found = (re.fullmatch(r"table(\d+)", path.stem) for path in DIRECTORY.glob("*.csv"))
    return tuple(sorted(int(match.group(1)) for match in found if match))


@cache
def paper_rows(table: int) -> tuple[PaperRow, ...]:
    """The rows of a printed table of methods, in the paper's order."""
    return tuple(_row(table, line) for line in _lines(table))


@cache
def paper_comparisons(table: int) -> tuple[PaperComparison, ...]:
    """The rows of a printed table of comparisons, in the paper's order."""
    return tuple(PaperComparison(**line) for line in _lines(table))


def _lines(table: int) -> list[dict[str, str]]:
    with open(DIRECTORY / f"table{table}.csv", newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def _row(table: int, line: dict[str, str]) -> PaperRow:
    nonzero, episodes = (int(part) for part in line["nonzero"].split("/"))
    success, _ = (int(part) for part in line["success"].split("/"))
    return PaperRow(
        table=table,
        method=line["method"],
        setting=line["setting"],
        avg_reward=float(line["avg_reward"]),
        median=float(line["median"]),
        avg_max=float(line["avg_max"]),
        nonzero=nonzero,
        success=success,
        episodes=episodes,
        latency_ms=float(line["latency_ms"]) if "latency_ms" in line else None,
        inference_fps=float(line["inference_fps"]) if "inference_fps" in line else None,
    )
