import cv2
import pytest

from imfvla import tasks
from imfvla.errors import UserError
from imfvla.figures.contact_sheet import GAP
from imfvla.gallery import write_gallery


@pytest.mark.parametrize("name", tasks.NAMES)
def test_both_ways_of_the_hidden_choice_are_shown_from_one_start(name, tmp_path):
    task = {"name": name, "variant": "easy", "expert": {"modes": 2, "noise": 0.0, "hold": 18, "dwell": 0}}
    paths = write_gallery(task, 0, 24, tmp_path)
    sheets = [cv2.imread(str(path)) for path in paths]
    shape = sheets[0].shape
    assert sheets[1].shape == shape
    assert shape[1] == GAP + 4 * (24 + GAP)
    row = (shape[0] - 24) // 4  # of pictures with its line of text, about
    assert (sheets[0][:row] == sheets[1][:row]).all()
    assert (sheets[0][row : 2 * row] != sheets[1][row : 2 * row]).any()


@pytest.mark.parametrize("task", [{"name": "none", "paraphrases": False}, {"name": "pusht", "expert": None}])
def test_another_task_is_refused_by_name(task, tmp_path):
    with pytest.raises(UserError, match=rf"task must be one of socket, .* found '{task['name']}'"):
        write_gallery(task, 0, 24, tmp_path / "out")
    assert not list(tmp_path.iterdir())
