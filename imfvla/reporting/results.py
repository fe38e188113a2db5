"""The numbers of a row of the tables, with their intervals, from the episodes of its evaluations."""

from collections.abc import Sequence
from functools import cached_property

from imfvla.reporting.answers import Answer, Evaluated
from imfvla.reporting.mapping.row import TableRow
from imfvla.reporting.metrics import METRICS
from imfvla.reporting.paper import PaperRow
from imfvla.reporting.records import Row
from imfvla.reporting.runs import Evaluation
from imfvla.reporting.statistics.estimates import wilson_interval
from imfvla.reporting.statistics.measured import Measured

BY_NAME = {metric.name: metric for metric in METRICS}


class Result:
    """The results of a policy at one NFE: of a row of the tables, or of a policy outside of them.

    Of several training seeds, the episodes of all count. Numbers are None where the row is missing.
    """

    def __init__(self, evaluated: Sequence[Evaluated], answer: Answer | None = None) -> None:
        assert evaluated or answer
        self.evaluated, self.answer = tuple(evaluated), answer
        self._measured: dict[str, Measured] = {}

    @classmethod
    def of(cls, answer: Answer) -> "Result":
        return cls(answer.evaluated, answer)

    @property
    def row(self) -> TableRow | None:
        """Its row of the tables."""
        return self.answer.row if self.answer else None

    @property
    def paper(self) -> PaperRow | None:
        return self.row.paper if self.row else None

    @property
    def is_missing(self) -> bool:
        return not self.evaluated

    @property
    def first(self) -> Evaluation:
        """The evaluation of the first training seed."""
        return self.evaluated[0].evaluation

    @property
    def name(self) -> str:
        """Short, and unique in a report."""
        if self.row:
            return self.row.name
        return f"{self.policy}, infer{self.nfe}, step {self.first.summary['checkpoint_step']}"

    @property
    def policy(self) -> str:
        """Experiment and overrides, the training seed apart, and the noise where it is unusual."""
        if self.row:
            return f"{self.row.experiment}/{self.row.run}" if self.row.run else self.row.experiment
        return self.first.label

    @property
    def nfe(self) -> int:
        return self.row.nfe if self.row else self.first.nfe

    @property
    def task(self) -> str | None:
        return self.first.summary["protocol"]["task"] if self.evaluated else None

    @property
    def is_last(self) -> bool:
        """Whether the weights are those at the end of training."""
        evaluations = [found.evaluation for found in self.evaluated]
        return all(e.summary["checkpoint_step"] == e.training_steps for e in evaluations) and bool(
            evaluations
        )

    @property
    def episodes(self) -> list[Row]:
        """Of all training seeds, one after the other."""
        return [row for found in self.evaluated for row in found.episodes]

    @property
    def metrics(self) -> dict[str, Measured]:
        """By name: every one of `METRICS`."""
        return {name: self.metric(name) for name in BY_NAME}

    def metric(self, name: str) -> Measured:
        """One of `METRICS`; intervals take time, so that none is computed which nobody asks for."""
        if name not in self._measured:
            by_seed = [found.episodes for found in self.evaluated]
            self._measured[name] = Measured(None) if self.is_missing else BY_NAME[name].measured(by_seed)
        return self._measured[name]

    @cached_property
    def paper_success_share(self) -> Measured:
        """The share printed in the paper, with the interval of its count."""
        if not self.paper:
            return Measured(None)
        count, number = self.paper.success, self.paper.episodes
        return Measured(count / number, *wilson_interval(count, number))
