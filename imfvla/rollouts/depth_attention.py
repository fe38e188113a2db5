"""What each sublayer of a trained core reads of those before it: the weights a_{l,s} of its Attention Residuals.

Shapes: B batch, T tokens, S sources so far, L sublayers.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
from torch import Tensor, nn

from imfvla.environment import Environment
from imfvla.environments.rollout import run_episode
from imfvla.errors import UserError
from imfvla.nn.residual import AttentionResidual, History
from imfvla.rollouts.actor import ChunkActor

ACTIONS, CONTEXT = "actions", "context"  # tokens of the two passes through a core


class DepthWeights:
    """Mean weights over all tokens, evaluations and decisions recorded: one row of sources for each query."""

    def __init__(self, num_queries: int) -> None:
        self._sums: dict[str, list[np.ndarray | None]] = {
            kind: [None] * num_queries for kind in (ACTIONS, CONTEXT)
        }
        self._counts = {kind: np.zeros(num_queries) for kind in (ACTIONS, CONTEXT)}

    def add(self, kind: str, query: int, weights: Tensor) -> None:
        """Weights (B, T, S) of one reading."""
        total = weights.detach().double().flatten(0, 1).sum(0).cpu().numpy()
        known = self._sums[kind][query]
        self._sums[kind][query] = total if known is None else known + total
        self._counts[kind][query] += weights.shape[0] * weights.shape[1]

    def rows(self, kind: str) -> list[list[float]]:
        """Row l has the mean weights of the sources that query l reads; empty where it was not asked."""
        return [
            [] if total is None else np.round(total / count, 6).tolist()
            for total, count in zip(self._sums[kind], self._counts[kind], strict=True)
        ]


def attention_residuals(core: nn.Module) -> list[AttentionResidual]:
    """Those of a core: first of its own blocks, then of those for the average velocity, where it has them apart.

    Raises UserError where the core has no Attention Residuals.
    """
    residual = getattr(core, "residual", None)
    if not isinstance(residual, AttentionResidual):
        raise UserError(
            f"the core's residual must be Attention Residuals, found {type(residual).__name__}: choose a run "
            "trained with core=attnres or core=block_attnres."
        )
    return [residual, *([core.average.residual] if getattr(core, "average", None) else [])]


@contextmanager
def record_depth_weights(core: nn.Module) -> Iterator[DepthWeights]:
    """Inside, every pass through `core` adds its weights to what is yielded; what it computes stays as it is.

    The action tokens are those of the blocks that sample: a core may have others for the instantaneous velocity, which
    hold the context. Raises UserError where the core has no Attention Residuals.
    """
    residuals = attention_residuals(core)
    recorded = DepthWeights(len(residuals[0].query))
    in_forward = False

    def enter(*_: Any) -> None:
        nonlocal in_forward
        in_forward = True

    def leave(*_: Any) -> None:
        nonlocal in_forward
        in_forward = False

    def begin_recorded(begin: Callable[[Tensor], History], embedding: Tensor) -> History:
        history = begin(embedding)
        kind = ACTIONS if in_forward else CONTEXT
        aggregate, weights = history.aggregate, history.weights

        def weights_recorded(query: int) -> Tensor:
            found = weights(query)
            recorded.add(kind, query, found)
            return found

        def aggregate_recorded(query: int) -> Tensor:
            if len(history.sources) == 1:  # read as it is, without weights
                recorded.add(kind, query, embedding.new_ones(*embedding.shape[:2], 1))
            return aggregate(query)

        history.weights, history.aggregate = weights_recorded, aggregate_recorded
        return history

    hooks = [core.register_forward_pre_hook(enter), core.register_forward_hook(leave)]
    for residual in residuals:
        residual.begin = partial(begin_recorded, residual.begin)
    try:
        yield recorded
    finally:
        for residual in residuals:
            del residual.begin  # the class's again
        for hook in hooks:
            hook.remove()


def measure_depth_attention(
    env: Environment, policy: Any, *, seed: int, nfe: int, max_steps: int | None = None
) -> dict[str, Any]:
    """Plays one episode and returns its weights: lists of rows under "actions" and "context", and how it was played."""
    actor = ChunkActor(policy, policy.horizon, nfe, noise_seed=0)
    with record_depth_weights(policy.core) as recorded:
        result = run_episode(
            env, actor, seed, [], kind="rollout", config={}, metadata={}, max_steps=max_steps
        )
    return {
        "seed": seed,
        "nfe": nfe,
        "num_decisions": len(result.inference_ms),
        "total_reward": result.total_reward,
        ACTIONS: recorded.rows(ACTIONS),
        CONTEXT: recorded.rows(CONTEXT),
    }
