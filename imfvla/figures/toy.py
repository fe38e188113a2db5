"""Samples of eight Gaussians, one panel a generator."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from imfvla.figures.style import BLUE, GREY, VERMILION, new_figure, style

LIMIT = 2.4


def toy_figure(data: np.ndarray, cases: Sequence[tuple[str, str, bool, np.ndarray]]) -> Figure:
    """Data (N, 2) and, of each case, a title, its figures, whether it passes and samples (N, 2)."""
    with style():
        figure = new_figure(2.1 * (1 + len(cases)), 2.75)
        panels = figure.subplots(1, 1 + len(cases), sharex=True, sharey=True)
        shown = [("data", f"{len(data)} samples", None, data), *cases]
        for axes, (title, figures, passes, samples) in zip(panels, shown, strict=True):
            color = GREY if passes is None else BLUE if passes else VERMILION
            axes.plot(*samples.T, ".", color=color, markersize=1.2, alpha=0.35, rasterized=True)
            axes.set(xlim=(-LIMIT, LIMIT), ylim=(-LIMIT, LIMIT), aspect="equal", xlabel=figures)
            axes.set_title(title)
            axes.set(xticks=[-2, 0, 2], yticks=[-2, 0, 2])
    return figure
