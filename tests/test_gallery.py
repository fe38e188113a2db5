import cv2
import pytest

from imfvla import tasks
from imfvla.gallery import write_gallery


@pytest.mark.parametrize("name", tasks.NAMES)
def test_both_ways_of_the_hidden_choice_are_shown_from_one_start(name, tmp_path):
    task = {"name": name, "variant": "easy", "expert": {"modes": 2, "noise": 0.0, "hold": 18}}
    paths = write_gallery(task, 0, 24, tmp_path)
    sheets = [cv2.imread(str(path)) for path in paths]
    assert [sheet.shape for sheet in sheets] == [(4 * 30, 4 * 30, 3)] * 2
    assert (sheets[0][:30] == sheets[1][:30]).all()
    assert (sheets[0][30:60] != sheets[1][30:60]).any()
