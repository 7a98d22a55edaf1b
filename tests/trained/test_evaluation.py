import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from unmix_plugin.scenes.demo.scene import make_demo_scene
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.settings import SceneOptions
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.metrics import abundance_rmse, psnr, sam
from unmix_plugin.spectral.sensor import SceneSensor
from unmix_plugin.trained.evaluation import (
    DEFINITIONS,
    Evaluation,
    PredictedView,
    SceneTruth,
    ViewTruth,
    finite_or_none,
    scene_truth,
)

SHUFFLED = [2, 0, 1]


BANDS = Bands.of([450, 500, 550, 600, 650])
ENDMEMBERS = torch.tensor([[9, 1, 1, 2, 3], [1, 8, 3, 1, 1], [2, 2, 2, 9, 6]], dtype=torch.float64) / 10
SCENE = SceneTruth(BANDS, 3, ENDMEMBERS, ("a", "b", "c"))
"""Three materials in five bands."""

LABELS = (torch.arange(12) // 4).to(torch.uint8).repeat(10, 1)
ABUNDANCES = 0.8 * torch.nn.functional.one_hot(LABELS.long(), 3).float() + 0.2 / 3
ALPHA = torch.ones(10, 12)
ALPHA[0], ALPHA[1], ABUNDANCES[0], LABELS[:2] = 0.0, 0.5, 0.0, 255
SPECTRA = ((ALPHA[..., None] * ABUNDANCES).double() @ ENDMEMBERS).float()
VIEW = ViewTruth("view", SPECTRA, torch.ones(10, 12, dtype=torch.bool), ALPHA, LABELS, ABUNDANCES)
"""Stripes of the materials, mixed a little, half covered along one edge, nothing beyond it."""


def perfect(order: list[int] = SHUFFLED) -> PredictedView:
    """What a model renders that knows the truth, its endmembers numbered in another order."""
    position = torch.zeros(256, dtype=torch.uint8)
    position[order] = torch.arange(len(order), dtype=torch.uint8)
    position[255] = 255
    composited = (ABUNDANCES * VIEW.opacity[..., None])[..., order]
    return PredictedView(VIEW.spectra, VIEW.opacity, composited, position[LABELS.long()], composited)


def evaluated(view: ViewTruth, predicted: PredictedView, order: list[int] = SHUFFLED) -> Evaluation:
    evaluation = Evaluation(SCENE, ENDMEMBERS[order])
    evaluation.add(view, predicted)
    return evaluation


def test_a_perfect_prediction_has_no_error_whatever_the_order_of_its_endmembers():
    figures = evaluated(VIEW, perfect()).figures()
    assert figures["psnr"] == figures["rgb_psnr"] == math.inf
    for name in ("rmse", "sam", "abundance_rmse", "endmember_angle"):
        assert figures[name] == pytest.approx(0.0, abs=1e-7), name
    for name in ("ssim", "miou", "macro_f1", "accuracy"):
        assert figures[name] == pytest.approx(1.0), name
    assert (figures["views"], figures["bands"]) == (1, 5)
    assert finite_or_none(figures)["psnr"] is None


def test_figures_without_truth_are_unknown_and_the_others_stay():
    """Half the light costs PSNR and no angle; a small image has no SSIM, and an empty one no PSNR of matter."""
    evaluation = Evaluation(SceneTruth(BANDS, 0), ENDMEMBERS)
    dim = replace(perfect([0, 1, 2]), spectra=VIEW.spectra * 0.5)
    evaluation.add(ViewTruth("view", VIEW.spectra, VIEW.valid), dim)
    figures = finite_or_none(evaluation.figures())
    unknown = {"psnr_white", "miou", "macro_f1", "accuracy", "abundance_rmse", "endmember_angle"}
    assert {name for name, value in figures.items() if value is None} == unknown
    assert figures["psnr"] == pytest.approx(psnr(VIEW.spectra * 0.5, VIEW.spectra))
    assert figures["sam"] == pytest.approx(0.0, abs=1e-7)
    flat, blank = torch.zeros(6, 9, 3), torch.zeros(6, 9)
    small = PredictedView(torch.rand(6, 9, 5), blank, flat, blank.byte(), flat)
    seen = ViewTruth("small", small.spectra, torch.ones(6, 9, dtype=torch.bool), blank)
    found = Evaluation(SCENE, ENDMEMBERS).add(seen, small)
    assert math.isnan(found["ssim"])
    assert math.isnan(found["psnr_matter"])


def test_the_angle_counts_labelled_or_opaque_pixels_only():
    spectra, order = VIEW.spectra.clone(), [0, 1, 2]
    spectra[:2] = spectra[:2].flip(-1)  # half covered and empty pixels
    predicted = replace(perfect(order), spectra=spectra)
    assert evaluated(VIEW, predicted, order).figures()["sam"] == pytest.approx(0.0, abs=1e-7)
    labelled = replace(VIEW, labels=torch.zeros_like(LABELS))
    found = evaluated(labelled, predicted, order).figures()["sam"]
    assert found == pytest.approx(sam(spectra, VIEW.spectra))
    assert found > 0.01


def test_invalid_pixels_count_for_nothing():
    valid = VIEW.valid.clone()
    valid[4:6] = False
    predicted = perfect()

    def spoil(values, wrong):
        return torch.where(valid if values.dim() == 2 else valid[..., None], values, wrong)

    spoilt = {name: getattr(predicted, name) for name in ("spectra", "accumulation", "abundances")}
    spoilt = {name: spoil(values, 1 - values) for name, values in spoilt.items()}
    ids = spoil(predicted.segmentation, (predicted.segmentation + 1) % 3)
    wrong = replace(predicted, segmentation=ids, **spoilt)
    figures = evaluated(replace(VIEW, valid=valid), wrong).figures()
    for name in ("rmse", "sam", "abundance_rmse"):
        assert figures[name] == pytest.approx(0.0, abs=1e-7), name
    assert figures["miou"] == 1.0
    assert evaluated(VIEW, wrong).figures()["miou"] < 1


def test_missing_matter_is_an_error_of_its_abundances():
    whole = perfect([0, 1, 2])
    thin = replace(whole, accumulation=whole.accumulation * 0.25, abundances=whole.abundances * 0.25)
    evaluation = evaluated(VIEW, thin, [0, 1, 2])
    assert evaluation.matching is not None
    expected = abundance_rmse(ABUNDANCES * 0.25, ABUNDANCES, evaluation.matching, VIEW.opacity >= 0.5)
    assert evaluation.figures()["abundance_rmse"] == pytest.approx(expected, rel=1e-6)
    assert expected > 0.3


def test_means_are_over_views_that_have_the_figure():
    evaluation = Evaluation(SCENE, ENDMEMBERS)
    dim = replace(perfect([0, 1, 2]), abundances=perfect([0, 1, 2]).abundances * 0.5)
    first = evaluation.add(VIEW, dim)["abundance_rmse"]
    assert first > 0.1
    second = evaluation.add(replace(VIEW, name="other", abundances=None), dim)["abundance_rmse"]
    assert math.isnan(second)
    assert evaluation.figures()["abundance_rmse"] == pytest.approx(first)
    assert set(evaluation.per_view) == {"view", "other"}
    assert evaluation.per_view["view"].keys() <= DEFINITIONS.keys()


def test_true_endmembers_are_reflectances_in_the_light_of_the_scene(tmp_path):
    make_demo_scene(tmp_path, 16, 8, 4)
    demo = load_scene(tmp_path, SceneOptions())
    lit, flat = (scene_truth(one).endmembers for one in (demo, replace(demo, illuminant=None)))
    assert lit is not None
    assert flat is not None
    torch.testing.assert_close(lit, flat * torch.from_numpy(demo.illuminant), rtol=1e-6, atol=0)
    assert not torch.allclose(lit, flat, rtol=1e-2)


def test_psnr_of_matter_leaves_the_background_and_invalid_and_blown_out_pixels_out():
    """A background that is rendered as black as it is raises PSNR, by however much there is of it."""
    matter = VIEW.shows_matter[..., None]
    flat = replace(VIEW, spectra=torch.where(matter, 0.5, VIEW.spectra))
    predicted = replace(perfect(), spectra=torch.where(matter, 0.4, VIEW.spectra))
    found = evaluated(flat, predicted).per_view["view"]
    assert found["psnr_matter"] == pytest.approx(20.0, abs=1e-4)
    assert found["psnr"] == pytest.approx(20.0 + 10 * math.log10(120 / 96), abs=1e-4)
    spoiled = replace(flat, spectra=flat.spectra.clone(), valid=flat.valid.clone())
    spoiled.spectra[5], spoiled.valid[5] = 1.0, False
    found = evaluated(spoiled, predicted).per_view["view"]
    assert found["psnr_matter"] == pytest.approx(20.0, abs=1e-4)
    measured = flat.spectra.clone()  # some pixels are blown out
    rows = VIEW.shows_matter.nonzero()[:4]
    measured[rows[:, 0], rows[:, 1], 0] = 0.95
    found = evaluated(replace(VIEW, spectra=measured), predicted).per_view["view"]
    assert found["psnr_matter_unsaturated"] == pytest.approx(20.0, abs=1e-4)
    assert found["psnr_matter"] < 19.9
    assert found["psnr"] < found["psnr_unsaturated"] - 0.1


def test_a_white_pixel_that_the_mask_calls_matter_is_right_over_white_if_nothing_is_there():
    """Gaps through which a white backdrop shows: an error on black, whatever a prediction without it does."""
    measured, alpha = VIEW.spectra.clone(), VIEW.opacity.clone()
    measured[4, 4], alpha[4, 4] = 1.0, 1.0
    gap = replace(VIEW, spectra=measured, alpha=alpha)
    seen, opacity = VIEW.spectra.clone(), VIEW.opacity.clone()
    seen[4, 4], opacity[4, 4] = 0.0, 0.0
    predicted = replace(perfect(), spectra=seen, accumulation=opacity)
    found = evaluated(gap, predicted).per_view["view"]
    assert found["psnr"] == pytest.approx(10 * math.log10(120), abs=1e-4)
    assert found["psnr_white"] == math.inf
    bare = evaluated(replace(gap, alpha=None), predicted).per_view["view"]
    assert math.isnan(bare["psnr_white"])


def test_a_view_is_measured_as_its_sensor_sees_it():
    sensor = SceneSensor("pair", np.array([[0.5, 0.5, 0, 0, 0], [0, 0, 0, 1.0, 0]]))
    spectra = torch.rand(10, 12, 5, generator=torch.Generator().manual_seed(4))
    measured = torch.stack([spectra[..., :2].mean(dim=-1), spectra[..., 3]], dim=-1)
    valid = torch.ones(10, 12, dtype=torch.bool)
    evaluation = Evaluation(SceneTruth(Bands.of([450, 500, 550, 600, 650]), 0), torch.rand(3, 5))
    flat = torch.zeros(10, 12)
    predicted = PredictedView(spectra, flat, torch.zeros(10, 12, 3), flat.byte(), torch.zeros(10, 12, 3))
    figures = evaluation.add(ViewTruth("a", measured, valid, sensor=sensor), predicted)
    assert figures["psnr"] > 100
    assert math.isnan(figures["rgb_psnr"])
    other = evaluation.add(ViewTruth("b", measured + 0.1, valid, sensor=sensor), predicted)
    assert other["psnr"] == pytest.approx(20, abs=0.01)
    assert evaluation.per_sensor() == {}
    evaluation.sensors.update(a="one", b="other")
    assert evaluation.per_sensor()["other"]["psnr"] == other["psnr"]
    relit = ViewTruth("a", measured, valid, sensor=sensor).in_light(np.array([1.0, 3.0, 0, 0.5, 0]))
    assert_close(relit.spectra, (measured * torch.tensor([2.0, 0.5])).clamp(max=1))


def test_views_counted_apart_and_merged_are_views_counted_together():
    """The second prediction has two materials exchanged, so that order and figures matter."""
    predictions = [perfect(order) for order in ([0, 1, 2], SHUFFLED, [0, 1, 2])]
    together, first, second = (Evaluation(SCENE, ENDMEMBERS) for _ in range(3))
    for name, predicted, part in zip("cab", predictions, (first, second, first), strict=True):
        together.add(replace(VIEW, name=name), predicted)
        part.add(replace(VIEW, name=name), predicted)
    first.merge([second], "cab")
    assert finite_or_none(first.figures()) == finite_or_none(together.figures())
    assert list(first.per_view) == ["c", "a", "b"]
    assert first.segmentation() == together.segmentation()


def test_pixels_that_were_measured_blown_out_stay_so_in_another_light_and_others_do_not_become_so():
    """A darker light in one band, a stronger one in the other: what the sensor could not tell is what was measured."""
    measured = torch.full((10, 12, 2), 0.4)
    measured[:3, :, 0] = 1.0
    view = ViewTruth("a", measured, torch.ones(10, 12, dtype=torch.bool))
    relit = view.in_light(np.array([0.5, 2.4]))
    assert float(relit.spectra[5, 5, 1]) > 0.9
    assert torch.equal(relit.blown_out, measured[..., 0] == 1.0)
    assert torch.equal(relit.in_light(np.array([1.5, 1.0])).blown_out, relit.blown_out)
    shown = relit.spectra.clone()
    shown[:3] -= 0.3
    flat = torch.ones(10, 12)
    predicted = PredictedView(shown - 0.01, flat, flat[..., None], flat.byte(), flat[..., None])
    figures = Evaluation(SceneTruth(Bands.of([500, 600]), 0), torch.ones(1, 2)).add(relit, predicted)
    assert figures["psnr_unsaturated"] == pytest.approx(40.0, abs=1e-2)
    assert figures["psnr"] < 20


def test_errors_of_bands_are_of_clamped_predictions_as_all_figures_are():
    bright = replace(perfect(), spectra=torch.full_like(VIEW.spectra, 3.0))
    evaluation = evaluated(VIEW, bright)
    errors = evaluation.bands["view"].mse
    assert errors == pytest.approx(((1 - VIEW.spectra.double()) ** 2).mean(dim=(0, 1)).numpy())
    assert math.sqrt(errors.mean()) == pytest.approx(evaluation.per_view["view"]["rmse"])
