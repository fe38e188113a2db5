"""ROS 2 bags, written by mcap-ros2-support, become episodes of one rate."""

import logging

import numpy as np
import pytest

from imfvla.errors import UserError

pytest.importorskip("mcap_ros2", reason="needs the extra ros2")
from bags import BagWriter, grey, h264, joints, png, write_bag
from outside import options

from imfvla.recording.mcap_file import MAGIC
from imfvla.sources.ros2 import open_source

STATE = [{"topic": "/joint_states", "channels": {"shoulder": "shoulder [rad]", "elbow": "elbow [rad]"}}]
COMMAND = [{"topic": "/command", "channels": ["shoulder [rad]", "elbow [rad]"]}]


def opened(path, **changes):
    common = {"control_hz": 20, "state": STATE, "cameras": {"front": "/camera"}, "instruction": "go"}
    where = path if isinstance(path, list | int) else str(path)
    return open_source(options("ros2", path=where) | common | changes)


def test_a_bag_is_an_episode_of_one_rate_with_joints_by_name(tmp_path):
    source = opened(write_bag(tmp_path / "bag.mcap"), action=COMMAND)
    assert source.robot.state == source.robot.action == ("shoulder [rad]", "elbow [rad]")
    assert source.robot.relative_to == (0, 1)
    assert (source.robot.control_hz, source.robot.cameras[0].height, source.robot.cameras[0].width) == (
        20,
        16,
        24,
    )
    read = source.episode(0, ("front",))
    assert (read.name, read.instructions) == ("bag", ("go",))
    # The first step is where every topic has had a message: at the first picture, 4 ms in.
    times = 0.004 + np.arange(len(read.state)) / 20
    assert len(read.state) == 20
    assert np.abs(read.state[:, 1] - times).max() <= 0.01
    assert (read.state[:, 1] <= times + 1e-6).all()  # the last value at or before the step, never a later one
    assert np.array_equal(read.state[:, 0], -read.state[:, 1])
    assert np.abs(read.action[:, 1] - 1 - times).max() <= 0.02
    assert source.robot.action_min[0] == pytest.approx(read.action[:, 0].min())
    shown = read.images["front"][:, 0, 0, 0] / 100
    assert np.abs(shown - times).max() <= 0.5 / 30 + 0.006
    assert source.num_frames(0) == len(read.image_steps) == 20


def test_without_commands_the_next_state_is_the_action(tmp_path):
    read = opened(write_bag(tmp_path / "bag.mcap"), camera_every=3).episode(0)
    assert len(read.state) == 19
    assert np.array_equal(read.state[1:], read.action[:-1])
    assert read.image_steps.tolist() == [0, 3, 6, 9, 12, 15, 18]
    assert read.images == {}


def test_folders_of_files_and_of_split_bags(tmp_path):
    write_bag(tmp_path / "run_10.mcap")
    write_bag(tmp_path / "run_2.mcap")
    split = tmp_path / "split"
    split.mkdir()
    (split / "metadata.yaml").write_text("", encoding="utf-8")
    for number in (0, 1):
        with BagWriter(split / f"split_{number}.mcap") as bag:
            for tick in range(11):
                time = number + tick / 10
                bag.write("/joint_states", "sensor_msgs/msg/JointState", time, joints(time))
                bag.write(
                    "/camera",
                    "sensor_msgs/msg/CompressedImage",
                    time,
                    {"format": "png", "data": png(grey(time))},
                )
    source = opened(tmp_path, max_gap_s=0.2, max_skew_s=0.06)
    assert [source.episode(index).name for index in range(3)] == ["run_2", "run_10", "split"]
    assert len(source.episode(2).state) == 40
    assert len(opened(tmp_path, max_gap_s=0.2, max_skew_s=0.06, episodes=[1])) == 1
    assert len(opened([str(tmp_path / "run_2.mcap")])) == 1


def test_marks_cut_a_bag_into_episodes_and_a_topic_says_the_instruction(tmp_path):
    with BagWriter(tmp_path / "long.mcap") as bag:
        texts = {0.5: ("/mark", "begin"), 0.6: ("/say", "first"), 1.5: ("/mark", "end")}
        texts |= {2.0: ("/mark", "begin"), 2.1: ("/say", "second"), 2.8: ("/mark", "end")}
        for tick in range(300):
            time = tick / 100
            bag.write("/joint_states", "sensor_msgs/msg/JointState", time, joints(time))
            if time in texts:
                topic, text = texts[time]
                bag.write(topic, "std_msgs/msg/String", time, {"data": text})
    marks = {"topic": "/mark", "start": "begin", "stop": "end"}
    changes = {"marks": marks, "instruction": None, "instruction_topic": "/say", "cameras": {}}
    source = opened(tmp_path / "long.mcap", **changes)
    first, second = source.episode(0), source.episode(1)
    assert (first.name, first.instructions) == ("long#0", ("first",))
    assert (second.name, second.instructions) == ("long#1", ("second",))
    assert first.state[0, 1] == pytest.approx(0.5)
    assert first.action[-1, 1] == pytest.approx(1.5)
    with pytest.raises(UserError, match=r"'begin' and 'never' in turn, found 'begin' twice"):
        opened(tmp_path / "long.mcap", **changes | {"marks": marks | {"stop": "never"}})


def test_raw_pictures_other_messages_and_several_publishers_of_one_topic(tmp_path):
    frame = np.arange(4 * 5 * 3, dtype=np.uint8).reshape(4, 5, 3)
    padded = np.concatenate([frame[..., ::-1].reshape(4, 15), np.full((4, 3), 9, np.uint8)], 1)
    raw = {
        "height": 4,
        "width": 5,
        "encoding": "bgr8",
        "is_bigendian": 0,
        "step": 18,
        "data": padded.tobytes(),
    }
    with BagWriter(tmp_path / "bag.mcap") as bag:
        for tick in range(21):
            time = tick / 20
            bag.write("/joint_states", "sensor_msgs/msg/JointState", time, joints(time))
            hand = {"name": ["hand"], "position": [time + 5], "velocity": [2.0], "effort": []}
            bag.write("/joint_states", "sensor_msgs/msg/JointState", time, hand)
            bag.write("/gripper", "test_msgs/msg/Gripper", time, {"fingers": [1.5, time], "note": "x"})
            bag.write("/camera", "sensor_msgs/msg/Image", time, raw)
    state = [
        *STATE,
        {"topic": "/joint_states", "field": "velocity", "channels": {"hand": "hand_speed [rad/s]"}},
        {"topic": "/gripper", "channels": {"fingers[1]": "gripper [m]"}},
    ]
    source = opened(tmp_path / "bag.mcap", state=state)
    read = source.episode(0, ("front",))
    assert source.robot.relative_to == (0, 1, 2, None)
    assert read.state[4].tolist() == pytest.approx([-0.2, 0.2, 2.0, 0.2])
    assert np.array_equal(read.images["front"][3], frame)


@pytest.mark.parametrize("first", [0, 3])
def test_video_is_decoded_from_its_first_message_on_or_refused(tmp_path, first):
    shades = [np.full((32, 48, 3), 20 + 10 * tick, np.uint8) for tick in range(21)]
    packets = h264(shades)
    assert len(packets) == len(shades)
    with BagWriter(tmp_path / "bag.mcap") as bag:
        for tick in range(first, 21):
            bag.write("/joint_states", "sensor_msgs/msg/JointState", tick / 20, joints(tick / 20))
            video = {"data": packets[tick], "format": "h264"}
            bag.write("/video", "foxglove_msgs/msg/CompressedVideo", tick / 20 + 0.3, video, delay_s=0.3)
    if first:
        with pytest.raises(UserError, match=r"bag\.mcap.*/video.*key frame"):
            opened(tmp_path / "bag.mcap", cameras={"front": "/video"})
        return
    source = opened(tmp_path / "bag.mcap", cameras={"front": "/video"}, camera_every=4)
    read = source.episode(0, ("front",))
    assert (source.robot.cameras[0].height, source.robot.cameras[0].width) == (32, 48)
    assert np.abs(read.images["front"].astype(int) - np.stack(shades)[:20:4]).max() <= 4


def test_the_clock_can_be_the_time_of_recording(tmp_path):
    with BagWriter(tmp_path / "bag.mcap") as bag:
        for tick in range(41):
            bag.write("/joint_states", "sensor_msgs/msg/JointState", tick / 20, joints(tick / 20), delay_s=5)
            bag.write("/command", "std_msgs/msg/Float64MultiArray", tick / 20, {"data": [0.0, tick]})
    with pytest.raises(UserError, match=r"time in common.*clock: log"):
        opened(tmp_path / "bag.mcap", action=COMMAND, cameras={})
    read = opened(tmp_path / "bag.mcap", action=COMMAND, cameras={}, clock="log").episode(0)
    assert read.state[4, 1] == pytest.approx(read.action[4, 1] / 20)


def test_gaps_and_skew_are_reported_and_refused_beyond_their_limits(tmp_path, caplog):
    path = write_bag(tmp_path / "gap.mcap", skip=(0.3, 0.6))
    with pytest.raises(UserError, match=r"gap\.mcap.*/joint_states.*0\.1 s.*0\.300 s.*max_gap_s"):
        opened(path)
    with caplog.at_level(logging.INFO):
        opened(path, max_gap_s=0.5)
    assert "largest gap 0.300 s (/joint_states)" in caplog.text
    slow = write_bag(tmp_path / "slow.mcap", camera_hz=4)
    with pytest.raises(UserError, match=r"slow\.mcap.*/camera.*0\.05 s.*max_skew_s"):
        opened(slow)
    assert len(opened(slow, max_skew_s=0.2)) == 1
    both = opened([str(path), str(slow)], max_skew_s=0.2, episodes=[1])
    assert both.episode(0).name == "slow"


def test_the_digest_follows_files_and_options(tmp_path):
    path = write_bag(tmp_path / "bag.mcap")
    before = opened(path).digest()
    assert opened(path).digest() == before
    assert opened(path, control_hz=10).digest() != before
    write_bag(path, end_s=1.1)
    assert opened(path).digest() != before


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"path": "/nowhere"}, ["/nowhere"]),
        ({"path": 3}, ["demos.path", "3"]),
        ({"path": []}, ["demos.path", "[]"]),
        ({"control_hz": 0}, ["demos.control_hz"]),
        ({"instruction": None}, ["demos.instruction", "sentence"]),
        ({"state": []}, ["demos.state"]),
        ({"state": [{"topic": "/joint_states"}]}, ["demos.state[0].channels"]),
        ({"state": [{"topic": "/joint_states", "channels": {"elbow": "elbow"}}]}, ["demos.state[0]", "unit", "elbow"]),
        ({"state": [STATE[0] | {"field": "speed"}]}, ["demos.state[0].field", "velocity"]),
        ({"state": [STATE[0] | {"field": "velocity"}]}, ["/joint_states", "velocity", "shoulder"]),
        (
            {"state": [{"topic": "/joint_states", "channels": {"wrist": "wrist [rad]"}}]},
            ["bag.mcap", "/joint_states", "wrist", "elbow"],
        ),
        (
            {"state": [{"topic": "/joint_states", "channels": {"elbow": "a [rad]", "wrist": "wrist [rad]"}}]},
            ["bag.mcap", "/joint_states", "wrist", "shoulder"],
        ),
        ({"state": [STATE[0] | {"topic": "/joints"}]}, ["bag.mcap", "/joints", "/joint_states (sensor_msgs"]),
        ({"action": [COMMAND[0] | {"channels": ["a [rad]"]}]}, ["/command", "array of 1 ", "found 2 numbers"]),
        ({"state": [STATE[0] | {"channels": ["a [rad]"]}]}, ["/joint_states", "found shoulder", "a mapping of"]),
        ({"state": [*STATE, *STATE]}, ["demos.state", "elbow, shoulder more than once"]),
        ({"state": ["/joint_states"]}, ["demos.state[0]", "mapping"]),
        ({"cameras": {"front": ["/camera"]}}, ["demos.cameras.front", "a text"]),
        ({"instruction": ""}, ["demos.instruction", "a sentence"]),
        ({"instruction": None, "instruction_topic": "/say"}, ["bag.mcap", "/say", "/camera (sensor_msgs"]),
        ({"marks": {"topic": "/mark", "start": "a", "stop": "b"}}, ["bag.mcap", "/mark", "/camera (sensor_msgs"]),
        ({"marks": "/mark"}, ["demos.marks", "mapping"]),
        ({"cameras": {"front": "/video"}}, ["bag.mcap", "/video", "/camera"]),
        ({"cameras": {"front": "/command"}}, ["bag.mcap", "/command", "not supported", "Float64MultiArray"]),
        ({"cameras": ["/camera"]}, ["demos.cameras", "mapping"]),
        ({"absolute": ["hand"]}, ["demos.absolute", "hand", "elbow"]),
        ({"episodes": [1]}, ["demos.episodes", "below 1"]),
        ({"marks": {"topic": "/mark"}}, ["demos.marks.start"]),
        ({"clock": "sim"}, ["demos.clock", "log"]),
    ],
)  # fmt: skip
def test_options_that_do_not_fit_are_refused_by_file_and_key(tmp_path, changes, words):
    path = write_bag(tmp_path / "bag.mcap")
    with pytest.raises(UserError) as error:
        opened(path, **changes) if "path" not in changes else opened(**changes)
    assert all(word in str(error.value) for word in words), str(error.value)


def cut(path):
    path.write_bytes(path.read_bytes()[:-300])


def flip(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 255
    path.write_bytes(data)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (cut, ["bag.mcap", "cut off"]),
        (flip, ["bag.mcap", "whole MCAP"]),
        (lambda path: path.write_bytes(b""), ["bag.mcap", "whole MCAP"]),
        (lambda path: path.write_bytes(MAGIC + MAGIC), ["bag.mcap", "whole MCAP"]),
        (lambda path: path.rename(path.with_name("bag.mcap.zstd")), ["not supported", "zstd -d"]),
        (lambda path: path.rename(path.with_name("bag_0.db3")), ["not supported", "ros2 bag convert"]),
        (lambda path: path.unlink(), ["demos.path", "none"]),
    ],
)
def test_damaged_files_and_those_that_are_not_supported_are_told_apart(tmp_path, damage, words):
    damage(write_bag(tmp_path / "bag.mcap"))
    with pytest.raises(UserError) as error:
        opened(tmp_path)
    assert all(word in str(error.value) for word in words), str(error.value)
    assert "delete" not in str(error.value)


def test_numbers_and_pictures_that_do_not_fit_are_refused(tmp_path):
    with BagWriter(tmp_path / "nan.mcap") as bag:
        for tick in range(5):
            bag.write(
                "/joint_states",
                "sensor_msgs/msg/JointState",
                tick,
                joints(0.0) | {"position": [0.0, 0.0, np.nan]},
            )
    with pytest.raises(UserError, match=r"nan\.mcap.*/joint_states.*finite"):
        opened(tmp_path / "nan.mcap", cameras={})
    both = [
        str(write_bag(tmp_path / name, size=size)) for name, size in (("a.mcap", (8, 8)), ("b.mcap", (8, 9)))
    ]
    with pytest.raises(UserError, match=r"b\.mcap.*/camera.*8 x 8.*8 x 9"):
        opened(both)
    for image, words in (
        ({"encoding": "16UC1"}, "16UC1"),
        ({"data": b"12"}, "2 bytes"),
        ({"step": 1}, "step 1"),
    ):
        raw = {
            "height": 2,
            "width": 2,
            "encoding": "rgb8",
            "is_bigendian": 0,
            "step": 6,
            "data": bytes(12),
        } | image
        with BagWriter(tmp_path / "raw.mcap") as bag:
            bag.write("/joint_states", "sensor_msgs/msg/JointState", 0, joints(0.0))
            bag.write("/camera", "sensor_msgs/msg/Image", 0, raw)
        with pytest.raises(UserError, match=rf"raw\.mcap.*/camera.*{words}"):
            opened(tmp_path / "raw.mcap")
