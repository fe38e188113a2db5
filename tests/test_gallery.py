import cv2
import pytest

from imfvla import tasks
from imfvla.errors import UserError
from imfvla.figures.contact_sheet import GAP
from imfvla.gallery import write_conditions, write_gallery


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


def test_every_condition_and_severity_is_shown_at_the_start_and_later(tmp_path, monkeypatch):
    monkeypatch.setattr("imfvla.config.condition.CONDITIONS", ("camera_pose", "friction"))
    monkeypatch.setattr("imfvla.gallery.LATER_S", 0.1)
    task = {
        "name": "transfer",
        "variant": "easy",
        "expert": {"modes": 2, "noise": 0.0, "hold": 18, "dwell": 0},
    }
    (path,) = write_conditions(task, 0, 48, tmp_path)
    sheet = cv2.imread(str(path))
    assert sheet.shape[1] == GAP + 6 * (48 + GAP)
    line = (sheet.shape[0] - 3 * (48 + GAP)) // 4
    tops = [2 * line + number * (line + 48 + GAP) for number in range(3)]
    none, camera, friction = (sheet[top : top + 48] for top in tops)
    assert (none[:, : 48 + GAP] != camera[:, : 48 + GAP]).any()
    assert (none[:, : 48 + GAP] == friction[:, : 48 + GAP]).all()
