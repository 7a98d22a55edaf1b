"""Path-traces described scenes with Mitsuba 3, and writes them as scene folders or as raw captures, with their truth.

Three bands are traced at a time, as the three channels of Mitsuba's `scalar_rgb`: reflectances are colours of vertices,
and all light has one spectrum, which is applied afterwards. Abundances of pixels are means over the same box filter.

Notation: `H`, `W` rows and columns, `B` bands, `K` materials.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from _traced_bodies import Body
from _traced_scenes import Lamp, TracedScene
from PIL import Image
from scipy import ndimage

from unmix_plugin.formats.envi import UINT16, cube_entries, header_bytes, wavelength_entries
from unmix_plugin.scenes.demo.scene import lens_entries, transform_matrix
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import illuminant_power, linear_to_srgb, rgb_matrix
from unmix_plugin.spectral.library.spectra_csv import SpectraTable, write_spectra_csv

Array = np.ndarray
_DEPTH = 5
"""Segments of the longest path."""
_EVALUATION_PATHS = 100
"""Per pixel and band of views that are kept from training: what is compared with should have no noise of its own."""
_ABUNDANCE_RAYS = 16
"""Per pixel, for abundances and labels."""
_UNLABELLED = 255
_BRIGHTEST = 99.7
"""Percentile of the training pixels that an exposure of 1 maps to 0.9."""
_FULL_COUNTS, _DARK_COUNTS, _READ_NOISE = 60_000.0, 800.0, 12.0


def write_scene(scene: TracedScene, folder: Path, follow: Callable[[float], None]) -> None:
    """Render all views of a scene and write its folder, transforms.json last.

    Args:
        follow: Is told the share that is done.
    """
    light = illuminant_power(scene.light, Bands.of(scene.wavelengths_nm))
    cubes, alphas, abundances = _Tracer(scene).views(follow)
    cubes *= light.astype(np.float32)
    is_measure = ~scene.is_evaluation[:, None, None] & (
        abundances.sum(axis=-1) > 0.5
    )  # lamps in view are none
    brightest = np.percentile(cubes[is_measure].max(axis=-1), _BRIGHTEST)
    cubes *= np.float32(0.9 * scene.exposure / brightest)
    write = _write_raw if scene.is_raw else _write_folder
    write(scene, folder, cubes, list(zip(alphas, abundances, strict=True)), light)


class _Tracer:
    """A scene as Mitsuba has it."""

    def __init__(self, scene: TracedScene) -> None:
        import mitsuba  # pyright: ignore[reportMissingImports] - of the extra "reference"

        mitsuba.set_variant("scalar_rgb")
        self._mitsuba: Any = mitsuba
        self._scene = scene
        lit = {
            f"body{k}": self._shape(f"body{k}", body, body.roughness) for k, body in enumerate(scene.bodies)
        }
        matt = {f"body{k}": self._shape(f"body{k}", body, None) for k, body in enumerate(scene.bodies)}
        self._matt = mitsuba.load_dict(
            {
                "type": "scene",
                **matt,
                **self._lamp_in_view(),
                "light": {"type": "constant", "radiance": _grey(1.0)},
            }
        )
        self._lit = mitsuba.load_dict({"type": "scene", **lit, **self._lights()})
        self._parameters = {id(each): mitsuba.traverse(each) for each in (self._matt, self._lit)}
        self._path = mitsuba.load_dict(
            {"type": "path", "max_depth": _DEPTH, "hide_emitters": scene.has_alpha}
        )
        self._albedo = mitsuba.load_dict({"type": "aov", "aovs": "albedo:albedo"})

    def views(self, follow: Callable[[float], None]) -> tuple[Array, Array, Array]:
        """Light before its spectrum (N, H, W, B), alpha (N, H, W) and abundances (N, H, W, K) of all views."""
        scene = self._scene
        num_bands, count = len(scene.wavelengths_nm), len(scene.names)
        passes = -(-num_bands // 3) + -(-count // 3)
        bands, shown = [], []
        # All views of three bands before the next three: Mitsuba builds the scene anew when colours change.
        for columns in self._threes(scene.reflectances.T):
            bands.append(self._rendered(self._lit, columns, self._path, scene.paths))
            follow(len(bands) / passes)
        for columns in self._threes(np.eye(count)):
            shown.append(self._rendered(self._matt, columns, self._albedo, _ABUNDANCE_RAYS))
            follow((len(bands) + len(shown)) / passes)
        cubes = np.concatenate([images[..., :3] for images in bands], axis=-1)[..., :num_bands]
        abundances = np.concatenate([images[..., :3] for images in shown], axis=-1)[..., :count]
        alpha = bands[0][..., 3] if scene.has_alpha else np.ones(cubes.shape[:3], np.float32)
        return cubes, alpha.clip(0, 1), abundances

    def _threes(self, spectra: Array) -> Iterator[list[Array]]:
        """Colours of the vertices of every body, three rows of `spectra` (B, K) at a time, the last ones filled up."""
        for start in range(0, len(spectra), 3):
            rows = spectra[np.arange(start, start + 3).clip(max=len(spectra) - 1)]
            yield [body.abundances @ rows.T for body in self._scene.bodies]

    def _rendered(self, lit: Any, columns: Sequence[Array], integrator: Any, paths: int) -> Array:
        """Every view (N, H, W, channels) with these colours of the bodies."""
        parameters = self._parameters[id(lit)]
        for k, colours in enumerate(columns):
            parameters[f"body{k}.vertex_color"] = np.ascontiguousarray(colours, np.float32).ravel()
        parameters.update()
        lamp, images = self._scene.lamp, []
        for index, is_evaluation in enumerate(self._scene.is_evaluation):
            if lamp is not None and lamp.follows_camera and lit is self._lit:
                self._move_lamp(lamp, index)
            # One seed for all bands of a view: a path carries its whole spectrum.
            rays = max(paths, _EVALUATION_PATHS) if is_evaluation and lit is self._lit else paths
            image = self._mitsuba.render(
                lit, sensor=self._sensor(index, rays), integrator=integrator, seed=index
            )
            images.append(np.array(image, np.float32))
        return np.stack(images)

    def _shape(self, title: str, body: Body, roughness: float | None) -> Any:
        colour = {"type": "mesh_attribute", "name": "vertex_color"}
        material: dict[str, Any] = {"type": "twosided", "inner": {"type": "diffuse", "reflectance": colour}}
        if roughness is not None:
            material = {"type": "principled", "base_color": colour, "specular": 0.5, "roughness": roughness}
        properties = self._mitsuba.Properties()
        properties["mesh_bsdf"] = self._mitsuba.load_dict(material)
        vertices, faces = len(body.mesh.vertices), len(body.mesh.faces)
        shape = self._mitsuba.Mesh(title, vertices, faces, has_vertex_normals=True, props=properties)
        shape.add_attribute("vertex_color", 3, np.zeros(3 * vertices, np.float32))
        parameters = self._mitsuba.traverse(shape)
        parameters["vertex_positions"] = np.asarray(body.mesh.vertices, np.float32).ravel()
        parameters["vertex_normals"] = np.asarray(body.mesh.vertex_normals, np.float32).ravel()
        parameters["faces"] = np.asarray(body.mesh.faces, np.uint32).ravel()
        parameters.update()
        return shape

    def _lights(self) -> dict[str, Any]:
        scene, lights = self._scene, {}
        if scene.sky > 0:
            lights["sky"] = {"type": "constant", "radiance": _grey(scene.sky)}
        if scene.sun is not None:
            lights["sun"] = {"type": "directional", "direction": list(scene.sun), "irradiance": _grey(2.0)}
        if scene.lamp is not None and scene.lamp.follows_camera:
            intensity = _grey(scene.lamp.radiance * math.pi * scene.lamp.radius**2)
            lights["lamp"] = {"type": "point", "position": [0, 0, 3], "intensity": intensity}
        elif scene.lamp is not None:
            emitter = {"type": "area", "radiance": _grey(scene.lamp.radiance)}
            sphere = {"type": "sphere", "center": list(scene.lamp.place), "radius": scene.lamp.radius}
            lights["lamp"] = {**sphere, "emitter": emitter}
        return lights

    def _move_lamp(self, lamp: Lamp, index: int) -> None:
        pose = self._scene.cameras.camera_to_world[index].double().numpy()
        parameters = self._parameters[id(self._lit)]
        parameters["lamp.position"] = (pose[:, 3] + pose[:, :3] @ np.asarray(lamp.place)).tolist()
        parameters.update()

    def _lamp_in_view(self) -> dict[str, Any]:
        """The lamp as a body without materials, where views show it."""
        lamp = self._scene.lamp
        if lamp is None or lamp.follows_camera or self._scene.has_alpha:
            return {}
        black = {"type": "diffuse", "reflectance": _grey(0.0)}
        return {"lamp": {"type": "sphere", "center": list(lamp.place), "radius": lamp.radius, "bsdf": black}}

    def _sensor(self, index: int, rays: int) -> Any:
        cameras = self._scene.cameras
        pose = cameras.camera_to_world[index].double().numpy()
        origin, up, back = pose[:, 3], pose[:, 1], pose[:, 2]
        look_at = self._mitsuba.ScalarTransform4f().look_at(
            origin.tolist(), (origin - back).tolist(), up.tolist()
        )
        film = {"type": "hdrfilm", "width": cameras.width, "height": cameras.height, "pixel_format": "rgba"}
        angle = 2 * math.atan(cameras.width / 2 / float(cameras.focal_px[index, 0]))
        return self._mitsuba.load_dict(
            {
                "type": "perspective",
                "fov": math.degrees(angle),
                "to_world": look_at,
                "film": {**film, "rfilter": {"type": "box"}},
                # A third of the noise that independent samples have.
                "sampler": {"type": "multijitter", "sample_count": rays},
            }
        )


def _grey(value: float) -> dict[str, Any]:
    return {"type": "rgb", "value": [value] * 3}


def _write_folder(
    scene: TracedScene, folder: Path, cubes: Array, masks: Sequence[tuple[Array, Array]], light: Array
) -> None:
    """The layout of UnMix-NeRF: cubes, pictures, labels, and abundances of evaluation views."""
    rng, sampling = np.random.default_rng(17), Bands.of(scene.wavelengths_nm)
    for name in ("images", "cubes", "labels", "abundances"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    _write_truth(scene, folder, light)
    frames: list[dict[str, Any]] = []
    for index, (cube, (alpha, abundances)) in enumerate(zip(cubes, masks, strict=True)):
        split = "eval" if scene.is_evaluation[index] else "train"
        title = f"{split}_{index:03d}"
        if scene.noise:
            cube = cube + scene.noise * rng.standard_normal(cube.shape).astype(np.float32)
        cube = cube.clip(0, 1)
        is_wrong = scene.has_wrong_masks and split == "train"
        mask = _wrong_mask(rng, alpha, cube, has_hole=index in (5, 20)) if is_wrong else alpha
        if scene.has_alpha and not scene.noise:
            cube = np.where(alpha[..., None] > 0, cube, 0)
        srgb = linear_to_srgb(torch.from_numpy(cube) @ rgb_matrix(sampling)).clamp(0, 1).numpy()
        picture = np.concatenate([srgb, mask[..., None]], axis=-1) if scene.has_alpha else srgb
        entry: dict[str, Any] = {
            "file_path": f"images/{title}.png",
            "hyperspectral_file_path": f"cubes/{title}.npy",
            "seg_file_path": f"labels/{title}.png",
            "transform_matrix": transform_matrix(scene.cameras, index),
        }
        Image.fromarray((picture * 255).round().astype(np.uint8)).save(folder / entry["file_path"])
        Image.fromarray(_labels(abundances)).save(folder / entry["seg_file_path"])
        np.save(folder / entry["hyperspectral_file_path"], cube.astype(np.float16))
        if split == "eval":
            entry["abundance_file_path"] = f"abundances/{title}.npy"
            np.save(folder / entry["abundance_file_path"], abundances.astype(np.float16))
        frames.append(entry)
    named = [frame["file_path"] for frame in frames]
    content = {
        **lens_entries(scene.cameras),
        "wavelengths": scene.wavelengths_nm.tolist(),
        "materials": list(scene.names),
        "illuminant_path": "illuminant.csv",
        "endmembers_path": "endmembers.csv",
        "train_filenames": [name for name, kept in zip(named, scene.is_evaluation, strict=True) if not kept],
        "val_filenames": [name for name, kept in zip(named, scene.is_evaluation, strict=True) if kept],
        "test_filenames": [name for name, kept in zip(named, scene.is_evaluation, strict=True) if kept],
        "frames": frames,
    }
    (folder / "transforms.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _write_raw(
    scene: TracedScene, folder: Path, cubes: Array, masks: Sequence[tuple[Array, Array]], light: Array
) -> None:
    """ENVI counts of a snapshot camera, `white` and `dark`, true poses, and `truth/` with labels."""
    rng = np.random.default_rng(18)
    (folder / "truth").mkdir(parents=True, exist_ok=True)
    _write_truth(scene, folder / "truth", light)
    _, width, num_bands = cubes.shape[1:]
    sensitivity = np.exp(-(((scene.wavelengths_nm - 560) / 170) ** 2))
    columns = 1 + 0.03 * rng.standard_normal((width, num_bands))
    full = _FULL_COUNTS * sensitivity * columns
    dark = _DARK_COUNTS + 60 * rng.standard_normal((width, num_bands))

    def write(name: str, counts: Array, what: str) -> None:
        entries = cube_entries(
            "ENVI Standard", f"{what}, raw counts", width, len(counts), num_bands, "bil", UINT16
        )
        entries |= wavelength_entries(Bands.of(scene.wavelengths_nm))
        noisy = counts + rng.standard_normal(counts.shape) * np.sqrt(np.abs(counts - dark) + _READ_NOISE**2)
        stored = noisy.round().clip(0, 65535).astype("<u2")
        (folder / f"{name}.raw").write_bytes(stored.transpose(0, 2, 1).tobytes())
        (folder / f"{name}.hdr").write_bytes(header_bytes(entries))

    lamp = light / (light * sensitivity).max()
    write("dark", np.broadcast_to(dark, (60, width, num_bands)), "dark frame")
    write("white", np.broadcast_to(dark + 0.9 * full * lamp, (60, width, num_bands)), "white reference")
    frames = []
    for index, (cube, (_, abundances)) in enumerate(zip(cubes, masks, strict=True)):
        name = f"view_{index:03d}"
        # In units of the white panel, which is 1 where the cube has the light itself.
        write(name, dark + 0.9 * full * lamp * (cube / light), "a view")
        Image.fromarray(_labels(abundances)).save(folder / "truth" / f"{name}.png")
        frames.append(
            {"file_path": f"{name}.hdr", "transform_matrix": transform_matrix(scene.cameras, index)}
        )
    poses = json.dumps(lens_entries(scene.cameras) | {"frames": frames}, indent=1) + "\n"
    (folder / "poses-true.json").write_text(poses, encoding="utf-8")


def _write_truth(scene: TracedScene, folder: Path, light: Array) -> None:
    sampling = Bands.of(scene.wavelengths_nm)
    folder.mkdir(parents=True, exist_ok=True)
    write_spectra_csv(folder / "endmembers.csv", SpectraTable(sampling, scene.names, scene.reflectances))
    write_spectra_csv(folder / "illuminant.csv", SpectraTable(sampling, ("power",), light[None]))


def _labels(abundances: Array) -> Array:
    """The material with the largest abundance where at least half of a pixel shows one, otherwise 255."""
    is_shown = abundances.sum(axis=-1) >= 0.5
    return np.where(is_shown, abundances.argmax(axis=-1), _UNLABELLED).astype(np.uint8)


def _wrong_mask(rng: np.random.Generator, alpha: Array, cube: Array, has_hole: bool) -> Array:
    """A binary mask as people make them: edges off by a pixel, specks, blown-out parts left out, a hole."""
    mask = ndimage.binary_dilation(alpha > 0.5, iterations=1) if rng.random() < 0.5 else alpha > 0.7
    mask = np.asarray(mask, bool) & ~(ndimage.uniform_filter(cube.max(axis=-1), 3) > 0.98)
    mask ^= rng.random(mask.shape) < 0.001
    if has_hole:
        rows, columns = np.nonzero(mask)
        place = int(rng.integers(len(rows)))
        y, x = np.ogrid[: mask.shape[0], : mask.shape[1]]
        mask &= (y - rows[place]) ** 2 + (x - columns[place]) ** 2 > 25
    return mask.astype(np.float32)
