"""Frames of videos that several processes draw in rounds, one view each: the first puts them into the videos."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from unmix_plugin.engine.processes import Processes
from unmix_plugin.formats.video import FrameSink


class FrameExchange:
    """Takes the frames that this process draws; at the end of a round they follow each other by rank."""

    def __init__(self, processes: Processes, num_videos: int, videos: Sequence[FrameSink]) -> None:
        """
        Args:
            processes: All of which end each round.
            num_videos: Frames of a view.
            videos: Where frames go; only the first process has them.
        """
        self._processes, self._videos = processes, videos
        self._drawn: list[np.ndarray | None] = [None] * num_videos

    def sink(self, video: int) -> FrameSink:
        """Takes the frame of this round of a video."""

        def take(frame: np.ndarray) -> None:
            self._drawn[video] = frame

        return take

    def end_round(self) -> None:
        """Hand over the frames of this round; a process without a view in it has none.

        Raises:
            RunError: in the first process, the disk is full or refuses.
        """
        if not self._drawn:
            return
        drawn = self._processes.gather(self._drawn)
        self._drawn = [None] * len(self._drawn)
        with self._processes.together():
            for frames in drawn:
                for add, frame in zip(self._videos, frames, strict=False):
                    if frame is not None:
                        add(frame)
