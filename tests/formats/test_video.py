"""MP4 video, read back with imageio."""

import subprocess
import sys

import numpy as np
import pytest

from tests.factories.outputs import read_video
from tests.factories.systems import needs_posix
from unmix_plugin.errors import RunError
from unmix_plugin.formats import video
from unmix_plugin.formats.video import video_frames


def smooth_frames(count, width=48, height=32):
    """Frames of one colour each at the left, another at the right: what any encoder keeps."""
    colours = np.random.default_rng(0).integers(20, 236, (count, 2, 3), dtype=np.uint8)
    return np.repeat(np.repeat(colours[:, None], height, axis=1), width // 2, axis=2)


def test_frames_come_back_in_order_in_their_colours_at_their_speed(tmp_path):
    frames = smooth_frames(9)
    with video_frames(tmp_path / "deep" / "v.mp4", 48, 32, 12.0) as add:
        for frame in frames:
            add(frame)
    seen, facts = read_video(tmp_path / "deep" / "v.mp4")
    assert seen.shape == frames.shape
    assert (facts["fps"], facts["codec"], facts["duration"]) == (12.0, "h264", 0.75)
    assert "yuv420p" in facts["pix_fmt"]
    assert "bt709/bt709/iec61966-2-1" in facts["pix_fmt"]
    # Away from the edge between the two colours, where colour is coarser than brightness.
    for side in (slice(2, 20), slice(28, 46)):
        assert np.abs(seen[:, :, side].astype(int) - frames[:, :, side]).max() <= 6


def test_odd_sizes_are_made_even_by_showing_the_last_line_twice_and_other_sizes_refused(tmp_path):
    frame = smooth_frames(1, 48, 32)[0][:31, :47]
    with video_frames(tmp_path / "v.mp4", 47, 31, 24.0) as add:
        add(frame)
    seen, _ = read_video(tmp_path / "v.mp4")
    assert seen.shape == (1, 32, 48, 3)
    assert np.abs(seen[0, -1, -1].astype(int) - frame[-1, -1]).max() <= 6
    with (
        pytest.raises(ValueError, match=r"frames are \(31, 47, 3\) uint8"),
        video_frames(tmp_path / "other.mp4", 47, 31, 24.0) as add,
    ):
        add(np.zeros((32, 50, 3), np.uint8))
    assert [path.name for path in tmp_path.glob("[!.]*")] == ["v.mp4"]


def write(path, count, end=None):
    with video_frames(path, 48, 32, 24.0) as add:
        for frame in smooth_frames(count):
            add(frame)
        if end is not None:
            raise end


def test_an_error_between_frames_ends_the_encoder_and_leaves_the_old_video(tmp_path):
    (tmp_path / "v.mp4").write_bytes(b"old")
    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "v.mp4", 1, KeyboardInterrupt())
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"old"]


def test_an_encoder_that_fails_is_quoted_and_leaves_nothing(tmp_path, monkeypatch):
    def failing(path, _size, _fps):
        code = (
            f"import sys; open({str(path)!r}, 'w').write('half'); sys.exit('[out] No space left on device')"
        )
        return [sys.executable, "-c", code]

    monkeypatch.setattr(video, "_command", failing)
    with pytest.raises(RunError, match=r"can't write \S*v\.mp4: No space left on device; make room"):
        write(tmp_path / "v.mp4", 50)
    assert list(tmp_path.iterdir()) == []


@needs_posix
def test_the_real_encoder_out_of_space_leaves_nothing(tmp_path):
    """Whether it is met while frames are written or only at their end."""
    code = (
        "import sys, resource, numpy as np; from pathlib import Path\n"
        "from unmix_plugin.errors import RunError; from unmix_plugin.formats.video import video_frames\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))\n"
        "frame = np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)\n"
        "for count in (2, 60):\n"
        "    try:\n"
        "        with video_frames(Path(sys.argv[1]), 64, 64, 24.0) as add:\n"
        "            for shift in range(count): add(np.roll(frame, 7 * shift, axis=shift % 2))\n"
        "    except RunError as error: print(error)\n"
    )
    words = [sys.executable, "-c", code, str(tmp_path / "v.mp4")]
    ended = subprocess.run(words, capture_output=True, text=True, check=True)
    assert ended.stdout.count("can't write") == 2
    assert list(tmp_path.iterdir()) == []
