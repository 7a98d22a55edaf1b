import numpy as np
import pytest
import torch

from tests.factories.files import present
from tests.factories.scenes import make_rig
from unmix_plugin.scenes import pixel_table
from unmix_plugin.scenes.pixel_table import PixelTable
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.settings import SceneOptions

CPU = torch.device("cpu")


@pytest.fixture
def rig(tmp_path):
    folder = make_rig(tmp_path / "rig")
    folder.edit_cube(4, lambda cube: np.concatenate([np.full_like(cube[:2], np.nan), cube[2:]]))
    return load_scene(folder.root, SceneOptions(invalid_pixels="mask"))


def test_drawn_pixels_are_those_of_their_views(rig):
    table = PixelTable(rig, CPU, (1, 3, 4, 5))
    assert len(table) == 320 + 80 + 80 + 320
    groups = table.draw(500, torch.Generator().manual_seed(1))
    assert [group.sensor for group in groups] == [0, 1, 2]
    assert sum(len(group.cameras) for group in groups) == 500
    for group in groups:
        places = zip(group.cameras.tolist(), group.corners.tolist(), group.spectra, group.alpha, strict=True)
        for camera, (column, row), spectrum, alpha in places:
            view = (1, 3, 4, 5)[camera]
            assert rig.frames[view].sensor == group.sensor
            assert rig.valid_mask(view)[row, column]
            np.testing.assert_array_equal(spectrum, rig.cube(view)[row, column])
            assert alpha == present(rig.alpha(view))[row, column]
    numbers = torch.cat([group.numbers for group in groups])
    places = torch.cat([torch.cat([g.cameras[:, None], g.corners], dim=1) for g in groups])
    assert len(numbers.unique()) == len(places.unique(dim=0))


def test_every_valid_pixel_comes_up_equally_often(rig):
    table = PixelTable(rig, CPU, (1, 3, 4, 5))
    valid = 320 + 80 + 60 + 320
    assert table.shares == {0: 320 / valid, 1: 140 / valid, 2: 320 / valid}
    groups = table.draw(200 * valid, torch.Generator().manual_seed(0))
    counts = torch.bincount(torch.cat([group.numbers for group in groups]), minlength=len(table))
    assert int((counts == 0).sum()) == 20
    drawn = counts[counts > 0].double()
    assert abs(float(drawn.var()) / 200 - 1) < 0.2  # as a Poisson distribution has it
    assert float((drawn - 200).abs().max()) < 6 * 200**0.5


def test_pixels_are_drawn_by_the_shares_that_are_asked_for(rig):
    table = PixelTable(rig, CPU, (1, 3, 4, 5))
    shares = {0: 0.2, 1: 0.8, 2: 0.0}
    groups = table.draw(5000, torch.Generator().manual_seed(0), shares=shares)
    assert [group.sensor for group in groups] == [0, 1]
    assert abs(len(groups[0].cameras) - 1000) < 5 * 1000**0.5
    assert len(groups[0].cameras) + len(groups[1].cameras) == 5000
    assert len(groups[1].numbers.unique()) == 140


def test_opaque_pixels_are_sampled_of_one_sensor_and_of_large_blocks_from_some(rig, monkeypatch):
    pixels = PixelTable(rig, CPU, (1, 3, 4, 5)).sample_opaque(1, 12, seed=0)
    assert pixels.shape == (12, 2)
    np.testing.assert_allclose(pixels[:, 1], 0.25 * pixels[:, 0], atol=1e-3)
    everything = PixelTable(rig, CPU, (3, 4)).sample_opaque(1, 1000, seed=0)
    monkeypatch.setattr(pixel_table, "_MOST_LISTED", 100)
    table = PixelTable(rig, CPU, (3, 4))
    found = table.sample_opaque(1, 1000, seed=0)
    assert 0 < len(found) < 13
    assert {tuple(row) for row in found.tolist()} <= {tuple(row) for row in everything.tolist()}
    np.testing.assert_array_equal(table.sample_opaque(1, 1000, seed=0), found)
