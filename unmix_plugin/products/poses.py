"""Cameras of all views with their poses as training corrected them, in the forms that other programs open.

`transforms.json` is nerfstudio's (also of Brush, instant-ngp, Postshot), with a lens in each frame; `sparse/0` is a
COLMAP model as text. Both name the pictures images/NAME.png, which are copied from the scene where it still lies.
Cameras with the higher radial terms k3, k4 have COLMAP's FULL_OPENCV, which has k3 and no k4. Line cameras have
`key_poses` in transforms.json, which no other program follows, and are left out of the model.

Sources: nerfstudio 1.1, data conventions; COLMAP, output format and camera models (world to camera, OpenCV's axes).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from unmix_plugin.formats.files import make_folder, write_file
from unmix_plugin.limits import MOST_TABLE_BYTES, read_bounded
from unmix_plugin.products.product import Job
from unmix_plugin.products.scene_products import Poses
from unmix_plugin.scenes.folder import METRES_KEY, transforms_bytes
from unmix_plugin.scenes.scene import Normalisation
from unmix_plugin.trained.camera_files import camera_entry
from unmix_plugin.trained.run_views import RunView

_PICTURES, _MODEL = "images", Path("sparse") / "0"
_FLIP = np.diag([1.0, -1.0, -1.0])
"""From OpenGL's axes of the camera to OpenCV's."""
_LENS = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2")


def export(job: Job, _: Poses) -> list[Path]:
    """Write transforms.json, a COLMAP model, and the pictures that both name."""
    scene = job.loaded.scene
    root = Path(str(job.loaded.record.summary.get("root", "")))
    pictures = [root / _PICTURES / f"{view.name}.png" for view in scene.views]
    if not root.is_absolute() or not all(path.is_file() for path in pictures):
        pictures = []
    content = _poses_json(scene.views, scene.frame, "pose" in scene.fitted)
    if job.loaded.scale is not None:
        content[METRES_KEY] = job.loaded.scale.metres_per_unit
    model, left_out = _colmap_texts(content["frames"])
    files = {job.folder / "transforms.json": transforms_bytes(content)}
    files |= {job.folder / _MODEL / name: text.encode() for name, text in model.items()}
    job.claim([*files, *(job.folder / _PICTURES / path.name for path in pictures)])
    for folder in (job.folder, job.folder / _MODEL, *([job.folder / _PICTURES] if pictures else [])):
        make_folder(folder)
    if left_out:
        job.say(
            f"left out of the COLMAP model, as line cameras: {left_out} of {len(content['frames'])} views"
        )
    if any(frame.get("k4") for frame in content["frames"]):
        job.say("looks wrong: COLMAP has no lens with the term k4, which is in transforms.json alone")
    if not pictures:
        job.say(
            f"no pictures at {job.loaded.record.summary.get('root')}: copy those of the scene to {_PICTURES}/ beside "
            "transforms.json"
        )
    written = [write_file(path, data) for path, data in files.items()]
    copied = job.follow("copying pictures", pictures)
    written += [
        write_file(job.folder / _PICTURES / path.name, read_bounded(path, MOST_TABLE_BYTES))
        for path in copied
    ]
    return written


def _poses_json(views: Sequence[RunView], frame: Normalisation, is_refined: bool) -> dict[str, Any]:
    """What the file says; `frame` leads from world to model space."""
    frames = []
    for view in views:
        width, height = view.camera.size(0)
        entry = {"file_path": f"{_PICTURES}/{view.name}.png", **camera_entry(view, frame)}
        frames.append({**entry, "split": view.split, "w": width, "h": height})
    first = {key: frames[0].get(key) for key in (*_LENS, "k3", "k4", "w", "h")} if frames else {}
    shared = all({key: one.get(key) for key in first} == first for one in frames)
    common = {key: value for key, value in first.items() if value is not None} if shared else {}
    return {"camera_model": "OPENCV", **common, "poses_refined": is_refined, "frames": frames}


def _colmap_texts(frames: Sequence[dict[str, Any]]) -> tuple[dict[str, str], int]:
    """Files of a COLMAP model by name, and how many frames have no one pose."""
    cameras: dict[tuple[Any, ...], int] = {}
    images = []
    for frame in frames:
        if "transform_matrix" not in frame:
            continue
        higher = frame.get("k3", 0.0), frame.get("k4", 0.0)
        values = [frame.get(key, 0.0) for key in _LENS]
        model = ("FULL_OPENCV", *values, higher[0], 0.0, 0.0, 0.0) if any(higher) else ("OPENCV", *values)
        camera = cameras.setdefault((model[0], frame["w"], frame["h"], *model[1:]), len(cameras) + 1)
        pose = np.array(frame["transform_matrix"])[:3]
        world_to_camera = (pose[:, :3] @ _FLIP).T
        x, y, z, w = Rotation.from_matrix(world_to_camera).as_quat()
        numbers = " ".join(f"{value:.17g}" for value in (w, x, y, z, *(-world_to_camera @ pose[:, 3])))
        name = frame["file_path"].removeprefix(f"{_PICTURES}/")
        images.append(f"{len(images) + 1} {numbers} {camera} {name}\n\n")
    lines = [f"{number} {' '.join(map(str, key))}\n" for key, number in cameras.items()]
    texts = {"cameras.txt": "".join(lines), "images.txt": "".join(images), "points3D.txt": ""}
    return texts, len(frames) - len(images)
