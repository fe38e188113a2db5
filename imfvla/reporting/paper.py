"""The paper's printed tables, from `experiments/paper`. `mapping.py` says which run fills a row."""

import csv
from dataclasses import dataclass
from functools import cache

from imfvla.assets import folder

DIRECTORY = folder("experiments") / "paper"
TABLES = (1, 2)  # rows of methods; table 3 compares them
TITLES = {
    1: "Table 1: socket peg insertion",
    2: "Table 2: object transfer",
    3: "Table 3: derived comparisons",
}


@dataclass(frozen=True, slots=True)
class PaperRow:
    """One printed row of Table 1 or 2."""

    table: int
    method: str
    setting: str
    avg_reward: float
    median: float
    avg_max: float
    nonzero: int
    success: int
    episodes: int
    latency_ms: float | None  # printed in Table 1 only
    inference_fps: float | None  # printed in Table 2 only

    @property
    def label(self) -> str:
        """Unique within its table."""
        return f"{self.method} ({self.setting})"


@dataclass(frozen=True, slots=True)
class PaperComparison:
    """One printed row of Table 3; `result` is the text as printed."""

    comparison: str
    metric: str
    result: str

    @property
    def label(self) -> str:
        """Unique within Table 3."""
        return f"{self.comparison}, {self.metric}"


@cache
def paper_rows() -> tuple[PaperRow, ...]:
    """The rows of Tables 1 and 2 in the paper's order."""
    return tuple(_row(table, line) for table in TABLES for line in _lines(table))


@cache
def paper_comparisons() -> tuple[PaperComparison, ...]:
    """The rows of Table 3 in the paper's order."""
    return tuple(PaperComparison(**line) for line in _lines(3))


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
