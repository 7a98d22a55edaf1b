"""Rendering views block by block into files: each view is composited once, and all its outputs follow from that.

Of a view, a block of rows is in memory at a time, and what a format needs as a whole: nothing for ENVI and .npy, the
picture for PNG and video, the output itself for EXR.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import numpy as np

from unmix_plugin.engine.geometry.camera_paths import rows_of
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.formats.video import FrameSink
from unmix_plugin.products.render.cameras import RenderCameras
from unmix_plugin.products.render.files import (
    Rows,
    RowsSink,
    Setting,
    frame,
    still,
    still_paths,
    video,
    video_path,
)
from unmix_plugin.products.render.outputs import Product
from unmix_plugin.products.render.pictures import Palette
from unmix_plugin.products.render.survey import Survey
from unmix_plugin.spectral.coefficients import OCCUPIED_ACCUMULATION
from unmix_plugin.spectral.maps.reflectance_maps import is_reflectance_map
from unmix_plugin.trained.trained_scene import TrainedScene

_PATH_FPS, _VIEWS_FPS = 24.0, 2.0
"""Frames a second of a path, and of views that don't follow each other."""

_BLOCK_PIXELS, _BLOCK_NUMBERS = 1 << 16, 1 << 22
"""Most pixels of a block, and most numbers of one of its outputs."""


@dataclass(frozen=True)
class Block:
    """Some rows of a view, as a camera of their own."""

    view: int
    """Index of the view."""
    first_row: int
    camera: Cameras
    is_last: bool
    """Whether the view ends with it."""


class RenderJob:
    """A context: render its blocks, in their order. A view's files get their names when its last block is done, videos
    at the end; whatever is not complete when an error comes is left without a trace."""

    def __init__(
        self,
        scene: TrainedScene,
        cameras: RenderCameras,
        products: Sequence[Product],
        survey: Survey,
        folder: Path,
    ) -> None:
        """
        Args:
            scene: Of mixed materials.
            cameras: To render from.
            products: What to write.
            survey: Of these cameras and outputs.
            folder: Where to write.
        """
        materials = scene.materials
        self._scene, self._cameras, self._survey = scene, cameras, survey
        palette = Palette.of(materials, survey.scales)
        self._setting = Setting(folder, cameras.size, materials, palette, cameras.frames_per_second)
        self._moving = [product for product in products if is_video_of_all(product, cameras)]
        self._still = [product for product in products if product not in self._moving]
        self._asked = _asked_of_model(products)
        self._files, self._view = ExitStack(), ExitStack()
        self._frame_sinks: list[FrameSink] = []
        self._sinks: list[RowsSink] = []

    @property
    def palette(self) -> Palette:
        """The colours of the pictures."""
        return self._setting.palette

    def blocks(self, pixels: int | None = None) -> list[Block]:
        """All that is to be rendered.

        Args:
            pixels: Most of a block; None: what keeps a block's numbers small.
        """
        width, height = self._cameras.size
        if pixels is None:
            pixels = min(_BLOCK_PIXELS, _BLOCK_NUMBERS // len(self._setting.materials.bands))
        rows = max(1, pixels // width)
        return [
            Block(
                index, first, rows_of(view.camera, first, min(first + rows, height)), first + rows >= height
            )
            for index, view in enumerate(self._cameras.views)
            for first in range(0, height, rows)
        ]

    def __enter__(self) -> RenderJob:
        usual = _PATH_FPS if self._cameras.is_path else _VIEWS_FPS
        frames_per_second = self._cameras.frames_per_second or usual
        with ExitStack() as opening:
            self._frame_sinks = [
                opening.enter_context(video(product, self._setting, frames_per_second))
                for product in self._moving
            ]
            self._view = opening.enter_context(ExitStack())
            self._files = opening.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._files.__exit__(kind, error, traceback)

    def render(self, block: Block) -> None:
        """Render a block and hand it to the files.

        Raises:
            RunError: the disk is full or refuses.
        """
        if block.first_row == 0:
            self._open_view(block.view)
        rows = Rows(block.first_row, self._values(block.camera))
        for sink in self._sinks:
            sink(rows)
        if block.is_last:
            self._view.close()

    def _open_view(self, index: int) -> None:
        views = self._cameras.views
        progress = index / max(1, len(views) - 1)
        self._sinks = [
            self._view.enter_context(still(product, views[index].name, self._setting))
            for product in self._still
        ]
        self._sinks += [
            self._view.enter_context(frame(product.output, progress, self._setting, add))
            for product, add in zip(self._moving, self._frame_sinks, strict=True)
        ]

    def _values(self, camera: Cameras) -> dict[str, np.ndarray]:
        rendered = self._scene.render(camera, self._asked)
        if self._survey.pca is not None:
            spectra = rendered["spectral"]
            seen = (rendered["accumulation"] > OCCUPIED_ACCUMULATION)[..., None]
            rendered["pca"] = self._survey.pca(spectra.cpu()) * seen.cpu()
        if self._survey.scores:
            spectra, opacity = rendered["spectral"].cpu(), rendered["accumulation"].cpu()
            reflectance = self._setting.materials.reflectance_of(spectra, opacity)
            rendered |= {name: score(reflectance) for name, score in self._survey.scores.items()}
        return {name: values.detach().cpu().numpy() for name, values in rendered.items()}


def is_video_of_all(product: Product, cameras: RenderCameras) -> bool:
    """Whether a product is one video of all views: but a sweep through the bands is one video a view, unless the
    camera moves."""
    is_sweep = product.output.kind.name == "spectra" and not (cameras.is_path and len(cameras.views) > 1)
    return product.format == "mp4" and not is_sweep


def product_paths(folder: Path, product: Product, cameras: RenderCameras) -> list[Path]:
    """Files of a product."""
    if is_video_of_all(product, cameras):
        return [video_path(folder, product)]
    return [path for view in cameras.views for path in still_paths(folder, product, view.name)]


def _asked_of_model(products: Sequence[Product]) -> tuple[str, ...]:
    names = {product.output.name: None for product in products}
    for name in [name for name in names if name == "pca" or is_reflectance_map(name)]:
        names.pop(name)
        names["spectral"] = None
    return (*names, *(() if "accumulation" in names else ("accumulation",)))
