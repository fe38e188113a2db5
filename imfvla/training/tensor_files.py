"""Files of tensors, safetensors and never pickle: written whole or not at all, read strictly.

A missing, foreign or misshapen tensor is an error that names it.
"""

import errno
import os
import re
import shutil
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from imfvla.errors import UserError, unreadable
from imfvla.storage.files import SCRATCH
from imfvla.storage.opening import WEIGHTS, Kind, checked

MAX_HEADER_BYTES = 16 * 2**20  # of a safetensors file: names, shapes and details


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
        real = checked(path, WEIGHTS if most is None else kind_of_weights(most), home=home)
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


def num_bytes(tensors: Iterable[Tensor]) -> int:
    """Of these tensors together."""
    return sum(tensor.numel() * tensor.element_size() for tensor in tensors)


def kind_of_weights(most: int) -> Kind:
    """Files that hold no more than `most` bytes of tensors beside their header."""
    return Kind("file of the configured policy", most + MAX_HEADER_BYTES)


def refuse_misfits(path: Path, wanted: Mapping[str, Tensor], found: Mapping[str, Tensor]) -> None:
    """Raises UserError naming the tensors of a file that are missing, foreign, or of another shape or type."""
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


def _damaged(path: Path, error: Exception) -> UserError:
    return UserError(f"{path} is cut off or damaged ({error}): restore it, or move it away and train again.")


def _listed(names: list[str]) -> str:
    text = ", ".join(names[:4])
    return f"{text} and {len(names) - 4} more" if len(names) > 4 else text
