"""Depth for the browser: where the picture is, far where nothing is, in steps that pack well."""

import numpy as np
from torch.testing import assert_close

from tests.viewer.view_factory import make_frame
from unmix_plugin.viewer.rendering.pictures import FAR, picture_depth
from unmix_plugin.viewer.view_cameras import camera_of, pose_of


def test_depth_is_along_the_axis_where_something_is_and_far_elsewhere(source):
    camera = camera_of(pose_of(source.record.train_cameras[0]), 32)
    frame = make_frame(source, camera)
    depth = picture_depth(frame)
    accumulation = frame.coefficients.accumulation.numpy()
    assert depth.shape == (camera.height, camera.width)
    assert (depth[accumulation <= 0.5] == np.float32(np.round(FAR / 512e-5) * 512e-5)).all()
    seen = accumulation > 0.5
    assert seen.any()
    bundle = camera.image_rays(0)
    distance = (frame.coefficients.distance / frame.coefficients.accumulation.clamp(min=1e-6)).flatten()
    _, expected = camera.project(bundle.origins + distance[:, None] * bundle.directions, 0)
    expected = expected.view(camera.height, camera.width).numpy()
    assert np.abs(depth[seen] - expected[seen]).max() < 0.003


def test_fine_pictures_have_the_depth_of_every_nth_pixel(source):
    camera = camera_of(pose_of(source.record.train_cameras[0]), 300)
    frame = make_frame(source, camera)
    coefficients = frame.coefficients
    depth = picture_depth(frame)
    assert depth.shape == (150, camera.width // 2)
    far = coefficients.accumulation[1::2, 1::2].numpy() <= 0.5
    assert ((depth > 100) == far).all()


def test_depths_have_empty_low_bits_in_the_units_of_the_browser(source):
    depth = picture_depth(make_frame(source))
    units = np.round(depth.astype(np.float64) * 100_000).astype(np.int64)
    assert_close(units % 512, np.zeros_like(units))
