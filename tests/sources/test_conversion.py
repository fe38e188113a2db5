"""python -m imfvla.convert: every source into every target, all episodes or none."""

import re
import resource
import signal
from importlib import import_module

import numpy as np
import pytest
import yaml

pytest.importorskip("pyarrow", reason="needs the extra lerobot")
from outside import EEF_ACTION, EEF_STATE, ROBOT, episode, options, write_robomimic

from imfvla.command.composition import CONFIG_DIRECTORY, compose
from imfvla.command.line import in_hydras_words
from imfvla.convert import main
from imfvla.errors import UserError
from imfvla.recording import read_episode
from imfvla.sources import conversion
from imfvla.sources.lerobot import LeRobotWriter
from imfvla.sources.lerobot import open_source as open_lerobot

LENGTHS = (6, 4)


@pytest.fixture(scope="module")
def data_set(tmp_path_factory):
    path = tmp_path_factory.mktemp("made") / "set"
    with LeRobotWriter(path, ROBOT, pictures="png") as writer:
        for number, length in enumerate(LENGTHS):
            writer.add(episode(number, length))
    return path


def test_from_lerobot_to_recordings(data_set, tmp_path, capsys):
    main(["from=lerobot", f"from.path={data_set}", "to=mcap", f"to.path={tmp_path / 'recordings'}"])
    assert "2 episodes, 10 steps." in capsys.readouterr().out
    read = read_episode(tmp_path / "recordings" / "episode-000001.mcap")
    assert np.array_equal(read.action, episode(1, 4).action)


def test_from_recordings_to_lerobot(data_set, tmp_path):
    pytest.importorskip("imfvla.sources.mcap", reason="the source of recordings is not there yet")
    main(["from=lerobot", f"from.path={data_set}", "to=mcap", f"to.path={tmp_path / 'recordings'}"])
    back = tmp_path / "back"
    main(
        [
            "from=mcap",
            f"from.path={tmp_path / 'recordings'}",
            "to=lerobot",
            f"to.path={back}",
            "to.pictures=png",
        ]
    )
    source = open_lerobot(options("lerobot", path=str(back)))
    assert source.robot == ROBOT
    for index, length in enumerate(LENGTHS):
        found, made = source.episode(index, ("front", "wrist")), episode(index, length)
        assert np.array_equal(found.state, made.state)
        assert found.instructions == made.instructions
        assert all(np.array_equal(found.images[view], made.images[view]) for view in made.images)


def test_from_hdf5_and_ros2_to_lerobot(tmp_path):
    pytest.importorskip("h5py", reason="needs the extra hdf5")
    pytest.importorskip("mcap_ros2", reason="needs the extra ros2")
    from bags import write_bag

    chosen = tmp_path / "mine"
    (chosen / "from").mkdir(parents=True)
    mapped = {
        "state": EEF_STATE,
        "action": EEF_ACTION,
        "layout": "robomimic",
        "control_hz": 20,
        "instruction": "lift",
    }
    joints = {"shoulder": "shoulder [rad]", "elbow": "elbow [rad]"}
    bag = {"state": [{"topic": "/joint_states", "channels": joints}], "cameras": {"front": "/camera"}}
    bag |= {"control_hz": 20, "instruction": "go", "path": str(write_bag(tmp_path / "bag.mcap"))}
    for name, kind, values in (("lift", "hdf5", mapped), ("mine", "ros2", bag)):
        written = {"defaults": [f"/demos/{kind}@_here_", "_self_"], **values}
        (chosen / "from" / f"{name}.yaml").write_text(yaml.safe_dump(written), encoding="utf-8")
    demo = write_robomimic(tmp_path / "demo.hdf5")
    to = ["to=lerobot", "to.pictures=png", "--config-dir", str(chosen)]
    main(["from=lift", f"from.path={demo}", f"to.path={tmp_path / 'lifted'}", *to])
    main(["from=mine", f"to.path={tmp_path / 'gone'}", *to])
    assert (tmp_path / "lifted" / "meta" / "info.json").exists()
    assert (tmp_path / "gone" / "meta" / "info.json").exists()


def test_every_source_has_its_options_in_one_place():
    for kind in conversion.READERS:
        if not (CONFIG_DIRECTORY / "demos" / f"{kind}.yaml").exists():
            continue  # comes with the source of recordings
        given = {"control_hz": 1, "state": "x", "action": "[x]", "layout": "act", "instruction": "x"}
        demos = yaml.safe_load((CONFIG_DIRECTORY / "demos" / f"{kind}.yaml").read_text(encoding="utf-8"))
        given = [f"from.{key}={value}" for key, value in given.items() if demos.get(key) == "???"]
        config = compose("convert", [f"from={kind}", "to=mcap", "from.path=x", "to.path=y", *given])
        assert config["from"].keys() == demos.keys()
        assert config["from"]["source"] == kind


def test_errors_leave_nothing(data_set, tmp_path, capsys, monkeypatch):
    broken = tmp_path / "broken"
    with LeRobotWriter(broken, ROBOT, pictures="png") as writer:
        writer.add(episode(0, 4))
        writer.add(episode(1, 4))
    table = next(broken.glob("data/*/*.parquet"))
    table.write_bytes(table.read_bytes()[:-20])
    for arguments, words in (
        ([f"from.path={broken}", f"to.path={tmp_path / 'new'}"], "parquet"),
        ([f"from.path={data_set}", f"to.path={broken}"], "exists already"),
        ([f"from.path={tmp_path / 'none'}", f"to.path={tmp_path / 'new'}"], "no folder"),
        (
            [f"from.path={data_set}", "from.frames_directory=x", f"to.path={tmp_path / 'new'}"],
            "frames_directory",
        ),
    ):
        with pytest.raises(SystemExit, match="2"):
            main(["from=lerobot", "to=mcap", *arguments])
        assert words in capsys.readouterr().err
        assert sorted(path.name for path in tmp_path.iterdir()) == ["broken"]


@pytest.mark.parametrize(
    "target", [["to=mcap"], ["to=lerobot", "to.pictures=h264"], ["to=lerobot", "to.pictures=png"]]
)
def test_a_full_disk_leaves_nothing(data_set, tmp_path, capsys, target):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (3000, before[1]))
    try:
        with pytest.raises(SystemExit, match="2"):
            main(["from=lerobot", f"from.path={data_set}", f"to.path={tmp_path / 'new'}", *target])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    assert "too large" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["arm", "lift"])
def test_the_examples_of_the_documents_are_right_up_to_their_paths(name):
    text = (CONFIG_DIRECTORY.parent / "docs" / "data.md").read_text(encoding="utf-8")
    example = yaml.safe_load(
        re.search(rf"```yaml\n# mine/demos/{name}.yaml\n(.*?)```", text, re.DOTALL).group(1)
    )
    kind = example.pop("defaults")[0]
    pytest.importorskip({"ros2": "mcap_ros2", "hdf5": "h5py"}[kind], reason=f"needs the extra {kind}")
    with pytest.raises(UserError, match=example["path"]):
        import_module(f"imfvla.sources.{kind}").open_source(options(kind, **example))


def test_a_command_without_source_or_target_says_what_there_is(capsys):
    for arguments, words in (
        ([], "from=lerobot from.path=FOLDER to=mcap"),
        (["from=lerobot"], "to=<OPTION>"),
        (["from=zarr", "to=mcap"], "hdf5, lerobot, mcap, ros2"),
        (["from=lerobot", "to=mcap", "to.path=x"], "from.path"),
    ):
        with pytest.raises(SystemExit, match="2"):
            main(arguments)
        assert words in capsys.readouterr().err


@pytest.mark.parametrize(
    ("source", "target", "words"),
    [
        ({"source": "os"}, {"format": "mcap", "path": "x"}, "from.source"),
        ({"source": "lerobot"}, {"format": "zip", "path": "x"}, "to.format"),
        ({"source": "lerobot"}, {"format": "mcap", "path": ""}, "to.path"),
        ({"source": "lerobot"}, {"format": "lerobot", "path": "x", "pictures": "gif"}, "to.pictures"),
    ],
)
def test_options_are_checked_before_anything_is_read(source, target, words):
    with pytest.raises(UserError, match=words):
        conversion.convert(source, target)


def test_paths_are_taken_literally_and_lists_of_them_stay_lists():
    assert in_hydras_words(["from.path=/data/a=b, c"]) == ["from.path='/data/a=b, c'"]
    assert in_hydras_words(["from.path=[a.mcap,b.mcap]"]) == ["from.path=[a.mcap,b.mcap]"]
