import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from tests.spectral.mixtures import seeded, smooth_endmembers
from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.segmentation import SegmentationTally, material_ids, material_scores


def labels(*values):
    return torch.tensor(values, dtype=torch.uint8)


def scored(pred, true, num_pred, num_true):
    tally = SegmentationTally(num_pred, num_true)
    tally.add(pred, true)
    return tally.scores()


@given(st.floats(0.01, 100), st.floats(0.01, 100))
def test_scores_are_cosines_blind_to_brightness(gain, endmember_gain):
    endmembers = smooth_endmembers(4)
    pixels = torch.rand(2, 3, 24, dtype=torch.float64, generator=seeded())
    expected = torch.einsum("hwb,kb->hwk", pixels, endmembers)
    expected = expected / (pixels.norm(dim=-1)[..., None] * endmembers.norm(dim=-1))
    assert_close(material_scores(gain * pixels, endmember_gain * endmembers), expected)


def test_a_zero_spectrum_scores_zero():
    assert_close(material_scores(torch.zeros(2, 24), smooth_endmembers(3).float()), torch.zeros(2, 3))


def test_ids_are_the_best_score_where_something_is():
    scores = torch.tensor([[0.1, 0.9, 0.3], [0.8, 0.2, 0.7], [0.1, 0.2, 0.3]])
    accumulations = torch.tensor([1.0, 0.5, 0.499])
    assert material_ids(scores, accumulations).tolist() == [1, 0, 255]
    assert material_ids(scores, accumulations, threshold=0.1).tolist() == [1, 0, 2]
    assert material_ids(scores, accumulations).dtype == torch.uint8


@given(st.permutations(range(4)), st.integers(0, 99))
def test_renamed_labels_score_perfectly(order, seed):
    true = torch.randint(0, 4, (6, 7), generator=seeded(seed)).to(torch.uint8)
    scores = scored(labels(*order)[true.long()], true, 4, 4)
    assert (scores.miou, scores.macro_f1, scores.accuracy) == (1, 1, 1)
    present = true.unique().tolist()
    assert all(scores.matching[order[m]] == m for m in present)


def test_figures_of_a_small_scene_counted_by_hand():
    pred = labels(1, 1, 1, 0, 0, 0, 0, 1)
    true = labels(0, 0, 0, 0, 1, 1, 1, 1)
    scores = scored(pred, true, 2, 2)
    assert scores.matching == {1: 0, 0: 1}
    assert scores.iou == {0: pytest.approx(3 / 5), 1: pytest.approx(3 / 5)}
    assert scores.miou == pytest.approx(3 / 5)
    assert scores.macro_f1 == pytest.approx(6 / 8)
    assert scores.accuracy == pytest.approx(6 / 8)


def test_materials_count_equally_in_means_and_pixels_in_accuracy():
    true = labels(*[0] * 8, *[1] * 2)
    pred = labels(*[0] * 8, 0, 1)
    scores = scored(pred, true, 2, 2)
    assert scores.miou == pytest.approx((8 / 9 + 1 / 2) / 2)
    assert scores.macro_f1 == pytest.approx((16 / 17 + 2 / 3) / 2)
    assert scores.accuracy == pytest.approx(0.9)


def test_unlabelled_pixels_are_ignored_and_missed_ones_are_not():
    true = labels(0, 0, 255, 255, 1, 1)
    pred = labels(0, 255, 0, 1, 1, 1)
    scores = scored(pred, true, 2, 2)
    assert scores.iou == {0: 0.5, 1: 1}
    assert scores.accuracy == pytest.approx(3 / 4)
    assert scores.macro_f1 == pytest.approx((2 / 3 + 1) / 2)


def test_a_surplus_id_is_a_miss_of_the_material_it_covers():
    true = labels(0, 0, 0, 0, 1, 1)
    pred = labels(2, 0, 0, 0, 1, 1)
    scores = scored(pred, true, 3, 2)
    assert scores.iou == {0: 0.75, 1: 1}
    assert 2 not in scores.matching
    assert scores.accuracy == pytest.approx(5 / 6)


def test_a_material_without_an_id_scores_zero():
    true = labels(0, 0, 1, 1, 2, 2)
    pred = labels(0, 0, 1, 1, 1, 1)
    scores = scored(pred, true, 2, 3)
    assert sorted(scores.iou.values()) == [0, 0.5, 1]
    assert scores.miou == pytest.approx(0.5)
    assert scores.macro_f1 == pytest.approx((1 + 2 / 3) / 3)


def test_materials_that_never_occur_are_left_out_of_means():
    scores = scored(labels(3, 3, 1), labels(5, 5, 2), 4, 9)
    assert (scores.miou, scores.accuracy, scores.matching) == (1, 1, {3: 5, 1: 2})


def test_matching_is_on_intersection_over_union_not_on_hits():
    # By hits 0-0 and 1-1 win (0 + 7 against 2 + 4 pixels); by IoU the other way round does.
    tally = SegmentationTally(2, 2)
    for pred, true, count in ((0, 1, 2), (1, 0, 4), (1, 1, 7)):
        tally.add(
            torch.full((count,), pred, dtype=torch.uint8), torch.full((count,), true, dtype=torch.uint8)
        )
    scores = tally.scores()
    straight, crossed = (0 + 7 / 13) / 2, (2 / 9 + 4 / 11) / 2
    assert crossed > straight
    assert scores.matching == {0: 1, 1: 0}
    assert scores.miou == pytest.approx(crossed)


@given(st.integers(0, 500))
def test_views_fed_one_by_one_count_as_one_scene(seed):
    pred = torch.randint(0, 5, (4, 9), generator=seeded(seed)).to(torch.uint8)
    true = torch.randint(0, 4, (4, 9), generator=seeded(seed + 1)).to(torch.uint8)
    pred[pred == 4], true[:, 0] = 255, 255
    tally = SegmentationTally(4, 4)
    for view in range(4):
        tally.add(pred[view], true[view])
    assert tally.scores() == scored(pred, true, 4, 4)
    assert int(tally.confusion.sum()) == int((true != 255).sum())


def test_ids_that_share_no_pixel_with_a_material_are_not_matched_to_it():
    """They would be shown in its colour, under its name."""
    scores = scored(labels(0, 0, 0, 2), labels(0, 0, 1, 255), 3, 2)
    assert scores.matching == {0: 0}
    assert (scores.miou, scores.accuracy) == (pytest.approx(1 / 3), pytest.approx(2 / 3))


def test_one_matching_serves_all_views():
    # Each view alone would be perfect under its own matching; the scene as a whole is half wrong.
    tally = SegmentationTally(2, 2)
    tally.add(labels(0, 1, 1), labels(0, 1, 1))
    tally.add(labels(1, 0, 0), labels(0, 1, 1))
    assert tally.scores().accuracy == pytest.approx(0.5)


def test_the_confusion_matrix_names_rows_and_columns():
    tally = SegmentationTally(2, 3)
    tally.add(labels(1, 1, 255, 0), labels(2, 2, 1, 255))
    assert tally.confusion.tolist() == [[0, 0, 0], [0, 0, 2], [0, 1, 0]]


def test_a_scene_without_labels_has_no_figures():
    scores = scored(labels(0, 1), labels(255, 255), 2, 2)
    assert math.isnan(scores.miou)
    assert math.isnan(scores.macro_f1)
    assert math.isnan(scores.accuracy)
    assert scores.matching == {}


def test_ids_beyond_the_declared_numbers_are_refused():
    tally = SegmentationTally(2, 3)
    with pytest.raises(SpectrumError, match=r"predicted ids must be below 2 or 255; found 2 in 1 pixel$"):
        tally.add(labels(0, 2), labels(0, 2))
    with pytest.raises(SpectrumError, match="true labels must be below 3 or 255; found 7 in 2 pixels"):
        tally.add(labels(0, 1), labels(7, 7))


def test_more_materials_than_eight_bits_hold_are_refused():
    with pytest.raises(SpectrumError, match="between 1 and 255; found 256"):
        material_ids(torch.zeros(1, 256), torch.ones(1))
    with pytest.raises(SpectrumError, match="found 0"):
        SegmentationTally(0, 3)
