"""Families accept no points at all, as when no path of a batch goes on."""

import pytest
import torch

from unmix_plugin.neumatex.materials.layered import LayeredFamily
from unmix_plugin.neumatex.materials.neural import NeuralFamily
from unmix_plugin.neumatex.materials.pbr import PbrFamily


@pytest.mark.parametrize("kind", [LayeredFamily, NeuralFamily, PbrFamily])
def test_no_points_have_no_reflectances(kind):
    family = kind()
    parameters, directions = torch.zeros(0, family.num_parameters), torch.zeros(0, 3)
    assert family.evaluate(parameters, directions, directions).shape == (0, 3)
    assert family.sample(parameters, directions, directions).shape == (0, 3)
    assert family.density(parameters, directions, directions).shape == (0,)
