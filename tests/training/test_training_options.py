from dataclasses import asdict, replace

import pytest
from tiny_policy import OPTIM, OPTIONS

from imfvla.errors import UserError
from imfvla.options import build
from imfvla.training.options import OptimOptions, TrainingOptions


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"steps": 0}, r"training\.steps must be between 1 and 1000000000, found 0"),
        ({"checkpoints": 5}, r"training\.checkpoints must be at most 4"),
        ({"precision": "fp16"}, r"training\.precision must be one of fp32, tf32, bf16, auto, found 'fp16'"),
        ({"device": "tpu"}, r"training\.device"),
        ({"threads": 0}, r"training\.threads must be null or between 1 and 1024"),
        ({"sharding": "half"}, r"training\.sharding must be one of none, full, found 'half'"),
        ({"save_every_s": -1.0}, r"training\.save_every_s"),
    ],
)
def test_training_out_of_range(changes, message):
    with pytest.raises(UserError, match=message):
        build(TrainingOptions, asdict(OPTIONS) | changes, "training")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"lr": 0.0}, r"optim\.lr must be above 0"),
        ({"betas": (0.9, 1.0)}, r"optim\.betas"),
        ({"warmup": 1.5}, r"optim\.warmup must be between 0 and 1"),
        ({"ema_decay": 1.0}, r"optim\.ema_decay"),
    ],
)
def test_optim_out_of_range(changes, message):
    with pytest.raises(UserError, match=message):
        build(OptimOptions, asdict(OPTIM) | changes, "optim")


@pytest.mark.parametrize(("steps", "count"), [(4, 2), (7, 3), (5, 5), (1, 1)])
def test_checkpoints_are_spread_and_end_at_the_end(steps, count):
    kept = sorted(replace(OPTIONS, steps=steps, checkpoints=count).checkpoint_steps())
    assert len(kept) == count
    assert kept[-1] == steps
    assert kept[0] >= 1
