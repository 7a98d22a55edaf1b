"""Views of the built-in scene and the truth that comes with them."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tests.scenes.demo.demo_parts import LAMP, PLACEMENTS
from unmix_plugin.scenes.demo.scene import demo_cameras, label_image, radiance_cube
from unmix_plugin.scenes.demo.shading import (
    MATERIALS,
    band_centers_nm,
    lamp_power,
    reflectances,
    render_view,
    trace,
)
from unmix_plugin.scenes.demo.shapes import first_hits


@pytest.fixture(scope="module")
def view():
    """One evaluation view at a size where every material and every kind of pixel occurs."""
    return render_view(demo_cameras(48, 8), 2)


def spectral_angle(a, b):
    return np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1))


def spectra_of(bands):
    wavelengths = band_centers_nm(bands)
    return reflectances(wavelengths), lamp_power(wavelengths)


def test_a_lit_matt_pixel_of_one_material_is_reflectance_times_lamp_times_shading(view):
    spectra, lamp = spectra_of(31)
    cube = radiance_cube(view, spectra, lamp)
    for k in range(len(MATERIALS)):
        pure = (view.alpha == 1) & (view.abundances[..., k] > 0.9999) & (view.specular == 0)
        if MATERIALS[k] == "green":  # the glossy apple only: no pixel of it is without a trace of highlight
            continue
        assert pure.any(), MATERIALS[k]
        shading = view.diffuse[pure][:, k]
        assert_allclose(cube[pure], shading[:, None] * (spectra[k] * lamp), atol=1e-4)
        assert ((shading > 0) & (shading <= 1.05)).all()


def test_what_a_highlight_adds_to_the_same_point_has_the_lamps_colour():
    spectra, lamp = spectra_of(31)
    rays = demo_cameras(64, 8).image_rays(2)
    origins, directions = rays.origins.numpy(), rays.directions.numpy()
    brightest = trace(origins, directions, LAMP[None]).specular.argmax()
    distances, _ = first_hits(PLACEMENTS, origins, directions)
    point = origins[brightest] + distances[brightest] * directions[brightest]
    eyes = np.stack([origins[brightest], point + 2 * np.array([0, 0.3, 1], dtype=np.float32)])
    towards = (point - eyes) / np.linalg.norm(point - eyes, axis=1, keepdims=True)
    seen = trace(eyes, towards.astype(np.float32), LAMP[None])
    assert seen.specular[0] > 0.5
    assert seen.specular[1] < 0.1
    radiances = (seen.diffuse @ spectra + seen.specular[:, None]) * lamp
    assert spectral_angle(radiances[0] - radiances[1], lamp) < 0.01
    assert spectral_angle(radiances[1], lamp) > 0.2


def test_two_cameras_see_the_same_diffuse_light_at_the_same_point():
    cameras = demo_cameras(32, 8)
    rays = cameras.image_rays(0)
    origins, directions = rays.origins.numpy(), rays.directions.numpy()
    distances, _ = first_hits(PLACEMENTS, origins, directions)
    points = (origins + distances[:, None] * directions)[np.isfinite(distances)]
    seen = trace(origins, directions, LAMP[None])
    eye = cameras.camera_to_world[5, :, 3].numpy()
    lengths = np.linalg.norm(points - eye, axis=1)
    towards = (points - eye) / lengths[:, None]
    others, _ = first_hits(PLACEMENTS, np.broadcast_to(eye, points.shape), towards)
    common = np.abs(others - lengths) < 1e-4
    assert common.sum() > 50
    again = trace(np.broadcast_to(eye, points.shape)[common], towards[common], LAMP[None])
    first = seen.diffuse[seen.is_hit][common]
    # A shadow's border can fall to either side by rounding.
    assert np.mean(np.abs(again.diffuse - first).max(axis=1) < 2e-3) > 0.98


def test_abundances_lie_on_the_simplex_where_something_is(view):
    sums = view.abundances.sum(axis=-1)
    assert (view.abundances >= 0).all()
    assert_allclose(sums[view.alpha > 0], 1, atol=1e-5)
    assert (sums[view.alpha == 0] == 0).all()


def test_labels_are_the_largest_abundance_where_half_a_pixel_is_covered(view):
    labels = label_image(view)
    labelled = view.alpha >= 0.5
    assert (labels[~labelled] == 255).all()
    assert (labels[labelled] == view.abundances[labelled].argmax(axis=-1)).all()
    assert set(np.unique(labels[labelled])) == set(range(len(MATERIALS)))


def test_a_view_has_pure_pixels_mixed_pixels_and_soft_edges(view):
    largest = view.abundances.max(axis=-1)[view.alpha == 1]
    assert 0.1 < np.mean(largest < 0.95) < 0.8
    assert np.mean(largest > 0.999) > 0.15
    assert ((view.alpha > 0) & (view.alpha < 1)).sum() > 50


def test_materials_are_told_apart_by_their_spectra_under_the_lamp():
    spectra, lamp = spectra_of(31)
    angles = [spectral_angle(a * lamp, b * lamp) for i, a in enumerate(spectra) for b in spectra[:i]]
    assert min(angles) > 0.45


def test_a_highlight_is_brighter_than_the_matt_surface_yet_nothing_saturates_beside_it(view):
    spectra, lamp = spectra_of(31)
    unclipped = (view.diffuse @ spectra + view.specular[..., None]) * lamp
    assert view.specular.max() > 0.2
    assert np.mean(unclipped.max(axis=-1) > 1) < 0.01
