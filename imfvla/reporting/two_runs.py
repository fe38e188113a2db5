"""Two runs compared start by start: a sentence and a table for each NFE."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from imfvla.errors import UserError
from imfvla.reporting.answers import Evaluated, read_evaluated
from imfvla.reporting.results import Result
from imfvla.reporting.runs import rows
from imfvla.reporting.statistics.contrasts import Contrast, return_difference, speedup, success_difference
from imfvla.reporting.statistics.pairs import Pairs, refusal
from imfvla.reporting.statistics.power import ALPHA, POWER
from imfvla.reporting.statistics.significance import holm
from imfvla.reporting.table import NOTHING, REFUSED, TOO_FEW, Table, with_interval
from imfvla.reporting.table_row import machine
from imfvla.reporting.tables import COLUMNS, ours, p_value
from imfvla.storage.run_directory import RunDirectory

NAMES = ("A", "B")


@dataclass(frozen=True, slots=True)
class Measure:
    """A measure in which two policies are compared: a column of the tables, and how a difference in it reads."""

    title: str
    column: str
    contrast: Callable[[Pairs], Contrast]
    scale: float
    digits: int
    unit: str  # of the contrast
    more: str  # "A {more} B by" so much
    less: str
    neutral: float  # of the contrast where both are alike
    value_unit: str = ""  # of the column


MEASURES = (
    Measure(
        "Success", "Success-like", success_difference, 100, 1, " points",
        more="succeeds more often than", less="succeeds less often than", neutral=0,
    ),
    Measure("Reward", "Avg. reward", return_difference, 1, 1, "", "earns more than", "earns less than", 0),
    Measure("Speed", "Latency ms", speedup, 1, 2, "×", "is faster than", "is slower than", 1, " ms"),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class ComparedMeasure:
    """A measure of both; `contrast` is None where `refused` says why it cannot be computed."""

    measure: Measure
    contrast: Contrast | None
    p_holm: float | None = None
    refused: str | None = None

    @property
    def is_shown(self) -> bool:
        """Whether a difference is significant after Holm's correction over the whole table."""
        return self.p_holm is not None and self.p_holm < ALPHA


@dataclass(frozen=True, slots=True)
class Duel:
    """One evaluation of A and one of B from the same starts, and the measures compared."""

    ours: Evaluated
    theirs: Evaluated
    compared: tuple[ComparedMeasure, ...] = ()

    @property
    def label(self) -> str:
        one, other = self.ours.evaluation.nfe, self.theirs.evaluation.nfe
        return f"infer{one}" if one == other else f"infer{one} against infer{other}"


def compare_runs(a: RunDirectory, b: RunDirectory, nfe: Sequence[int] | None = None) -> list[Duel]:
    """A against B for each NFE; p-values are corrected over all comparisons.

    Args:
      nfe: one number for both, or one of A and one of B; None for each number that both were evaluated with.

    Raises:
      UserError: no such evaluation, episodes that are damaged, or starts that are not the same.
    """
    duels = [_compare(*pair) for pair in _pairs(a, b, nfe)]
    every = [found for duel in duels for found in duel.compared]
    corrected = iter(holm([found.contrast.p if found.contrast else None for found in every]))
    return [
        replace(duel, compared=tuple(replace(found, p_holm=next(corrected)) for found in duel.compared))
        for duel in duels
    ]


def verdict(duel: Duel) -> str:
    """A sentence for each measure."""
    sentences = [_sentence(found) for found in duel.compared]
    return f"{duel.label}, {len(duel.ours.episodes)} pairs. " + " ".join(sentences)


def table_of(duels: Sequence[Duel]) -> Table:
    """Both and their difference, with p-values and the smallest detectable difference."""
    cells = []
    for duel in duels:
        both = [dict(zip(COLUMNS[3:], ours(Result([e])), strict=True)) for e in (duel.ours, duel.theirs)]
        for found in duel.compared:
            measure = found.measure
            values = (cells_of[measure.column] for cells_of in both)
            values = (cell if cell == NOTHING else f"{cell}{measure.value_unit}" for cell in values)
            cells.append((duel.label, measure.title, *values, *_difference(found)))
    columns = ("nfe", "Measure", *NAMES, "A against B", "p (uncorrected)", "p (Holm)", "Test", "Detectable")
    return Table("Two runs, start by start", columns, tuple(cells), _notes(duels[0]))


def _compare(one: Evaluated, other: Evaluated) -> Duel:
    reason = refusal([one], [other])
    if reason:
        raise UserError(f"The episodes cannot be paired: {reason}. Evaluate both with the same protocol.")
    timed = refusal([one], [other], times=True)
    compared = []
    for measure in MEASURES:
        is_refused = measure.contrast is speedup and timed
        contrast = None if is_refused else measure.contrast(Pairs([one], [other]))
        compared.append(ComparedMeasure(measure, contrast, refused=timed if is_refused else None))
    return Duel(one, other, tuple(compared))


def _pairs(a: RunDirectory, b: RunDirectory, nfe: Sequence[int] | None) -> list[tuple[Evaluated, Evaluated]]:
    if a.path.resolve() == b.path.resolve():
        raise UserError(f"{a.path} is given twice: name two different runs.")
    known = [{evaluation.nfe: evaluation for evaluation in rows(run)} for run in (a, b)]
    numbers = [(number, number) for number in known[0] if number in known[1]]
    if nfe is not None:
        numbers = [(nfe[0], nfe[-1])]
    for run, found, wanted in zip((a, b), known, zip(*numbers, strict=True), strict=False):
        for number in wanted:
            if number not in found:
                raise UserError(f"{run.path} was evaluated with nfe {_listed(found)}, not with {number}.")
    if not numbers:
        raise UserError(
            f"{a.path} was evaluated with nfe {_listed(known[0])} and {b.path} with {_listed(known[1])}: no NFE is "
            "common to both; name one of each, such as nfe=[1,100]."
        )
    return [(read_evaluated(known[0][one]), read_evaluated(known[1][other])) for one, other in numbers]


def _listed(numbers: dict) -> str:
    return ", ".join(map(str, numbers))


def _difference(found: ComparedMeasure) -> tuple[str, ...]:
    if found.contrast is None or found.contrast.result.value is None:
        return (REFUSED if found.refused else NOTHING, NOTHING, NOTHING, NOTHING, NOTHING)
    measure, contrast = found.measure, found.contrast
    detectable = contrast.detectable
    return (
        _amount(found),
        p_value(contrast.p),
        p_value(found.p_holm),
        contrast.test,
        NOTHING if detectable is None else f"{measure.scale * detectable:.{measure.digits}f}{measure.unit}",
    )


def _amount(found: ComparedMeasure) -> str:
    measure, result = found.measure, found.contrast.result.scaled(found.measure.scale)
    if measure.neutral:
        return with_interval(result, measure.digits, measure.unit)
    form = f"+.{measure.digits}f"
    bounds = TOO_FEW if result.low is None else f"[{result.low:{form}}, {result.high:{form}}]"
    return f"{result.value:{form}} {bounds}{measure.unit}"


def _sentence(found: ComparedMeasure) -> str:
    measure = found.measure
    if found.refused:
        return f"{measure.title}: not compared, because {found.refused}."
    result = found.contrast.result
    if result.value is None:
        return f"{measure.title}: not measured."
    p = f"Holm-corrected p = {p_value(found.p_holm)}".replace("= <", "< ")
    if not found.is_shown:
        detectable = found.contrast.detectable
        limit = ""
        if detectable is not None:
            size = f"{measure.scale * detectable:.{measure.digits}f}{measure.unit}"
            limit = f"; {size} would have been found with probability {POWER}"
        return f"{measure.title}: no difference shown ({_amount(found)}, {p}{limit})."
    words = measure.more if result.value > measure.neutral else measure.less
    return f"{measure.title}: A {words} B ({_amount(found)}, {p})."


def _notes(duel: Duel) -> tuple[str, ...]:
    described = []
    for name, found in zip(NAMES, (duel.ours, duel.theirs), strict=True):
        summary, evaluation = found.evaluation.summary, found.evaluation
        described.append(
            f"{name}: {evaluation.run}, weights of step {summary['checkpoint_step']}; {machine(summary)}."
        )
    protocol, seeds = duel.ours.evaluation.summary["protocol"], duel.ours.evaluation.seeds
    task = f"{protocol['task']} ({protocol['variant']}), seeds {seeds[0]} to {seeds[-1]}"
    noise_seed = protocol.get("noise_seed", 0)
    return (
        *described,
        f"{task}, noise seed {noise_seed}. In brackets: 95% intervals. Differences are A minus B, speed is "
        "B's time over A's. p is two-sided, for one comparison alone and after Holm's correction over the whole table. "
        "Detectable: the smallest difference "
        f"in favour of A that so many pairs would have shown with probability {POWER} at p = {ALPHA}.",
    )
