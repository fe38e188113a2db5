"""An episode comes back from its file exactly, or not at all."""

import json
import resource
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zstandard
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Chunk, Message, Metadata
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, IndexType, Writer
from synthetic import StillScene, synthetic_actions, write_episode

from imfvla.episode import Decision, EpisodeInfo, EpisodeResult, Step
from imfvla.errors import UserError
from imfvla.recording import McapSink, TruncatedRecording, read_episode, read_index
from imfvla.tasks.bimanual_robot import bimanual_robot

VIEWS = ("front", "top")
INFO = EpisodeInfo(
    task="socket",
    kind="rollout",
    seed=100_003,
    start_digest="0123456789abcdef",
    instruction="insert the peg",
    views=VIEWS,
    robot=bimanual_robot(VIEWS, (16, 24)),
    config={"name": "run", "horizon": {"pred": 32}, "sizes": [1, 2.5, None]},
    metadata={"nfe": 2, "style": {"speed": np.float32(0.5)}},
)
RESULT = EpisodeResult(
    seed=100_003,
    start_digest="0123456789abcdef",
    num_steps=6,
    total_reward=7.0,
    max_reward=2.0,
    success=False,
    first_step_of_stage=(1, 4, -1),
    failure=None,
    inference_ms=(3.25, 4.5),
    wall_s=0.75,
)


@pytest.fixture
def scene() -> StillScene:
    return StillScene(INFO.robot)


def steps(num_steps: int = 6) -> list[Step]:
    """Steps with float32 of all magnitudes, a chunk and frames at steps 0 and 4."""
    rng = np.random.default_rng(0)
    result = []
    for index in range(num_steps):
        state, action, executed = (
            rng.standard_normal((3, 16)) * 10.0 ** rng.integers(-30, 30, (3, 16))
        ).astype(np.float32)
        decision = Decision(action, executed)
        if index % 4 == 0:
            images = {view: rng.integers(0, 256, (16, 24, 3), dtype=np.uint8) for view in VIEWS}
            chunk = rng.standard_normal((8, 16)).astype(np.float32)
            decision = replace(decision, images=images, chunk=chunk, inference_ms=3.5)
        result.append(Step(index, index / 50, state, decision, float(index), index // 2))
    return result


def record(path: Path, scene: StillScene, episode: list[Step], **sink_options) -> None:
    sink = McapSink(path, **sink_options)
    sink.begin(scene, INFO)
    for step in episode:
        sink.step(scene, step)
    sink.end(replace(RESULT, num_steps=len(episode)))


def assert_conforms(value: object, schema: dict) -> None:
    """Checks what of JSON Schema the recordings use."""
    kinds = {
        "object": dict,
        "array": list,
        "number": (int, float),
        "integer": int,
        "string": str,
        "boolean": bool,
    }
    assert isinstance(value, kinds[schema["type"]])
    if isinstance(value, dict):
        for name, part in value.items():
            assert_conforms(part, schema["properties"][name])
    if isinstance(value, list):
        for part in value:
            assert_conforms(part, schema["items"])


def leftovers(directory: Path) -> list[str]:
    return sorted(file.name for file in directory.iterdir())


def test_an_episode_comes_back_exactly(tmp_path, scene):
    episode = steps()
    record(tmp_path / "a.mcap", scene, episode)
    read = read_episode(tmp_path / "a.mcap")
    assert read.info == replace(INFO, metadata={"nfe": 2, "style": {"speed": 0.5}})
    assert read.result == RESULT
    np.testing.assert_array_equal(read.state, [step.state for step in episode])
    np.testing.assert_array_equal(read.action, [step.decision.action for step in episode])
    np.testing.assert_array_equal(read.executed, [step.decision.executed for step in episode])
    np.testing.assert_array_equal(read.reward, [step.reward for step in episode])
    np.testing.assert_array_equal(read.stage, [step.stage for step in episode])
    np.testing.assert_allclose(read.time_s, [step.time_s for step in episode], atol=1e-9)
    assert read.state.dtype == read.action.dtype == np.float32
    assert read.image_steps.tolist() == [0, 4]
    assert list(read.chunks) == [0, 4]
    for row, step in enumerate((0, 4)):
        np.testing.assert_array_equal(read.chunks[step], episode[step].decision.chunk)
        for view in VIEWS:
            np.testing.assert_array_equal(read.images[view][row], episode[step].decision.images[view])


def test_rendered_frames_show_the_state_before_the_action(tmp_path):
    write_episode(tmp_path / "a.mcap", 7, num_steps=9, views=VIEWS, image_size=(16, 24), camera_every=2)
    read = read_episode(tmp_path / "a.mcap")
    scene = StillScene(INFO.robot)
    assert read.image_steps.tolist() == [0, 2, 4, 6, 8]
    for row, step in enumerate(read.image_steps):
        scene.position = read.state[step, 0]
        for view, frame in scene.look().items():
            np.testing.assert_array_equal(read.images[view][row], frame)


def test_frames_of_the_actor_go_before_rendered_ones(tmp_path, scene):
    episode = steps()
    record(tmp_path / "a.mcap", scene, episode, render_every=2)
    read = read_episode(tmp_path / "a.mcap", images=("top",))
    assert read.image_steps.tolist() == [0, 2, 4]
    np.testing.assert_array_equal(read.images["top"][2], episode[4].decision.images["top"])
    np.testing.assert_array_equal(read.images["top"][1], scene.look()["top"])


def test_equal_episodes_make_equal_files(tmp_path, scene):
    for name in ("a.mcap", "b.mcap"):
        record(tmp_path / name, scene, steps())
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_numbers_that_are_not_finite_come_back(tmp_path, scene):
    episode = steps(1)
    chunk = np.full((2, 16), np.inf, np.float32)
    episode[0] = replace(episode[0], decision=replace(episode[0].decision, chunk=chunk))
    record(tmp_path / "a.mcap", scene, episode)
    assert np.isnan(read_episode(tmp_path / "a.mcap").chunks[0]).all()


def test_steps_that_are_not_to_be_imitated_come_back_and_are_no_topic_where_nothing_is_said(tmp_path, scene):
    said = (False, False, True, True, False, True)
    episode = [
        replace(step, decision=replace(step.decision, imitate=flag))
        for step, flag in zip(steps(), said, strict=True)
    ]
    record(tmp_path / "said.mcap", scene, episode)
    np.testing.assert_array_equal(read_episode(tmp_path / "said.mcap").imitate, said)
    record(tmp_path / "unsaid.mcap", scene, steps())
    assert read_episode(tmp_path / "unsaid.mcap").imitate is None
    assert b"/expert/imitate" in (tmp_path / "said.mcap").read_bytes()
    assert b"/expert/imitate" not in (tmp_path / "unsaid.mcap").read_bytes()
    episode[2] = replace(episode[2], decision=replace(episode[2].decision, imitate=None))
    record(tmp_path / "gap.mcap", scene, episode)
    with pytest.raises(UserError, match=r"gap\.mcap .*5 messages of /expert/imitate for 6 steps"):
        read_episode(tmp_path / "gap.mcap")


def test_lossy_frames_are_jpeg_and_close(tmp_path, scene):
    smooth = np.linspace(0, 255, 16 * 24 * 3).reshape(16, 24, 3).astype(np.uint8)
    episode = steps(1)
    decision = replace(episode[0].decision, images=dict.fromkeys(VIEWS, smooth))
    record(tmp_path / "a.mcap", scene, [replace(episode[0], decision=decision)], lossless=False)
    read = read_episode(tmp_path / "a.mcap").images["top"][0]
    assert 0 < np.abs(read.astype(int) - smooth).mean() < 8


def test_frames_are_decoded_only_where_asked_for(tmp_path, scene):
    record(tmp_path / "a.mcap", scene, steps())
    assert read_episode(tmp_path / "a.mcap", images=False).images == {}
    assert list(read_episode(tmp_path / "a.mcap", images=("top",)).images) == ["top"]
    with pytest.raises(UserError, match=r"a\.mcap has no frames of view side; it has front, top"):
        read_episode(tmp_path / "a.mcap", images=("side",))


def test_the_index_counts_without_reading(tmp_path, scene):
    record(tmp_path / "a.mcap", scene, steps())
    index = read_index(tmp_path / "a.mcap")
    assert (index.num_steps, index.num_frames) == (6, {"front": 2, "top": 2})
    assert index.num_bytes == (tmp_path / "a.mcap").stat().st_size
    changed = steps()
    changed[3] = replace(changed[3], reward=9.0)
    record(tmp_path / "b.mcap", scene, changed)
    assert read_index(tmp_path / "b.mcap").data_crc != index.data_crc


def test_messages_have_foxgloves_names(tmp_path, scene):
    record(tmp_path / "a.mcap", scene, steps())
    first, schemas = {}, {}
    with (tmp_path / "a.mcap").open("rb") as stream:
        reader = make_reader(stream)
        for schema, channel, message in reader.iter_messages():
            first.setdefault(channel.topic, json.loads(message.data))
            schemas[channel.topic] = schema.name
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            assert_conforms(json.loads(message.data), json.loads(schema.data))
        assert [attachment.name for attachment in reader.iter_attachments()] == ["config.json"]
        assert {record.name for record in reader.iter_metadata()} == {"imfvla.episode", "imfvla.result"}
    assert schemas["/camera/front"] == "foxglove.CompressedImage"
    assert schemas["/tf"] == "foxglove.FrameTransforms"
    assert schemas["/scene"] == "foxglove.SceneUpdate"
    assert schemas["/episode/log"] == "foxglove.Log"
    assert set(first["/camera/front"]) == {"timestamp", "frame_id", "data", "format"}
    assert first["/camera/front"]["format"] == "png"
    assert set(first["/robot/state"]["left"]) == {f"joint_{i}" for i in range(1, 8)} | {"gripper"}
    assert set(first["/robot/action"]) == {"clean", "executed"}


@pytest.mark.parametrize("kept", [0, 1, 5, 8, 100, 0.3, 0.6])
def test_a_truncated_file_is_refused_by_name(tmp_path, scene, kept):
    path = tmp_path / "cut.mcap"
    record(path, scene, steps())
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * kept) if isinstance(kept, float) else kept])
    for read in (read_episode, read_index):
        with pytest.raises(TruncatedRecording, match=r"cut\.mcap is truncated \(its data end .* delete it"):
            read(path)


@pytest.mark.parametrize("lost", [200, 60, 20, 1])
def test_data_that_may_be_whole_is_not_to_be_deleted(tmp_path, scene, lost):
    path = tmp_path / "cut.mcap"
    record(path, scene, steps())
    path.write_bytes(path.read_bytes()[:-lost])
    for read in (read_episode, read_index):
        with pytest.raises(TruncatedRecording, match=r"cut\.mcap is truncated after its data") as told:
            read(path)
        assert "delete" not in str(told.value)


@pytest.mark.parametrize("place", np.linspace(0.001, 0.5, 12))
def test_a_flipped_bit_is_noticed(tmp_path, scene, place):
    path = tmp_path / "flipped.mcap"
    record(path, scene, steps())
    data = bytearray(path.read_bytes())
    data[int(place * len(data))] ^= 16
    path.write_bytes(data)
    with pytest.raises(UserError, match=r"flipped\.mcap is damaged .* restore it") as told:
        read_episode(path)
    assert "delete" not in str(told.value)


def compress_without_size(data: bytes) -> bytes:
    """As Foxglove's SDK does: the zstd frame does not say how long its content is."""
    return zstandard.ZstdCompressor(write_content_size=False).compress(data)


@pytest.mark.parametrize(
    "options",
    [
        {"compression": CompressionType.ZSTD},
        {"compression": CompressionType.LZ4},
        {"compression": CompressionType.NONE},
        {"use_chunking": False},
        {"use_statistics": False},
        {"enable_crcs": False, "enable_data_crcs": False},
        {"index_types": IndexType.NONE, "use_summary_offsets": False},
        {
            "index_types": IndexType.NONE, "use_summary_offsets": False, "use_statistics": False,
            "repeat_channels": False, "repeat_schemas": False,
        },
    ],
    ids=lambda options: ",".join(options),
)  # fmt: skip
def test_an_episode_that_another_library_wrote_comes_back(tmp_path, scene, monkeypatch, options):
    source, copy = tmp_path / "a.mcap", tmp_path / "b.mcap"
    record(source, scene, steps())
    monkeypatch.setattr("mcap.writer.zstandard.compress", compress_without_size)
    rewrite(source, copy, **options)
    before, after = read_episode(source), read_episode(copy)
    assert (after.info, after.result) == (before.info, before.result)
    for name in ("time_s", "state", "action", "executed", "reward", "stage", "image_steps"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    for view in VIEWS:
        np.testing.assert_array_equal(after.images[view], before.images[view])
    index, found = read_index(source), read_index(copy)
    assert (found.num_steps, found.num_frames, found.info) == (index.num_steps, index.num_frames, index.info)
    rewrite(source, copy, **options, changed=b"4.0")
    assert read_index(copy).num_bytes == found.num_bytes or options.get("compression") is not None
    assert read_index(copy).data_crc != found.data_crc


def rewrite(source: Path, target: Path, changed: bytes = b"3.0", **options) -> None:
    """Writes a recording again with other options of a writer, and `changed` for a reward of 3.0."""
    with target.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start()
        channels: dict[int, int] = {}
        for record in StreamReader(source.open("rb")).records:
            if isinstance(record, Metadata):
                writer.add_metadata(record.name, record.metadata)
            elif isinstance(record, Attachment):
                writer.add_attachment(0, 0, record.name, record.media_type, record.data)
            elif isinstance(record, Channel) and record.id not in channels:
                schema = writer.register_schema(record.topic, "jsonschema", b"{}")
                channels[record.id] = writer.register_channel(record.topic, "json", schema)
            elif isinstance(record, Message):
                data = record.data.replace(b'"reward":3.0', b'"reward":' + changed)
                writer.add_message(channels[record.channel_id], record.log_time, data, record.log_time)
        writer.finish()


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4])
@pytest.mark.parametrize("stated", [-1, 1])
def test_a_chunk_of_another_size_than_stated_is_refused(tmp_path, scene, monkeypatch, compression, stated):
    record(tmp_path / "a.mcap", scene, steps())
    write = Chunk.write

    def lie(chunk: Chunk, stream) -> None:
        chunk.uncompressed_size += stated
        write(chunk, stream)

    monkeypatch.setattr(Chunk, "write", lie)
    rewrite(tmp_path / "a.mcap", tmp_path / "b.mcap", compression=compression)
    with pytest.raises(UserError, match=r"b\.mcap .* that states"):
        read_episode(tmp_path / "b.mcap")


def test_what_cannot_be_read_is_named(tmp_path):
    with pytest.raises(UserError, match=r"none\.mcap does not exist"):
        read_episode(tmp_path / "none.mcap")
    for read in (read_episode, read_index):
        with pytest.raises(UserError, match="Wanted a file, found a directory"):
            read(tmp_path)


def test_an_aborted_recording_leaves_what_was_there(tmp_path, scene):
    path = tmp_path / "a.mcap"
    record(path, scene, steps())
    before = path.read_bytes()
    sink = McapSink(path)
    sink.begin(scene, INFO)
    sink.step(scene, steps()[0])
    assert leftovers(tmp_path) == [".a.mcap.part", "a.mcap"]
    sink.abort()
    sink.abort()
    assert leftovers(tmp_path) == ["a.mcap"]
    assert path.read_bytes() == before


def test_an_error_while_recording_leaves_nothing(tmp_path, scene):
    sink = McapSink(tmp_path / "a.mcap")
    sink.begin(scene, INFO)
    wrong = steps()[0]
    wrong.decision.images["top"] = np.zeros((4, 4))
    with pytest.raises(ValueError, match="uint8"):
        sink.step(scene, wrong)
    assert leftovers(tmp_path) == []


def test_a_full_disk_is_named_and_leaves_nothing(tmp_path, scene):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    path = tmp_path / "a.mcap"
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
        with pytest.raises(UserError, match=r"Cannot record .*a\.mcap: File too large; .*ulimit -f"):
            record(path, scene, steps(200))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert leftovers(tmp_path) == []


def test_a_directory_that_cannot_be_is_named(tmp_path, scene):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=r"Cannot record .*a\.mcap: .*; check that the directory"):
        McapSink(tmp_path / "file" / "a.mcap").begin(scene, INFO)


def test_synthetic_actions_have_no_equal_rows():
    rows = np.concatenate([synthetic_actions(seed, 30) for seed in range(4)])
    assert len(np.unique(rows, axis=0)) == len(rows)
