"""Light and normals that are fitted with materials: what stays as it is, and that they find the truth."""

import math

import pytest
import torch
from torch.testing import assert_close

from tests.factories.surfaces import Lambert, Uniform, ball, generator, unit
from unmix_plugin.neumatex.fit.refinement import FittedLight, FittedNormals
from unmix_plugin.neumatex.tracing.environment import Environment
from unmix_plugin.neumatex.tracing.lamp_and_sky import LampAndSky
from unmix_plugin.neumatex.tracing.path_tracer import TracedObject
from unmix_plugin.neumatex.tracing.rays import RayMesh, SurfacePoints

RAYS = RayMesh(ball(4))


def _light(
    towards: tuple[float, float, float] = (0.4, -0.5, 0.7), lamp: tuple[float, float] = (0.3, 0.3)
) -> LampAndSky:
    sky = torch.tensor([0.1, 0.05, 0.05, 0.05, 0.05, 0.3, 0.0])
    return LampAndSky(torch.tensor(towards), torch.tensor([3.0, 14.0]), torch.tensor(lamp), sky)


def _seen(rays: RayMesh = RAYS, count: int = 250) -> SurfacePoints:
    eyes = 3 * unit(torch.randn(count, 3, generator=generator(3)))
    targets = 0.8 * (torch.rand(count, 3, generator=generator(4)) - 0.5)
    return rays.seen(eyes, unit(targets - eyes))[1]


def _shading(rays: RayMesh, light: LampAndSky, points: SurfacePoints, seed: int) -> torch.Tensor:
    environment = Environment(light.radiance().expand(-1, -1, 3))
    surface = Uniform(Lambert(), [0.5] * 3)
    return TracedObject(rays, environment, surface).light(points, 32, 0, generator(seed))


def test_a_white_surface_reads_what_a_lamp_and_sky_say():
    light = _light()
    towards = unit(light.towards[None])
    points = SurfacePoints(2 * towards, towards, towards, towards)
    white = TracedObject(
        RAYS, Environment(light.radiance().expand(-1, -1, 3)), Uniform(Lambert(), [1.0] * 3)
    ).light(points, 4096, 0, generator(0))
    assert float(white.mean()) == pytest.approx(float(light.white_facing_the_lamp()), rel=0.03)


def test_a_light_survives_json_and_what_is_none_is_refused():
    light = _light()
    assert LampAndSky.from_json(light.to_json()).to_json() == light.to_json()
    assert LampAndSky.from_tensor(light.to_tensor()).to_json() == light.to_json()
    for change in ({"sky": [1.0]}, {"lamp": [1.0, math.nan]}, {"towards": "up"}):
        with pytest.raises((ValueError, TypeError)):
            LampAndSky.from_json({**light.to_json(), **change})


def test_a_fit_keeps_what_white_reads_and_begins_near_where_it_was_told():
    fitted = FittedLight()
    fitted.start_from(_light())
    assert_close(fitted.light().white_facing_the_lamp(), _light().white_facing_the_lamp())
    assert_close(fitted.towards.detach(), unit(_light().towards[None])[0])
    with torch.no_grad():
        fitted.log_lamp.add_(1.0)
        fitted.towards.copy_(torch.tensor([1.0, 0.0, 0.0]))
    assert_close(fitted.light().white_facing_the_lamp(), _light().white_facing_the_lamp())


def test_a_lamp_that_is_off_comes_back():
    """By the shading of a matt ball alone."""
    points, fitted, true = _seen(), FittedLight(), _light(lamp=(0.54, 0.06))
    fitted.start_from(_light((0.55, -0.35, 0.7)))
    optimiser = torch.optim.Adam(fitted.parameters(), lr=0.03)
    for step in range(80):
        wanted = _shading(RAYS, true, points, 1000 + step).detach()
        loss = (_shading(RAYS, fitted.light(), points, step) - wanted).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    cosine = float(unit(fitted.towards.detach()[None]) @ unit(true.towards[None]).T)
    assert math.degrees(math.acos(min(cosine, 1))) < 3  # from 13 degrees


def test_normals_that_are_off_come_nearer_and_are_smooth():
    """A dent in the normals of a ball, in light that is known."""
    true, faces = RAYS.mesh.normals, RAYS.mesh.faces
    towards = unit(_light().towards[None])[0]
    near = (true @ unit(torch.tensor([[0.9, 0.2, 0.4]])).T).clamp(min=0) ** 60
    dented = unit(true + 0.5 * near * towards)
    points, fitted = _seen(count=1000), FittedNormals(len(true))
    assert_close(fitted(dented, faces), dented)
    optimiser = torch.optim.Adam(fitted.parameters(), lr=0.02)
    hits = RAYS.closest(points.positions + 0.3 * points.to_eye, -points.to_eye)
    for step in range(40):
        rays = RAYS.with_normals(fitted(dented, faces))
        shown = rays.points(hits, -points.to_eye)
        wanted = _shading(RAYS, _light(), points, 1000 + step).detach()
        loss = (_shading(rays, _light(), shown, step) - wanted).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    with torch.no_grad():
        found = fitted(dented, faces)
    # One lamp tells how far normals lean towards it, and nothing of how they are turned about it.
    lit = true @ towards > 0.3
    before, after = (((one - true) @ towards)[lit].square().mean() for one in (dented, found))
    assert float(after) < 0.4 * float(before)
    assert_close(found.norm(dim=1), torch.ones(len(found)))


def test_normals_are_not_bent_as_a_whole():
    true, faces = RAYS.mesh.normals, RAYS.mesh.faces
    fitted = FittedNormals(len(true))
    with torch.no_grad():
        fitted.offsets.copy_(torch.tensor([0.3, -0.2, 0.1]).expand(len(true), 3))
    assert_close(fitted(true, faces), true)
