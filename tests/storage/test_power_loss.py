"""Every writer, and a loss of power at every moment: the old content or the new one is read, and nothing between."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from fakes import FakeEnvironment, known_actions
from losing_disk import watch
from synthetic import write_demonstrations, write_episode
from synthetic_runs import episodes_of

from imfvla.data import FrameStore
from imfvla.episode import Decision
from imfvla.errors import UserError
from imfvla.recording import read_episode, write_mp4
from imfvla.reporting.episodes import read_episodes
from imfvla.rollouts.rollout_log import PARTIAL, RolloutLog
from imfvla.sources import collection
from imfvla.sources.mcap import McapSource
from imfvla.sources.mcap_writer import McapWriter
from imfvla.storage.files import clear_folder, copy_file, write_json, write_text, write_together
from imfvla.storage.run_directory import RunDirectory

ROWS = episodes_of(0.6, 100_000, 3, task="socket", latency_ms=6.0)
SMALL = {"views": ("front",), "image_size": (16, 16)}


def survives(tmp_path, write, read):
    """The number of crashes of `write(root)` after each of which `read(root)` gives what was before or after it."""
    root = tmp_path / "root"
    root.mkdir(exist_ok=True)
    before = read(root)
    with watch(root, tmp_path / "crashes") as disk:
        write(root)
    after = read(root)
    assert after != before
    *earlier, forced, kept = disk.images
    assert read(forced) == read(kept) == after
    for image in earlier:
        assert read(image) in (before, after), image
    return len(disk.images)


def text_of(path):
    return path.read_text() if path.exists() else None


@pytest.mark.parametrize("name", ["config.yaml", "new/folders/too.md"])
def test_texts(tmp_path, name):
    (tmp_path / "root").mkdir()
    (tmp_path / "root" / "config.yaml").write_text("old")
    survives(tmp_path, lambda root: write_text(root / name, "new"), lambda root: text_of(root / name))


def test_the_harness_finds_a_name_that_comes_before_its_content(tmp_path):
    def careless(root):
        (root / ".x").write_text("new")
        (root / ".x").replace(root / "x")

    with pytest.raises(AssertionError):
        survives(tmp_path, careless, lambda root: text_of(root / "x"))


def test_status(tmp_path):
    run = RunDirectory(tmp_path / "root")
    run.write_status("running", step=1)
    survives(tmp_path, lambda root: run.write_status("done"), lambda root: RunDirectory(root).status())


def test_a_copy(tmp_path):
    (tmp_path / "a.log").write_text("new")
    read = lambda root: text_of(root / "media" / "a.log")  # noqa: E731
    survives(tmp_path, lambda root: copy_file(tmp_path / "a.log", root / "media" / "a.log"), read)


def test_a_publication_has_every_file_whole(tmp_path):
    files = {"a.md": (b"old a", b"new a"), "figures/b.svg": (None, b"new b")}
    root = tmp_path / "root"
    root.mkdir()
    (root / "a.md").write_bytes(b"old a")
    with watch(root, tmp_path / "crashes") as disk:
        write_together({root / name: new for name, (_, new) in files.items()})
    for image in disk.images:
        for name, contents in files.items():
            path = image / name
            assert (path.read_bytes() if path.exists() else None) in contents
    assert all((disk.images[-2] / name).read_bytes() == new for name, (_, new) in files.items())


def actions_of(path):
    return read_episode(path).action.tolist() if path.exists() else None


@pytest.mark.parametrize("is_new", [True, False])
def test_a_recording(tmp_path, is_new):
    if not is_new:
        write_episode(tmp_path / "root" / "a.mcap", 1, num_steps=2, **SMALL)
    write = lambda root: write_episode(root / "a.mcap", 2, num_steps=2, **SMALL)  # noqa: E731
    survives(tmp_path, write, lambda root: actions_of(root / "a.mcap"))


class Demonstrator:
    """Does what is known."""

    def reset(self, env, seed):
        self.actions = known_actions(40)

    def act(self, env, state, step):
        return Decision(self.actions[step], self.actions[step])


def test_a_demonstration(tmp_path, monkeypatch):
    monkeypatch.setattr(collection, "_stage_for", lambda settings: (FakeEnvironment(), Demonstrator()))
    settings = SimpleNamespace(camera_every=8, to_json=dict)
    seed = next(seed for seed in range(8) if collection.record_demonstration(settings, tmp_path, seed)[1])
    write = lambda root: collection.record_demonstration(settings, root, seed)  # noqa: E731
    survives(tmp_path, write, lambda root: actions_of(collection.recording_path(root, seed)))


def test_a_video(tmp_path):
    frames = np.zeros((2, 32, 32, 3), np.uint8)

    def read(root):
        return (root / "a.mp4").read_bytes() if (root / "a.mp4").exists() else None

    survives(tmp_path, lambda root: write_mp4(root / "a.mp4", frames, 10), read)


@pytest.mark.parametrize("is_new", [True, False])
def test_a_frame_store_never_has_other_pictures_than_it_states(tmp_path, is_new):
    demonstrations = write_demonstrations(tmp_path / "demos", num_episodes=2, num_steps=4)
    source = McapSource.of(demonstrations)
    if not is_new:
        FrameStore.build(source, tmp_path / "root" / "store", (8, 8), ("front",))

    def read(root):
        clear_folder(root / "store")  # as the next build does
        if not (root / "store").exists():
            return None
        store = FrameStore.open(root / "store")
        return store.image_size, store.images.sum(), store.state.tolist(), store.action.tolist()

    write = lambda root: FrameStore.build(source, root / "store", (16, 16), ("top",))  # noqa: E731
    survives(tmp_path, write, read)


def test_a_converted_data_set(tmp_path):
    source = McapSource.of(write_demonstrations(tmp_path / "demos", num_episodes=2, num_steps=4))

    def write(root):
        with McapWriter(root / "set", source.robot) as writer:
            for index in range(2):
                writer.add(source.episode(index, ("front", "top", "r_wrist")))

    def read(root):
        return [actions_of(path) for path in sorted((root / "set").glob("*"))]

    survives(tmp_path, write, read)


def evaluate(folder, rows, summary=None, **options):
    """An evaluation that ends with a `summary`, or is interrupted after its rows."""
    with RolloutLog(folder, {"nfe": 1}, **options) as log:
        log.begin()
        for row in rows[len(log.rows) :]:
            log.append(row)
        if summary:
            log.finish(rows, {"protocol": {"nfe": 1}, **summary})


def test_rows_of_an_evaluation(tmp_path):
    def read(folder):
        if (folder / "summary.json").exists():
            return "summary", len(read_episodes(folder / "episodes.jsonl", range(100_000, 100_003)))
        partial = text_of(folder / PARTIAL) or ""
        return "partial", max(0, partial.count("\n") - 1)

    (tmp_path / "root").mkdir()
    with watch(tmp_path / "root", tmp_path / "crashes") as disk:
        evaluate(tmp_path / "root", ROWS[:1])
        evaluate(tmp_path / "root", ROWS, {"avg_return": 1.0})
    found = [read(image) for image in disk.images]
    forced = [count for _, count in found[::2]]
    assert forced == sorted(forced)  # a row that was appended is not lost
    assert set(forced) == {0, 1, 2, 3}
    assert found[-2:] == [("summary", 3)] * 2


def test_a_repeated_evaluation_never_shows_an_old_summary_beside_new_rows(tmp_path):
    old, new = ([row | {"total_reward": number} for row in ROWS] for number in (0.5, 1.5))
    evaluate(tmp_path / "root", old, {"avg_return": 0.5})
    with watch(tmp_path / "root", tmp_path / "crashes") as disk:
        evaluate(tmp_path / "root", new, {"avg_return": 1.5}, overwrite=True)
    for image in disk.images:
        if (image / "summary.json").exists():
            first = read_episodes(image / "episodes.jsonl", range(100_000, 100_003))[0]
            assert json.loads(text_of(image / "summary.json"))["avg_return"] == first["total_reward"]


def test_the_list_of_failed_seeds(tmp_path):
    def read(root):
        return text_of(root / "collection.json")

    survives(tmp_path, lambda root: write_json(root / "collection.json", {"failed_seeds": [1]}), read)


def test_a_store_that_shrank_is_refused(tmp_path):
    source = McapSource.of(write_demonstrations(tmp_path / "demos", num_episodes=1, num_steps=4))
    for name in ("images.raw", "state.npy", "action.npy", "image_steps.npy"):
        for change in (-1, 1):
            store = FrameStore.build(source, tmp_path / f"{name}{change}", (8, 8), ("front",))
            path = store.path / name
            size = path.stat().st_size
            with open(path, "r+b") as stream:
                stream.truncate(size + change)
            with pytest.raises(UserError, match="cannot be read"):
                FrameStore.open(store.path)
