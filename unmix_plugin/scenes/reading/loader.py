"""From a scene folder to a validated `Scene`.

Each check notes its faults and goes on, so that one reading names them all. Only one frame's values are in memory at a
time. Model space is found last: which box the training views show, and whether the world goes on behind it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64

from unmix_plugin.engine.geometry.camera_paths import meeting_point
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.key_poses import KeyPoses
from unmix_plugin.engine.geometry.space import SceneBox
from unmix_plugin.engine.runs.atomic_files import NOT_PORTABLE, safe_name
from unmix_plugin.errors import SceneError, SpectrumError
from unmix_plugin.scenes.backdrops import BeforeBackdrop, find_before_backdrop
from unmix_plugin.scenes.geometry.bounds import find_bounds
from unmix_plugin.scenes.geometry.matched_points import find_matched_points
from unmix_plugin.scenes.geometry.view_agreement import (
    commonest,
    compare_conventions,
    describe,
    find_world_evidence,
)
from unmix_plugin.scenes.placement import Normalisation
from unmix_plugin.scenes.reading.cubes import (
    check_abundances,
    check_cube_headers,
    check_cube_values,
    read_cube,
    say_clipped,
)
from unmix_plugin.scenes.reading.faults import Faults, resolve_path, sha256_of
from unmix_plugin.scenes.reading.foreign_keys import FILE_NAME
from unmix_plugin.scenes.reading.images import check_colours, check_labels, check_masks
from unmix_plugin.scenes.reading.sensors import check_coverage, group_by_sensor, read_operators
from unmix_plugin.scenes.reading.splits import Split, split_frames
from unmix_plugin.scenes.reading.transforms_json import SceneEntry, Size, at_sizes, read_transforms
from unmix_plugin.scenes.scene import Frame, Scene
from unmix_plugin.settings import SceneOptions
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import illuminant_power
from unmix_plugin.spectral.library.spectra_csv import SpectraTable, read_spectra_csv
from unmix_plugin.spectral.sensor import SceneSensor

_FAR_OFF, _MOST_FAR_OFF = 20.0, 0.1
"""Distance of a camera from the others' middle, in the distance within which most others are, from which on its pose is
taken for wrong; and the largest share of the views that this may hold for."""
_LEAST_PLACES = 10
"""Of cameras; among fewer none is called far off."""
_NOTHING_TO_SEE = (
    "the training views show nothing but a plain backdrop or sky: there is no shape that could be learnt"
)
_MEASURED_KEYS = ("hyperspectral_file_path", "file_path", "mask_path", "responses_path")
"""Files of a frame that a training reads; the others are the truth, for evaluation only."""


def load_scene(root: Path, options: SceneOptions | None = None) -> Scene:
    """Read and check a scene folder.

    Every cube and picture is read once, a frame at a time; the `Scene` reads them again when asked for pixels.

    Args:
        root: Folder that holds transforms.json.
        options: How to read it; None for the defaults.
    Raises:
        SceneError: the folder is not a sound scene; the message lists all that is wrong with it.
    """
    options = SceneOptions() if options is None else options
    faults = Faults(root)
    scale = options.value_scale
    if scale is not None and not 1e-30 <= scale <= 1e30:  # float32 divides by these
        faults.add("--value-scale", f"is {scale:g}; expected a positive number, what stands for 1")
        faults.raise_if_any()
    entry = read_transforms(root, faults)
    if options.value_scale is None:
        options = replace(options, value_scale=entry.value_scale)
    located = _locate_files(root, entry, options, faults)
    truth = _read_truth(root, entry, options, faults)
    names = truth.material_names
    checked = _check_files(entry, located, None if names is None else len(names), options, faults)
    if checked is not None:
        entry = at_sizes(entry, checked.sizes, faults)
    split = split_frames(entry, options.eval_split, options.eval_interval, faults)
    train, warnings = split.train, ()
    if checked is not None and split.train and entry.wavelengths_nm is not None:
        train, warnings = _without_far_off(entry, located, split.train)
        used, noted = {checked.sensor_indices[index] for index in train}, faults.noted
        check_coverage(checked.sensors, used, entry.wavelengths_nm, faults)
        if warnings and faults.noted > noted:
            faults.add(FILE_NAME, warnings[0])
    if options.world == "unbounded" and checked is not None and checked.foreground is not None:
        faults.add(
            "world",
            "is unbounded, but pictures have alpha, and behind what is transparent there is nothing; expected bounded "
            "or auto, or pictures without alpha",
        )
    faults.raise_if_any()
    assert checked is not None
    warnings = (*entry.warnings, *checked.warnings, *warnings)
    if entry.fwhm_nm is not None and (unknown := int(np.isnan(entry.fwhm_nm).sum())):
        said = f"'fwhm' has 0 or null for {unknown} of {len(entry.fwhm_nm)} bands: the widths of all count as unknown"
        entry, warnings = replace(entry, fwhm_nm=None), (*warnings, said)
    return _assemble(root, entry, located, checked, truth, Split(train, split.evaluation), warnings, options)


@dataclass(frozen=True)
class _Truth:
    """What a scene says of its materials and light; None where it says nothing."""

    material_names: tuple[str, ...] | None
    illuminant: Float64[np.ndarray, " B"] | None
    endmembers: Float64[np.ndarray, "K B"] | None
    light_paths: tuple[Path, ...]
    material_paths: tuple[Path, ...]


def _read_truth(root: Path, entry: SceneEntry, options: SceneOptions, faults: Faults) -> _Truth:
    names, illuminant, endmembers = entry.materials, None, None
    paths: dict[str, tuple[Path, ...]] = {}
    for key, text in (("illuminant_path", entry.illuminant_path), ("endmembers_path", entry.endmembers_path)):
        if text is None:
            continue
        path = resolve_path(root, text, options.allow_outside_paths, f"'{key}'", faults)
        if path is None or entry.wavelengths_nm is None:
            continue
        paths[key] = (path,)
        if key == "illuminant_path":
            illuminant = _read_illuminant(path, entry.wavelengths_nm, f"'{key}'", faults)
        else:
            table = read_endmembers(path, entry.wavelengths_nm, names, f"'{key}'", faults)
            names, endmembers = (names, None) if table is None else (table.names, table.spectra)
    return _Truth(
        names, illuminant, endmembers, paths.get("illuminant_path", ()), paths.get("endmembers_path", ())
    )


def _assemble(
    root: Path,
    entry: SceneEntry,
    located: tuple[dict[str, Path], ...],
    checked: _CheckedFiles,
    truth: _Truth,
    split: Split,
    warnings: tuple[str, ...],
    options: SceneOptions,
) -> Scene:
    assert entry.wavelengths_nm is not None
    space = _find_model_space(root, entry, checked, split.train, options)
    normalisation, scene_box, is_unbounded, before, world_reason = space
    if before is not None and not before.shows_matter:
        before, warnings = None, (*warnings, _NOTHING_TO_SEE)
    inputs = [path for paths in located for key, path in paths.items() if key in _MEASURED_KEYS]
    inputs += [root / FILE_NAME, *truth.light_paths]
    truths = [path for paths in located for key, path in paths.items() if key not in _MEASURED_KEYS]
    truths += truth.material_paths
    hashes = checked.cube_hashes
    evaluated = [located[index] for index in split.evaluation]
    return Scene(
        root=root,
        wavelengths_nm=entry.wavelengths_nm,
        fwhm_nm=entry.fwhm_nm,
        sensors=checked.sensors,
        frames=_name_frames(entry, located, checked.sensor_indices),
        cameras=make_cameras(entry, checked.sizes, normalisation),
        train_indices=split.train,
        eval_indices=split.evaluation,
        scene_box=scene_box,
        normalisation=normalisation.after(entry.placement),
        placement=entry.placement,
        metres_per_unit=entry.metres_per_unit,
        material_names=truth.material_names,
        illuminant=truth.illuminant,
        endmembers=truth.endmembers,
        has_alpha=checked.foreground is not None,
        is_unbounded=is_unbounded,
        before_backdrop=before,
        world_reason=world_reason,
        warnings=warnings,
        has_labels=all("seg_file_path" in paths for paths in evaluated),
        has_abundances=all("abundance_file_path" in paths for paths in evaluated),
        input_hashes={_relative(path, root): hashes.get(path) or sha256_of(path) for path in inputs},
        truth_hashes={_relative(path, root): sha256_of(path) for path in truths},
        options=options,
    )


def readable_name(name: str) -> str:
    """A name that shows what it is: no character that a terminal obeys, none that a table takes for a formula's.

    >>> readable_name("@SUM(A1)"), readable_name("leaf\\u202e_1")
    ('_SUM(A1)', 'leaf__1')
    """
    shown = safe_name(name, NOT_PORTABLE, "view")
    return f"_{shown[1:]}" if shown[:1] in ("=", "+", "-", "@") else shown


def distinct_names(files: Sequence[str]) -> list[str]:
    """The shortest names of views that differ and that files can have on every system.

    Args:
        files: Path of a file of each, with slashes: its stem, its folder before it, its whole path, or a number.
    """
    paths = [PurePosixPath(file).with_suffix("") for file in files]
    candidates = (
        [path.name for path in paths],
        [f"{path.parent.name}_{path.name}" for path in paths],
        ["_".join(part for part in path.parts if part not in ("..", "/")) for path in paths],
    )
    for candidate in candidates:
        names = [readable_name(name) for name in candidate]
        if len({name.casefold() for name in names}) == len(names):
            return names
    return [readable_name(f"{index}_{path.name}") for index, path in enumerate(paths)]


def _name_frames(
    entry: SceneEntry, located: tuple[dict[str, Path], ...], sensors: tuple[int, ...]
) -> tuple[Frame, ...]:
    names = distinct_names([frame.paths["hyperspectral_file_path"] for frame in entry.frames])
    return tuple(
        Frame(
            name=name,
            cube_path=files["hyperspectral_file_path"],
            image_path=files.get("file_path"),
            label_path=files.get("seg_file_path"),
            mask_path=files.get("mask_path"),
            abundance_path=files.get("abundance_file_path"),
            sensor=sensor,
        )
        for name, files, sensor in zip(names, located, sensors, strict=True)
    )


def _relative(path: Path, root: Path) -> str:
    return path.relative_to(root).as_posix() if path.is_relative_to(root) else str(path)


@dataclass(frozen=True)
class _CheckedFiles:
    """What the checks found on their way through the files."""

    sizes: list[Size]
    """Of each frame's images."""
    sensors: tuple[SceneSensor, ...]
    sensor_indices: tuple[int, ...]
    """Which sensor took each frame."""
    foreground: tuple[Bool[np.ndarray, "_ _"], ...] | None
    """For each frame the pixels that may show something: not fully transparent, or not to be trusted. None where the
    scene has no alpha."""
    unknown: tuple[Bool[np.ndarray, "_ _"] | None, ...]
    """For each frame the pixels that are not valid or masked out; None without."""
    cube_hashes: dict[Path, str]
    """SHA-256 of each cube, in the order of the frames."""
    warnings: tuple[str, ...]


def _locate_files(
    root: Path, entry: SceneEntry, options: SceneOptions, faults: Faults
) -> tuple[dict[str, Path], ...]:
    """The files of each frame by the key that names them; a file that two frames share as their cube is a fault."""
    located: list[dict[str, Path]] = []
    owner: dict[Path, str] = {}
    for frame in entry.frames:
        paths: dict[str, Path] = {}
        for key, text in frame.paths.items():
            least_parts = 1 if key in ("file_path", "hyperspectral_file_path") else 2
            path = resolve_path(root, text, options.allow_outside_paths, frame.where, faults, least_parts)
            if path is not None:
                paths[key] = path
        cube = paths.get("hyperspectral_file_path")
        if cube is not None:
            first = owner.setdefault(cube.resolve(), frame.where)
            if first != frame.where:
                text = frame.paths["hyperspectral_file_path"]
                faults.add(frame.where, f"is a duplicate: its cube {text!r} is that of {first} too; drop one")
        located.append(paths)
    return tuple(located)


def _check_files(
    entry: SceneEntry,
    located: tuple[dict[str, Path], ...],
    num_materials: int | None,
    options: SceneOptions,
    faults: Faults,
) -> _CheckedFiles | None:
    """Read and check all files of all frames; None with noted faults if no cube is sound."""
    entries = [
        (frame.where, frame.sensor, paths.get("responses_path"))
        for frame, paths in zip(entry.frames, located, strict=True)
    ]
    operators = read_operators(entries, entry.wavelengths_nm, faults)
    sizes, headers = check_cube_headers(entry, located, operators, faults)
    values = check_cube_values(entry, located, headers, options.value_scale, options.invalid_pixels, faults)
    seen = check_colours(entry, located, sizes, faults)
    masks = check_masks(entry, located, sizes, faults)
    check_labels(entry, located, sizes, num_materials, faults)
    for frame, paths, size in zip(entry.frames, located, sizes, strict=True):
        if "abundance_file_path" in paths:
            where = frame.name_of("abundance_file_path")
            check_abundances(paths["abundance_file_path"], size, num_materials, where, faults)
    cubes = [cube for cube in values if cube is not None]
    known_sizes = [size for size in sizes if size is not None]
    known_operators = [operator for operator in operators if operator is not None]
    if len(cubes) != len(values) or len(known_operators) != len(operators) or not cubes:
        return None
    where = [frame.name_of("hyperspectral_file_path") for frame in entry.frames]
    unknown = tuple(
        cube.invalid if mask is None else ~mask if cube.invalid is None else cube.invalid | ~mask
        for cube, mask in zip(cubes, masks, strict=True)
    )
    for name, missing, mask, cube in zip(where, unknown, masks, cubes, strict=True):
        is_told = cube.num_invalid_pixels == cube.num_pixels or (mask is not None and not mask.any())
        if missing is not None and missing.all() and not is_told:
            faults.add(
                name, "the mask leaves only pixels with NaN, infinite or negative values; drop the frame"
            )
    foreground = None
    if seen is not None:
        foreground = tuple(
            (np.ones(size, bool) if shown is None else shown) | (False if missing is None else missing)
            for shown, missing, size in zip(seen, unknown, known_sizes, strict=True)
        )
    paths = [paths["hyperspectral_file_path"] for paths in located]
    sensors, indices = group_by_sensor(entries, known_operators, known_sizes, faults)
    hashes = {path: cube.sha256 for path, cube in zip(paths, cubes, strict=True)}
    clipped = say_clipped(list(zip(where, cubes, strict=True)), options.value_scale)
    return _CheckedFiles(known_sizes, sensors, indices, foreground, unknown, hashes, clipped)


def _read_illuminant(
    path: Path, wavelengths_nm: Float64[np.ndarray, " B"], where: str, faults: Faults
) -> Float64[np.ndarray, " B"] | None:
    """Relative power of the light, greatest value 1; None and a noted fault if it cannot be had at these bands."""
    try:
        return illuminant_power(path, Bands(wavelengths_nm))
    except SpectrumError as error:
        faults.add(where, str(error))
        return None


def read_endmembers(
    path: Path,
    wavelengths_nm: Float64[np.ndarray, " B"],
    materials: tuple[str, ...] | None,
    where: str,
    faults: Faults,
) -> SpectraTable | None:
    """True endmembers in the order of `materials`, matched by name; None and a noted fault if they do not fit."""
    try:
        table = read_spectra_csv(path).resampled(Bands(wavelengths_nm))
    except SpectrumError as error:
        faults.add(where, str(error))
        return None
    if materials is None:
        return table
    if sorted(materials) != sorted(table.names):
        faults.add(where, f"{path} names {list(table.names)}; expected the 'materials' {list(materials)}")
        return None
    order = [table.names.index(name) for name in materials]
    return SpectraTable(table.bands, materials, table.spectra[order])


def make_cameras(entry: SceneEntry, sizes: list[Size], normalisation: Normalisation) -> Cameras:
    """Cameras of all frames.

    Args:
        entry: Without faults.
        sizes: Height and width of each frame's image.
        normalisation: From the space of transforms.json to that of the cameras.
    """
    lenses = [frame.intrinsics for frame in entry.frames if frame.intrinsics is not None]
    assert len(lenses) == len(entry.frames)
    centers = [
        [0.5 * side if at is None else at for at, side in zip(lens.center_px, size[::-1], strict=True)]
        for lens, size in zip(lenses, sizes, strict=True)
    ]
    count = max(len(lens.coefficients) for lens in lenses)  # 6 where any has higher radial terms, or 4
    distortion = [(*lens.distortion, *lens.higher_radial)[:count] for lens in lenses]
    focal_px = [
        lens.focal_at(width, height, frame.line_poses is not None)
        for lens, (height, width), frame in zip(lenses, sizes, entry.frames, strict=True)
    ]
    return Cameras.of_sizes(
        camera_to_world=_model_poses(_world_poses(entry), normalisation),
        focal_px=torch.tensor(focal_px, dtype=torch.float32),
        center_px=torch.tensor(centers, dtype=torch.float32),
        distortion=torch.tensor(distortion, dtype=torch.float32),
        sizes=[(width, height) for height, width in sizes],
        key_poses=_key_poses(entry, normalisation),
    )


def _world_poses(entry: SceneEntry) -> Float64[np.ndarray, "N 3 4"]:
    """One pose a frame, as transforms.json has it."""
    poses = [frame.pose for frame in entry.frames if frame.pose is not None]
    assert len(poses) == len(entry.frames)
    return np.stack(poses)


def _model_poses(
    poses: Float64[np.ndarray, "n 3 4"], normalisation: Normalisation
) -> Float[torch.Tensor, "n 3 4"]:
    rotations = normalisation.rotation @ poses[:, :, :3]
    positions = normalisation.to_model(poses[:, :, 3])
    return torch.from_numpy(np.concatenate([rotations, positions[:, :, None]], axis=-1)).float()


def _key_poses(entry: SceneEntry, normalisation: Normalisation) -> KeyPoses | None:
    """Poses by height in the image, where a frame is of a line camera; row r is taken at r + 0.5."""
    if all(frame.line_poses is None for frame in entry.frames):
        return None
    parts = []
    for frame, pose in zip(entry.frames, _world_poses(entry), strict=True):
        lines = frame.line_poses
        rows, poses = (np.zeros(1), pose[None]) if lines is None else (lines.rows, lines.poses)
        heights = torch.from_numpy(rows + 0.5).float()
        parts.append(KeyPoses(_model_poses(poses, normalisation), heights, (len(rows),)))
    return KeyPoses.join(parts)


def _without_far_off(
    entry: SceneEntry, located: tuple[dict[str, Path], ...], train: tuple[int, ...]
) -> tuple[tuple[int, ...], tuple[str, ...]]:
    """Training views without those whose cameras are so far off that only a wrong pose explains it, and what to say."""
    if any(frame.pose is None for frame in entry.frames):
        return train, ()
    positions = _world_poses(entry)[list(train), :, 3]
    shots = [entry.frames[view].shot or place.tobytes() for view, place in zip(train, positions, strict=True)]
    places = np.stack(list(dict(zip(shots, positions, strict=True)).values()))  # a rig's lenses share one
    if len(places) < _LEAST_PLACES:
        return train, ()
    middle = np.median(places, axis=0)
    usual = float(np.quantile(np.linalg.norm(places - middle, axis=1), 1 - _MOST_FAR_OFF, method="lower"))
    distances = np.linalg.norm(positions - middle, axis=1)
    is_off = (distances > _FAR_OFF * usual) & (usual > 0)
    if not is_off.any():
        return train, ()
    names = ", ".join(located[train[row]]["hyperspectral_file_path"].name for row in np.flatnonzero(is_off))
    said = (
        f"left out of training: {names}, {distances.max() / usual:.0f} times as far from the middle of the cameras as "
        "nearly all others: its pose must be wrong"
    )
    return tuple(view for view, off in zip(train, is_off, strict=True) if not off), (said,)


def _find_model_space(
    root: Path, entry: SceneEntry, checked: _CheckedFiles, train: tuple[int, ...], options: SceneOptions
) -> tuple[Normalisation, SceneBox, bool, BeforeBackdrop | None, str | None]:
    """The box that the training views show, how its longest edge becomes [-1, 1], whether the world goes on, what may
    stand before a backdrop, if views without alpha share one, and why the world is taken to end, where that was found.

    The similarity starts from the space of transforms.json. The box is found in a space centred on the training
    cameras, where coordinates are of order 1. Raises SceneError: alpha and poses contradict.
    """
    cubes = list(checked.cube_hashes)
    positions = _world_poses(entry)[list(train), :, 3]
    middle = positions.mean(axis=0)
    radius = float(np.linalg.norm(positions - middle, axis=-1).max())
    first = Normalisation(np.eye(3), -middle, 1.0 / radius if radius > 0.0 else 1.0)
    cameras = make_cameras(entry, checked.sizes, first)[list(train)]
    foreground = None if checked.foreground is None else [checked.foreground[index] for index in train]
    alike = commonest([checked.sensor_indices[index] for index in train])

    def read_view(view: int, part: tuple[slice, ...]) -> Float32[np.ndarray, "H W B"]:
        return read_cube(cubes[train[alike[view]]], options.value_scale, options.invalid_pixels, part)

    def read_valid(view: int) -> Bool[np.ndarray, "H W"]:
        index = train[alike[view]]
        missing = checked.unknown[index]
        return np.ones(checked.sizes[index], dtype=bool) if missing is None else ~missing

    before = first_box = points = None
    if foreground is None and options.world == "auto" and len(alike) == len(train):
        sizes, unknown = [cameras.size(row) for row in alike], [checked.unknown[index] for index in train]
        before = find_before_backdrop(sizes, read_view, unknown)
    if before is not None and before.shows_matter:
        try:
            first_box = find_bounds(root, cameras, before.masks())
        except SceneError:  # poses contradict it
            before = None
    has_masks = first_box is not None or foreground is not None
    if not has_masks and meeting_point(cameras.camera_to_world.double().numpy()) is None:
        points = find_matched_points(cameras[alike], read_view, read_valid)
        points = None if points is None else replace(points, pairs=torch.tensor(alike)[points.pairs])
    try:
        first_box = first_box or find_bounds(root, cameras, foreground, points)
    except SceneError as error:
        alike_poses = _world_poses(entry)[[train[row] for row in alike]]
        hint = describe(compare_conventions(alike_poses, cameras[alike], read_view))
        raise SceneError(f"{error}\n{hint}" if hint else str(error)) from error
    is_unbounded, reason = options.world == "unbounded", None
    if options.world == "auto" and not has_masks and not (points and points.are_equally_far):
        evidence = find_world_evidence(first_box, cameras[alike], read_view)
        if not evidence.goes_on:
            places = points or find_matched_points(cameras[alike], read_view, read_valid)
            evidence = evidence if places is None else evidence.with_places(first_box, places.places)
        is_unbounded, reason = evidence.goes_on, evidence.in_words()
    low, high = first_box.aabb.double().numpy()
    scale = float(2.0 / (high - low).max())
    half = 0.5 * scale * (high - low)
    translation = first.translation - 0.5 * (low + high) / first.scale
    box = SceneBox(torch.from_numpy(np.stack([-half, half])).float())
    return Normalisation(first.rotation, translation, first.scale * scale), box, is_unbounded, before, reason
