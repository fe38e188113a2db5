"""What is found before the first stage of a run."""

import pytest

from imfvla.command.composition import compose
from imfvla.command.rehearsal import rehearse
from imfvla.config.protocol import EvaluationOptions
from imfvla.errors import UserError
from imfvla.generators.staged import StagedMeanFlow

SMALL = ["core.width=16", "core.depth=1", "core.heads=2", "observation.views=[front]", "training.steps=10"]


def evaluation(*nfe):
    return EvaluationOptions(episodes=1, first_seed=0, nfe=nfe)


def test_a_second_stage_that_cannot_compute_is_found_before_the_first_one(monkeypatch):
    config = compose("train", ["generator=imf", *SMALL])
    rehearse(config, evaluation(1, 2))

    def fail(self, core, z, r, t, context):
        raise RuntimeError("shapes of the second stage")

    monkeypatch.setattr(StagedMeanFlow, "path_velocity", fail)
    with pytest.raises(UserError, match=r"cannot compute a loss and a chunk.*shapes of the second stage"):
        rehearse(config, evaluation(1, 2))


def test_a_loss_of_the_last_stage_that_is_not_finite_is_named_with_the_first(monkeypatch):
    monkeypatch.setattr(StagedMeanFlow, "path_velocity", lambda self, core, z, r, t, context: z / 0)
    config = compose("train", ["generator=imf", *SMALL])
    with pytest.raises(UserError, match=r"the first losses and chunk .* must be finite, found \[.+, nan\]"):
        rehearse(config, evaluation(1))
