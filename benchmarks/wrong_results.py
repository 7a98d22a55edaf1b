"""Does `unmix-process` notice by itself that a scene is wrong, where no reader could know?

    python benchmarks/wrong_results.py

The demo's table is written as a capture that is right, and then with one thing wrong that its files do not tell: a
level added to the counts, exposures that vary, a gain of one band, pictures of another lens or size than said, poses in
another convention or of few views, masks the wrong way round, spectra in a part of the files that is not read. Every
wrong scene must be found, and for what it is; the right one must give no finding.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import _common
import _machine
import numpy as np
import tyro
from PIL import Image
from scipy import ndimage

from unmix_plugin.captures.options import ProcessOptions
from unmix_plugin.captures.process import process_capture
from unmix_plugin.scenes.demo.scene import make_demo_scene

SIZE, BANDS, VIEWS = 192, 16, 24


@dataclass(frozen=True)
class Options:
    """Process right and wrong captures."""

    scenes: tuple[Path, ...] = ()
    """Further scenes that are right, of the layout `unmix-nerf`."""
    quick: bool = False
    """Write no results."""
    results: Path | None = None
    """Folder for wrong_results.json and wrong_results.md; None: beside the benchmarks."""


def _change_cubes(folder: Path, change: Callable[[np.ndarray, int], np.ndarray]) -> None:
    for index, path in enumerate(sorted((folder / "cubes").glob("*.npy"))):
        cube = np.load(path).astype(np.float32)
        np.save(path, change(cube, index).astype(np.float32))


def _change_json(folder: Path, change: Callable[[dict[str, Any]], None]) -> None:
    path = folder / "transforms.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def _change_alpha(folder: Path, change: Callable[[np.ndarray, int], np.ndarray]) -> None:
    for index, path in enumerate(sorted((folder / "images").glob("*.png"))):
        with Image.open(path) as opened:
            pixels = np.array(opened.convert("RGBA"))
        pixels[..., 3] = change(pixels[..., 3], index)
        Image.fromarray(pixels).save(path)


_FLOOR_SIZE, _FLOOR_FOCAL, _FLOOR_VIEWS = 200, 100.0, 16


def _write_floor(folder: Path, is_fisheye: bool) -> None:
    """A printed floor of three paints, through a pinhole of 90 degrees or a fisheye of the same focal length."""
    generator = np.random.default_rng(0)
    paints = []
    for _ in range(3):
        waves = [ndimage.gaussian_filter(generator.random((600, 600)), width) * width for width in (2, 4, 9)]
        paints.append((sum(waves) - np.min(sum(waves))) / np.ptp(sum(waves)))
    wavelengths = np.linspace(450, 850, 6)
    spectra = np.stack([np.exp(-(((wavelengths - nm) / 120) ** 2)) for nm in (500, 620, 760)])
    for name in ("images", "cubes"):
        (folder / name).mkdir(parents=True)
    columns, rows = np.meshgrid(np.arange(_FLOOR_SIZE) + 0.5, np.arange(_FLOOR_SIZE) + 0.5)
    ideal = (np.column_stack([columns.ravel(), rows.ravel()]) - _FLOOR_SIZE / 2) / _FLOOR_FOCAL
    if is_fisheye:
        angle = np.linalg.norm(ideal, axis=1, keepdims=True)
        ideal = ideal * np.tan(angle) / angle
    frames = []
    for index in range(_FLOOR_VIEWS):
        azimuth = 2 * np.pi * index / _FLOOR_VIEWS
        position = np.array([2.2 * np.cos(azimuth), 2.2 * np.sin(azimuth), 1.6 + 1.2 * (index % 2)])
        back = position / np.linalg.norm(position)
        right = np.cross([0.0, 0.0, 1.0], back)
        right /= np.linalg.norm(right)
        pose = np.column_stack([right, np.cross(back, right), back, position])
        rays = np.column_stack([ideal[:, 0], -ideal[:, 1], -np.ones(len(ideal))]) @ pose[:, :3].T
        is_floor = rays[:, 2] < -1e-3
        depth = np.where(is_floor, -position[2] / np.where(is_floor, rays[:, 2], -1.0), 0.0)
        x, y, _ = (position + depth[:, None] * rays).T
        at = [300 + 90 * y, 300 + 90 * x]
        shares = np.stack(
            [ndimage.map_coordinates(paint, at, order=1, mode="mirror") for paint in paints], axis=-1
        )
        cube = np.where(is_floor[:, None], shares @ spectra * 0.4, 0.3).reshape(_FLOOR_SIZE, _FLOOR_SIZE, -1)
        name = f"view_{index:02d}"
        np.save(folder / "cubes" / f"{name}.npy", cube.astype(np.float32))
        Image.new("RGB", (_FLOOR_SIZE, _FLOOR_SIZE)).save(folder / "images" / f"{name}.png")
        paths = {"file_path": f"images/{name}.png", "hyperspectral_file_path": f"cubes/{name}.npy"}
        frames.append({**paths, "transform_matrix": pose.tolist()})
    lens = {"w": _FLOOR_SIZE, "h": _FLOOR_SIZE, "fl_x": _FLOOR_FOCAL, "fl_y": _FLOOR_FOCAL}
    content = {**lens, "wavelengths": wavelengths.tolist(), "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))


def _few_poses(content: dict[str, Any]) -> None:
    content["frames"] = content["frames"][:6]


def _other_axes(content: dict[str, Any]) -> None:
    for frame in content["frames"]:
        pose = np.array(frame["transform_matrix"])
        pose[:3, 1:3] *= -1
        frame["transform_matrix"] = pose.tolist()


def _bury(folder: Path) -> None:
    """Spectra behind a preview of three bands, in files whose first array is read."""
    for path in sorted((folder / "cubes").glob("*.npy")):
        cube = np.load(path).astype(np.float32)
        np.save(path, cube[..., [2, 8, 13]])
        with path.open("ab") as file:
            np.save(file, cube)
    _change_json(folder, lambda top: top.update(wavelengths=[450, 550, 650]))


WRONG: dict[str, tuple[Callable[[Path], None], str]] = {
    "a level on all values": (
        lambda folder: _change_cubes(folder, lambda cube, _: cube + 0.05),
        "a level seems to be added",
    ),
    "every second view exposed twice as long": (
        lambda folder: _change_cubes(folder, lambda cube, index: cube * (0.5, 1.0)[index % 2]),
        "as with other exposures",
    ),
    "exposures that vary by 30 %": (
        lambda folder: _change_cubes(
            folder, lambda cube, index: cube * np.random.default_rng(index).uniform(0.7, 1.0)
        ),
        "as with other exposures",
    ),
    "one band with 1.3 times the gain": (
        lambda folder: _change_cubes(
            folder, lambda cube, _: cube * np.where(np.arange(BANDS) == 7, 1.3, 1.0)
        ),
        "off against both neighbours",
    ),
    "floor: a fisheye read as OPENCV": (
        lambda folder: _write_floor(folder, is_fisheye=True),
        "do not fit their lens",
    ),
    "floor: a focal length of a picture that was cropped": (
        lambda folder: _change_json(
            folder, lambda top: top.update(fl_x=top["fl_x"] * 0.7, fl_y=top["fl_y"] * 0.7)
        ),
        "do not fit their lens",
    ),
    "poses in OpenCV's axes": (lambda folder: _change_json(folder, _other_axes), "do not fit their poses"),
    "masks the wrong way round": (
        lambda folder: _change_alpha(folder, lambda alpha, _: 255 - alpha),
        "the wrong way round",
    ),
    "one mask the wrong way round": (
        lambda folder: _change_alpha(folder, lambda alpha, index: 255 - alpha if index == 5 else alpha),
        "the wrong way round",
    ),
    "poses of 6 of 24 views": (lambda folder: _change_json(folder, _few_poses), "have no pose"),
    "spectra behind a preview": (_bury, "only a small part was read"),
}
"""What is made wrong, and words of the finding that names it."""


def _findings(capture: Path, scene: Path) -> list[str]:
    """What looks wrong of a capture, whose poses may be a file beside its cubes."""
    asked = ProcessOptions("unmix-nerf", capture, scene)
    poses = capture / "poses.json"
    if poses.is_file():
        wavelengths = ",".join(map(str, json.loads(poses.read_text())["wavelengths"]))
        asked = ProcessOptions("cubes", capture / "cubes", scene, poses=str(poses), wavelengths=wavelengths)
    return process_capture(asked, lambda _: None, lambda _, views: views)


def main(options: Options) -> None:
    """Make captures, process them, publish."""
    figures, measured = [], {}
    with tempfile.TemporaryDirectory() as place:
        root = Path(place)
        make_demo_scene(root / "demo", SIZE, BANDS, VIEWS)
        _write_floor(root / "floor", is_fisheye=False)
        right = {
            "the demo": root / "demo",
            "a printed floor": root / "floor",
            **{path.name: path for path in options.scenes},
        }
        for name, capture in right.items():
            found = _findings(capture, root / f"scene of {name}")
            measured[f"right: {name}"] = found
            figures.append(
                _common.required(f"right: {name}", "no finding", not found, "; ".join(found) or "none")
            )
        for name, (spoil, words) in WRONG.items():
            capture, scene = root / "capture", root / f"scene {len(measured)}"
            shutil.rmtree(capture, ignore_errors=True)
            if "fisheye" not in name:
                shutil.copytree(root / ("floor" if name.startswith("floor") else "demo"), capture)
            spoil(capture)
            if name.startswith("poses of"):
                content = json.loads((capture / "transforms.json").read_text())
                for frame in content["frames"]:
                    frame["file_path"] = frame["hyperspectral_file_path"]
                (capture / "poses.json").write_text(json.dumps(content))
            found = _findings(capture, scene)
            measured[name] = found
            is_found = any(words in one for one in found)
            figures.append(_common.required(name, "found", is_found, "; ".join(found) or "nothing"))
    setting = {"size": SIZE, "bands": BANDS, "views": VIEWS}
    question = "Does processing notice by itself that a scene is wrong?"
    report = _common.Report(
        "wrong_results", question, setting, _machine.describe_machine("cpu"), figures, measured
    )
    _common.publish(report, _common.results_folder(options.results, options.quick))


if __name__ == "__main__":
    main(tyro.cli(Options))
