"""A validated object, read from its folder: its mesh, the light around it, and posed pictures of it.

The folder has transforms.json and pictures as any scene has, a mesh, an environment map, and perhaps `relit/<light>/`
with the same under lights that training never sees. docs/background/neumatex.md says what its keys mean.

World space is that of the mesh's file, and of the poses before nerfstudio's `applied_transform`; z is up. Model space
has the mesh's bounding box in the middle of [-1, 1]^3, axes as in the world.

Notation: `H x W` pixels, `B` bands, `M` true materials.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np
from jaxtyping import Float64

from unmix_plugin.engine import Decision
from unmix_plugin.errors import SceneError
from unmix_plugin.formats.files import hash_of, write_file
from unmix_plugin.formats.json_values import describe
from unmix_plugin.limits import MOST_TEXT_BYTES, read_bounded
from unmix_plugin.neumatex.fit import checks
from unmix_plugin.neumatex.fit.pictures import PosedPictures, read_picture, read_posed_pictures
from unmix_plugin.neumatex.fit.tone import TONE_MAPPINGS, ToneMapping
from unmix_plugin.neumatex.tracing.environment import Environment, MovingFrame
from unmix_plugin.neumatex.tracing.lamp_and_sky import LampAndSky
from unmix_plugin.neumatex.tracing.light_files import ENVIRONMENT_SUFFIXES, read_environment, read_lamp
from unmix_plugin.neumatex.tracing.mesh import MESH_SUFFIXES, Mesh, read_mesh, turned_to_viewers
from unmix_plugin.neumatex.tracing.rays import RayMesh
from unmix_plugin.scenes.doctor import check_copies
from unmix_plugin.scenes.placement import Placement
from unmix_plugin.scenes.reading.cubes import UnreadableArrayError, map_array
from unmix_plugin.scenes.reading.entries import SceneEntry, read_entries
from unmix_plugin.scenes.reading.faults import FILE_NAME, Faults, resolve_path
from unmix_plugin.scenes.reading.loader import read_endmembers
from unmix_plugin.scenes.reading.splits import Split, split_frames
from unmix_plugin.scenes.scene import Normalisation
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.library.spectra_csv import SpectraTable

_EVAL_INTERVAL = 8
"""Every so many frames one is for evaluation, where transforms.json does not say which."""
_NUM_COLOURS = 3
_SAME_BAND_NM = 0.5
"""Wavelengths in names of files' channels are rounded."""
_CLEARLY_BETTER = 0.01
"""Of the mean overlap of outlines: pixels at their edges make that of equal shapes differ by less."""
_Lamp = Float64[np.ndarray, " B"]


@dataclass(frozen=True)
class HeldOutLight:
    """The object under a light that training never sees."""

    name: str
    environment: Environment
    pictures: PosedPictures
    """All for evaluation."""


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
    metres_per_unit: float | None
    """Of the world; None: unknown."""
    lights: tuple[HeldOutLight, ...]
    bands: Bands | None
    """Of spectral pictures; None for RGB."""
    lamp: Float64[np.ndarray, " B"] | None
    """Relative power of the light of spectral pictures, greatest band 1."""
    true_materials: SpectraTable | None
    """Reflectances of what a spectral object is really made of, where they are known."""
    abundance_files: tuple[Path | None, ...]
    """One a view, where the true materials are known."""
    input_hashes: dict[str, str]
    """SHA-256 of mesh, environment and pictures."""
    notes: tuple[str, ...]
    """What is unusual but usable."""
    decisions: tuple[Decision, ...]
    """What was decided when it was made of a run."""
    estimated: Estimated

    def truth(self, index: int) -> dict[str, np.ndarray]:
        """What is known of a view's materials, float32: `base_colour` (H W 3), linear; or of spectral pictures
        `true_abundances` (H W M) and `true_endmembers` (M B). Raises SceneError: a file is malformed, or has another
        size than the view."""
        if self.bands is None:
            path = self.root / "truth" / "base_colour" / f"{self.pictures.names[index]}.exr"
            if not path.is_file():
                return {}
            found = {"base_colour": read_picture(path).numbers}
            count, what = _NUM_COLOURS, "colours"
        else:
            path = None if self.true_materials is None else self.abundance_files[index]
            if self.true_materials is None or path is None:
                return {}
            try:
                shares = np.array(map_array(path), dtype=np.float32)
            except UnreadableArrayError as error:
                raise SceneError(f"{path} {error}") from error
            count, what = len(self.true_materials.names), "materials"
            endmembers = self.true_materials.spectra.astype(np.float32)
            found = {"true_abundances": shares, "true_endmembers": endmembers}
        shape, (width, height) = next(iter(found.values())).shape, self.pictures.cameras.size(index)
        if shape != (height, width, count):
            raise SceneError(
                f"{path}: has shape {shape}; expected {(height, width, count)}: rows and columns of the view "
                f"{self.pictures.names[index]}, and {count} {what}"
            )
        return found


@dataclass(frozen=True)
class PosedObject:
    """What is known of an object before its light is."""

    root: Path
    mesh: Mesh
    """Model space."""
    frame: Normalisation
    """From world to model space."""
    pictures: PosedPictures
    split: Split
    bands: Bands | None
    """Of spectral pictures; None for RGB."""
    lamp: Float64[np.ndarray, " B"] | None
    """Relative power of the light, greatest band 1; None where it is unknown."""


def load_posed_object(root: Path, mesh: Path | None = None) -> PosedObject:
    """Read and check an object's folder, which need not have a light; a mesh that is given takes the place of its own.
    Errors are those of `load_object`."""
    folder = read_object_folder(root, [], needs_mesh=True, mesh=mesh, environment=root)
    frame, placed, pictures = _placed(folder, [])
    bands = _bands_of(folder, pictures, None)
    return PosedObject(root, placed, frame, pictures, folder.split, bands, folder.lamp(bands))


def load_object(
    root: Path, lamp: str | None = None, mesh: Path | None = None, environment: Path | None = None
) -> ObjectScene:
    """Read and check an object's folder.

    Args:
        mesh, environment: Files in place of the folder's; the latter is neither turned nor scaled.
        lamp: For pictures of many bands: what lit them, as `read_lamp` takes it, instead of what the folder says.
    Raises:
        SceneError: the folder is not a sound object; the message says what is wrong with it.
    """
    root, notes = root.resolve(), list[str]()
    folder = read_object_folder(root, notes, needs_mesh=True, mesh=mesh, environment=environment)
    frame, placed_mesh, pictures = _placed(folder, notes)
    bands = _bands_of(folder, pictures, None)
    if bands is None and lamp is not None:
        raise SceneError(
            f"{root}: a lamp is given, but its pictures have {_NUM_COLOURS} colours; leave it out"
        )
    power = folder.lamp(bands) if bands is None or lamp is None else read_lamp(lamp, bands)
    light = folder.environment(bands, power)
    if environment is None:  # which stands still
        light = replace(light, moves=folder.moving_frame(frame, bands))
    notes += checks.light_doubts(pictures, light)
    hashes = [pictures.hashes[name] for name in pictures.names]
    poses = pictures.cameras.camera_to_world.numpy()
    notes += [found.sentence() for found in check_copies(pictures.names, hashes, poses)]
    relit = root / "relit"
    places = sorted(path for path in relit.iterdir() if path.is_dir()) if relit.is_dir() else []
    held_out = [_read_held_out(place, frame, pictures, bands, power, notes) for place in places]
    if bands is not None and power is None:
        mean = light.mean_radiance().double().numpy()
        if not (mean > 0).all():
            raise SceneError(
                f"{folder.environment_path}: is black at {bands.centers_nm[int(np.argmin(mean))]:g} nm, where nothing "
                "could be told of reflectance; leave such bands out of the pictures"
            )
        power = mean / mean.max()
    true_materials, abundance_files = (None, ()) if bands is None else _read_truth(root, folder.entry, bands)
    files = (folder.mesh_path, folder.environment_path)
    given = {name for name, path in (("mesh", mesh), ("light", environment)) if path is not None}
    decisions = tuple(each for each in read_decisions(root) if each.subject not in given)
    notes += [LIGHT_UNKNOWN for each in decisions if each.subject == "light" and each.is_undecided]
    scene = ObjectScene(
        root=root,
        mesh=placed_mesh,
        environment=light,
        frame=frame,
        pictures=pictures,
        split=folder.split,
        metres_per_unit=folder.entry.metres_per_unit,
        lights=tuple(held_out),
        bands=bands,
        lamp=power,
        true_materials=true_materials,
        abundance_files=abundance_files,
        input_hashes={**{path.name: hash_of(path) for path in files}, **pictures.hashes},
        notes=tuple(notes),
        decisions=decisions,
        estimated=read_estimated(root, *files),
    )
    for view in scene.split.evaluation:  # a malformed truth is told before training, not after it
        scene.truth(view)
    return scene


LIGHT_UNKNOWN = (
    "the pictures do not tell where light comes from: no lamp explains shading and shadows clearly better than an even "
    "sky. Light and reflectance are a guess then: capture some views with a lamp on one side, or a mirrored ball in "
    "the same light, and give --environment"
)
"""What has to be said where the light of an object could not be told."""
DECISIONS_FILE = "decisions.json"
"""In a folder that was made of a run: what was decided about the object."""


def read_decisions(root: Path) -> tuple[Decision, ...]:
    """What was decided about an object when it was made of a run; nothing where it was not."""
    path = root / DECISIONS_FILE
    if not path.is_file():
        return ()
    try:
        return tuple(Decision(**each) for each in json.loads(read_bounded(path, MOST_TEXT_BYTES)))
    except (OSError, ValueError, TypeError) as error:
        raise SceneError(
            f"{path}: is damaged ({error}); make the object again, or remove the file"
        ) from error


@dataclass(frozen=True)
class Estimated:
    """What of an object was not given but told by its pictures, so that a fit may refine it."""

    has_mesh: bool = False
    light: LampAndSky | None = None
    """As which the environment was written."""

    def write(self, root: Path) -> None:
        """Beside mesh.ply and environment.exr, whose content is noted: another one is no estimate."""
        content = {
            "mesh": hash_of(root / "mesh.ply") if self.has_mesh else None,
            "environment": None if self.light is None else hash_of(root / "environment.exr"),
            "light": None if self.light is None else self.light.to_json(),
        }
        write_file(root / _ESTIMATED_FILE, json.dumps(content, indent=1).encode())


_ESTIMATED_FILE = "estimated.json"


def read_estimated(root: Path, mesh: Path, environment: Path) -> Estimated:
    """What `Estimated.write` noted, of these files; nothing where there is none."""
    path = root / _ESTIMATED_FILE
    if not path.is_file():
        return Estimated()
    try:
        content = json.loads(read_bounded(path, MOST_TEXT_BYTES))
        has_mesh = content["mesh"] is not None and content["mesh"] == hash_of(mesh)
        has_light = content["environment"] is not None and content["environment"] == hash_of(environment)
        return Estimated(has_mesh, LampAndSky.from_json(content["light"]) if has_light else None)
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise SceneError(
            f"{path}: is damaged ({error}); make the object again, or remove the file"
        ) from error


@dataclass(frozen=True)
class _Folder:
    """What a folder's transforms.json says."""

    root: Path
    entry: SceneEntry
    split: Split
    mesh_path: Path
    """The folder itself where no mesh is needed."""
    environment_path: Path
    placement: tuple[float, ...]
    """Of the environment: rotation in degrees and exposure in stops."""
    tone: ToneMapping | None

    def pictures(self, frame: Normalisation) -> PosedPictures:
        """Its pictures in model space, given that from the world."""
        return read_posed_pictures(self.root, self.entry, _from_poses(frame, self.entry.placement), self.tone)

    def environment(self, bands: Bands | None, lamp: _Lamp | None) -> Environment:
        """In the bands of spectral pictures, otherwise in colours."""
        return read_environment(self.environment_path, *self.placement, bands=bands, lamp=lamp)

    def moving_frame(self, frame: Normalisation, bands: Bands | None) -> MovingFrame | None:
        """What 'environment_moves' says, in model space; None where the light stands still."""
        keys = self.entry.keys.environment_moves
        if keys is None:
            return None
        if bands is None or not any(keys.axis):
            what = "for pictures in colours; it needs pictures of many bands"
            what = what if bands is None else "with an axis of no length"
            raise SceneError(f"{self.root / FILE_NAME}: 'environment_moves' {what}")
        middle = frame.to_model(np.array([keys.middle]))[0].tolist()
        return MovingFrame.of_numbers((float(keys.kind == "camera"), *middle, *keys.axis))

    def lamp(self, bands: Bands | None) -> Float64[np.ndarray, " B"] | None:
        """What 'illuminant_path' names, for spectral pictures; None where there is none."""
        if bands is None or self.entry.keys.illuminant_path is None:
            return None
        faults = Faults(self.root)
        path = resolve_path(self.root, self.entry.keys.illuminant_path, None, "'illuminant_path'", faults)
        faults.raise_if_any()
        return read_lamp(str(path), bands)


def read_object_folder(
    root: Path,
    notes: list[str],
    needs_mesh: bool,
    mesh: Path | None = None,
    environment: Path | None = None,
) -> _Folder:
    """Read and check the keys of a folder's transforms.json; `notes` gets what is unusual. Files that are given take
    the place of the folder's."""
    faults = Faults(root)
    entry = read_entries(root, faults, needs_cubes=False)
    keys = entry.keys
    split = split_frames(entry, "auto", _EVAL_INTERVAL, faults) if needs_mesh else Split((), ())
    turned = (keys.environment_rotation_deg or 0.0, keys.environment_exposure_stops or 0.0)
    if environment is not None:
        turned = (0.0, 0.0)
    else:
        environment = _find_file(root, keys.environment_path, "environment", ENVIRONMENT_SUFFIXES, faults)
    if not needs_mesh:
        mesh = root
    elif mesh is None:
        mesh = _find_file(root, keys.mesh_path, "mesh", MESH_SUFFIXES, faults)
    tone = keys.tone_mapping
    if tone is not None and tone not in TONE_MAPPINGS:
        known = ", ".join(TONE_MAPPINGS)
        faults.add(FILE_NAME, f"'tone_mapping' is {describe(tone)}; expected one of {known}")
    faults.raise_if_any()
    assert environment is not None
    assert mesh is not None
    notes += entry.warnings
    tone = cast("ToneMapping | None", tone)
    return _Folder(root, entry, split, mesh, environment, turned, tone)


def _find_file(
    root: Path, named: str | None, what: str, suffixes: tuple[str, ...], faults: Faults
) -> Path | None:
    """The file that a key names, or the only one of its kind; None and a noted fault if there is none."""
    key = f"{what}_path"
    if named is not None:
        return resolve_path(root, named, None, f"'{key}'", faults)
    found = sorted(path for path in root.iterdir() if path.suffix.lower() in suffixes and path.is_file())
    usual = [path for path in found if path.stem == what]
    chosen = usual if len(found) > 1 and usual else found
    if len(chosen) == 1:
        return chosen[0]
    if chosen:
        listed = ", ".join(path.name for path in chosen)
        faults.add(str(root), f"has several: {listed}; name one with '{key}' in {FILE_NAME}")
    else:
        names = " or ".join(f"{what}{suffix}" for suffix in suffixes)
        faults.add(str(root), f"has no {what}; put {names} there")
    return None


def _bands_of(folder: _Folder, pictures: PosedPictures, usual: Bands | None) -> Bands | None:
    """Of spectral pictures, as 'wavelengths' and their files say, or else the usual ones; None for colours."""
    listed, in_files, count = folder.entry.wavelengths_nm, pictures.wavelengths_nm, pictures.num_colours
    own, where = None if in_files is None else Bands.of(in_files), folder.root / FILE_NAME
    bands = usual if own is None else own
    if listed is not None:
        bands = Bands(listed)
        if own and (len(own) != len(listed) or np.abs(listed - own.centers_nm).max() > _SAME_BAND_NM):
            raise SceneError(
                f"{where}: 'wavelengths' of {bands}, but the files of the pictures say {own}; give the same, in nm"
            )
    if bands is None and count == _NUM_COLOURS:
        return None
    if bands is None or len(bands) != count:
        given = "no 'wavelengths'" if bands is None else f"{len(bands)} 'wavelengths'"
        raise SceneError(
            f"{where}: {given} for pictures of {count} bands; list the centre of each band in nm"
        )
    if pictures.tone != "linear":
        raise SceneError(
            f"{where}: pictures of {count} bands with 'tone_mapping' {pictures.tone}; expected linear light"
        )
    return bands


def _read_truth(
    root: Path, entry: SceneEntry, bands: Bands
) -> tuple[SpectraTable | None, tuple[Path | None, ...]]:
    """What 'endmembers_path' and each frame's 'abundance_file_path' name; None without endmembers."""
    if entry.keys.endmembers_path is None:
        return None, ()
    faults, key, table = Faults(root), "'endmembers_path'", None
    path = resolve_path(root, entry.keys.endmembers_path, None, key, faults)
    if path is not None:
        table = read_endmembers(path, bands.centers_nm, entry.materials, faults)
    named = [(frame.paths.get("abundance_file_path"), frame.where) for frame in entry.frames]
    files = tuple(
        None if file is None else resolve_path(root, file, None, where, faults) for file, where in named
    )
    faults.raise_if_any()
    return table, files


def _placed(folder: _Folder, notes: list[str]) -> tuple[Normalisation, Mesh, PosedPictures]:
    """The mesh and the pictures in model space; a mesh that fits clearly better with its y axis upwards is turned."""
    given, name = read_mesh(folder.mesh_path, notes), folder.mesh_path.name
    frame, mesh, pictures = _in_model_space(given, folder)
    read = (pictures.read(index) for index in range(len(pictures)))
    alphas = [picture.alpha if picture.has_alpha else None for picture in read]
    scale, offset = given.to_model_space()
    turned = given.with_y_upwards()
    overlaps, upright = (
        checks.outline_overlaps(RayMesh(one.transformed(scale, offset)), pictures.cameras, alphas)
        for one in (given, turned)
    )
    has_outlines = any(alpha is not None for alpha in alphas)
    is_better = has_outlines and upright.mean() > overlaps.mean() + _CLEARLY_BETTER
    if (is_better or checks.is_misplaced(overlaps)) and not checks.is_misplaced(upright):
        notes.append(f"{name} has y as its upward axis, the poses have z: the mesh was turned")
        overlaps = upright
        frame, mesh, pictures = _in_model_space(turned, folder)
    if checks.is_misplaced(overlaps):
        raise SceneError(checks.misplacement(overlaps, pictures.cameras, frame, name))
    if has_outlines:
        notes += checks.outline_doubts(overlaps, name)
    else:
        notes.append(
            f"the pictures have no alpha: whether {name} lies as they show the object, and which of its axes is "
            "upwards, could not be checked"
        )
    mesh, count = turned_to_viewers(mesh, checks.sides_seen(RayMesh(mesh), pictures.cameras))
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


def _read_held_out(
    root: Path,
    frame: Normalisation,
    own: PosedPictures,
    bands: Bands | None,
    lamp: _Lamp | None,
    notes: list[str],
) -> HeldOutLight:
    """A folder below relit/, given the object's pictures, bands and lamp."""
    remarks = list[str]()
    folder = read_object_folder(root, remarks, needs_mesh=False)
    notes += [f"relit/{root.name}/{warning}" for warning in remarks]
    pictures = folder.pictures(frame)
    if pictures.tone == "camera" != own.tone:
        raise SceneError(
            f"{root / FILE_NAME}: 'tone_mapping' of its pictures is camera, a response that is learnt from the "
            f"object's pictures, but those are {own.tone}; expected linear, srgb or agx"
        )
    fits = pictures.num_colours == own.num_colours
    found = _bands_of(folder, pictures, bands) if fits else f"{pictures.num_colours} bands"
    if found != bands:
        expected = f"{_NUM_COLOURS} colours" if bands is None else bands
        raise SceneError(f"{root}: pictures of {found}; the object has {expected}: give the same")
    own_lamp = folder.lamp(bands)
    if folder.entry.keys.environment_moves is not None:
        raise SceneError(f"{root / FILE_NAME}: 'environment_moves'; lights of relit/ stand still")
    return HeldOutLight(
        root.name, folder.environment(bands, lamp if own_lamp is None else own_lamp), pictures
    )
