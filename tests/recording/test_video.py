"""Videos: what players and people need of them."""

import resource
from types import SimpleNamespace

import av
import numpy as np
import pytest
from test_mcap import INFO, RESULT, steps

from imfvla.errors import UserError
from imfvla.recording import VideoSink, write_mp4
from imfvla.recording.video import CAPTION_HEIGHT, CAPTION_MARGIN, side_by_side


def pictures(num: int, height: int = 33, width: int = 47) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [rng.integers(0, 256, (height, width, 3), dtype=np.uint8) for _ in range(num)]


def test_a_video_plays_everywhere(tmp_path):
    write_mp4(tmp_path / "a.mp4", pictures(7), 25)
    with av.open(str(tmp_path / "a.mp4")) as container:
        (stream,) = container.streams.video
        assert (stream.codec_context.name, stream.pix_fmt, stream.average_rate) == ("h264", "yuv420p", 25)
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
    assert [frame.shape for frame in frames] == [(32, 46, 3)] * 7
    write_mp4(tmp_path / "b.mp4", pictures(7), 25)
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()


def test_an_error_between_frames_leaves_nothing(tmp_path):
    def broken():
        yield from pictures(2)
        raise RuntimeError("renderer lost")

    with pytest.raises(RuntimeError, match="renderer lost"):
        write_mp4(tmp_path / "a.mp4", broken(), 25)
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_named_and_leaves_nothing(tmp_path):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
        with pytest.raises(UserError, match=r"Cannot write video .*a\.mp4: File too large; .*ulimit -f"):
            write_mp4(tmp_path / "a.mp4", pictures(90, 96, 96), 25)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("num_views", "width"), [(1, 96), (1, 240), (3, 96), (3, 240)])
def test_a_caption_is_never_clipped(num_views, width):
    caption = "transfer  seed 100003  demonstration  13.98 s  stage 4  return 2734"
    frame = side_by_side([np.zeros((8, width, 3), np.uint8)] * num_views, caption)
    line = frame[-CAPTION_HEIGHT:]
    assert line.max() > 100
    assert line[:2].max() == line[-2:].max() == 0
    assert line[:, : CAPTION_MARGIN - 1].max() == line[:, -CAPTION_MARGIN + 2 :].max() == 0


def test_an_episode_is_filmed_in_real_time(tmp_path):
    asked = []

    def render(view, height, width):
        asked.append((view, height, width))
        return np.zeros((height, width, 3), np.uint8)

    sink = VideoSink(tmp_path / "a.mp4", views=("front", "top"), height=24)
    env = SimpleNamespace(render=render, stages=("reach",))
    sink.begin(env, INFO)
    for step in steps():
        sink.step(env, step)
    sink.end(RESULT)
    assert asked == [("front", 24, 36), ("top", 24, 36)] * 2
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert container.streams.video[0].average_rate == 12.5
    assert [file.name for file in tmp_path.iterdir()] == ["a.mp4"]


def test_an_aborted_film_leaves_nothing(tmp_path):
    sink = VideoSink(tmp_path / "a.mp4", views=("front",), height=24)
    sink.abort()
    env = SimpleNamespace(
        render=lambda view, height, width: np.zeros((height, width, 3), np.uint8), stages=()
    )
    sink.begin(env, INFO)
    sink.step(env, steps()[0])
    sink.abort()
    assert list(tmp_path.iterdir()) == []
