"""Poses estimated from the pictures themselves: structure from motion with COLMAP, one lens a sensor.

COLMAP runs as a process of its own, `python -m unmix_plugin.captures.poses.estimation SETTINGS.json`, because it ends
the one that it runs in when a check of its own fails, can't be interrupted, and talks to standard error.

Notation: `H x W` pixels, `B` bands.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import json
import os
import re
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Shaped, UInt8

from unmix_plugin.captures.names import natural_order
from unmix_plugin.captures.poses.colmap import read_colmap
from unmix_plugin.captures.poses.pose_set import PoseSet
from unmix_plugin.engine.children import child_command
from unmix_plugin.errors import CaptureError, install_hint, name_some

_LEAST_VIEWS = 3
_LEAST_SHARE = 0.5
"""Of the views; with fewer registered ones the poses are refused."""
_MOST_EXHAUSTIVE = 100
"""Views up to which all pairs are matched; beyond, neighbours in the order of names."""
_RIM_PX = 4
"""Beside the edge of a mask, where features are those of the silhouette and not of the surface."""
_PERCENTILES = (1.0, 99.5)
_GAMMA = 0.5
"""Values are light; shadows need the room that eyes, and detectors made for photographs, expect."""
_LOCAL_CONTRAST, _TILES = 0.02, 8
"""A side is cut into so many tiles, each with a contrast of its own."""
_ENOUGH = 0.9
"""Share of registered images with which no other focal length is tried."""
_FOCAL_FACTORS = (1.2, 3.0, 7.0)
"""First focal lengths to try, over the longer side: wide, tele and far lenses."""
_PEAK_THRESHOLD = 0.003
"""Of features: half of COLMAP's, as objects in a laboratory have less texture than a street."""
_MOST_FEATURES = 8192
"""Of a picture."""
_SEED = 0
_GAIN = 0.02
"""Part of the reprojection error that distortion has to remove to be kept."""
_MOST_DISTORTION = 0.1
"""Of half the diagonal: what distortion may move the corner of a picture by."""
_LOG, _RESULT, _REPORT, _DRAWN = "colmap.log", "found.json", "report.txt", "worst-matches.png"
WORK_FILES = re.compile(
    r"(images|masks)/\d{6,}\.png(\.png)?|database\.db(-wal|-shm|-journal)?|matched\.txt|settings\.json|colmap\.log|"
    r"found\.json|report\.txt|worst-matches\.png|models/[^/]+/(\d+/)?\w+\.(bin|txt|ini)"
)
"""Names of the files that an estimation leaves in its folder."""
_FEW_FEATURES, _FEW_MATCHES = 400, 60
"""Of a view, and with the view that shares most with it, below which these are what is missing."""
_STILL_PX, _MOSTLY_STILL = 1.5, 0.5
"""Distance by which matched points hardly move, and the share of such points that tells of a still background."""
_MOST_WORST = 3
"""Views whose matches are drawn."""
_SMALLER_STEPS = "take more views in smaller steps (10 degrees) with much overlap"
_TEXTURE = (
    "put printed markers or texture beside the object (for markers: --poses markers --marker-size METRES)"
)
_STILL = "mask a background that stands still while the object turns (--mask black, white or files)"
_OTHER_POSES = "give poses of another program with --poses FILE"


def require_pycolmap() -> None:
    """Look, before anything is computed, whether COLMAP is there. Raises CaptureError: it is not."""
    if importlib.util.find_spec("pycolmap") is None:
        raise CaptureError(
            f"poses can't be estimated: pycolmap is not installed: {install_hint('sfm')}, or give other poses"
        )


def estimate_poses(
    pictures: Mapping[str, UInt8[np.ndarray, "H W"]],
    folder: Path,
    sensor_of: Mapping[str, str] | None = None,
    masks: Mapping[str, Bool[np.ndarray, "H W"]] | None = None,
    threads: int | None = None,
) -> PoseSet:
    """Find where pictures were taken from.

    Args:
        pictures: By the name of the view; with high contrast (see `contrast_picture`).
        folder: For COLMAP's files and its log; is made.
        sensor_of: Sensor of each view; views of one have one lens and one size. None is one for all.
        masks: True on the foreground; features are found there, but not on its rim.
        threads: None takes those of the machine, at most 8; with 1 the same pictures give the same poses to the bit.
    Returns:
        Poses by the name of the view, in an arbitrary world (`has_world` is False).
    Raises:
        CaptureError: pycolmap is not installed, or fewer than half of the views, or than 3, could be registered.
    """
    from PIL import Image
    from scipy.ndimage import binary_erosion

    require_pycolmap()
    if len(pictures) < _LEAST_VIEWS:
        raise CaptureError(f"{len(pictures)} views; at least {_LEAST_VIEWS} are needed: {_SMALLER_STEPS}")
    ordered = sorted(pictures, key=natural_order)
    files = {name: f"{index:06d}.png" for index, name in enumerate(ordered)}
    shown = {"images": {files[name]: picture for name, picture in pictures.items()}}
    if masks is not None:
        shown["masks"] = {
            f"{files[name]}.png": 255 * binary_erosion(mask, iterations=_RIM_PX).astype(np.uint8)
            for name, mask in masks.items()
        }
    digest = hashlib.sha256()  # what tells whether an earlier try looked at the same
    for kind, shown_of_kind in shown.items():
        (folder / kind).mkdir(parents=True, exist_ok=True)
        for name, pixels in shown_of_kind.items():
            Image.fromarray(pixels).save(folder / kind / name)
            digest.update(f"{kind}/{name} {pixels.shape}".encode() + pixels.tobytes())
    sensors: dict[str, list[str]] = {}
    for name in ordered:
        sensors.setdefault((sensor_of or {}).get(name, ""), []).append(files[name])
    settings = {
        "folder": str(folder.resolve()),
        "sensors": list(sensors.values()),
        "has_masks": masks is not None,
        "sequential": len(pictures) > _MOST_EXHAUSTIVE,
        "threads": threads or min(os.cpu_count() or 1, 8),
        "pictures": digest.hexdigest(),
    }
    found = _run(settings, folder)
    # The model with the most views, that with the smaller error where two have as many.
    views = found["views"]
    best = max(found["models"], key=lambda model: (model["registered"], -model["error_px"]), default=None)
    registered = 0 if best is None else best["registered"]
    if best is None or registered < max(_LEAST_VIEWS, _LEAST_SHARE * len(files)):
        findings, advice = _explain(views, files, folder)
        raise CaptureError(
            f"poses of only {registered} of {len(files)} views could be estimated; expected at least half. {findings}. "
            f"Try: {advice}. {folder / _REPORT} and {folder / _DRAWN} show the worst views"
        )
    poses = read_colmap(Path(best["folder"]))
    cameras = {name: poses.cameras[file] for name, file in files.items() if file in poses.cameras}
    missing = [name for name in files if name not in cameras]
    error = f"a mean reprojection error of {best['error_px']:.2f} px"
    notes = [f"COLMAP registered {registered} of {len(files)} views with {error}"]
    if missing:
        matches = ", ".join(f"{name} ({views[files[name]]['most']})" for name in missing[:_MOST_WORST])
        notes.append(f"views without pose: {name_some(missing)}; matches with the nearest view: {matches}")
    notes += poses.notes
    return replace(poses, cameras=cameras, source="estimated by COLMAP", has_world=False, notes=tuple(notes))


def _run(settings: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Start the process that reconstructs, with its output in the log file; or take what an earlier try found."""
    result, asked, wanted = folder / _RESULT, folder.resolve() / "settings.json", json.dumps(settings)
    if result.is_file() and asked.is_file() and asked.read_text(encoding="utf-8") == wanted:
        with contextlib.suppress(ValueError):  # cut short by a kill: found anew
            return json.loads(result.read_text(encoding="utf-8"))
    result.unlink(missing_ok=True)
    asked.write_text(wanted, encoding="utf-8")
    command = child_command("unmix_plugin.captures.poses.estimation", [str(asked)])
    with (folder / _LOG).open("wb") as log:
        ran = subprocess.run(command, stdout=log, stderr=log, stdin=subprocess.DEVNULL, check=False)
    if ran.returncode != 0 or not result.is_file():
        *_, last = ["without a word", *(folder / _LOG).read_text("utf-8", "replace").strip().splitlines()]
        raise CaptureError(f"COLMAP stopped with status {ran.returncode} ({last}); see {folder / _LOG}")
    return json.loads(result.read_text(encoding="utf-8"))


def _explain(views: dict[str, Any], files: Mapping[str, str], folder: Path) -> tuple[str, str]:
    """What was found of features and matches, and what to try, most likely first; writes report and picture."""
    names = {file: name for name, file in files.items()}
    order = sorted(views, key=lambda file: views[file]["most"])
    features, usual, still, matched = (
        [view[key] for view in views.values()] for key in ("features", "most", "still", "matched")
    )
    share = sum(still) / max(1, sum(matched))
    tries = [_SMALLER_STEPS, _TEXTURE, _STILL]
    if np.median(features) < _FEW_FEATURES:
        tries.sort(key=lambda what: what != _TEXTURE)
    worst = ", ".join(f"{names[file]} ({views[file]['most']})" for file in order[:_MOST_WORST])
    findings = (
        f"In the mean of all bands, views have {np.median(features):.0f} features and share {np.median(usual):.0f} "
        f"with the view nearest to them (medians; {_FEW_FEATURES} and {_FEW_MATCHES} or more serve); the fewest: "
        f"{worst}"
    )
    if share > _MOSTLY_STILL:
        tries.sort(key=lambda what: what != _STILL)
        findings += f"; {share:.0%} of the matches stand still in the picture, as a background does"
    lines = ["Poses could not be estimated.", "", findings + ".", "", "Try, the most likely first:"]
    lines += [f"- {what}" for what in (*tries, _OTHER_POSES)]
    lines += ["", "view: features, matches with the view that shares most, its name"]
    for file in order:
        view, partner = views[file], names.get(views[file]["best"], "no other view")
        lines.append(f"{names[file]}: {view['features']}, {view['most']}, {partner}")
    (folder / _REPORT).write_text("\n".join(lines) + "\n", encoding="utf-8")
    from PIL import Image, ImageDraw

    rows = []  # each of the worst views beside the one that shares most with it, and lines between matched points
    for file in order[:_MOST_WORST]:
        best = folder / "images" / (views[file]["best"] or file)
        with Image.open(folder / "images" / file) as first, Image.open(best) as second:
            row = Image.new("RGB", (first.width + second.width, max(first.height, second.height)))
            row.paste(first.convert("RGB"), (0, 0))
            row.paste(second.convert("RGB"), (first.width, 0))
            draw = ImageDraw.Draw(row)
            for x, y, other_x, other_y in views[file]["lines"]:
                draw.line((x, y, other_x + first.width, other_y), fill=(255, 0, 200))
        rows.append(row)
    sheet = Image.new("RGB", (max(row.width for row in rows), sum(row.height for row in rows)))
    for index, row in enumerate(rows):
        sheet.paste(row, (0, sum(above.height for above in rows[:index])))
    sheet.save(folder / _DRAWN)
    return findings, "; ".join(tries)


def contrast_picture(
    cube: Shaped[np.ndarray, "H W B"], full_scale: float, valid: Bool[np.ndarray, "H W"]
) -> UInt8[np.ndarray, "H W"]:
    """A picture in which features are found: the mean of all bands, stretched, with local contrast.

    Args:
        cube: May lie on disk; some rows are read at a time.
        full_scale: Number that stands for 1.
        valid: Pixels that count for the stretch; others become black, as do those that are not finite.
    """
    from skimage.exposure import equalize_adapthist

    height, width, bands = cube.shape
    mean = np.empty((height, width), np.float32)
    weights = np.full(bands, 1.0 / bands / full_scale, np.float32)
    for start in range(0, height, 64):
        mean[start : start + 64] = cube[start : start + 64].astype(np.float32) @ weights
    counts = valid & np.isfinite(mean)
    if not counts.any():
        return np.zeros(mean.shape, np.uint8)
    low, high = np.percentile(mean[counts], _PERCENTILES)
    if high <= low:
        return np.where(counts, np.uint8(128), np.uint8(0))
    level = np.clip((np.where(counts, mean, low) - low) / (high - low), 0.0, 1.0) ** _GAMMA
    tile = [max(side // _TILES, 1) for side in mean.shape]
    local = equalize_adapthist(level, kernel_size=tile, clip_limit=_LOCAL_CONTRAST)
    return np.where(counts, np.round(255.0 * local), 0.0).astype(np.uint8)


def _reconstruct(path: Path) -> None:
    """Write `found.json`: folder, registered images and reprojection error of each model, and `_matches_of_views`.
    Files of an earlier try of the same pictures are used again.

    The settings: `folder`, with `images` and, where `has_masks`, `masks` (IMAGE.png, black where no features are
    wanted); `sensors`, names of image files with one lens each; `sequential`, whether to match neighbours in the order
    of names alone; `threads`; and the digest of all `pictures`.
    """
    import pycolmap

    settings = json.loads(path.read_text(encoding="utf-8"))
    pycolmap.set_random_seed(_SEED)
    folder = Path(settings["folder"])
    database, matched = folder / "database.db", folder / "matched.txt"
    if not (database.is_file() and matched.is_file() and matched.read_text() == settings["pictures"]):
        database.unlink(missing_ok=True)
        features = pycolmap.FeatureExtractionOptions()
        features.num_threads, features.use_gpu = settings["threads"], False
        features.sift.max_num_features, features.sift.peak_threshold = _MOST_FEATURES, _PEAK_THRESHOLD
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = "SIMPLE_RADIAL"  # a lens with one number of distortion
        if settings["has_masks"]:
            reader.mask_path = folder / "masks"
        for names in settings["sensors"]:
            pycolmap.extract_features(
                database,
                folder / "images",
                image_names=names,
                camera_mode=pycolmap.CameraMode.SINGLE,
                reader_options=reader,
                extraction_options=features,
                device=pycolmap.Device.cpu,
            )
        matching, verification = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
        matching.num_threads, matching.use_gpu = settings["threads"], False
        verification.ransac.random_seed = _SEED
        match = pycolmap.match_sequential if settings["sequential"] else pycolmap.match_exhaustive
        match(
            database,
            matching_options=matching,
            verification_options=verification,
            device=pycolmap.Device.cpu,
        )
        matched.write_text(settings["pictures"])
    count = sum(map(len, settings["sensors"]))
    found: list[dict[str, Any]] = []
    for factor in _FOCAL_FACTORS:
        # All lenses start from a focal length of so many times the longer side, without distortion.
        with pycolmap.Database.open(database) as opened:
            for camera in opened.read_all_cameras():
                values = np.zeros(len(camera.params))
                values[list(camera.focal_length_idxs())] = factor * max(camera.width, camera.height)
                values[list(camera.principal_point_idxs())] = camera.width / 2, camera.height / 2
                camera.params = values.tolist()
                opened.update_camera(camera)
        found += _map(pycolmap, settings, database, folder / "models" / f"{factor:g}")
        if max((model["registered"] for model in found), default=0) >= _ENOUGH * count:
            break
    result = {"models": found, "views": _matches_of_views(pycolmap, database)}
    (folder / _RESULT).write_text(json.dumps(result), encoding="utf-8")


def _matches_of_views(pycolmap: Any, database: Path) -> dict[str, Any]:
    """By image: its `features`; verified matches with all others (`matched`) and how many of them stand `still`; and of
    the pair with the `most`, the other image (`best`) and matched points x, y, x, y (`lines`)."""
    with pycolmap.Database.open(database) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        points = {number: opened.read_keypoints(number)[:, :2] for number in names}
        nothing = {"matched": 0, "still": 0, "most": 0, "best": None, "lines": []}
        views = {name: {"features": len(points[number]), **nothing} for number, name in names.items()}
        pairs, geometries = opened.read_two_view_geometries()
        for pair, geometry in zip(pairs, geometries, strict=True):
            first, second = pycolmap.pair_id_to_image_pair(pair)
            inliers = np.asarray(geometry.inlier_matches, int).reshape(-1, 2)
            ends = points[first][inliers[:, 0]], points[second][inliers[:, 1]]
            still = int((np.linalg.norm(ends[0] - ends[1], axis=1) < _STILL_PX).sum())
            for here, there, points_here, points_there in (
                (first, second, *ends),
                (second, first, *ends[::-1]),
            ):
                view = views[names[here]]
                view |= {"matched": view["matched"] + len(inliers), "still": view["still"] + still}
                if len(inliers) > view["most"]:
                    lines = np.hstack([points_here, points_there]).round(1).tolist()[:200]
                    view |= {"most": len(inliers), "best": names[there], "lines": lines}
    return views


def _map(pycolmap: Any, settings: dict[str, Any], database: Path, output: Path) -> list[dict[str, Any]]:
    """Models from one first focal length, without distortion, which a few views of a far lens would let run away; it is
    refined afterwards, where that is better and stays small."""
    output.mkdir(parents=True, exist_ok=True)
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = settings["threads"], _SEED
    options.min_model_size = _LEAST_VIEWS
    options.max_num_models = 5
    options.ba_refine_extra_params = options.mapper.abs_pose_refine_extra_params = False
    options.max_focal_length_ratio = options.mapper.max_focal_length_ratio = 50.0
    options.triangulation.max_focal_length_ratio = 50.0
    options.mapper.random_seed = options.triangulation.random_seed = _SEED
    options.mapper.init_min_tri_angle, options.mapper.init_min_num_inliers = 8.0, 50
    options.mapper.abs_pose_min_num_inliers, options.mapper.abs_pose_min_inlier_ratio = 15, 0.15
    models = pycolmap.incremental_mapping(database, Path(settings["folder"]) / "images", output, options)
    found = []
    for number, model in models.items():
        place = output / str(number)
        refined = pycolmap.Reconstruction(model)
        bundle = pycolmap.BundleAdjustmentOptions()
        bundle.refine_extra_params, bundle.print_summary = True, False
        pycolmap.bundle_adjustment(refined, bundle)
        limit = (1.0 - _GAIN) * model.compute_mean_reprojection_error()
        is_better = refined.compute_mean_reprojection_error() < limit
        if not (is_better and all(map(_is_plausible, refined.cameras.values()))):
            refined = model
        refined.write(place)
        error = refined.compute_mean_reprojection_error()
        found.append({"folder": str(place), "registered": refined.num_reg_images(), "error_px": error})
    return found


def _is_plausible(camera: Any) -> bool:
    """Whether distortion moves the corners of the picture by a small part of the diagonal."""
    corners = np.array([[0.0, 0.0], [camera.width, 0.0], [0.0, camera.height], [camera.width, camera.height]])
    away = corners - (camera.principal_point_x, camera.principal_point_y)
    ideal = away / (camera.focal_length_x, camera.focal_length_y)
    distorted = camera.img_from_cam(np.column_stack([ideal, np.ones(4)]))
    limit = _MOST_DISTORTION * 0.5 * np.hypot(camera.width, camera.height)
    return bool(np.isfinite(distorted).all() and np.linalg.norm(distorted - corners, axis=1).max() < limit)


if __name__ == "__main__":
    _reconstruct(Path(sys.argv[1]))
