"""Boxes, arrows and lines of text on a sheet whose unit is one tenth of an inch."""

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch, Rectangle

from imfvla.figures.style import GREY, INK, new_figure

UNIT = 0.1  # inches
SCALE = 1.25  # of the sizes below, in points
SMALLEST = 5.0  # points: text that would have to be smaller raises an error


class Sheet:
    """An empty drawing area of width x height units, origin at the lower left."""

    def __init__(self, width: float, height: float) -> None:
        self.figure: Figure = new_figure(UNIT * width, UNIT * height)
        self.figure.set_layout_engine("none")
        self.axes: Axes = self.figure.add_axes((0, 0, 1, 1))
        self.axes.set(xlim=(0, width), ylim=(0, height))
        self.axes.axis("off")

    def box(
        self,
        x: float,
        y: float,
        width: float,
        height: float,
        lines: Sequence[str] = (),
        *,
        title: str = "",
        face: str = "white",
        edge: str = GREY,
        size: float = 8.0,
        rounding: float = 1.0,
    ) -> None:
        """A rounded box from its lower left corner: a bold title at its top, lines of text below or in the middle."""
        self.axes.add_patch(
            FancyBboxPatch(
                (x + rounding, y + rounding),
                width - 2 * rounding,
                height - 2 * rounding,
                boxstyle=f"round,pad={rounding},rounding_size={rounding}",
                facecolor=face,
                edgecolor=edge,
                linewidth=1.0,
            )
        )
        top = y + height
        if title:
            self.text(x + width / 2, top - 1.0, title, width - 1.5, size=size + 1.5, weight="bold", va="top")
            top -= 3.2
        if lines:
            middle = (top + y) / 2
            self.text(x + width / 2, middle, "\n".join(lines), width - 1.5, size=size)

    def text(
        self, x: float, y: float, text: str, width: float | None = None, *, size: float = 8.0, **options
    ) -> None:
        """Text around (x, y), with formulas between dollar signs, made smaller until it is no wider than `width` units.

        Raises ValueError where it would become unreadable.
        """
        size *= SCALE
        usual = {"ha": "center", "va": "center", "color": INK, "linespacing": 1.35, "parse_math": True}
        options = usual | options
        drawn = self.axes.text(x, y, text, fontsize=size, **options)
        if width is None:
            return
        renderer = self.figure.canvas.get_renderer()
        limit = width * UNIT * self.figure.dpi
        needed = drawn.get_window_extent(renderer).width
        if needed > limit:
            size *= limit / needed
            if size < SMALLEST:
                raise ValueError(
                    f"{text!r} does not fit into {width} units: it needs {needed / limit:.1f} times that"
                )
            drawn.set_fontsize(size)

    def arrow(
        self,
        start: tuple[float, float],
        end: tuple[float, float],
        *,
        color: str = INK,
        bend: float = 0.0,
        width: float = 1.1,
        head: float = 9.0,
        line: str = "-",
        alpha: float = 1.0,
    ) -> None:
        """From start to end; `bend` is the height of its arc as a share of its length."""
        self.axes.add_patch(
            FancyArrowPatch(
                start,
                end,
                arrowstyle="-|>" if head else "-",
                mutation_scale=head or 1.0,
                connectionstyle=f"arc3,rad={bend}",
                color=color,
                linewidth=width,
                linestyle=line,
                alpha=alpha,
                shrinkA=0,
                shrinkB=0,
            )
        )

    def path(
        self,
        points: Sequence[tuple[float, float]],
        *,
        color: str = INK,
        width: float = 1.1,
        head: bool = True,
    ):
        """A line through the points, with an arrow head at its end."""
        xs, ys = zip(*points[:-1], strict=True)
        last = points[-1]
        self.axes.plot(xs, ys, color=color, linewidth=width, solid_capstyle="butt")
        self.arrow(points[-2], last, color=color, width=width, head=9.0 if head else 0.0)

    def cells(
        self,
        x: float,
        y: float,
        colors: Sequence[str],
        *,
        width: float,
        height: float,
        edge: str = "white",
    ) -> None:
        """A row of adjoining cells with a total width of `width`."""
        each = width / len(colors)
        for index, color in enumerate(colors):
            self.axes.add_patch(
                Rectangle((x + index * each, y), each, height, facecolor=color, edgecolor=edge, linewidth=0.6)
            )
