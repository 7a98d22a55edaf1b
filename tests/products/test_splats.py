"""Splats that are fitted to a scene: what they look like, what they are made of, and where files say that they are."""

from dataclasses import replace
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch
from plyfile import PlyData
from scipy.spatial.transform import Rotation

from tests.factories.ball_model import RADIUS, ball_scene, cameras_around
from tests.factories.cameras import FRAME
from unmix_plugin.errors import ConfigError
from unmix_plugin.products.product import Job
from unmix_plugin.products.scene_products import Splats
from unmix_plugin.products.splat_fit import FittedSplats, fit_splats, pinhole, seen_splats, start_splats
from unmix_plugin.products.splats import export
from unmix_plugin.spectral.metrics import psnr
from unmix_plugin.trained.run_views import RunView, world_up

SIDES = [
    (np.cos(angle), np.sin(angle), height) for height in (-0.6, 0.6) for angle in np.arange(6) * np.pi / 3
]
LEFT_OUT, SIDE_PX = (0.4, 0.9, 0.2), 24


def follow(_doing, items):
    return items


@pytest.fixture(scope="module")
def scene():
    """A ball of two materials and views around it."""
    cameras = cameras_around(SIDES, SIDE_PX)
    views = [RunView(str(index), camera, "train") for index, camera in enumerate(cameras)]
    return replace(ball_scene(), views=tuple(views), frame=FRAME)


@pytest.fixture(scope="module")
def start(scene):
    return start_splats(scene, 1500, follow)


@pytest.fixture(scope="module")
def fitted(scene, start):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("unmix_plugin.products.splat_fit._PICTURES_PER_VIEW", 1)  # none between the views
        return fit_splats(scene, start, 60, torch.Generator().manual_seed(0), follow)


def test_fitted_splats_look_like_the_field_from_where_they_were_not_fitted(scene, start, fitted):
    [camera] = cameras_around([LEFT_OUT], SIDE_PX)
    with torch.no_grad():
        field = scene.look(camera)["rgb"].float()
        before, after = (
            [psnr(splats.picture(pinhole(camera), times)[..., :3], field) for times in (2, 4)]
            for splats in (start, fitted)
        )
    assert min(after) > 30
    assert min(after) > min(before) + 3


def test_splats_start_as_discs_along_the_surface_no_closer_than_they_can_be_drawn(start):
    assert len(start) < 1500
    radii = start.positions.norm(dim=1)
    assert radii.sub(RADIUS).abs().max() < 0.03
    normals = Rotation.from_quat(start.rotations.numpy()).apply([0.0, 0.0, 1.0])
    assert ((normals * start.positions.numpy()).sum(axis=1) / radii.numpy()).min() > 0.9
    sizes = start.log_scales.exp()
    assert (sizes[:, 2] < 0.2 * sizes[:, 0]).all()
    # Discs whose standard deviation is three quarters of their distance cover the ball.
    assert float((sizes[:, 0] ** 2).sum()) == pytest.approx(0.75**2 * 4 * np.pi * RADIUS**2, rel=0.35)


def test_splats_are_made_of_what_is_seen_there_and_hidden_ones_are_left_out(scene, fitted):
    hidden = FittedSplats(*(values[:2] for values in vars(fitted).values()))
    places = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 9.0]])  # in the ball, and where no view looks
    hidden = replace(hidden, positions=places, log_scales=hidden.log_scales - 2)
    both = FittedSplats(
        *(torch.cat(parts) for parts in zip(vars(hidden).values(), vars(fitted).values(), strict=True))
    )
    kept, seen = seen_splats(scene, both, follow)
    assert len(kept) <= len(fitted)
    assert kept.positions.norm(dim=1).min() > 0.5
    assert kept.positions.norm(dim=1).max() < 0.7
    assert len(kept) > 0.9 * len(fitted)
    torch.testing.assert_close(seen.abundances.sum(dim=1), torch.ones(len(kept)))
    heights = kept.positions[:, 2]
    for material, there in ((0, heights > 0.1), (1, heights < -0.1)):
        assert seen.abundances[there, material].quantile(0.05) > 0.9


def test_a_splat_is_drawn_where_the_camera_sees_it_as_large_as_it_is_there():
    [camera] = cameras_around([(1.0, 0.3, 0.5)])
    place, size = torch.tensor([[0.2, 0.1, -0.3]]), 0.15
    splat = FittedSplats(
        place,
        torch.tensor([[0.1, -0.4, 0.3, 2.0]]),
        torch.full((1, 3), size).log(),
        torch.tensor([2.0]),
        torch.tensor([[1.0, 0.5, 0.0]]),
    )
    picture = splat.picture(camera, blur=0.0)
    opacity = picture[..., 3].double()
    centre, depth = camera.project(place, 0)
    rows, columns = torch.meshgrid(*(torch.arange(side) + 0.5 for side in opacity.shape), indexing="ij")
    found = [float((opacity * axis).sum() / opacity.sum()) for axis in (columns, rows)]
    np.testing.assert_allclose(found, centre[0], atol=0.1)
    spread = float((opacity * (columns - found[0]) ** 2).sum() / opacity.sum()) ** 0.5
    assert spread == pytest.approx(float(camera.focal_px[0, 0]) * size / float(depth), rel=0.1)
    torch.testing.assert_close(picture[..., 1], 0.5 * picture[..., 3])


@pytest.fixture(scope="module")
def files(scene, tmp_path_factory):
    def written(up):
        folder = tmp_path_factory.mktemp("splats")
        parts = {"scene": scene, "frame": FRAME, "materials": scene.materials, "folder": folder}
        job = MagicMock(spec=Job, loaded=MagicMock(scale=None), say=print, follow=follow, **parts)
        export(job, Splats(megabytes=0.05, steps=0, up=up))
        return folder

    return {up: written(up) for up in ("y", "z")}


def read(path):
    """Positions, rotations, standard deviations of a PLY of splats."""
    columns = PlyData.read(path)["vertex"]

    def stacked(*names):
        return np.stack([columns[name] for name in names], axis=1)

    turns = Rotation.from_quat(stacked("rot_1", "rot_2", "rot_3", "rot_0"))
    return stacked(*"xyz"), turns, np.exp(stacked("scale_0", "scale_1", "scale_2"))


def test_a_ply_has_splats_in_the_world_of_the_scene_and_keeps_to_its_size(files):
    path = files["z"] / "splats.ply"
    assert path.stat().st_size < 0.05e6 + 2000  # its header
    positions, turns, sizes = read(path)
    away = positions - FRAME.to_world(np.zeros(3))
    radii = np.linalg.norm(away, axis=1)
    np.testing.assert_allclose(radii, RADIUS / FRAME.scale, rtol=0.1)
    across = (turns.apply([0.0, 0.0, 1.0]) * away).sum(axis=1) / radii
    assert np.quantile(across, 0.05) > 0.9
    assert (sizes[:, 0] ** 2).sum() == pytest.approx(
        0.75**2 * 4 * np.pi * (RADIUS / FRAME.scale) ** 2, rel=0.5
    )


def test_what_is_up_is_minus_y_for_viewers(files, scene):
    (upright, turns, sizes), (plain, plain_turns, plain_sizes) = (
        read(files[up] / "splats.ply") for up in ("y", "z")
    )
    up = world_up(scene.views, FRAME)
    np.testing.assert_allclose(-upright[:, 1], plain @ up, atol=1e-4)
    np.testing.assert_allclose(-turns.apply([0, 0, 1])[:, 1], plain_turns.apply([0, 0, 1]) @ up, atol=1e-4)
    np.testing.assert_array_equal(sizes, plain_sizes)


@pytest.mark.parametrize(("words", "message"), [
    ({"megabytes": 0.0}, "--megabytes is 0; choose 0.01 to 1000"), ({"steps": -1}, "--steps is -1; choose 0 to 100000"),
])  # fmt: skip
def test_odd_sizes_are_refused(words, message):
    with pytest.raises(ConfigError, match=message):
        export(MagicMock(spec=Job), Splats(**words))
