"""Pictures in rows and columns with gaps between them, a heading over each column and a line of text over each row."""

import io
from collections.abc import Sequence

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from imfvla.figures.style import WIDTH, style

GAP = 6  # px
LINE = 0.27  # inches that a line of text takes


def contact_sheet(rows: Sequence[tuple[str, Sequence[np.ndarray]]], columns: Sequence[str]) -> np.ndarray:
    """A picture uint8 (H, W, 3) from the text and the equal pictures of each row, and the headings of columns.

    Text is as large as in all figures where the sheet is shown as wide as they are.
    """
    height, width = rows[0][1][0].shape[:2]
    sheet_width = GAP + len(columns) * (width + GAP)
    dpi = sheet_width / WIDTH
    line = round(LINE * dpi)
    sheet_height = line + len(rows) * (line + height + GAP)
    with style():
        figure = Figure(figsize=(sheet_width / dpi, sheet_height / dpi), dpi=dpi)
        canvas = FigureCanvasAgg(figure)
        lefts = [GAP + column * (width + GAP) for column in range(len(columns))]
        for left, text in zip(lefts, columns, strict=True):
            _write(figure, left + width / 2, line / 2, text, ha="center")
        for number, (text, pictures) in enumerate(rows):
            top = line + number * (line + height + GAP)
            _write(figure, GAP, top + line / 2, text, weight="bold")
            for left, picture in zip(lefts, pictures, strict=True):
                below = sheet_height - top - line - height
                figure.figimage(picture, left, below, origin="upper")
        canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def png(picture: np.ndarray) -> bytes:
    """A picture uint8 (H, W, 3) as a file."""
    stream = io.BytesIO()
    Image.fromarray(picture).save(stream, "png", optimize=True)
    return stream.getvalue()


def _write(figure: Figure, x: float, y: float, text: str, **options: str) -> None:
    """Around a point [px], counted from the upper left."""
    width, height = figure.bbox.width, figure.bbox.height
    figure.text(x / width, 1 - y / height, text, va="center_baseline", **options)
