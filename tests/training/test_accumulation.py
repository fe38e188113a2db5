"""Gradients added up over parts of a batch: the steps are those of the whole batch."""

from dataclasses import replace

import pytest
import torch
from tiny_policy import ACTION, OPTIONS, STATE, STEPS, CountedBatches, TinyPolicy
from torch import nn

from imfvla.errors import UserError
from imfvla.generators.base import HighNoiseTimes
from imfvla.generators.ddpm import DenoisingDiffusion
from imfvla.generators.imf import ImprovedMeanFlow
from imfvla.nn.residual import StandardResidual
from imfvla.nn.transformer import TransformerCore
from imfvla.training.clipping import Clipping
from imfvla.training.logger import read_metrics
from imfvla.training.parallel import Alone, Shared
from imfvla.types import Batch

MEAN_FLOW = {
    "parametrisation": "data", "times": HighNoiseTimes(), "boundary_share": 0.3, "v_from": "boundary",
    "instant_weight": 1.0, "compound_target": "sample", "time_power": 2.0, "adaptive_power": 0.5,
    "adaptive_offset": 1e-3, "draws": 4, "compound_draws": 2, "clip": 10.0,
}  # fmt: skip


class Generative(TinyPolicy):
    """A generator on a small core that sees the state alone."""

    def __init__(self, generator) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.core = TransformerCore(
            steps=STEPS, channels=ACTION, width=8, depth=1, heads=2, patch=1, mlp_ratio=2.0, max_rad=10.0,
            residual=StandardResidual,
        )  # fmt: skip
        nn.init.normal_(self.core.output.weight, std=0.3)
        self.encoder, self.generator = nn.Linear(STATE, 8), generator

    def loss(self, batch: Batch, rng: torch.Generator):
        context = self.core.condition(self.encoder(batch.obs.state))
        loss, logs = self.generator.loss(self.core, context, batch.actions, batch.valid, rng)
        return loss.mean(), logs


class DoubleBatches(CountedBatches):
    """Of float64 numbers, with steps that do not count."""

    def batch(self, number: int) -> Batch:
        batch = super().batch(number)
        valid = batch.valid.clone()
        valid[::3, 2:] = False
        seen = replace(batch.obs, state=batch.obs.state.double())
        return Batch(seen, batch.actions.double(), valid)


POLICIES = {
    "dropout": TinyPolicy,
    "imf_plain": lambda: Generative(ImprovedMeanFlow(**MEAN_FLOW)),
    "ddpm": lambda: Generative(
        DenoisingDiffusion(num_levels=100, prediction="sample", clip_sample=True, draws=2, clip=10.0)
    ),
}


@pytest.mark.parametrize("kind", POLICIES)
def test_parts_make_the_steps_of_the_batch(tmp_path, make_trainer, kind):
    """Weights, average, moments and the gradient's scale after steps of the schedule, some of them clipped."""

    def trained(parts: int):
        trainer = make_trainer(
            tmp_path / str(parts), POLICIES[kind]().double(), steps=6, log_every=1, accumulate=parts
        )
        trainer.batches, trainer.clipping = DoubleBatches(), Clipping(1.1, 0.05)
        trainer.train()
        moments = trainer.optimiser.state_dict()["state"]
        return trainer, [*trainer.policy.parameters(), *trainer.ema.policy.parameters()], moments

    whole, expected, moments = trained(1)
    assert any(row["clipped"] for row in read_metrics(whole.run.metrics))
    for parts in (2, 8):
        found, tensors, own = trained(parts)
        assert found.clipping.state() == pytest.approx(whole.clipping.state(), rel=1e-9)
        for ours, theirs in zip(tensors, expected, strict=True):
            torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-12)
        for number, moment in moments.items():
            for key in ("exp_avg", "exp_avg_sq"):
                torch.testing.assert_close(own[number][key], moment[key], rtol=1e-9, atol=1e-14)
        for row, of_whole in zip(
            read_metrics(found.run.metrics), read_metrics(whole.run.metrics), strict=True
        ):
            assert row["loss"] == pytest.approx(of_whole["loss"], rel=1e-9)
            assert row["grad_norm"] == pytest.approx(of_whole["grad_norm"], rel=1e-9)


def test_a_batch_that_has_no_such_parts_is_refused():
    with pytest.raises(UserError, match=r"batch_size must be a multiple of training.accumulate=3, found 8"):
        Alone().check(replace(OPTIONS, accumulate=3))
    with pytest.raises(UserError, match=r"multiple of the 2 processes times training.accumulate=8, found 8"):
        Shared(0, 2, 2).check(replace(OPTIONS, accumulate=8))
    Shared(0, 2, 2).check(replace(OPTIONS, accumulate=4))


def test_parts_of_shares_draw_what_the_batch_draws():
    """Two processes of two parts each have the four quarters, in order."""
    rng = torch.Generator().manual_seed(5)
    whole = torch.randn(8, 3, generator=rng)
    found = []
    for rank in range(2):
        for part in range(2):
            rng = torch.Generator().manual_seed(5)
            with Shared(rank, 2, 2).draws(rng, 2, part, 2):
                found.append(torch.randn(2, 3, generator=rng))
    assert torch.equal(torch.cat(found), whole)
