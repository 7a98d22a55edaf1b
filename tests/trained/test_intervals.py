"""Intervals of what a scene shows: as many hold what is true as they say, and where nothing is known they say so."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
import trimesh
from safetensors.torch import load_file, save_file

from tests.factories.ball_model import RADIUS, ball_scene
from tests.factories.ball_page import box
from tests.factories.cameras import FRAME
from tests.factories.models import NUM_BANDS
from unmix_plugin.editing import Light, Recipe, edit_scene
from unmix_plugin.errors import ConfigError, RunError
from unmix_plugin.scenes.demo.scene import make_demo_scene
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.spectral.intervals import width_factor
from unmix_plugin.trained.measured_errors import FILE_NAME, measure_errors, read_errors, write_errors
from unmix_plugin.trained.measured_surface import MeasuredSurface
from unmix_plugin.trained.place_errors import CELL_SIZES_PX, ComparedPixels, PlaceErrors
from unmix_plugin.trained.places import MeasuredScene, NamedRegion, spectrum_at
from unmix_plugin.trained.regions import Box, OfMaterial
from unmix_plugin.trained.run_views import RunView
from unmix_plugin.trained.surface_mesh import TriangleMesh
from unmix_plugin.trained.training_views import thinned_views

PIXEL = 0.01
WORLD_RADIUS = RADIUS / FRAME.scale
VIEWS = 12
DEVIATIONS = torch.tensor([[0.01], [0.1], [0.5]]).expand(3, NUM_BANDS)
"""Of endmembers of value 1; the last is not determined."""


def places(count, generator):
    """On a square of 60 pixels; errors are four times as large on one half."""
    positions = torch.rand(count, 3, generator=generator) * torch.tensor([60 * PIXEL, 60 * PIXEL, 0.0])
    deviations = torch.where(positions[:, 0] < 30 * PIXEL, 0.02, 0.08)
    return positions, deviations


def pixel_errors(positions, deviations, generator, common=0.0):
    """Errors with heavy tails, part of them the same everywhere."""

    def draw(width):
        own = torch.randn(len(positions), width, generator=generator)
        own = own * (1 + 2 * (torch.rand(len(positions), 1, generator=generator) > 0.9))
        return deviations[:, None] * (own + common)

    of_view = torch.randint(0, VIEWS, (len(positions),), generator=generator)
    abundances, spectra = known(len(positions))
    return ComparedPixels(
        positions, of_view, spectra, spectra - draw(NUM_BANDS), abundances, (abundances - draw(3))[None]
    )


def known(count):
    """Abundances and spectra that are rendered everywhere."""
    return torch.full((count, 3), 1 / 3), torch.ones(count, NUM_BANDS)


def fitted(common=0.0, count=20_000, seed=0):
    generator = torch.Generator().manual_seed(seed)
    errors = PlaceErrors.fit(
        pixel_errors(*places(count, generator), generator, common),
        torch.ones(3, NUM_BANDS),
        DEVIATIONS,
        torch.zeros(3),
        PIXEL,
    )
    assert errors is not None
    return errors


@pytest.mark.parametrize("coverage", [0.5, 0.8, 0.9, 0.95])
def test_of_errors_that_were_not_seen_as_many_are_within_as_the_coverage_says(coverage):
    errors, generator = fitted(), torch.Generator().manual_seed(7)
    positions, deviations = places(5000, generator)
    fresh, local = pixel_errors(positions, deviations, generator), errors.at(positions, *known(5000))
    is_large = deviations > 0.05
    half = errors.half_widths(fresh.abundances, local.abundances, coverage)[:, :2]
    of_spectra = (
        width_factor(errors.spectrum_factors, coverage) * local.spectra[:, None] * errors.band_deviations
    )
    of_abundances, of_bands = (fresh.abundances - fresh.possible[0])[:, :2], fresh.rendered - fresh.measured
    for within in (of_abundances.abs() <= half, of_bands.abs() <= of_spectra):
        for part in (is_large, ~is_large):
            assert float(within[part].double().mean()) == pytest.approx(coverage, abs=0.03)
    assert float(half[is_large].mean() / half[~is_large].mean()) == pytest.approx(4, rel=0.15)


def test_what_is_the_same_everywhere_stays_in_the_mean_of_a_region_and_the_rest_does_not():
    generator = torch.Generator().manual_seed(3)
    positions, _ = places(500, generator)
    weights = np.ones(500)
    edge = 48 * PIXEL
    independent, alike = fitted(0.0), fitted(2.0)
    own = independent.over_region(independent.at(positions, *known(500)), weights, edge)
    alone = alike.at(positions, *known(500))
    shared = alike.over_region(alone, weights, edge)
    assert float(own.abundances[:2].max()) < 0.2 * float(alone.abundances[:, :2].mean())
    assert float(shared.abundances[:2].min()) > 0.6 * float(alone.abundances[:, :2].square().mean().sqrt())
    assert own.abundances.isnan().tolist() == [False, False, True]


def test_what_is_absent_has_narrower_intervals_than_what_is_there_where_its_errors_are_smaller():
    generator = torch.Generator().manual_seed(1)
    pixels = pixel_errors(*places(20_000, generator), generator)
    abundances = torch.tensor([0.6, 0.4, 0.0]).expand(20_000, 3)
    missed = torch.tensor([0.05, 0.05, 0.001]) * torch.randn(2, 20_000, 3, generator=generator)
    missed[1] *= 2
    some = replace(pixels, abundances=abundances, possible=abundances + missed)
    errors = PlaceErrors.fit(some, torch.ones(3, NUM_BANDS), DEVIATIONS / 10, torch.zeros(3), PIXEL)
    assert errors is not None
    local = errors.at(pixels.positions, abundances, pixels.rendered)
    half = errors.half_widths(abundances, local.abundances, 0.9).mean(dim=0)
    torch.testing.assert_close(
        half[:2], torch.full((2,), 1.645 * 0.1), rtol=0.1, atol=0
    )  # of the further way
    assert half[2] < 0.01


def test_where_fewer_than_two_views_measured_errors_are_unknown():
    errors = fitted()
    away = torch.tensor(
        [[30 * PIXEL, 30 * PIXEL, 0.0], [30 * PIXEL, 30 * PIXEL, 5 * CELL_SIZES_PX[0] * PIXEL]]
    )
    local = errors.at(away, *known(2))
    assert local.spectra.isfinite().tolist() == [True, False]
    assert local.abundances.isfinite().tolist() == [[True, True, False], [False] * 3]
    nowhere = errors.over_region(errors.at(away[1:], *known(1)), np.ones(1), PIXEL)
    assert nowhere.spectra.isnan().all()


def test_of_two_views_nothing_is_said():
    generator = torch.Generator().manual_seed(0)
    found = pixel_errors(*places(2000, generator), generator)
    few = replace(found, views=found.views % 2)
    assert PlaceErrors.fit(few, torch.ones(3, NUM_BANDS), DEVIATIONS, torch.zeros(3), PIXEL) is None


def test_a_run_keeps_its_errors_and_says_why_there_are_none(tmp_path):
    errors = fitted(count=2000)
    assert "no errors.safetensors" in str(read_errors(tmp_path, 10, NUM_BANDS, 3))
    write_errors(tmp_path, errors, 10)
    again = read_errors(tmp_path, 10, NUM_BANDS, 3)
    assert isinstance(again, PlaceErrors)
    torch.testing.assert_close(again.tensors(), errors.tensors())
    assert "after 10 steps, and the run has 20" in str(read_errors(tmp_path, 20, NUM_BANDS, 3))
    with pytest.raises(RunError, match="another number of bands"):
        read_errors(tmp_path, 10, NUM_BANDS + 1, 3)
    write_errors(tmp_path, None, 10)
    assert not (tmp_path / FILE_NAME).exists()


def test_errors_of_an_earlier_layout_are_none_and_that_is_said(tmp_path):
    write_errors(tmp_path, fitted(count=2000), 10)
    path = tmp_path / FILE_NAME
    save_file(load_file(path), path, {"steps": "10"})
    assert "of an earlier version" in str(read_errors(tmp_path, 10, NUM_BANDS, 3))


def test_a_damaged_file_of_errors_is_refused(tmp_path):
    write_errors(tmp_path, fitted(count=2000), 10)
    data = (tmp_path / FILE_NAME).read_bytes()
    (tmp_path / FILE_NAME).write_bytes(data[: len(data) // 2])
    with pytest.raises(RunError, match="is damaged"):
        read_errors(tmp_path, 10, NUM_BANDS, 3)


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """A ball beside the views of another scene, so that it is far off."""
    folder = tmp_path_factory.mktemp("scene") / "demo"
    make_demo_scene(folder, 40, NUM_BANDS, 12)
    scene = load_scene(folder)
    split = {**dict.fromkeys(scene.train_indices, "train"), **dict.fromkeys(scene.eval_indices, "eval")}
    views = tuple(RunView(scene.frames[i].name, scene.cameras[i], which) for i, which in split.items())  # type: ignore[arg-type]
    ball = replace(ball_scene(), views=views, frame=FRAME)
    errors = measure_errors(ball, list(thinned_views(ball, MeasuredScene(scene, None))))
    assert errors is not None
    # Its endmembers are none of the scene's.
    return replace(ball, measured_errors=replace(errors, is_determined=torch.ones_like(errors.is_determined)))


def test_endmembers_that_the_pixels_do_not_tell_have_no_intervals_and_say_why(measured):
    errors = measured.measured_errors
    certain = torch.ones_like(errors.is_determined)
    certain[0] = False
    told = replace(measured, measured_errors=replace(errors, is_determined=certain))
    probe = told.probe(*middle(told))
    interval = probe.interval("abundances")
    assert interval.is_known
    assert np.isnan(interval.low).tolist() == (~certain).tolist()
    assert "none like it" in interval.not_determined
    assert "none like it" in told.interval(probe, "abundance:0").not_determined
    assert told.interval(probe, "abundance:1").not_determined == ""
    spectra = replace(
        measured, measured_errors=replace(errors, endmember_deviations=0.1 * measured.materials.endmembers)
    )
    ends = spectra.endmember_interval(0.9)
    np.testing.assert_allclose(ends.width, 2 * 1.645 * 0.1 * measured.materials.endmembers, rtol=1e-3)
    assert ends.not_determined == ""
    untold = replace(measured, measured_errors="nobody looked").endmember_interval()
    assert untold.not_determined == "nobody looked"


def middle(scene):
    camera = scene.views[-1].camera
    return camera, camera.width // 2, camera.height // 2


def test_a_probe_has_the_interval_that_the_map_shows(measured):
    camera, column, row = middle(measured)
    probe, view = measured.probe(camera, column, row), measured.look(camera)
    found = probe.interval("abundances")
    assert found.not_determined == ""
    largest = int(probe.abundances.argmax())
    assert found.low[largest] <= probe.abundances[largest] <= found.high[largest]
    assert found.low.min() >= 0
    assert found.high.max() <= 1
    for name in ("abundance:0", "abundance:1", "band:500nm"):
        own = measured.interval(probe, name)
        np.testing.assert_allclose(view[f"interval:{name}"][row, column], own.width, rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(view["interval:abundance"][row, column], found.width[largest], rtol=1e-3)
    assert view["interval:abundance"][0, 0].isnan()  # nothing is there


def test_wider_intervals_hold_narrower_ones_and_spectra_are_not_negative(measured):
    probe = measured.probe(*middle(measured))
    for name in ("abundances", "predicted"):
        ends = [probe.interval(name, coverage) for coverage in (0.5, 0.9, 0.99)]
        for inner, outer in pairwise(ends):
            assert (outer.low <= inner.low).all()
            assert (outer.high >= inner.high).all()
        assert ends[-1].low.min() >= 0


def test_the_interval_of_an_index_follows_from_that_of_spectra(measured):
    probe = measured.probe(*middle(measured))
    index, band = measured.interval(probe, "index:r500"), measured.interval(probe, "band:500nm")
    assert index.low == pytest.approx(probe.values["predicted"][1] - index.width / 2)
    assert index.width == pytest.approx(2 * (band.high - probe.values["predicted"][1]), rel=0.5)
    brighter = replace(probe, values={name: 1.2 * one for name, one in probe.values.items()})
    ratio, of_brighter = (measured.interval(one, "index:r500/r600") for one in (probe, brighter))
    assert of_brighter.low + of_brighter.high == pytest.approx(ratio.low + ratio.high)
    assert of_brighter.width < ratio.width  # errors that only make a spectrum brighter don't change it
    ratio = measured.interval(probe, "index:r500/r500")
    assert (ratio.low, ratio.high) == pytest.approx((1, 1))


def test_where_there_is_no_honest_interval_it_says_why(measured):
    camera, column, row = middle(measured)
    probe = measured.probe(camera, 0, 0)
    assert "there" in probe.interval().not_determined
    edited = edit_scene(measured, Recipe(illuminant=Light("A")))
    assert "edited" in edited.probe(camera, column, row).interval().not_determined
    with pytest.raises(ConfigError, match="not determined: the scene is edited"):
        edited.look(camera)["interval:abundance"]
    untold = replace(measured, measured_errors="nobody looked")
    assert untold.probe(camera, column, row).interval().not_determined == "nobody looked"
    point = measured.frame.to_world(RADIUS * np.array([0.0, 0.0, -1.0])).tolist()
    below = measured.probe_point(*point).interval()
    assert "fewer than two training views" in below.not_determined
    assert np.isnan(below.width).all()


@pytest.mark.parametrize(
    "name", ["interval:rgb", "interval:segmentation", "interval:depth", "interval:accumulation"]
)
def test_what_has_no_interval_is_refused(measured, name):
    with pytest.raises(ConfigError, match="no interval of"):
        measured.output(name)


@pytest.fixture(scope="module")
def surface(measured):
    ball = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    return MeasuredSurface(measured, TriangleMesh(np.asarray(ball.vertices), np.asarray(ball.faces)))


def test_a_material_covers_an_area_within_its_interval(surface):
    found = surface.measure(OfMaterial(0), "upper")
    interval = found.area_interval
    assert interval.not_determined == ""
    assert interval.low <= found.area <= interval.high
    assert interval.high <= 1.01 * surface.areas.sum()
    certain = replace(surface.scene.measured_errors, abundance_factors=torch.zeros(7))
    sharp = MeasuredSurface(replace(surface.scene, measured_errors=certain), surface.mesh)
    own = sharp.measure(OfMaterial(0), "upper").area_interval
    assert own.width < 0.2 * found.area  # an outline is known to one triangle
    assert 0 < own.width <= interval.width


def test_a_box_covers_an_area_known_to_a_triangle_along_its_edges(surface):
    low, high = WORLD_RADIUS / 2, 9.0
    cap = surface.measure(box([-high, -high, low], [high] * 3), "cap")
    rim = 2 * np.pi * WORLD_RADIUS * np.sqrt(3) / 2
    spacing = np.sqrt(surface.areas.mean() * 4 / np.sqrt(3))
    interval = cap.area_interval
    assert interval.low < np.pi * WORLD_RADIUS**2 < interval.high
    assert 0.5 * rim * spacing < interval.width < 3 * rim * spacing


def test_a_region_has_intervals_of_its_means_or_a_reason(surface):
    everywhere = Box((-99.0, -99.0, -99.0), (99.0, 99.0, 99.0))
    place = spectrum_at(surface.scene, NamedRegion("all", everywhere, surface))
    interval = place.probe.interval("abundances")
    assert interval.not_determined == ""
    assert ((interval.low <= place.probe.abundances) & (place.probe.abundances <= interval.high)).all()
    assert place.region is not None
    assert place.region.area_interval.low == pytest.approx(place.region.area)  # it has no edge
    untold = MeasuredSurface(replace(surface.scene, measured_errors="nobody looked"), surface.mesh)
    region = untold.measure(everywhere, "all")
    assert (region.errors, region.area_interval.not_determined) == ("nobody looked",) * 2
