"""Training on sensors of different bands and sizes: each pixel is compared with what its own sensor sees."""

import re
from dataclasses import replace

import numpy as np
import torch
from torch.testing import assert_close

from tests.factories import models
from tests.factories.models import NUM_BANDS, initial_data, make_rays
from tests.factories.scenes import make_rig
from unmix_plugin.datamanager import HyperspectralDataManager
from unmix_plugin.engine.geometry.space import RayBundle
from unmix_plugin.model import UnmixModel
from unmix_plugin.sensors.views import MeasuredPixels, from_batch, to_batch
from unmix_plugin.settings import HyperspectralDataManagerConfig, LossConfig

BANDS = [2, 0, 3, 1]
RESPONSES = [[0.5, 0.5, 0.0, 0.0, 0.0], [0.0, 0.0, 0.2, 0.3, 0.5]]
SENSORS = [{"name": "spectral", "bands": BANDS}, {"name": "colour", "responses": RESPONSES}]
PIXELS, RAYS = (6, 3), (1, 4)


def make_model(**settings) -> UnmixModel:
    pixels = initial_data()["pixels"]
    seen = {"pixels": pixels[:, BANDS], "sensor": np.array(0), "typical": pixels.mean(axis=0)}
    return models.make_model(more_metadata={"sensors": SENSORS}, more_data=seen, **settings).train()


def make_batch() -> tuple[RayBundle, list[MeasuredPixels]]:
    generator = torch.Generator().manual_seed(3)
    rays, pixels, first = [], [], 0
    for sensor, (count, each, channels) in enumerate(zip(PIXELS, RAYS, (4, 2), strict=True)):
        spectra = 0.1 + 0.8 * torch.rand(count, channels, generator=generator)
        alpha = torch.rand(count, generator=generator)
        numbers = torch.arange(first, first + count)
        pixels.append(MeasuredPixels(sensor, count * each, spectra, alpha, numbers))
        rays.append(make_rays(count * each, seed=sensor))
        first += count
    return RayBundle.join(rays), pixels


def operator(sensor: int) -> torch.Tensor:
    return torch.eye(NUM_BANDS)[BANDS] if sensor == 0 else torch.tensor(RESPONSES)


def test_a_batch_is_the_pixels_that_it_was_made_of():
    rays, pixels = make_batch()
    batch = to_batch(pixels)
    assert batch["spectra"].shape == (9, 4)
    for own, expected in zip(from_batch(batch, len(rays), [4, 2].__getitem__), pixels, strict=True):
        assert (own.sensor, own.num_rays) == (expected.sensor, expected.num_rays)
        assert torch.equal(own.spectra, expected.spectra)
        assert torch.equal(own.pixels, expected.pixels)
        assert own.surfaces is None
    alone = replace(pixels[0], sensor=None)
    [whole] = from_batch(to_batch([alone]), alone.num_rays, [4].__getitem__)
    assert (whole.sensor, whole.num_rays, len(whole)) == (None, 6, 6)


def test_the_loss_is_the_mean_error_of_what_each_sensor_sees():
    settings = LossConfig(background="black", rgb=0.0, abundances=0.0)
    model = make_model(losses=settings).eval()
    rays, pixels = make_batch()
    loss = model.losses(model.training_batch(rays, pixels))["spectral"]
    spectra = model.get_outputs(rays)["spectral"]
    errors, first = [], 0
    for sensor, own in enumerate(pixels):
        seen = spectra[first : first + own.num_rays] @ operator(sensor).T
        errors.append((seen.unflatten(0, (len(own), -1)).mean(dim=1) - own.spectra).square().mean())
        first += own.num_rays
    assert_close(loss, 6 / 18 * errors[0] + 12 / 18 * errors[1])
    loss.backward()
    assert model.endmembers.grad is not None
    assert (model.endmembers.grad.abs().sum(dim=0) > 0).all()


def test_every_loss_works_on_every_sensor_and_pixels_of_few_channels_are_not_unmixed():
    model = make_model(losses=LossConfig(abundances=0.5)).train()
    rays, pixels = make_batch()
    opaque = [replace(own, alpha=torch.ones(len(own))) for own in pixels]
    outputs, losses, metrics = model.get_train_loss_dict(rays, to_batch(opaque))
    model.update(outputs)
    assert {"spectral", "rgb", "abundances"} <= losses.keys()
    assert all(loss.isfinite() and loss > 0 for loss in losses.values())
    assert metrics["psnr"].isfinite()
    assert [model.seen_by.tells_materials(sensor, 3) for sensor in (0, 1)] == [True, False]
    assert model.guide.margin_variance.isfinite()
    alone = model.losses(model.training_batch(rays[6:], pixels[1:]))
    assert "abundances" not in alone


def test_first_endmembers_are_right_on_the_bands_that_were_seen_and_positive_on_others():
    model = make_model()
    shapes = torch.eye(3, NUM_BANDS) * 0.6 + 0.1
    found = torch.nn.functional.normalize(model.endmembers.detach()[:, BANDS], dim=1)
    cosines = (found @ torch.nn.functional.normalize(shapes[:, BANDS], dim=1).T).amax(dim=0)
    assert (cosines > 0.99).all()
    assert (model.endmembers > 0).all()


def test_more_endmembers_than_channels_start_from_spectra_of_different_shape():
    model = make_model(num_endmembers=5)
    assert int(torch.linalg.matrix_rank(model.endmembers.detach(), rtol=1e-3)) == 5


def rig_manager(root, **settings) -> HyperspectralDataManager:
    settings = {"train_num_rays_per_batch": 400, "single_ray_until": 0.0, **settings}
    config = HyperspectralDataManagerConfig(grid_resolution=16, **settings)
    return config.setup(data=make_rig(root).root, device=torch.device("cpu"))


def test_each_view_gets_as_many_pixels_and_each_pixel_as_many_rays_whatever_their_size(tmp_path):
    """A batch of few coarse pixels with many rays each taught little, and saw the same cells again and again."""
    manager = rig_manager(tmp_path / "rig", subpixels=1)
    manager.set_train_rays_per_batch(4000)
    rays, batch = manager.next_train(0)
    assert batch["sensor_rays"].tolist() == [1, 1, 1]
    assert len(rays) == manager.get_train_rays_per_batch() == 4000
    drawn = torch.bincount(rays.camera_indices)
    expected = 4000 / len(manager.train_cameras)
    assert float((drawn - expected).abs().max()) < 5 * expected**0.5


def test_rays_of_a_coarse_pixel_lie_within_it(tmp_path):
    manager = rig_manager(tmp_path / "rig", subpixels=2)
    rays, batch = manager.next_train(0)
    assert batch["sensors"].tolist() == [0, 1, 2]
    assert batch["sensor_rays"].tolist() == [4, 4, 4]
    assert len(rays) == manager.get_train_rays_per_batch() == 400
    assert int(rays.camera_indices.max()) == 4
    start, count = int(batch["sensor_pixels"][0]), int(batch["sensor_pixels"][1])
    own = rays[slice(4 * start, 4 * (start + count))]
    for pixel in range(count):
        four = own[slice(4 * pixel, 4 * pixel + 4)]
        camera = int(four.camera_indices[0])
        points, _ = manager.train_cameras.project(four.origins + 2 * four.directions, camera)
        column, row = points.mean(dim=0).floor().long().tolist()
        assert ((points >= torch.tensor([column, row])) & (points <= torch.tensor([column, row]) + 1)).all()
        cube = manager.scene.cube(manager.scene.train_indices[camera])
        assert_close(batch["spectra"][start + pixel, :2], torch.from_numpy(cube[row, column]))


def _but_copies(warnings: list[str]) -> list[str]:
    """But for what is true of drawn views without noise."""
    return [warning for warning in warnings if "the very same values" not in warning]


def test_a_rig_says_which_sensor_is_alone_and_starts_from_the_one_with_most_channels(tmp_path):
    manager = rig_manager(tmp_path / "rig")
    data = manager.initial_data()
    assert data["pixels"].shape[1] == 4
    assert int(data["sensor"]) == 0
    np.testing.assert_allclose(data["typical"] / data["typical"][0], [1, 2.5, 4, 2], rtol=0.15)
    assert _but_copies(manager.warnings()) == []
    camera, batch = manager.eval_image(0)
    assert batch["spectra"].shape == (camera.height, camera.width, 4)
    assert int(batch["sensor"]) == 0


def test_sensors_that_share_no_band_are_named(tmp_path):
    folder = make_rig(tmp_path / "rig")
    for index in (0, 1, 2):
        folder.edit_cube(index, lambda cube: cube[..., [1, 3]])
        folder.edit(lambda content, index=index: content["frames"][index].update(bands=[1, 3], sensor="odd"))
    folder.edit(lambda content: content["train_filenames"].remove("images/view_5.png"))
    config = HyperspectralDataManagerConfig(grid_resolution=16)
    [warning] = _but_copies(config.setup(data=folder.root, device=torch.device("cpu")).warnings())
    assert "no other sensor shares a band with odd, small" in warning


def test_a_rig_whose_sensors_look_elsewhere_is_named(tmp_path):
    folder = make_rig(tmp_path / "rig")

    def turn_away(content) -> None:
        for frame in content["frames"]:
            if frame.get("sensor") == "small":
                matrix = np.array(frame["transform_matrix"])
                matrix[:3, 0] *= -1.0
                matrix[:3, 2] *= -1.0
                frame["transform_matrix"] = matrix.tolist()

    folder.edit(turn_away)
    config = HyperspectralDataManagerConfig(grid_resolution=16)
    said = config.setup(data=folder.root, device=torch.device("cpu")).warnings()
    assert any(
        re.search("of what sensor 'small' sees, the other sensors see 0 ?%", warning) for warning in said
    )


def test_endmembers_that_a_sensor_cannot_carry_are_named():
    (warning,) = make_model(num_endmembers=3).warnings()
    assert "3 endmembers are more than these sensors have channels: colour (2); materials" in warning
    (warning,) = make_model(num_endmembers=5).warnings()
    assert "spectral (4), colour (2)" in warning
    assert "try --endmembers 4" in warning
