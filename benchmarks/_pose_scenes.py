"""Demo scenes whose poses are off, or that are swept by line cameras, and how far refined poses are from the truth."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import least_squares
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.key_poses import KeyPoses, rotation_matrix
from unmix_plugin.scenes.demo.scene import demo_cameras, label_image, make_demo_scene, radiance_cube
from unmix_plugin.scenes.demo.shading import band_centers_nm, lamp_power, reflectances, render_view

_TRANSFORMS = "transforms.json"
_NUM_POINTS = 300
_POINTS_BOX = ((-0.7, -0.7, 0.0), (0.7, 0.7, 0.6))
"""Where the demo scene's things are."""
SWEEP_LENGTH = 2.4
"""How far a line camera moves during a sweep, world units."""
SWEPT = "eval_swept_"
"""With which names of evaluation views begin that are sweeps."""
WOBBLES = (1.0, 2.0, 3.0)
"""Waves of a line camera's wobble over a sweep."""


@dataclass(frozen=True)
class PosedScene:
    """A scene folder, and the poses that it was rendered with."""

    folder: Path
    truth: Cameras
    """Of all frames, world space."""
    error_px: float
    """Of the poses that the folder says, mean."""


def scene_points(seed: int) -> Float[Tensor, "P 3"]:
    """Points by which poses are compared."""
    low, high = torch.tensor(_POINTS_BOX)
    generator = torch.Generator().manual_seed(seed)
    return low + torch.rand(_NUM_POINTS, 3, generator=generator) * (high - low)


def frames_off(folder: Path, size: int, bands: int, views: int, error_px: float, seed: int) -> PosedScene:
    """A demo scene whose frame cameras, all of them, are off by so many pixels in the mean; 0 leaves them."""
    make_demo_scene(folder, size, bands, views)
    truth = demo_cameras(size, views)
    steps = np.random.default_rng(seed).normal(size=(views, 6))

    def moved(scale: float) -> Cameras:
        return replace(
            truth, camera_to_world=stepped(truth.camera_to_world, torch.tensor(scale * steps).float())
        )

    scale = _scale_for(error_px, lambda x: pose_error(truth, moved(x)))
    _write_poses(folder, moved(scale))
    return PosedScene(folder, truth, pose_error(truth, moved(scale)))


def sweeps(folder: Path, size: int, bands: int, num_sweeps: int, error_px: float, seed: int) -> PosedScene:
    """The scene swept by line cameras with a smooth wobble that its poses don't know.

    Evaluation views are frames with true poses, and the same views as sweeps that wobble as well (`SWEPT`).
    """
    views = views_for(num_sweeps)
    make_demo_scene(folder, size, bands, views)
    frames, truth = demo_cameras(size, views), line_cameras(size, views)
    content = json.loads((folder / _TRANSFORMS).read_text())
    is_train = [frame["file_path"].startswith("images/train") for frame in content["frames"]]
    waves = _waves(size, views, seed)

    def wobbling(scale: float) -> Cameras:
        assert truth.key_poses is not None
        poses = stepped(truth.key_poses.poses, scale * waves.flatten(0, 1))
        return replace(truth, key_poses=replace(truth.key_poses, poses=poses))

    chosen = [index for index, train in enumerate(is_train) if train]
    scale = _scale_for(error_px, lambda x: pose_error(truth[chosen], wobbling(x)[chosen]))
    _render_sweeps(folder, dict(enumerate(content["frames"])), truth, chosen, bands)
    _write_poses(folder, frames, {index: wobbling(scale) for index in chosen})
    _add_evaluation_sweeps(
        folder, truth, wobbling(scale), [i for i in range(views) if i not in chosen], bands
    )
    return PosedScene(folder, truth[chosen], pose_error(truth[chosen], wobbling(scale)[chosen]))


def line_cameras(size: int, views: int) -> Cameras:
    """The demo's cameras, each moving down its own y axis while it takes one row after the other."""
    still = demo_cameras(size, views)
    shares = 0.5 - (torch.arange(size) + 0.5) / size
    poses = still.camera_to_world[:, None].repeat(1, size, 1, 1)
    poses[..., 3] += SWEEP_LENGTH * shares[None, :, None] * still.camera_to_world[:, None, :, 1]
    heights = (torch.arange(size) + 0.5).repeat(views)
    return replace(still, key_poses=KeyPoses(poses.flatten(0, 1), heights, (size,) * views))


def stepped(poses: Float[Tensor, "N 3 4"], steps: Float[Tensor, "N 6"]) -> Float[Tensor, "N 3 4"]:
    """Poses turned about their cameras and moved, world axes."""
    turned = rotation_matrix(steps[:, :3]) @ poses[:, :, :3]
    return torch.cat([turned, (poses[:, :, 3] + steps[:, 3:])[:, :, None]], dim=-1)


def pose_error(truth: Cameras, found: Cameras) -> float:
    """By how many pixels cameras see the scene's points beside where they should, mean.

    After the similarity under which the pixels are off by least: what moves the whole world shows in no picture. One
    that brings the cameras themselves together would not do: a shift of a camera can hardly be told from a turn, so
    the places of refined cameras are far less certain than what they see.
    """
    first = similarity(_anchors(found), _anchors(truth))
    seen = [_sightings(truth, found, index, first) for index in range(len(truth))]
    right, poses, points, focal, ratio = (torch.cat(column).double() for column in zip(*seen, strict=True))
    wanted = _image_point(right, points)

    def errors(step: Float[np.ndarray, "7"]) -> Float[Tensor, "P 2"]:
        turn, shift, growth = torch.as_tensor(step).split([3, 3, 1])
        rotation = rotation_matrix(turn[None])[0]
        places = growth.exp() * poses[:, :, 3] @ rotation.T + shift
        moved = torch.cat([rotation @ poses[:, :, :3], places[:, :, None]], dim=-1)
        return (_image_point(moved, points) * ratio - wanted) * focal

    best = least_squares(lambda step: errors(step).flatten().numpy(), np.zeros(7))
    return float(errors(best.x).norm(dim=1).mean())


def _sightings(truth: Cameras, found: Cameras, index: int, change: Any) -> tuple[Tensor, ...]:
    """Of each point that a view sees: the true pose and the found one, the point, the true focal length (pixels), and
    by what the found one is larger. Poses are those of the row that sees the point in truth."""
    points = scene_points(0)
    coords, depths = truth.project(points, index)
    size = torch.tensor(truth.size(index))
    seen = (depths > 0) & (coords > 0).all(dim=1) & (coords < size).all(dim=1)
    views, y = torch.full((int(seen.sum()),), index), coords[seen, 1]
    focal = truth.focal_px[index].expand(len(y), 2)
    ratio = (found.focal_px[index] / truth.focal_px[index]).expand(len(y), 2)
    return truth.poses_at(views, y), change(found.poses_at(views, y)), points[seen], focal, ratio


def similarity(source: Float[Tensor, "n 3"], target: Float[Tensor, "n 3"]) -> Any:
    """The similarity that brings points nearest to others, as a change of poses.

    Source: Umeyama 1991, Least-squares estimation of transformation parameters between two point patterns.
    """
    a, b = source.double(), target.double()
    middle_a, middle_b = a.mean(dim=0), b.mean(dim=0)
    u, s, vt = torch.linalg.svd((b - middle_b).T @ (a - middle_a))
    sign = torch.tensor([1.0, 1.0, float(torch.sign(torch.linalg.det(u @ vt)))], dtype=torch.float64)
    rotation = u @ torch.diag(sign) @ vt
    scale = (s * sign).sum() / (a - middle_a).square().sum()

    def change(poses: Float[Tensor, "N 3 4"]) -> Float[Tensor, "N 3 4"]:
        position = scale * (poses[:, :, 3].double() - middle_a) @ rotation.T + middle_b
        return torch.cat([rotation @ poses[:, :, :3].double(), position[:, :, None]], dim=-1).float()

    return change


def _anchors(cameras: Cameras) -> Float[Tensor, "n 3"]:
    """Points that are fixed to the cameras, at the scene's distance: they hold positions and directions alike."""
    found = []
    for index in range(len(cameras)):
        y = torch.linspace(0.5, cameras.size(index)[1] - 0.5, 24 if cameras.is_line_camera(index) else 1)
        poses = cameras.poses_at(torch.full((len(y),), index), y)
        axes = (
            -4.0 * poses[:, :, 2],
            1.0 * poses[:, :, 0] - 4.0 * poses[:, :, 2],
            1.0 * poses[:, :, 1] - 4.0 * poses[:, :, 2],
        )
        found += [poses[:, :, 3], *(poses[:, :, 3] + axis for axis in axes)]
    return torch.cat(found)


def _image_point(poses: Float[Tensor, "P 3 4"], points: Float[Tensor, "P 3"]) -> Float[Tensor, "P 2"]:
    local = torch.einsum("pi,pij->pj", points - poses[:, :, 3], poses[:, :, :3])
    return local[:, :2] / -local[:, 2:]


def _scale_for(error_px: float, error: Any) -> float:
    """The scale at which an error that grows with it has a value, by bisection."""
    if error_px == 0:
        return 0.0
    low, high = 0.0, 0.3
    for _ in range(14):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if error(middle) < error_px else (low, middle)
    return 0.5 * (low + high)


def views_for(num_sweeps: int) -> int:
    """Views of a demo scene that has so many to train on: every 4th is for evaluation."""
    return next(n for n in range(num_sweeps, 2 * num_sweeps + 4) if n - (n + 1) // 4 == num_sweeps)


def _waves(size: int, views: int, seed: int) -> Float[Tensor, "V H 6"]:
    """Random sums of slow waves over the rows."""
    generator = torch.Generator().manual_seed(seed)
    y = (torch.arange(size) + 0.5) / size
    total = torch.zeros(views, size, 6)
    for count in WOBBLES:
        phases = 2 * torch.pi * torch.rand(views, 1, 6, generator=generator)
        sizes = torch.randn(views, 1, 6, generator=generator) / count
        total += sizes * torch.sin(2 * torch.pi * count * y[None, :, None] + phases)
    return total


def _render_sweeps(
    folder: Path,
    frames: Mapping[int, dict[str, Any]],
    cameras: Cameras,
    chosen: Sequence[int],
    bands: int,
) -> None:
    """Cubes, pictures with alpha and labels of the line cameras, in place of the frames'."""
    from PIL import Image

    wavelengths = band_centers_nm(bands)
    spectra, lamp = reflectances(wavelengths), lamp_power(wavelengths)
    for index in chosen:
        view = render_view(cameras, index)
        np.save(
            folder / frames[index]["hyperspectral_file_path"],
            radiance_cube(view, spectra, lamp).astype(np.float16),
        )
        rgba = np.repeat(view.alpha[..., None], 4, axis=-1)
        Image.fromarray((rgba * 255).round().astype(np.uint8)).save(folder / frames[index]["file_path"])
        Image.fromarray(label_image(view)).save(folder / frames[index]["seg_file_path"])


def _write_poses(folder: Path, frames: Cameras, lines: dict[int, Cameras] | None = None) -> None:
    content = json.loads((folder / _TRANSFORMS).read_text())
    for index, frame in enumerate(content["frames"]):
        frame["transform_matrix"] = _matrix(frames.camera_to_world[index])
        if lines and index in lines:
            keys = lines[index].key_poses
            assert keys is not None
            del frame["transform_matrix"]
            frame["row_poses"] = [_matrix(pose) for pose in keys.of(index).poses]
    (folder / _TRANSFORMS).write_text(json.dumps(content) + "\n")


def _add_evaluation_sweeps(
    folder: Path, truth: Cameras, given: Cameras, chosen: Sequence[int], bands: int
) -> None:
    """Sweeps beside the evaluation frames, with the poses that are given."""
    content = json.loads((folder / _TRANSFORMS).read_text())
    assert given.key_poses is not None
    added = []
    for index in chosen:
        name = f"{SWEPT}{index:03d}"
        entry = {
            "file_path": f"images/{name}.png",
            "hyperspectral_file_path": f"cubes/{name}.npy",
            "seg_file_path": f"labels/{name}.png",
            "row_poses": [_matrix(pose) for pose in given.key_poses.of(index).poses],
        }
        added.append(entry)
    _render_sweeps(folder, dict(zip(chosen, added, strict=True)), truth, chosen, bands)
    for key, value in content.items():
        if key.startswith(("val", "test")) and isinstance(value, list):
            content[key] = value + [entry["file_path"] for entry in added]
    content["frames"] += added
    (folder / _TRANSFORMS).write_text(json.dumps(content) + "\n")


def _matrix(pose: Float[Tensor, "3 4"]) -> list[list[float]]:
    u, _, vt = np.linalg.svd(pose[:, :3].double().numpy())
    rigid = np.column_stack([u @ vt, pose[:, 3].double().numpy()])
    return [*rigid.tolist(), [0.0, 0.0, 0.0, 1.0]]
