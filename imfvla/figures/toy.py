"""Samples of eight Gaussians, one panel a generator."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from imfvla.figures.style import BLUE, GREY, VERMILION, WIDTH, new_figure, style

LIMIT = 2.4
COLUMNS = 3


def toy_figure(data: np.ndarray, cases: Sequence[tuple[str, str, bool, np.ndarray]]) -> Figure:
    """Data (N, 2) and, for each case, a title, its numbers, whether it passes and samples (N, 2)."""
    shown = [("data", f"{len(data)} samples", None, data), *cases]
    rows = -(-len(shown) // COLUMNS)
    with style():
        figure = new_figure(WIDTH, 3.2 * rows)
        panels = figure.subplots(rows, COLUMNS, sharex=True, sharey=True, squeeze=False).flat
        for axes in panels[len(shown) :]:
            axes.set_axis_off()
        for axes, (title, figures, passes, samples) in zip(panels, shown, strict=False):
            color = GREY if passes is None else BLUE if passes else VERMILION
            axes.plot(*samples.T, ".", color=color, markersize=1.6, alpha=0.35, rasterized=True)
            axes.set(xlim=(-LIMIT, LIMIT), ylim=(-LIMIT, LIMIT), aspect="equal", xlabel=figures)
            axes.set_title(title)
            axes.set(xticks=[-2, 0, 2], yticks=[-2, 0, 2])
            axes.tick_params(labelbottom=True, labelleft=True)
    return figure
