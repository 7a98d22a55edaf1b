"""MP4 video, H.264: frames go to an encoder as they come, and none is kept.

Source of the tags: ITU-T H.273; colours are those of BT.709, whose primaries sRGB has, with sRGB's own transfer curve.
"""

from __future__ import annotations

import contextlib
import re
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TypeAlias, cast

import numpy as np

from unmix_plugin.engine.runs.atomic_files import cannot_write, whole_file
from unmix_plugin.errors import RunError

FrameSink: TypeAlias = Callable[[np.ndarray], None]
"""Takes the next frame, (H, W, 3) uint8 sRGB."""

_QUALITY = 16
"""Constant rate factor of x264: 0 is lossless, 18 is hard to tell from it."""

OWN_GROUP = getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0)
"""With a session of its own, where there are any: Ctrl-C does not reach the process, since it is for us, who end it."""

_TAGS = "colorspace=bt709:color_primaries=bt709:color_trc=iec61966-2-1:range=tv"


@contextmanager
def video_frames(path: Path, width: int, height: int, frames_per_second: float) -> Iterator[FrameSink]:
    """Context that gives a sink for frames; at its end the video is complete and has its name.

    Players want even sizes: where a side is odd, the last row or column is shown twice.

    Raises:
        RunError: the disk is full or refuses, or the encoder fails; nothing is left of the video.
        ValueError: a frame of another size.
    """

    @contextmanager
    def failures() -> Iterator[None]:
        """Context in which an encoder that no longer reads is an error of the video."""
        try:
            yield
        except OSError as error:
            encoder.wait()
            raise _failure(path, log) from error

    def add(frame: np.ndarray) -> None:
        if frame.shape != (height, width, 3) or frame.dtype != np.uint8:
            raise ValueError(f"frames are ({height}, {width}, 3) uint8; got {frame.shape} {frame.dtype}")
        even = np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
        with failures():
            stdin.write(even.tobytes())

    with whole_file(path) as temporary, tempfile.TemporaryFile() as log:
        command = _command(temporary, (width + width % 2, height + height % 2), frames_per_second)
        encoder = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=log,
            start_new_session=True,
            creationflags=OWN_GROUP,
        )
        stdin = cast("IO[bytes]", encoder.stdin)
        try:
            yield add
            with failures():
                stdin.close()
            if encoder.wait() != 0:
                raise _failure(path, log)
        finally:
            if encoder.poll() is None:  # still at work
                encoder.kill()
                encoder.wait()
            with contextlib.suppress(OSError):  # what was not yet written has no reader any more
                stdin.close()


def _command(path: Path, size: tuple[int, int], frames_per_second: float) -> list[str]:
    """The encoder's command."""
    import imageio_ffmpeg

    frames = f"-f rawvideo -pix_fmt rgb24 -s {size[0]}x{size[1]} -r {frames_per_second:g} -i -"
    colours = f"-vf scale=out_color_matrix=bt709:out_range=tv,setparams={_TAGS} -pix_fmt yuv420p"
    codec = f"-an -c:v libx264 -crf {_QUALITY} -movflags +faststart -f mp4"
    options = f"-hide_banner -loglevel error -nostdin -y {frames} {colours} {codec}"
    return [imageio_ffmpeg.get_ffmpeg_exe(), *options.split(), str(path)]


def _failure(path: Path, log: IO[bytes]) -> RunError:
    log.seek(0)
    lines = log.read().decode(errors="replace").strip().splitlines()
    # The part in brackets names the encoder's component.
    reason = re.sub(r"^\[.*?\]\s*", "", lines[-1]) if lines else "the video encoder ended early"
    return cannot_write(path, reason)
