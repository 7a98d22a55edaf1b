"""A validated object, read from its folder: its mesh, the light around it, and posed pictures of it.

The folder has transforms.json and pictures as any scene has, a mesh, an environment map, and perhaps `relit/<light>/`
with the same under lights that training never sees. docs/background/neumatex.md says what its keys mean.

World space is that of the mesh's file, and of the poses before nerfstudio's `applied_transform`; z is up. Model space
has the mesh's bounding box in the middle of [-1, 1]^3, axes as in the world.

Notation: `H x W` pixels, `B` bands, `M` true materials.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from jaxtyping import Float32, Float64

from unmix_plugin.errors import SceneError
from unmix_plugin.neumatex.fit.checks import (
    is_misplaced,
    light_doubt,
    misplacement,
    outline_doubt,
    outline_overlaps,
    sides_seen,
)
from unmix_plugin.neumatex.fit.pictures import PosedPictures, has_alpha, read_picture, read_posed_pictures
from unmix_plugin.neumatex.fit.tone import TONE_MAPPINGS, ToneMapping
from unmix_plugin.neumatex.tracing.environment import Environment
from unmix_plugin.neumatex.tracing.light_files import (
    ENVIRONMENT_SUFFIXES,
    read_environment,
    read_environment_of_bands,
    read_lamp,
)
from unmix_plugin.neumatex.tracing.mesh import MESH_SUFFIXES, Mesh, read_mesh, turned_to_viewers
from unmix_plugin.neumatex.tracing.rays import RayMesh
from unmix_plugin.scenes.placement import Placement
from unmix_plugin.scenes.reading.cubes import UnreadableArrayError, map_array
from unmix_plugin.scenes.reading.faults import (
    Faults,
    describe,
    read_json_file,
    read_number,
    resolve_path,
    sha256_of,
)
from unmix_plugin.scenes.reading.foreign_keys import FILE_NAME
from unmix_plugin.scenes.reading.loader import read_endmembers
from unmix_plugin.scenes.reading.splits import Split, split_frames
from unmix_plugin.scenes.reading.transforms_json import SceneEntry, read_transforms
from unmix_plugin.scenes.scene import Normalisation
from unmix_plugin.spectral.bands import Bands

EVAL_INTERVAL = 8
"""Every so many frames one is for evaluation, where transforms.json does not say which."""
MOST_STOPS = 20.0
_NUM_COLOURS = 3
_SAME_BAND_NM = 0.5
"""Wavelengths in names of files' channels are rounded."""
_CLEARLY_BETTER = 0.01
"""Of the mean overlap of outlines: pixels at their edges make that of equal shapes differ by less."""


@dataclass(frozen=True)
class _HeldOutLight:
    """The object under a light that training never sees."""

    name: str
    environment: Environment
    pictures: PosedPictures
    """All for evaluation."""


@dataclass(frozen=True)
class _TrueMaterials:
    """What an object is really made of."""

    names: tuple[str, ...]
    endmembers: Float64[np.ndarray, "M B"]
    """Reflectances."""
    abundance_files: tuple[Path | None, ...]
    """One a view."""


@dataclass(frozen=True)
class ObjectScene:
    """Everything known about an object; made by `load_object` only, which guarantees what is said here."""

    root: Path
    """Its folder."""
    mesh: Mesh
    """Model space."""
    environment: Environment
    """The light of the pictures, world directions."""
    frame: Normalisation
    """From world to model space."""
    pictures: PosedPictures
    """All views."""
    split: Split
    """Views to train on and views to evaluate, at least one each."""
    lights: tuple[_HeldOutLight, ...]
    bands: Bands | None
    """Of spectral pictures; None for RGB."""
    lamp: Float64[np.ndarray, " B"] | None
    """Relative power of the light of spectral pictures, greatest band 1."""
    truth: Path | None
    """Folder of true base colours; None where there is none."""
    true_materials: _TrueMaterials | None
    """Of spectral pictures, where they are known."""
    input_hashes: dict[str, str]
    """SHA-256 of mesh, environment and pictures."""
    notes: tuple[str, ...]
    """What is unusual but usable."""

    def base_colour(self, index: int) -> Float32[np.ndarray, "H W 3"] | None:
        """True base colour of a view, linear; None where it is unknown.

        Raises:
            SceneError: its file is malformed, or has another size than the view.
        """
        name = f"{self.pictures.files[index].name}.exr"
        if self.truth is None or not (self.truth / name).is_file():
            return None
        found = read_picture(self.truth / name).numbers
        self._require_shape(self.truth / name, found, index, _NUM_COLOURS, "colours")
        return found

    def abundances(self, index: int) -> Float32[np.ndarray, "H W M"] | None:
        """True abundances of a view's pixels; None where they are unknown.

        Raises:
            SceneError: the file can't be read, or has another size than the view, or another number of materials.
        """
        materials = self.true_materials
        path = None if materials is None else materials.abundance_files[index]
        if materials is None or path is None:
            return None
        try:
            found = np.array(map_array(path), dtype=np.float32)
        except UnreadableArrayError as error:
            raise SceneError(f"{path} {error}") from error
        self._require_shape(path, found, index, len(materials.names), "materials")
        return found

    def _require_shape(self, path: Path, found: np.ndarray, index: int, count: int, what: str) -> None:
        width, height = self.pictures.cameras.size(index)
        if found.shape != (height, width, count):
            raise SceneError(
                f"{path}: has shape {found.shape}; expected {(height, width, count)}: rows and columns of the view "
                f"{self.pictures.names[index]}, and {count} {what}"
            )

    def summary(self) -> dict[str, Any]:
        """What a run has to record of the object, as JSON-able values."""
        return {
            "root": str(self.root),
            "frames": self.pictures.names,
            "train_indices": list(self.split.train),
            "eval_indices": list(self.split.evaluation),
            "normalisation": self.frame.to_json(),
            "tone_mapping": self.pictures.tone,
            "lights": {light.name: light.pictures.names for light in self.lights},
            "input_hashes": dict(self.input_hashes),
        }


def load_object(root: Path, lamp: str | None = None) -> ObjectScene:
    """Read and check an object's folder.

    Args:
        root: The folder.
        lamp: For pictures of many bands: what lit them, as `read_lamp` takes it, instead of what the folder says.
    Raises:
        SceneError: the folder is not a sound object; the message says what is wrong with it.
    """
    root = root.resolve()
    faults = Faults(root)
    entry = read_transforms(root, faults, needs_cubes=False)
    notes = list(entry.warnings)
    split = split_frames(entry, "auto", EVAL_INTERVAL, faults)
    folder = _read_folder(root, entry, faults)
    mesh_path = _find_file(root, "mesh_path", "mesh", MESH_SUFFIXES, faults)
    faults.raise_if_any()
    assert mesh_path is not None
    frame, mesh, pictures = _placed(read_mesh(mesh_path, notes), mesh_path.name, folder, notes)
    bands, own_lamp = _spectral_light(folder, pictures, lamp)
    environment = folder.environment(bands, own_lamp)
    doubt = light_doubt(pictures, environment)
    notes += [] if doubt is None else [doubt]
    held_out = [
        _read_held_out(path, frame, pictures, bands, own_lamp, notes) for path in _held_out_folders(root)
    ]
    if bands is not None and own_lamp is None:
        light_of_all = environment.mean_radiance().double().numpy()
        own_lamp = light_of_all / light_of_all.max()
    truth = root / "truth" / "base_colour"
    files = {path.name: sha256_of(path) for path in (mesh_path, folder.environment_path)}
    scene = ObjectScene(
        root=root,
        mesh=mesh,
        environment=environment,
        frame=frame,
        pictures=pictures,
        split=split,
        lights=tuple(held_out),
        bands=bands,
        lamp=own_lamp,
        truth=truth if truth.is_dir() else None,
        true_materials=None if bands is None else _read_true_materials(root, entry, bands),
        input_hashes={**files, **pictures.hashes},
        notes=tuple(notes),
    )
    for view in split.evaluation:  # a malformed truth is told before training, not after it
        scene.base_colour(view)
        scene.abundances(view)
    return scene


@dataclass(frozen=True)
class _Folder:
    """What a folder's transforms.json says."""

    root: Path
    entry: SceneEntry
    environment_path: Path
    placement: tuple[float, float]
    """Of the environment: rotation in degrees and exposure in stops."""
    tone: ToneMapping | None

    def pictures(self, frame: Normalisation) -> PosedPictures:
        """Its pictures in model space, given that from the world."""
        return read_posed_pictures(self.root, self.entry, _from_poses(frame, self.entry.placement), self.tone)

    def environment(self, bands: Bands | None, lamp: Float64[np.ndarray, " B"] | None) -> Environment:
        """In the bands of spectral pictures, otherwise in colours."""
        if bands is None:
            return read_environment(self.environment_path, *self.placement)
        return read_environment_of_bands(self.environment_path, bands, lamp, *self.placement)

    def lamp(self, bands: Bands) -> Float64[np.ndarray, " B"] | None:
        """What 'illuminant_path' names; None where there is none."""
        if self.entry.illuminant_path is None:
            return None
        faults = Faults(self.root)
        path = resolve_path(self.root, self.entry.illuminant_path, None, "'illuminant_path'", faults)
        faults.raise_if_any()
        return None if path is None else read_lamp(str(path), bands)


def _spectral_light(
    folder: _Folder, pictures: PosedPictures, lamp: str | None
) -> tuple[Bands | None, Float64[np.ndarray, " B"] | None]:
    """Bands of an object's pictures, None for pictures in colours, and their lamp's power, None where it is not
    given."""
    root, bands, count = folder.root, _bands_of(folder, pictures), pictures.num_colours
    if bands is None and count == _NUM_COLOURS:
        if lamp is not None:
            raise SceneError(f"{root}: a lamp is given, but its pictures have {count} colours; leave it out")
        return None, None
    if bands is None or len(bands) != count:
        given = "no 'wavelengths'" if bands is None else f"{len(bands)} 'wavelengths'"
        raise SceneError(
            f"{root / FILE_NAME}: {given} for pictures of {count} bands; list the centre of each band in nm"
        )
    if pictures.tone != "linear":
        raise SceneError(
            f"{root / FILE_NAME}: pictures of {count} bands with 'tone_mapping' {pictures.tone}; expected linear light"
        )
    return bands, folder.lamp(bands) if lamp is None else read_lamp(lamp, bands)


def _bands_of(folder: _Folder, pictures: PosedPictures) -> Bands | None:
    """What 'wavelengths' and the files of the pictures say; None where they say nothing."""
    listed, in_files = folder.entry.wavelengths_nm, pictures.wavelengths_nm
    if in_files is None:
        return None if listed is None else Bands(listed)
    bands = Bands.of(in_files)
    if listed is None:
        return bands
    if len(listed) != len(bands) or np.abs(listed - bands.centers_nm).max() > _SAME_BAND_NM:
        raise SceneError(
            f"{folder.root / FILE_NAME}: 'wavelengths' of {Bands(listed)}, but the files of the pictures say {bands}; "
            "give the same, in nm"
        )
    return Bands(listed)


def _read_true_materials(root: Path, entry: SceneEntry, bands: Bands) -> _TrueMaterials | None:
    """What 'endmembers_path' and each frame's 'abundance_file_path' name; None without endmembers."""
    if entry.endmembers_path is None:
        return None
    faults, table = Faults(root), None
    path = resolve_path(root, entry.endmembers_path, None, "'endmembers_path'", faults)
    if path is not None:
        table = read_endmembers(path, bands.centers_nm, entry.materials, "'endmembers_path'", faults)
    named = [(frame.paths.get("abundance_file_path"), frame.where) for frame in entry.frames]
    files = tuple(
        None if file is None else resolve_path(root, file, None, where, faults) for file, where in named
    )
    faults.raise_if_any()
    assert table is not None
    return _TrueMaterials(table.names, table.spectra, files)


def _read_folder(root: Path, entry: SceneEntry, faults: Faults) -> _Folder:
    """The keys of light and tone; only sound where no faults are noted."""
    content = _content(root)
    path = _find_file(root, "environment_path", "environment", ENVIRONMENT_SUFFIXES, faults)
    numbers = list[float]()
    for key, most in (("environment_rotation_deg", 1e6), ("environment_exposure_stops", MOST_STOPS)):
        number = read_number(content.get(key, 0.0))
        if number is None or abs(number) > most:
            faults.add(
                FILE_NAME,
                f"'{key}' is {describe(content[key])}; expected a number from {-most:g} to {most:g}",
            )
        numbers.append(number or 0.0)
    tone = content.get("tone_mapping")
    if tone is not None and tone not in TONE_MAPPINGS:
        known = ", ".join(TONE_MAPPINGS)
        faults.add(FILE_NAME, f"'tone_mapping' is {describe(tone)}; expected one of {known}")
        tone = None
    return _Folder(root, entry, path or root, (numbers[0], numbers[1]), cast("ToneMapping | None", tone))


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
    given: Mesh, name: str, folder: _Folder, notes: list[str]
) -> tuple[Normalisation, Mesh, PosedPictures]:
    """The mesh and the pictures in model space; a mesh that fits clearly better with its y axis upwards is turned.

    Raises:
        SceneError: it fits neither way; the message says how far off it is as it was given.
    """
    frame, mesh, pictures = _in_model_space(given, folder)
    read = (pictures.read(index) for index in range(len(pictures)))
    alphas = [picture.alpha if has_alpha(picture) else None for picture in read]
    scale, offset = given.to_model_space()
    turned = given.with_y_upwards()
    as_given, upright = (
        outline_overlaps(RayMesh(one.transformed(scale, offset)), pictures.cameras, alphas)
        for one in (given, turned)
    )
    has_outlines = any(alpha is not None for alpha in alphas)
    is_better = has_outlines and upright.mean() > as_given.mean() + _CLEARLY_BETTER
    if (is_better or is_misplaced(as_given)) and not is_misplaced(upright):
        notes.append(f"{name} has y as its upward axis, the poses have z: the mesh was turned")
        as_given = upright
        frame, mesh, pictures = _in_model_space(turned, folder)
    if is_misplaced(as_given):
        raise SceneError(misplacement(as_given, pictures.cameras, frame, name))
    doubt = outline_doubt(as_given, name)
    if not has_outlines:
        doubt = (
            f"the pictures have no alpha: whether {name} lies as they show the object, and which of its axes is "
            "upwards, could not be checked"
        )
    notes += [] if doubt is None else [doubt]
    mesh, count = turned_to_viewers(mesh, sides_seen(RayMesh(mesh), pictures.cameras))
    if count:
        notes.append(
            f"{name}: cameras saw {count} of {len(mesh.faces)} triangles from behind; they were turned"
        )
    return frame, mesh, pictures


def _in_model_space(mesh: Mesh, folder: _Folder) -> tuple[Normalisation, Mesh, PosedPictures]:
    """From the world to model space, and a mesh and the pictures there."""
    scale, offset = mesh.to_model_space()
    frame = Normalisation(np.eye(3), np.zeros(3), scale, -offset.double().numpy())
    return frame, mesh.transformed(scale, offset), folder.pictures(frame)


def _from_poses(frame: Normalisation, placement: Placement) -> Normalisation:
    """From the space of transforms.json to model space, given that from the world."""
    back = placement.rotation.T
    shift = placement.scale * (placement.offset - frame.offset - back @ placement.translation)
    return Normalisation(back, shift, frame.scale / placement.scale)


def _held_out_folders(root: Path) -> list[Path]:
    relit = root / "relit"
    return sorted(path for path in relit.iterdir() if path.is_dir()) if relit.is_dir() else []


def _read_held_out(
    root: Path,
    frame: Normalisation,
    own: PosedPictures,
    bands: Bands | None,
    lamp: Float64[np.ndarray, " B"] | None,
    notes: list[str],
) -> _HeldOutLight:
    """A folder below relit/, given the object's pictures, bands and lamp."""
    faults = Faults(root)
    entry = read_transforms(root, faults, needs_cubes=False)
    notes += [f"relit/{root.name}/{warning}" for warning in entry.warnings]
    folder = _read_folder(root, entry, faults)
    faults.raise_if_any()
    pictures = folder.pictures(frame)
    if bands is not None and pictures.tone != "linear":
        raise SceneError(
            f"{root / FILE_NAME}: pictures of bands with 'tone_mapping' {pictures.tone}; expected linear light"
        )
    if pictures.tone == "camera" != own.tone:
        raise SceneError(
            f"{root / FILE_NAME}: 'tone_mapping' of its pictures is camera, a response that is learnt from the "
            f"object's pictures, but those are {own.tone}; expected linear, srgb or agx"
        )
    found = _bands_of(folder, pictures)
    if pictures.num_colours != own.num_colours or found not in (None, bands):
        named = "" if found is None else f", wavelengths of {found}"
        expected = f"{own.num_colours} colours" if bands is None else bands
        raise SceneError(
            f"{root}: pictures of {pictures.num_colours} bands{named}; the object has {expected}: give the same"
        )
    if bands is not None:
        own_lamp = folder.lamp(bands)
        lamp = lamp if own_lamp is None else own_lamp
    return _HeldOutLight(root.name, folder.environment(bands, lamp), pictures)
