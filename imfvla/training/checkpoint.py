"""Checkpoints as safetensors and JSON, never pickle: a state to resume from bit for bit, and weights to use.

Loading is strict: a missing, foreign or misshapen tensor is an error that names it.
"""

import errno
import json
import os
import re
import shutil
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NotRequired, TypedDict

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.optim import Optimizer

from imfvla.errors import UserError, unreadable
from imfvla.options import Number, Plain, at_most, one_of, within
from imfvla.policy import Policy, build_policy
from imfvla.robot import RobotSpec
from imfvla.robot_of import KEY
from imfvla.sources.same_robot import refuse_other_robot
from imfvla.storage.documents import parse_json, read_json
from imfvla.storage.files import (
    PARTIAL,
    SCRATCH,
    clear_write_errors,
    delete_leftovers,
    make_folder,
    put_folder,
    write_atomically,
    write_json,
)
from imfvla.storage.opening import WEIGHTS, Kind, checked
from imfvla.storage.records import Code, Duration, Step, as_record
from imfvla.storage.run_directory import RunDirectory
from imfvla.storage.trained_config import refuse_changed_config
from imfvla.training.precision import PRECISIONS
from imfvla.training.sharding import fill, gathered

STATE_FORMAT = "imfvla-state-1"
WEIGHTS_FORMAT = "imfvla-policy-1"
MAX_HEADER_BYTES = 16 * 2**20  # of a safetensors file: names, shapes and details
MOMENTS = ("step", "exp_avg", "exp_avg_sq")  # what AdamW keeps of a parameter


class LoggerState(TypedDict):
    """What the logger has added up since its last line: sums of scalars, and of how many steps."""

    sums: Annotated[Mapping[str, Number], at_most(1000)]
    count: NotRequired[Step]
    skipped: NotRequired[Step]


class EarlierCode(TypedDict):
    """Code that a training ran with before the present one."""

    until_step: Step
    code: Code


class Details(TypedDict):
    """What the loop resumes from besides the tensors."""

    step: Step
    train_s: Duration
    precision: Annotated[str, one_of(*PRECISIONS)]
    # Of the gradients; None where every step so far was left out.
    gradient_scale: Annotated[float, within(0, 1e300)] | None
    batches: Mapping[str, Plain]  # checked by those who load it
    logger: LoggerState
    code: NotRequired[Code]
    earlier_code: NotRequired[Annotated[list[EarlierCode], at_most(1000)]]
    config: NotRequired[Mapping[str, Plain] | None]


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
        delete_leftovers(path)
        write_atomically(path, lambda temporary: write_tensors(temporary, tensors, header))


def load_state(path: Path, state: TrainState) -> Details:
    """Fills `state` from a file of `save_state` and returns its details; a mismatch changes nothing."""
    most = 2 * num_bytes(state.policy.parameters())  # AdamW's moments
    most += num_bytes(state.policy.state_dict().values()) + num_bytes(state.averaged.state_dict().values())
    tensors, header = read_tensors(path, most)
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
    _refuse_misfits(path, wanted, tensors)
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
        checked(path, _weights_of(num_bytes(policy.state_dict().values())), home=run.path)


def num_bytes(tensors: Iterable[Tensor]) -> int:
    """Of these tensors together."""
    return sum(tensor.numel() * tensor.element_size() for tensor in tensors)


def _weights_of(most: int) -> Kind:
    """Files that hold no more than `most` bytes of tensors beside their header."""
    return Kind("file of the configured policy", most + MAX_HEADER_BYTES)


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


def write_tensors(path: Path, tensors: Mapping[str, Tensor], header: Mapping[str, str]) -> None:
    """One safetensors file. Raises OSError where it cannot be written.

    The library writes a temporary file of a random name first. It lies in a folder of ours, so that what a kill leaves
    is found and deleted.
    """
    on_cpu = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    scratch = path.with_name(path.name + SCRATCH)
    try:
        scratch.mkdir()
        save_file(on_cpu, scratch / path.name, metadata=dict(header))
        os.replace(scratch / path.name, path)
    except SafetensorError as error:  # it wraps the system's error, whose number appears only in the text
        number = re.search(r"os error (\d+)", str(error))
        if number is None:
            raise OSError(None, str(error)) from error
        raise OSError(int(number[1]), os.strerror(int(number[1]))) from error
    finally:
        with suppress(OSError):
            scratch.rmdir()  # works where no file handle is left
        shutil.rmtree(scratch, ignore_errors=True)


def read_tensors(
    path: Path, most: int | None = None, *, home: Path | None = None
) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors and header of a safetensors file in `home`.

    Raises UserError where it is missing, cut off or broken, and, before it is read, where it has more than `most` bytes
    of tensors.
    """
    try:
        real = checked(path, WEIGHTS if most is None else _weights_of(most), home=home)
        with safe_open(real, framework="pt") as file:
            return {name: file.get_tensor(name) for name in file.keys()}, file.metadata() or {}  # noqa: SIM118
    except UserError:
        raise
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


def _read_details(path: Path, header: Mapping[str, str]) -> Details:
    """The details that `save_state` got. Raises UserError where they are not what the loop saves."""
    remedy = "restore it, or move it away and train again"
    try:
        details = parse_json(header.get("details", ""))
    except ValueError as error:
        raise UserError(f"{path} has a damaged header ({error}): {remedy}.") from error
    return as_record(details, Details, f"{path}, details", remedy)


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
