"""LeRobotDataset v3, written and read by our own code; `test_lerobot_itself.py` holds both to LeRobot."""

import json
import os
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from imfvla.errors import UserError
from imfvla.robot import Camera

pa = pytest.importorskip("pyarrow", reason="needs the extra lerobot")
import pyarrow.parquet as pq  # noqa: E402
from outside import ROBOT, episode, options  # noqa: E402

from imfvla.sources.lerobot import LeRobotWriter, open_source  # noqa: E402
from imfvla.sources.lerobot import series as series_module  # noqa: E402

LENGTHS = (8, 5, 7)
FRONT = "observation.images.front"


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    path = tmp_path_factory.mktemp("lerobot") / "set"
    with LeRobotWriter(path, ROBOT, pictures="h264") as writer:
        for number, length in enumerate(LENGTHS):
            writer.add(episode(number, length))
    return path


@pytest.fixture
def copied(written, tmp_path):
    return Path(shutil.copytree(written, tmp_path / "set"))


def opened(path, **changes):
    return open_source(options("lerobot", path=str(path), **changes))


def edit_info(path, **changes):
    file = path / "meta/info.json"
    file.write_text(json.dumps(json.loads(file.read_text(encoding="utf-8")) | changes), encoding="utf-8")


def edit_table(path, change):
    """Rewrites a parquet file with the columns that `change(columns)` leaves in a dict of lists."""
    table = pq.read_table(path)
    columns = {name: table[name].to_pylist() for name in table.column_names}
    change(columns)
    pq.write_table(pa.table({name: pa.array(values) for name, values in columns.items()}), path)


DATA = "data/chunk-000/file-000.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
VIDEO = f"videos/{FRONT}/chunk-000/file-000.mp4"


@pytest.mark.parametrize(("pictures", "error"), [("av1", 5.0), ("h264", 3.0), ("png", 0.0)])
def test_what_was_written_is_read_in_any_order(tmp_path, pictures, error):
    with LeRobotWriter(tmp_path / "set", ROBOT, pictures=pictures) as writer:
        for number, length in enumerate(LENGTHS):
            writer.add(episode(number, length))
    source = opened(tmp_path / "set")
    assert source.robot == ROBOT
    assert len(source) == 3
    for index in (2, 0, 1):
        made, read = episode(index, LENGTHS[index]), source.episode(index, ("wrist", "front"))
        assert np.array_equal(read.state, made.state)
        assert np.array_equal(read.action, made.action)
        assert read.instructions == made.instructions
        assert np.array_equal(read.image_steps, np.arange(LENGTHS[index]))
        assert source.num_frames(index) == LENGTHS[index]
        for view, frames in made.images.items():
            assert np.abs(read.images[view].astype(int) - frames).mean() <= error
    assert not list(tmp_path.glob(".*"))


def test_pictures_are_decoded_only_where_they_are_asked_for(written):
    assert opened(written).episode(0).images == {}


def test_episodes_cameras_and_frames_can_be_chosen(written):
    source = opened(written, episodes=[2], cameras={"eye": FRONT}, camera_every=3, instruction="go")
    read = source.episode(0, ("eye",))
    assert (len(source), source.robot.cameras) == (1, (Camera("eye", 64, 96),))
    assert read.image_steps.tolist() == [0, 3, 6]
    assert read.instructions == ("go",)
    assert np.abs(read.images["eye"].astype(int) - episode(2, 7).images["front"][::3]).mean() < 3


def test_a_picture_is_repeated_at_steps_without_one(tmp_path):
    with LeRobotWriter(tmp_path / "set", ROBOT, pictures="png") as writer:
        writer.add(episode(0, 6, every=4))
        assert writer.num_repeats == 4
    read = opened(tmp_path / "set").episode(0, ("front",))
    assert np.array_equal(read.images["front"], episode(0, 6, every=4).images["front"][[0, 0, 0, 0, 1, 1]])


def test_episodes_go_on_in_the_next_file_once_one_is_full(tmp_path, monkeypatch):
    monkeypatch.setattr(series_module, "MB", 0)
    with LeRobotWriter(tmp_path / "set", ROBOT, pictures="h264") as writer:
        for number, length in enumerate(LENGTHS):
            writer.add(episode(number, length))
    assert len(list((tmp_path / "set").glob(f"videos/{FRONT}/*/*.mp4"))) == 3
    assert len(list((tmp_path / "set").glob("data/*/*.parquet"))) == 3
    read = opened(tmp_path / "set").episode(2, ("front",))
    assert np.array_equal(read.state, episode(2, 7).state)
    assert np.abs(read.images["front"].astype(int) - episode(2, 7).images["front"]).mean() < 3


def test_threads_read_at_the_same_time(written):
    source = opened(written)
    with ThreadPoolExecutor(3) as threads:
        read = list(threads.map(lambda index: source.episode(index, ("front",)), (0, 1, 2, 0, 1, 2)))
    assert [len(found.state) for found in read] == [*LENGTHS, *LENGTHS]


def test_the_digest_follows_what_would_be_read(copied):
    before = opened(copied).digest()
    assert opened(copied).digest() == before
    assert opened(copied, instruction="go").digest() != before
    video = copied / VIDEO
    os.utime(video, ns=(0, video.stat().st_mtime_ns + 1))
    assert opened(copied).digest() != before


def test_without_our_own_file_limits_come_from_statistics_and_grippers_stay_absolute(copied):
    (copied / "meta/imfvla_robot.json").unlink()
    actions = np.concatenate([episode(number, length).action for number, length in enumerate(LENGTHS)])
    for stats in (True, False):
        if not stats:
            (copied / "meta/stats.json").unlink()
        robot = opened(copied).robot
        assert robot.relative_to == (0, 1, None)
        assert np.allclose(robot.action_min, actions.min(0))
        assert np.allclose(robot.action_max, actions.max(0))
    assert opened(copied, absolute=["elbow"]).robot.relative_to == (0, None, 2)
    assert opened(copied, absolute=[]).robot.relative_to == (0, 1, 2)
    assert opened(copied, action_min=[-9, -9, -9]).robot.action_min == (-9, -9, -9)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["a", "b", "c"], ("a", "b", "c")),
        ({"motors": ["a", "b", "c"]}, ("a", "b", "c")),
        ({"b": 1, "a": 0, "c": 2}, ("a", "b", "c")),
        (["dim"], ("action_0", "action_1", "action_2")),
        (None, ("action_0", "action_1", "action_2")),
    ],
)
def test_names_of_channels_in_all_forms_that_data_sets_have(copied, names, expected):
    info = json.loads((copied / "meta/info.json").read_text(encoding="utf-8"))
    info["features"]["action"]["names"] = names
    edit_info(copied, features=info["features"])
    assert opened(copied).robot.action == expected
    assert opened(copied, action_names=["x [m]", "y [m]", "z [m]"]).robot.action == (
        "x [m]",
        "y [m]",
        "z [m]",
    )


def test_features_are_joined_into_one_state(written):
    robot = opened(written, state=["observation.state", "timestamp"], absolute=[]).robot
    assert robot.state == (*ROBOT.state, "timestamp_0")


def set_value(name, row, value):
    return lambda columns: columns[name].__setitem__(row, value)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda path: shutil.rmtree(path / "meta"), ["meta/info.json", "correct the path"]),
        (lambda path: edit_info(path, codebase_version="v2.1"), ["codebase_version", "v3.0", "v2.1", "convert"]),
        (lambda path: edit_info(path, fps=None), ["fps", "above 0", "None"]),
        (lambda path: edit_info(path, total_episodes=10**9), ["total_episodes", "1000000000"]),
        (lambda path: edit_info(path, total_episodes=999_999), ["meta/episodes", "999999", "found 3"]),
        (lambda path: edit_info(path, data_path="../../etc/passwd"), ["data_path", "inside", "etc/passwd"]),
        (lambda path: edit_info(path, data_path="{chunk_index.__class__}"), ["data_path", "__class__"]),
        (lambda path: edit_info(path, data_path="{chunk_index:0999999999d}"), ["data_path", "999999999"]),
        (lambda path: edit_info(path, video_path="/etc/{video_key}"), ["video_path", "inside", "/etc/"]),
        (lambda path: edit_info(path, video_path=None), ["video_path", "None"]),
        (lambda path: edit_info(path, features={}), ["features", "mapping"]),
        (lambda path: (path / "meta/tasks.parquet").unlink(), ["meta/tasks.parquet", "missing"]),
        (lambda path: (path / DATA).write_bytes(b"PAR1" + bytes(100) + b"PAR1"), [DATA, "no whole parquet"]),
        (lambda path: (path / DATA).write_bytes((path / DATA).read_bytes()[:-9]), [DATA, "no whole parquet"]),
        (lambda path: (path / DATA).unlink(), [DATA, "missing"]),
        (lambda path: edit_table(path / DATA, set_value("action", 3, [0, np.nan, 0])), ["elbow", "step 3", "nan"]),
        (lambda path: edit_table(path / DATA, set_value("action", 3, [0.0, 0.0])), ["column action", "3 numbers"]),
        (lambda path: edit_table(path / DATA, set_value("action", 3, None)), ["column action"]),
        (lambda path: edit_table(path / DATA, lambda columns: columns.pop("action")), ["columns", "with action"]),
        (lambda path: edit_table(path / DATA, set_value("episode_index", 1, 9)), ["episode_index", "9"]),
        (lambda path: edit_table(path / DATA, set_value("task_index", 1, 1)), ["task_index", "instruction"]),
        (lambda path: edit_info(path, fps=20), ["timestamp", "20 Hz", "10 Hz"]),
        (lambda path: (path / VIDEO).write_bytes(b"#EXTM3U\n/etc/passwd\n"), [VIDEO, "no whole mp4"]),
        (lambda path: (path / VIDEO).unlink(), [VIDEO, "missing"]),
        (lambda path: edit_table(path / EPISODES, set_value("length", 1, 6)), ["length of episode 1"]),
        (lambda path: edit_table(path / EPISODES, set_value("data/file_index", 0, -1)), ["data/file_index"]),
        (
            lambda path: edit_table(path / EPISODES, set_value(f"videos/{FRONT}/from_timestamp", 0, 1.6)),
            [VIDEO, "a frame at 2.0000 s", "an end at 1.9000 s"],
        ),
        (
            lambda path: edit_table(path / EPISODES, set_value(f"videos/{FRONT}/from_timestamp", 0, 0.05)),
            [VIDEO, "0.0500 s", "between 0.0000 s and 0.1000 s"],
        ),
    ],
)  # fmt: skip
def test_a_bad_data_set_is_refused_by_file_and_key(copied, damage, words):
    damage(copied)
    with pytest.raises(UserError) as error:
        opened(copied).episode(0, ("front",))
    assert all(word in str(error.value) for word in words), str(error.value)
    assert "delete" not in str(error.value)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"path": "/nowhere"}, ["/nowhere", "no folder"]),
        ({"paht": "x"}, ["paht", "path"]),
        ({"action": ["motors"]}, ["motors", "observation.state", "demos.action"]),
        ({"action": [FRONT]}, [FRONT, "list of numbers"]),
        ({"action": []}, ["demos.action"]),
        ({"cameras": {"eye": "top"}}, ["demos.cameras.eye", "top", FRONT]),
        ({"cameras": ["top"]}, ["demos.cameras", "mapping"]),
        ({"cameras": {"eye": [FRONT]}}, ["demos.cameras.eye", "a text"]),
        (
            {"state": ["observation.state", "observation.state"]},
            ["demos.state", "observation.state more than once"],
        ),
        ({"state_names": ["a", "b", "a [rad]"]}, ["demos.state_names", "a more than once"]),
        ({"action_min": [5, 0, 0], "action_max": [1, 1, 1]}, ["demos.action_min", "5 and 1 for shoulder"]),
        ({"instruction": ""}, ["demos.instruction", "a sentence"]),
        ({"episodes": [3]}, ["demos.episodes", "below 3"]),
        ({"episodes": [0, 0]}, ["demos.episodes", "differ"]),
        ({"absolute": ["wrist"]}, ["demos.absolute", "wrist", "elbow"]),
        ({"action_min": [0]}, ["demos.action_min", "3 values"]),
        ({"action_names": ["a", "b"]}, ["demos.action_names", "action (3)", "found 2"]),
        ({"state_names": ["shoulder [deg]", "b", "c"]}, ["shoulder [deg]", "shoulder [rad]", "unit"]),
        ({"camera_every": 0}, ["demos.camera_every"]),
    ],
)
def test_options_that_do_not_fit_are_refused_by_key(written, changes, words):
    with pytest.raises(UserError) as error:
        open_source(options("lerobot", path=str(written)) | changes)
    assert all(word in str(error.value) for word in words), str(error.value)


def test_a_link_out_of_the_folder_is_refused_and_one_into_the_hubs_cache_is_read(copied, tmp_path):
    secret = tmp_path / "secret.parquet"
    shutil.move(copied / DATA, secret)
    (copied / DATA).symlink_to(secret)
    with pytest.raises(UserError, match="inside the data set"):
        opened(copied).episode(0)
    snapshot = tmp_path / "datasets--x" / "snapshots" / "abc"
    snapshot.parent.mkdir(parents=True)
    shutil.move(copied, snapshot)
    (tmp_path / "datasets--x" / "blobs").mkdir()
    blob = Path(shutil.move(secret, tmp_path / "datasets--x" / "blobs" / "123"))
    (snapshot / DATA).unlink()
    (snapshot / DATA).symlink_to(blob)
    assert len(opened(snapshot).episode(0).state) == 8


@pytest.mark.parametrize("name", [DATA, "meta/info.json", "."])
def test_a_link_that_leads_to_itself_is_refused(copied, name):
    path = copied / name
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    path.symlink_to(path)
    with pytest.raises(UserError, match=r"leads to itself|No LeRobot data set"):
        opened(copied).episode(0, ())


def test_lists_that_would_fill_the_memory_are_refused_before_they_are_unpacked(copied, monkeypatch):
    monkeypatch.setattr("imfvla.sources.lerobot.tables.MAX_GROUP_VALUES", 1000)
    edit_table(copied / DATA, lambda columns: columns["action"].__setitem__(0, [0.0] * 2000))
    with pytest.raises(UserError, match=r"column action.*at most 1000 values.*2057"):
        opened(copied).episode(0)


def test_what_the_writer_cannot_keep_is_refused(tmp_path):
    (tmp_path / "there").mkdir()
    with pytest.raises(UserError, match="exists already"):
        LeRobotWriter(tmp_path / "there", ROBOT)
    with pytest.raises(UserError, match=r"control_hz.*whole number.*12\.5"):
        LeRobotWriter(tmp_path / "set", replace(ROBOT, control_hz=12.5))
    with pytest.raises(UserError, match=r"even.*63 x 64.*png"):
        LeRobotWriter(tmp_path / "set", replace(ROBOT, cameras=(Camera("top", 63, 64),)))
    assert not (tmp_path / "set").exists()


def write_all(path, *episodes):
    with LeRobotWriter(path, ROBOT) as writer:
        for made in episodes:
            writer.add(made)


def test_an_error_or_no_episode_leaves_nothing(tmp_path):
    good = episode(0)
    bad = [
        replace(good, images={}),
        replace(good, action=good.action[:, :2]),
        replace(good, state=np.full_like(good.state, np.nan)),
        replace(good, image_steps=good.image_steps + 1),
        replace(good, imitate=np.arange(len(good.state)) > 1),
    ]
    for made in bad:
        with pytest.raises(UserError, match="made_0"):
            write_all(tmp_path / "set", good, made)
    with pytest.raises(UserError, match="at least one episode"):
        write_all(tmp_path / "set")
    assert not list(tmp_path.iterdir())
