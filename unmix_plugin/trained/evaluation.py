"""How well a model predicts views that it has not seen: every figure of merit of a scene, view by view.

Each figure has one definition, in `DEFINITIONS` and in `spectral.metrics`. Figures are means over the evaluation
views, but for segmentation, which is scored once over all of them.

Notation: `H x W` pixels, `B` bands, `K` true materials, `P` predicted endmembers.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.outputs import Output
from unmix_plugin.errors import RunError
from unmix_plugin.figures.paint import paint
from unmix_plugin.figures.pictures import Picture
from unmix_plugin.scenes.scene import Scene
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import linear_to_srgb, rgb_matrix
from unmix_plugin.spectral.evidence import is_blown_out
from unmix_plugin.spectral.materials import default_names
from unmix_plugin.spectral.metrics import (
    SSIM_WINDOW_PX,
    abundance_rmse,
    endmember_angle,
    match_endmembers,
    psnr,
    psnr_over_white,
    rmse,
    sam,
    ssim,
)
from unmix_plugin.spectral.segmentation import NOTHING_ID, SegmentationScores, SegmentationTally
from unmix_plugin.spectral.sensor import SceneSensor

if TYPE_CHECKING:
    from unmix_plugin.trained.trained_scene import MaterialView, TrainedScene


_MOST_SENSOR_SUBPIXELS = 4
"""Along an edge of a coarse sensor's pixel, in multiples of the finest sensor's."""


@dataclass(frozen=True)
class PredictedView:
    """What a scene shows from one camera, on black; on the CPU."""

    spectra: Float[Tensor, "H W B"]
    accumulation: Float[Tensor, "H W"]
    """Opacity, [0, 1]."""
    abundances: Float[Tensor, "H W K"]
    """Composited, so that they sum to the accumulation."""
    segmentation: UInt8[Tensor, "H W"]
    """Material ids, 255 where nothing is."""
    material_scores: Float[Tensor, "H W K"]
    """Cosine of the spectrum to each endmember."""
    has_sky: bool = False
    """Whether a sky is behind all that is seen."""
    confidence: Float[Tensor, "H W"] | None = None
    """Estimated probability that the segmentation is right."""
    gain: Float[Tensor, "b"] | None = None
    """With which each channel of the sensor that measured the view is multiplied; None: 1."""

    @property
    def coverage(self) -> Float[Tensor, "H W"]:
        """How much of a pixel shows something, the sky included, [0, 1]."""
        return torch.ones_like(self.accumulation) if self.has_sky else self.accumulation

    @property
    def shares(self) -> Float[Tensor, "H W K"]:
        """Abundances of what is seen, summing to 1 wherever anything is."""
        return self.abundances / self.accumulation.clamp(min=1e-6)[..., None]


def render_view(scene: TrainedScene, camera: Cameras, subpixels: int | None = None) -> PredictedView:
    """Render all that is written about a view; `subpixels` squared rays per pixel, None for as many as in training."""
    return predicted_view(scene.look(camera, subpixels))


def predicted_view(view: MaterialView) -> PredictedView:
    """All that is written about a rendered view."""
    names = ("spectral", "accumulation", "abundances", "segmentation", "material_scores")
    parts = (view[name].detach().cpu() for name in names)
    confidence = view["confidence"].detach().cpu()
    return PredictedView(*parts, has_sky=view.scene.field.has_sky, confidence=confidence)


def subpixels_for(scene: Scene, index: int, subpixels: int, pixel_size: float) -> int:
    """Rays along the edge of a pixel with which to render a view, so that coarse sensors' pixels are means too: from
    those of a pixel of this size in the middle of the scene."""
    if not scene.is_rig:
        return subpixels
    distance = scene.cameras.camera_to_world[index, :, 3] - scene.scene_box.aabb.mean(dim=0)
    edge = float(distance.norm() / scene.cameras.focal_px[index].mean())
    return subpixels * min(max(1, round(edge / pixel_size)), _MOST_SENSOR_SUBPIXELS)


def picture(spectra: Float[Tensor, "H W B"], coverage: Float[Tensor, "H W"], bands: Bands) -> Picture:
    """Spectra seen on black as an sRGB picture over neutral grey."""
    return coloured_picture(spectra, coverage, rgb_matrix(bands))


def coloured_picture(
    spectra: Float[Tensor, "H W b"], coverage: Float[Tensor, "H W"], weights: Float[Tensor, "b 3"]
) -> Picture:
    """The same with other weights of the channels in red, green and blue."""
    linear = spectra.double().clamp(min=0) @ weights.double()
    return paint(_COLOUR, linear, coverage).picture()


_COLOUR = Output("linear_rgb", "linear", "colour", "linear light in sRGB primaries")


def as_numpy(values: Tensor) -> np.ndarray:
    """float64 for drawing."""
    return values.double().numpy()


_OPAQUE_ALPHA = 0.99
"""Opacity from which an unlabelled pixel counts for the spectral angle."""
_HALF_COVERED = 0.5
"""Opacity from which a pixel's abundances count."""
_VIEW_FIGURES = (
    *("psnr", "psnr_matter", "psnr_unsaturated", "psnr_matter_unsaturated", "psnr_white"),
    *("rmse", "ssim", "sam", "rgb_psnr", "abundance_rmse"),
)
"""Figures of every view, as far as there is truth for them."""

DEFINITIONS = {
    "psnr": "dB, all valid pixels and bands of spectra on black, peak 1",
    "psnr_matter": "dB, the same over valid pixels that are labelled or opaque only, background left out",
    "psnr_unsaturated": "dB, as psnr without blown-out pixels, in which a band was measured above 0.9",
    "psnr_matter_unsaturated": "dB, as psnr_matter without blown-out pixels",
    "psnr_white": "dB, as psnr with both laid over white by their opacity, as results on objects are often published; "
    "only of views with alpha",
    "rmse": "root mean squared error, all valid pixels and bands",
    "ssim": "mean over bands, 7 x 7 uniform window, data range 1",
    "sam": "mean spectral angle in radians over labelled or opaque pixels whose true spectrum is not dark "
    "(root mean square over bands above 0.005)",
    "rgb_psnr": "dB, the same cubes as sRGB (false colour where the bands are not those of the eye); only of "
    "views with all bands",
    "miou": "mean intersection over union of the true materials; predicted ids matched to labels once a scene "
    "(Hungarian), unlabelled pixels ignored",
    "macro_f1": "mean F1 of the true materials, same matching",
    "accuracy": "share of labelled pixels with the right material, same matching",
    "abundance_rmse": "endmembers matched by spectral angle; pixels at least half covered; composited abundances "
    "divided by the larger of predicted and true opacity, since true ones sum to 1 on partly covered pixels too",
    "endmember_angle": "mean spectral angle in radians between reflectance x illuminant and the matched endmember",
    "views": "evaluation views",
    "bands": "spectral bands",
    "train_seconds": "seconds of training alone",
    "train_rays_per_second": "training rays a second of training",
}
"""What each figure is, in the order in which they are shown."""


@dataclass(frozen=True)
class ViewTruth:
    """What was measured of one view."""

    name: str
    spectra: Float[Tensor, "H W B"]
    valid: Bool[Tensor, "H W"]
    """Pixels that count."""
    alpha: Float[Tensor, "H W"] | None = None
    labels: UInt8[Tensor, "H W"] | None = None
    """True material, 255 where unlabelled."""
    abundances: Float[Tensor, "H W K"] | None = None
    sensor: SceneSensor | None = None
    """What measured the spectra; None where it sees the scene's bands as they are."""
    measured_blown_out: Bool[Tensor, "H W"] | None = None
    """`blown_out` of a view in another light; None in the light that it was measured in."""

    @property
    def blown_out(self) -> Bool[Tensor, "H W"]:
        """Pixels in which a band was measured near full scale, whatever light the view is in now."""
        return is_blown_out(self.spectra) if self.measured_blown_out is None else self.measured_blown_out

    def seen(self, spectra: Float[Tensor, "*pixels B"]) -> Float[Tensor, "*pixels b"]:
        """Spectra on the scene's bands as the view's sensor sees them."""
        if self.sensor is None:
            return spectra
        return spectra @ torch.from_numpy(self.sensor.matrix).to(spectra).T

    def shown(self, predicted: PredictedView) -> Float[Tensor, "H W b"]:
        """What the view's sensor sees of a prediction, times its gain."""
        spectra = self.seen(predicted.spectra)
        return spectra if predicted.gain is None else spectra * predicted.gain.to(spectra)

    def colour_weights(self, bands: Bands) -> Float[Tensor, "b 3"]:
        """From the view's spectra to linear sRGB, or to false colours where its sensor lacks bands."""
        if self.sensor is None:
            return rgb_matrix(bands, torch.float64)
        return torch.from_numpy(self.sensor.false_colours)

    @property
    def opacity(self) -> Float[Tensor, "H W"]:
        """Alpha, 1 without it."""
        return torch.ones(self.spectra.shape[:2]) if self.alpha is None else self.alpha

    @property
    def shows_matter(self) -> Bool[Tensor, "H W"]:
        """Valid pixels that are labelled or opaque."""
        opaque = self.opacity > _OPAQUE_ALPHA
        return self.valid & (opaque if self.labels is None else opaque | (self.labels != NOTHING_ID))

    @property
    def counted_labels(self) -> UInt8[Tensor, "H W"] | None:
        """Labels, 255 also in pixels that don't count."""
        if self.labels is None:
            return None
        return torch.where(self.valid, self.labels, torch.full_like(self.labels, NOTHING_ID))

    def in_light(self, factors: Float[np.ndarray, " B"] | None) -> ViewTruth:
        """The view as the same sensor would have measured it in another light; itself where `factors` are None."""
        if factors is None:
            return self
        own = self.seen(torch.from_numpy(factors))
        spectra = (self.spectra * own.to(self.spectra)).clamp(0, 1)
        return replace(self, spectra=spectra, measured_blown_out=self.blown_out)


@dataclass(frozen=True)
class SceneTruth:
    """What is known of a scene's materials."""

    bands: Bands
    num_materials: int
    """Of labels; 0 where nothing is known of materials."""
    endmembers: Float[Tensor, "K B"] | None = None
    """True radiance of each material: reflectance x illuminant, under flat light where the illuminant is unknown."""
    names: tuple[str, ...] | None = None

    def in_light(self, factors: Float[np.ndarray, " B"] | None) -> SceneTruth:
        """The scene in another light; itself where `factors` are None."""
        if factors is None or self.endmembers is None:
            return self
        return replace(self, endmembers=self.endmembers * torch.from_numpy(factors))


@dataclass(frozen=True)
class BandErrors:
    """One view band by band, over its valid pixels."""

    nm: Float[np.ndarray, " b"]
    """Centres of the bands that its sensor sees."""
    mean: Float[np.ndarray, " b"]
    """Of what was measured."""
    mse: Float[np.ndarray, " b"]
    """Mean squared error of what was predicted, clamped to [0, 1]."""
    num_pixels: int


class Evaluation:
    """Figures of merit of one scene, fed view by view; keeps no image."""

    def __init__(
        self,
        truth: SceneTruth,
        endmembers: Float[Tensor, "P B"] | None,
        names: tuple[str, ...] | None = None,
    ) -> None:
        """Nothing counted yet; `endmembers` are the model's, None of a model of spectra alone, their `names` None for
        `default_names`."""
        self.has_materials = endmembers is not None
        if endmembers is None:
            endmembers = torch.zeros(0, len(truth.bands))
        self.truth = truth
        self.names = default_names(len(endmembers)) if names is None else names
        self.endmembers = endmembers.detach().cpu().double()
        self.matching = (
            match_endmembers(self.endmembers, truth.endmembers)
            if self.has_materials and truth.endmembers is not None
            else None
        )
        """Predicted and true endmembers, paired by spectral angle; None where there are none of one kind."""
        self.per_view: dict[str, dict[str, float]] = {}
        """`_VIEW_FIGURES` of each view; NaN where it has no truth."""
        self.bands: dict[str, BandErrors] = {}
        """Of each view."""
        self.sensors: dict[str, str] = {}
        """Name of the sensor of each view of a rig."""
        is_scored = self.has_materials and truth.num_materials > 0
        self._tally = SegmentationTally(len(endmembers), truth.num_materials) if is_scored else None

    def add(self, view: ViewTruth, predicted: PredictedView) -> dict[str, float]:
        """Count one view; its figures. A RunError where it was measured in another size than the run's camera has."""
        measured, rendered = tuple(view.spectra.shape[:2]), tuple(predicted.spectra.shape[:2])
        if measured != rendered:
            raise RunError(
                f"view {view.name} was measured with {measured[1]} x {measured[0]} pixels; its camera in the run has "
                f"{rendered[1]} x {rendered[0]}; name the scene that the run was trained on with --data"
            )
        spectra, target, valid, matter = view.shown(predicted), view.spectra, view.valid, view.shows_matter
        exposed = ~view.blown_out
        figures = dict.fromkeys(_VIEW_FIGURES, math.nan) | {
            "psnr": psnr(spectra, target, valid),
            "psnr_matter": psnr(spectra, target, matter),
            "psnr_unsaturated": psnr(spectra, target, valid & exposed),
            "psnr_matter_unsaturated": psnr(spectra, target, matter & exposed),
            "rmse": rmse(spectra, target, valid),
            "sam": sam(spectra, target, matter),
            "abundance_rmse": self._abundance_rmse(view, predicted),
        }
        if view.alpha is not None:
            figures["psnr_white"] = psnr_over_white(
                spectra, predicted.accumulation, target, view.alpha, valid
            )
        if min(spectra.shape[:2]) >= SSIM_WINDOW_PX:
            figures["ssim"] = ssim(spectra, target, valid)
        if view.sensor is None:
            figures["rgb_psnr"] = psnr(self._srgb(spectra), self._srgb(target), valid)
        if self._tally is not None and (labels := view.counted_labels) is not None:
            self._tally.add(predicted.segmentation, labels)
        self.per_view[view.name] = figures
        centers = torch.tensor(self.truth.bands.centers_nm)
        known = target[valid].double()
        self.bands[view.name] = BandErrors(
            as_numpy(view.seen(centers)),
            as_numpy(known.mean(dim=0)),
            as_numpy((spectra[valid].double().clamp(0, 1) - known).square().mean(dim=0)),
            len(known),
        )
        return figures

    def merge(self, others: Iterable[Evaluation], order: Iterable[str]) -> None:
        """Count the views of others of the same scene, too; `order` has the names of all views."""
        for other in others:
            self.per_view |= other.per_view
            self.bands |= other.bands
            self.sensors |= other.sensors
            if self._tally is not None and other._tally is not None:
                self._tally.confusion += other._tally.confusion
        self.per_view = {name: self.per_view[name] for name in order}

    def segmentation(self) -> SegmentationScores:
        """Scores over all views counted so far, and which id stands for which material."""
        if self._tally is None:
            return SegmentationScores(math.nan, math.nan, math.nan, {}, {})
        return self._tally.scores()

    def per_sensor(self) -> dict[str, dict[str, float]]:
        """Means of `_VIEW_FIGURES` over the views of each sensor, by its name; empty unless the scene is a rig."""
        return {
            sensor: _means([self.per_view[view] for view, own in self.sensors.items() if own == sensor])
            for sensor in dict.fromkeys(self.sensors.values())
        }

    def figures(self) -> dict[str, float]:
        """The scene's figures; NaN where there is no truth."""
        means = _means(self.per_view.values())
        scores, truth = self.segmentation(), self.truth
        angle = math.nan
        if self.has_materials and truth.endmembers is not None:
            angle = endmember_angle(self.endmembers, truth.endmembers)
        matched = {"miou": scores.miou, "macro_f1": scores.macro_f1, "accuracy": scores.accuracy}
        counts = {"views": len(self.per_view), "bands": len(truth.bands)}
        return {**means, **matched, "endmember_angle": angle, **counts}

    def _abundance_rmse(self, view: ViewTruth, predicted: PredictedView) -> float:
        if self.matching is None or view.abundances is None:
            return math.nan
        counts = view.valid & (view.opacity >= _HALF_COVERED) & (view.abundances.sum(dim=-1) > 0)
        # Divided by the larger opacity, a partly covered pixel is not blamed for its background, nor is a surface that
        # is missing forgiven.
        opacity = torch.maximum(predicted.accumulation, view.opacity).clamp(min=1e-6)
        return abundance_rmse(
            predicted.abundances / opacity[..., None], view.abundances, self.matching, counts
        )

    def _srgb(self, spectra: Float[Tensor, "H W B"]) -> Float[Tensor, "H W 3"]:
        matrix = rgb_matrix(self.truth.bands, torch.float64)
        # Row by row, since float64 doubles the cube.
        linear = torch.stack([row.double().clamp(0, 1) @ matrix for row in spectra])
        return linear_to_srgb(linear.clamp(0, 1))


def scene_truth(scene: Scene) -> SceneTruth:
    """What a scene says of its materials."""
    endmembers = None
    if scene.endmembers is not None:
        light = np.ones(len(scene.wavelengths_nm)) if scene.illuminant is None else scene.illuminant
        endmembers = torch.from_numpy(scene.endmembers * light)
    known = scene.endmembers if scene.material_names is None else scene.material_names
    if known is not None:
        num_materials = len(known)
    else:  # as many as labels of evaluation views name
        labels = (found for index in scene.eval_indices if (found := scene.labels(index)) is not None)
        greatest = (int(one.max(where=one != NOTHING_ID, initial=0)) for one in labels)
        num_materials = max((label + 1 for label in greatest), default=0)
    return SceneTruth(Bands.of(scene.wavelengths_nm), num_materials, endmembers, scene.material_names)


def view_truth(scene: Scene, index: int) -> ViewTruth:
    """What was measured of one view of a scene."""
    sensor = scene.sensor_of(index)
    return ViewTruth(
        name=scene.frames[index].name,
        spectra=torch.from_numpy(scene.cube(index)),
        valid=torch.tensor(scene.valid_mask(index)),
        alpha=_tensor(scene.alpha(index)),
        labels=_tensor(scene.labels(index)),
        abundances=_tensor(scene.abundances(index)),
        sensor=None if sensor.sees_all_bands else sensor,
    )


def finite_or_none(figures: dict[str, float]) -> dict[str, float | None]:
    """Figures as JSON has them: null where there is no truth, or for the infinite PSNR of equal images."""
    return {name: value if math.isfinite(value) else None for name, value in figures.items()}


def _tensor(array: np.ndarray | None) -> Tensor | None:
    """A copy: arrays of pictures may be read-only."""
    return None if array is None else torch.tensor(array)


def _means(views: Collection[dict[str, float]]) -> dict[str, float]:
    """Each figure's mean over the views that have it; NaN if none does."""
    means = {}
    for name in _VIEW_FIGURES:
        known = [view[name] for view in views if not math.isnan(view[name])]
        means[name] = sum(known) / len(known) if known else math.nan
    return means
