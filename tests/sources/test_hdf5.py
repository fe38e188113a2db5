"""HDF5 files in the layouts of robomimic and ACT, made here."""

import cv2
import numpy as np
import pytest

from imfvla.errors import UserError
from imfvla.robot import Camera

h5py = pytest.importorskip("h5py", reason="needs the extra hdf5")
from outside import (  # noqa: E402
    EEF_ACTION,
    EEF_STATE,
    SMALL,
    arrays,
    options,
    small_frames,
    write_robomimic,
)

from imfvla.sources.hdf5 import open_source  # noqa: E402

JOINTS = ["waist [rad]", "elbow [rad]", "gripper [0, 1]"]


def robomimic(path, **changes):
    common = {
        "layout": "robomimic",
        "control_hz": 20,
        "state": EEF_STATE,
        "action": EEF_ACTION,
        "instruction": "lift",
    }
    return open_source(options("hdf5", path=str(path)) | common | changes)


def write_act(folder, numbers=(0, 1, 10), encode=None):
    folder.mkdir(exist_ok=True)
    for number in numbers:
        with h5py.File(folder / f"episode_{number}.hdf5", "w") as file:
            file["observations/qpos"], file["action"] = arrays(number)
            seen = small_frames(number)
            file["observations/images/top"] = seen if encode is None else encode(seen)
    return folder


def act(path, **changes):
    common = {
        "layout": "act",
        "control_hz": 50,
        "state": {"qpos": JOINTS},
        "action": JOINTS,
        "instruction": "insert",
    }
    return open_source(options("hdf5", path=str(path)) | common | changes)


def encoded(seen, suffix=".png", swap=True):
    """As cv2 takes pictures: blue first, where a recorder minds it."""
    return [cv2.imencode(suffix, frame[..., ::-1] if swap else frame)[1] for frame in seen]


def padded(parts):
    found = np.zeros((len(parts), max(map(len, parts)) + 5), np.uint8)
    for row, part in zip(found, parts, strict=True):
        row[: len(part)] = part
    return found


def ragged(parts):
    found = np.empty(len(parts), h5py.vlen_dtype(np.uint8))
    for number, part in enumerate(parts):
        found[number] = part
    return found


def test_robomimic_has_many_episodes_a_file_in_the_order_of_their_numbers(tmp_path):
    source = robomimic(write_robomimic(tmp_path / "demo.hdf5"))
    assert source.robot.state == ("x [m]", "y [m]", "gripper [m]")
    assert source.robot.relative_to == (0, 1, None)
    assert source.robot.cameras == (Camera("agentview_image", *SMALL),)
    assert source.robot.control_hz == 20
    for index, number in enumerate((0, 1, 10)):
        read, (state, action) = source.episode(index, ("agentview_image",)), arrays(number)
        assert read.name == f"demo/data/demo_{number}"
        assert np.array_equal(read.state, state.astype(np.float32))
        assert np.array_equal(read.action, action.astype(np.float32))
        assert np.array_equal(read.images["agentview_image"], small_frames(number))
        assert read.instructions == ("lift",)
    actions = np.concatenate([arrays(number)[1] for number in (0, 1, 10)])
    assert np.allclose(source.robot.action_min, actions.min(0))
    assert robomimic(tmp_path / "demo.hdf5", action_key="actions_abs").episode(0).action[
        0, 0
    ] == pytest.approx(arrays(0)[1][0, 0] + 1)


@pytest.mark.parametrize(
    "encode", [None, lambda seen: padded(encoded(seen)), lambda seen: ragged(encoded(seen))]
)
def test_act_has_an_episode_a_file_with_raw_and_encoded_pictures(tmp_path, encode):
    source = act(write_act(tmp_path / "act", encode=encode))
    read = source.episode(2, ("top",))
    assert (read.name, len(source)) == ("episode_10", 3)
    assert np.array_equal(read.state, arrays(10)[0].astype(np.float32))
    assert np.array_equal(read.images["top"], small_frames(10))


def test_red_and_blue_can_be_exchanged(tmp_path):
    folder = write_act(tmp_path / "act", encode=lambda seen: padded(encoded(seen, swap=False)))
    assert np.array_equal(
        act(folder, picture_order="bgr").episode(0, ("top",)).images["top"], small_frames(0)
    )
    assert not np.array_equal(act(folder).episode(0, ("top",)).images["top"], small_frames(0))


@pytest.mark.parametrize("every", [1, 4, 100])
def test_frames_episodes_and_cameras_can_be_chosen(tmp_path, every):
    folder = write_act(tmp_path / "act")
    source = act(folder, episodes=[1], camera_every=every, cameras={"eye": "top"})
    read = source.episode(0, ("eye",))
    assert (read.name, len(source)) == ("episode_1", 1)
    assert np.array_equal(read.images["eye"], small_frames(1)[::every])
    assert source.num_frames(0) == len(read.image_steps) == len(read.images["eye"])
    assert act(folder, cameras={}).num_frames(0) == 0


def test_pictures_are_read_in_blocks(tmp_path, monkeypatch):
    monkeypatch.setattr("imfvla.sources.hdf5.file.BLOCK", 4)
    source = act(write_act(tmp_path / "act"), camera_every=2)
    assert np.array_equal(source.episode(0, ("top",)).images["top"], small_frames(0)[::2])


def test_the_digest_follows_files_and_options(tmp_path):
    path = write_robomimic(tmp_path / "demo.hdf5")
    before = robomimic(path).digest()
    assert robomimic(path).digest() == before
    assert robomimic(path, instruction="push").digest() != before
    write_robomimic(path, (0, 1))
    assert robomimic(path).digest() != before


def set_values(key, values):
    def change(path):
        with h5py.File(path, "a") as file:
            del file[key]
            file[key] = values

    return change


def set_dataset(key, **arguments):
    def change(path):
        with h5py.File(path, "a") as file:
            del file[key]
            file.create_dataset(key, **arguments)

    return change


def virtual(path):
    with h5py.File(path, "a") as file:
        layout = h5py.VirtualLayout((6, 3), "f8")
        layout[:] = h5py.VirtualSource("/etc/passwd", "a", (6, 3))
        del file["data/demo_0/actions"]
        file.create_virtual_dataset("data/demo_0/actions", layout)


DEMO = "data/demo_0"
huge_pictures = set_dataset(
    f"{DEMO}/obs/agentview_image", shape=(6, 16_000, 16_000, 3), dtype="u1", chunks=(1, 8, 8, 3)
)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda path: path.write_bytes(b"not HDF5"), ["demo.hdf5", "whole HDF5"]),
        (lambda path: path.write_bytes(path.read_bytes()[:3000]), ["demo.hdf5", "whole HDF5"]),
        (lambda path: path.unlink(), ["demos.path", "demo.hdf5"]),
        (set_values("data", 3), ["data", "a group"]),
        (lambda path: h5py.File(path, "w").close(), ["demo.hdf5", "data", "nothing"]),
        (set_values(f"{DEMO}/actions", np.zeros((6, 2))), [f"{DEMO}/actions", "(steps, 3)", "(6, 2)"]),
        (set_values(f"{DEMO}/actions", np.zeros((0, 3))), [f"{DEMO}/actions", "(0, 3)"]),
        (set_values(f"{DEMO}/actions", np.full((6, 3), np.nan)), [f"{DEMO}/actions", "finite", "nan", "x [m]"]),
        (set_values(f"{DEMO}/actions", ["a"] * 6), [f"{DEMO}/actions", "numbers", "object"]),
        (set_dataset(f"{DEMO}/actions", data=np.zeros(6, "V9")), [f"{DEMO}/actions", "numbers"]),
        (set_dataset(f"{DEMO}/actions", shape=(10**9, 3), dtype="f8", chunks=(10, 3)), ["actions", "1000000000"]),
        (set_dataset(f"{DEMO}/actions", shape=(10**6, 999), dtype="f8", chunks=(10, 3)), ["actions", "(steps, 3)"]),
        (huge_pictures, ["agentview_image", "GiB"]),
        (set_values(f"{DEMO}/actions", h5py.ExternalLink("/etc/passwd", "a")), [f"{DEMO}/actions", "links"]),
        (set_values(f"{DEMO}/obs", h5py.SoftLink("/data/demo_1/obs")), [f"{DEMO}", "links"]),
        (set_dataset(f"{DEMO}/actions", shape=(6, 3), dtype="f8", external="/etc/passwd"), ["actions", "other files"]),
        (virtual, ["actions", "other files"]),
        (set_values(f"{DEMO}/obs/eef_pos", np.zeros((5, 2))), ["obs/eef_pos", "6 steps", "(5,)"]),
        (set_values(f"{DEMO}/obs/agentview_image", np.zeros((5, 4, 4, 3), "u1")), ["agentview_image", "6 steps"]),
    ],
)  # fmt: skip
def test_bad_files_are_refused_by_file_and_key(tmp_path, damage, words):
    path = write_robomimic(tmp_path / "demo.hdf5")
    damage(path)
    with pytest.raises(UserError) as error:
        robomimic(path, cameras={"eye": "agentview_image"}).episode(0, ("eye",))
    assert all(word in str(error.value) for word in words), str(error.value)
    assert "delete" not in str(error.value)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"path": ""}, ["demos.path"]),
        ({"layout": "libero"}, ["demos.layout", "robomimic", "act"]),
        ({"layout": "act"}, ["demo.hdf5", "action", "data"]),
        ({"control_hz": None}, ["demos.control_hz", "number"]),
        ({"instruction": ""}, ["demos.instruction"]),
        ({"state": None}, ["demos.state", "mapping"]),
        ({"state": {"eef_pos": ["x", "y"]}}, ["demos.state.eef_pos", "unit", "'x'"]),
        ({"state": {"eef_pos": ["x [m]"]}}, ["obs/eef_pos", "(steps, 1)", "(6, 2)"]),
        ({"state": {"eef_vel": ["x [m]"]}}, ["obs", "eef_vel", "eef_pos"]),
        ({"action": ["x [m]", "y [m]", "y [m]"]}, ["demos.action", "differ", "y more than once"]),
        (
            {"state": {"eef_pos": ["x [m]", "y [m]"], "gripper_qpos": ["x [m]"]}},
            ["demos.state", "x more than once"],
        ),
        ({"state": {"eef_pos": ["x [m]", 3]}}, ["demos.state", "names of channels"]),
        ({"cameras": {"eye": ["agentview_image"]}}, ["demos.cameras.eye", "a text"]),
        ({"instruction": " "}, ["demos.instruction", "a sentence"]),
        (
            {"action_min": [0, 0, 0], "action_max": [1, 0, 1]},
            ["demos.action_min", "demos.action_max", "0 and 0 for y"],
        ),
        ({"action_key": "actions_rel"}, ["demo_0", "actions_rel", "actions_abs"]),
        ({"cameras": {"eye": "wrist"}}, ["obs", "wrist", "agentview_image"]),
        ({"cameras": {"eye": "eef_pos"}}, ["eef_pos", "uint8"]),
        ({"cameras": ["agentview_image"]}, ["demos.cameras", "mapping"]),
        ({"episodes": [3]}, ["demos.episodes", "below 3"]),
        ({"picture_order": "gbr"}, ["demos.picture_order"]),
    ],
)
def test_options_that_do_not_fit_are_refused_by_key(tmp_path, changes, words):
    path = write_robomimic(tmp_path / "demo.hdf5")
    with pytest.raises(UserError) as error:
        robomimic(path, **changes).episode(0) if "path" not in changes else robomimic(**changes)
    assert all(word in str(error.value) for word in words), str(error.value)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (set_values("data/demo_10/obs/eef_pos", np.zeros((6, 4))), ["demo_10/obs/eef_pos", "(steps, 2)", "(6, 4)"]),
        (set_values("data/demo_10/obs/eef_pos", np.zeros((4, 2))), ["demo_10/obs/eef_pos", "6 steps", "(4,)"]),
        (set_values("data/demo_10/obs", 3), ["demo_10/obs", "a group"]),
        (set_values("data/demo_10/obs/agentview_image", np.zeros((9, *SMALL, 3), "u1")), ["agentview", "6 steps"]),
    ],
)  # fmt: skip
def test_keys_and_shapes_of_every_episode_are_checked_before_one_is_read(tmp_path, damage, words):
    """A training opens its source first, so nothing is trained yet."""
    path = write_robomimic(tmp_path / "demo.hdf5")
    damage(path)
    with pytest.raises(UserError) as error:
        robomimic(path)
    assert all(word in str(error.value) for word in words), str(error.value)


def test_pictures_that_cannot_be_decoded_or_have_another_size_are_refused(tmp_path):
    bad = write_act(tmp_path / "bad", (0,), encode=lambda seen: np.zeros((6, 40), np.uint8))
    with pytest.raises(UserError, match=r"episode_0\.hdf5.*images/top at step 0.*neither a PNG nor a JPEG"):
        act(bad)
    folder = write_act(tmp_path / "act")
    set_values("observations/images/top", np.zeros((6, 4, 4, 3), np.uint8))(folder / "episode_10.hdf5")
    with pytest.raises(UserError, match=r"episode_10\.hdf5.*images/top.*12 x 20.*4 x 4"):
        act(folder).episode(2, ("top",))
