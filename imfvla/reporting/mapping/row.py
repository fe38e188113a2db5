"""A row of the tables: the policy, its weights and the evaluation that answer it."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from imfvla.reporting.mapping.file import named
from imfvla.reporting.paper import PaperRow
from imfvla.storage.run_directory import step_of
from imfvla.storage.run_names import run_key, run_name


@dataclass(frozen=True, slots=True)
class Wanted:
    """The evaluation that a row is taken from: whole episodes from consecutive seeds."""

    first_seed: int
    episodes: int
    noise_seed: int
    device: str


@dataclass(frozen=True, slots=True)
class TableRow:
    """A row of a table. `paper` is the printed row, None for a row that the paper does not have."""

    name: str
    table: str  # name of its table
    experiment: str  # of conf/exp
    overrides: tuple[str, ...]
    nfe: int
    checkpoint: str  # "last", or a share such as "1/3" of the training steps
    wanted: Wanted
    method: str
    setting: str
    paper: PaperRow | None
    where: str  # file and line, for messages
    # Of a row in a setting: keys and values of the protocol that differ from `protocol.USUAL`, and the unchanged row.
    changes: tuple[tuple[str, Any], ...] = ()
    base: str | None = None

    @property
    def run(self) -> str:
        """Name of the run directory below that of the experiment, its seed apart; "" for "default"."""
        return _run_of(self.overrides)

    @property
    def label(self) -> str:
        return f"{self.method} ({self.setting})"

    def options(self, prefix: str = "") -> list[str]:
        """The overrides of an evaluation with these changes; `prefix` is "evaluation." in a training."""
        names = {"condition": "condition", "severity": f"{prefix}condition.severity"}
        return [f"{names.get(key, prefix + key)}={value}" for key, value in self.changes]

    def step(self, steps: int) -> int:
        """The step of the row's weights in a training of so many steps."""
        return step_of(steps, self.checkpoint)


def row_named(name: str, rows: Mapping[str, TableRow], where: str) -> TableRow:
    """The row of any table that is called `name`. Raises UserError with those that are in no setting."""
    if name in rows:
        return rows[name]
    usual = {other: row for other, row in rows.items() if not row.changes}
    return named(name, usual, f"{where}: unknown row")


@lru_cache(maxsize=4096)
def _run_of(overrides: tuple[str, ...]) -> str:
    """Kept, since every row is compared with every evaluation."""
    return run_key(run_name(overrides))
