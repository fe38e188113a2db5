"""What the sublayers of trained policies read of earlier ones: heat maps of mean Attention Residual weights."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from imfvla.documents import MAX_JSON_BYTES, parse_json, read_text
from imfvla.errors import UserError
from imfvla.figures.style import GREY, INK, new_figure, style

FILE = "depth_attention.json"  # in a run directory, from tools/depth_attention.py


def read_depth_attention(run: Path) -> dict[str, Any] | None:
    """What a run directory recorded, None where nothing is. Raises UserError for a file that cannot be read."""
    path = run / FILE
    if not path.exists():
        return None
    remedy = f"delete it or repeat python tools/depth_attention.py {run}"
    try:
        found = parse_json(read_text(path, MAX_JSON_BYTES))
        _matrix(found["actions"])
        found["experiment"], found["checkpoint_step"]
    except (OSError, KeyError, TypeError, ValueError, IndexError) as error:
        raise UserError(f"{path} holds no depth weights: {error!r}; {remedy}.") from error
    return found


def depth_attention(recorded: Sequence[Mapping[str, Any]]) -> Figure:
    """A map for each policy: reading sublayer downwards, source to the right; rows sum to one."""
    with style():
        figure = new_figure(max(4.8 * len(recorded), 4.8), 4.4)
        if not recorded:
            figure.text(
                0.5, 0.5, f"no run has {FILE}:\npython tools/depth_attention.py RUN", ha="center", color=GREY
            )
            return figure
        axes = figure.subplots(1, len(recorded), squeeze=False)[0]
        matrices = [_matrix(found["actions"]) for found in recorded]
        brightest = max(
            np.nanmax(weights[1:], initial=0.1) for weights in matrices
        )  # the first row has one source
        for axis, found, weights in zip(axes, recorded, matrices, strict=True):
            image = axis.imshow(weights, cmap="cividis", vmin=0, vmax=brightest, aspect="auto")
            axis.set_title(f"{found['experiment']}, step {found['checkpoint_step']}")
            axis.grid(visible=False)
            axis.set_xlabel("source")
            sublayers = [_sublayer(index + 1) for index in range(len(weights))]
            sources = ["emb.", *sublayers][: weights.shape[1]]
            if weights.shape[1] < len(weights):  # sums of blocks of sublayers
                sources = ["emb.", *(f"sum {index}" for index in range(1, weights.shape[1]))]
            axis.set_xticks(range(weights.shape[1]), sources, rotation=90, fontsize=7)
            axis.set_yticks(range(len(weights)), sublayers, fontsize=7)
            if weights.size <= 400:
                for (row, column), value in np.ndenumerate(weights):
                    if not np.isnan(value):
                        shown = f"{value:.2f}".removeprefix("0")
                        axis.text(column, row, shown, ha="center", va="center", fontsize=6,
                                  color=INK if value > brightest / 2 else "white")  # fmt: skip
        axes[0].set_ylabel("sublayer that reads")
        figure.colorbar(image, ax=list(axes), shrink=0.8, label="mean weight over action tokens")
    return figure


def _matrix(rows: Sequence[Sequence[float]]) -> np.ndarray:
    """Weights (queries, most sources), nan where a query does not read; queries that were not asked left out."""
    asked = [row for row in rows if row]
    matrix = np.full((len(asked), max(len(row) for row in asked)), np.nan)
    for index, row in enumerate(asked):
        matrix[index, : len(row)] = row
    return matrix


def _sublayer(number: int) -> str:
    return f"{(number + 1) // 2} {'attn' if number % 2 else 'MLP'}"
