import numpy as np

from unmix_plugin.captures.poses.estimation import (
    contrast_picture,
    mean_weights,
    stretch,
    without_rim,
)


def test_dark_texture_uses_the_whole_range_and_what_does_not_count_is_black():
    generator = np.random.default_rng(0)
    values = generator.uniform(0.01, 0.02, (64, 80)).astype(np.float32)
    valid = np.ones((64, 80), bool)
    valid[:, :20] = False
    values[:, :20], values[5, 50] = 9.0, np.nan
    picture = stretch(values, valid)
    assert not picture[:, :20].any()
    assert picture[5, 50] == 0
    counted = picture[:, 20:]
    assert counted.max() - np.percentile(counted, 5) > 150


def test_a_flat_or_empty_picture_is_no_noise():
    assert np.unique(stretch(np.full((8, 8), 0.3, np.float32))).tolist() == [128]
    assert not stretch(np.full((8, 8), np.nan, np.float32)).any()


def test_a_cube_is_read_in_rows_and_bad_bands_do_not_count():
    generator = np.random.default_rng(1)
    cube = generator.uniform(0, 1, (150, 20, 3)).astype(np.float32)
    cube[..., 1] = np.nan
    read = []

    def read_rows(rows):
        read.append(rows.stop - rows.start)
        return cube[rows]

    weights = mean_weights(np.array([True, False, True]))
    picture = contrast_picture(read_rows, (150, 20), weights)
    np.testing.assert_array_equal(picture, stretch(cube[..., [0, 2]].mean(-1)))
    assert sum(read) == 150
    assert max(read) < 150


def test_the_rim_of_a_mask_is_left_out():
    mask = np.zeros((20, 20), bool)
    mask[5:15, 5:15] = True
    assert without_rim(mask, 2).sum() == 36
