"""Checkpoints as safetensors and JSON, never pickle: a state to resume from bit for bit, and weights to use.

Loading is strict: a missing, foreign or misshapen tensor is an error that names it.
"""

import errno
import json
import os
import re
import shutil
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.optim import Optimizer

from imfvla.errors import UserError, unreadable
from imfvla.policy import Policy, build_policy
from imfvla.robot import RobotSpec
from imfvla.robot_of import KEY
from imfvla.sources.same_robot import refuse_other_robot
from imfvla.storage.documents import parse_json, read_json
from imfvla.storage.files import PARTIAL, clear_write_errors, sync, write_atomically, write_json
from imfvla.storage.run_directory import RunDirectory
from imfvla.training.sharding import fill, gathered

STATE_FORMAT = "imfvla-state-1"
WEIGHTS_FORMAT = "imfvla-policy-1"
MOMENTS = ("step", "exp_avg", "exp_avg_sq")  # what AdamW keeps of a parameter
# What the loop resumes from besides the tensors, with types.
DETAILS = {
    "step": (int,),
    "train_s": (int, float),
    "precision": (str,),
    "gradient_scale": (float, type(None)),  # None where every step so far was left out
    "batches": (dict,),
    "logger": (dict,),
}


@dataclass(frozen=True, slots=True)
class TrainState:
    """All that the next step depends on: learning rate and random numbers are functions of the step alone."""

    policy: nn.Module
    averaged: nn.Module  # same structure as `policy`
    optimiser: Optimizer  # AdamW


def save_state(path: Path, state: TrainState, details: Mapping[str, Any], *, writes: bool = True) -> None:
    """Writes one file atomically: tensors, and JSON-able `details` (step, logger sums, ...) in its header.

    Where the state is sharded all processes call this, and one of them `writes`.
    """
    tensors = {f"policy/{name}": tensor for name, tensor in state.policy.state_dict().items()}
    tensors |= {f"averaged/{name}": tensor for name, tensor in state.averaged.state_dict().items()}
    for name, parameter in state.policy.named_parameters():
        kept = state.optimiser.state.get(parameter, {})
        tensors |= {f"adamw/{moment}/{name}": kept[moment] for moment in MOMENTS if moment in kept}
    tensors = gathered(tensors, keep=writes)
    if writes:
        header = {"format": STATE_FORMAT, "details": json.dumps(details)}
        write_atomically(path, lambda temporary: write_tensors(temporary, tensors, header))


def load_state(path: Path, state: TrainState) -> dict[str, Any]:
    """Fills `state` from a file of `save_state` and returns its details; a mismatch changes nothing."""
    tensors, header = read_tensors(path)
    if header.get("format") != STATE_FORMAT:
        raise UserError(
            f"{path} is not a training state: wanted format {STATE_FORMAT}, found {header.get('format')!r}."
        )
    details = _read_details(path, header)
    wanted = {f"policy/{name}": tensor for name, tensor in state.policy.state_dict().items()}
    wanted |= {f"averaged/{name}": tensor for name, tensor in state.averaged.state_dict().items()}
    moments = {
        f"adamw/{moment}/{name}": torch.zeros(()) if moment == "step" else parameter
        for name, parameter in state.policy.named_parameters()
        for moment in MOMENTS
        if f"adamw/{moment}/{name}" in tensors  # a parameter that has had no gradient yet has none
    }
    _refuse_misfits(path, wanted | moments, tensors)
    with torch.no_grad():
        for name, tensor in wanted.items():
            fill(tensor, tensors[name])
        for name, parameter in state.policy.named_parameters():
            names = {moment: f"adamw/{moment}/{name}" for moment in MOMENTS}
            if names["step"] in tensors:
                state.optimiser.state[parameter] = {
                    "step": tensors[names["step"]].to(parameter.device),
                    **{
                        moment: fill(torch.empty_like(parameter), tensors[names[moment]])
                        for moment in MOMENTS[1:]
                    },
                }
    return details


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
            temporary.mkdir(parents=True)
            write_tensors(temporary / "policy.safetensors", tensors, {"format": WEIGHTS_FORMAT})
            sync(temporary / "policy.safetensors")
            write_json(temporary / "policy.json", {"format": WEIGHTS_FORMAT, **description})
            shutil.rmtree(directory, ignore_errors=True)
            temporary.rename(directory)
            sync(directory.parent)
        except BaseException:
            with suppress(OSError):
                shutil.rmtree(temporary, ignore_errors=True)
            raise


def load_weights(policy: nn.Module, path: Path) -> None:
    """Fills `policy` from `policy.safetensors`. Raises UserError naming tensors that do not fit, and how."""
    tensors, _ = read_tensors(path)
    wanted = policy.state_dict()
    _refuse_misfits(path, wanted, tensors)
    with torch.no_grad():
        for name, tensor in wanted.items():
            tensor.copy_(tensors[name])


def load_policy(run: RunDirectory, step: int | str = "last") -> Policy:
    """The averaged policy of a run, ready to predict: statistics included, in eval mode, no gradients.

    Raises UserError where the weights do not fit the run's config, or were trained for another robot.
    """
    step = run.weights_step(step)
    policy = build_policy(run.config(), statistics=None)
    if policy.has_stages:
        policy.begin_step(step - 1, run.training_steps())  # the last one that these weights have learned from
    path = run.policy_weights(step)
    _refuse_other_robot(policy, path)
    load_weights(policy, path)
    return policy.eval().requires_grad_(False)


def _refuse_other_robot(policy: Policy, path: Path) -> None:
    """Raises UserError where the description beside the weights states another robot than the policy's."""
    beside = path.with_suffix(".json")
    stated = read_json(beside, "restore it", mapping=True).get(KEY) if beside.exists() else None
    if stated is not None:  # else they are older than the key, and the config decides
        refuse_other_robot(
            RobotSpec.from_json(stated, f"{beside}: {KEY}"),
            policy.robot,
            policy.views,
            of=f"the weights {path}",
            where="The run's config.yaml",
            remedy="Restore the config that the weights were trained with.",
        )


def write_tensors(path: Path, tensors: Mapping[str, Tensor], header: Mapping[str, str]) -> None:
    """One safetensors file. Raises OSError where it cannot be written."""
    on_cpu = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    try:
        save_file(on_cpu, path, metadata=dict(header))
    except SafetensorError as error:  # it wraps the system's error, whose number appears only in the text
        number = re.search(r"os error (\d+)", str(error))
        if number is None:
            raise OSError(None, str(error)) from error
        raise OSError(int(number[1]), os.strerror(int(number[1]))) from error


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors and header of a safetensors file. Raises UserError where it is missing, cut off or broken."""
    try:
        with safe_open(path, framework="pt") as file:
            return {name: file.get_tensor(name) for name in file.keys()}, file.metadata() or {}  # noqa: SIM118
    except FileNotFoundError:
        raise UserError(f"{path} is missing: the run has no such checkpoint.") from None
    except PermissionError as error:
        raise unreadable(path, error) from error
    except OSError as error:
        if error.errno in (errno.EMFILE, errno.ENFILE):
            raise  # the machine's fault, not the file's
        raise _damaged(path, error) from error
    except Exception as error:  # a damaged header can raise anything from SafetensorError to KeyError
        raise _damaged(path, error) from error


def _damaged(path: Path, error: Exception) -> UserError:
    return UserError(f"{path} is cut off or damaged ({error}): restore it, or move it away and train again.")


def _read_details(path: Path, header: Mapping[str, str]) -> dict[str, Any]:
    """The details that `save_state` got. Raises UserError where they are not what the loop saves."""
    try:
        details = parse_json(header["details"])
        kinds = {key: type(details[key]) for key in DETAILS}
        if any(kinds[key] not in DETAILS[key] for key in DETAILS) or details["step"] < 0:
            raise ValueError(f"wanted {DETAILS}, found {kinds}")
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(
            f"{path} has a damaged header ({error!r}): restore it, or move it away and train again."
        ) from error
    return details


def _refuse_misfits(path: Path, wanted: Mapping[str, Tensor], found: Mapping[str, Tensor]) -> None:
    faults = []
    if missing := sorted(wanted.keys() - found.keys()):
        faults.append(f"missing {_listed(missing)}")
    if foreign := sorted(found.keys() - wanted.keys()):
        faults.append(f"foreign {_listed(foreign)}")
    for name in sorted(wanted.keys() & found.keys()):
        shape, other = tuple(wanted[name].shape), tuple(found[name].shape)
        if shape != other:
            faults.append(f"{name} has shape {other}, wanted {shape}")
        elif wanted[name].dtype != found[name].dtype:
            faults.append(f"{name} has type {found[name].dtype}, wanted {wanted[name].dtype}")
    if faults:
        shown = faults[:6] + [f"and {len(faults) - 6} more"] * (len(faults) > 6)
        raise UserError(
            f"{path} does not fit the configured policy: {'; '.join(shown)}. Is it another method's?"
        )


def _listed(names: list[str]) -> str:
    text = ", ".join(names[:4])
    return f"{text} and {len(names) - 4} more" if len(names) > 4 else text
