"""Training on sensors of different bands and sizes: each pixel is compared with what its own sensor sees."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from tests.method_factory import BOX, CONFIG, NUM_BANDS, WAVELENGTHS_NM, initial_data, make_rays
from tests.scenes.rig_factory import make_rig
from unmix_plugin.datamanager import HyperspectralDataManager
from unmix_plugin.datamanager_settings import HyperspectralDataManagerConfig
from unmix_plugin.losses.training_losses import LossConfig
from unmix_plugin.model import UnmixModel
from unmix_plugin.sensors.batches import join_parts, split_parts

BANDS = [2, 0, 3, 1]
RESPONSES = [[0.5, 0.5, 0.0, 0.0, 0.0], [0.0, 0.0, 0.2, 0.3, 0.5]]
SENSORS = [{"name": "spectral", "bands": BANDS}, {"name": "colour", "responses": RESPONSES}]
PIXELS, RAYS = (6, 3), (1, 4)


def make_model(**settings) -> UnmixModel:
    metadata = {
        "wavelengths_nm": WAVELENGTHS_NM,
        "illuminant": None,
        "has_alpha": True,
        "grid_resolution": 8,
        "subpixels": 2,
        "pixel_size": 0.087,
        "sensors": SENSORS,
    }
    torch.manual_seed(0)
    model: UnmixModel = replace(CONFIG, **settings).setup(scene_box=BOX, metadata=metadata)
    data = initial_data()
    typical = data["pixels"].mean(axis=0)
    seen = {**data, "pixels": data["pixels"][:, BANDS], "sensor": np.array(0), "typical": typical}
    with torch.no_grad():
        model.initialise(seen, torch.Generator().manual_seed(0))
        model.field.get_parameter("table").normal_(std=0.5)
    return model


def make_batch():
    generator = torch.Generator().manual_seed(3)
    parts, first = [], 0
    for sensor, (count, rays, channels) in enumerate(zip(PIXELS, RAYS, (4, 2), strict=True)):
        measured = {
            "spectra": 0.1 + 0.8 * torch.rand(count, channels, generator=generator),
            "alpha": torch.rand(count, generator=generator),
            "pixels": torch.arange(first, first + count),
        }
        parts.append((sensor, make_rays(count * rays, seed=sensor), measured))
        first += count
    return join_parts(parts)


def operator(sensor: int) -> torch.Tensor:
    return torch.eye(NUM_BANDS)[BANDS] if sensor == 0 else torch.tensor(RESPONSES)


def test_what_was_joined_comes_apart_again():
    rays, batch = make_batch()
    assert batch["spectra"].shape == (9, 4)
    outputs = {"accumulation": torch.arange(18.0), "num_samples": torch.tensor(5)}
    first, second = split_parts(outputs, batch, [4, 2].__getitem__)
    assert (first.sensor, second.sensor) == (0, 1)
    assert (first.share, second.share) == pytest.approx((6 / 18, 12 / 18))
    assert second.outputs["accumulation"].tolist() == list(range(6, 18))
    assert second.batch["spectra"].shape == (3, 2)
    assert second.batch["pixels"].tolist() == [6, 7, 8]
    assert len(rays) == 18
    [whole] = split_parts(outputs, {"spectra": torch.zeros(18, 3)}, [3].__getitem__)
    assert whole.outputs is outputs


def test_the_loss_is_the_mean_error_of_what_each_sensor_sees():
    model = make_model(
        losses=LossConfig(background="black", rgb=0.0, opacity=0.0, spread=0.0, abundances=0.0)
    ).eval()
    rays, batch = make_batch()
    outputs = model.get_outputs(rays)
    loss = model.get_loss_dict(outputs, batch)["spectral"]
    model.seen_by = type(model.seen_by)((), model.rgb_weights)
    spectra = model.get_outputs(rays)["spectral"]
    errors, first_ray, first_pixel = [], 0, 0
    for sensor, (count, num_rays) in enumerate(zip(PIXELS, RAYS, strict=True)):
        seen = spectra[first_ray : first_ray + count * num_rays] @ operator(sensor).T
        pixels = seen.unflatten(0, (count, num_rays)).mean(dim=1)
        measured = batch["spectra"][first_pixel : first_pixel + count, : pixels.shape[1]]
        errors.append((pixels - measured).square().mean())
        first_ray, first_pixel = first_ray + count * num_rays, first_pixel + count
    assert_close(loss, 6 / 18 * errors[0] + 12 / 18 * errors[1])
    loss.backward()
    assert model.endmembers.grad is not None
    assert (model.endmembers.grad.abs().sum(dim=0) > 0).all()


def test_every_loss_works_on_every_sensor_and_pixels_of_few_channels_are_not_unmixed():
    model = make_model(losses=LossConfig(abundances=0.5)).train()
    rays, batch = make_batch()
    outputs = model.get_outputs(rays)
    losses = model.get_loss_dict(outputs, batch, model.get_metrics_dict(outputs, batch))
    assert {"spectral", "rgb", "abundances"} <= losses.keys()
    assert all(loss.isfinite() and loss > 0 for loss in losses.values())
    assert [model.seen_by.tells_materials(sensor, 3) for sensor in (0, 1)] == [True, False]
    model.observe(outputs, {**batch, "alpha": torch.ones(9)})
    assert model.guide.margin_variance.isfinite()
    _, colour = split_parts(outputs, batch, model.seen_by.num_channels)
    alone = {**colour.batch, "sensors": torch.tensor([1])}
    alone |= {"sensor_pixels": torch.tensor([3]), "sensor_rays": torch.tensor([4])}
    assert "abundances" not in model.get_loss_dict(dict(colour.outputs), alone)


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
    config = HyperspectralDataManagerConfig(
        train_num_rays_per_batch=400, grid_resolution=16, single_ray_until=0.0, **settings
    )
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


def test_a_rig_says_which_sensor_is_alone_and_starts_from_the_one_with_most_channels(tmp_path):
    manager = rig_manager(tmp_path / "rig")
    data = manager.initial_data()
    assert data["pixels"].shape[1] == 4
    assert int(data["sensor"]) == 0
    np.testing.assert_allclose(data["typical"] / data["typical"][0], [1, 2.5, 4, 2], rtol=0.15)
    assert manager.warnings() == []
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
    [warning] = config.setup(data=folder.root, device=torch.device("cpu")).warnings()
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
        "of what sensor 'small' sees, the other sensors see 0 %" in warning.replace("0%", "0 %")
        for warning in said
    )


def test_endmembers_that_a_sensor_cannot_carry_are_named():
    (warning,) = make_model(num_endmembers=3).warnings()
    assert (
        "3 endmembers are more than these sensors have channels: colour (2); materials are found" in warning
    )
    (warning,) = make_model(num_endmembers=5).warnings()
    assert "spectral (4), colour (2)" in warning
    assert "try --endmembers 4" in warning
