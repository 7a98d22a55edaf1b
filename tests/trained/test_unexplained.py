"""What no mixture of the materials gives is found where it was measured, and nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.factories.models import CAMERA, NUM_BANDS, make_scene
from unmix_plugin.errors import ConfigError, RunError
from unmix_plugin.spectral.library.spectra_csv import read_spectra
from unmix_plugin.trained.trained_scene import TrainedScene
from unmix_plugin.trained.training_views import ThinnedView
from unmix_plugin.trained.unexplained import (
    SPECTRA_NAME,
    Unexplained,
    find_unexplained,
    read_unexplained,
    write_unexplained,
)
from unmix_plugin.trained.unexplained_map import FILE_NAME, UnexplainedMap, read_unexplained_map

SCENE = make_scene(light=[0.5, 0.7, 1.0, 0.9, 0.6])
SIZE, EDGE = 32, 0.02


def floor_views(retouch: np.ndarray | None = None, count: int = 5, noise: float = 0.003) -> list[ThinnedView]:
    """Views of a floor of changing mixtures, each shaded otherwise and with noise; a square of 5 x 5 pixels shows the
    retouch, if there is one."""
    generator = np.random.default_rng(0)
    rows, columns = np.mgrid[:SIZE, :SIZE]
    points = np.stack([columns * EDGE - 0.3, rows * EDGE - 0.3, np.zeros((SIZE, SIZE))], axis=-1)
    endmembers = SCENE.materials.endmembers.double().numpy()
    fractions = np.random.default_rng(1).dirichlet(np.ones(len(endmembers)), (SIZE, SIZE))
    views = []
    for number in range(count):
        spectra = 0.6 * fractions @ endmembers
        if retouch is not None:
            spectra[2:7, 3:8] = retouch
        spectra *= generator.uniform(0.7, 1.0, (SIZE, SIZE, 1))
        spectra += noise * generator.standard_normal(spectra.shape)
        full = np.ones((SIZE, SIZE))
        views.append(
            ThinnedView(
                name=f"view_{number}",
                measured=spectra,
                rendered=spectra,
                counts=full > 0,
                is_whole=full > 0,
                blown_out=full < 0,
                opacity=full,
                abundances=fractions,
                points=points,
                pixel=EDGE * full,
            )
        )
    return views


def found_in(views: list[ThinnedView], scene: TrainedScene = SCENE) -> Unexplained:
    """What is found where there is something to judge."""
    found = find_unexplained(scene, views)
    assert found is not None
    return found


def odd_spectrum() -> np.ndarray:
    """A spectrum that no mixture of the scene's endmembers comes near."""
    endmembers = SCENE.materials.endmembers.double().numpy()
    candidates = np.eye(NUM_BANDS)
    cosines = (candidates @ endmembers.T / np.linalg.norm(endmembers, axis=1)).max(axis=1)
    return 0.4 * candidates[cosines.argmin()] + 0.02


def test_a_retouch_is_one_patch_where_it_is_with_the_spectrum_that_was_measured():
    found = found_in(floor_views(odd_spectrum()))
    [patch] = found.patches
    middle = SCENE.frame.to_model(patch.position[None])[0]
    np.testing.assert_allclose(middle, [5 * EDGE - 0.3, 4 * EDGE - 0.3, 0], atol=1.5 * EDGE)
    assert patch.surface == pytest.approx(25 / SIZE**2, rel=0.3)
    assert patch.num_views == 5
    cosine = patch.spectrum @ odd_spectrum() / np.linalg.norm(patch.spectrum) / np.linalg.norm(odd_spectrum())
    assert cosine > 0.999
    assert found.median < 0.01
    on, off = torch.tensor(middle).float(), torch.tensor([0.2, 0.2, 0.0])
    assert found.map.at(on[None])[0] > 0.1 > found.map.at(off[None])[0]
    assert found.map.at(torch.tensor([[9.0, 9.0, 9.0]])).isnan().all()


def test_mixtures_noise_and_shade_are_no_patches():
    assert found_in(floor_views()).patches == ()
    assert found_in(floor_views(noise=0.05)).patches == ()
    mixture = 0.3 * SCENE.materials.endmembers[:2].double().numpy().sum(axis=0)
    assert found_in(floor_views(mixture)).patches == ()


def test_what_fewer_than_three_views_see_is_not_judged():
    assert find_unexplained(SCENE, floor_views(odd_spectrum(), count=2)) is None
    assert find_unexplained(SCENE, []) is None


def test_nothing_is_said_of_endmembers_that_had_too_few_rays_to_settle():
    views = floor_views(odd_spectrum())
    num_pixels = sum(view.counts.size for view in views)
    assert find_unexplained(SCENE, views, 2 * num_pixels) is None
    assert find_unexplained(SCENE, views, 4 * num_pixels) is not None


def test_materials_that_explain_nothing_well_are_said_to_be_too_few(tmp_path):
    one = replace(
        SCENE, materials=replace(SCENE.materials, endmembers=SCENE.materials.endmembers[:1], names=("a",))
    )
    found = found_in(floor_views(), one)
    [sentence] = found.in_words(tmp_path)
    assert "more than --endmembers 1" in sentence


def test_what_a_run_keeps_is_read_again_and_offers_the_patch_as_a_material(tmp_path):
    found = found_in(floor_views(odd_spectrum()))
    assert read_unexplained(tmp_path) is None
    write_unexplained(tmp_path, found, SCENE.materials)
    again = read_unexplained(tmp_path)
    assert again is not None
    assert SCENE.materials.light is not None
    assert again.in_words(tmp_path) == found.in_words(tmp_path)
    np.testing.assert_array_equal(again.map.cells, found.map.cells)
    table = read_spectra(tmp_path / SPECTRA_NAME)
    assert table.names == (*SCENE.materials.names, "unexplained 1")
    light = SCENE.materials.light.double().numpy()
    np.testing.assert_allclose(table.spectra[-1] * light, found.patches[0].spectrum.clip(0), rtol=1e-5)


def test_the_map_is_an_output_of_scenes_that_have_one():
    assert "unexplained" not in [output.name for output in SCENE.outputs]
    with pytest.raises(ConfigError, match="what the training views measured"):
        SCENE.output("unexplained")
    everywhere = UnexplainedMap(np.full(3, -4.0), 8.0, np.zeros((1, 3), int), np.full(1, 0.25, np.float32))
    scene = replace(SCENE, unexplained=everywhere)
    assert "unexplained" in [output.name for output in scene.outputs]
    view = scene.look(CAMERA)
    values = view["unexplained"]
    is_there = view.coefficients.is_occupied
    assert values[~is_there].isnan().all()
    torch.testing.assert_close(values[is_there], torch.full_like(values[is_there], 0.25))


def test_a_damaged_map_is_refused(tmp_path):
    (tmp_path / FILE_NAME).write_bytes(b"PK")
    with pytest.raises(RunError, match="damaged"):
        read_unexplained_map(tmp_path)
