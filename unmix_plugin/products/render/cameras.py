"""Which cameras a render uses: views of the dataset, a path around or through them, those of a file, or a map."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

from unmix_plugin.engine.geometry.camera_paths import interpolated, orbit
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.errors import ConfigError, did_you_mean
from unmix_plugin.products.render import RenderOptions
from unmix_plugin.products.render.maps import MapInfo, map_camera
from unmix_plugin.trained.camera_files import check_frames_per_second, check_size, read_camera_file
from unmix_plugin.trained.measures import Scale
from unmix_plugin.trained.protocol import RenderableScene
from unmix_plugin.trained.run_views import RunView, cameras_of, find_view, resized_views, some_views_of

_PATH_CAMERAS = ("orbit", "interpolate")
_CAMERA_CHOICES = ("dataset-eval", "dataset-train", *_PATH_CAMERAS)
"""Cameras that have a name; any other choice is a map or a file."""

_USUAL_FRAMES = 120
_MOST_FRAMES = 100_000
_GREATEST_DOWNSCALE = 1000
_PROJECTED_CODES = (1024, 32_766)
"""EPSG codes that a GeoTIFF's key of a projected system takes; those of 4000 to 4999 are geographic or geocentric."""
_LEAST_PATH_HEIGHT = 512
"""Rows of videos along a path that is made here, unless a size is asked for."""


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
        return self.views[0].camera.size(0)


def choose_cameras(
    scene: RenderableScene, options: RenderOptions, scale: Scale | None = None
) -> RenderCameras:
    """The cameras asked for; `scale` is that of the world, for maps.

    Raises:
        ConfigError: an unknown choice, a bad file, an impossible size, or options that contradict each other.
    """
    kind, _, direction = options.cameras.partition(":")
    if kind == "map":
        return _map(scene, options, scale, direction or "top")
    for flag, given in (("--epsg", options.epsg), ("--pixel-size", options.pixel_size)):
        if given is not None:
            raise ConfigError(f"{flag} is for --cameras map, not for --cameras {options.cameras}")
    chosen = _from_source(scene, options)
    if options.view:
        names = {find_view(chosen.views, one).name for one in options.view}
        chosen = replace(chosen, views=tuple(view for view in chosen.views if view.name in names))
    if options.fps is not None:
        chosen = replace(chosen, frames_per_second=check_frames_per_second(options.fps, "--fps"))
    return replace(chosen, views=resized_views(chosen.views, _size(chosen.size, options)))


def _from_source(scene: RenderableScene, options: RenderOptions) -> RenderCameras:
    source, count = options.cameras, _USUAL_FRAMES if options.frames is None else options.frames
    if options.frames is not None and source not in _PATH_CAMERAS:
        raise ConfigError(
            f"--frames is for the paths that are made here, {' and '.join(_PATH_CAMERAS)}, not for --cameras {source}"
        )
    if not 1 <= count <= _MOST_FRAMES:
        raise ConfigError(f"--frames {count}: expected 1 to {_MOST_FRAMES}")
    if source in ("dataset-eval", "dataset-train"):
        views = some_views_of(scene.views, "eval" if source == "dataset-eval" else "train")
        return RenderCameras(resized_views(views), False, None)
    if source == "orbit":
        return _path(source, orbit(cameras_of(scene.views, "train"), scene.scene_box, count))
    if source == "interpolate":
        return _path(source, interpolated(cameras_of(scene.views, "eval"), scene.scene_box, count))
    if not source.endswith(".json") and not Path(source).is_file():
        hint = did_you_mean(source, _CAMERA_CHOICES, likeness=0.5, form=" ({})")
        raise ConfigError(
            f"unknown cameras {source!r}{hint}; known are {', '.join(_CAMERA_CHOICES)}, map, and "
            "the path of a camera file (.json)"
        )
    found = read_camera_file(Path(source), scene.frame)
    return RenderCameras(found.views, found.frames_per_second is not None, found.frames_per_second)


def _map(
    scene: RenderableScene, options: RenderOptions, scale: Scale | None, direction: str
) -> RenderCameras:
    given = (options.size, options.downscale, options.frames, options.fps)
    if any(one is not None for one in given) or options.view:
        raise ConfigError(
            "--cameras map has one view of the size that --pixel-size gives; leave out other options of views"
        )
    camera, info = map_camera(scene, scale, direction, options.pixel_size)
    if options.epsg is not None:
        if not _PROJECTED_CODES[0] <= options.epsg <= _PROJECTED_CODES[1] or options.epsg // 1000 == 4:
            raise ConfigError(
                f"--epsg {options.epsg} is no projected coordinate system; expected a code such as 32632 (UTM zone 32N)"
            )
        if direction != "top":
            raise ConfigError(f"--epsg is for maps from above; map:{direction} has no east and north")
        if scale is None or scale.metres_per_unit != 1:
            raise ConfigError(
                "--epsg needs a world in metres, as geo-referenced poses have; this run's scale is another or "
                "unknown: leave --epsg out"
            )
        info = replace(info, epsg=options.epsg)
    name = re.sub(r"[^\w-]+", "_", f"map_{direction}")
    return RenderCameras((RunView(name, camera),), False, None, info)


def _path(name: str, cameras: Cameras) -> RenderCameras:
    views = tuple(RunView(f"{name}_{index:04d}", cameras[index]) for index in range(len(cameras)))
    return RenderCameras(views, True, None)


def _size(size: tuple[int, int], options: RenderOptions) -> tuple[int, int]:
    downscale, asked = options.downscale, options.asked_size()
    if asked is not None and downscale is not None:
        raise ConfigError("--size and --downscale both say how large pictures are; give one of them")
    if asked is not None:
        return check_size(*asked, "--size")
    if downscale is None and options.cameras in _PATH_CAMERAS and size[1] < _LEAST_PATH_HEIGHT:
        return round(size[0] * _LEAST_PATH_HEIGHT / size[1]), _LEAST_PATH_HEIGHT
    if downscale is None:
        return size
    if not 1 / _GREATEST_DOWNSCALE <= downscale <= _GREATEST_DOWNSCALE:
        raise ConfigError(
            f"--downscale {downscale:g}: expected {1 / _GREATEST_DOWNSCALE:g} to {_GREATEST_DOWNSCALE}"
        )
    width, height = (round(side / downscale) for side in size)
    return check_size(width, height, f"--downscale {downscale:g}")
