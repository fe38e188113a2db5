"""The weights of a policy and their description, safetensors and JSON: written, checked, and loaded to predict."""

import shutil
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
from torch import nn

from imfvla.policy import Policy, build_policy
from imfvla.robot import RobotSpec
from imfvla.robot_of import KEY
from imfvla.sources.same_robot import refuse_other_robot
from imfvla.storage.documents import read_json
from imfvla.storage.files import PARTIAL, clear_write_errors, make_folder, put_folder, write_json
from imfvla.storage.opening import checked
from imfvla.storage.run_directory import RunDirectory
from imfvla.storage.trained_config import refuse_changed_config
from imfvla.training.sharding import gathered
from imfvla.training.tensor_files import (
    kind_of_weights,
    num_bytes,
    read_tensors,
    refuse_misfits,
    write_tensors,
)

WEIGHTS_FORMAT = "imfvla-policy-1"


def save_weights(
    directory: Path, policy: nn.Module, description: Mapping[str, Any], *, writes: bool = True
) -> None:
    """Writes `policy.safetensors` and `policy.json` into `directory`, which appears whole or not at all.

    Where the policy is sharded all processes call this, and one of them `writes`.
    """
    tensors = gathered(policy.state_dict(), keep=writes)
    if not writes:
        return
    temporary = directory.with_name(directory.name + PARTIAL)
    with clear_write_errors(directory):
        try:
            shutil.rmtree(temporary, ignore_errors=True)
            make_folder(directory.parent)
            temporary.mkdir()
            write_tensors(temporary / "policy.safetensors", tensors, {"format": WEIGHTS_FORMAT})
            write_json(temporary / "policy.json", {"format": WEIGHTS_FORMAT, **description})
            put_folder(temporary, directory)
        except BaseException:
            with suppress(OSError):
                shutil.rmtree(temporary, ignore_errors=True)
            raise


def load_weights(policy: nn.Module, path: Path, *, home: Path | None = None) -> None:
    """Fills `policy` from `policy.safetensors`, a file in `home`.

    Raises UserError naming tensors that do not fit, and how, and where the file has more bytes than the policy needs.
    """
    wanted = policy.state_dict()
    tensors, _ = read_tensors(path, num_bytes(wanted.values()), home=home)
    refuse_misfits(path, wanted, tensors)
    with torch.no_grad():
        for name, tensor in wanted.items():
            tensor.copy_(tensors[name])


def load_policy(run: RunDirectory, step: int | str = "last") -> Policy:
    """The averaged policy of a run, ready to predict: statistics included, in eval mode, no gradients.

    Raises UserError where the weights do not fit the run's config, or were trained with another one or for another
    robot.
    """
    step, config = run.weights_step(step), run.config()
    refuse_changed_config(run, config, step)
    policy = build_policy(config, statistics=None)
    if policy.has_stages:
        policy.begin_step(step - 1, run.training_steps())  # the last one that these weights have learned from
    path = run.policy_weights(step)
    _refuse_other_robot(policy, path, run.path)
    load_weights(policy, path, home=run.path)
    return policy.eval().requires_grad_(False)


def check_weights(run: RunDirectory, step: int | str = "last") -> None:
    """Raises UserError where the file of these weights has more bytes than the config's policy needs. Reads none."""
    path = run.policy_weights(step)
    if path.exists():
        policy = build_policy(run.config(), statistics=None)
        checked(path, kind_of_weights(num_bytes(policy.state_dict().values())), home=run.path)


def _refuse_other_robot(policy: Policy, path: Path, home: Path) -> None:
    """Raises UserError where the description beside the weights states another robot than the policy's."""
    beside = path.with_suffix(".json")
    stated = read_json(beside, "restore it", mapping=True, home=home).get(KEY) if beside.exists() else None
    if stated is not None:  # else they are older than the key, and the config decides
        refuse_other_robot(
            RobotSpec.from_json(stated, f"{beside}: {KEY}"),
            policy.robot,
            policy.views,
            of=f"the weights {path}",
            where="The run's config.yaml",
            remedy="Restore the config that the weights were trained with.",
        )
