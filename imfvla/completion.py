"""Whether an experiment has nothing left to do, from its files alone. Needs neither torch nor mujoco."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from imfvla.errors import UserError
from imfvla.reporting.runs import evaluations
from imfvla.run_directory import DONE, EXECUTION_KEYS, RunDirectory, differences, plain

PROTOCOL_KEYS = (
    "first_seed",
    "episodes",
    "noise_seed",
    "device",
)  # of `evaluation`, as a protocol names them


def is_complete(config: Mapping[str, Any], directory: Path) -> bool:
    """Whether this config's run is done there, with every evaluation that the config asks for.

    False where its files cannot be read: running it then says why.
    """
    run = RunDirectory(directory)
    try:
        if run.status().get("state") != DONE:
            return False
        found = run.config()
        if differences(found, plain(config), EXECUTION_KEYS):
            return False
        wanted = config["evaluation"]
        step = int(run.policy_weights(wanted["checkpoint"]).parent.name.removeprefix("step-"))
        protocol = {key: wanted[key] for key in PROTOCOL_KEYS} | {"checkpoint_step": step, "max_steps": None}
        of_protocol = [
            evaluation
            for evaluation in evaluations(run, found)
            if protocol.items() <= evaluation.summary["protocol"].items()
        ]
        return {*wanted["nfe"]} <= {evaluation.nfe for evaluation in of_protocol}
    except (UserError, TypeError, KeyError):
        return False
