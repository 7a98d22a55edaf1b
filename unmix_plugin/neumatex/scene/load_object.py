"""From an object's folder to a validated `ObjectScene`.

The folder has transforms.json and pictures as any scene has, a mesh, an environment map, and perhaps `relit/<light>/`
with the same under lights that training never sees. docs/guides/neumatex.md says what its keys mean.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from unmix_plugin.errors import SceneError
from unmix_plugin.neumatex.geometry.mesh import Mesh
from unmix_plugin.neumatex.geometry.ray_mesh import RayMesh
from unmix_plugin.neumatex.geometry.read_mesh import SUFFIXES as MESH_SUFFIXES
from unmix_plugin.neumatex.geometry.read_mesh import read_mesh
from unmix_plugin.neumatex.lighting.environment import Environment
from unmix_plugin.neumatex.lighting.lamp import read_environment_of_bands
from unmix_plugin.neumatex.lighting.read_environment import SUFFIXES as ENVIRONMENT_SUFFIXES
from unmix_plugin.neumatex.lighting.read_environment import read_environment
from unmix_plugin.neumatex.scene.light_check import light_doubt
from unmix_plugin.neumatex.scene.mesh_check import mesh_fit
from unmix_plugin.neumatex.scene.object_scene import HeldOutLight, ObjectScene
from unmix_plugin.neumatex.scene.posed_pictures import PosedPictures, has_alpha, read_posed_pictures
from unmix_plugin.neumatex.scene.spectral_light import SpectralLight, spectral_light
from unmix_plugin.neumatex.scene.true_materials import read_true_materials
from unmix_plugin.neumatex.tone.curves import TONE_MAPPINGS, ToneMapping
from unmix_plugin.scenes.placement import Placement
from unmix_plugin.scenes.reading.faults import (
    Faults,
    describe,
    read_json_file,
    read_number,
    resolve_path,
    sha256_of,
)
from unmix_plugin.scenes.reading.splits import split_frames
from unmix_plugin.scenes.reading.transforms_json import FILE_NAME, SceneEntry, read_transforms
from unmix_plugin.scenes.scene import Normalisation

EVAL_INTERVAL = 8
"""Every so many frames one is for evaluation, where transforms.json does not say which."""
MOST_STOPS = 20.0


def load_object(root: Path, lamp: str | None = None) -> ObjectScene:
    """Read and check an object's folder.

    Args:
        root: The folder.
        lamp: For pictures of many bands: what lit them, as `read_lamp` takes it, instead of what the folder says.
    Raises:
        SceneError: the folder is not a sound object; the message says what is wrong with it.
    """
    root = root.resolve()
    faults, notes = Faults(root), list[str]()
    entry = read_transforms(root, faults, needs_cubes=False)
    split = split_frames(entry, "auto", EVAL_INTERVAL, faults)
    light = _read_light(root, faults)
    mesh_path = _find_file(root, "mesh_path", "mesh", MESH_SUFFIXES, faults)
    faults.raise_if_any()
    assert light is not None
    assert mesh_path is not None
    frame, mesh, pictures = _placed(
        read_mesh(mesh_path, notes), mesh_path.name, root, entry, light, notes, faults
    )
    spectral = spectral_light(root, entry, pictures, lamp)
    environment = light.environment(spectral)
    doubt = light_doubt(pictures, environment)
    notes += [] if doubt is None else [doubt]
    files = {mesh_path.name: mesh_path, light.environment_path.name: light.environment_path}
    truth = root / "truth" / "base_colour"
    return ObjectScene(
        root=root,
        mesh=mesh,
        environment=environment,
        frame=frame,
        pictures=pictures,
        split=split,
        lights=tuple(_read_held_out(path, frame, spectral) for path in _held_out_folders(root)),
        bands=None if spectral is None else spectral.bands,
        lamp=None if spectral is None else spectral.lamp_of(environment),
        truth=truth if truth.is_dir() else None,
        true_materials=read_true_materials(root, entry, spectral),
        input_hashes={**{name: sha256_of(path) for name, path in files.items()}, **pictures.hashes},
        notes=tuple(notes),
    )


@dataclass(frozen=True)
class _Light:
    """What a transforms.json says of light and tone."""

    environment_path: Path
    rotation_deg: float
    exposure_stops: float
    tone: ToneMapping | None

    def environment(self, spectral: SpectralLight | None) -> Environment:
        """In the bands of spectral pictures, otherwise in colours."""
        placement = (self.rotation_deg, self.exposure_stops)
        if spectral is None:
            return read_environment(self.environment_path, *placement)
        return read_environment_of_bands(self.environment_path, spectral.bands, spectral.lamp, *placement)


def _read_light(root: Path, faults: Faults) -> _Light | None:
    """The keys of light and tone; None with noted faults where they are wrong."""
    noted, content = faults.noted, _content(root)
    path = _find_file(root, "environment_path", "environment", ENVIRONMENT_SUFFIXES, faults)
    numbers = dict[str, float]()
    for key, most in (("environment_rotation_deg", 1e6), ("environment_exposure_stops", MOST_STOPS)):
        number = read_number(content.get(key, 0.0))
        if number is None or abs(number) > most:
            faults.add(
                FILE_NAME,
                f"'{key}' is {describe(content[key])}; expected a number from {-most:g} to {most:g}",
            )
        numbers[key] = number or 0.0
    tone = content.get("tone_mapping")
    if tone is not None and tone not in TONE_MAPPINGS:
        known = ", ".join(TONE_MAPPINGS)
        faults.add(FILE_NAME, f"'tone_mapping' is {describe(tone)}; expected one of {known}")
    if path is None or faults.noted > noted:
        return None
    rotation_deg, exposure_stops = numbers.values()
    return _Light(path, rotation_deg, exposure_stops, cast("ToneMapping | None", tone))


def _find_file(root: Path, key: str, what: str, suffixes: tuple[str, ...], faults: Faults) -> Path | None:
    """The file that a key names, or the only one of its kind; None and a noted fault if there is none."""
    named = _content(root).get(key)
    if named is not None:
        if not isinstance(named, str) or not named:
            faults.add(FILE_NAME, f"'{key}' is {describe(named)}; expected a path")
            return None
        return resolve_path(root, named, None, f"'{key}'", faults)
    found = sorted(path for path in root.iterdir() if path.suffix.lower() in suffixes and path.is_file())
    usual = [path for path in found if path.stem == what]
    chosen = usual if len(found) > 1 and usual else found
    if len(chosen) == 1:
        return chosen[0]
    listed = ", ".join(path.name for path in chosen)
    names = " or ".join(f"{what}{suffix}" for suffix in suffixes)
    advice = f"name one with '{key}' in {FILE_NAME}" if chosen else f"put {names} there"
    faults.add(str(root), f"has {f'several: {listed}' if chosen else f'no {what}'}; {advice}")
    return None


def _content(root: Path) -> dict[str, Any]:
    """What transforms.json holds, which `read_transforms` has checked to be an object."""
    return read_json_file(root / FILE_NAME)


def _placed(
    given: Mesh, name: str, root: Path, entry: SceneEntry, light: _Light, notes: list[str], faults: Faults
) -> tuple[Normalisation, Mesh, PosedPictures]:
    """The mesh and the pictures in model space; a mesh that fits only with its y axis upwards is turned.

    Raises:
        SceneError: it fits neither way; the message says how far off it is as it was given.
    """
    found: list[str] = []
    for placed in (given, given.with_y_upwards()):
        frame, mesh = _model_space(placed)
        pictures = read_posed_pictures(root, entry, _from_poses(frame, entry.placement), light.tone, faults)
        alphas = [_alpha(pictures, index) for index in range(len(pictures))]
        fit = mesh_fit(RayMesh(mesh), pictures.cameras, alphas, frame, name)
        if fit.misplaced is None:
            doubt = fit.doubt(name)
            notes += [] if doubt is None else [doubt]
            notes += (
                [f"{name} has y as its upward axis, the poses have z: the mesh was turned"] if found else []
            )
            return frame, mesh, pictures
        found.append(fit.misplaced)
    raise SceneError(found[0])


def _model_space(mesh: Mesh) -> tuple[Normalisation, Mesh]:
    scale, offset = mesh.to_model_space()
    middle = -offset.double().numpy()
    return Normalisation(np.eye(3), np.zeros(3), scale, middle), mesh.transformed(scale, offset)


def _from_poses(frame: Normalisation, placement: Placement) -> Normalisation:
    """From the space of transforms.json to model space, given that from the world."""
    back = placement.rotation.T
    shift = placement.scale * (placement.offset - frame.offset - back @ placement.translation)
    return Normalisation(back, shift, frame.scale / placement.scale)


def _alpha(pictures: PosedPictures, index: int) -> np.ndarray | None:
    picture = pictures.read(index)
    return picture.alpha if has_alpha(picture) else None


def _held_out_folders(root: Path) -> list[Path]:
    relit = root / "relit"
    return sorted(path for path in relit.iterdir() if path.is_dir()) if relit.is_dir() else []


def _read_held_out(folder: Path, frame: Normalisation, spectral: SpectralLight | None) -> HeldOutLight:
    faults = Faults(folder)
    entry: SceneEntry = read_transforms(folder, faults, needs_cubes=False)
    light = _read_light(folder, faults)
    faults.raise_if_any()
    if light is None:
        raise SceneError(f"{folder} has no environment map")
    pictures = read_posed_pictures(folder, entry, _from_poses(frame, entry.placement), light.tone, faults)
    if spectral is not None:
        spectral = spectral.of_held_out(folder, entry, pictures)
    return HeldOutLight(folder.name, light.environment(spectral), pictures)
