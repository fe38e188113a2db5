"""Data sets inside an HDF5 file that others wrote: only what lies in this file, of numbers or pictures, and bounded."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from imfvla.errors import UserError, unreadable
from imfvla.recording.mcap_file import MAX_EPISODE_BYTES
from imfvla.recording.pictures import decode, size_of
from imfvla.sources.checks import MAX_STEPS, bounded_pictures, misfit, missing_extra, numbers, shortened
from imfvla.storage.opening import ANYWHERE, DATA, checked

try:
    import h5py
except ImportError as error:
    raise missing_extra("hdf5", error) from error

BLOCK = 64  # steps of pictures in memory besides the result
MAX_CHUNK_BYTES = 2**30  # of one unpacked chunk, which the library keeps in memory whole
CHOOSE = "correct the layout or the keys in the options"


@contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
    """The file, for reading. Raises UserError where it is missing or no whole HDF5 file."""
    try:
        with h5py.File(checked(path, DATA, home=ANYWHERE), "r", locking="best-effort") as file:
            yield file
    except UserError:
        raise
    except FileNotFoundError as error:
        raise UserError(f"{path} is missing: wanted an HDF5 file there; correct the path.") from error
    except PermissionError as error:
        raise unreadable(path, error) from error
    except (OSError, ValueError, KeyError, RuntimeError, TypeError) as error:
        reason = shortened(" ".join(str(error).split()))
        if "filter" in reason or "plugin" in reason:
            raise UserError(
                f"{path} has a compression that is not supported ({reason}): rewrite it with gzip or without."
            ) from error
        raise UserError(
            f"{path} must be a whole HDF5 file, found otherwise ({reason}); copy it again."
        ) from error


def group(parent: h5py.Group, key: str, path: Path) -> h5py.Group:
    """A group below `parent`. Raises UserError where there is none in this file."""
    found = _member(parent, key, path)
    if not isinstance(found, h5py.Group):
        raise misfit(path, _name(parent, key), "a group", "a data set", CHOOSE)
    return found


def dataset(parent: h5py.Group, key: str, path: Path) -> h5py.Dataset:
    """A data set below `parent`. Raises UserError where there is none whose values lie in this file."""
    found = _member(parent, key, path)
    if not isinstance(found, h5py.Dataset):
        raise misfit(path, _name(parent, key), "a data set", f"a group of {_known(found)}", CHOOSE)
    if found.external or found.is_virtual:
        raise misfit(
            path, _name(parent, key), "stored in this file (others are not supported)", "values in other files",
            "rewrite it with its values inside",
        )  # fmt: skip
    if found.chunks and np.prod(found.chunks, dtype=float) * found.dtype.itemsize > MAX_CHUNK_BYTES:
        wanted = f"in chunks of at most {MAX_CHUNK_BYTES} bytes"
        raise misfit(path, _name(parent, key), wanted, found.chunks, "rewrite it in smaller chunks")
    if found.ndim and found.shape[0] > MAX_STEPS:
        raise misfit(
            path, _name(parent, key), f"at most {MAX_STEPS} steps", found.shape[0], "split the episode"
        )
    return found


def _member(parent: h5py.Group, key: str, path: Path) -> h5py.Group | h5py.Dataset:
    found = parent
    for part in key.strip("/").split("/"):
        link = found.get(part, getlink=True) if isinstance(found, h5py.Group) else None
        if link is None or part in ("", ".", ".."):
            raise misfit(path, found.name, f"a group with {part}", _known(found), CHOOSE)
        if not isinstance(link, h5py.HardLink):  # to another file, or to what may lead there
            raise misfit(
                path, _name(parent, key), "stored in this file (links are not supported)", "a link",
                "rewrite it with its values inside",
            )  # fmt: skip
        found = found[part]
    return found


def _known(found: h5py.Group | h5py.Dataset) -> str:
    return shortened(", ".join(found) or "nothing") if isinstance(found, h5py.Group) else "a data set"


def _name(parent: h5py.Group, key: str) -> str:
    return f"{parent.name.rstrip('/')}/{key}"


def numbers_shape(data: h5py.Dataset, names: Sequence[str], path: Path) -> tuple[int, int]:
    """(T, channels), without reading a value. Raises UserError where the shape or type is another."""
    if data.dtype.kind not in "fiub":
        raise misfit(path, data.name, "numbers (objects are not supported)", str(data.dtype), CHOOSE)
    shape = data.shape if data.ndim != 1 else (*data.shape, 1)
    if len(shape) != 2 or shape[1] != len(names) or not shape[0]:
        raise misfit(
            path, data.name, f"of shape (steps, {len(names)}), one for each channel of the options", data.shape,
            "correct the channels in the options",
        )  # fmt: skip
    if data.size * data.dtype.itemsize > MAX_EPISODE_BYTES:
        raise misfit(path, data.name, f"at most {MAX_EPISODE_BYTES} bytes", data.shape, "split the episode")
    return shape


def read_numbers(data: h5py.Dataset, names: Sequence[str], path: Path) -> np.ndarray:
    """float32 (T, channels). Raises UserError where the shape or type is another, and on NaN."""
    shape = numbers_shape(data, names, path)
    return numbers(data[()].reshape(shape), len(names), path, data.name, names)


def is_pictures(data: h5py.Dataset) -> bool:
    """Whether it can be the pictures of a camera: uint8 (T, H, W, 3), or an encoded picture for each step."""
    return (data.ndim == 4 and data.dtype == np.uint8 and data.shape[3] == 3) or _is_encoded(data)


def _is_encoded(data: h5py.Dataset) -> bool:
    is_bytes = data.dtype.kind == "S" or h5py.check_vlen_dtype(data.dtype) == np.uint8
    is_bytes = is_bytes or h5py.check_string_dtype(data.dtype) is not None
    return (data.ndim == 2 and data.dtype == np.uint8) or (data.ndim == 1 and is_bytes)


def picture_size(data: h5py.Dataset, path: Path) -> tuple[int, int]:
    """(H, W) of the first picture. Raises UserError where these are no pictures."""
    if not is_pictures(data) or not data.shape[0]:
        raise misfit(
            path, data.name, "uint8 (steps, height, width, 3), or an encoded picture for each step",
            f"{data.dtype} of shape {data.shape}", "correct the cameras in the options",
        )  # fmt: skip
    if not _is_encoded(data):
        return data.shape[1], data.shape[2]
    try:
        return size_of(_bytes(data[0]))
    except ValueError as error:
        raise _bad(data, 0, str(error), path) from error


def read_pictures(
    data: h5py.Dataset, every: int, size: tuple[int, int], swap: bool, path: Path
) -> np.ndarray:
    """Every `every`-th picture: uint8 (K, H, W, 3). `swap` exchanges red and blue."""
    if (found := picture_size(data, path)) != size:
        wanted = f"{size[0]} x {size[1]}, as in the first episode"
        raise misfit(path, data.name, wanted, f"{found[0]} x {found[1]}", "leave this episode out")
    steps = range(0, len(data), every)
    bounded_pictures(len(steps), *size, path, data.name)
    frames = np.empty((len(steps), *size, 3), np.uint8)
    block = max(1, BLOCK // every) * every
    for start in range(0, len(data), block):
        rows = data[start : start + block : every]
        place = start // every
        if not _is_encoded(data):
            frames[place : place + len(rows)] = rows
            continue
        for number, row in enumerate(rows):
            try:
                if size_of(_bytes(row)) != size:
                    raise ValueError(f"a picture of {size_of(_bytes(row))}")
                frames[place + number] = decode(_bytes(row))
            except ValueError as error:
                raise _bad(data, start + number * every, str(error), path) from error
    return np.ascontiguousarray(frames[..., ::-1]) if swap else frames


def _bytes(row: np.ndarray | bytes | str) -> bytes:
    if isinstance(row, str):
        raise ValueError("a text")
    return bytes(row)


def _bad(data: h5py.Dataset, step: int, found: str, path: Path) -> UserError:
    return misfit(
        path, f"{data.name} at step {step}", "a PNG or JPEG of one size", found, "copy the file again"
    )
