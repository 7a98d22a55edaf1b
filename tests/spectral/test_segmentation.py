import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from tests.factories.mixtures import seeded, smooth_endmembers
from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.segmentation import SegmentationTally, material_ids, material_scores


def labels(*values):
    return torch.tensor(values, dtype=torch.uint8)


def scored(num_pred, num_true, *views):
    tally = SegmentationTally(num_pred, num_true)
    for pred, true in views:
        tally.add(pred, true)
    return tally.scores()


@given(st.floats(0.01, 100), st.floats(0.01, 100))
def test_scores_are_cosines_blind_to_brightness_and_0_of_nothing(gain, endmember_gain):
    endmembers = smooth_endmembers(4)
    pixels = torch.rand(2, 3, 24, dtype=torch.float64, generator=seeded())
    expected = torch.einsum("hwb,kb->hwk", pixels, endmembers)
    expected = expected / (pixels.norm(dim=-1)[..., None] * endmembers.norm(dim=-1))
    assert_close(material_scores(gain * pixels, endmember_gain * endmembers), expected)
    assert not material_scores(torch.zeros(2, 24).double(), endmembers).any()


def test_ids_are_the_best_score_where_something_is():
    scores = torch.tensor([[0.1, 0.9, 0.3], [0.8, 0.2, 0.7], [0.1, 0.2, 0.3]])
    accumulations = torch.tensor([1.0, 0.5, 0.499])
    assert material_ids(scores, accumulations).tolist() == [1, 0, 255]
    assert material_ids(scores, accumulations, threshold=0.1).tolist() == [1, 0, 2]
    assert material_ids(scores, accumulations).dtype == torch.uint8


@given(st.permutations(range(4)), st.integers(0, 99))
def test_renamed_labels_score_perfectly(order, seed):
    true = torch.randint(0, 4, (6, 7), generator=seeded(seed)).to(torch.uint8)
    scores = scored(4, 4, (labels(*order)[true.long()], true))
    assert (scores.miou, scores.macro_f1, scores.accuracy) == (1, 1, 1)
    present = true.unique().tolist()
    assert all(scores.matching[order[m]] == m for m in present)


@pytest.mark.parametrize(
    ("pred", "true", "numbers", "matching", "iou", "macro_f1", "accuracy"),
    [
        ("11100001", "00001111", (2, 2), {1: 0, 0: 1}, {0: 3 / 5, 1: 3 / 5}, 6 / 8, 6 / 8),
        # Materials count equally in means, pixels in accuracy.
        ("0000000001", "0000000011", (2, 2), {0: 0, 1: 1}, {0: 8 / 9, 1: 1 / 2}, (16 / 17 + 2 / 3) / 2, 0.9),
        # Pixels without labels are ignored, missed ones are not.
        ("0.0111", "00..11", (2, 2), {0: 0, 1: 1}, {0: 1 / 2, 1: 1}, (2 / 3 + 1) / 2, 3 / 4),
        # A surplus id is a miss of the material that it covers.
        ("200011", "000011", (3, 2), {0: 0, 1: 1}, {0: 3 / 4, 1: 1}, (6 / 7 + 1) / 2, 5 / 6),
        # A material without an id scores 0: ids that share no pixel with it are not matched to it.
        ("0002", "001.", (3, 2), {0: 0}, {0: 2 / 3, 1: 0}, (4 / 5) / 2, 2 / 3),
        # Of two materials of one id the larger has it.
        ("0011111", "0011122", (2, 3), {0: 0, 1: 1}, {0: 1, 1: 3 / 5, 2: 0}, (1 + 6 / 8) / 3, 5 / 7),
        # Materials that never occur are left out of means.
        ("331", "552", (4, 9), {3: 5, 1: 2}, {5: 1, 2: 1}, 1, 1),
        ("01", "..", (2, 2), {}, {}, math.nan, math.nan),
    ],
)
def test_figures_of_small_scenes_counted_by_hand(pred, true, numbers, matching, iou, macro_f1, accuracy):
    """A point is 255."""
    views = (labels(*(255 if pixel == "." else int(pixel) for pixel in view)) for view in (pred, true))
    scores = scored(*numbers, tuple(views))
    assert scores.matching == matching
    assert scores.iou == pytest.approx(iou)
    mean = sum(iou.values()) / len(iou) if iou else math.nan
    figures = (scores.miou, scores.macro_f1, scores.accuracy)
    assert figures == pytest.approx((mean, macro_f1, accuracy), nan_ok=True)


def test_matching_is_on_intersection_over_union_not_on_hits():
    # By hits 0-0 and 1-1 win (0 + 7 against 2 + 4 pixels); by IoU the other way round does.
    scores = scored(2, 2, (labels(*[0] * 2, *[1] * 11), labels(*[1] * 2, *[0] * 4, *[1] * 7)))
    straight, crossed = (0 + 7 / 13) / 2, (2 / 9 + 4 / 11) / 2
    assert crossed > straight
    assert scores.matching == {0: 1, 1: 0}
    assert scores.miou == pytest.approx(crossed)


@given(st.integers(0, 500))
def test_views_fed_one_by_one_count_as_one_scene(seed):
    pred = torch.randint(0, 5, (4, 9), generator=seeded(seed)).to(torch.uint8)
    true = torch.randint(0, 4, (4, 9), generator=seeded(seed + 1)).to(torch.uint8)
    pred[pred == 4], true[:, 0] = 255, 255
    assert scored(4, 4, *zip(pred, true, strict=True)) == scored(4, 4, (pred, true))


def test_one_matching_serves_all_views():
    # Each view alone would be perfect under its own matching; the scene as a whole is half wrong.
    views = (labels(0, 1, 1), labels(0, 1, 1)), (labels(1, 0, 0), labels(0, 1, 1))
    assert scored(2, 2, *views).accuracy == pytest.approx(0.5)


def test_the_confusion_matrix_has_predicted_ids_in_rows_and_missed_pixels_in_the_last():
    tally = SegmentationTally(2, 3)
    tally.add(labels(1, 1, 255, 0), labels(2, 2, 1, 255))
    assert tally.confusion.tolist() == [[0, 0, 0], [0, 0, 2], [0, 1, 0]]


def test_ids_beyond_the_declared_numbers_or_eight_bits_are_refused():
    tally = SegmentationTally(2, 3)
    with pytest.raises(SpectrumError, match=r"predicted ids must be below 2 or 255; found 2 in 1 pixel$"):
        tally.add(labels(0, 2), labels(0, 2))
    with pytest.raises(SpectrumError, match="true labels must be below 3 or 255; found 7 in 2 pixels"):
        tally.add(labels(0, 1), labels(7, 7))
    with pytest.raises(SpectrumError, match="between 1 and 255; found 256"):
        material_ids(torch.zeros(1, 256), torch.ones(1))
    with pytest.raises(SpectrumError, match="found 0"):
        SegmentationTally(0, 3)
