"""Small captures in the forms that people's programs write, each with its truth; and a written scene in their terms.

Every picture shows another smooth field of three materials whose left and right, top and bottom and corners differ, so
that a flip, a turn, a shifted band or another view's values can't pass for the right ones. Cameras stand on a ring.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tests.factories.commands import done, refused
from tests.factories.files import AXES, header_text
from unmix_plugin.commands.process import process

HEIGHT, WIDTH, VIEWS = 24, 36, 5
WAVELENGTHS_NM = np.linspace(450.0, 900.0, 7)
FOCAL_PX = 45.0
RGB = ["--wavelengths", "620,540,470"]
RED_GREEN_BLUE = [3, 1, 0]
"""Bands that pictures show."""


def spectra(wavelengths_nm: np.ndarray = WAVELENGTHS_NM) -> np.ndarray:
    """Reflectances of the three materials, (3, B)."""

    def edge(centre_nm: float, width_nm: float) -> np.ndarray:
        return 1 / (1 + np.exp(-(wavelengths_nm - centre_nm) / width_nm))

    leaf = 0.08 + 0.6 * edge(710, 15) + 0.1 * np.exp(-(((wavelengths_nm - 550) / 40) ** 2))
    stone = 0.35 + 0.1 * (wavelengths_nm - 450) / 450
    return np.stack([0.1 + 0.5 * edge(600, 30), leaf, stone])


def cube(seed: int, height: int = HEIGHT, width: int = WIDTH, nm: np.ndarray = WAVELENGTHS_NM) -> np.ndarray:
    """Reflectance of a view, (H, W, B) in 0.001 to 0.999; a dark corner marks the first row and column."""
    y, x = np.mgrid[:height, :width]
    shares = np.stack(
        [0.5 + 0.5 * np.sin(x / 5 + seed), 0.5 + 0.5 * np.cos(y / 4 + x / 9 + seed), 0.2 + 0.8 * x / width],
        -1,
    )
    values = shares / shares.sum(-1, keepdims=True) @ spectra(nm) * (0.4 + 0.5 * y / height)[..., None]
    values = values + np.random.default_rng(seed).normal(0, 0.002, values.shape)
    values[: height // 6, : width // 6] *= 0.3
    return np.clip(values, 0.001, 0.999)


def ring(views: int = VIEWS) -> list[np.ndarray]:
    """Cameras to world in OpenGL's axes that look at the origin from three heights, (4, 4) each."""
    poses = []
    for index in range(views):
        angle = 2 * np.pi * index / views
        position = np.array([4 * np.cos(angle), 4 * np.sin(angle), 1.5 + index % 3 * 0.8])
        back = position / np.linalg.norm(position)
        right = np.cross([0.0, 0.0, 1.0], back)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3] = np.column_stack([right, np.cross(back, right), back, position])
        poses.append(pose)
    return poses


def write_transforms(
    path: Path,
    names: Sequence[str],
    poses: Sequence[np.ndarray] | None = None,
    of_frame: Callable[[int], dict[str, Any]] = lambda _: {},
    focal_px: float = FOCAL_PX,
    **top: Any,
) -> None:
    """A transforms.json of these files; further entries of all and of each frame."""
    frames = [
        {"file_path": name, "transform_matrix": pose.tolist(), **of_frame(index)}
        for index, (name, pose) in enumerate(zip(names, poses or ring(len(names)), strict=True))
    ]
    lens = {"fl_x": focal_px, "fl_y": focal_px, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT}
    path.write_text(json.dumps({**lens, **top, "frames": frames}), encoding="utf-8")


def write_envi(
    header: Path, values: np.ndarray, interleave: str = "bil", /, suffix: str = ".raw", **entries: Any
) -> None:
    """An ENVI cube; further entries of its header, `_` for blanks, None to leave one out."""
    listed = "{" + ", ".join(f"{value:g}" for value in WAVELENGTHS_NM) + "}"
    usual = {"wavelength": listed, "wavelength units": "Nanometers", "header offset": 0}
    header.parent.mkdir(parents=True, exist_ok=True)
    given = {key.replace("_", " "): value for key, value in entries.items()}
    header.write_text(header_text(values, interleave, {**usual, **given}), encoding="utf-8")
    header.with_suffix(suffix).write_bytes(values.transpose(AXES[interleave]).tobytes())


def braced(values: Any, form: str = "{:.9g}") -> str:
    """A list as ENVI headers have it."""
    return "{" + ", ".join(form.format(value) for value in values) + "}"


def counts(values: np.ndarray, lamp: np.ndarray, offset: float, full: int = 65535) -> np.ndarray:
    """What a sensor of 16 bits stores."""
    return np.clip(np.rint(values * lamp + offset), 0, full).astype(np.uint16)


@dataclass(frozen=True)
class WrittenView:
    """A view of a written scene, in the terms of its capture."""

    name: str
    values: np.ndarray
    """(H, W, B)"""
    pose: np.ndarray
    """(3, 4) in the capture's own world"""
    entries: dict[str, Any]
    """Of the frame, and of the scene where the frame has none."""


@dataclass(frozen=True)
class WrittenScene:
    """A scene that was written, in the terms of its capture."""

    root: Path
    wavelengths_nm: np.ndarray
    views: list[WrittenView]
    printed: str

    def check_values(self, truth: Callable[[str], np.ndarray], tolerance: float = 0.02) -> None:
        """That all values are the truth's (H, W, bands in the scene's order) by a name, but for one factor."""
        found = np.concatenate([view.values.ravel() for view in self.views])
        expected = np.concatenate([truth(view.name).ravel() for view in self.views])
        factor = (found * expected).sum() / (expected * expected).sum()
        assert np.abs(found / factor - expected).max() < tolerance * expected.max()

    def check_poses(self, truth: Callable[[str], np.ndarray]) -> None:
        """That all poses are the truth's by a name."""
        for view in self.views:
            np.testing.assert_allclose(view.pose, truth(view.name)[:3], atol=1e-4, err_msg=view.name)


def processed(*words: object, output: Path) -> WrittenScene:
    """The scene that `unmix-process` with these words writes to a folder."""
    ended = done(process, *words, "--output-dir", output)
    content = json.loads((output / "transforms.json").read_text(encoding="utf-8"))
    turned = np.array(content.get("applied_transform", np.eye(4)[:3].tolist()))
    views = []
    for frame in content["frames"]:
        path = output / frame["hyperspectral_file_path"]
        values = np.load(path).astype(float) / content.get("value_scale", 1.0)
        pose = np.array(frame["transform_matrix"])[:3]
        place = turned[:, :3].T @ (pose[:, 3] / content.get("applied_scale", 1.0) - turned[:, 3])
        own = np.column_stack(
            [turned[:, :3].T @ pose[:, :3], place + np.array(content.get("offset", [0.0, 0.0, 0.0]))]
        )
        views.append(WrittenView(path.stem, values, own, {**content, **frame}))
    return WrittenScene(output, np.array(content["wavelengths"]), views, ended.out + ended.err)


def not_processed(*words: object, output: Path) -> str:
    """What is said where `unmix-process` has to refuse these words; nothing may be left of a scene."""
    message = refused(process, *words, "--output-dir", output)
    assert not output.exists()
    return message


def number_of(name: str) -> int:
    """The number at the end of a view's name."""
    return int("".join(one if one.isdigit() else " " for one in name).split()[-1])


def cube_of(name: str) -> np.ndarray:
    """The truth of a view that ends with its number."""
    return cube(number_of(name))


def pose_of(name: str, views: int = VIEWS) -> np.ndarray:
    """The pose of a view that ends with its number."""
    return ring(views)[number_of(name)]
