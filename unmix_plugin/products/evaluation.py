"""The evaluation of a run: figures of merit of every view, and prediction beside truth as pictures.

A scene of mixed materials is measured against all that is known of its spectral scene, and so are the spectra that a
model of another method names. Others measure their images themselves. All write metrics.json and a folder for each kind
of picture.

True materials keep their colours in all pictures; a predicted endmember has the colour of the material that it is
matched to, and one of its own where it is matched to none.

Notation: `H x W` pixels, `B` bands, `K` true materials, `P` predicted endmembers.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from unmix_plugin.engine.outputs import Output
from unmix_plugin.engine.pipeline import Pipeline, average_metrics, evaluating
from unmix_plugin.engine.processes import Processes
from unmix_plugin.errors import ConfigError, counted
from unmix_plugin.figures.look import NEUTRAL
from unmix_plugin.figures.paint import paint, scale_of
from unmix_plugin.figures.pictures import Picture, TitledPicture, draw_panels, in_rows
from unmix_plugin.figures.plotting import RIGHT, WRONG, Colour, distinct_colours, own_colours
from unmix_plugin.formats.files import rgba_png_bytes, write_file
from unmix_plugin.products.views import SHARE_SCALE, paint_ids, share_panels
from unmix_plugin.scenes.scene import Scene
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import describe_colour
from unmix_plugin.spectral.colour.srgb import encode_srgb
from unmix_plugin.spectral.segmentation import NOTHING_ID
from unmix_plugin.trained.alignment import render_aligned
from unmix_plugin.trained.evaluation import (
    DEFINITIONS,
    BandErrors,
    Evaluation,
    PredictedView,
    ViewTruth,
    as_numpy,
    coloured_picture,
    finite_or_none,
    scene_truth,
    view_truth,
)
from unmix_plugin.trained.run_views import views_of
from unmix_plugin.trained.trained_scene import TrainedScene

_ERROR = Output("error", "map", "error", "error of sRGB", (0.0, 0.2), "magma")
_COLUMNS = 7
_Follow = Callable[[str, Sequence[Any]], Iterator[Any]]
"""The items given, while it is shown how many are done."""


@dataclass(frozen=True)
class Evaluated:
    """What was found of a run."""

    figures: dict[str, float | None]
    """Of the scene; None where there is no truth."""
    per_image: list[dict[str, Any]]
    """Name and figures of each view or image."""
    more: dict[str, Any]
    """What else metrics.json has."""
    num_pictures: int
    bands: dict[str, BandErrors] = field(default_factory=dict)
    """Of each view, where the figures are those of `DEFINITIONS`; empty where a model measured its images itself."""

    @property
    def own(self) -> dict[str, float | None]:
        """What a model that was measured here says of its images itself."""
        return {name: value for name, value in self.more.get("own", {}).items() if name != "views"}

    def write(self, path: Path, times: Mapping[str, float | None]) -> dict[str, Any]:
        """Write metrics.json; its figures, those of training among them."""
        figures, each = {**self.figures, **times}, "per_image"
        if self.bands:
            figures, each = {name: figures[name] for name in DEFINITIONS if name in figures}, "per_view"
        content = {**figures, each: self.per_image, **self.more}
        write_file(path, (json.dumps(content, indent=1, allow_nan=False) + "\n").encode())
        return figures


def evaluate_images(pipeline: Pipeline, folder: Path, follow: _Follow) -> Evaluated:
    """What a model says of its own images, and its pictures of each: KIND/NAME.png in the folder."""
    images, found, num_pictures = pipeline.evaluate_images(), [], 0
    for _ in follow("evaluating images", range(pipeline.datamanager.num_eval_images)):
        name, metrics, pictures = next(images)
        found.append((name, metrics))
        num_pictures += len(pictures)
        for kind, picture in pictures.items():
            pixels = (picture.clamp(0, 1) * 255 + 0.5).byte().cpu().numpy()
            write_file(folder / kind / f"{name}.png", rgba_png_bytes(pixels, f"{kind} of {name}"))
    means = average_metrics([metrics for _, metrics in found])
    figures = {**finite_or_none(means), "views": len(pipeline.datamanager.eval_cameras)}
    per_image = [{"name": name, **finite_or_none(metrics)} for name, metrics in found]
    return Evaluated(figures, per_image, {}, num_pictures)


def evaluate_spectra(pipeline: Pipeline, measured: Scene, folder: Path, follow: _Follow) -> Evaluated | None:
    """Measure the spectra that a model names, by the same definitions as those of a scene of mixed materials.

    What the model says of its images itself stands beside, as `own` and `own_per_image`, with its pictures; where it
    draws none, prediction is drawn beside truth.

    Returns:
        What was found; None of a model that names no spectra.
    Raises:
        ConfigError: they are not on the scene's bands.
    """
    model, bands = pipeline.model, Bands.of(measured.wavelengths_nm)
    named = (one for one in model.outputs if one.kind == "channels" and one.quantity is not None)
    output = next(named, None)
    if output is None:
        return None
    own = evaluate_images(pipeline, folder, follow)
    truth = scene_truth(measured)
    evaluation, num_pictures = Evaluation(truth, None), own.num_pictures
    opacity = [one.name for one in model.outputs if one.name == "accumulation"]
    for number, index in follow("evaluating views", list(enumerate(measured.eval_indices))):
        with torch.no_grad(), evaluating(model):
            camera = pipeline.datamanager.eval_cameras[number]
            found = model.get_outputs_for_camera(camera, [output.name, *opacity])
        spectra, view = found[output.name].cpu(), view_truth(measured, index)
        if spectra.shape[-1] != len(bands) or (output.centers_nm and Bands.of(output.centers_nm) != bands):
            raise ConfigError(
                f"the output {output.name} of {type(model).__name__} has {counted(spectra.shape[-1], 'channel')}, the "
                f"scene {bands}: spectra are measured on the scene's own bands; give one channel for each, and as "
                "centers_nm their centres or nothing"
            )
        height, width = spectra.shape[:2]
        predicted = PredictedView(
            spectra,
            found["accumulation"].cpu() if opacity else torch.ones(height, width),
            torch.zeros(height, width, 0),
            torch.full((height, width), NOTHING_ID, dtype=torch.uint8),
            torch.zeros(height, width, 0),
        )
        if measured.is_rig:
            evaluation.sensors[view.name] = measured.sensor_of(index).name
        figures = evaluation.add(view, predicted)
        if not opacity:
            figures["psnr_white"] = math.nan
        if not own.num_pictures:
            drawn = draw_colour(view, predicted, bands, figures["psnr"])
            write_file(folder / "rgb" / f"{view.name}.png", drawn)
            num_pictures += 1
    found = _evaluated(evaluation, {"own": own.figures, "own_per_image": own.per_image}, num_pictures)
    return replace(found, figures={name: one for name, one in found.figures.items() if one is not None})


def _evaluated(evaluation: Evaluation, more: dict[str, Any], num_pictures: int) -> Evaluated:
    """What was counted, as it is written."""
    more = {"definitions": DEFINITIONS, **more}
    per_sensor = {name: finite_or_none(found) for name, found in evaluation.per_sensor().items()}
    more |= {"per_sensor": per_sensor} if per_sensor else {}
    per_view = [{"name": name, **finite_or_none(found)} for name, found in evaluation.per_view.items()]
    return Evaluated(
        finite_or_none(evaluation.figures()), per_view, more, num_pictures, bands=evaluation.bands
    )


def evaluate_scene(
    scene: TrainedScene,
    measured: Scene,
    light_factors: Float[np.ndarray, " B"] | None,
    folder: Path,
    follow: _Follow,
    processes: Processes,
) -> Evaluated | None:
    """Measure a scene of mixed materials on the evaluation views of what was measured, and draw each view.

    Args:
        scene: What renders; each view is aligned first as far as the scene's `fitted` says.
        measured: With all truth that is known.
        light_factors: What measured radiance is multiplied with; None: nothing.
        folder: Where pictures go: rgb, segmentation and abundances.
    Returns:
        What was found; None in all processes but the first.
    """
    truth = scene_truth(measured).in_light(light_factors)
    evaluation = Evaluation(truth, scene.materials.endmembers, scene.materials.names)
    look = material_look(evaluation)
    # Of segmentations the ids alone are kept: their colours are known after the last view.
    ids: dict[int, UInt8[np.ndarray, "H W"]] = {}
    views = list(zip(measured.eval_indices, views_of(scene.views, "eval"), strict=True))
    with processes.together():
        for index, own in follow("evaluating views", views[processes.rank :: processes.count]):
            view = view_truth(measured, index).in_light(light_factors)
            predicted = render_aligned(scene, own.camera, measured, index, view)
            if measured.is_rig:
                evaluation.sensors[view.name] = measured.sensor_of(index).name
            psnr_db, name = evaluation.add(view, predicted)["psnr"], f"{view.name}.png"
            write_file(folder / "rgb" / name, draw_colour(view, predicted, truth.bands, psnr_db))
            drawn = draw_matched_abundances(view, predicted, evaluation, look)
            write_file(folder / "abundances" / name, drawn)
            ids[index] = predicted.segmentation.numpy()
    parts = processes.gather((evaluation, ids))
    if not processes.is_first:
        return None
    evaluation.merge((other for other, _ in parts[1:]), [measured.frames[i].name for i, _ in views])
    ids = {index: found for _, part in parts for index, found in part.items()}
    matching = evaluation.segmentation().matching
    for index in follow("drawing segmentations", list(ids)):
        name, labels = measured.frames[index].name, measured.labels(index)
        if labels is not None:
            labels = np.where(measured.valid_mask(index), labels, np.uint8(NOTHING_ID))
        drawn = draw_matched_segmentation(name, labels, ids[index], look, matching)
        write_file(folder / "segmentation" / f"{name}.png", drawn)
    return _evaluated(evaluation, {"aligned": list(scene.fitted)} if scene.fitted else {}, 3 * len(ids))


@dataclass(frozen=True)
class MaterialLook:
    """Names and colours of true materials and predicted endmembers in one evaluation."""

    true_names: tuple[str, ...]
    true_colours: Float[np.ndarray, "K 3"]
    pred_names: tuple[str, ...]
    surplus_colours: Float[np.ndarray, "P 3"]
    """Colours of predicted endmembers that stand for no true material."""

    @property
    def true_entries(self) -> list[tuple[str, Colour]]:
        """Name and colour of each true material."""
        return list(zip(self.true_names, self.true_colours, strict=True))

    def surplus(self, matching: Mapping[int, int]) -> dict[int, tuple[str, Colour]]:
        """Name and colour of each predicted endmember that the matching (predicted -> true) has no partner for."""
        entries = enumerate(zip(self.pred_names, self.surplus_colours, strict=True))
        return {index: entry for index, entry in entries if index not in matching}

    def predicted(self, ids: UInt8[np.ndarray, "H W"], matching: Mapping[int, int]) -> Picture:
        """Predicted ids in the colours of the true materials that they are matched to, or in their own."""
        colours = np.array(self.surplus_colours)
        for pred, true in matching.items():
            colours[pred] = self.true_colours[true]
        return paint_ids(ids, self.pred_names, colours)

    def beside_labels(
        self, ids: UInt8[np.ndarray, "H W"], labels: UInt8[np.ndarray, "H W"], matching: Mapping[int, int]
    ) -> tuple[Picture, Picture, Picture]:
        """True labels, predicted materials in their colours, and where they differ."""
        agreement = np.where((as_true(ids, matching) != labels)[..., None], WRONG, RIGHT)
        agreement[labels == NOTHING_ID] = NEUTRAL
        true = paint_ids(labels, self.true_names, self.true_colours)
        return true, self.predicted(ids, matching), agreement


def as_true(ids: UInt8[np.ndarray, "H W"], matching: Mapping[int, int]) -> UInt8[np.ndarray, "H W"]:
    """Predicted ids as those of the true materials that they are matched to, 255 for the others."""
    table = np.full(256, NOTHING_ID, dtype=np.uint8)
    table[list(matching)] = list(matching.values())
    return table[ids]


def material_look(evaluation: Evaluation) -> MaterialLook:
    """Names and colours for all figures of an evaluation."""
    truth, endmembers = evaluation.truth, evaluation.endmembers
    grey = torch.full((truth.num_materials, len(truth.bands)), 0.2, dtype=torch.float64)
    spectra = grey if truth.endmembers is None else truth.endmembers.double()
    colours = distinct_colours(own_colours(torch.cat([spectra, endmembers]), truth.bands))
    return MaterialLook(
        truth.names or tuple(f"material {index}" for index in range(len(spectra))),
        colours[: len(spectra)],
        evaluation.names,
        colours[len(spectra) :],
    )


def draw_colour(view: ViewTruth, predicted: PredictedView, bands: Bands, psnr_db: float) -> bytes:
    """True colour, predicted colour, and their difference; in false colours for sensors without all bands."""
    weights, spectra = view.colour_weights(bands), view.shown(predicted)
    error = np.abs(_srgb_on_black(spectra, weights) - _srgb_on_black(view.spectra, weights)).mean(axis=-1)
    seen = np.maximum(as_numpy(view.opacity), as_numpy(predicted.coverage)) > 0.01
    counted = (seen & view.valid.numpy()).astype(np.float64)
    panels = [
        TitledPicture(coloured_picture(view.spectra, view.opacity, weights), "true"),
        TitledPicture(coloured_picture(spectra, predicted.coverage, weights), "predicted"),
        TitledPicture(paint(_ERROR, error, counted).picture(), "error"),
    ]
    colours = describe_colour(bands).split(":")[0] if view.sensor is None else f"seen by {view.sensor.name}"
    heading = f"{view.name}: {colours}, spectral PSNR {psnr_db:.1f} dB"
    return draw_panels([panels], heading, scale_of(_ERROR))


def draw_matched_segmentation(
    name: str,
    labels: UInt8[np.ndarray, "H W"] | None,
    ids: UInt8[np.ndarray, "H W"],
    look: MaterialLook,
    matching: Mapping[int, int],
) -> bytes:
    seen = set(np.unique(as_true(ids, matching)).tolist())
    legend = [entry for index, entry in look.surplus(matching).items() if (ids == index).any()]
    if labels is None:
        panels = [TitledPicture(look.predicted(ids, matching), "predicted")]
    else:
        titles = ("true", "predicted", "disagreement")
        panels = list(map(TitledPicture, look.beside_labels(ids, labels, matching), titles))
        seen |= set(np.unique(labels).tolist())
        legend += [("right", RIGHT), ("wrong", WRONG), ("not counted", (NEUTRAL,) * 3)]
    true_entries = [entry for index, entry in enumerate(look.true_entries) if index in seen]
    return draw_panels([panels], f"{name}: segmentation", legend=true_entries + legend)


def draw_matched_abundances(
    view: ViewTruth, predicted: PredictedView, evaluation: Evaluation, look: MaterialLook
) -> bytes:
    """Each true material's abundance above that of the endmember matched to it; surplus endmembers at the end."""
    swatches = own_colours(evaluation.endmembers, evaluation.truth.bands)
    pred_panels = share_panels(predicted.shares, predicted.accumulation, look.pred_names, swatches)
    heading, matching = f"{view.name}: abundances", evaluation.matching
    if view.abundances is None or matching is None:
        return draw_panels(in_rows(pred_panels), heading, SHARE_SCALE)
    has_truth = view.abundances.sum(dim=-1) > 0
    true_panels = share_panels(view.abundances, view.opacity * has_truth, look.true_names, look.true_colours)
    blank = TitledPicture(np.full_like(true_panels[0].image, NEUTRAL), "none matched")
    partners = dict(zip(matching.true_ids, (pred_panels[index] for index in matching.pred_ids), strict=True))
    partner_panels = [partners.get(index, blank) for index in range(len(true_panels))]
    columns = min(len(true_panels), _COLUMNS)
    pairs = zip(in_rows(true_panels, columns), in_rows(partner_panels, columns), strict=True)
    surplus = [panel for index, panel in enumerate(pred_panels) if index not in matching.pred_ids]
    rows = [row for pair in pairs for row in pair] + in_rows(surplus, columns)
    return draw_panels(rows, f"{heading}, true above predicted (matched by spectral angle)", SHARE_SCALE)


def _srgb_on_black(spectra: Float[Tensor, "H W b"], weights: Float[Tensor, "b 3"]) -> np.ndarray:
    linear = spectra.double().clamp(0, 1) @ weights
    return encode_srgb(linear.clamp(0, 1).numpy())
