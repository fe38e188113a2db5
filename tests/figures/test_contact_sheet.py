"""Pictures side by side: each as it is, with a gap around it, a heading over columns and a line over rows."""

import io

import numpy as np
from PIL import Image

from imfvla.figures.contact_sheet import GAP, contact_sheet, png


def test_pictures_are_unchanged_and_gaps_are_white():
    rng = np.random.default_rng(0)
    pictures = rng.integers(0, 200, (2, 3, 50, 80, 3), dtype=np.uint8)
    sheet = contact_sheet([("a row", pictures[0]), ("another", pictures[1])], ["one", "two", "three"])
    line = (sheet.shape[0] - 2 * (50 + GAP)) // 3
    assert sheet.shape[1] == GAP + 3 * (80 + GAP)
    for row in range(2):
        top = line + row * (line + 50 + GAP) + line
        for column in range(3):
            left = GAP + column * (80 + GAP)
            np.testing.assert_array_equal(sheet[top : top + 50, left : left + 80], pictures[row, column])
            assert (sheet[top : top + 50, left - GAP : left] == 255).all()
    for top in (0, line, 2 * line + 50 + GAP):  # the headings and both lines of text
        assert (sheet[top : top + line] < 128).any()


def test_a_file_holds_the_picture():
    picture = np.random.default_rng(0).integers(0, 255, (5, 7, 3), dtype=np.uint8)
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(png(picture)))), picture)
