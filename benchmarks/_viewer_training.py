"""What the viewer costs a training: the same steps, timed by the clock on the wall, with and without it."""

from __future__ import annotations

import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import _common

from unmix_plugin.engine.model import TrainingCallback, TrainingCallbackLocation
from unmix_plugin.engine.runs.loading import read_scene_record
from unmix_plugin.viewer.access import TrainingViewerOptions
from unmix_plugin.viewer.rendering.scene import source_of_training
from unmix_plugin.viewer.server import Viewer
from unmix_plugin.viewer.session import Services

WAYS = ("no viewer", "no page", "one page at rest", "one page always moving")
UNTIMED_STEPS = 10

_PAGE = """
import contextlib, sys, time
sys.path.insert(0, {folder!r})
from tests.factories.viewer_page import ConnectionClosed, Page
with contextlib.suppress(OSError, ConnectionClosed), Page({address!r}, width=512, height=512) as page:
    page.look_from(0.3)
    print("there", flush=True)
    step = 0
    while not page.is_closed:
        time.sleep(0.03)
        step += 1
        if {moves}:
            page.look_from(0.3 + 0.01 * step)
"""


@dataclass(frozen=True)
class TrainingSpeed:
    """Steps a second of each way, one value a round."""

    values: dict[str, list[float]]
    processor: dict[str, list[float]]
    """The same by the time that the process had processors, which nothing else on the machine disturbs."""
    share: float
    """Of the viewer, while a page moves."""

    def relative(self, way: str) -> float:
        """Speed relative to that without a viewer, best round against best: whatever else runs only slows."""
        return max(self.values[way]) / max(self.values["no viewer"])

    def relative_by_processor(self, way: str) -> float:
        """The same by processor time."""
        return max(self.processor[way]) / max(self.processor["no viewer"])


def measure_training(folder: Path, data: Path, device: str, steps: int, rounds: int) -> TrainingSpeed:
    """Train the same steps in each way, in turn, so that a busy moment of the machine hits all of them."""
    options = TrainingViewerOptions(port=0)
    values: dict[str, list[float]] = {way: [] for way in WAYS}
    processor: dict[str, list[float]] = {way: [] for way in WAYS}
    for number in range(rounds):
        for way in WAYS:
            words = ["unmix-nerf", "--data", str(data), "--output-dir", str(folder / f"{way}-{number}")]
            words += ["--device", device, "--max-num-iterations", str(steps + UNTIMED_STEPS)]
            wall_s, processor_s = _seconds(words, way, options)
            values[way].append(steps / wall_s)
            processor[way].append(steps / processor_s)
            print(f"  {way}: {values[way][-1]:.1f} steps/s", flush=True)
    return TrainingSpeed(values, processor, options.share)


def _seconds(words: list[str], way: str, options: TrainingViewerOptions) -> tuple[float, float]:
    """Seconds that the timed steps took, on the wall and of processors."""
    trainer = _common.quiet_trainer(words)
    times: list[tuple[float, float]] = []

    def note(*_: object) -> None:
        times.append((time.perf_counter(), time.process_time()))

    trainer.callbacks.append(TrainingCallback(TrainingCallbackLocation.AFTER_TRAIN_ITERATION, note))
    if way == "no viewer":
        trainer.train()
    else:
        source = source_of_training(trainer, read_scene_record(trainer.run))
        source.device.viewing_share = options.share
        viewer = Viewer(Services(source, _no_scene), options)
        viewer.start()
        page = None if way == "no page" else _page(viewer.port, moves=way.endswith("moving"))
        try:
            trainer.train()
        finally:
            viewer.stop()
            if page is not None:
                page.wait(30)
    begun, ended = times[UNTIMED_STEPS - 1], times[-1]
    return ended[0] - begun[0], ended[1] - begun[1]


def _page(port: int, moves: bool) -> subprocess.Popen[str]:
    """A page in a process of its own, as a browser is; there before this returns."""
    folder = str(_common.REPOSITORY)
    code = _PAGE.format(folder=folder, address=f"ws://127.0.0.1:{port}", moves=moves)
    page = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert page.stdout is not None
    page.stdout.readline()
    return page


def _no_scene() -> NoReturn:
    """A training has its scene, which is not needed here."""
    from unmix_plugin.errors import SceneError

    raise SceneError("not read")
