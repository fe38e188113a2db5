"""The graphs in a run directory, as `imfvla.export` writes them: found, and compared with the card beside them."""

import hashlib
import importlib.util
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, TypedDict

from imfvla.config.assets import install_command
from imfvla.errors import UserError
from imfvla.options import at_most, one_of
from imfvla.storage.opening import GRAPH, open_to_read
from imfvla.storage.records import FileName, Name, read_record
from imfvla.storage.run_directory import RunDirectory

FOLDER = "onnx"  # of a run directory
FORMAT = "imfvla-onnx-1"
MOST_GRAPHS = 8  # of one number of evaluations
PACKAGES = ("onnx", "onnxscript", "onnxruntime")


class Card(TypedDict):
    """What is read of `infer<n>.json`."""

    format: Annotated[str, one_of(FORMAT)]
    weights: Name  # digest of the policy's
    graphs: Annotated[Mapping[str, FileName], at_most(MOST_GRAPHS)]
    digests: Annotated[Mapping[str, Name], at_most(MOST_GRAPHS)]  # of the graphs' files


def missing_packages() -> list[str]:
    """Those that are not installed of the packages that write and compute graphs."""
    return [name for name in PACKAGES if importlib.util.find_spec(name) is None]


def require_packages() -> None:
    """Raises UserError where such packages are missing."""
    if missing := missing_packages():
        raise UserError(f"runtime=onnx needs {', '.join(missing)}: {install_command('onnx')}.")


def read_graphs(run: RunDirectory, step: int, nfe: int) -> dict[str, bytes]:
    """The graphs by name that compute `nfe` evaluations with the weights of `step`.

    Raises UserError where there are none, or where they belong to other weights or to another card.
    """
    folder = run.path / FOLDER
    path, remedy = folder / f"infer{nfe}.json", f"remove {folder}, and evaluate again to export"
    if not path.exists():
        raise UserError(f"{folder} has no graphs of nfe={nfe}, as {path.name} is missing: {remedy}.")
    card = read_record(path, Card, remedy, home=run.path)
    wanted = run.weights_digest(step)
    if card["weights"] != wanted:
        raise UserError(
            f"{path} was exported from weights {card['weights']}, wanted those of step {step}, {wanted}: {remedy}."
        )
    return {
        name: _read(folder / file, card["digests"].get(name), remedy, run)
        for name, file in card["graphs"].items()
    }


def _read(path: Path, wanted: str | None, remedy: str, run: RunDirectory) -> bytes:
    try:
        with open_to_read(path, GRAPH, home=run.path) as stream:
            graph = stream.read()
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}; {remedy}.") from error
    if (found := digest_of_graph(graph)) != wanted:
        raise UserError(f"{path} has the digest {found}, its card says {wanted}: {remedy}.")
    return graph


def digest_of_graph(graph: bytes) -> str:
    """16 hex digits."""
    return hashlib.sha256(graph).hexdigest()[:16]
