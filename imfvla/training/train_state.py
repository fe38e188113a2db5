"""The state of a training, to resume from bit for bit: one file of tensors, with details in its header."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NotRequired, TypedDict

import torch
from torch import nn
from torch.optim import Optimizer

from imfvla.errors import UserError
from imfvla.options import Number, Plain, at_most, one_of, within
from imfvla.storage.documents import parse_json
from imfvla.storage.files import delete_leftovers, write_atomically
from imfvla.storage.records import Code, Duration, Step, as_record
from imfvla.training.compiling import MODES
from imfvla.training.precision import PRECISIONS
from imfvla.training.sharding import fill, gathered
from imfvla.training.tensor_files import num_bytes, read_tensors, refuse_misfits, write_tensors

STATE_FORMAT = "imfvla-state-1"
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
    compiling: NotRequired[Annotated[str, one_of(*MODES)] | None]  # None before it is decided
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
    refuse_misfits(path, wanted | moments, tensors)
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


def _read_details(path: Path, header: Mapping[str, str]) -> Details:
    """The details that `save_state` got. Raises UserError where they are not what the loop saves."""
    remedy = "restore it, or move it away and train again"
    try:
        details = parse_json(header.get("details", ""))
    except ValueError as error:
        raise UserError(f"{path} has a damaged header ({error}): {remedy}.") from error
    return as_record(details, Details, f"{path}, details", remedy)
