"""Whether an experiment has nothing left to do, from its files alone. Needs neither torch nor mujoco."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from imfvla.config.protocol import EvaluationOptions
from imfvla.config.views import VIEWS, view_options
from imfvla.errors import UserError
from imfvla.options import build
from imfvla.reporting.offline import read_offline
from imfvla.reporting.runs import evaluations
from imfvla.robot_of import has_environment
from imfvla.storage.run_directory import (
    DONE,
    EXECUTION_KEYS,
    RunDirectory,
    differences,
    plain,
    step_of,
    training_steps,
)

OFFLINE_KEYS = ("noise_seed", "noise_scale", "device")


def is_complete(config: Mapping[str, Any], directory: Path) -> bool:
    """Whether this config's run is done there, with every evaluation that the config asks for.

    False where its files cannot be read: running it then reports why.
    """
    try:
        step = RunDirectory(directory).weights_step(config["evaluation"]["checkpoint"])
        return _has_evaluations(config, directory, step)
    except (UserError, TypeError, KeyError):
        return False


def is_reported(config: Mapping[str, Any], directory: Path) -> bool:
    """The same for a shipped result, which has no weights."""
    try:
        steps = training_steps(config, directory)
        return _has_evaluations(config, directory, step_of(steps, config["evaluation"]["checkpoint"]))
    except (UserError, TypeError, KeyError):
        return False


def _has_evaluations(config: Mapping[str, Any], directory: Path, step: int) -> bool:
    run = RunDirectory(directory)
    if run.status().get("state") != DONE:
        return False
    found = run.config()
    unsaid = (VIEWS,) if view_options(config).views is None else ()  # a run says what its data has
    if differences(found, plain(config), (*EXECUTION_KEYS, *unsaid)):
        return False
    wanted = config["evaluation"]
    if not has_environment(config):
        offline = read_offline(run)
        kept = {key: wanted[key] for key in OFFLINE_KEYS} | {
            "checkpoint_step": step,
            "nfe": list(wanted["nfe"]),
        }
        return offline is not None and kept.items() <= offline["protocol"].items()
    asked = build(EvaluationOptions, wanted, "evaluation").in_protocol()
    done = evaluations(run, found, asked | {"checkpoint_step": step})
    return {*wanted["nfe"]} <= {evaluation.nfe for evaluation in done}
