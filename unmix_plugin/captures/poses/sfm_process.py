"""Structure from motion with pycolmap, as a process of its own: `python -m ... SETTINGS.json`.

A process, because COLMAP ends the one that it runs in when a check of its own fails, can't be interrupted, and talks to
standard error.
"""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

LEAST_MODEL = 3
"""Images of the smallest model that is kept."""
ENOUGH = 0.9
"""Share of registered images with which no other focal length is tried."""
FOCAL_FACTORS = (1.2, 3.0, 7.0)
"""First focal lengths to try, over the longer side: wide, tele and far lenses."""
PEAK_THRESHOLD = 0.003
"""Of features: half of COLMAP's, as matter in a laboratory has less texture than a street."""
CAMERA_MODEL = "SIMPLE_RADIAL"
"""COLMAP's name of a lens with one number of distortion."""
MOST_FEATURES = 8192
"""Of a picture."""
SEED = 0
GAIN = 0.02
"""Part of the reprojection error that distortion has to remove to be kept."""
GREATEST_BEND = 0.1
"""Of half the diagonal: what distortion may move the corner of a picture by."""


@dataclass(frozen=True)
class SfmSettings:
    """What to reconstruct."""

    folder: str
    """Holds `images` and gets `database.db` and `models`."""
    sensors: tuple[tuple[str, ...], ...]
    """Names of image files with one lens each."""
    has_masks: bool
    """Whether `masks` holds IMAGE.png for images, black where no features are wanted."""
    sequential: bool
    """Match neighbours in the order of names instead of all pairs."""
    threads: int


def write_settings(settings: SfmSettings) -> Path:
    """The file to start the process with."""
    path = Path(settings.folder) / "settings.json"
    path.write_text(json.dumps(asdict(settings)), encoding="utf-8")
    return path


def main(path: Path) -> None:
    """Reconstruct, and write `result.json`: folder, registered images and reprojection error of each model."""
    import pycolmap

    values = json.loads(path.read_text(encoding="utf-8"))
    settings = SfmSettings(**{**values, "sensors": tuple(map(tuple, values["sensors"]))})
    pycolmap.set_random_seed(SEED)
    folder = Path(settings.folder)
    database = folder / "database.db"
    database.unlink(missing_ok=True)
    _extract(pycolmap, settings, database)
    _match(pycolmap, settings, database)
    count = sum(map(len, settings.sensors))
    found: list[dict[str, Any]] = []
    for factor in FOCAL_FACTORS:
        _set_focal(pycolmap, database, factor)
        found += _map(pycolmap, settings, database, folder / "models" / f"{factor:g}")
        if max((model["registered"] for model in found), default=0) >= ENOUGH * count:
            break
    (folder / "result.json").write_text(json.dumps(found), encoding="utf-8")


def _extract(pycolmap: Any, settings: SfmSettings, database: Path) -> None:
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads, options.use_gpu = settings.threads, False
    options.sift.max_num_features, options.sift.peak_threshold = MOST_FEATURES, PEAK_THRESHOLD
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = CAMERA_MODEL
    if settings.has_masks:
        reader.mask_path = Path(settings.folder) / "masks"
    for names in settings.sensors:
        pycolmap.extract_features(
            database,
            Path(settings.folder) / "images",
            image_names=list(names),
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reader,
            extraction_options=options,
            device=pycolmap.Device.cpu,
        )


def _match(pycolmap: Any, settings: SfmSettings, database: Path) -> None:
    options = pycolmap.FeatureMatchingOptions()
    options.num_threads, options.use_gpu = settings.threads, False
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    match = pycolmap.match_sequential if settings.sequential else pycolmap.match_exhaustive
    match(database, matching_options=options, verification_options=verification, device=pycolmap.Device.cpu)


def _set_focal(pycolmap: Any, database: Path, factor: float) -> None:
    """Start all lenses from a focal length of so many times the longer side, without distortion."""
    with pycolmap.Database.open(database) as opened:
        for camera in opened.read_all_cameras():
            values = np.zeros(len(camera.params))
            values[list(camera.focal_length_idxs())] = factor * max(camera.width, camera.height)
            values[list(camera.principal_point_idxs())] = camera.width / 2, camera.height / 2
            camera.params = values
            opened.update_camera(camera)


def _map(pycolmap: Any, settings: SfmSettings, database: Path, output: Path) -> list[dict[str, Any]]:
    """Models from one first focal length, without distortion, which a few views of a far lens would let run away."""
    output.mkdir(parents=True, exist_ok=True)
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed, options.min_model_size = (
        settings.threads,
        SEED,
        LEAST_MODEL,
    )
    options.max_num_models = 5
    options.ba_refine_extra_params = options.mapper.abs_pose_refine_extra_params = False
    options.max_focal_length_ratio = options.mapper.max_focal_length_ratio = 50.0
    options.triangulation.max_focal_length_ratio = 50.0
    options.mapper.random_seed = options.triangulation.random_seed = SEED
    options.mapper.init_min_tri_angle, options.mapper.init_min_num_inliers = 8.0, 50
    options.mapper.abs_pose_min_num_inliers, options.mapper.abs_pose_min_inlier_ratio = 15, 0.15
    models = pycolmap.incremental_mapping(database, Path(settings.folder) / "images", output, options)
    found = []
    for number, model in models.items():
        place = output / str(number)
        bent = _with_distortion(pycolmap, model)
        bent.write(place)
        error = bent.compute_mean_reprojection_error()
        found.append({"folder": str(place), "registered": bent.num_reg_images(), "error_px": error})
    return found


def _with_distortion(pycolmap: Any, model: Any) -> Any:
    """The model with distortion refined too, where that is better and stays small; otherwise as it was."""
    bent = pycolmap.Reconstruction(model)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_extra_params, options.print_summary = True, False
    pycolmap.bundle_adjustment(bent, options)
    is_better = (
        bent.compute_mean_reprojection_error() < (1.0 - GAIN) * model.compute_mean_reprojection_error()
    )
    return bent if is_better and all(map(_is_plausible, bent.cameras.values())) else model


def _is_plausible(camera: Any) -> bool:
    """Whether distortion moves the corners of the picture by a small part of the diagonal."""
    corners = np.array([[0.0, 0.0], [camera.width, 0.0], [0.0, camera.height], [camera.width, camera.height]])
    away = corners - (camera.principal_point_x, camera.principal_point_y)
    ideal = away / (camera.focal_length_x, camera.focal_length_y)
    bent = camera.img_from_cam(np.column_stack([ideal, np.ones(4)]))
    limit = GREATEST_BEND * 0.5 * np.hypot(camera.width, camera.height)
    return bool(np.isfinite(bent).all() and np.linalg.norm(bent - corners, axis=1).max() < limit)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
