"""Figure 1: the method from observation to executed chunk, drawn from a composed configuration."""

from collections.abc import Mapping
from typing import Any

from matplotlib.figure import Figure

from imfvla.figures.description import ATTENTION, BLOCK, STANDARD, Method, describe, listing
from imfvla.figures.diagram import Sheet
from imfvla.figures.style import BLUE, GREEN, GREY, INK, ORANGE, PALE, PURPLE, SKY, VERMILION, style
from imfvla.reporting.mapping import read_mapping

WIDTH, HEIGHT = 128, 72
FACES = {
    "observation": "#eaf4fb",
    "encoder": "#e6f5ef",
    "core": "#fdf3e1",
    "generator": "#fbeaf3",
    "robot": "#f2f2f2",
}
MAX_BLOCKS, MAX_STEPS = 12, 20  # larger numbers are not drawn one by one


def method_overview(config: Mapping[str, Any]) -> Figure:
    """The figure of a config that `conf/train.yaml` composed: its views, tokens, core, generator and horizon."""
    method = describe(config)
    with style():
        sheet = Sheet(WIDTH, HEIGHT)
        _observation(sheet, method)
        _encoder(sheet, method)
        _core(sheet, method)
        _generator(sheet, method)
        _robot(sheet, method)
    return sheet.figure


def _observation(sheet: Sheet, method: Method) -> None:
    sheet.box(2, 20, 21, 50, title="Observation", face=FACES["observation"])
    steps = "" if method.observed_steps == 1 else f", {method.observed_steps} steps"
    height, width = method.image_size
    room, number = 27.0, len(method.views)
    each = min(room / number, 9.0)
    top = 65.5
    for index, view in enumerate(method.views):
        y = top - (index + 1) * each
        sheet.box(4, y + 0.4, 17, each - 0.8, [view], face="white", edge=SKY, size=7.5, rounding=0.6)
    sheet.text(12.5, top - number * each - 1.4, f"{height} × {width} pixels{steps}", 19, size=7)
    sheet.box(4, 27.5, 17, 5.2, [f"{method.state}, {method.state_dim}"], edge=GREEN, size=7.5, rounding=0.6)
    sheet.box(4, 21.5, 17, 5.2, ["instruction"], edge=PURPLE, size=7.5, rounding=0.6)
    sheet.arrow((23, 45), (27.4, 45))


def _encoder(sheet: Sheet, method: Method) -> None:
    sheet.box(27.5, 20, 23, 50, title="Encoder", face=FACES["encoder"])
    residual = "Attention Residuals" if method.vision_residual == ATTENTION else "fixed residual sums"
    lines = [method.vision]
    if "ResNet" in method.vision:
        lines.append(residual)
    lines.append("all views as one batch")
    sheet.box(29.5, 52, 19, 12.5, lines, edge=SKY, size=7.5, rounding=0.8)
    sheet.box(29.5, 44, 19, 5, ["MLP of the state"], edge=GREEN, size=7.5, rounding=0.6)
    sheet.box(29.5, 37.5, 19, 5, ["hashed words"], edge=PURPLE, size=7.5, rounding=0.6)
    if method.view_tokens is not None:
        step = [SKY] * (len(method.views) * method.view_tokens) + [GREEN]
        colors = step * method.observed_steps + [PURPLE, ORANGE]
        sheet.cells(29.5, 29.5, colors, width=19, height=3.4)
        per_view = "1 token" if method.view_tokens == 1 else f"{method.view_tokens} tokens"
        sheet.text(39, 34.6, f"{len(colors)} context tokens", 20, size=7.5, weight="bold")
        sheet.text(39, 25.2, f"{per_view} per view, state,\nsentence, summary of all", 20, size=7)
    sheet.arrow((50.5, 45), (54.9, 45))


def _core(sheet: Sheet, method: Method) -> None:
    sheet.box(55, 20, 30, 50, title="Policy transformer", face=FACES["core"])
    sheet.text(70, 64.3, f"{method.depth} blocks, width {method.width}, {method.heads} heads", 28, size=7.5)
    sheet.text(70, 61.6, method.core, 28, size=7.5)
    shown = min(method.depth, MAX_BLOCKS)
    bottom, top = 35.0, 58.5
    each = (top - bottom) / shown
    for index in range(shown):
        y = bottom + index * each
        sheet.box(64, y + 0.12 * each, 17, 0.76 * each, edge=ORANGE, rounding=min(0.5, each / 4))
        if each > 3:
            sheet.text(72.5, y + each / 2, ", ".join(method.sublayers), 15, size=6.5)
    middles = [bottom + (index + 0.5) * each for index in range(shown)]
    sources = [bottom - 1.0, *middles]
    if method.residual == STANDARD:
        sheet.arrow((61, sources[0]), (61, top), color=GREY, width=1.6)
        note = "fixed residual sum"
    else:
        for later in range(1, shown + 1):
            for earlier in range(later):
                start, end = (63.8, sources[earlier]), (63.8, sources[later])
                weight = 0.35 if later < shown else 1.0
                color = VERMILION if later == shown else GREY
                sheet.arrow(start, end, color=color, bend=-0.55, width=0.8, head=5.0, alpha=weight)
        blocks = f" over blocks of {method.block_size}" if method.residual == BLOCK else ""
        note = f"AttnRes{blocks}: each sublayer\nweighs what came before"
    sheet.text(70, 31.2, note, 28, size=7, color=INK if method.residual == STANDARD else VERMILION)
    tokens = method.num_action_tokens
    sheet.cells(57.5, 25.4, [BLUE] * tokens, width=25, height=2.6)
    per_token = "1 action each" if method.patch == 1 else f"{method.patch} actions each"
    plural = "token" if tokens == 1 else "tokens"
    sheet.text(70, 22.9, f"{tokens} action {plural}, {per_token}", 28, size=7)
    sheet.arrow((85, 45), (89.4, 45))


def _generator(sheet: Sheet, method: Method) -> None:
    sheet.box(89.5, 20, 36.5, 50, title="Action generator", face=FACES["generator"])
    sheet.text(107.75, 64.3, method.generator, 34, size=8, weight="bold")
    if method.is_improved_mean_flow or method.generator_class == "MeanFlow":
        sheet.text(107.75, 60.4, r"average velocity  $u_\theta(z_t, r, t)$", 34, size=8)
    elif method.is_staged:
        text = r"velocity  $v_\theta(z_t, t)$,  then its average  $u_\theta(z_t, r, t)$"
        sheet.text(107.75, 60.4, text, 34, size=8)
    elif method.generator_class == "FlowMatching":
        sheet.text(107.75, 60.4, r"velocity  $v_\theta(z_t, t)$", 34, size=8)
    left, right = 99.0, 121.5
    rows = method.nfe[:4]
    top, each = (54.0, 8.4) if len(rows) > 1 else (47.0, 0.0)
    if method.generator_class not in ("Regression", "TwoStepRegression"):
        sheet.text(left, top + 3.2, "noise", size=7)
        sheet.text(right, top + 3.2, "actions", size=7)
    for index, nfe in enumerate(rows):
        y = top - index * each - 1.0
        sheet.text(94.2, y, f"infer{nfe}", 8, size=7.5, weight="bold")
        _steps(sheet, left, right, y, nfe)
    sheet.text(107.75, 24.6, f"{_calls(method, rows)};\nthe context is encoded once", 34, size=7)


def _calls(method: Method, rows: tuple[int, ...]) -> str:
    """How often the network is called, and for which velocity where it has two."""
    if not method.instant_nfe:
        return f"{listing(rows)} {'call' if rows == (1,) else 'calls'} of the network"
    if 1 in rows:
        return r"one call of $u_\theta$, or more of $v_\theta$"
    return rf"{listing(rows)} calls of $v_\theta$"


def _steps(sheet: Sheet, left: float, right: float, y: float, nfe: int) -> None:
    """The way from noise to actions in `nfe` arcs, or in a dotted line of many."""
    if nfe > MAX_STEPS:
        sheet.path([(left, y), (right, y)], color=PURPLE)
        for index in range(40):
            x = left + (right - left) * index / 40
            sheet.axes.plot([x, x], [y - 0.6, y + 0.6], color=PURPLE, linewidth=0.7)
        return
    each = (right - left) / nfe
    for index in range(nfe):
        start, end = (left + index * each, y), (left + (index + 1) * each, y)
        sheet.arrow(start, end, color=PURPLE, bend=-0.28, width=1.3, head=8.0 if nfe < 6 else 5.0)
        sheet.axes.plot(*start, "o", color=PURPLE, markersize=2.6)


def _robot(sheet: Sheet, method: Method) -> None:
    sheet.box(2, 2, 124, 13, face=FACES["robot"])
    sheet.text(14, 10.6, method.world, 22, size=9, weight="bold")
    sheet.text(14, 6.6, read_mapping().task(method.task).title, 22, size=7.5)
    colors = [BLUE] * method.exec + [PALE] * (method.pred - method.exec)
    sheet.cells(45, 7.2, colors, width=68, height=3.4, edge=GREY)
    executed = 68 * method.exec / method.pred
    sheet.text(45, 12.8, f"chunk of {method.pred} actions at {method.control_hz:g} Hz", size=7.5, ha="left")
    done = f"the first {method.exec} are executed, the rest is dropped"
    if method.exec == method.pred:
        done = f"all {method.exec} are executed"
    sheet.text(45, 4.6, f"{done}; then it looks again", size=7.5, ha="left")
    sheet.axes.plot([45, 45 + executed], [6.2, 6.2], color=INK, linewidth=1.2)
    sheet.path([(107.75, 20), (107.75, 11.4)])
    sheet.path([(44, 8.9), (28, 8.9)])
    sheet.path([(12.5, 15), (12.5, 19.4)])
