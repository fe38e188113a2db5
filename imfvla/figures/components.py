"""Figure 2: what the generator learns and how Attention Residuals aggregate, drawn from a composed configuration."""

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from imfvla.figures.description import BLOCK, STANDARD, Method, describe, listing
from imfvla.figures.diagram import Sheet
from imfvla.figures.style import BLUE, GREEN, GREY, ORANGE, PALE, PURPLE, SKY, VERMILION, style

WIDTH, HEIGHT = 128, 72
MAX_SHOWN = 12  # sources of the residual; if there are more, the middle is left out
STEP_COLORS = (VERMILION, BLUE, GREEN, ORANGE, PURPLE)
# For each generator: title, what is regressed on what, and remarks that hold for all its options. One that is not
# listed has its name as title and no equation.
LEARNS = {
    "ImprovedMeanFlow": (
        "Improved Mean Flow: what is learnt",
        r"$V_\theta = u_\theta(z_t, r, t) + (t - r)\;\mathrm{sg}\!\left[\frac{d}{dt}u_\theta\right]"
        r"\;\longrightarrow\; e - x$",
        (
            r"$\frac{d}{dt}u_\theta = \mathrm{jvp}\left(u_\theta,\;(z_t, r, t),\;(v_\theta, 0, 1)\right)$",
            r"with $v_\theta = u_\theta(z_t, t, t)$ of the same network",
        ),
    ),
    "MeanFlow": (
        "Mean Flow: what is learnt",
        r"$u_\theta(z_t, r, t)\;\longrightarrow\;\mathrm{sg}\!\left[v - (t - r)\,\frac{d}{dt}u_\theta\right]$",
        (
            r"$\frac{d}{dt}u_\theta = \mathrm{jvp}\left(u_\theta,\;(z_t, r, t),\;(v, 0, 1)\right)$",
            r"with the conditional velocity $v = e - x$",
        ),
    ),
    "StagedMeanFlow": (
        "Mean Flow in two stages: what is learnt",
        r"first  $v_\theta(z_t, t)\;\longrightarrow\; e - x$,   then  "
        r"$u_\theta(z_t, r, t)\;\longrightarrow\;\mathrm{sg}\left[\overline{v_\theta}\right]$",
        (),
    ),
    "FlowMatching": (
        "Flow matching: what is learnt",
        r"$v_\theta(z_t, t)\;\longrightarrow\; e - x$",
        ("the velocity at one time; no derivative is taken",),
    ),
    "DenoisingDiffusion": (
        "Diffusion: what is learnt",
        r"$f_\theta(z_k, k)\;\longrightarrow\;$",
        (),
    ),
    "Regression": (
        "Regression: what is learnt",
        r"$x_\theta(0)\;\longrightarrow\; x$",
        ("the error of the action itself",),
    ),
    "TwoStepRegression": (
        "Two-step regression: what is learnt",
        r"$x_\theta(0, 1)\;\longrightarrow\; x \;\longleftarrow\; x_\theta(z_s, s)$",
        ("the action from nothing, and from itself with a little noise",),
    ),
    "ImplicitMaximumLikelihood": (
        "IMLE: what is learnt",
        r"$x_\theta(e_m)\;\longrightarrow\; x,\quad m = \mathrm{argmin}_j\,|x_\theta(e_j) - x|$",
        ("of several samples, the one nearest to the action learns it",),
    ),
}
PREDICTIONS = {"epsilon": r"$\;\epsilon$", "sample": r"$\;x$", "v": r"$\;v$"}  # of diffusion


def method_components(config: Mapping[str, Any]) -> Figure:
    """The figure of a config that `conf/train.yaml` composed: generator, its options, NFE, residual, depth."""
    method = describe(config)
    with style():
        sheet = Sheet(WIDTH, HEIGHT)
        _instantaneous(sheet)
        _average(sheet, method)
        _training(sheet, method)
        _residuals(sheet, method)
    return sheet.figure


def _instantaneous(sheet: Sheet) -> None:
    sheet.box(2, 40, 61, 30, title="Flow matching: instantaneous velocity")
    sheet.text(32.5, 62.6, r"$\frac{dz_t}{dt} = v(z_t, t)$", 40, size=10)
    place = _curve(sheet, 8, 46, 49, 14)
    start, end = place(0.92), place(0.92, moved=0.62)
    sheet.arrow(start, end, color=VERMILION, width=1.8, head=12)
    sheet.axes.plot(*start, "o", color=VERMILION, markersize=5)
    target = place(0.3)
    sheet.axes.plot([end[0], target[0]], [end[1], target[1]], color=GREY, linestyle=":", linewidth=1.2)
    sheet.text(
        (end[0] + target[0]) / 2 + 1.0, (end[1] + target[1]) / 2, "error of one long step", size=7, ha="left"
    )


def _average(sheet: Sheet, method: Method) -> None:
    sheet.box(65, 40, 61, 30, title=r"Mean Flow: average velocity over $[r, t]$")
    equation = r"$u(z_t, r, t) = \frac{1}{t-r}\int_r^t v(z_\tau, \tau)\,d\tau = v - (t-r)\,\frac{d}{dt}u$"
    sheet.text(95.5, 62.6, equation, 56, size=10)
    place = _curve(sheet, 71, 46, 49, 14)
    counts = [nfe for nfe in method.nfe if nfe <= len(STEP_COLORS) and nfe not in method.instant_nfe]
    for color, nfe in zip(STEP_COLORS, counts, strict=False):
        times = np.linspace(1, 0, nfe + 1)
        for begin, finish in pairwise(times):
            sheet.arrow(place(begin), place(finish), color=color, width=1.6, head=11)
    for index, (color, nfe) in enumerate(zip(STEP_COLORS, counts, strict=False)):
        sheet.text(104, 58.6 - 2.7 * index, f"infer{nfe}", size=8, color=color, weight="bold", ha="left")
    if method.instant_nfe:
        names = ", ".join(f"infer{nfe}" for nfe in method.instant_nfe)
        sheet.text(104, 58.6 - 2.7 * len(counts), f"{names}: steps of $v$", 21, size=7, ha="left")
    elif not counts:
        sheet.text(104, 58.6, f"infer{method.nfe[0]}: no average is used", size=7, ha="left")


def _curve(sheet: Sheet, x: float, y: float, width: float, height: float) -> Any:
    """Draws a curved way from noise to data; returns the point of a time, `moved` on along the tangent there."""

    def at(t: float | np.ndarray) -> np.ndarray:
        return 0.06 + 0.9 * np.sin(np.pi * (0.5 * t + 0.02)) ** 3

    def place(t: float, moved: float = 0.0) -> tuple[float, float]:
        slope = (at(t) - at(t - 1e-4)) / 1e-4
        return x + width * (1 - t + moved), y + height * float(at(t) - moved * slope)

    times = np.linspace(1, 0, 100)
    sheet.axes.plot(
        x + width * (1 - times), y + height * at(times), color=SKY, linewidth=3, solid_capstyle="round"
    )
    sheet.arrow((x - 2, y - 2), (x + width + 3, y - 2), color=GREY, head=8)
    sheet.text(x, y - 3.7, r"noise, $t = 1$", size=7)
    sheet.text(x + width - 1, y - 3.7, r"action, $t = 0$", size=7)
    return place


def _training(sheet: Sheet, method: Method) -> None:
    name = method.generator[:1].upper() + method.generator[1:]
    unknown = (f"{name}: what is learnt", "", ())
    title, equation, remarks = LEARNS.get(method.generator_class, unknown)
    sheet.box(2, 2, 61, 36, title=title, face="#fbeaf3")
    if method.prediction:
        equation += PREDICTIONS.get(method.prediction, method.prediction)
    if equation:
        sheet.text(32.5, 28.5, equation, 58, size=10)
    lines = list(remarks)
    if method.is_staged:
        lines += _stages(method)
    if method.num_levels:
        lines.append(f"at one of {method.num_levels} levels of noise")
    if method.parametrisation == "data":
        lines.append(r"the network gives the clean action $D$;  $u = (z_t - D)\,/\,t$")
    elif method.parametrisation == "velocity":
        lines.append(r"the network gives the velocity itself")
    details = [] if method.times is None else [method.times]
    if method.boundary_share:
        draws = "intervals" if method.is_staged else "draws"
        details.append(f"{method.boundary_share:.0%} of the {draws} span all of [0, 1]")
    if details:
        lines.append(", ".join(details))
    top, each = 23.2, 3.6
    for index, line in enumerate(lines):
        sheet.text(32.5, top - index * each, line, 58, size=8)
    calls = "call" if method.nfe == (1,) else "calls"
    text = f"an action chunk for the robot from {listing(method.nfe)} {calls} of the network"
    sheet.box(6, 3.6, 53, 5, [text], face="white", edge=PURPLE, size=8, rounding=0.8)


def _stages(method: Method) -> list[str]:
    """What the second stage of two learns from, and when."""
    steps = "one Euler step" if method.path_steps == 1 else f"{method.path_steps} Euler steps"
    return [
        rf"$\overline{{v_\theta}}$: mean of $v_\theta$ over {steps} along its own path, from $z_t$ to $r$",
        rf"$u_\theta$ has action blocks of its own, learnt after {method.average_from:.0%} of the training",
    ]


def _residuals(sheet: Sheet, method: Method) -> None:
    attends = method.residual != STANDARD
    title = "Attention Residuals" if attends else "Fixed residual sums"
    title = (
        f"{title}: {method.depth} blocks of {len(method.sublayers)} sublayers, {method.num_sublayers} in all"
    )
    sheet.box(65, 2, 61, 36, title=title, face="#fdf3e1")
    names, faces = _sources(method)
    left, width, y = 69.0, 42.0, 22.5
    each = width / len(names)
    sum_at = (117.5, y + 1.7)
    color = VERMILION if attends else GREY
    for index, (name, face) in enumerate(zip(names, faces, strict=True)):
        x = left + index * each
        sheet.cells(x + 0.1 * each, y, [face], width=0.8 * each, height=3.4)
        sheet.text(x + each / 2, y - 1.6, name, each, size=7)
        thickness = (1.0, 3.2, 1.8, 4.4, 0.8)[index % 5] if attends else 1.2
        target = (sum_at[0] - 2.2, sum_at[1] + 0.4)
        sheet.arrow(
            (x + each / 2, y + 3.4), target, bend=-0.28, width=thickness, head=0, alpha=0.55, color=color
        )
    sheet.axes.plot(*sum_at, "o", markersize=17, markerfacecolor="white", markeredgecolor=color)
    sheet.text(*sum_at, r"$\Sigma$", size=10)
    sheet.arrow((sum_at[0] + 2.0, sum_at[1]), (124.5, sum_at[1]))
    sheet.text(122.4, sum_at[1] + 2.4, "next", size=7)
    if attends:
        read = r"$y_{l+1} = f_{l+1}\left(\sum_{s=0}^{l} a_{l+1,s}\,y_s\right)$"
        weight = r"$a_{l+1,s} = \mathrm{softmax}_s\left(w_{l+1}^{\top}\,\mathrm{RMSNorm}(y_s)\right)$"
        end = "the sum of all increments" if method.readout == "sum" else "one more aggregation"
        note = f"a sketch of weights; queries start at zero, all alike; read out: {end}"
    else:
        read, weight = (
            r"$y_{l+1} = f_{l+1}\left(\sum_{s=0}^{l} y_s\right)$",
            "every earlier increment counts alike",
        )
        note = ""
    sheet.text(95.5, 15.8, read, 56, size=9.5)
    sheet.text(95.5, 10.4, weight, 56, size=9.5)
    if note:
        sheet.text(95.5, 5.6, note, 58, size=7.5)


def _sources(method: Method) -> tuple[list[str], list[str]]:
    """Labels and colours of what the last sublayer reads: the embedding, then increments or sums of blocks of them."""
    if method.residual == BLOCK:
        ends = range(method.block_size, method.num_sublayers + method.block_size, method.block_size)
        first = [end - method.block_size + 1 for end in ends]
        names = [f"$y_{{{a}..{min(b, method.num_sublayers - 1)}}}$" for a, b in zip(first, ends, strict=True)]
        names = [name for name, a in zip(names, first, strict=True) if a < method.num_sublayers]
        return ["$y_0$", *names], [SKY, *[ORANGE] * len(names)]
    shown = min(method.num_sublayers, MAX_SHOWN)
    names = [f"$y_{{{index}}}$" for index in range(shown)]
    faces = [SKY, *(ORANGE if index % 2 else "#f6cf7f" for index in range(1, shown))]
    if shown < method.num_sublayers:
        names[-2:] = [r"$\cdots$", f"$y_{{{method.num_sublayers - 1}}}$"]
        faces[-2] = PALE
    return names, faces
