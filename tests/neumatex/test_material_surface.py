"""A fit starts from a plain material."""

import pytest
import torch

from unmix_plugin.neumatex.material_surface import TriplaneSurface, material_family, start_plain
from unmix_plugin.neumatex.triplane import Triplane


@pytest.mark.parametrize("name", ["neural", "pbr"])
def test_a_new_triplane_is_grey_and_reflects_as_what_is_no_metal(name):
    family = material_family(name)
    generator = torch.Generator().manual_seed(2)
    triplane = Triplane(family.num_parameters, 16, generator=generator)
    start_plain(triplane, family)
    positions = 2 * torch.rand(200, 3, generator=generator) - 1
    parameters = TriplaneSurface(family, triplane).parameters(positions).detach()
    assert family.base_colour(parameters).sub(0.5).abs().mean() < 0.1
    up = torch.tensor([[0.0, 0.0, 1.0]]).expand(200, 3)
    side = torch.nn.functional.normalize(torch.tensor([[0.7, 0.0, 1.0]]), dim=-1).expand(200, 3)
    reflectance = family.evaluate(parameters, side, up)
    dark = torch.cat([torch.full((200, 3), 0.02), parameters[:, 3:]], dim=-1)
    # Nearly all of it is the base colour's: a metal's highlight would not go with it.
    assert family.evaluate(dark, side, up).mean() < 0.35 * reflectance.mean()
