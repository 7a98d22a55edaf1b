"""Are pictures of lenses that scenes do not have as good as pictures of a lens that they have?

    python benchmarks/lenses.py [--steps 800]

The demo's table is rendered from near through a fisheye of 120 degrees, a radial lens about a centre of its own (as a
MicMac calibration) and an ftheta lens, and made a scene by `unmix-process`, which resamples the pictures. The same
cameras are rendered through the lens of that scene. Both are trained for equally many steps and evaluated on the
pictures that were never resampled. Where points are seen is checked on pictures whose pixels hold their own place.
"""

from __future__ import annotations

import json
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import _common
import _machine
import numpy as np
import torch
import tyro
from PIL import Image

from unmix_plugin.captures.options import ProcessOptions
from unmix_plugin.captures.poses.lens import Lens, Points, Project, distort_fisheye, distort_ftheta, fit_lens
from unmix_plugin.captures.process import process_capture
from unmix_plugin.engine.geometry.space import RayBundle
from unmix_plugin.scenes.demo.scene import demo_cameras, radiance_cube
from unmix_plugin.scenes.demo.shading import band_centers_nm, lamp_power, reflectances, render_view

WIDTH, HEIGHT, BANDS = 96, 72, 8
_NEARER = 0.5
"""Of the demo's distance."""


@dataclass(frozen=True)
class Options:
    """Compare resampled pictures with others."""

    steps: int = 800
    """Of each training."""
    views: int = 24
    only: str = ""
    """Part of the name of the one lens to look at."""
    quick: bool = False
    """Show that it works; its figures mean nothing."""
    results: Path | None = None
    """Folder for lenses.json and lenses.md; None: beside the benchmarks."""


_TERMS = (-2.2e-5, 1.5e-9)
_CENTER, _OWN_CENTER, _FOCAL = (48.0, 36.0), (66.0, 29.0), 62.0


def _radial(ideal: Points) -> Points:
    away = _FOCAL * ideal + _CENTER - _OWN_CENTER
    squared = (away**2).sum(axis=1, keepdims=True)
    return away * (1 + _TERMS[0] * squared + _TERMS[1] * squared**2) + _OWN_CENTER


_FISHEYE_FOCAL = WIDTH / 2 / np.radians(60.0)
_FTHETA = (0.0, 0.016, 0.0, 6e-7)
LENSES: dict[str, Project] = {
    "fisheye of 120 degrees": lambda ideal: distort_fisheye(ideal, 0.02, -0.01) * _FISHEYE_FOCAL + _CENTER,
    "radial about a centre of its own": _radial,
    "ftheta": lambda ideal: distort_ftheta(ideal, 200.0, *_FTHETA) / _FTHETA[1] + _CENTER,
}
_KEYS: dict[str, dict[str, Any]] = {
    "fisheye of 120 degrees": {
        "camera_model": "OPENCV_FISHEYE",
        **dict.fromkeys(("fl_x", "fl_y"), _FISHEYE_FOCAL),
        "k1": 0.02,
        "k2": -0.01,
        "k3": 0.0,
        "k4": 0.0,
    },
    "ftheta": {f"ftheta_p{power}": term for power, term in enumerate((*_FTHETA, 0.0))},
}


@dataclass(frozen=True)
class _Cameras:
    """The demo's cameras, nearer, with rays through any lens."""

    poses: np.ndarray
    """(N, 3, 4)"""
    project: Project
    width: int = WIDTH
    height: int = HEIGHT

    def image_rays(self, index: int, offset: tuple[float, float]) -> RayBundle:
        """One ray a pixel, row after row; backwards where the lens sees nothing."""
        columns, rows = np.meshgrid(np.arange(WIDTH) + offset[0], np.arange(HEIGHT) + offset[1])
        pixels = np.column_stack([columns.ravel(), rows.ravel()])
        ideal = (pixels - _CENTER) / _FISHEYE_FOCAL / 1.5
        for _ in range(60):  # Newton's method, damped: these lenses are gentle
            step = 1e-6
            sides = [self.project(ideal + move) - self.project(ideal - move) for move in step * np.eye(2)]
            slopes = np.stack(sides, axis=-1) / (2 * step)
            ideal = ideal + np.linalg.solve(slopes, (pixels - self.project(ideal))[..., None])[..., 0]
        is_seen = np.abs(self.project(ideal) - pixels).max(axis=1) < 1e-3
        rays = np.column_stack([ideal[:, 0], -ideal[:, 1], -np.ones(len(ideal))])
        rays[~is_seen] = (0.0, 0.0, 1.0)
        rays = rays / np.linalg.norm(rays, axis=1, keepdims=True) @ self.poses[index, :, :3].T
        origins = np.broadcast_to(self.poses[index, :, 3], rays.shape).copy()
        return RayBundle(
            torch.from_numpy(origins).float(),
            torch.from_numpy(rays).float(),
            torch.full((len(rays),), index),
        )


def _poses(views: int) -> np.ndarray:
    poses = demo_cameras(96, views).camera_to_world.double().numpy().copy()
    poses[:, :, 3] = (0.0, 0.0, 0.22) + _NEARER * (poses[:, :, 3] - (0.0, 0.0, 0.22))
    return poses


def _write_capture(folder: Path, poses: np.ndarray, project: Project, keys: dict[str, Any] | None) -> None:
    """Cubes, pictures with alpha and poses; as MicMac's orientations without keys for the lens."""
    for name in ("images", "cubes"):
        (folder / name).mkdir(parents=True)
    centers_nm = np.asarray(band_centers_nm(BANDS))
    spectra, lamp = reflectances(centers_nm), lamp_power(centers_nm)
    cameras: Any = _Cameras(poses, project)
    frames = []
    for index in range(len(poses)):
        name = f"{'eval' if index % 4 == 3 else 'train'}_{index:03d}"
        view = render_view(cameras, index)
        cube = radiance_cube(view, spectra, lamp).astype(np.float32)
        np.save(folder / "cubes" / f"{name}.npy", cube)
        picture = np.dstack([np.zeros((HEIGHT, WIDTH, 3)), view.alpha])
        Image.fromarray((255 * picture).round().astype(np.uint8)).save(folder / "images" / f"{name}.png")
        paths = {"file_path": f"images/{name}.png", "hyperspectral_file_path": f"cubes/{name}.npy"}
        frames.append({**paths, "transform_matrix": poses[index].tolist()})
    lists = {
        f"{split}_filenames": [f["file_path"] for f in frames if f["file_path"].startswith(f"images/{start}")]
        for split, start in (("train", "train"), ("val", "eval"), ("test", "eval"))
    }
    lens = {"w": WIDTH, "h": HEIGHT, "cx": _CENTER[0], "cy": _CENTER[1], "wavelengths": centers_nm.tolist()}
    content = {**lens, **(keys or {}), **lists, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))
    if keys is None:
        _write_micmac(folder, frames)


def _write_micmac(folder: Path, frames: list[dict[str, Any]]) -> None:
    """Ori-All/ with one orientation a picture. Pixels are counted from the centre of the first."""
    (folder / "Ori-All").mkdir()
    calibration = (
        "<ExportAPERO><CalibrationInternConique><KnownConv>eConvApero_DistM2C</KnownConv>"
        f"<PP>{_CENTER[0] - 0.5} {_CENTER[1] - 0.5}</PP><F>{_FOCAL}</F><SzIm>{WIDTH} {HEIGHT}</SzIm>"
        f"<CalibDistortion><ModRad><CDist>{_OWN_CENTER[0] - 0.5} {_OWN_CENTER[1] - 0.5}</CDist>"
        + "".join(f"<CoeffDist>{term}</CoeffDist>" for term in _TERMS)
        + "</ModRad></CalibDistortion></CalibrationInternConique></ExportAPERO>"
    )
    (folder / "Ori-All" / "AutoCal.xml").write_text(calibration)
    for frame in frames:
        pose = np.array(frame["transform_matrix"])
        rotation = pose[:, :3] @ np.diag([1.0, -1.0, -1.0])
        rows = "".join(
            f"<L{i + 1}>{' '.join(map(repr, row.tolist()))}</L{i + 1}>" for i, row in enumerate(rotation)
        )
        name = Path(frame["hyperspectral_file_path"]).stem
        text = (
            "<ExportAPERO><OrientationConique><FileInterne>AutoCal.xml</FileInterne><Externe>"
            f"<Centre>{' '.join(map(repr, pose[:, 3].tolist()))}</Centre>"
            f"<ParamRotation><CodageMatr>{rows}</CodageMatr></ParamRotation></Externe>"
            "<ConvOri><KnownConv>eConvApero_DistM2C</KnownConv></ConvOri></OrientationConique></ExportAPERO>"
        )
        (folder / "Ori-All" / f"Orientation-{name}.png.xml").write_text(text)


def _process(capture: Path, scene: Path, poses: str | None) -> None:
    asked = ProcessOptions("unmix-nerf", capture, scene, poses=poses, mask="files", scale=1.0)
    process_capture(asked, lambda _: None, lambda _, views: views)


def _lens_of_scene(scene: Path) -> Lens:
    values = json.loads((scene / "transforms.json").read_text())
    number = {
        key: float(values[key]) for key in ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2")
    }
    return Lens(
        values["w"],
        values["h"],
        (number["fl_x"], number["fl_y"]),
        (number["cx"], number["cy"]),
        (number["k1"], number["k2"], number["p1"], number["p2"]),
        (number["k3"], number["k4"]),
    )


def _points_off_px(folder: Path, name: str, lens: Lens) -> float:
    """Largest distance between where points are seen in a resampled picture and where the scene's lens says."""
    capture, scene = folder / "places", folder / "places-scene"
    poses = _poses(3)
    for part in ("images", "cubes"):
        (capture / part).mkdir(parents=True)
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    places = np.stack([columns / 100, rows / 100, np.full_like(rows, 0.5)], axis=-1).astype(np.float32)
    frames = []
    for index, pose in enumerate(poses):
        np.save(capture / "cubes" / f"v{index}.npy", places)
        opaque = np.full((HEIGHT, WIDTH, 4), 255, np.uint8)
        Image.fromarray(opaque).save(capture / "images" / f"v{index}.png")
        paths = {"file_path": f"images/v{index}.png", "hyperspectral_file_path": f"cubes/v{index}.npy"}
        frames.append({**paths, "transform_matrix": pose.tolist()})
    top = {"w": WIDTH, "h": HEIGHT, "cx": _CENTER[0], "cy": _CENTER[1], "wavelengths": [450, 550, 650]}
    (capture / "transforms.json").write_text(json.dumps({**top, **_KEYS.get(name, {}), "frames": frames}))
    if name not in _KEYS:
        _write_micmac(capture, frames)
    _process(capture, scene, None if name in _KEYS else str(capture / "Ori-All"))
    shown = np.load(scene / "cubes" / "v0.npy")[..., :2] / 655.35
    missing = np.zeros(shown.shape[:2], bool)
    if (scene / "masks" / "v0.png").is_file():
        with Image.open(scene / "masks" / "v0.png") as mask:
            missing = np.asarray(mask.convert("L")) == 0
    pixels = np.random.default_rng(0).uniform((0.5, 0.5), (WIDTH - 0.51, HEIGHT - 0.51), (20000, 2))
    ideal = lens.ideal_of(pixels)
    assert ideal is not None
    assert np.abs(lens.pixels_of(ideal) - pixels).max() < 1e-6
    wanted, pixels = LENSES[name](ideal), pixels - 0.5
    column, row = np.floor(pixels).astype(int).T
    found, seen = np.zeros((len(row), 2)), np.ones(len(row), bool)
    for down, across in ((0, 0), (0, 1), (1, 0), (1, 1)):
        weight = np.abs(1 - across - (pixels[:, 0] - column)) * np.abs(1 - down - (pixels[:, 1] - row))
        found += weight[:, None] * shown[row + down, column + across]
        seen &= ~missing[row + down, column + across]
    return float(np.linalg.norm(found - wanted, axis=1)[seen].max())


def _psnr(scene: Path, steps: int, folder: Path) -> float:
    """Of one training, by our commands."""
    folder.mkdir(parents=True)
    words = ["unmix-nerf", "--data", str(scene), "--max-num-iterations", str(steps), "--device", "cpu"]
    words += ["--pipeline.model.num-endmembers", "6"]
    _common.run_command([_common.console_script("unmix-train"), *words], folder)
    [run] = folder.glob("outputs/*/*/*")
    _common.run_command([_common.console_script("unmix-eval"), "--run", str(run), "--device", "cpu"], folder)
    metrics = json.loads((run / "eval" / "metrics.json").read_text(encoding="utf-8"))
    return float({**metrics, **metrics.get("means", {})}["psnr"])


def main(options: Options) -> None:
    """Render, process, train in pairs, publish."""
    views, steps = (8, 20) if options.quick else (options.views, options.steps)
    figures, measured = [], {}
    chosen = {name: project for name, project in LENSES.items() if options.only in name}
    for name, project in chosen.items():
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place)
            poses = _poses(views)
            _write_capture(folder / "capture", poses, project, _KEYS.get(name))
            given = None if name in _KEYS else str(folder / "capture" / "Ori-All")
            _process(folder / "capture", folder / "resampled", given)
            lens = _lens_of_scene(folder / "resampled")
            off_px = _points_off_px(folder, name, lens)
            keys = {
                "fl_x": lens.focal_px[0],
                "fl_y": lens.focal_px[1],
                "cx": lens.center_px[0],
                "cy": lens.center_px[1],
            }
            keys |= dict(zip(("k1", "k2", "p1", "p2"), lens.distortion, strict=True))
            keys |= dict(zip(("k3", "k4"), lens.higher_radial, strict=True))
            _write_capture(folder / "direct-capture", poses, lens.pixels_of, keys)
            _process(folder / "direct-capture", folder / "direct", None)
            for kind in ("cubes", "images", "masks"):  # evaluation views that were never resampled
                for path in (folder / "direct" / kind).glob("eval_*"):
                    (folder / "resampled" / kind / path.name).write_bytes(path.read_bytes())
            direct, resampled = (
                _psnr(folder / which, steps, folder / "runs" / which) for which in ("direct", "resampled")
            )
        moved = fit_lens(project, Lens(WIDTH, HEIGHT, (60.0, 60.0), _CENTER), name, "").note
        measured[name] = {
            "points_off_px": off_px,
            "direct_db": direct,
            "resampled_db": resampled,
            "said": moved,
        }
        figures.append(_common.Limit(0.1, is_upper=True, unit=" px").judge(f"{name}: points off", off_px))
        lost = direct - resampled
        figures.append(
            _common.Limit(1.0, is_upper=True, unit=" dB").judge(
                f"{name}: PSNR lost ({resampled:.2f} dB resampled, {direct:.2f} dB direct)", lost
            )
        )
    setting = {"steps": steps, "views": views, "size": [HEIGHT, WIDTH], "bands": BANDS}
    question = "Are resampled pictures of other lenses as good as direct ones?"
    report = _common.Report("lenses", question, setting, _machine.describe_machine("cpu"), figures, measured)
    _common.publish(report, _common.results_folder(options.results, options.quick))


if __name__ == "__main__":
    main(tyro.cli(Options))
