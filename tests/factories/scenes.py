"""Tiny scene folders: a matt ball at the origin, seen from a ring of cameras, by a rig, or by line cameras."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.errors import SceneError
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.settings import SceneOptions
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.sensor import read_sensor

WIDTH, HEIGHT = 20, 16
WAVELENGTHS = (450.0, 520.0, 600.0, 680.0)
SPECTRUM = np.array([0.2, 0.5, 0.8, 0.4], dtype=np.float32)
FOCAL = 28.0


@dataclass(frozen=True)
class SceneFolder:
    """A written scene and the means to damage it."""

    root: Path

    @property
    def content(self) -> dict[str, Any]:
        """transforms.json as it stands."""
        return json.loads((self.root / "transforms.json").read_text(encoding="utf-8"))

    def edit(self, change: Callable[[dict[str, Any]], Any]) -> SceneFolder:
        """Change transforms.json in place."""
        content = self.content
        change(content)
        (self.root / "transforms.json").write_text(json.dumps(content), encoding="utf-8")
        return self

    def edit_cube(self, index: int, change: Callable[[np.ndarray], np.ndarray | None]) -> SceneFolder:
        """Change a cube in place, or replace it with what `change` returns."""
        path = self.root / f"cubes/view_{index}.npy"
        cube = np.load(path)
        changed = change(cube)
        np.save(path, cube if changed is None else changed)
        return self

    def edit_cubes(self, change: Callable[[np.ndarray], np.ndarray | None]) -> SceneFolder:
        for index in range(len(self.content["frames"])):
            self.edit_cube(index, change)
        return self


def look_at(position: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Camera to world (4, 4) with OpenGL axes, +z up in the world."""
    back = (position - target) / np.linalg.norm(position - target)
    right = np.cross(np.array([0.0, 0.0, 1.0]), back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :4] = np.stack([right, np.cross(back, right), back, position], axis=1)
    return pose


def ring_poses(count: int, distance: float = 4.0) -> list[np.ndarray]:
    """Cameras around the origin, alternately lower and higher."""
    poses = []
    for index in range(count):
        angle, height = 2.0 * np.pi * index / count, (0.25, 0.7)[index % 2]
        radius = np.sqrt(1.0 - height**2)
        position = distance * np.array([radius * np.cos(angle), radius * np.sin(angle), height])
        poses.append(look_at(position, np.zeros(3)))
    return poses


def cameras_of(
    poses: list[np.ndarray], width: int, height: int, focal: float, distortion: tuple[float, ...] = (0.0,) * 4
) -> Cameras:
    count = len(poses)
    return Cameras(
        camera_to_world=torch.from_numpy(np.stack(poses)[:, :3]).float(),
        focal_px=torch.full((count, 2), focal),
        center_px=torch.tensor([[width / 2, height / 2]]).repeat(count, 1),
        distortion=torch.tensor([distortion]).repeat(count, 1),
        width=width,
        height=height,
    )


def ball_alpha(pose: np.ndarray, radius: float, width: int, height: int, focal: float) -> np.ndarray:
    """Coverage (H, W) of a ball at the origin, from 5 x 5 rays per pixel."""
    steps = (np.arange(5) + 0.5) / 5.0
    x = (np.arange(width)[:, None] + steps).reshape(-1)
    y = (np.arange(height)[:, None] + steps).reshape(-1)
    grid_x, grid_y = np.meshgrid(x, y)
    local = np.stack([grid_x - width / 2, height / 2 - grid_y, np.full_like(grid_x, -focal)], -1)
    directions = local @ pose[:3, :3].T
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    along = -(directions @ pose[:3, 3])
    hits = (pose[:3, 3] @ pose[:3, 3] - along**2 < radius**2) & (along > 0)
    return hits.reshape(height, 5, width, 5).mean(axis=(1, 3))


def write_view(root: Path, index: int, pose: np.ndarray, radius: float | None) -> dict[str, Any]:
    """Write the files of a view of a ball, opaque everywhere where it has no radius; its frame in transforms.json."""
    cover = np.ones((HEIGHT, WIDTH)) if radius is None else ball_alpha(pose, radius, WIDTH, HEIGHT, FOCAL)
    np.save(root / f"cubes/view_{index}.npy", (cover[..., None] * SPECTRUM).astype(np.float16))
    grey = (200 * cover).astype(np.uint8)
    pixels = np.stack([grey, grey, grey, np.round(255 * cover).astype(np.uint8)], axis=-1)
    Image.fromarray(pixels).save(root / f"images/view_{index}.png")
    labels = np.where(cover > 0.5, np.uint8(1), np.uint8(255))
    Image.fromarray(labels).save(root / f"labels/view_{index}.png")
    abundances = np.stack([np.zeros_like(cover), (cover > 0.5).astype(float)], axis=-1)
    np.save(root / f"abundances/view_{index}.npy", abundances.astype(np.float16))
    return {
        "file_path": f"images/view_{index}.png",
        "hyperspectral_file_path": f"cubes/view_{index}.npy",
        "seg_file_path": f"labels/view_{index}.png",
        "abundance_file_path": f"abundances/view_{index}.npy",
        "transform_matrix": pose.tolist(),
    }


def make_scene(
    root: Path,
    frames: int = 6,
    alpha: bool = True,
    radius: float = 0.6,
    poses: list[np.ndarray] | None = None,
) -> SceneFolder:
    """Write a sound scene: frame 0 is for evaluation, by lists."""
    for folder in ("cubes", "images", "labels", "abundances"):
        (root / folder).mkdir(parents=True)
    poses = ring_poses(frames) if poses is None else poses
    entries = [write_view(root, index, pose, radius if alpha else None) for index, pose in enumerate(poses)]
    materials = "wavelength,leaf,clay\n450,0.1,0.2\n520,0.3,0.5\n600,0.1,0.8\n680,0.1,0.4\n"
    (root / "endmembers.csv").write_text(materials, encoding="utf-8")
    (root / "illuminant.csv").write_text("wavelength,power\n450,1\n600,2\n680,4\n", encoding="utf-8")
    lens = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2}
    content = {
        "camera_model": "OPENCV",
        "w": WIDTH,
        "h": HEIGHT,
        **lens,
        "wavelengths": list(WAVELENGTHS),
        "materials": ["leaf", "clay"],
        "illuminant_path": "illuminant.csv",
        "endmembers_path": "endmembers.csv",
        "train_filenames": [f"images/view_{index}.png" for index in range(1, len(poses))],
        "test_filenames": ["images/view_0.png"],
        "frames": entries,
    }
    (root / "transforms.json").write_text(json.dumps(content), encoding="utf-8")
    return SceneFolder(root)


def widen(
    folder: SceneFolder, num_bands: int, change: Callable[[int, np.ndarray], np.ndarray]
) -> SceneFolder:
    """Give a scene other bands, from 450 nm on, whose cubes follow from the number of a view and its cube."""
    folder.edit(lambda content: content.update(wavelengths=[450.0 + 2 * band for band in range(num_bands)]))
    folder.edit(lambda content: [content.pop(key, None) for key in ("endmembers_path", "illuminant_path")])
    for index in range(len(folder.content["frames"])):
        folder.edit_cube(index, lambda cube, i=index: change(i, cube))
    return folder


def fault_of(folder: SceneFolder, **options: Any) -> str:
    """The message with which a scene is refused."""
    with pytest.raises(SceneError) as caught:
        load_scene(folder.root, SceneOptions(**options))
    message = str(caught.value)
    assert str(folder.root) in message
    return message


def set_frame(index: int, **values: Any) -> Callable[[dict[str, Any]], None]:
    return lambda content: content["frames"][index].update(values)


RESPONSES = "wavelength,red,blue\n480,0,1\n560,0.5,1\n640,1,0\n"
"""Of a camera with two channels, the longer waves first."""


def make_rig(root: Path) -> SceneFolder:
    """Frames 0 to 2 have all four bands, 3 and 4 two bands at half the size, 5 the channels of `RESPONSES`."""
    folder = make_scene(root)
    for index in (3, 4):
        halve(folder, index)
        folder.edit_cube(index, lambda cube: cube[..., [2, 0]])
        folder.edit(set_frame(index, bands=[2, 0], sensor="small"))
    (root / "colours.csv").write_text(RESPONSES, encoding="utf-8")
    channels = read_sensor(root / "colours.csv").seen_by(Bands.of(WAVELENGTHS)).matrix[:, ::-1]
    folder.edit_cube(5, lambda cube: cube.astype(np.float32) @ channels.astype(np.float32))
    return folder.edit(set_frame(5, responses_path="colours.csv"))


def halve(folder: SceneFolder, index: int) -> None:
    """Bring a frame's files and lens to half the size."""
    folder.edit_cube(index, lambda cube: cube.astype(np.float32).reshape(8, 2, 10, 2, -1).mean(axis=(1, 3)))
    for kind in ("images", "labels"):
        path = folder.root / f"{kind}/view_{index}.png"
        Image.fromarray(np.asarray(Image.open(path))[::2, ::2]).save(path)
    path = folder.root / f"abundances/view_{index}.npy"
    np.save(path, np.load(path)[::2, ::2])
    folder.edit(set_frame(index, w=10, h=8, fl_x=14.0, fl_y=14.0, cx=5.0, cy=4.0))


SWEEP = 1.0
"""How far each camera moves along its y axis from the first row to the last, to either side of the middle."""


def row_poses(pose: np.ndarray, num_rows: int = HEIGHT) -> list[np.ndarray]:
    """A camera that moves evenly down its own y axis while it takes the rows."""
    poses = []
    for row in range(num_rows):
        moved = pose.copy()
        moved[:3, 3] += (1.0 - 2.0 * row / (num_rows - 1)) * SWEEP * pose[:3, 1]
        poses.append(moved)
    return poses


def swept_alpha(pose: np.ndarray, radius: float) -> np.ndarray:
    """Which pixels (H, W) of the sweep have the ball at their middle."""
    x = (np.arange(WIDTH) + 0.5 - WIDTH / 2) / FOCAL
    local = np.stack([x, np.zeros_like(x), -np.ones_like(x)], axis=-1)
    cover = np.zeros((HEIGHT, WIDTH))
    for row, own in enumerate(row_poses(pose)):
        directions = local @ own[:3, :3].T
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        position = own[:3, 3]
        along = -(directions @ position)
        cover[row] = (position @ position - along**2 < radius**2) & (along > 0)
    return cover


def make_line_scene(root: Path, frames: int = 6, radius: float = 0.6) -> SceneFolder:
    """The scene of `make_scene` taken by line cameras; even frames say a pose a row, odd ones key poses."""
    scene, poses = make_scene(root, frames, radius=radius), ring_poses(frames)
    entries: list[dict[str, Any]] = scene.content["frames"]
    for index, (entry, pose) in enumerate(zip(entries, poses, strict=True)):
        cover = swept_alpha(pose, radius)
        np.save(root / entry["hyperspectral_file_path"], (cover[..., None] * SPECTRUM).astype(np.float16))
        grey, alpha = (200 * cover).astype(np.uint8), np.round(255 * cover).astype(np.uint8)
        Image.fromarray(np.stack([grey, grey, grey, alpha], axis=-1)).save(root / entry["file_path"])
        del entry["transform_matrix"], entry["seg_file_path"], entry["abundance_file_path"]
        matrices = [matrix.tolist() for matrix in row_poses(pose)]
        if index % 2:
            rows = (0, HEIGHT - 1)
            entry["key_poses"] = [{"row": row, "transform_matrix": matrices[row]} for row in rows]
        else:
            entry["row_poses"] = matrices
    return scene.edit(lambda content: content.update(frames=entries))
