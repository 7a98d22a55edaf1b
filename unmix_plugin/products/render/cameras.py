"""Which cameras a render uses: views of the dataset, a path around or through them, or those of a file."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

from unmix_plugin.engine.geometry.camera_paths import interpolated, orbit
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.errors import ConfigError, did_you_mean
from unmix_plugin.products.render.maps import MapInfo, map_camera
from unmix_plugin.trained.camera_files import check_frames_per_second, check_size, read_camera_file
from unmix_plugin.trained.measures import Scale
from unmix_plugin.trained.protocol import RenderableScene
from unmix_plugin.trained.run_views import RunView, cameras_of, find_view, resized_views, views_of

_DATASET_CAMERAS = ("dataset-eval", "dataset-train")
_PATH_CAMERAS = ("orbit", "interpolate")
_CAMERA_CHOICES = (*_DATASET_CAMERAS, *_PATH_CAMERAS)
"""Cameras that have a name; any other choice is a file."""

_USUAL_FRAMES = 120
_MOST_FRAMES = 100_000
_GREATEST_DOWNSCALE = 1000
_PROJECTED_CODES = (1024, 32_766)
"""EPSG codes that a GeoTIFF's key of a projected system takes; those of 4000 to 4999 are geographic or geocentric."""
_LEAST_PATH_HEIGHT = 512
"""Rows of videos along a path that is made here, unless a size is asked for."""


@dataclass(frozen=True)
class CameraRequest:
    """What cameras are asked for."""

    source: str = "dataset-eval"
    """One of `_CAMERA_CHOICES`, or the path of a camera file."""
    only: tuple[str, ...] = ()
    """Names of views, or numbers from 0; none: all."""
    size: tuple[int, int] | None = None
    """Width and height in pixels; None: that of the dataset or of the file, for paths made here at least 512 rows."""
    downscale: float | int | None = None
    """Division of width and height."""
    num_frames: int | None = None
    """Of a path that is made here."""
    frames_per_second: float | int | None = None
    """Of videos; None: as in the file, or a default for each kind of video."""
    pixel_size: float | None = None
    """Of a map: edge of a pixel, metres or units of the world; None: that of the scene's views."""
    epsg: int | None = None
    """Of a map from above: code of the coordinate system of the world; None: unknown."""


@dataclass(frozen=True)
class RenderCameras:
    """Cameras to render from."""

    views: tuple[RunView, ...]
    """At least one; all of one size, in model space, with different names fit for file names."""
    is_path: bool
    """Whether one view follows the other, as the frames of a video do."""
    frames_per_second: float | None
    """Of videos, where it is given."""
    map_info: MapInfo | None = None
    """Where the one view lies, if it is a map."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.views[0].camera.width, self.views[0].camera.height


def choose_cameras(
    scene: RenderableScene, request: CameraRequest, scale: Scale | None = None
) -> RenderCameras:
    """The cameras asked for; `scale` is that of the world, for maps.

    Raises:
        ConfigError: an unknown choice, a bad file, an impossible size, or options that contradict each other.
    """
    kind, _, direction = request.source.partition(":")
    if kind == "map":
        return _map(scene, request, scale, direction or "top")
    if request.epsg is not None:
        raise ConfigError(f"--epsg is for --cameras map; --cameras {request.source} has no map coordinates")
    if request.pixel_size is not None:
        raise ConfigError(
            f"--pixel-size is for --cameras map; --cameras {request.source} has pixels of its own"
        )
    chosen = _from_source(scene, request)
    if request.only:
        names = {find_view(chosen.views, one).name for one in request.only}
        chosen = replace(chosen, views=tuple(view for view in chosen.views if view.name in names))
    if request.frames_per_second is not None:
        frames_per_second = check_frames_per_second(request.frames_per_second, "--fps")
        chosen = replace(chosen, frames_per_second=frames_per_second)
    return replace(chosen, views=resized_views(chosen.views, _size(chosen.size, request)))


def _from_source(scene: RenderableScene, request: CameraRequest) -> RenderCameras:
    source = request.source
    if request.num_frames is not None:
        if source not in _PATH_CAMERAS:
            raise ConfigError(
                f"--frames is for the paths that are made here, {' and '.join(_PATH_CAMERAS)}; "
                f"--cameras {source} has cameras of its own"
            )
        if not 1 <= request.num_frames <= _MOST_FRAMES:
            raise ConfigError(f"--frames {request.num_frames}: expected 1 to {_MOST_FRAMES}")
    if source in _DATASET_CAMERAS:
        views = views_of(scene.views, "eval" if source == "dataset-eval" else "train")
        return RenderCameras(resized_views(views), False, None)
    count = _USUAL_FRAMES if request.num_frames is None else request.num_frames
    if source == "orbit":
        return _path("orbit", orbit(cameras_of(scene.views, "train"), scene.scene_box, count))
    if source == "interpolate":
        return _path("interpolate", interpolated(cameras_of(scene.views, "eval"), scene.scene_box, count))
    if not source.endswith(".json") and not Path(source).is_file():
        hint = did_you_mean(source, _CAMERA_CHOICES, likeness=0.5, form=" ({})")
        raise ConfigError(
            f"unknown cameras {source!r}{hint}; known are {', '.join(_CAMERA_CHOICES)}, map, and "
            "the path of a camera file (.json)"
        )
    found = read_camera_file(Path(source), scene.frame)
    is_path = found.frames_per_second is not None
    return RenderCameras(found.views, is_path, found.frames_per_second)


def _map(
    scene: RenderableScene, request: CameraRequest, scale: Scale | None, direction: str
) -> RenderCameras:
    given = (request.size, request.downscale, request.num_frames, request.frames_per_second)
    if any(one is not None for one in given) or request.only:
        raise ConfigError(
            "--cameras map has one view of the size that --pixel-size gives; leave out other options of views"
        )
    camera, info = map_camera(scene, scale, direction, request.pixel_size)
    if request.epsg is not None:
        info = _in_coordinate_system(info, request.epsg, scale, direction)
    name = re.sub(r"[^\w-]+", "_", f"map_{direction}")
    return RenderCameras((RunView(name, camera),), False, None, info)


def _in_coordinate_system(info: MapInfo, epsg: int, scale: Scale | None, direction: str) -> MapInfo:
    if not _PROJECTED_CODES[0] <= epsg <= _PROJECTED_CODES[1] or epsg // 1000 == 4:
        raise ConfigError(
            f"--epsg {epsg} is no projected coordinate system; expected a code such as 32632 (UTM zone 32N)"
        )
    if direction != "top":
        raise ConfigError(f"--epsg is for maps from above; map:{direction} has no east and north")
    if scale is None or scale.metres_per_unit != 1:
        raise ConfigError(
            "--epsg needs a world in metres, as geo-referenced poses have; this run's has another or an unknown scale: "
            "leave --epsg out"
        )
    return replace(info, epsg=epsg)


def _path(name: str, cameras: Cameras) -> RenderCameras:
    views = tuple(RunView(f"{name}_{index:04d}", cameras[index]) for index in range(len(cameras)))
    return RenderCameras(views, True, None)


def _size(size: tuple[int, int], request: CameraRequest) -> tuple[int, int]:
    if request.size is not None and request.downscale is not None:
        raise ConfigError("--size and --downscale both say how large pictures are; give one of them")
    if request.size is not None:
        return check_size(*request.size, "--size")
    if request.downscale is None and request.source in _PATH_CAMERAS and size[1] < _LEAST_PATH_HEIGHT:
        return round(size[0] * _LEAST_PATH_HEIGHT / size[1]), _LEAST_PATH_HEIGHT
    if request.downscale is None:
        return size
    if not 1 / _GREATEST_DOWNSCALE <= request.downscale <= _GREATEST_DOWNSCALE:
        raise ConfigError(
            f"--downscale {request.downscale:g}: expected {1 / _GREATEST_DOWNSCALE:g} to {_GREATEST_DOWNSCALE}"
        )
    width, height = (round(side / request.downscale) for side in size)
    return check_size(width, height, f"--downscale {request.downscale:g}")
