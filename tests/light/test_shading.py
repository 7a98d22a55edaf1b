import torch
from torch.nn.functional import normalize
from torch.testing import assert_close

from unmix_plugin.light.shading import Lamplight, LampShading

COUNT = 400
UPWARDS = torch.tensor([0.0, 0.0, 1.0])


class FacingUp(LampShading):
    """Of which all normals are upwards and a quarter of the light comes from all around."""

    def surface(self, features):
        up = UPWARDS[None].repeat(len(features), 1)
        return up, torch.full((len(features), 1), 0.25)


def light_from(towards: torch.Tensor, visible: float = 1.0) -> Lamplight:
    return Lamplight(torch.full((len(towards),), visible), normalize(towards, dim=1))


def seen(towards: torch.Tensor, directions: torch.Tensor, visible: float = 1.0):
    shading = FacingUp(2, 4, UPWARDS)
    return shading(torch.zeros(len(towards), 2), normalize(directions, dim=1), light_from(towards, visible))


def test_a_matt_surface_is_as_bright_as_it_faces_the_lamp_and_in_the_shadow_as_the_light_all_around():
    towards = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    brightness = seen(towards, -towards).brightness[:, 0]
    assert_close(brightness, torch.tensor([1.0, 0.25 + 0.75 * 0.5**0.5, 0.25, 0.25]))
    shadowed = seen(towards, -towards, visible=0.0)
    assert_close(shadowed.brightness, torch.full((4, 1), 0.25))
    assert float(shadowed.lobes.max()) == 0


def test_gloss_shows_where_the_eye_is_in_the_mirror_direction():
    towards = torch.tensor([[1.0, 0.0, 1.0]]).repeat(3, 1)
    mirrored = torch.tensor([[1.0, 0.0, -1.0], [1.3, 0.0, -1.0], [-1.0, 0.0, -1.0]])
    lobes = seen(towards, mirrored).lobes
    assert_close(lobes[0], torch.ones(4))
    assert bool((lobes[0] > lobes[1]).all() & (lobes[1] > lobes[2]).all())
    assert bool((lobes[1].diff() < 0).all())


def test_turning_the_whole_scene_changes_nothing_but_the_first_normals():
    generator = torch.Generator().manual_seed(1)
    turn, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator).double())
    turn = turn * torch.linalg.det(turn)
    towards, along = (normalize(torch.randn(50, 3, generator=generator).double(), dim=1) for _ in range(2))
    features = torch.randn(50, 4, generator=generator).double()
    one = LampShading(4, 8, UPWARDS).double()
    other = LampShading(4, 8, (turn @ UPWARDS.double()).float()).double()
    other.load_state_dict(one.state_dict())
    with torch.no_grad():
        *_, last = other.network.parameters()
        last[:3] = turn @ last[:3]
    expected = one(features, along, light_from(towards))
    found = other(features, along @ turn.T, light_from(towards @ turn.T))
    # As exact as the first normals, which are float32.
    assert_close(found.brightness, expected.brightness, rtol=2e-6, atol=2e-6)
    assert_close(found.lobes, expected.lobes, rtol=2e-6, atol=2e-6)


def test_normals_are_learnt_from_brightness_under_many_lamps_even_from_behind():
    """Normals that face away from every lamp at first: max(0, cosine) alone would give them no gradient."""
    generator = torch.Generator().manual_seed(0)
    true = normalize(torch.tensor([[0.6, 0.0, -0.8], [-0.6, 0.2, -0.8]]), dim=1)
    features = torch.eye(2).repeat(COUNT // 2, 1)
    normals = true.repeat(COUNT // 2, 1)
    towards = normalize(normals + 0.8 * torch.randn(COUNT, 3, generator=generator), dim=1)
    wanted = 0.3 + 0.7 * (normals * towards).sum(dim=1, keepdim=True).clamp(min=0)
    torch.manual_seed(0)
    shading = LampShading(2, 16, UPWARDS)
    optimiser = torch.optim.Adam(shading.parameters(), lr=0.01)
    for _ in range(400):
        optimiser.zero_grad()
        error = (shading(features, -towards, light_from(towards)).brightness - wanted).square().mean()
        error.backward()
        optimiser.step()
    with torch.no_grad():
        found, around = shading.surface(torch.eye(2))
    assert float((found * true).sum(dim=1).min()) > 0.99
    assert_close(around, torch.full((2, 1), 0.3), atol=0.03, rtol=0)
