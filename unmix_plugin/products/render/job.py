"""Rendering views block by block into files: each view is composited once, and all its outputs follow from that.

Of a view, a block of rows is in memory at a time, and what a format needs as a whole: nothing for ENVI and .npy, the
picture for PNG and video, the output itself for EXR. A look ahead at all views, small, tells what their pictures must
have in common, so that a video does not flicker. Several processes share the views in rounds, one view each; the first
puts the frames of a round into the videos.
"""

from __future__ import annotations

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
from unmix_plugin.engine.processes import ALONE, Processes
from unmix_plugin.engine.registry import METRES, Output
from unmix_plugin.figures.pictures import ColourScale
from unmix_plugin.formats.video import FrameSink
from unmix_plugin.products.render.cameras import RenderCameras
from unmix_plugin.products.render.files import (
    COVERAGE,
    FormattedOutput,
    RenderSetting,
    Rows,
    RowsSink,
    frame,
    still,
    still_paths,
    video,
    video_path,
)
from unmix_plugin.products.render.maps import MapInfo
from unmix_plugin.products.render.pictures import Palette, scale_of
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.materials import OCCUPIED_ACCUMULATION
from unmix_plugin.spectral.subspace import PcaColours
from unmix_plugin.trained.outputs import usual_range
from unmix_plugin.trained.protocol import RenderableScene
from unmix_plugin.trained.reflectance_maps import Score, is_reflectance_map, parse_reflectance_map
from unmix_plugin.trained.run_views import RunView
from unmix_plugin.trained.trained_scene import one_pixel

_MOST_VIEWS = 12
_PIXELS = 32 * 32
"""Of a view looked at."""


@dataclass(frozen=True)
class Survey:
    """What all pictures of a render share."""

    scales: dict[str, ColourScale] = field(default_factory=dict)
    """Colours of outputs whose range only the views tell, by output."""
    pca: PcaColours | None = None
    """Colours of the output `pca` of a scene of materials, if asked for."""
    scores: dict[str, Score] = field(default_factory=dict)
    """From reflectance to each index and target that is asked for."""


def needs_survey(outputs: Collection[Output]) -> bool:
    """Whether pictures of `outputs` share anything that has to be found out first."""
    return any(
        output.name == "pca" or is_reflectance_map(output.name) or _is_ranged(output) for output in outputs
    )


def take_survey(
    scene: RenderableScene, views: Sequence[RunView], outputs: Collection[Output], info: MapInfo | None = None
) -> Survey:
    """Look at up to twelve views, evenly spread over all, and find what `outputs` of all views, or of the map of
    `info`, share."""
    if not needs_survey(outputs):
        return Survey()
    scene = _lit_for(scene, info)
    maps = [output for output in outputs if is_reflectance_map(output.name)]
    ranged = [output for output in outputs if _is_ranged(output) and output not in maps]
    has_pca = any(output.name == "pca" for output in outputs)
    materials = scene.materials
    spectra = ["spectral"] if materials is not None and (maps or has_pca) else []
    seen = _seen(scene, views, [*(output.name for output in ranged), *spectra])
    scales = {
        output.name: scale_of(output, *usual_range(seen[output.name] * _units(output, info)))
        for output in ranged
    }
    if materials is None or not spectra:
        return Survey(scales)
    reflectance = materials.reflectance_of(seen["spectral"], seen["accumulation"])
    bands, lit = materials.bands, materials.is_lit
    scores = {output.name: parse_reflectance_map(output.name, bands, lit).fit(reflectance) for output in maps}
    for output in maps:
        if output.value_range is None and output.kind == "map":
            scales[output.name] = scale_of(output, *usual_range(scores[output.name](reflectance)))
    return Survey(scales, PcaColours.fit(seen["spectral"]) if has_pca else None, scores)


def _lit_for(scene: RenderableScene, info: MapInfo | None) -> RenderableScene:
    """The scene as it is shown: rays of a map start from many places, so that no lamp can go with them."""
    return scene if info is None else scene.lit_head_on


def _units(output: Output, info: MapInfo | None) -> float:
    """What an output's numbers are multiplied with to be in the unit that it says."""
    metres = None if info is None else info.metres_per_unit
    return 1.0 if metres is None or output.unit != METRES else metres


def _is_ranged(output: Output) -> bool:
    """Whether only the views tell between which values an output's colours go."""
    return output.kind in ("map", "shares") and output.value_range is None


def _seen(scene: RenderableScene, views: Sequence[RunView], outputs: Sequence[str]) -> dict[str, Tensor]:
    """Outputs and `accumulation` of the pixels in which something is, of all views looked at, on the CPU."""
    every = -(-len(views) // _MOST_VIEWS)
    found: dict[str, list[Tensor]] = {name: [] for name in (*outputs, "accumulation")}
    for view in views[::every]:
        looked = scene.look(view.camera.shrunk(_PIXELS))
        occupied = looked.opacity > OCCUPIED_ACCUMULATION
        for name in outputs:
            found[name].append(looked[name][occupied].cpu())
        found["accumulation"].append(looked.opacity[occupied].cpu())
    return {name: torch.cat(parts) for name, parts in found.items()}


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
    ) -> None:
        """Of a scene of any method; `survey` is of these cameras and outputs, and each process has a job like this."""
        scene = _lit_for(scene, cameras.map_info)
        self._scene, self._cameras, self._survey, self._processes = scene, cameras, survey, processes
        asked = [one.output for one in outputs]
        setting = setting_for(scene, cameras.views[0].camera, asked, survey, folder)
        self._setting = replace(
            setting, frames_per_second=cameras.frames_per_second, map_info=cameras.map_info
        )
        self.palette = self._setting.palette
        """The colours of the pictures."""
        self._moving = [one for one in outputs if is_video_of_all(one, cameras)]
        self._still = [one for one in outputs if one not in self._moving]
        self._units = {output.name: _units(output, cameras.map_info) for output in asked}
        # What all views share is computed here, from spectra.
        own = {*survey.scores, *(["pca"] if survey.pca is not None else [])}
        names = dict.fromkeys("spectral" if output.name in own else output.name for output in asked)
        self._asked = [name for name in names if name != "accumulation"]

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
                        rows = Rows(block.first_row, self._values(block.camera))
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

    def _values(self, camera: Cameras) -> dict[str, np.ndarray]:
        view = self._scene.look(camera)
        rendered = {name: view[name] for name in self._asked}
        rendered |= {name: view[name] * unit for name, unit in self._units.items() if unit != 1.0}
        rendered["accumulation"] = opacity = view.opacity
        rendered[COVERAGE] = view.coverage
        if self._survey.pca is not None:
            seen = (opacity > OCCUPIED_ACCUMULATION)[..., None]
            rendered["pca"] = self._survey.pca(rendered["spectral"].cpu()) * seen.cpu()
        if self._survey.scores and (materials := self._scene.materials) is not None:
            reflectance = materials.reflectance_of(rendered["spectral"].cpu(), opacity.cpu())
            rendered |= {name: score(reflectance) for name, score in self._survey.scores.items()}
        return {name: values.detach().cpu().numpy() for name, values in rendered.items()}


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
        if output.kind != "shares" and of_output is not None:
            bands[output.name] = of_output
            names[output.name] = tuple(f"{wavelength:g} nm" for wavelength in of_output.centers_nm)
        elif materials is None:
            pixel = scene.render(one_pixel(camera, 0, 0), [output.name])[output.name]
            names[output.name] = tuple(f"{output.title} {index}" for index in range(pixel.shape[-1]))
        else:
            names[output.name] = materials.names
    palette = Palette.of(materials, survey.scales)
    return RenderSetting(folder, camera.size(0), palette, bands, names)
