"""The path tracer against closed forms, and whole pictures."""

import math

import pytest
import torch
import trimesh
from torch.testing import assert_close

from tests.factories.surfaces import Glossy, Lambert, Uniform, ball, generator, mesh_from, unit
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.light.lamp import LAMP_FRAMES
from unmix_plugin.neumatex.tracing.built_in_lights import built_in_environment
from unmix_plugin.neumatex.tracing.environment import Environment, MovingFrame, directions_of_pixels
from unmix_plugin.neumatex.tracing.microfacet import frames
from unmix_plugin.neumatex.tracing.path_tracer import TracedObject
from unmix_plugin.neumatex.tracing.rays import RayMesh, pixel_hits

GLOSSY = [0.4, 0.3, 0.2, 0.3, 0.5]


def _sphere(subdivisions=3):
    return RayMesh(ball(subdivisions))


def _two_spheres():
    first, second = (trimesh.creation.icosphere(subdivisions=3, radius=0.5) for _ in range(2))
    first.apply_translation((-0.5, 0, 0))
    second.apply_translation((0.52, 0.1, 0.1))
    return RayMesh(mesh_from(first, second))


def _white():
    return Environment(torch.ones(8, 16, 3))


def _seen(rays, count=200, origin=(0.3, -3.0, 0.4)):
    """Points that a viewer outside (or inside) sees."""
    origins = torch.tensor(origin).expand(count, 3)
    targets = 1.2 * torch.rand(count, 3, generator=generator()) - 0.6
    return rays.seen(origins, unit(targets - origins))[1]


def _radiance(surface, rays, environment, points, samples=64, bounces=1, seed=0):
    return TracedObject(rays, environment, surface).light(points, samples, bounces, generator(seed))


def test_white_furnace_of_a_convex_lambertian():
    rays = _sphere(5)
    points = _seen(rays)
    surface = Uniform(Lambert(), [1.0, 0.5, 0.0])
    radiance = _radiance(surface, rays, _white(), points, 256, bounces=3)
    expected = torch.tensor([1.0, 0.5, 0.0]).expand_as(radiance)
    # Facets hide a little of the hemispheres of interpolated normals.
    assert_close(radiance, expected, atol=0.03, rtol=0)
    assert_close(radiance.mean(dim=0), expected[0], atol=0.004, rtol=0)


@pytest.mark.parametrize("bounces", [0, 1, 2])
def test_bounces_within_a_closed_sphere_are_a_geometric_series(bounces):
    """A hole of a known size lets light in; all of it comes from the hole's solid angle."""
    sphere = trimesh.creation.icosphere(subdivisions=4)
    open_faces = sphere.faces[sphere.triangles_center[:, 2] < 0.8]
    open_sphere = trimesh.Trimesh(sphere.vertices, open_faces, process=False)
    hole = 1 - open_sphere.area / sphere.area
    rays = RayMesh(mesh_from(open_sphere))
    points = _seen(rays, count=3000, origin=(0.0, 0.0, 0.0))
    points = points.select(points.positions[:, 2] < 0.75)
    albedo = torch.tensor([0.9, 0.6, 0.3])
    radiance = _radiance(Uniform(Lambert(), albedo), rays, _white(), points, 16, bounces)
    # Inside a sphere every point sees every part under cos cos / (pi r^2) = 1 / area, so the irradiance is the same
    # everywhere and each reflection keeps the albedo and the closed part.
    closed = albedo * (1 - hole)
    expected = albedo * hole * sum(closed**order for order in range(bounces + 1))
    assert_close(radiance.mean(dim=0), expected, rtol=0.03, atol=0)


def test_energy_is_not_made():
    rays = _two_spheres()
    points = _seen(rays)
    radiance = _radiance(Uniform(Lambert(), [1.0] * 3), rays, _white(), points, samples=256, bounces=6)
    assert radiance.max() < 1.05
    direct = _radiance(Uniform(Lambert(), [1.0] * 3), rays, _white(), points, samples=256, bounces=0)
    assert direct.min() < 0.8  # one sphere shadows the other, which bounces make up for
    assert_close(radiance.mean(), torch.tensor(1.0), atol=0.02, rtol=0)


class _OnlyEnvironment(Glossy):
    """Draws nothing itself."""

    def sample(self, parameters, wo, uniforms):
        return -unit(uniforms + 0.1)

    def density(self, parameters, wi, wo):
        return torch.zeros(len(wi))


class _NeverDrawn(Environment):
    """Can't be drawn from."""

    def sample(self, uniforms):
        directions, density = super().sample(uniforms)
        return directions, torch.zeros_like(density)

    def density(self, directions):
        return torch.zeros(len(directions))


def test_both_strategies_together_agree_with_each_alone():
    rays, light = _two_spheres(), built_in_environment("studio", 3, height=16)
    points = _seen(rays)
    together, by_light, by_material = (
        _radiance(Uniform(family, GLOSSY), rays, drawn, points, 1024, bounces=0)
        for family, drawn in (
            (Glossy(), light),
            (_OnlyEnvironment(), light),
            (Glossy(), _NeverDrawn(light.image)),
        )
    )
    for single in (by_light, by_material):
        assert_close(single.mean(dim=0), together.mean(dim=0), rtol=0.01, atol=0)
        assert (single - together).abs().mean() < 0.1 * together.mean()


def test_transport_is_reciprocal():
    """Light from a small source far away in direction a, seen from b, equals light from b seen from a."""
    rays, surface = _two_spheres(), Uniform(Lambert(), [0.8, 0.5, 0.2])
    a, b = unit(torch.tensor([0.5, -1.0, 0.3])), unit(torch.tensor([-1.0, -0.4, 0.6]))
    assert_close(_flux(rays, surface, a, b), _flux(rays, surface, b, a), rtol=0.03, atol=0)


def _flux(rays, surface, light, eye):
    """Radiance over the projected area that the eye sees, from a light of a few degrees; two reflections or one."""
    first, second, _ = frames(eye[None])[0]
    x, y = torch.meshgrid(*2 * [torch.linspace(-1.3, 1.3, 120)], indexing="ij")
    origins = 5 * eye + x.reshape(-1, 1) * first + y.reshape(-1, 1) * second
    directions = -eye.expand_as(origins).contiguous()
    _, points = rays.seen(origins, directions)
    spot = (directions_of_pixels(64, 128) @ light > 0.985).float()[..., None].expand(-1, -1, 3)
    emitter = Environment(spot.contiguous())
    power = emitter.mean_radiance().sum()
    radiance = _radiance(surface, rays, emitter, points, 32, bounces=1)
    return radiance.sum(dim=0) / power


def test_gradients_are_those_of_finite_differences():
    rays, light = _two_spheres(), built_in_environment("window-room", 1, height=16)
    points = _seen(rays, count=30)
    values = torch.tensor(GLOSSY, requires_grad=True)
    cotangent = torch.rand(len(points.positions), 3, generator=generator(7))

    def value(parameters):
        # Densities come from the fixed material, reflectances from the changed one: the same paths in both.
        family = _FixedDraws(values.detach())
        return (_radiance(Uniform(family, parameters), rays, light, points, 32) * cotangent).sum()

    (gradient,) = torch.autograd.grad(value(values), values)
    step = 0.01
    rises = [value(values.detach() + shift) - value(values.detach() - shift) for shift in step * torch.eye(5)]
    expected = torch.stack(rises) / (2 * step)
    assert_close(gradient, expected, rtol=5e-3, atol=1e-3 * float(expected.abs().max()))


class _FixedDraws(Glossy):
    """Draws as another material would, so that changed parameters leave the paths alone."""

    def __init__(self, drawn_as):
        self._drawn_as = drawn_as

    def sample(self, parameters, wo, uniforms):
        return super().sample(self._drawn_as.expand_as(parameters), wo, uniforms)

    def density(self, parameters, wi, wo):
        return super().density(self._drawn_as.expand_as(parameters), wi, wo)


def test_gradient_of_the_mean_is_the_mean_of_gradients_with_moving_draws():
    """The derivative without fixing draws is estimated without bias: compare with differences of good estimates."""
    rays, light = _sphere(3), built_in_environment("overcast", 1, height=16)
    points = _seen(rays, count=60)
    values = torch.tensor(GLOSSY, requires_grad=True)
    surface = Uniform(Glossy(), values)
    (gradient,) = torch.autograd.grad(_radiance(surface, rays, light, points, 512).mean(), values)
    step = 0.1 * torch.tensor([0.0, 0, 0, 0, 1.0])
    up, down = (
        _radiance(Uniform(Glossy(), values.detach() + s * step), rays, light, points, 2048).mean()
        for s in (1, -1)
    )
    assert_close(gradient[4], (up - down) / 0.2, rtol=0.08, atol=2e-4)


def test_two_calls_are_independent_and_a_seed_repeats():
    rays, light = _sphere(2), built_in_environment("studio", 0, height=16)
    points = _seen(rays)
    surface, drawn = Uniform(Glossy(), GLOSSY), generator(4)
    first, second = (TracedObject(rays, light, surface).light(points, 4, generator=drawn) for _ in range(2))
    again = _radiance(surface, rays, light, points, samples=4, seed=4)
    assert torch.equal(first, again)
    truth = _radiance(surface, rays, light, points, samples=2048, seed=9)
    errors = torch.stack([(first - truth)[:, 0], (second - truth)[:, 0]])
    assert torch.corrcoef(errors)[0, 1].abs() < 0.2


SIZE = 48


def _camera(size=SIZE, x_axis=(0.0, 1.0, 0.0), back=(1.0, 0.0, 0.0)):
    """One on the x axis, four units away, z up; by default it looks at the origin."""
    axes = [torch.tensor(axis) for axis in (x_axis, (0.0, 0.0, 1.0), back, (4.0, 0.0, 0.0))]
    focal = torch.full((1, 2), 1.5 * size)
    pose = torch.stack(axes, dim=-1)[None]
    return Cameras(pose, focal, torch.full((1, 2), size / 2), torch.zeros(1, 4), size, size)


def test_alpha_is_the_covered_part_of_pixels_whose_rays_are_averaged():
    hits = pixel_hits(_sphere(4), _camera(), 0, subpixels=4)
    alpha = hits.alpha()
    # A unit sphere at distance 4 has an outline of this radius in pixels.
    radius = 1.5 * SIZE / math.sqrt(4**2 - 1)
    assert_close(alpha.sum(), torch.tensor(math.pi * radius**2), rtol=0.005, atol=0)
    assert (alpha[SIZE // 2, SIZE // 2], alpha[0, 0]) == (1, 0)
    assert bool(((alpha > 0) & (alpha < 1)).any())
    assert_close(hits.image(torch.ones(len(hits), 3)), alpha[..., None].expand(-1, -1, 3))
    inner = hits.select(hits.pixels == SIZE // 2 * SIZE + SIZE // 2)
    assert_close(inner.points.to_eye.norm(dim=-1), torch.ones(16))
    assert bool((hits.pixels.diff() >= 0).all())


def test_left_and_up_are_where_they_belong():
    """Light from +z and from +y: the upper half is brighter, and the half that shows +y, on the right."""
    image = torch.zeros(16, 32, 3)
    image[:8, :, 0] = 1  # +z
    image[:, 0:16, 1] = 1  # azimuths from 0 to pi, +y
    traced = TracedObject(_sphere(4), Environment(image), Uniform(Lambert(), [1.0] * 3))
    picture, _ = traced.picture(_camera(), 0, 64, bounces=0)
    half = SIZE // 2
    assert picture[:half, :, 0].mean() > 2 * picture[half:, :, 0].mean()
    assert picture[:, half:, 1].mean() > 2 * picture[:, :half, 1].mean()


def test_a_camera_that_sees_nothing_gives_black_and_alpha_zero():
    traced = TracedObject(_sphere(4), _white(), Uniform(Lambert(), [1.0] * 3))
    picture, alpha = traced.picture(_camera(8, (0.0, -1.0, 0.0), (-1.0, 0.0, 0.0)), 0, 64)
    assert picture.abs().sum() + alpha.sum() == 0


@pytest.mark.parametrize("kind", ["turntable", "camera"])
def test_light_that_turns_with_the_camera_is_that_which_stands_there_for_each_camera(kind):
    rays, surface = _two_spheres(), Uniform(Glossy(), GLOSSY)
    towards = unit(torch.tensor([0.5, 0.7, 0.4]))
    image = (1 + directions_of_pixels(32, 64) @ towards)[..., None].expand(-1, -1, 3) ** 4
    moving = Environment(image, moves=MovingFrame(kind, (0.1, 0.0, -0.2), (0.1, 0.0, 1.0)))
    for origin in ((0.3, -3.0, 0.4), (2.0, 1.0, 1.5)):
        points = _seen(rays, 100, origin)
        still = moving.seen_from(torch.tensor(origin))
        found = _radiance(surface, rays, moving, points, 512).mean(dim=0)
        assert_close(found, _radiance(surface, rays, still, points, 512).mean(dim=0), rtol=0.01, atol=0)
    first, second = (moving.seen_from(torch.tensor(eye)) for eye in ((0.3, -3.0, 0.4), (2.0, 1.0, 1.5)))
    assert (first.image - second.image).abs().max() > 0.5


def test_a_turntables_light_is_the_same_from_all_heights_and_a_carried_lamp_rises():
    up = torch.tensor([[0.0, 0.0, 1.0]])
    for kind, expected in zip(LAMP_FRAMES, (1.0, math.sqrt(0.5)), strict=True):
        axes = MovingFrame(kind, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)).axes(torch.tensor([[3.0, 0.0, 3.0]]))
        assert_close(axes @ axes.mT, torch.eye(3)[None])
        assert float(torch.linalg.det(axes[0])) == pytest.approx(1)
        assert float(axes[0, 2] @ up[0]) == pytest.approx(expected, abs=1e-6)


def test_gradients_to_normals_and_light_are_those_of_differences():
    """Of the mean over many paths, by the sides of a step; materials that are drawn for themselves included."""
    rays, surface = _two_spheres(), Uniform(Glossy(), GLOSSY)
    image = built_in_environment("clear-sky", 3, height=16).image
    points = _seen(rays, 300)
    turn = unit(torch.randn(rays.mesh.normals.shape, generator=generator(1)))
    change = torch.rand(image.shape, generator=generator(2))

    def light(step: torch.Tensor) -> torch.Tensor:
        turned = rays.with_normals(unit(rays.mesh.normals + step[0] * turn))
        faces = rays.closest(points.positions + 0.5 * points.to_eye, -points.to_eye)
        again = turned.points(faces, -points.to_eye)
        return _radiance(surface, turned, Environment(image + step[1] * change), again, 512).mean()

    at = torch.zeros(2, requires_grad=True)
    light(at).backward()
    assert at.grad is not None
    for row, size in enumerate((0.05, 0.05)):
        step = torch.zeros(2)
        step[row] = size
        difference = float(light(step) - light(-step)) / (2 * size)
        assert float(at.grad[row]) == pytest.approx(difference, rel=0.1, abs=2e-3)
