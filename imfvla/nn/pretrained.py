"""Weights that others trained, from a local safetensors file: read once, when a training begins from nothing.

A part with such weights has a method `initialise_from_pretrained`; building it reads no file, so that a checkpoint,
which has the weights, can be used where the file is gone. Pickles are never read: they can run code.
"""

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Protocol, runtime_checkable

import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from imfvla.errors import UserError
from imfvla.storage.opening import ANYWHERE, WEIGHTS, checked

SHOWN = 4  # names of one kind in a message


@runtime_checkable
class Pretrained(Protocol):
    """A part of a policy that can take weights from a file."""

    def initialise_from_pretrained(self) -> None:
        """Takes them, where a file is configured. Raises UserError where it does not fit."""
        ...


def initialise_from_pretrained(model: nn.Module) -> None:
    """Lets every part of `model` take its pretrained weights."""
    for module in model.modules():
        if isinstance(module, Pretrained):
            module.initialise_from_pretrained()


def read_weights(path: str | Path, key: str) -> dict[str, Tensor]:
    """The tensors of a safetensors file on the CPU. Raises UserError, under the config `key`, where it is not one."""
    path = Path(str(path)).expanduser()
    if path.suffix != ".safetensors":
        raise UserError(
            f"{key} must be null or a .safetensors file, found {str(path)!r}: convert a state_dict with "
            f"safetensors.torch.save_file(torch.load({path.name!r}, weights_only=True), "
            f"{path.stem + '.safetensors'!r}); pickles are not read here."
        )
    try:
        return load_file(checked(path, WEIGHTS, home=ANYWHERE))
    except UserError as error:
        raise UserError(f"{key}: {error}") from error
    except FileNotFoundError:
        raise UserError(
            f"{key} names {path}, which is not there: correct the path, or take null to begin with random weights."
        ) from None
    except Exception as error:  # a damaged header can surface as anything, from SafetensorError to KeyError
        raise UserError(
            f"{key} names {path}, which cannot be read as safetensors ({error}): restore the file."
        ) from error


def take_weights(
    parameters: Mapping[str, Tensor], found: Mapping[str, Tensor], ignored: Collection[str], where: str
) -> None:
    """Copies `found` into the `parameters` of the same names; all of them or, at a misfit, none.

    `ignored` names may be found and are not used. Raises UserError, which begins with `where`, that says which names
    are missing, foreign or of another shape.
    """
    faults = []
    if missing := parameters.keys() - found.keys():
        faults.append(f"missing {_listed(missing)}")
    if foreign := found.keys() - parameters.keys() - set(ignored):
        faults.append(f"foreign {_listed(foreign)}")
    misshapen = {
        f"{name} {tuple(found[name].shape)} for {tuple(parameter.shape)}"
        for name, parameter in parameters.items()
        if name in found and found[name].shape != parameter.shape
    }
    if misshapen:
        faults.append(f"ill-shaped {_listed(misshapen)}")
    if faults:
        raise UserError(f"{where}: {'; '.join(faults)}.")
    with torch.no_grad():
        for name, parameter in parameters.items():
            parameter.copy_(found[name])


class Backbone:
    """Mixin of a module most of which can be pretrained and frozen: all parameters but those that begin as `own` says.

    Both parts of a policy, `key` "encoder" and "core", take theirs from one file: the checkpoint of another policy.
    """

    key: str
    own: tuple[str, ...]
    pretrained: str | None
    frozen: bool

    def set_backbone(self, pretrained: str | None, frozen: bool) -> None:
        """Remembers the file and freezes; last in the constructor."""
        if frozen and pretrained is None:
            raise UserError(
                f"{self.key}.frozen=true needs {self.key}.pretrained, found null: name the safetensors file with the "
                f"weights to keep, or train them with {self.key}.frozen=false."
            )
        self.pretrained, self.frozen = pretrained, frozen
        if frozen:
            for parameter in self.backbone().values():
                parameter.requires_grad_(False)

    def train(self, mode: bool = True) -> nn.Module:
        """As of any module; what is frozen stays in eval mode."""
        super().train(mode)
        for name, module in self.named_modules():
            if self.frozen and name and not f"{name}.".startswith(self.own):
                module.training = False
        return self

    def backbone(self) -> dict[str, nn.Parameter]:
        """The pretrained part by name."""
        return {name: p for name, p in self.named_parameters() if not name.startswith(self.own)}

    def initialise_from_pretrained(self) -> None:
        """Takes the backbone from the file, where one is configured."""
        if self.pretrained is None:
            return
        where, prefix = f"{self.key}.pretrained", f"{self.key}."
        read = read_weights(self.pretrained, where)
        found = {name.removeprefix(prefix): x for name, x in read.items() if name.startswith(prefix)}
        mine = {name: x for name, x in found.items() if not name.startswith(self.own)}
        what = f"{where}={self.pretrained} does not fit this {self.key}"
        take_weights(self.backbone(), mine, (), what)


def _listed(names: Collection[str]) -> str:
    shown = ", ".join(sorted(names)[:SHOWN])
    return f"{shown} and {len(names) - SHOWN} more" if len(names) > SHOWN else shown
