"""The command-line tools for recordings, and the Foxglove layout against what is recorded."""

import json
import re
import runpy
import sys
from pathlib import Path

import av
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from synthetic import write_episode

TOOLS = Path(__file__).parents[2] / "tools"


def run(tool: str, *arguments: object) -> int:
    """Exit status of a tool, without `begin`, which would take over this process's streams and signals."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("imfvla.command.begin", lambda: None)
        patch.setattr(sys, "argv", [tool, *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            runpy.run_path(str(TOOLS / tool), run_name="__main__")
    return ended.value.code or 0


def test_check_accepts_whole_recordings(synthetic_demonstrations, capsys):
    assert run("mcap_check.py", synthetic_demonstrations) == 0
    assert "3 of 3 files ok" in capsys.readouterr().out


def test_check_names_the_broken_one(synthetic_demonstrations, capsys):
    broken = synthetic_demonstrations / "episode-00001.mcap"
    broken.write_bytes(broken.read_bytes()[:-100])
    assert run("mcap_check.py", synthetic_demonstrations) == 1
    out = capsys.readouterr().out
    assert re.search(r"FAIL .*episode-00001\.mcap", out)
    assert "2 of 3 files ok" in out


def test_check_continues_after_files_of_others(synthetic_demonstrations, capsys):
    with (synthetic_demonstrations / "a.mcap").open("wb") as stream:
        writer = Writer(stream, use_statistics=False)
        writer.start()
        writer.finish()
    (synthetic_demonstrations / "b.mcap").write_text("not one")
    (synthetic_demonstrations / "c.mcap").mkdir()
    assert run("mcap_check.py", synthetic_demonstrations) == 1
    assert "3 of 6 files ok" in capsys.readouterr().out


def test_check_of_nothing_fails(tmp_path):
    assert run("mcap_check.py", tmp_path) == 1


def test_export_makes_a_video_of_the_recorded_frames(synthetic_demonstrations):
    source = synthetic_demonstrations / "episode-00000.mcap"
    assert run("mcap_to_mp4.py", source) == 0
    with av.open(str(source.with_suffix(".mp4"))) as container:
        assert container.streams.video[0].average_rate == 25
        assert sum(1 for _ in container.decode(video=0)) == 12


def test_export_plays_in_real_time_whenever_the_policy_looked(tmp_path):
    write_episode(tmp_path / "a.mcap", 0, num_steps=40, camera_every=16)
    assert run("mcap_to_mp4.py", tmp_path / "a.mcap") == 0
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert container.streams.video[0].average_rate == 12.5
        pictures = [frame.to_ndarray(format="rgb24")[:-30] for frame in container.decode(video=0)]
    assert len(pictures) == 10
    changes = [
        step for step in range(1, 10) if np.abs(pictures[step] - pictures[step - 1].astype(int)).max() > 64
    ]
    assert changes == [4, 8]


@pytest.mark.parametrize("target", ["a.mp4", "film.mp4", "a.mcap"])
def test_export_overwrites_nothing_unasked(tmp_path, capsys, target):
    for name in ("a.mcap", "b.mcap"):
        write_episode(tmp_path / name, 0, num_steps=4)
    there = tmp_path / target
    if target != "a.mcap":
        there.write_bytes(b"the evaluation's own")
    before = there.read_bytes()
    if target == "a.mp4":
        assert run("mcap_to_mp4.py", tmp_path / "b.mcap", tmp_path / "a.mcap") == 2
        assert not (tmp_path / "b.mp4").exists()
    else:
        assert run("mcap_to_mp4.py", tmp_path / "a.mcap", "-o", there) == 2
    assert target in capsys.readouterr().err
    assert there.read_bytes() == before


def test_export_replaces_a_video_where_asked(synthetic_demonstrations):
    source = synthetic_demonstrations / "episode-00000.mcap"
    source.with_suffix(".mp4").write_bytes(b"old")
    assert run("mcap_to_mp4.py", source, "--overwrite") == 0
    assert source.with_suffix(".mp4").stat().st_size > 1000


def test_export_of_a_broken_recording_says_so(synthetic_demonstrations, capsys):
    source = synthetic_demonstrations / "episode-00000.mcap"
    source.write_bytes(source.read_bytes()[:500])
    assert run("mcap_to_mp4.py", source) == 2
    assert "episode-00000.mcap is truncated" in capsys.readouterr().err
    assert not source.with_suffix(".mp4").exists()


def test_the_layout_shows_what_is_recorded(synthetic_demonstrations):
    layout = json.loads((TOOLS / "foxglove_layout.json").read_text())
    messages = {}
    with (synthetic_demonstrations / "episode-00000.mcap").open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages():
            messages[channel.topic] = json.loads(message.data)
    panels = layout["configById"]
    shown = set(re.findall(r'"([A-Za-z0-9]+![a-z_]+)"', json.dumps(layout["layout"])))
    assert shown == set(panels)
    assert {panel["imageMode"]["imageTopic"] for name, panel in panels.items() if "Image!" in name} <= set(
        messages
    )
    assert set(panels["3D!scene"]["topics"]) <= set(messages)
    paths = [path["value"] for panel in panels.values() for path in panel.get("paths", [])]
    for topic, *names in (path.split(".") for path in paths if not path.startswith("/policy/")):
        value = messages[topic]
        for name in names:
            value = value[name]
        assert isinstance(value, int | float)
