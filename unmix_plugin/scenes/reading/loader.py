"""From a scene folder to a validated `Scene`.

Each check notes its faults and goes on, so that one reading names them all. Model space is found last.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Float64

from unmix_plugin.engine.runs.atomic_files import NOT_PORTABLE, safe_name
from unmix_plugin.errors import SpectrumError
from unmix_plugin.formats.files import hash_of
from unmix_plugin.scenes.folder import CUBE_KEY
from unmix_plugin.scenes.kept import judged_once
from unmix_plugin.scenes.messages import Message
from unmix_plugin.scenes.reading.checks import CheckedFiles, check_frames
from unmix_plugin.scenes.reading.entries import SceneEntry, at_sizes, locate_files, read_entries
from unmix_plugin.scenes.reading.faults import FILE_NAME, Faults, resolve_path
from unmix_plugin.scenes.reading.model_space import ModelSpace, find_model_space, without_far_off
from unmix_plugin.scenes.reading.splits import Split, split_frames
from unmix_plugin.scenes.scene import Frame, Scene
from unmix_plugin.settings import SceneOptions
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import illuminant_power
from unmix_plugin.spectral.library.spectra_csv import SpectraTable, read_spectra

_MEASURED_KEYS = (CUBE_KEY, "file_path", "mask_path", "responses_path")
"""Files of a frame that a training reads; the others are the truth, for evaluation only."""


def load_scene(root: Path, options: SceneOptions | None = None) -> Scene:
    """Read and check a scene folder.

    Every cube and picture is read a frame at a time; the `Scene` reads them again when asked for pixels.

    Args:
        root: Folder that holds transforms.json.
        options: How to read it; None for the defaults.
    Raises:
        SceneError: the folder is not a sound scene; the message lists all that is wrong with it.
    """
    options, faults = options or SceneOptions(), Faults(root)
    entry = read_entries(root, faults)
    if options.value_scale is None:
        options = replace(options, value_scale=entry.keys.value_scale)
    entry = locate_files(root, entry, options.allow_outside_paths, faults)
    truth = _read_truth(root, entry, options, faults)
    num_materials = None if truth.material_names is None else len(truth.material_names)
    checked = check_frames(entry.frames, entry.wavelengths_nm, num_materials, options, faults)
    if checked is not None:
        entry = at_sizes(entry, checked.sizes, faults)
    split = split_frames(entry, options.eval_split, options.eval_interval, faults)
    if checked is not None and split.train and entry.wavelengths_nm is not None:
        train, far_off = without_far_off(entry, split.train)
        used = {checked.frames[index].sensor for index in train}
        is_seen = np.any([checked.sensors[index].seen_bands for index in sorted(used)], axis=0)
        if not is_seen.all():
            unseen = ", ".join(f"{nm:g}" for nm in entry.wavelengths_nm[~is_seen])
            faults.note("'wavelengths'", Message.UNSEEN_BANDS, bands=unseen)
            if far_off is not None:
                faults.add(FILE_NAME, far_off)
        split = replace(split, train=train)
        entry = replace(entry, warnings=(*entry.warnings, *checked.warnings, *([far_off] if far_off else [])))
    if options.world == "unbounded" and checked is not None and checked.has_alpha:
        faults.note("world", Message.WORLD_WITH_ALPHA)
    faults.raise_if_any()
    assert checked is not None
    return _assemble(root, entry, checked, truth, split, options)


@dataclass(frozen=True)
class _Truth:
    """What a scene says of its materials and light, and in which files; None where it says nothing."""

    material_names: tuple[str, ...] | None
    illuminant: Float64[np.ndarray, " B"] | None = None
    endmembers: Float64[np.ndarray, "K B"] | None = None
    light_path: Path | None = None
    materials_path: Path | None = None


def _read_truth(root: Path, entry: SceneEntry, options: SceneOptions, faults: Faults) -> _Truth:
    def located(key: str) -> Path | None:
        text = getattr(entry.keys, key)
        if text is None:
            return None
        return resolve_path(root, text.replace("\\", "/"), options.allow_outside_paths, f"'{key}'", faults)

    light_path = located("illuminant_path")
    materials_path = located("endmembers_path")
    names, illuminant, endmembers, bands = entry.materials, None, None, entry.wavelengths_nm
    if light_path is not None and bands is not None:
        try:
            illuminant = illuminant_power(light_path, Bands(bands)) / (entry.keys.reflectance_of_1 or 1.0)
        except SpectrumError as error:
            faults.note("'illuminant_path'", Message.WRONG_LIGHT, reason=error)
    if materials_path is not None and bands is not None:
        table = read_endmembers(materials_path, bands, names, faults)
        names, endmembers = (names, None) if table is None else (table.names, table.spectra)
    return _Truth(
        material_names=names,
        illuminant=illuminant,
        endmembers=endmembers,
        light_path=light_path,
        materials_path=materials_path,
    )


def read_endmembers(
    path: Path, wavelengths_nm: Float64[np.ndarray, " B"], materials: tuple[str, ...] | None, faults: Faults
) -> SpectraTable | None:
    """True endmembers in the order of `materials`, matched by name; None and a noted fault if they do not fit."""
    try:
        table = read_spectra(path).resampled(Bands(wavelengths_nm))
    except SpectrumError as error:
        return faults.note("'endmembers_path'", Message.WRONG_ENDMEMBERS, reason=error)
    if materials is None:
        return table
    if sorted(materials) != sorted(table.names):
        values = {"path": path, "found": list(table.names), "expected": list(materials)}
        return faults.note("'endmembers_path'", Message.OTHER_MATERIALS, **values)
    order = [table.names.index(name) for name in materials]
    return SpectraTable(table.bands, materials, table.spectra[order])


def _assemble(
    root: Path, entry: SceneEntry, checked: CheckedFiles, truth: _Truth, split: Split, options: SceneOptions
) -> Scene:
    known = {frame.cube: frame.sha256 for frame in checked.frames}
    files = [(key, path) for frame in entry.frames for key, path in frame.files.items()]
    inputs = [path for key, path in files if key in _MEASURED_KEYS] + [root / FILE_NAME, truth.light_path]
    truths = [path for key, path in files if key not in _MEASURED_KEYS] + [truth.materials_path]

    def hashes(paths: Sequence[Path | None]) -> dict[str, str]:
        found = {
            path.relative_to(root).as_posix() if path.is_relative_to(root) else str(path): path
            for path in paths
            if path is not None
        }
        return {name: known.get(path) or hash_of(path) for name, path in found.items()}

    input_hashes = hashes(inputs)
    space = judged_once(
        ModelSpace,
        {"files": input_hashes, "training views": split.train, "options": options},
        lambda: find_model_space(root, entry, checked, split.train, options),
    )
    before, fwhm_nm, warnings = space.before_backdrop, entry.fwhm_nm, (*entry.warnings, *space.warnings)
    if fwhm_nm is not None and (unknown := int(np.isnan(fwhm_nm).sum())):
        warning = Message.UNKNOWN_WIDTHS.sentence(unknown=unknown, bands=len(fwhm_nm))
        fwhm_nm, warnings = None, (*warnings, warning)
    if before is not None and not before.shows_foreground:
        before, warnings = None, (*warnings, Message.NOTHING_TO_SEE.sentence())
    frames = tuple(
        Frame(
            name=name,
            cube_path=own.cube,
            image_path=frame.files.get("file_path"),
            label_path=frame.files.get("seg_file_path"),
            mask_path=frame.files.get("mask_path"),
            abundance_path=frame.files.get("abundance_file_path"),
            sensor=own.sensor,
        )
        for name, frame, own in zip(
            distinct_names([frame.paths[CUBE_KEY] for frame in entry.frames]),
            entry.frames,
            checked.frames,
            strict=True,
        )
    )
    assert entry.wavelengths_nm is not None
    evaluated = [entry.frames[index].files for index in split.evaluation]
    return Scene(
        root=root,
        wavelengths_nm=entry.wavelengths_nm,
        fwhm_nm=fwhm_nm,
        sensors=checked.sensors,
        frames=frames,
        cameras=entry.cameras(checked.sizes, space.normalisation),
        train_indices=split.train,
        eval_indices=split.evaluation,
        scene_box=space.scene_box,
        normalisation=space.normalisation.after(entry.placement),
        placement=entry.placement,
        metres_per_unit=entry.metres_per_unit,
        material_names=truth.material_names,
        illuminant=truth.illuminant,
        endmembers=truth.endmembers,
        has_alpha=checked.has_alpha,
        is_unbounded=space.is_unbounded,
        before_backdrop=before,
        world_reason=space.world_reason,
        decisions=space.decisions,
        warnings=warnings,
        has_labels=all("seg_file_path" in files for files in evaluated),
        has_abundances=all("abundance_file_path" in files for files in evaluated),
        input_hashes=input_hashes,
        truth_hashes=hashes(truths),
        options=options,
        markers={
            name: entry.placement.to_source(np.array(points))
            for name, points in (entry.keys.markers or {}).items()
        },
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
