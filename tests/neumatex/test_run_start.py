"""Endmembers and abundances of a run of unmix-nerf at points of a mesh that lies in another space."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from tests.products.ball_model import RADIUS, ball_scene
from unmix_plugin.errors import ConfigError
from unmix_plugin.neumatex.run_start import RunMaterials
from unmix_plugin.spectral.bands import Bands

RUN = RunMaterials(Path("run"), ball_scene())
COUNT = len(RUN.scene.materials.endmembers)
TURN = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
SCALE, SHIFT = 0.5, np.array([0.3, -0.1, 0.2])


def _corners(scale=SCALE):
    """Of a model space in which the run's space is turned, scaled and shifted."""
    of_mesh = np.concatenate([np.zeros((1, 3)), np.eye(3)])
    return RUN.scene.frame.to_world((of_mesh * scale) @ TURN + SHIFT)


def _points(count=200):
    """Points and normals of the run's ball, in that model space."""
    outwards = torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    outwards = torch.nn.functional.normalize(outwards, dim=1)
    of_run = RADIUS * outwards.double().numpy()
    positions = torch.from_numpy((of_run - SHIFT) @ TURN.T / SCALE).float()
    return positions, torch.from_numpy(outwards.double().numpy() @ TURN.T).float(), outwards


def test_abundances_are_those_of_the_runs_surface_at_the_same_place_in_the_world():
    positions, normals, outwards = _points()
    shares = RUN.abundances(positions, normals, _corners())
    clear = outwards[:, 2].abs() > 0.1
    assert_close(shares[clear, 0], (outwards[clear, 2] > 0).float(), atol=0.02, rtol=0)
    assert_close(shares.sum(dim=1), torch.ones(len(shares)))


def test_a_run_of_another_place_is_refused():
    positions, normals, _ = _points()
    with pytest.raises(ConfigError, match="of the mesh's surface only"):
        RUN.abundances(positions, normals, _corners(scale=3.0))


def test_endmembers_become_reflectances_by_the_light():
    materials = RUN.scene.materials
    lamp = np.linspace(0.5, 1.0, len(materials.bands))
    found = RUN.reflectances(materials.bands, lamp, COUNT)
    light = torch.from_numpy(lamp).float() if materials.light is None else materials.light
    assert_close(found * light, materials.endmembers.detach())


@pytest.mark.parametrize(
    ("bands", "count", "expected"),
    [
        (Bands.of([400, 500]), COUNT, "they must be the same"),
        (RUN.scene.materials.bands, COUNT + 1, "num-endmembers is"),
    ],
)
def test_a_run_of_other_bands_or_another_number_is_refused(bands, count, expected):
    with pytest.raises(ConfigError, match=expected):
        RUN.reflectances(bands, np.ones(len(bands)), count)
