"""Rendering views block by block into files: each view is composited once, and all its outputs follow from that.

Of a view, a block of rows is in memory at a time, and what a format needs as a whole: nothing for ENVI and .npy, the
picture for PNG and video, the output itself for EXR. A look ahead at all views, small, tells what their pictures must
have in common, so that a video does not flicker. Several processes share the views in rounds, one view each; the first
puts the frames of a round into the videos.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.outputs import METRES, Output
from unmix_plugin.engine.processes import ALONE, Processes
from unmix_plugin.figures.look import Look
from unmix_plugin.figures.paint import needs_range
from unmix_plugin.formats.video import FrameSink
from unmix_plugin.products.render.cameras import RenderCameras
from unmix_plugin.products.render.files import (
    FormattedOutput,
    RenderSetting,
    Rows,
    RowsSink,
    frame,
    is_painted,
    still,
    still_paths,
    video,
    video_path,
)
from unmix_plugin.products.render.maps import MapInfo
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.trained.mixture_view import picture_values, usual_range, values_of
from unmix_plugin.trained.protocol import RenderableScene
from unmix_plugin.trained.reflectance_maps import is_reflectance_map
from unmix_plugin.trained.run_views import RunView
from unmix_plugin.trained.trained_scene import judged_together, one_pixel

_MOST_VIEWS = 12
_PIXELS = 32 * 32
"""Of a view looked at."""


@dataclass(frozen=True)
class Survey:
    """What all pictures of a render share."""

    ranges: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Values at the ends of the colours of outputs whose range only the views tell, by output."""
    outputs: dict[str, Output] = field(default_factory=dict)
    """By name: those whose numbers are judged against all views rather than each against itself."""


def needs_survey(outputs: Collection[Output], look: Look = Look()) -> bool:  # noqa: B008 - a frozen value
    """Whether pictures of `outputs` share anything that has to be found out first."""
    return any(
        output.name == "pca" or is_reflectance_map(output.name) or needs_range(output, look)
        for output in outputs
    )


def take_survey(
    scene: RenderableScene,
    views: Sequence[RunView],
    outputs: Collection[Output],
    info: MapInfo | None = None,
    look: Look = Look(),  # noqa: B008 - a frozen value
) -> Survey:
    """Look at up to twelve views, evenly spread over all, and find what `outputs` of all views, or of the map of
    `info`, share; principal components are those of the training views, as the viewer shows them."""
    if not needs_survey(outputs, look):
        return Survey()
    scene = _lit_for(scene, info)
    looked = [scene.look(view.camera.shrunk(_PIXELS)) for view in views[:: -(-len(views) // _MOST_VIEWS)]]
    own, ranges = judged_together(outputs, looked), dict[str, tuple[float, float]]()
    for output in outputs:
        if needs_range(output, look):
            seen = torch.cat([picture_values(view, own.get(output.name, output)).seen for view in looked])
            least = 0.0 if output.kind == "grey" else math.inf
            ranges[output.name] = usual_range(seen * _units(output, info), least)
    return Survey(ranges, own)


def _lit_for(scene: RenderableScene, info: MapInfo | None) -> RenderableScene:
    """The scene as it is shown: rays of a map start from many places, so that no lamp can go with them."""
    return scene if info is None else scene.lit_head_on


def _units(output: Output, info: MapInfo | None) -> float:
    """What an output's numbers are multiplied with to be in the unit that it says."""
    metres = None if info is None else info.metres_per_unit
    return 1.0 if metres is None or output.unit != METRES else metres


_PATH_FPS, _VIEWS_FPS = 24.0, 2.0
"""Frames a second of a path, and of views that don't follow each other."""

_BLOCK_PIXELS, _BLOCK_NUMBERS = 1 << 16, 1 << 22
"""Most pixels of a block, and most numbers of one of its outputs."""


class _Block(NamedTuple):
    """Some rows of a view, by its index, as a camera of their own."""

    view: int
    first_row: int
    camera: Cameras


class RenderJob:
    """Views to be rendered into files."""

    def __init__(
        self,
        scene: RenderableScene,
        cameras: RenderCameras,
        outputs: Sequence[FormattedOutput],
        survey: Survey,
        folder: Path,
        processes: Processes = ALONE,
        look: Look = Look(),  # noqa: B008 - a frozen value
    ) -> None:
        """Of a scene of any method; `survey` is of these cameras and outputs, and each process has a job like this."""
        scene = _lit_for(scene, cameras.map_info)
        self._scene, self._cameras, self._survey, self._processes = scene, cameras, survey, processes
        asked = list(dict.fromkeys(one.output for one in outputs))
        setting = setting_for(scene, cameras.views[0].camera, asked, survey, folder)
        self._setting = replace(
            setting, frames_per_second=cameras.frames_per_second, map_info=cameras.map_info, look=look
        )
        self._moving = [one for one in outputs if is_video_of_all(one, cameras)]
        self._still = [one for one in outputs if one not in self._moving]
        self._units = {output.name: _units(output, cameras.map_info) for output in asked}
        own = {output.name: survey.outputs.get(output.name, output) for output in asked}
        self._painted = [
            own[name] for name in dict.fromkeys(one.output.name for one in outputs if is_painted(one))
        ]
        self._numbers = [
            own[name] for name in dict.fromkeys(one.output.name for one in outputs if not is_painted(one))
        ]

    def blocks(self, pixels: int | None = None) -> list[_Block]:
        """All that this process is to render, in blocks of at most so many pixels; None: what keeps numbers few."""
        width, height = self._cameras.size
        if pixels is None:
            most = max((len(names) for names in self._setting.channels.values()), default=1)
            pixels = min(_BLOCK_PIXELS, _BLOCK_NUMBERS // most)
        rows = max(1, pixels // width)
        own = list(enumerate(self._cameras.views))[self._processes.rank :: self._processes.count]
        return [
            _Block(index, first, view.camera.crop(0, first, width, min(rows, height - first)))
            for index, view in own
            for first in range(0, height, rows)
        ]

    def render(self, blocks: Iterable[_Block]) -> None:
        """Render `blocks`, in their order. A view's files get their names when its last block is done, videos at the
        end; after an error nothing incomplete is left.

        Raises:
            RunError: the disk is full or refuses, or another process failed.
            Follower: this is not the first process, and one failed.
        """
        views, processes, setting = self._cameras.views, self._processes, self._setting
        usual = _PATH_FPS if self._cameras.is_path else _VIEWS_FPS
        frames_per_second = self._cameras.frames_per_second or usual
        with ExitStack() as files:
            videos = [
                files.enter_context(video(one, setting, frames_per_second))
                for one in self._moving
                if processes.is_first
            ]
            num_rounds = 0
            for index, parts in groupby(blocks, key=lambda block: block.view):
                drawn: list[np.ndarray | None] = [None] * len(self._moving)
                progress = index / max(1, len(views) - 1)
                with processes.together(), ExitStack() as of_view:
                    sinks: list[RowsSink] = []
                    for one in self._still:
                        path = still_paths(setting.folder, one, views[index].name)[0]
                        sinks.append(of_view.enter_context(still(path, one, setting)))
                    for place, one in enumerate(self._moving):
                        add = partial(drawn.__setitem__, place)
                        sinks.append(of_view.enter_context(frame(one.output, progress, setting, add)))
                    for block in parts:
                        rows = self._rows(block)
                        for sink in sinks:
                            sink(rows)
                self._end_round(drawn, videos)
                num_rounds += 1
            # The other processes may have one view more.
            for _ in range(num_rounds, -(-len(views) // processes.count)):
                with processes.together():
                    pass
                self._end_round([None] * len(self._moving), videos)

    def _end_round(self, drawn: list[np.ndarray | None], videos: Sequence[FrameSink]) -> None:
        """Hand over the frames that each process drew, which follow each other by rank; one without a view has none."""
        if not drawn:
            return
        of_all = self._processes.gather(drawn)
        with self._processes.together():
            for frames in of_all:
                for add, drawn_frame in zip(videos, frames, strict=False):
                    if drawn_frame is not None:
                        add(drawn_frame)

    @torch.no_grad()
    def _rows(self, block: _Block) -> Rows:
        view, units = self._scene.look(block.camera), self._units
        numbers = {one.name: values_of(view, one) for one in self._numbers}
        painted = {one.name: picture_values(view, one) for one in self._painted}
        return Rows(
            block.first_row,
            {name: _in_unit(values, units[name]).detach().cpu().numpy() for name, values in numbers.items()},
            {name: replace(one, values=_in_unit(one.values, units[name])) for name, one in painted.items()},
            view.opacity.cpu().numpy(),
            view.coverage.cpu().numpy(),
        )


def _in_unit(values: Tensor, unit: float) -> Tensor:
    return values if unit == 1.0 else values * unit


def is_video_of_all(formatted: FormattedOutput, cameras: RenderCameras) -> bool:
    """Whether a file is one video of all views: but a sweep through the bands is one video a view, unless the camera
    moves."""
    is_sweep = formatted.output.kind == "channels" and not (cameras.is_path and len(cameras.views) > 1)
    return formatted.format == "mp4" and not is_sweep


def output_paths(folder: Path, formatted: FormattedOutput, cameras: RenderCameras) -> list[Path]:
    """Files of an output."""
    if is_video_of_all(formatted, cameras):
        return [video_path(folder, formatted)]
    return [path for view in cameras.views for path in still_paths(folder, formatted, view.name)]


def setting_for(
    scene: RenderableScene, camera: Cameras, outputs: Sequence[Output], survey: Survey, folder: Path
) -> RenderSetting:
    """What files of views share that are as large as those of a camera; a scene without materials is asked how many
    channels an output has."""
    materials, names, bands = scene.materials, dict[str, tuple[str, ...]](), dict[str, Bands]()
    for output in outputs:
        if output.kind in ("grey", "map", "labels"):
            continue
        if output.kind not in ("channels", "spectra", "shares"):
            names[output.name] = ("x", "y", "z") if output.kind == "vectors" else ("red", "green", "blue")
            continue
        of_output = Bands.of(output.centers_nm) if output.centers_nm else scene.bands
        count = 0
        if materials is None and not output.centers_nm:
            count = scene.render(one_pixel(camera, 0, 0), [output.name])[output.name].shape[-1]
            if of_output is not None and (output.quantity is None or count != len(of_output)):
                of_output = None  # its channels are not the scene's bands
        if output.kind != "shares" and of_output is not None:
            bands[output.name] = of_output
            names[output.name] = tuple(f"{wavelength:g} nm" for wavelength in of_output.centers_nm)
        elif materials is None:
            names[output.name] = tuple(f"{output.title} {index}" for index in range(count))
        else:
            names[output.name] = materials.names
    return RenderSetting(folder, camera.size(0), survey.ranges, bands, names)
