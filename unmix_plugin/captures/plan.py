"""Everything that is decided before the first view is written: samples are taken, and decisions from them.

Notation: `N` sampled pixels, `c` bands of the scene.
"""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64

from unmix_plugin.captures.calibration.bands import BandChoice, stated_bands, without_bad, without_unlit
from unmix_plugin.captures.calibration.calibration import Calibration, Raster
from unmix_plugin.captures.calibration.exposures import (
    ComparedExposures,
    ExposedFiles,
    compare_exposures,
    exposure_of,
)
from unmix_plugin.captures.calibration.references import GivenReferences, SensorReferences, find_references
from unmix_plugin.captures.camera_tags import radiometric_model
from unmix_plugin.captures.cube import Capture, CaptureView, Cube
from unmix_plugin.captures.decide import (
    Saturation,
    Scale,
    ValueMeaning,
    background_rule,
    choose_mask,
    choose_scale,
    doubts_of_scale,
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
from unmix_plugin.captures.sample import (
    PixelSample,
    WhiteSample,
    border_pixels,
    bright_values,
    count_stored,
    draw_pixels,
    rows_behind,
)
from unmix_plugin.captures.spoilt import judge_values
from unmix_plugin.captures.writing.view_files import BackgroundRule, ViewRecipe, alpha_picture
from unmix_plugin.engine.sampling import evenly_spaced
from unmix_plugin.scenes.backdrops import Backdrop, judge_backdrop
from unmix_plugin.spectral.bands import Bands

_BACKDROP_VIEWS = 12
"""Views that a backdrop is looked for in."""
_WHITE_PERCENTILE = 99.0
"""Of sampled pixels; shown as white in pictures."""
_LEAST_END = 0.9
"""Of what is written as 1: saturated values below are too far off. Columns and bands differ in their ends a little."""
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

    def to_json(self) -> dict[str, Any]:
        """What was decided and from what, for the record."""
        dropped = [
            {
                "band": index,
                "wavelength_nm": float(self.bands.wavelengths_nm[index]),
                "reason": band.reason,
            }
            for index, band in sorted(self.bands.dropped.items())
        ]
        facts = {
            "saturation": {"stored": self.saturation.stored, "evidence": self.saturation.reason},
            **self.references_used,
            "wavelengths": self.bands.source,
            "dropped_bands": dropped,
        }
        return facts | ({"irradiance": dict(self.irradiance)} if self.irradiance else {})


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
    def decisions(self) -> dict[str, Any]:
        """With their reasons, as JSON-able values."""
        from unmix_plugin.spectral.colour.conversion import describe_colour

        each = {}
        for name, sensor in self.sensors.items():
            raster, rule = sensor.calibration.raster, self.recipes[name].background
            each[name or "all views"] = {
                "unit": sensor.meaning.description,
                "bands": len(sensor.centers_nm),
                "size": [raster.height, raster.width],
                "colours": describe_colour(Bands(sensor.centers_nm)),
                **sensor.to_json(),
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

    meanings = [sensor.meaning for sensor in sensors.values()]
    usual = [sensor.usual_sample.ravel() for sensor in sensors.values()]
    scale = choose_scale(meanings, np.concatenate(usual), options.scale)

    sound = {name: [view for view in same if view.name not in left_out] for name, same in by_sensor.items()}
    mask, backgrounds, remarks_on_mask = _decide_mask(options.mask, views, sensors, sound, scale.value)
    recipes = {
        name: ViewRecipe(
            sensor.calibration,
            scale.value,
            _colours_of(sensor, scale.value),
            backgrounds[name],
            use_opacity=mask == "files",
        )
        for name, sensor in sensors.items()
    }

    files = [(view.name, file) for view in views for file in (view.cube, *view.references)]
    files += [(file.path.name, file) for file in given.files]
    texts = (options.wavelengths or "", options.white_reflectance)  # numbers, or the name of a table
    tables = filter(os.path.isfile, texts)
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
            *(remark for sensor in sensors.values() for remark in sensor.remarks),
            *_doubts_of_references(sensors, scale),
            *remarks_on_mask,
            *_doubts_of_kinds(sensors, scale, views),
            *_remarks_on_pictures([view.cube for view in views]),
            *(one for view in views for one in view.cube.remarks if not one.code.looks_wrong),
            *(
                replace(one, where=(name,))
                for name, file in files
                for one in file.remarks
                if one.code.looks_wrong
            ),
        ),
        option_files=(*(path for file in given.files for path in file.files), *map(Path, tables)),
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
    remarks: list[Remark] = []
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
            may_be_reflectance=may_be_reflectance(first, bright_values(files)),
        )
        compared = compare_exposures(exposed)

    raster = Raster.of(first.shape[0], first.shape[1], options.crop, options.bin_pixels)
    calibration = Calibration(
        raster,
        bands.kept,
        references=references,
        saturation=saturation.stored,
        exposure=compared.common,
    )
    drawn = draw_pixels(views, calibration)
    spoilt = judge_values(drawn, cameras)
    left_out = {name: remark for name, remark in spoilt.items() if name not in options.keep_view}
    pixels = PixelSample(tuple(view for view in drawn if view.name not in left_out))
    pixels.require(first.path)
    values, saturated = pixels.values, pixels.saturated

    bands, found = without_bad(bands, values, saturated, options.max_noise)
    bands = bands.without_incomplete_bins(binning)
    bands.require(binning, str(first.path))
    still_kept = np.isin(calibration.bands, bands.kept)
    at_end = values[:, still_kept][saturated[:, still_kept]]
    models = {view.name: radiometric_model(view.cube) for view in views}
    irradiance = {name: one.irradiance for name, one in models.items() if one and one.irradiance is not None}
    return SensorPlan(
        calibration=replace(calibration, bands=bands.kept, bin_bands=binning),
        bands=bands,
        saturation=saturation,
        meaning=find_meaning(files, bool(references.whites)),
        sample=values[:, still_kept].reshape(len(values), -1, binning).mean(axis=2),
        is_usual=usual_pixels(pixels.views, still_kept),
        saturated_from=float(np.percentile(at_end, _FEW_PERCENTILE)) if len(at_end) else np.inf,
        lamp=_lamp_of(references, bands, binning),
        irradiance=irradiance,
        remarks=(*remarks, *compared.remarks, *found),
        left_out=left_out,
    )


def _lamp_of(
    references: SensorReferences, bands: BandChoice, binning: int
) -> Float64[np.ndarray, " c"] | None:
    """Light on the first white panel as the detector sees it, greatest value 1."""
    if not references.whites:
        return None
    white = references.whites[0]
    lamp = (white.signal / white.reflectance)[bands.kept].astype(np.float32)
    lamp = lamp.reshape(-1, binning).mean(axis=1).astype(np.float64)
    return np.clip(lamp, 0.0, None) / lamp.max()


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
    exposed = ExposedFiles(
        files,
        is_srgb=any(file.is_srgb for file in files),
        may_be_reflectance=any(may_be_reflectance(file, bright_values([file])) for file in files),
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


def _doubts_of_references(sensors: Mapping[str, SensorPlan], scale: Scale) -> Iterator[Remark]:
    """What may be wrong with the references, by the values that come of them."""
    has_white = any(sensor.calibration.references.whites for sensor in sensors.values())
    yield from doubts_of_scale([sensor.meaning for sensor in sensors.values()], scale, has_white)
    if any(is_below_black(sensor.sample) for sensor in sensors.values()):
        yield Remark.of(Code.BELOW_BLACK)


def _doubts_of_kinds(
    sensors: Mapping[str, SensorPlan], scale: Scale, views: Sequence[CaptureView]
) -> Iterator[Remark]:
    """Sensors whose values are of different kinds, and saturated values that are written as more than they may be."""
    meanings = [sensor.meaning for sensor in sensors.values()]
    kinds = {(meaning.has_one, meaning.states_one): meaning.description for meaning in meanings}
    if len(kinds) > 1 and not any(view.cube.is_srgb for view in views):
        yield Remark.of(Code.UNLIKE_MEANINGS, kinds=[*kinds.values()])
    end = min(sensor.saturated_from for sensor in sensors.values())
    if end < _LEAST_END * scale.value:
        yield Remark.of(Code.SATURATED_BELOW_ONE, end=f"{end:.3g}", scale=f"{scale.value:g}")


def _colours_of(sensor: SensorPlan, scale: float) -> Float32[np.ndarray, "c 3"]:
    """From spectra to linear red, green and blue, in which bright pixels of the sample are white."""
    from unmix_plugin.spectral.colour.conversion import rgb_matrix

    to_rgb = rgb_matrix(Bands(sensor.centers_nm)).numpy()
    shown = ((sensor.sample / np.float32(scale)) @ to_rgb).max(axis=1)
    white = float(np.percentile(shown, _WHITE_PERCENTILE)) if len(shown) else 0.0
    return to_rgb / np.float32(white) if white > 0 else to_rgb


def _remarks_on_pictures(files: Sequence[Cube]) -> Iterator[Remark]:
    """Encoding, order of colours and orientation; none where there is no picture."""
    pictures = [file for file in files if file.reader == "picture"]
    if any(file.is_srgb for file in pictures):
        yield Remark.of(Code.PICTURES_ARE_SRGB)
    for centres in (file.bands.wavelengths_nm for file in pictures):
        if centres is not None and len(centres) == 3 and centres[0] < centres[2]:
            red, green, blue = (f"{centre:g}" for centre in centres)
            yield Remark.of(Code.COLOURS_IN_ORDER, red=red, green=green, blue=blue)
            break
    turned = sum(file.orientation != 1 for file in files)
    if turned:
        yield Remark.of(Code.ORIENTATION_IGNORED, turned=turned, files=len(files))
