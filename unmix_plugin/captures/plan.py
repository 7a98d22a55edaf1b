"""Everything that is decided before the first view is written."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32

from unmix_plugin import __version__
from unmix_plugin.captures.calibration.exposures import ExposedFiles, compare_exposures, exposure_of
from unmix_plugin.captures.calibration.sensor import (
    BRIGHT_PERCENTILE,
    Sensor,
    may_be_reflectance,
    prepare_sensor,
    sampled_rows,
)
from unmix_plugin.captures.camera_tags import radiometric_model
from unmix_plugin.captures.cube import Capture, CaptureView, Cube
from unmix_plugin.captures.options import MaskKind, ProcessOptions, plain_options
from unmix_plugin.captures.poses.pose_set import PosedCamera, reading
from unmix_plugin.captures.report import Code, Kind, Remark, sentences
from unmix_plugin.captures.writing.view_files import BackgroundRule, ViewRecipe, alpha_picture
from unmix_plugin.engine.sampling import evenly_spaced
from unmix_plugin.errors import CaptureError, ConfigError, name_some
from unmix_plugin.scenes.backdrops import Backdrop, judge_backdrop
from unmix_plugin.scenes.reading.faults import sha256_of
from unmix_plugin.spectral.bands import Bands

_LOOKED_AT, _ROWS_LOOKED_AT = 12, 96
"""Views that a backdrop is looked for in, and rows of each."""
_WHITE_PERCENTILE = 99.0
"""Of sampled pixels; shown as white in pictures."""
_DEVIATIONS = 6.0
"""Standard deviations of the background's noise between its level and the threshold."""
_LEAST_DISTANCE = 0.02
"""Between level and threshold, as a share of the brightest pixels; JPEG and shading vary a background by about this."""
_LEAST_WHITE, _MOST_BLACK = 0.5, 0.2
"""Level of a white or black background, as a share of the brightest pixels."""
_BORDER_SHARE = 0.02
"""Width of the border that a background is judged by, as a share of the view's."""
_MOST_BORDER_PIXELS = 20000
_BRIGHTEST_PERCENTILE = 99.0
_MOST_ABOVE_ONE = 0.01
"""Share of reflectances above 1 that is still taken for highlights."""
_LEAST_BRIGHT = 0.05
"""Bright values below this would lose digits if they were kept."""
_LEAST_END = 0.9
"""Of what is written as 1: saturated values below are too far off. Columns and bands differ in their ends a little."""
_MOST_BELOW, _LEAST_LEVEL, _PILED_UP = 0.02, 0.005, 0.84
"""Share of a band's values below 0, and their mean over what is bright and over their root mean square, above which a
level was taken off: of noise around black the last is 0.8, of a level 1."""


@dataclass(frozen=True)
class Plan:
    """How every view is written, and why."""

    capture: Capture
    views: tuple[CaptureView, ...]
    sensors: dict[str, Sensor]
    recipes: dict[str, ViewRecipe]
    """By sensor."""
    scale: float
    mask: MaskKind
    decisions: dict[str, Any]
    """With their evidence, as JSON-able values."""
    notes: tuple[str, ...]
    """What a user should know, one sentence each."""
    warnings: tuple[str, ...] = ()
    """What may make values, wavelengths or geometry wrong, one sentence each."""
    option_files: tuple[Path, ...] = ()
    """What options name: dark frame, white reference, tables of its reflectance and of wavelengths."""
    left_out: Mapping[str, Remark] = field(default_factory=dict)
    """Views that nothing was decided from, as they are spoilt, and why."""

    def fingerprint(self, options: ProcessOptions) -> dict[str, Any]:
        """What must be the same for views to be gone on with: options, decisions and input files."""
        own = ["output_dir", "overwrite", "poses", "marker_size", "marker_family", "known_distance", "angles"]
        asked = {key: value for key, value in plain_options(options).items() if key not in own}
        files = [path for view in self.views for path in input_files(view)] + list(self.option_files)
        stamps = []  # path, size and time of change, which tell quickly whether a file is still the same
        for file in _files_of(files):
            with reading(file):
                facts = file.stat()
            stamps.append([os.fspath(file.absolute()), facts.st_size, facts.st_mtime_ns])
        # What transforms.json states may change while its poses, which views don't depend on, are mended.
        stated = [view.cube.linear for view in self.views if view.cube.linear is not None]
        return {
            "version": __version__,
            "options": asked,
            "decisions": self.decisions,
            "bands": {name: sensor.centers_nm.tolist() for name, sensor in self.sensors.items()},
            "gains": sorted({repr((one.gains.tolist(), one.offsets.tolist())) for one in stated}),
            "files": stamps,
        }


def make_plan(
    capture: Capture,
    views: Sequence[CaptureView],
    options: ProcessOptions,
    references: tuple[Cube | None, Cube | None],
    cameras: Mapping[str, PosedCamera] | None = None,
) -> Plan:
    """Look at some rows of every view and decide.

    Args:
        views: Those of the capture that become frames.
        references: Dark frame and white reference that the user names.
        cameras: By view, if they are known.
    Raises:
        CaptureError: views don't fit each other or the references, or a file can't be read.
        ConfigError: an option does not fit the files.
    """
    from unmix_plugin.spectral.colour.conversion import describe_colour, rgb_matrix

    by_sensor: dict[str, list[CaptureView]] = defaultdict(list)
    for view in views:
        by_sensor[view.sensor].append(view)
    sensors: dict[str, Sensor] = {}
    for name, same in by_sensor.items():
        # Views of several sizes are several sensors, and one may show the panel of all.
        every = [v for v in capture.views if v.sensor == name or not (name and v.release)]
        sensors[name] = prepare_sensor(same, options, references, every, cameras)
    sensors = _with_one_exposure(sensors, {name: same[0].cube for name, same in by_sensor.items()})
    left_out = {name: remark for sensor in sensors.values() for name, remark in sensor.left_out.items()}
    sound = {name: [view for view in same if view.name not in left_out] for name, same in by_sensor.items()}
    scale, why = _choose_scale(list(sensors.values()), options.scale)
    mask, said_of_mask = _choose_mask(views, options.mask)
    samples = {name: sensor.sample / np.float32(scale) for name, sensor in sensors.items()}
    backdrops: dict[str, Backdrop | None] = {}
    if mask == "auto":
        backdrops = {n: _find_backdrop(s, sound[n], scale, samples[n]) for n, s in sensors.items()}
        if not all(backdrops.values()):  # frames with alpha and without don't go together
            backdrops, mask = {}, "none"
    recipes: dict[str, ViewRecipe] = {}
    evidence: dict[str, dict[str, Any]] = {}
    for name, sensor in sensors.items():
        raster = sensor.calibration.raster
        to_rgb = rgb_matrix(Bands(sensor.centers_nm)).numpy()
        shown = (samples[name] @ to_rgb).max(axis=1)
        white = float(np.percentile(shown, _WHITE_PERCENTILE)) if len(shown) else 0.0
        to_rgb = to_rgb / np.float32(white) if white > 0 else to_rgb
        rule: BackgroundRule | Backdrop | None = backdrops.get(name)
        if mask in ("white", "black"):
            rule = _background_rule(mask, _border_pixels(sensor, sound[name], scale), samples[name])
        recipes[name] = ViewRecipe(sensor.calibration, scale, to_rgb, rule, mask == "files")
        evidence[name or "all views"] = {
            "unit": sensor.unit,
            "bands": len(sensor.centers_nm),
            "size": [raster.height, raster.width],
            "colours": describe_colour(Bands(sensor.centers_nm)),
            **sensor.evidence,
            "background": None if rule is None else rule.evidence,
        }
    decisions = {"scale": {"calibrated": scale, "evidence": why}, "mask": mask, "sensors": evidence}
    remarks = [remark for sensor in sensors.values() for remark in sensor.remarks]
    said = [*sentences(remarks, Kind.DONE), *said_of_mask]
    if found := [backdrop for backdrop in backdrops.values() if backdrop is not None]:
        said.append(
            f"a backdrop was found that all views share, {', '.join(each.in_words for each in found)}, and is cut out: "
            "look at contact-sheet.png; --mask none keeps it"
        )
    said += _notes_on_pictures([view.cube for view in views])
    said += dict.fromkeys(note for view in views for note in view.cube.notes)
    opened = [file for file in references if file is not None]
    texts = (options.wavelengths or "", options.white_reflectance)  # numbers, or the name of a table
    tables = filter(os.path.isfile, texts)
    warned = sentences(remarks, Kind.WRONG)
    warned += _doubts_of_values([*sensors.values()], 1.0 if options.scale is not None else scale)
    warned += sentences(_doubts_of_meaning(options, mask, views, [*sensors.values()]), Kind.WRONG)
    end = min(sensor.saturated_from for sensor in sensors.values())
    if end < _LEAST_END * scale:
        warned.append(
            f"values are saturated from {end:.3g} on, and are written as 1, which is read as at least {scale:g}: "
            f"expose less, or make that true with --scale {end:.3g}, which cuts off all above"
        )
    each = [(view.name, file) for view in views for file in (view.cube, *view.references)]
    each += [(file.path.name, file) for file in opened]
    return Plan(
        capture,
        tuple(views),
        sensors,
        recipes,
        scale,
        mask,
        decisions,
        (*capture.notes, *said),
        (*capture.warnings, *warned, *_warnings_of_files(each)),
        (*(path for file in opened for path in file.files), *map(Path, tables)),
        left_out,
    )


def _with_one_exposure(sensors: dict[str, Sensor], first: dict[str, Cube]) -> dict[str, Sensor]:
    """The sensors with those brought to one exposure that have no white reference: lenses of a rig, which are exposed
    each for its own band, or views of one camera in several sizes. The first one says what was done, or was not.

    Args:
        first: File of the first view of each.
    """
    bare = {name: one.calibration.exposure for name, one in sensors.items() if "white" not in one.evidence}
    known = {name: exposure for name, exposure in bare.items() if exposure is not None}
    rest = [name for name in bare if name not in known]
    files = [
        first[name]
        for name in known or rest
        if radiometric_model(first[name]) is None
        # What is wrong with those of one sensor was said of it.
        and (exposure_of(first[name]) is not None or first[name].exposure.time is None)
    ]
    if len(bare) < 2 or not files:
        return sensors
    is_bent, is_finished = (
        any(file.is_srgb for file in files),
        any(may_be_reflectance([file]) for file in files),
    )
    compared = compare_exposures(ExposedFiles(files, is_srgb=is_bent, may_be_reflectance=is_finished))
    common = compared.common
    remarks = [one for one in compared.remarks if one.code.looks_wrong or known or common is None]
    if known and rest:
        remarks.append(Remark.of(Code.EXPOSURE_OF_SOME_SENSORS, lacking=rest, known=[*known]))
    brought, first_name = dict(sensors), next(iter(bare))
    for name, exposure in known.items() if common is not None else ():
        sensor, factor = sensors[name], (common / exposure).astype(np.float32)
        calibration = replace(sensor.calibration, exposure=common)
        brought[name] = replace(sensor, calibration=calibration, sample=sensor.sample * factor)
    one = brought[first_name]
    brought[first_name] = replace(one, remarks=(*one.remarks, *remarks))
    return brought


def _doubts_of_meaning(
    options: ProcessOptions, mask: MaskKind, views: Sequence[CaptureView], sensors: Sequence[Sensor]
) -> Iterator[Remark]:
    """A mask that was looked for and not found, and sensors whose values are of different kinds."""
    if options.mask == "auto" and mask == "none" and not any(view.release for view in views):
        yield Remark.of(Code.NO_MASK_FOUND)
    kinds = {(one.is_absolute, one.is_stated): one.unit for one in sensors}
    if len(kinds) > 1 and not any(view.cube.is_srgb for view in views):
        yield Remark.of(Code.UNLIKE_MEANINGS, kinds=[*kinds.values()])


def _doubts_of_values(sensors: Sequence[Sensor], found_scale: float) -> Iterator[str]:
    """What may be wrong with the references, by the values that come of them, one sentence each."""
    if found_scale != 1.0 and all(sensor.is_stated for sensor in sensors):
        units = ", ".join(dict.fromkeys(sensor.unit for sensor in sensors))
        why = f"more than {_MOST_ABOVE_ONE:.0%} are above 1"
        why = why if found_scale > 1 else f"nearly all are below {_LEAST_BRIGHT:g}"
        if any("white" in sensor.evidence for sensor in sensors):
            why += " (was the white exposed and lit as the views were?)"
        yield (
            f"values ({units}) were divided by {found_scale:g}, as {why}: outputs of reflectance undo it, and "
            f"exported radiance times {found_scale:g} is what was measured; --scale 1 keeps values, and cuts off those "
            "above 1"
        )
    if any(_is_below_black(sensor.sample) for sensor in sensors):
        yield (
            "values lie below 0 by more than noise, and are written as 0: the dark frame is brighter than that of "
            "these views, or was taken off their numbers before"
        )


def _is_below_black(sample: Float32[np.ndarray, "N c"]) -> bool:
    """Whether values pile up below 0 in half of the bands that have many there."""
    below = np.clip(-sample.astype(np.float64), 0.0, None)
    count, total = (below > 0).sum(axis=0), below.sum(axis=0)
    judged = count > max(100, _MOST_BELOW * len(sample))
    bright = np.percentile(sample, BRIGHT_PERCENTILE, axis=0)[judged]
    count, total, below = count[judged], total[judged], below[:, judged]
    piled = total > _PILED_UP * np.sqrt(count * (below**2).sum(axis=0))
    return bool(judged.any()) and bool(np.mean(piled & (total > _LEAST_LEVEL * bright * count)) >= 0.5)


def _choose_scale(sensors: Sequence[Sensor], given: float | None) -> tuple[float, str]:
    """The scale and why.

    Reflectances, and values of files that say what stands for 1, are kept unless many are above 1 or all are small;
    others are divided by a high percentile. Raises CaptureError: nothing in the sampled pixels is above 0. Raises
    ConfigError: the given scale is not above 0.
    """
    if given is not None:
        if not (np.isfinite(given) and given > 0):
            raise ConfigError(f"--scale {given:g}: expected a number above 0, what is written as 1")
        return given, "given with --scale"
    values = np.concatenate([sensor.usual_sample.ravel() for sensor in sensors])
    bright = float(np.percentile(values, BRIGHT_PERCENTILE)) if len(values) else 0.0
    if not bright > 0:
        raise CaptureError(
            f"{BRIGHT_PERCENTILE:g} % of the calibrated values are not above 0 (up to {values.max(initial=0):g}); "
            "check the dark frame: is it as bright as the views?"
        )
    above = float((values > 1.0).mean())
    if all(sensor.is_absolute for sensor in sensors) and above <= _MOST_ABOVE_ONE and bright >= _LEAST_BRIGHT:
        return 1.0, f"values are kept ({sensors[0].unit}); {above:.2%} of the sampled ones are above 1"
    scale = float(f"{bright:.4g}")
    return scale, f"the {BRIGHT_PERCENTILE:g}th percentile of the sampled values"


# Matter and background: from files of the capture, from a background that is white or black, or from a backdrop that
# nobody has named. The border of the views tells how bright a background is and how much it varies; a threshold
# between it and the rest follows from that.


def _choose_mask(views: Sequence[CaptureView], asked: MaskKind) -> tuple[MaskKind, list[str]]:
    """What tells matter from background, `auto` where files don't, and what a user should know of it; the views of a
    rig are left whole. CaptureError where opacity is asked of files that some views don't have."""
    if asked not in ("auto", "files"):
        return asked, []
    missing = [
        view.name
        for view in views
        if not (view.alpha or alpha_picture(view) or (view.mask is not None and asked == "files"))
    ]
    if not missing:
        return "files", []
    if asked == "files":
        raise CaptureError(
            f"--mask files: view {missing[0]} has no mask; expected an alpha channel, or a mask that is white where "
            "matter is, for every view"
        )
    # What the lenses of a rig see from above is ground: a field or water is as plain as a backdrop and is the scene.
    otherwise: MaskKind = "none" if any(view.release for view in views) else "auto"
    if len(missing) == len(views):
        return otherwise, []
    has = "has" if len(missing) == 1 else "have"
    note = (
        f"{len(missing)} of {len(views)} views {has} no alpha channel ({name_some(missing)}), so that of the others is "
        "not used: give all views one, or choose --mask"
    )
    return otherwise, [note]


def _background_rule(
    kind: Literal["white", "black"], border: Float32[np.ndarray, "M c"], sample: Float32[np.ndarray, "N c"]
) -> BackgroundRule:
    """The rule that fits the border of the views, beside a sample of all their pixels. CaptureError where most of the
    border is not of this kind."""
    brightness = BackgroundRule.brightness(kind, border)
    everywhere = np.concatenate([BackgroundRule.brightness(kind, sample), brightness])
    brightest = float(np.percentile(np.clip(everywhere, 0.0, 1.0), _BRIGHTEST_PERCENTILE))
    level = float(np.median(brightness))
    deviation = 1.4826 * float(np.median(np.abs(brightness - level)))
    distance = max(_DEVIATIONS * deviation, _LEAST_DISTANCE * brightest)
    share = level / brightest if brightest > 0 else 0.0
    if (kind == "white" and share < _LEAST_WHITE) or (kind == "black" and share > _MOST_BLACK):
        expected = f"more than {_LEAST_WHITE:.0%}" if kind == "white" else f"less than {_MOST_BLACK:.0%}"
        raise CaptureError(
            f"--mask {kind}: the border of the views is at {share:.0%} of the brightest pixels; expected {expected}, "
            "as the background should reach to the border: choose another --mask"
        )
    threshold = level - distance if kind == "white" else level + distance
    return BackgroundRule(kind, threshold, level, deviation)


def _border_pixels(sensor: Sensor, views: Sequence[CaptureView], scale: float) -> Float32[np.ndarray, "M c"]:
    """Pixels at the border of the views, in [0, 1]; saturated ones are 1, missing ones are left out."""
    raster = sensor.calibration.raster
    width = max(1, round(_BORDER_SHARE * raster.width))
    columns = np.r_[0:width, raster.width - width : raster.width]
    rows = sorted({0, raster.height - 1, *sampled_rows(raster.height)})
    step = max(1, len(views) * (2 * raster.width + 2 * width * len(rows)) // _MOST_BORDER_PIXELS)
    border = []
    for view in views:
        for row in rows:
            part = sensor.calibration.rows(view.cube, row, row + 1)
            shown = np.arange(raster.width) if row in (0, raster.height - 1) else columns
            shown = shown[row % step :: step]
            values = np.where(part.saturated[0, shown], np.float32(scale), part.values[0, shown])
            border.append(values[~part.missing[0, shown]])
    return np.clip(np.concatenate(border) / np.float32(scale), 0.0, 1.0)


def _find_backdrop(
    sensor: Sensor, views: Sequence[CaptureView], scale: float, sample: Float32[np.ndarray, "N B"]
) -> Backdrop | None:
    """The backdrop of a sensor's views, judged by some rows of some of them; the sample is of all, divided by scale."""
    raster = sensor.calibration.raster
    rows = np.unique(np.linspace(0, raster.height - 1, min(raster.height, _ROWS_LOOKED_AT)).astype(int))

    def look(index: int) -> tuple[np.ndarray, np.ndarray]:
        parts = [sensor.calibration.rows(views[index].cube, row, row + 1) for row in rows.tolist()]
        values = np.concatenate([np.where(x.saturated, np.float32(scale), x.values) for x in parts])
        seen = np.clip(values / np.float32(scale), 0.0, 1.0)
        return seen, ~np.concatenate([part.missing for part in parts])

    return judge_backdrop(map(look, evenly_spaced(len(views), _LOOKED_AT)), sample)


def input_files(view: CaptureView) -> list[Path]:
    """Every file that a view is made of."""
    more = [path for path in (view.picture, view.mask, view.labels) if path is not None]
    return [*view.cube.files, *more, *(path for file in view.references for path in file.files)]


def hashes(paths: Iterable[Path]) -> list[dict[str, Any]]:
    """Path, size and SHA-256 of each file. CaptureError where one can't be read."""
    found = []
    for file in _files_of(paths):
        with reading(file):
            found.append({"path": os.fspath(file), "bytes": file.stat().st_size, "sha256": sha256_of(file)})
    return found


def _files_of(paths: Iterable[Path]) -> Iterator[Path]:
    """Files, and those of a folder that a reader takes as one."""
    for path in paths:
        yield from sorted(child for child in path.iterdir() if child.is_file()) if path.is_dir() else [path]


def _warnings_of_files(files: Sequence[tuple[str, Cube | None]]) -> list[str]:
    """What files warn of; one sentence where several warn of the same."""
    found = [
        Remark.of(Code.FILE_WARNING, [name], text=text)
        for name, file in files
        if file
        for text in file.warnings
    ]
    return sentences(found, Kind.WRONG)


def _notes_on_pictures(files: Sequence[Cube]) -> list[str]:
    """Notes on encoding, order of colours and orientation, one sentence each; none where there is no picture."""
    pictures = [file for file in files if file.reader == "picture"]
    notes = []
    if any(file.is_srgb for file in pictures):
        notes.append("pictures are taken as sRGB and brought to linear light")
    for centres in (file.bands.wavelengths_nm for file in pictures):
        if centres is not None and len(centres) == 3 and centres[0] < centres[2]:
            red, green, blue = (f"{centre:g}" for centre in centres)
            notes.append(
                f"the channels of pictures are red, green and blue in this order: {red} nm is taken for red, "
                f"{green} nm for green, {blue} nm for blue. If this is wrong, give --wavelengths {blue},{green},{red}"
            )
            break
    turned = sum(file.orientation != 1 for file in files)
    if turned:
        notes.append(
            f"EXIF's orientation of {turned} of {len(files)} pictures is ignored, as poses and lenses refer to the "
            "stored pixels; if yours were made from turned pictures, store these turned"
        )
    return notes
