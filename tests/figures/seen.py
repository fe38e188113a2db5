"""What can be seen on a figure, and whether all of it is on the sheet."""

from matplotlib.axes import Axes
from matplotlib.axis import Tick
from matplotlib.figure import Figure
from matplotlib.text import Text


def texts(figure: Figure) -> list[str]:
    """Every text drawn, none of them empty."""
    return [
        text.get_text() for text in figure.findobj(Text) if text.get_visible() and text.get_text().strip()
    ]


def clipped(figure: Figure) -> list[str]:
    """Texts that reach over the edge of the figure."""
    figure.canvas.draw()
    renderer = figure.canvas.get_renderer()
    width, height = figure.canvas.get_width_height()
    hidden = hidden_tick_labels(figure)
    found = []
    for text in figure.findobj(Text):
        if not text.get_visible() or not text.get_text().strip() or id(text) in hidden:
            continue
        box = text.get_window_extent(renderer)
        if box.x0 < -1 or box.y0 < -1 or box.x1 > width + 1 or box.y1 > height + 1:
            found.append(text.get_text())
    return found


def hidden_tick_labels(figure: Figure) -> set[int]:
    """Labels of ticks outside of the shown range, which are never drawn."""
    hidden = set()
    for axes in figure.findobj(Axes):
        for axis in (axes.xaxis, axes.yaxis):
            low, high = sorted(axis.get_view_interval())
            labels = {id(text) for tick in axis.findobj(Tick) for text in (tick.label1, tick.label2)}
            ticks = (*axis.get_major_ticks(), *axis.get_minor_ticks())
            shown = [tick for tick in ticks if low <= tick.get_loc() <= high]
            hidden |= labels - {id(text) for tick in shown for text in (tick.label1, tick.label2)}
    return hidden
