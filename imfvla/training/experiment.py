"""The config of an experiment as one object, read from `conf/train.yaml` composed. Needs neither torch nor mujoco."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Annotated, Any

from imfvla.config.augmentation import AugmentationOptions
from imfvla.config.horizon import Horizon
from imfvla.config.protocol import MAX_SEED, EvaluationOptions
from imfvla.config.views import ViewOptions
from imfvla.options import build, one_of, part_of, within
from imfvla.robot import FRAMES
from imfvla.storage.records import FileName
from imfvla.training.options import OptimOptions, TrainingOptions


@dataclass(frozen=True, slots=True)
class ExperimentOptions:
    """The keys of train.yaml, without those that say what is built: task, demos, encoder, core and generator."""

    name: FileName  # of its run directory
    seed: Annotated[int, within(0, MAX_SEED)]
    action_frame: Annotated[str, one_of(*FRAMES)]
    horizon: Horizon
    augmentation: AugmentationOptions
    observation: ViewOptions
    training: TrainingOptions
    optim: OptimOptions
    evaluation: EvaluationOptions


def read_experiment(config: Mapping[str, Any]) -> ExperimentOptions:
    """Of a config that was composed. Raises UserError naming the first key that is missing, unknown or wrong."""
    return build(
        ExperimentOptions,
        {field.name: part_of(config, field.name) for field in fields(ExperimentOptions)},
        "",
    )
