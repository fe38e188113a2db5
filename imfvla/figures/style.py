"""The style of all figures, and how they are saved: equal content gives equal files."""

import io
from collections.abc import Iterator
from contextlib import contextmanager

import matplotlib as mpl
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text

from imfvla.process.visible import visible

# Okabe and Ito's colours, told apart with every common kind of colour blindness.
BLACK, ORANGE, SKY, GREEN = "#000000", "#e69f00", "#56b4e9", "#009e73"
YELLOW, BLUE, VERMILION, PURPLE = "#f0e442", "#0072b2", "#d55e00", "#cc79a7"
GREY, PALE, INK = "#8a8a8a", "#e8e8e8", "#222222"
CYCLE = (BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY, BLACK)
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")  # one more than colours, so that pairs repeat late
STYLE = {
    "font.family": "DejaVu Sans",  # comes with matplotlib: the same everywhere
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.titley": 1.0,  # where it is anyway; searching a free place takes a fifth of the time of a figure
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": GREY,
    "axes.grid": True,
    "grid.color": PALE,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "figure.facecolor": "white",
    "text.parse_math": False,  # names come from files, and a "$" in one is a "$"; diagrams allow it for themselves
    "svg.fonttype": "path",
    "svg.hashsalt": "imfvla",  # element names, random otherwise
}
WIDTH = 8.3  # inches of a figure: at 100 px an inch it fills a README, and 8 points there are 11 px
DPI = 160


@contextmanager
def style() -> Iterator[None]:
    """Figures made inside this context have the common style; global settings are left alone."""
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(STYLE)
        yield


def new_figure(width: float, height: float) -> Figure:
    """An empty figure [inches] that belongs to no window."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def render(figure: Figure) -> dict[str, bytes]:
    """Content by suffix: ".svg" and ".png", without dates and versions."""
    content = {}
    for text in figure.findobj(Text):
        text.set_text(visible(text.get_text(), keep="\n"))  # XML takes no control characters
    with style():
        # Computed once, without a drawing of its own; with any engine left, savefig would draw once more for it.
        if figure.axes and (engine := figure.get_layout_engine()) is not None:
            engine.execute(figure)
        figure.set_layout_engine(None)
    for suffix, metadata in ((".svg", {"Date": None, "Creator": None}), (".png", {"Software": None})):
        stream = io.BytesIO()
        with style():
            figure.savefig(stream, format=suffix[1:], dpi=DPI, metadata=metadata)
        content[suffix] = stream.getvalue()
    return content
