"""The paper's printed tables, from `experiments/paper`."""

import csv
from dataclasses import dataclass
from functools import cache
from pathlib import Path

DIRECTORY = Path(__file__).resolve().parents[2] / "experiments" / "paper"
TABLES = (1, 2)  # rows of experiments; table 3 compares them
TITLES = {
    1: "Table 1: socket peg insertion",
    2: "Table 2: object transfer",
    3: "Table 3: derived comparisons",
}


@dataclass(frozen=True, slots=True)
class PaperRow:
    """One printed row of Table 1 or 2; `nfe` is our reading where the paper does not say it."""

    table: int
    experiment: str
    nfe: int
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


@dataclass(frozen=True, slots=True)
class Comparison:
    """One printed row of Table 3: `column` of a row against that of its baseline."""

    experiment: str
    nfe: int
    baseline: str
    baseline_nfe: int
    column: str  # a field of PaperRow
    operation: str  # ratio | inverse_ratio | difference
    comparison: str
    metric: str
    result: str  # as printed


@cache
def paper_rows() -> tuple[PaperRow, ...]:
    """The rows of Tables 1 and 2 in the paper's order."""
    return tuple(_row(table, line) for table in TABLES for line in _lines(table))


@cache
def comparisons() -> tuple[Comparison, ...]:
    """The rows of Table 3 in the paper's order."""
    return tuple(
        Comparison(**{**line, "nfe": int(line["nfe"]), "baseline_nfe": int(line["baseline_nfe"])})
        for line in _lines(3)
    )


def paper_row(experiment: str, nfe: int) -> PaperRow | None:
    """The printed row of an experiment, None where the paper has none."""
    return next((row for row in paper_rows() if (row.experiment, row.nfe) == (experiment, nfe)), None)


def _lines(table: int) -> list[dict[str, str]]:
    with open(DIRECTORY / f"table{table}.csv", newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def _row(table: int, line: dict[str, str]) -> PaperRow:
    nonzero, episodes = (int(part) for part in line["nonzero"].split("/"))
    success, _ = (int(part) for part in line["success"].split("/"))
    return PaperRow(
        table=table,
        experiment=line["experiment"],
        nfe=int(line["nfe"]),
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
