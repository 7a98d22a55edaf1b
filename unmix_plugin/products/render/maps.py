"""Orthographic views of a scene as maps: from above with north up, or square to any direction; and their map info.

Map coordinates are metres where the scene's scale is known, otherwise units of its world. From above, x is the world's
x (east) and y its y (north); so maps of geo-referenced scenes have the coordinates of their frame. Seen from the side,
up is the world's z. Where an axis of the image runs against one of the world (from below, north or west) or along none,
files say the size of pixels but no coordinates: a GIS would put the map in mirror image, or where it is not.

Source: GeoTIFF 1.1, OGC 19-008r4 (tags and keys); ENVI header format (map info).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import RayBundle
from unmix_plugin.errors import ConfigError
from unmix_plugin.trained.camera_files import check_size
from unmix_plugin.trained.measures import Scale
from unmix_plugin.trained.protocol import RenderableScene

_DIRECTIONS = {
    "top": (0.0, 0.0, 1.0),
    "bottom": (0.0, 0.0, -1.0),
    "east": (1.0, 0.0, 0.0),
    "west": (-1.0, 0.0, 0.0),
    "north": (0.0, 1.0, 0.0),
    "south": (0.0, -1.0, 0.0),
}
"""From where one looks, in the world; the first is what `map` alone means."""
_USUAL_PIXELS = 512
"""Along the longest side, where nothing says how large pixels are."""
_UTM_HALVES = {326: "North", 327: "South"}
"""Hundreds of the EPSG codes of WGS 84 / UTM, whose zones ENVI headers know by number."""
_GDAL_METADATA = 42112
"""Tag of GDAL's."""
_OUTSIDE = 1.01
"""Where rays start, in half diagonals of the scene box from its middle."""


class _OrthographicCameras(Cameras):
    """Cameras whose rays are parallel to their axis; `focal_px` is pixels in a unit of length."""

    def generate_rays(
        self, camera_indices: Int[Tensor, " R"], pixel_coords: Float[Tensor, "R 2"]
    ) -> RayBundle:
        """Rays through points of the images."""
        offsets = (pixel_coords - self.center_px[camera_indices]) / self.focal_px[camera_indices]
        poses = self.camera_to_world[camera_indices]
        origins = poses[:, :, 3] + offsets[:, :1] * poses[:, :, 0] - offsets[:, 1:] * poses[:, :, 1]
        backward = poses[:, :, 2]
        return RayBundle(origins, (-backward).contiguous(), camera_indices, -backward, pixel_coords)

    def project(
        self, points: Float[Tensor, "P 3"], index: int
    ) -> tuple[Float[Tensor, "P 2"], Float[Tensor, " P"]]:
        """Pixel coordinates and depths of points."""
        pose = self.camera_to_world[index]
        local = (points - pose[:, 3]) @ pose[:, :3]
        coords = torch.stack([local[:, 0], -local[:, 1]], dim=-1)
        return coords * self.focal_px[index] + self.center_px[index], -local[:, 2]

    def resized(self, width: int, height: int) -> Cameras:
        """The same part of the map with another number of pixels."""
        factors = torch.tensor([[width / self.width, height / self.height]])
        parts = (self.focal_px * factors.to(self.focal_px), self.center_px * factors.to(self.center_px))
        return _OrthographicCameras(self.camera_to_world, *parts, self.distortion, width, height)


@dataclass(frozen=True)
class MapInfo:
    """Where a map lies."""

    left: float
    """x of the left edge of the first column, map coordinates."""
    top: float
    """y of the upper edge of the first row."""
    pixel: float
    """Edge of a pixel."""
    metres_per_unit: float | None
    """Of the world, where coordinates and lengths are metres; None: they are in units of the world."""
    epsg: int | None = None
    """EPSG code of the projected coordinate system; None where it is unknown."""
    has_coordinates: bool = True
    """Whether columns and rows run along axes of the world, so that `left` and `top` are coordinates of it."""

    @property
    def is_metric(self) -> bool:
        """Whether coordinates and lengths are metres."""
        return self.metres_per_unit is not None

    @property
    def envi(self) -> dict[str, Any]:
        """Entries of an ENVI header; pixels are counted from 1, whose corner (1, 1) is that of the first pixel."""
        units = f"units={'Meters' if self.is_metric else 'Unknown'}"
        if not self.has_coordinates:
            return {"pixel size": [self.pixel, self.pixel, units]}
        place = [1.0, 1.0, self.left, self.top, self.pixel, self.pixel]
        half, zone = divmod(self.epsg or 0, 100)
        if half in _UTM_HALVES and 1 <= zone <= 60:
            return {"map info": ["UTM", *place, zone, _UTM_HALVES[half], "WGS-84", units]}
        return {"map info": ["Arbitrary", *place, units]}

    @property
    def geotiff(self) -> list[tuple[int, int, int, Any, bool]]:
        """Tags of a GeoTIFF as tifffile takes them: pixel scale, tie point, keys; none without coordinates."""
        if not self.has_coordinates:
            return []
        known = None if self.epsg is None else f"EPSG:{self.epsg}|"
        citation = known or (
            "unmix-nerf map, local metres|" if self.is_metric else "unmix-nerf map, units of the scene|"
        )
        keys = [
            (1024, 0, 1, 1 if self.is_metric else 32767),  # GTModelType: projected, or user-defined
            (1025, 0, 1, 1),  # GTRasterType: a pixel is an area
            (1026, 34737, len(citation), 0),  # GTCitation
        ]
        if self.epsg is not None:
            keys += [(3072, 0, 1, self.epsg)]  # ProjectedCRS
        elif self.is_metric:
            keys += [(3072, 0, 1, 32767), (3074, 0, 1, 32767), (3076, 0, 1, 9001)]  # user-defined, metres
        directory = [1, 1, 1, len(keys), *(number for key in keys for number in key)]
        return [
            (33550, 12, 3, (self.pixel, self.pixel, 0.0), True),
            (33922, 12, 6, (0.0, 0.0, 0.0, self.left, self.top, 0.0), True),
            (34735, 3, len(directory), tuple(directory), True),
            (34737, 2, len(citation) + 1, citation, True),
        ]


def gdal_metadata(
    names: Sequence[str], centers_nm: Sequence[float] = (), widths_nm: Sequence[float] = ()
) -> tuple[int, int, int, bytes, bool]:
    """GDAL's own tag of a TIFF as tifffile takes it: the description of each band, and where it is of one wavelength
    that and its width, both as the IMAGERY domain of GDAL has them and as its ENVI driver reads them.

    Source: GDAL documentation, GTiff driver (GDAL_METADATA) and raster data model (IMAGERY domain).
    """
    items = [(name, index, "DESCRIPTION", ' role="description"') for index, name in enumerate(names)]
    for index, nm in enumerate(centers_nm):
        items += [(f"{nm:.9g}", index, "wavelength", ""), ("Nanometers", index, "wavelength_units", "")]
        items.append((f"{nm / 1000:.9g}", index, "CENTRAL_WAVELENGTH_UM", ' domain="IMAGERY"'))
    for index, nm in enumerate(widths_nm):
        items.append((f"{nm / 1000:.9g}", index, "FWHM_UM", ' domain="IMAGERY"'))
    lines = [
        f'  <Item name="{key}" sample="{index}"{where}>{escape(text)}</Item>'
        for text, index, key, where in items
    ]
    text = "\n".join(["<GDALMetadata>", *lines, "</GDALMetadata>"]).encode("utf-8", "replace") + b"\0"
    return (_GDAL_METADATA, 2, len(text), text, True)


def map_camera(
    scene: RenderableScene, scale: Scale | None, direction: str, pixel_size: float | None
) -> tuple[Cameras, MapInfo]:
    """An orthographic camera that has all of the scene box in its image, and where its map lies.

    Args:
        scene, scale: Of any method, and of its world.
        direction: From where one looks: one of `_DIRECTIONS`, or x,y,z of the world.
        pixel_size: Edge of a pixel, metres or units of the world; None: that of the scene's own views.
    """
    axes, frame = _axes(direction), scene.frame
    metres = 1.0 if scale is None else scale.metres_per_unit
    corners = np.stack(np.meshgrid(*scene.scene_box.aabb.T.cpu().double().numpy()), -1).reshape(-1, 3)
    flat = frame.to_world(corners) @ axes.T * metres
    low, high = flat.min(axis=0), flat.max(axis=0)
    if pixel_size is None:
        own = None if scene.pixel_size is None else scene.pixel_size * metres / frame.scale
        pixel_size = own or float((high - low)[:2].max()) / _USUAL_PIXELS
        pixel_size = float(f"{pixel_size:.2g}")
    if not 0 < pixel_size < math.inf:
        raise ConfigError(f"--pixel-size is {pixel_size:g}; it must be greater than 0")
    width, height = (max(1, math.ceil(side / pixel_size - 1e-6)) for side in (high - low)[:2])
    check_size(width, height, f"--pixel-size {pixel_size:g}")
    info = MapInfo(
        float(low[0]),
        float(high[1]),
        pixel_size,
        None if scale is None else metres,
        has_coordinates=bool((axes[:2].max(axis=1) > 1 - 1e-9).all()),  # unit vectors
    )
    middle = np.array(
        [low[0] + width * pixel_size / 2, high[1] - height * pixel_size / 2, (low[2] + high[2]) / 2]
    )
    middle[2] += _OUTSIDE * float(np.linalg.norm(high - low)) / 2
    place = frame.to_model(middle / metres @ axes)
    pose = np.column_stack([frame.rotation @ axes.T, place])
    camera = _OrthographicCameras(
        torch.from_numpy(pose).float()[None],
        torch.full((1, 2), metres / (pixel_size * frame.scale)),
        torch.tensor([[width / 2, height / 2]]),
        torch.zeros(1, 4),
        width,
        height,
    )
    return camera, info


def _axes(direction: str) -> Float64[np.ndarray, "3 3"]:
    """Rows: right, up and towards the viewer, unit vectors of the world."""
    if direction in _DIRECTIONS:
        back = np.array(_DIRECTIONS[direction])
    else:
        try:
            back = np.array([float(part) for part in direction.split(",")])
        except ValueError:
            back = np.zeros(0)
        length = float(np.linalg.norm(back))
        if len(back) != 3 or not 0 < length < math.inf:
            raise ConfigError(
                f"--cameras map:{direction}: expected {', '.join(_DIRECTIONS)}, or a direction x,y,z of the world to "
                "look from"
            )
        back = back / length
    up = np.array([0.0, 1.0, 0.0]) if abs(back[2]) > 1 - 1e-6 else np.array([0.0, 0.0, 1.0])
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(back, right), back])
