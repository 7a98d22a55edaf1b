from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from tests.factories import ball_model
from tests.factories.scenes import cameras_of
from unmix_plugin.products.mesh import gltf_content
from unmix_plugin.spectral.materials import Coefficients
from unmix_plugin.trained.plain_outputs import OUTPUTS
from unmix_plugin.trained.surface import SurfaceAppearance, in_image, look_from_above, sample_field
from unmix_plugin.trained.surface_mesh import TriangleMesh
from unmix_plugin.trained.trained_scene import MaterialView

SCENE = ball_model.ball_scene()


def seen(directions, model=SCENE, num_rays=12_000):
    return ball_model.seen_surface(model, directions, num_rays)


@pytest.fixture(scope="module")
def ball():
    return seen(ball_model.ALL_ROUND)


def test_points_cover_all_of_the_surface_that_is_seen_with_its_mixture_light_and_direction(ball):
    points = ball.points()
    radii = points.positions.norm(dim=-1)
    assert len(points) > 1000
    assert float((radii - ball_model.RADIUS).abs().max()) < 0.04
    assert float(radii.mean()) == pytest.approx(ball_model.RADIUS, abs=0.01)
    assert len({tuple(row) for row in (points.positions > 0).tolist()}) == 8  # octants
    clear = points.positions[:, 2].abs() > 0.05
    above = (points.positions[:, 2] > 0)[clear]
    assert_close(points.abundances[clear, 0], above.float(), atol=5e-3, rtol=0)
    assert_close(points.abundances.sum(dim=-1), torch.ones(len(points)), atol=1e-4, rtol=0)
    expected = ball_model.SHADE * points.abundances @ SCENE.materials.endmembers
    assert_close(points.diffuse(SCENE.materials), expected, atol=1e-4, rtol=0)
    origins = 3 * torch.nn.functional.normalize(torch.tensor(ball_model.ALL_ROUND), dim=-1)
    towards = torch.nn.functional.normalize(points.positions[:, None] - origins, dim=-1)
    cosines = (towards * points.directions[:, None]).sum(dim=-1).max(dim=1).values
    assert_close(cosines, torch.ones(len(points)), atol=1e-4, rtol=0)


def test_rays_that_end_in_the_air_between_two_surfaces_give_no_points():
    model = ball_model.ball_scene(has_wall=True)
    cameras = [(-1.0, y, z) for y in (-0.6, 0.0, 0.6) for z in (-0.5, 0.5)]
    surface = seen(cameras, model, num_rays=20_000)
    alone = [seen([camera], model, num_rays=20_000 // len(cameras)) for camera in cameras]
    everything = torch.cat([one.points().positions for one in alone])
    points = surface.points().positions

    def off(positions):
        """Distance to the nearer of ball and wall."""
        to_ball, to_wall = (positions.norm(dim=-1) - ball_model.RADIUS).abs(), (positions[:, 0] - 0.8).abs()
        return torch.minimum(to_ball, to_wall)

    assert float(off(everything).max()) > 0.1, "without points in the air this test shows nothing"
    assert (off(points) < 0.08).float().mean() > 0.995
    assert len(points) > 0.9 * len(everything)


def test_seen_is_what_lies_on_a_surface_before_a_camera(ball):
    top, below, inside = [0.0, 0.0, 0.6], [0.0, 0.0, -0.6], [0.0, 0.0, 0.35]
    places = torch.tensor([top, below, inside, [0, 0, 0], [0.5, 0.5, 0.5]])  # middle, air
    assert ball.shows(places).tolist() == [True, True, False, False, False]
    assert seen(ball_model.FROM_ABOVE).shows(places).tolist() == [True, False, False, False, False]


def test_from_straight_above_a_point_looks_as_its_surface():
    normals = torch.nn.functional.normalize(torch.tensor([[0.1, 0.2, 0.9], [0.3, 0.1, -0.8]]), dim=-1)
    abundances, diffuse = look_from_above(SCENE, ball_model.RADIUS * normals, normals)
    assert_close(abundances, torch.tensor([[1.0, 0, 0], [0, 1, 0]]), atol=1e-4, rtol=0)
    assert_close(diffuse, ball_model.SHADE * SCENE.materials.endmembers[:2].detach(), atol=1e-3, rtol=0)
    nothing, light = look_from_above(SCENE, torch.zeros(0, 3), torch.zeros(0, 3))
    assert (nothing.shape, light.shape) == ((0, 3), (0, 5))
    assert np.isfinite(diffuse.numpy()).all()


ALIKE = (("a", "a 2", "a!"), ("Leaf", "leaf", "LEAF"), ("a", "a_1", "A!"), ("粘", "土", "0"))


@pytest.mark.parametrize("names", ALIKE)
def test_abundances_of_names_that_are_alike_are_all_kept(names):
    materials = replace(SCENE.materials, names=names)
    looks = SurfaceAppearance(materials, torch.eye(3), torch.ones(3, len(materials.bands)))
    mesh = TriangleMesh(np.eye(3), np.array([[0, 1, 2]]))
    for numbers in (looks.properties(), gltf_content(mesh, looks, "three points")[1]):
        columns = [column for name, column in numbers.items() if "abundance_" in name.lower()]
        np.testing.assert_array_equal(columns, np.eye(3))


def test_a_point_beyond_the_edge_is_not_in_the_image_where_the_lens_model_folds_over():
    camera = cameras_of([np.eye(4)], 400, 400, 300.0, (-0.3, 0.0, 0.0, 0.0))
    angles = torch.linspace(-1.5, 1.5, 301)
    points = 2 * torch.stack([angles.sin(), torch.zeros(301), -angles.cos()], dim=-1)
    edge = camera.generate_rays(torch.zeros(1, dtype=torch.int64), torch.tensor([[400.0, 200.0]]))
    expected = angles.abs() < torch.atan2(edge.directions[0, 0], -edge.directions[0, 2])
    assert in_image(camera, points)[0].tolist() == expected.tolist()


def test_colours_of_a_surface_are_those_of_renders_also_where_a_band_exceeds_full_scale():
    spectra = torch.tensor([[0.3, 0.4, 0.9, 1.8, 0.2], [1.5, 0.2, 0.1, 0.3, 2.0], [0.1, 0.2, 0.3, 0.2, 0.1]])
    scene = replace(SCENE, materials=replace(SCENE.materials, endmembers=spectra))
    ones = torch.ones(1, 3)
    seen = Coefficients.of(ones, ones, torch.eye(3)[None], torch.eye(3)[None], torch.zeros(1, 3, 0))
    rendered = OUTPUTS["rgb"].compute(MaterialView(scene, scene.views[0].camera, seen))[0]
    looks = SurfaceAppearance(scene.materials, torch.eye(3), spectra)
    np.testing.assert_allclose(looks.srgb, rendered.numpy(), atol=1e-5)


def test_densities_are_had_without_the_work_of_abundances(monkeypatch):
    points = torch.tensor([[0.0, 0.0, 0.5], [0.0, 0.0, 0.9]])
    densities, abundances = sample_field(SCENE, points)
    assert abundances.shape == (2, 3)
    monkeypatch.setattr(type(SCENE.field), "abundances_of", None)
    alone, nothing = sample_field(SCENE, points, with_abundances=False)
    assert torch.equal(alone, densities)
    assert nothing.shape == (2, 0)


def test_where_a_lamp_goes_with_the_camera_a_surface_is_lit_squarely_on_all_sides():
    """Pictures show the side towards the axis as bright as the other, since each camera brings its lamp."""
    scene, sides = ball_model.lamplit_ball_scene(), torch.tensor([[-1.0, 0.0, 0.3], [1.0, 0.0, 0.3]])
    normals = torch.nn.functional.normalize(sides, dim=1)
    places = torch.tensor(ball_model.LAMPLIT_MIDDLE) + ball_model.LAMPLIT_RADIUS * normals
    expected = ball_model.SHADE * scene.materials.endmembers[0].detach().expand(2, -1)
    assert_close(look_from_above(scene, places, normals)[1], expected, atol=1e-3, rtol=0)
    for place, side, spectrum in zip(places, sides.tolist(), expected, strict=True):
        [camera] = ball_model.cameras_around([(side[0], side[1], side[2])])
        column, row = camera.project(place[None], 0)[0][0].long().tolist()
        assert_close(scene.look(camera).spectra[row, column], spectrum, atol=0, rtol=0.08)
