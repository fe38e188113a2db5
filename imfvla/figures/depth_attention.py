"""How much the sublayers of trained policies read from earlier ones: heat maps of mean Attention Residual weights."""

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypedDict

import numpy as np
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure

from imfvla.figures.description import TWO_SUBLAYERS, sublayers_of
from imfvla.figures.style import GREY, INK, WIDTH, new_figure, style
from imfvla.options import at_most, require, within
from imfvla.storage.records import FileName, Step, read_record

FILE = "depth_attention.json"  # in a run directory, from tools/depth_attention.py
COLUMNS = 2
TICKS = (0, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1)
MOST_SUBLAYERS = 200  # a line of text for each
BRIGHT = 0.3  # from this weight on, the colour needs dark text
SHORT = {"attention": "attn", "cross-attention": "cross"}


Weights = Annotated[
    list[Annotated[list[Annotated[float, within(0, 1)]], at_most(MOST_SUBLAYERS)]], at_most(MOST_SUBLAYERS)
]


class DepthWeights(TypedDict):
    """What is recorded of a policy: for each sublayer that reads, the weights of those before it."""

    experiment: FileName
    checkpoint_step: Step
    actions: Weights
    context: Weights


def read_depth_attention(run: Path, core: Mapping[str, Any] | None = None) -> dict[str, Any] | None:
    """The record in a run directory, None if there is none; `core` is that of its config.

    Raises UserError for a file that cannot be read.
    """
    path = run / FILE
    if not path.exists():
        return None
    remedy = f"delete it or repeat python tools/depth_attention.py {shlex.quote(str(run))}"
    found = read_record(path, DepthWeights, remedy)
    require(any(found["actions"]), f"{path}: actions", "weights of at least one sublayer", "none")
    return found | {"sublayers": sublayers_of(core) if core else TWO_SUBLAYERS}


def depth_attention(recorded: Sequence[Mapping[str, Any]]) -> Figure:
    """A map for each policy: reading sublayer downwards, source to the right; rows sum to one."""
    with style():
        columns = min(max(len(recorded), 1), COLUMNS)
        rows = -(-max(len(recorded), 1) // columns)
        figure = new_figure(WIDTH, 0.4 + 3.9 * rows)
        if not recorded:
            figure.text(
                0.5, 0.5, f"no run has {FILE}:\npython tools/depth_attention.py RUN", ha="center", color=GREY
            )
            return figure
        axes = figure.subplots(rows, columns, squeeze=False)
        for axis in axes.flat[len(recorded) :]:
            axis.set_axis_off()
        matrices = [_matrix(found["actions"]) for found in recorded]
        for axis, found, weights in zip(axes.flat, recorded, matrices, strict=False):
            image = axis.imshow(weights, cmap="cividis", norm=PowerNorm(0.5, 0, 1), aspect="auto")
            axis.set_title(f"{found['experiment']}, step {found['checkpoint_step']}")
            axis.grid(visible=False)
            axis.set_xlabel("source")
            sublayers = _sublayers(len(weights), found.get("sublayers", TWO_SUBLAYERS))
            sources = ["emb.", *sublayers][: weights.shape[1]]
            if weights.shape[1] < len(weights):  # sums of blocks of sublayers
                sources = ["emb.", *(f"sum {index}" for index in range(1, weights.shape[1]))]
            axis.set_xticks(range(weights.shape[1]), sources, rotation=90, fontsize=7)
            axis.set_yticks(range(len(weights)), sublayers, fontsize=7)
            if weights.size <= 400:
                for (row, column), value in np.ndenumerate(weights):
                    if not np.isnan(value):
                        shown = f"{value:.2f}".removeprefix("0")
                        axis.text(column, row, shown, ha="center", va="center", fontsize=7,
                                  color=INK if value > BRIGHT else "white")  # fmt: skip
        for axis in axes[:, 0]:
            axis.set_ylabel("sublayer that reads")
        bar = figure.colorbar(image, ax=axes, shrink=0.8, aspect=30, label="mean weight over action tokens")
        bar.set_ticks(TICKS, labels=[f"{tick:g}" for tick in TICKS])
    return figure


def _matrix(rows: Sequence[Sequence[float]]) -> np.ndarray:
    """Weights (queries, most sources), nan where a query does not read; queries that were not used are left out."""
    asked = [row for row in rows if row]
    matrix = np.full((len(asked), max(len(row) for row in asked)), np.nan)
    for index, row in enumerate(asked):
        matrix[index, : len(row)] = row
    return matrix


def _sublayers(number: int, of_block: Sequence[str]) -> list[str]:
    """Block and kind of each, such as "1 attn"; an aggregation after the last block is the output's."""
    names = [SHORT.get(name, name) for name in of_block]
    known = [f"{block + 1} {name}" for block in range(number // len(names)) for name in names]
    return [*known, *["output"] * (number - len(known))]
