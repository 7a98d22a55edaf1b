from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.factories.ball_model import INNER_RADIUS, RADIUS, ball_scene
from tests.factories.cameras import FRAME
from tests.factories.models import make_scene
from unmix_plugin.errors import ConfigError, RunError
from unmix_plugin.products.volume import write_volume
from unmix_plugin.trained.surface import GridPoints, sample_field

SCENE = ball_scene()
GRID = GridPoints.over(SCENE.scene_box.aabb, 16)


@pytest.fixture(scope="module")
def volume(tmp_path_factory):
    path = tmp_path_factory.mktemp("volume") / "volume.npz"
    write_volume(path, SCENE, GRID, FRAME, range(GRID.shape[0]))
    with np.load(path, allow_pickle=False) as arrays:
        return {name: arrays[name] for name in arrays.files}


def positions(volume):
    """World points of the grid, by the file's own matrix."""
    indices = np.stack(np.meshgrid(*map(np.arange, volume["density"].shape), indexing="ij"), axis=-1)
    return (indices @ volume["index_to_world"][:3, :3].T) + volume["index_to_world"][:3, 3]


def test_the_matrix_leads_from_indices_to_the_world_of_the_scene(volume):
    radius = np.linalg.norm(FRAME.to_model(positions(volume)), axis=-1)
    solid = volume["density"] > 1e-3
    assert volume["density"].shape == (17, 17, 17)
    between = (radius > INNER_RADIUS + 0.06) & (radius < RADIUS - 0.06)
    assert between.sum() > 50
    assert solid[between].all()
    assert not solid[(radius < INNER_RADIUS - 0.06) | (radius > RADIUS + 0.06)].any()


def test_densities_are_per_world_unit_and_abundances_those_of_the_field(volume):
    places = torch.from_numpy(FRAME.to_model(positions(volume))).float().reshape(-1, 3)
    density, features = SCENE.field.get_density(places)
    np.testing.assert_allclose(volume["density"].ravel(), FRAME.scale * density.numpy(), rtol=1e-3, atol=1e-4)
    expected = SCENE.field.abundances_of(features).numpy()
    found = volume["abundances"].reshape(-1, 3)
    clear = (places[:, 2].abs() > 1e-4).numpy()
    np.testing.assert_array_equal(found[clear], expected[clear])
    assert (volume["density"].dtype, volume["abundances"].dtype) == (np.float32, np.float32)
    assert volume["endmember_names"].tolist() == list(SCENE.materials.names)
    np.testing.assert_array_equal(volume["endmembers"], SCENE.materials.endmembers.numpy())
    np.testing.assert_array_equal(volume["wavelengths_nm"], SCENE.bands.centers_nm)


def test_what_is_never_rendered_is_empty():
    scene = make_scene()
    skips = torch.ones(8, 8, 8, dtype=torch.uint8)
    skips[:4] = 0
    scene = replace(scene, renderer=replace(scene.renderer, skips=skips))
    grid = GridPoints.over(scene.scene_box.aabb, 8)
    density, shares = sample_field(scene, torch.stack([grid.slice_points(i) for i in range(9)]))
    assert density[:4].min() > 0
    np.testing.assert_allclose(shares[:4].sum(dim=-1), 1, atol=1e-5)
    assert not density[4:].any()
    assert not shares[4:].any()
    places = torch.tensor([[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0], [-1.5, 0.0, 0.0], [-1.0, 1.0, -1.0]])
    assert scene.renderer.is_occupied(places).tolist() == [True, False, False, True]
    assert (sample_field(scene, places)[0] > 0).tolist() == [True, False, False, True]


def test_a_grid_has_its_cells_along_the_longest_edge_and_stays_in_the_box():
    aabb = torch.tensor([[-1.0, -0.5, 0.0], [1.0, 0.27, 0.05]])
    grid = GridPoints.over(aabb, 20)
    assert (grid.cell, grid.shape) == (pytest.approx(0.1), (21, 8, 1))
    points = grid.slice_points(20)
    assert points.shape == (8, 1, 3)
    np.testing.assert_allclose(points[:, 0, 0], 1.0)
    assert bool((points <= aabb[1] + 1e-6).all())
    for resolution in (0, 7, 1025):
        with pytest.raises(ConfigError, match=f"--resolution is {resolution}; choose 8 to 1024"):
            GridPoints.over(aabb, resolution)


def test_a_disk_that_is_full_half_way_leaves_nothing(tmp_path):
    def slices():
        yield 0
        raise OSError(28, "No space left on device")

    with pytest.raises(RunError, match=r"volume\.npz: No space left on device"):
        write_volume(tmp_path / "volume.npz", SCENE, GRID, FRAME, slices())
    assert list(tmp_path.iterdir()) == []
