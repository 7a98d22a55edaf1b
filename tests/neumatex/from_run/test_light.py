"""The light of an object from shading and shadows: a lamp, the sky, what can't be told, and what white reads."""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from unmix_plugin.neumatex.from_run.light import LitPoints, find_light
from unmix_plugin.neumatex.tracing.environment import (
    Environment,
    MovingFrame,
    directions_of_pixels,
    solid_angles,
)
from unmix_plugin.neumatex.tracing.families import SpectralFamily
from unmix_plugin.neumatex.tracing.mesh import mesh_of
from unmix_plugin.neumatex.tracing.path_tracer import TracedObject
from unmix_plugin.neumatex.tracing.rays import RayMesh

LAMP = torch.tensor([0.5, 1.0, 0.8])
ENDMEMBERS = torch.tensor([[0.8, 0.6, 0.4], [0.1, 0.2, 0.3]])
NUM_POINTS = 1500


def _subject() -> RayMesh:
    """Three balls on a plate."""
    parts = [trimesh.creation.box(extents=(2, 2, 0.1))]
    for place in ((-0.4, 0.3, 0.35), (0.45, -0.2, 0.3), (0.1, 0.6, 0.2)):
        ball = trimesh.creation.icosphere(subdivisions=3, radius=place[2] - 0.05)
        ball.apply_translation(place)
        parts.append(ball)
    whole: Any = trimesh.util.concatenate(parts)
    vertices = torch.tensor(np.array(whole.vertices[whole.faces.reshape(-1)]), dtype=torch.float32)
    normals = torch.tensor(np.array(whole.vertex_normals[whole.faces.reshape(-1)]), dtype=torch.float32)
    return RayMesh(mesh_of(vertices, torch.arange(len(vertices)).reshape(-1, 3), normals))


@dataclass(frozen=True)
class _TwoMaterials:
    """One on either side of x = 0, hardly specular."""

    family: SpectralFamily

    def parameters(self, positions: torch.Tensor) -> torch.Tensor:
        share = (positions[:, :1] > 0).float()
        return torch.cat([share, 1 - share, torch.full_like(share, 0.5), torch.zeros_like(share)], dim=1)


SUBJECT = _subject()


def _environment(towards: tuple[float, float, float] | None, sky: float = 0.3) -> Environment:
    directions = directions_of_pixels(32, 64)
    image = sky * (1.2 + directions[..., 2]) if towards is not None else torch.full((32, 64), sky)
    if towards is not None:
        towards_unit = torch.nn.functional.normalize(torch.tensor(towards), dim=0)
        image = image + 60.0 * ((directions @ towards_unit) > math.cos(math.radians(7)))
    return Environment(image[..., None])


def _lit(environment: Environment) -> LitPoints:
    drawn = torch.Generator().manual_seed(0)
    outwards = torch.nn.functional.normalize(torch.randn(4 * NUM_POINTS, 3, generator=drawn), dim=1)
    outwards[:, 2] = outwards[:, 2].abs()
    outwards = outwards[outwards[:, 2] > 0.2]
    targets = 1.6 * (torch.rand(len(outwards), 3, generator=drawn) - 0.5) * torch.tensor([1.0, 1.0, 0.3])
    found, points = SUBJECT.seen(targets + 5 * outwards, -outwards)
    points = points.select(torch.arange(int(found.sum()))[:NUM_POINTS])
    surface = _TwoMaterials(SpectralFamily(ENDMEMBERS))
    light = replace(environment, image=environment.image * LAMP)
    spectra = TracedObject(SUBJECT, light, surface).light(points, 64, 1, drawn)
    return LitPoints(points, spectra, surface.parameters(points.positions)[:, :2])


def _white(environment: Environment) -> torch.Tensor:
    """What white surfaces of many orientations read."""
    height, width = environment.image.shape[:2]
    directions = directions_of_pixels(height, width)
    powers = environment.image[..., 0] * solid_angles(height, width)[:, None].float()
    normals = directions_of_pixels(8, 16).reshape(-1, 3)
    return (
        torch.einsum("nhw,hw->n", torch.einsum("nc,hwc->nhw", normals, directions).clamp(min=0), powers)
        / math.pi
    )


@pytest.mark.parametrize("towards", [(0.5, 0.4, 0.8), (-0.7, 0.2, 0.4), (0.1, -0.9, 0.7)])
def test_a_lamp_is_found_where_it_is_and_materials_as_bright_as_they_are(towards):
    true = _environment(towards)
    alike = ENDMEMBERS / ENDMEMBERS.norm(dim=1, keepdim=True)
    found = find_light(SUBJECT, _lit(true), alike, LAMP, None)
    unit = np.array(towards) / np.linalg.norm(towards)
    assert found.direction is not None
    assert math.degrees(math.acos(min(1.0, float(found.direction @ unit)))) < 5
    expected, got = _white(true), _white(Environment(found.light.radiance()))
    assert float(got.max()) == pytest.approx(1, abs=0.03)
    assert float((got / got.max() - expected / expected.max()).abs().max()) < 0.15
    first, second = (alike.norm(dim=1) * torch.from_numpy(found.gains)).tolist()
    true_first, true_second = ENDMEMBERS.norm(dim=1).tolist()
    assert first / second == pytest.approx(true_first / true_second, rel=0.08)
    assert found.decision.subject == "light"
    assert not found.decision.is_undecided
    assert found.decision.flag == "--environment"


def test_even_light_is_said_to_tell_no_lamp():
    found = find_light(SUBJECT, _lit(_environment(None)), ENDMEMBERS, LAMP, None)
    assert found.direction is None
    assert found.decision.is_undecided
    sky = found.light.radiance()
    assert float(sky.max() / sky.mean()) < 3


def test_a_white_reference_says_how_bright_the_light_is():
    lit = _lit(_environment((0.5, 0.4, 0.8)))
    known = find_light(SUBJECT, lit, ENDMEMBERS, LAMP, 2.5)
    assert float(_white(Environment(known.light.radiance())).max()) == pytest.approx(2.5, rel=0.03)
    assert known.decision.evidence["brightness of white"] == "by the white reference"


def test_no_surface_is_brighter_than_white():
    lit = _lit(_environment((0.5, 0.4, 0.8)))
    bright = LitPoints(lit.points, 50 * lit.spectra, lit.abundances)
    found = find_light(SUBJECT, bright, ENDMEMBERS, LAMP, None)
    albedo = lit.abundances.double() @ (torch.from_numpy(found.gains)[:, None] * ENDMEMBERS.double())
    assert float(albedo.mean(dim=1).quantile(0.99)) == pytest.approx(0.95, rel=0.02)


def test_light_that_turns_with_the_camera_is_found_in_its_frame_and_in_no_other():
    """By what is left unexplained, which says whether light stands still."""
    turntable = MovingFrame("turntable", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    for moves in (None, turntable):
        environment = replace(_environment((0.5, 0.4, 0.8)), moves=moves)
        lit = _lit(environment)
        assert lit.points.eyes is not None
        still = find_light(SUBJECT, lit, ENDMEMBERS, LAMP, None)
        turned = replace(lit, light_axes=turntable.axes(lit.points.eyes))
        moving = find_light(SUBJECT, turned, ENDMEMBERS, LAMP, None)
        right, wrong = (still, moving) if moves is None else (moving, still)
        assert right.error < 0.5 * wrong.error
        assert right.direction is not None
        unit = np.array((0.5, 0.4, 0.8)) / np.linalg.norm((0.5, 0.4, 0.8))
        assert float(right.direction @ unit) > math.cos(math.radians(5))
    assert "to the camera's right" in moving.decision.outcome
