"""Everything that is decided before the first view is written: samples are taken, and decisions from them.

Notation: `N` sampled pixels, `c` bands of the scene.
"""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64

from unmix_plugin.captures.calibration.bands import (
    BandChoice,
    stated_bands,
    without_bad,
    without_unlit,
    without_unmeasured,
)
from unmix_plugin.captures.calibration.calibration import (
    Calibration,
    Raster,
    WhiteSample,
    border_pixels,
    bright_values,
    count_stored,
    draw_pixels,
    find_unnamed_no_data,
    rows_behind,
)
from unmix_plugin.captures.calibration.references import GivenReferences, find_references
from unmix_plugin.captures.camera_tags import radiometric_model
from unmix_plugin.captures.cube import Capture, CaptureView, Cube
from unmix_plugin.captures.decide import (
    LEAST_BRIGHT,
    MOST_ABOVE_ONE,
    ComparedExposures,
    ExposedFiles,
    Saturation,
    Scale,
    ValueMeaning,
    background_rule,
    choose_mask,
    choose_scale,
    compare_exposures,
    find_meaning,
    find_saturation,
    is_below_black,
    may_be_reflectance,
    saturated_bands,
    usual_pixels,
)
from unmix_plugin.captures.options import MaskKind, ProcessOptions
from unmix_plugin.captures.poses.pose_set import PosedCamera
from unmix_plugin.captures.report import Code, Remark
from unmix_plugin.captures.spoilt import judge_values
from unmix_plugin.captures.writing.view_files import BackgroundRule, ViewRecipe, alpha_picture
from unmix_plugin.engine.sampling import evenly_spaced
from unmix_plugin.errors import CaptureError
from unmix_plugin.scenes.backdrops import Backdrop, judge_backdrop
from unmix_plugin.spectral.bands import Bands

_BACKDROP_VIEWS = 12
"""Views that a backdrop is looked for in."""
_WHITE_PERCENTILE = 99.0
"""Of sampled pixels; shown as white in pictures."""
_LEAST_END = 0.9
"""Of what is written as 1: saturated values below are too far off. Columns and bands differ in their ends a little."""
_MOST_ABOVE_GIVEN, _LEAST_OF_GIVEN = 0.5, 0.01
"""Share of sampled values above a given scale, and their greatest over it, beyond which the scale must be wrong."""
_FEW_PERCENTILE = 5.0
"""Of saturated values: nearly the darkest."""


@dataclass(frozen=True)
class SensorPlan:
    """How all views of one lens or camera are calibrated, and why."""

    calibration: Calibration
    bands: BandChoice
    saturation: Saturation
    meaning: ValueMeaning
    sample: Float32[np.ndarray, "N c"]
    """Calibrated pixels of all views, on the bands of the scene."""
    is_usual: Bool[np.ndarray, " N"] | None = None
    """Sampled pixels of views that are not far brighter than most; None if all are."""
    saturated_from: float = np.inf
    """Calibrated value of nearly the darkest of sampled numbers that are saturated."""
    lamp: Float64[np.ndarray, " c"] | None = None
    """Light on the white panel as the detector sees it, greatest value 1."""
    irradiance: Mapping[str, float] = field(default_factory=dict)
    """What sunshine sensors measured, by view; not used."""
    remarks: tuple[Remark, ...] = ()
    left_out: Mapping[str, Remark] = field(default_factory=dict)
    """Views that nothing was decided from, as they are spoilt, and why."""

    @property
    def usual_sample(self) -> Float32[np.ndarray, "M c"]:
        """The sample without views that are far brighter than most."""
        return self.sample if self.is_usual is None else self.sample[self.is_usual]

    @property
    def centers_nm(self) -> Float64[np.ndarray, " c"]:
        """Bands of the scene."""
        return self.bands.centers_nm(self.calibration.bin_bands)

    @property
    def references_used(self) -> dict[str, dict[str, str]]:
        """Files of `dark` and `white`, where there are such, and how they are used, for people."""
        references = self.calibration.references
        used: dict[str, dict[str, str]] = {}
        first = next(iter(references.by_view.values()), references.common)
        for name in ("dark", "white"):
            of_view, of_all = getattr(first, name), getattr(references.common, name)
            if references.by_view and of_view is not None:
                used[name] = {"file": "each view's own", "use": f"each view's own; {of_view.how}"}
            elif of_all is not None:
                used[name] = {"file": str(of_all.file.path), "use": of_all.how}
        return used


@dataclass(frozen=True)
class Plan:
    """How every view is written, and why."""

    capture: Capture
    views: tuple[CaptureView, ...]
    sensors: dict[str, SensorPlan]
    recipes: dict[str, ViewRecipe]
    """By sensor."""
    scale: Scale
    mask: MaskKind
    remarks: tuple[Remark, ...]
    """What a user should know."""
    option_files: tuple[Path, ...] = ()
    """What options name: dark frame, white reference, tables of its reflectance and of wavelengths."""
    left_out: Mapping[str, Remark] = field(default_factory=dict)
    """Views that nothing was decided from, as they are spoilt, and why."""

    @property
    def backdrops_in_words(self) -> str:
        """The backdrops that were found, those of all sensors; empty without any."""
        found = [recipe.background for recipe in self.recipes.values()]
        return ", ".join(each.in_words for each in found if isinstance(each, Backdrop))

    @property
    def numbers(self) -> dict[str, Any]:
        """What views are written by, with its sources, as JSON-able values: for programs, and to tell whether an
        interrupted start can go on. What was decided, and why, is in the table of decisions."""
        from unmix_plugin.spectral.colour.conversion import describe_colour

        each = {}
        for name, sensor in self.sensors.items():
            raster, rule = sensor.calibration.raster, self.recipes[name].background
            nm = sensor.bands.wavelengths_nm
            each[name or "all views"] = {
                "unit": sensor.meaning.description,
                "bands": len(sensor.centers_nm),
                "size": [raster.height, raster.width],
                "colours": describe_colour(Bands(sensor.centers_nm)),
                "saturation": {"stored": sensor.saturation.stored, "evidence": sensor.saturation.reason},
                **sensor.references_used,
                "wavelengths": sensor.bands.source,
                "dropped_bands": [
                    {"band": index, "wavelength_nm": float(nm[index]), "reason": band.reason}
                    for index, band in sorted(sensor.bands.dropped.items())
                ],
                **({"irradiance": dict(sensor.irradiance)} if sensor.irradiance else {}),
                "background": None if rule is None else rule.evidence,
            }
        scale = {"calibrated": self.scale.value, "evidence": self.scale.reason}
        return {"scale": scale, "mask": self.mask, "sensors": each}


def make_plan(
    capture: Capture,
    views: Sequence[CaptureView],
    options: ProcessOptions,
    given: GivenReferences,
    cameras: Mapping[str, PosedCamera] | None = None,
) -> Plan:
    """Look at some rows of every view and decide.

    Args:
        views: Those of the capture that become frames.
        given: References that the user names.
        cameras: By view, if they are known.
    Raises:
        CaptureError: views don't fit each other or the references, or a file can't be read.
        ConfigError: an option does not fit the files.
    """
    from unmix_plugin.spectral.colour.conversion import rgb_matrix

    by_sensor: dict[str, list[CaptureView]] = defaultdict(list)
    for view in views:
        by_sensor[view.sensor].append(view)
    sensors: dict[str, SensorPlan] = {}
    for name, same in by_sensor.items():
        # Views of several sizes are several sensors, and one may show the panel of all.
        every = [v for v in capture.views if v.sensor == name or not (name and v.shot)]
        sensors[name] = plan_sensor(same, options, given, all_views=every, cameras=cameras)
    sensors = with_one_exposure(sensors, {name: same[0].cube for name, same in by_sensor.items()})
    left_out = {name: remark for sensor in sensors.values() for name, remark in sensor.left_out.items()}

    scale = choose_scale(
        [sensor.meaning for sensor in sensors.values()],
        np.concatenate([sensor.usual_sample.ravel() for sensor in sensors.values()]),
        options.scale,
    )
    sound = {name: [view for view in same if view.name not in left_out] for name, same in by_sensor.items()}
    mask, backgrounds, on_mask = _decide_mask(options.mask, views, sensors, sound, scale.value)
    recipes = {}
    for name, sensor in sensors.items():
        # To linear red, green and blue, in which bright pixels of the sample are white.
        to_rgb = rgb_matrix(Bands(sensor.centers_nm)).numpy()
        shown = ((sensor.sample / np.float32(scale.value)) @ to_rgb).max(axis=1)
        white = float(np.percentile(shown, _WHITE_PERCENTILE)) if len(shown) else 0.0
        to_rgb = to_rgb / np.float32(white) if white > 0 else to_rgb
        recipes[name] = ViewRecipe(
            sensor.calibration, scale.value, to_rgb, backgrounds[name], use_opacity=mask == "files"
        )

    of_files = [(view.name, file) for view in views for file in (view.cube, *view.references)]
    of_files += [(file.path.name, file) for file in given.files]
    of_files = [(name, remark) for name, file in of_files for remark in file.remarks]
    texts = (options.wavelengths or "", options.white_reflectance)  # numbers, or the name of a table
    return Plan(
        capture=capture,
        views=tuple(views),
        sensors=sensors,
        recipes=recipes,
        scale=scale,
        mask=mask,
        remarks=(
            *(Remark.of(Code.NOTE, text=text) for text in capture.notes),
            *(Remark.of(Code.CAPTURE_WARNING, text=text) for text in capture.warnings),
            *_remarks_on_values(sensors, scale, [view.cube for view in views], on_mask),
            *(one for view in views for one in view.cube.remarks if not one.code.looks_wrong),
            *(replace(one, where=(name,)) for name, one in of_files if one.code.looks_wrong),
        ),
        option_files=(
            *(path for file in given.files for path in file.files),
            *map(Path, filter(os.path.isfile, texts)),
        ),
        left_out=left_out,
    )


def _decide_mask(
    asked: MaskKind,
    views: Sequence[CaptureView],
    sensors: Mapping[str, SensorPlan],
    sound: Mapping[str, Sequence[CaptureView]],
    scale: float,
) -> tuple[MaskKind, dict[str, BackgroundRule | Backdrop | None], list[Remark]]:
    """What tells foreground from background, the background of each sensor's views where values tell it (a colour that
    is asked for, or a backdrop), and what a user should know of that.

    Args:
        sound: Views of each sensor that are not spoilt.
    """
    is_rig = any(view.shot for view in views)
    without = []
    if asked in ("auto", "files"):
        # Files of a view tell its foreground: an alpha channel, or its mask where that is asked for.
        without = [
            view.name
            for view in views
            if not (view.alpha or alpha_picture(view) or (asked == "files" and view.mask is not None))
        ]
    mask, remarks = choose_mask(asked, [view.name for view in views], without, is_rig)
    backgrounds: dict[str, BackgroundRule | Backdrop | None] = dict.fromkeys(sensors)
    for name, sensor in sensors.items():
        calibration, sample = sensor.calibration, sensor.sample / np.float32(scale)
        if mask in ("white", "black"):
            backgrounds[name] = background_rule(mask, border_pixels(sound[name], calibration, scale), sample)
        elif mask == "auto":
            some = [sound[name][index] for index in evenly_spaced(len(sound[name]), _BACKDROP_VIEWS)]
            rows = (rows_behind(view, calibration, scale) for view in some)
            backgrounds[name] = judge_backdrop(rows, sample)
    if mask == "auto" and None in backgrounds.values():  # frames with alpha and without don't go together
        backgrounds, mask = dict.fromkeys(sensors), "none"
    if mask == "auto":
        found = [each.in_words for each in backgrounds.values() if isinstance(each, Backdrop)]
        remarks.append(Remark.of(Code.BACKDROP_FOUND, backdrops=", ".join(found)))
    if asked == "auto" and mask == "none" and not is_rig:
        remarks.append(Remark.of(Code.NO_MASK_FOUND))
    return mask, backgrounds, remarks


def plan_sensor(
    views: Sequence[CaptureView],
    options: ProcessOptions,
    given: GivenReferences,
    all_views: Sequence[CaptureView],
    cameras: Mapping[str, PosedCamera] | None = None,
) -> SensorPlan:
    """Look at some rows of every view and decide how they are calibrated.

    Args:
        views: At least one; all have the same bands and size.
        given: References that the user names.
        all_views: With those that have no pose: one may show a panel.
        cameras: By view, if they are known.
    Raises:
        CaptureError: references don't fit, wavelengths are unknown, no band is left, or a file can't be read.
        ConfigError: an option does not fit the files.
    """
    files = [view.cube for view in views]
    first, binning = files[0], options.bin_bands
    model = radiometric_model(first)
    bands = stated_bands(files, options)
    references = find_references(views, bands.wavelengths_nm, options, given=given, all_views=all_views)
    if options.saturation is not None:
        saturation = Saturation(options.saturation, "given with --saturation")
    elif model is not None:
        saturation = Saturation(model.saturated, f"known of {model.maker}")
    else:
        saturation = find_saturation(count_stored(files, bands.kept))
    bands, remarks = without_unmeasured(bands, references)
    for white in references.whites:
        bands, found = without_unlit(bands, white, saturated_bands(WhiteSample.of(white), saturation.stored))
        remarks += found
    bands.require(binning, str(first.path))
    compared = ComparedExposures()
    if model is None:  # a maker's calibration accounts for exposures already
        exposed = ExposedFiles(
            files,
            [white.file for white in references.whites],
            references.darks_beside(files),
            is_srgb=first.is_srgb,
            may_be_reflectance=may_be_reflectance(first, bright_values(files, bands.kept)),
        )
        compared = compare_exposures(exposed)

    calibration = Calibration(
        Raster.of(first.shape[0], first.shape[1], options.crop, options.bin_pixels),
        bands.kept,
        references=references,
        saturation=saturation.stored,
        exposure=compared.common,
    )
    drawn = draw_pixels(views, calibration)
    spoilt = judge_values(drawn, cameras)
    left_out = {name: remark for name, remark in spoilt.items() if name not in options.keep_view}
    drawn = [view for view in drawn if view.name not in left_out]
    if not any(len(view.values) for view in drawn):
        raise CaptureError(
            f"{first.path}: no sampled pixel of it and of the other views has a measurement in all bands (NaN, "
            "no-data, or no light on the white panel); check these, or leave bands out with --drop-bands"
        )
    values, saturated = (
        np.concatenate([getattr(view, name) for view in drawn]) for name in ("values", "saturated")
    )

    bands, found = without_bad(bands, values, saturated, options.max_noise)
    bands = bands.without_incomplete_bins(binning)
    bands.require(binning, str(first.path))
    if (number := find_unnamed_no_data(files, bands.kept)) is not None:
        remarks.append(Remark.of(Code.NO_DATA_UNNAMED, number=f"{number:g}"))
    still_kept = np.isin(calibration.bands, bands.kept)
    at_end = values[:, still_kept][saturated[:, still_kept]]
    lamp = None
    if references.whites:
        white = references.whites[0]
        lamp = (white.signal / white.reflectance)[bands.kept].astype(np.float32)
        lamp = lamp.reshape(-1, binning).mean(axis=1).astype(np.float64)
        lamp = np.clip(lamp, 0.0, None) / lamp.max()
    models = {view.name: radiometric_model(view.cube) for view in views}
    irradiance = {name: one.irradiance for name, one in models.items() if one and one.irradiance is not None}
    return SensorPlan(
        calibration=replace(calibration, bands=bands.kept, bin_bands=binning),
        bands=bands,
        saturation=saturation,
        meaning=find_meaning(files, bool(references.whites)),
        sample=values[:, still_kept].reshape(len(values), -1, binning).mean(axis=2),
        is_usual=usual_pixels(drawn, still_kept),
        saturated_from=float(np.percentile(at_end, _FEW_PERCENTILE)) if len(at_end) else np.inf,
        lamp=lamp,
        irradiance=irradiance,
        remarks=(*remarks, *compared.remarks, *found),
        left_out=left_out,
    )


def with_one_exposure(sensors: dict[str, SensorPlan], first: dict[str, Cube]) -> dict[str, SensorPlan]:
    """The sensors with those brought to one exposure that have no white reference: lenses of a rig, which are exposed
    each for its own band, or views of one camera in several sizes. The first one says what was done, or was not.

    Args:
        first: File of the first view of each.
    """
    bare = {
        name: sensor.calibration.exposure
        for name, sensor in sensors.items()
        if not sensor.calibration.references.whites
    }
    if len(bare) < 2:
        return sensors
    known = {name: exposure for name, exposure in bare.items() if exposure is not None}
    rest = [name for name in bare if name not in known]
    files = {
        name: first[name]
        for name in known or rest
        if radiometric_model(first[name]) is None
        # What is wrong with those of one sensor was said of it.
        and (first[name].total_exposure() is not None or first[name].exposure.time is None)
    }
    if not files:
        return sensors
    exposed = ExposedFiles(
        [*files.values()],
        is_srgb=any(file.is_srgb for file in files.values()),
        may_be_reflectance=any(
            may_be_reflectance(file, bright_values([file], sensors[name].bands.kept))
            for name, file in files.items()
        ),
    )
    compared = compare_exposures(exposed)
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


def _remarks_on_values(
    sensors: Mapping[str, SensorPlan], scale: Scale, files: Sequence[Cube], on_mask: Sequence[Remark]
) -> list[Remark]:
    """What a user should know of the values of all sensors: what was remarked of each, a 1 that means something and is
    lost, references that don't fit, sensors of different kinds, saturated values that are written as more than they may
    be; and of pictures their encoding, order of colours and orientation."""
    meanings = [sensor.meaning for sensor in sensors.values()]
    remarks = [remark for sensor in sensors.values() for remark in sensor.remarks]
    if not scale.is_given and scale.value != 1.0 and all(one.states_one for one in meanings):
        has_white = any(sensor.calibration.references.whites for sensor in sensors.values())
        facts = {
            "units": ", ".join(dict.fromkeys(one.description for one in meanings)),
            "scale": f"{scale.value:g}",
            "limit": f"{MOST_ABOVE_ONE:.0%}" if scale.value > 1 else f"{LEAST_BRIGHT:g}",
            "hint": " (was the white exposed and lit as the views were?)" if has_white else "",
        }
        remarks.append(Remark(Code.ONE_LOST_ABOVE if scale.value > 1 else Code.ONE_LOST_BELOW, facts))
    greatest = max(float(sensor.sample.max(initial=0.0)) for sensor in sensors.values())
    above = max(float((sensor.sample > scale.value).mean()) for sensor in sensors.values())
    if scale.is_given and (above > _MOST_ABOVE_GIVEN or greatest < _LEAST_OF_GIVEN * scale.value):
        facts = {"scale": f"{scale.value:g}", "greatest": f"{greatest:g}"}
        low = Remark.of(Code.GIVEN_SCALE_LOW, share=f"{above:.0%}", **facts)
        high = Remark.of(Code.GIVEN_SCALE_HIGH, limit=f"{_LEAST_OF_GIVEN:g}", **facts)
        remarks.append(low if above > _MOST_ABOVE_GIVEN else high)
    named_already = any(remark.code is Code.NO_DATA_UNNAMED for remark in remarks)
    if not named_already and any(is_below_black(sensor.sample) for sensor in sensors.values()):
        remarks.append(Remark.of(Code.BELOW_BLACK))
    remarks += on_mask
    kinds = {(meaning.has_one, meaning.states_one): meaning.description for meaning in meanings}
    if len(kinds) > 1 and not any(file.is_srgb for file in files):
        remarks.append(Remark.of(Code.UNLIKE_MEANINGS, kinds=[*kinds.values()]))
    end = min(sensor.saturated_from for sensor in sensors.values())
    if end < _LEAST_END * scale.value:
        facts = {"end": f"{end:.3g}", "scale": f"{scale.value:g}"}
        remarks.append(Remark(Code.SATURATED_BELOW_ONE, facts))

    pictures = [file for file in files if file.reader == "picture"]
    if any(file.is_srgb for file in pictures):
        remarks.append(Remark.of(Code.PICTURES_ARE_SRGB))
    centres = (file.bands.wavelengths_nm for file in pictures)
    red_last = (one for one in centres if one is not None and len(one) == 3 and one[0] < one[2])
    if (found := next(red_last, None)) is not None:
        colours = {name: f"{nm:g}" for name, nm in zip(("red", "green", "blue"), found, strict=True)}
        remarks.append(Remark(Code.COLOURS_IN_ORDER, colours))
    if turned := sum(file.orientation != 1 for file in files):
        remarks.append(Remark.of(Code.ORIENTATION_IGNORED, turned=turned, files=len(files)))
    return remarks
