from dataclasses import replace
from typing import Any

import pytest
from tiny_policy import OPTIM, OPTIONS, CountedBatches, TinyPolicy
from torch import nn

from imfvla.storage.run_directory import RunDirectory
from imfvla.training.loop import Trainer


@pytest.fixture
def make_trainer():
    """make_trainer(path, policy=TinyPolicy(), **changed training options) -> Trainer."""

    def make(path: Any, policy: nn.Module | None = None, **changes: Any) -> Trainer:
        options = replace(OPTIONS, **changes)
        return Trainer(
            policy or TinyPolicy(),
            CountedBatches(),
            RunDirectory(path),
            options,
            OPTIM,
            seed=7,
            description={},
        )

    return make
