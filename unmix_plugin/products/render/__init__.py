"""`unmix-render`: views as files. What can be asked for is here, apart from the work, which help need not import."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, fields
from pathlib import Path

from unmix_plugin.errors import ConfigError
from unmix_plugin.figures.look import Look
from unmix_plugin.products.product import EditOptions, RunOptions, SharedViews, WriteOptions


@dataclass(frozen=True)
class RenderOptions(Look, SharedViews, WriteOptions, EditOptions, RunOptions):
    """Render views of a trained run: spectra, pictures, maps and videos, from the run folder alone."""

    output: Path | None = None
    """Folder to write to; None: exports/render in the run folder."""
    cameras: str = "dataset-eval"
    """dataset-eval, dataset-train, orbit (around the scene), interpolate (through the evaluation cameras), map (from
    above without perspective, north up; map:bottom, map:east, map:north, map:west, map:south or map:X,Y,Z: from there),
    or a file: nerfstudio's camera_path.json, or poses as in transforms.json."""
    view: tuple[str, ...] = ()
    """Only these of the cameras, by name or by number from 0."""
    outputs: tuple[str, ...] = ()
    """spectral, reflectance, continuum, derivative, second_derivative, rgb, linear_rgb, diffuse, diffuse_rgb, specular,
    specular_rgb, abundances, abundance:NAME, material_scores, probe_probabilities, segmentation, confidence, depth,
    ray_distance, normals, accumulation, pca, band:650nm, false-colour:860,650,550; index:ndvi or
    index:(r800-r670)/(r800+r670), target:paint.csv or target:ace:paint.csv>0.5, library:mine.csv<0.1 or
    library:angle:mine.csv, absorption:650-700 (depth; or absorption:centre:650-700, absorption:area:650-700),
    interval:abundance, interval:abundance:NAME, interval:band:650nm or interval:index:ndvi (width of the 90 %
    interval); or all (but those with a colon). None given: spectral rgb abundances segmentation depth for single
    views, rgb for a path."""
    formats: tuple[str, ...] = ()
    """envi, exr, npy, png, mp4, tif (GeoTIFF of maps); each output is written in those that suit it. None given:
    what suits each best. mp4 of spectra goes through the bands."""
    size: str | None = None
    """Width and height in pixels, as in 640x480; the vertical field of view stays. None: the dataset's or the file's;
    orbit and interpolate have at least 512 rows."""
    downscale: float | None = None
    """Divide width and height by this."""
    pixel_size: float | None = None
    """Of maps: edge of a pixel in metres, or in units of the world where the run has no scale; None: about that of the
    scene's views."""
    epsg: int | None = None
    """Of maps from above: EPSG code of the projected coordinate system in metres that geo-referenced poses are in, as
    32632 for UTM zone 32N; it is written into the files."""
    frames: int | None = None
    """Number of cameras of orbit or interpolate; None: 120."""
    fps: float | None = None
    """Frames a second of videos; None: as the camera file says, or a default for each kind of video."""
    environment: str | None = None
    """Environment to light an object with: an .exr or .hdr file, or the name of a built-in one; for methods that know
    light and material apart. None: that of the pictures."""
    environment_rotation: float = 0.0
    """Degrees by which the environment is turned about the world's +z."""
    environment_exposure: float = 0.0
    """Stops by which the environment is brighter."""

    def asked_look(self) -> Look:
        """How pictures show it; a ConfigError where a number makes no sense."""
        if not (math.isfinite(self.exposure) and math.isfinite(self.gamma) and self.gamma > 0):
            raise ConfigError(
                f"--exposure {self.exposure:g} and --gamma {self.gamma:g}: expected finite numbers, gamma above 0"
            )
        low, high = self.value_range or (0.0, 1.0)
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            raise ConfigError(
                f"--value-range {low:g} {high:g}: expected two finite numbers, the lower one first"
            )
        return Look(**{one.name: getattr(self, one.name) for one in fields(Look)})

    def asked_size(self) -> tuple[int, int] | None:
        """Width and height that --size says; a ConfigError where it does not say them."""
        if self.size is None:
            return None
        match = re.fullmatch(r"(\d{1,9})[xX*](\d{1,9})", self.size)
        if match is None:
            raise ConfigError(f"--size {self.size}: expected width and height in pixels, as in 640x480")
        return int(match[1]), int(match[2])
