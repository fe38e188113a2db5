"""A loss or gradient that is not finite: which rows of the batch it comes from, and whether to stop or to skip."""

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import nn

from imfvla.errors import UserError
from imfvla.training.parallel import WholeBatchDraws, rows
from imfvla.training.sharding import release, whole
from imfvla.types import Batch

STOP, SKIP = "stop", "skip"
MAX_SKIPPED = 10  # batches in a row: more is no accident of the data
SHOWN = 4
log = logging.getLogger(__name__)


@dataclass(slots=True)
class NonFinite:
    """Counts batches in a row whose loss or gradient was not finite; `wanted` is stop or skip."""

    wanted: str
    in_a_row: int = 0

    @property
    def stops(self) -> bool:
        """Whether the first such batch is to stop the training."""
        return self.wanted == STOP

    def found(self, what: str, value: float, step: int, cause: str, kept: str) -> None:
        """Logs it and returns if the batch is to be skipped. Raises UserError if training is to stop."""
        self.in_a_row += 1
        where = f"at step {step + 1}, batch {step}: the {what} is {value}"
        if self.wanted == SKIP and self.in_a_row <= MAX_SKIPPED:
            log.warning("Skipped %s; it comes from %s.", where, cause)
            return
        advice = "Lower optim.lr or optim.clip_factor, or set training.precision=fp32"
        if self.wanted == STOP:
            advice += ", or training.on_non_finite=skip to skip such batches"
        else:
            advice = f"{self.in_a_row} batches in a row were like that. {advice}"
        raise UserError(f"Training stopped {where}; {kept}. It comes from {cause}. {advice}.")


def name_cause(policy: nn.Module, batch: Batch, seed: int, items: Sequence[str]) -> str:
    """The rows of a batch, as named by `items`, whose own loss or gradient is not finite; all if there is none.

    Each row's loss is recomputed with the random numbers that it had in the batch. Leaves no gradients.
    """
    size = len(batch.actions)
    guilty = [row for row in range(size) if not _is_finite(policy, batch, seed, row, size)]
    policy.zero_grad(set_to_none=True)
    if not guilty:
        return f"no single row, but the weights or all of: {_listed(items)}"
    return _listed([items[row] for row in guilty])


def _is_finite(policy: nn.Module, batch: Batch, seed: int, row: int, size: int) -> bool:
    torch.manual_seed(seed)
    rng = torch.Generator(batch.actions.device).manual_seed(seed)
    policy.zero_grad(set_to_none=True)
    with WholeBatchDraws(rng, 1, row, size), torch.compiler.set_stance("force_eager"):
        loss, _ = policy.loss(rows(batch, slice(row, row + 1)), rng)
    if not math.isfinite(loss.item()):
        release(policy)
        return False
    loss.backward()
    return all(whole(p.grad).isfinite().all() for p in policy.parameters() if p.grad is not None)


def _listed(items: Sequence[str]) -> str:
    more = f" and {len(items) - SHOWN} more" if len(items) > SHOWN else ""
    return "; ".join(items[:SHOWN]) + more
