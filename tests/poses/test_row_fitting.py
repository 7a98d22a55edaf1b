import pytest
import torch
from jaxtyping import Float
from torch import Tensor
from torch.testing import assert_close

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.key_poses import KeyPoses, rotation_matrix
from unmix_plugin.engine.geometry.space import RayBundle, SceneBox
from unmix_plugin.poses.row_fitting import fit_rows, main_axes

ROWS, WIDTH, FOCAL_PX, HEIGHT, SWEEP = 64, 48, 60.0, 2.0, 2.0
BOX = SceneBox(torch.tensor([[-1.0, -1.0, -0.1], [1.0, 1.0, 0.1]]))
PIXEL = 1 / FOCAL_PX


def camera(wobble_px: float = 0.0) -> Cameras:
    """A sweep down the y axis, which turns about the camera's x and y axes in waves of that size."""
    heights = torch.arange(ROWS) + 0.5
    place = heights / ROWS
    turns = wobble_px * PIXEL * torch.stack([(7 * place).sin(), (9 * place).cos(), 0 * place], dim=1)
    places = torch.stack([0 * place, SWEEP * (0.5 - place), HEIGHT + 0 * place], dim=1)
    poses = torch.cat([rotation_matrix(turns), places[:, :, None]], dim=2)
    lens = (torch.full((1, 2), FOCAL_PX), torch.tensor([[WIDTH / 2, ROWS / 2]]), torch.zeros(1, 4))
    keys = KeyPoses(poses, heights, (ROWS,))
    return Cameras(poses[ROWS // 2, None], *lens, WIDTH, ROWS, key_poses=keys)


def seen(rays: RayBundle) -> Float[Tensor, "R 3"]:
    """Two smooth textures and the opacity of a disc at z = 0."""
    along = -rays.origins[:, 2] / rays.directions[:, 2]
    x, y = (rays.origins + along[:, None] * rays.directions)[:, :2].T
    opacity = ((0.8 - torch.stack([x, y]).norm(dim=0)) * 40).sigmoid()
    first = 0.5 + 0.25 * torch.sin(9 * x) * torch.cos(7 * y) + 0.15 * torch.sin(5 * x + 4 * y)
    second = 0.5 + 0.3 * torch.cos(8 * y - 3 * x)
    return torch.stack([first * opacity, second * opacity, opacity], dim=1)


def look(rays: RayBundle, axes: Float[Tensor, "2 C"]) -> Float[Tensor, "R D"]:
    found = seen(rays)
    return torch.cat([found[:, :2] @ axes, found[:, 2:]], dim=1)


def fitted(
    truth: Cameras, valid: Tensor | None = None, spoilt: slice = slice(0, 0), start: Cameras | None = None
) -> Cameras:
    """From the sweep without wobble, or another start, by the picture of `truth`, in which some rows are white."""
    picture = seen(truth.image_rays(0)).view(ROWS, WIDTH, 3)
    picture[spoilt] = 1.0
    valid = torch.ones(ROWS, WIDTH, dtype=torch.bool) if valid is None else valid
    return fit_rows(start or camera(), picture[..., :2], valid, picture[..., 2], BOX, look)


def off_by(found: Cameras, truth: Cameras) -> float:
    """Largest distance on the disc, pixels."""

    def on_ground(rays: RayBundle) -> Tensor:
        return rays.origins - rays.origins[:, 2:] / rays.directions[:, 2:] * rays.directions

    ours, theirs = on_ground(found.image_rays(0)), on_ground(truth.image_rays(0))
    return float((ours - theirs)[theirs.norm(dim=1) < 0.7].norm(dim=1).max()) / HEIGHT / PIXEL


@pytest.mark.parametrize("size_px", [1.0, 6.0])
def test_a_wobble_is_found(size_px: float) -> None:
    truth = camera(size_px)
    assert off_by(camera(), truth) > 0.9 * size_px
    assert off_by(fitted(truth), truth) < 0.1


def test_rows_that_fit_stay_where_they_are_also_those_of_key_poses() -> None:
    assert off_by(fitted(camera()), camera()) < 0.02
    truth = camera(1.0)
    assert off_by(fitted(truth, start=truth), truth) < 0.02


def test_pixels_that_are_not_valid_do_not_pull() -> None:
    valid = torch.ones(ROWS, WIDTH, dtype=torch.bool)
    valid[20:30] = False
    assert off_by(fitted(camera(), valid, slice(20, 30)), camera()) < 0.02
    found = fitted(camera(1.0), torch.zeros(ROWS, WIDTH, dtype=torch.bool))
    assert_close(found.image_rays(0).directions, camera().image_rays(0).directions, atol=1e-6, rtol=0)


def test_moved_rays_know_where_they_pass_the_picture() -> None:
    expected = camera().image_rays(0).offsets

    def look_at_offsets(rays: RayBundle, axes: Float[Tensor, "2 C"]) -> Float[Tensor, "R D"]:
        """A backdrop that stands still in the picture depends on them."""
        assert expected is not None
        assert rays.offsets is not None
        assert torch.equal(rays.offsets, expected.repeat(len(rays) // len(expected), 1))
        return look(rays, axes)

    picture = seen(camera().image_rays(0)).view(ROWS, WIDTH, 3)
    valid = torch.ones(ROWS, WIDTH, dtype=torch.bool)
    found = fit_rows(camera(), picture[..., :2], valid, picture[..., 2], BOX, look_at_offsets)
    assert off_by(found, camera()) < 0.1


def test_the_channels_that_are_compared_hold_all_that_two_materials_show() -> None:
    generator = torch.Generator().manual_seed(0)
    mixed = torch.rand(200, 2, generator=generator) @ torch.rand(2, 5, generator=generator)
    axes = main_axes(mixed)
    assert_close(mixed @ axes @ axes.T, mixed, atol=1e-5, rtol=0)
    assert main_axes(mixed[:0]).shape == (5, 3)
