"""How fine to render; pictures in blocks are the pictures that a scene renders at once; depth for the browser."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from tests.factories.files import present
from tests.factories.views import make_frame, make_source, some_pose
from unmix_plugin.editing import Recipe
from unmix_plugin.editing.recipe import Gloss, Remove
from unmix_plugin.trained import gradual
from unmix_plugin.trained.trained_scene import MaterialView, TrainedScene
from unmix_plugin.viewer.rendering import pictures
from unmix_plugin.viewer.rendering.scene import Edit
from unmix_plugin.viewer.rendering.settings import LayerSettings
from unmix_plugin.viewer.view_cameras import camera_of, pose_of


@pytest.mark.parametrize(
    ("specular", "subpixels", "block"),
    [("none", 1, 7), ("dictionary", 2, 31), ("full", 1, 31), ("full", 2, 10_000)],
)
def test_blocks_give_what_the_scene_gives_at_once(tmp_path, specular, subpixels, block):
    source = make_source(tmp_path, specular=specular)
    camera = camera_of(pose_of(source.record.train_cameras[0]), 6)
    with source.locked() as scene:
        assert isinstance(scene, TrainedScene)
        expected = scene.look(camera, subpixels).coefficients
        render = gradual.FrameRender(camera, subpixels)
        total = 0
        while render.rays_left:
            total += render.render_block(scene, block)
        frame = render.frame(scene)
        assert isinstance(frame, MaterialView)
        assert gradual.numbers_per_pixel(scene) == expected.packed.shape[-1]
    assert total == render.num_rays == camera.width * camera.height * subpixels**2
    assert frame.coefficients.num_endmembers == expected.num_endmembers
    assert_close(frame.coefficients.packed, expected.packed, atol=1e-5, rtol=1e-5)


def test_what_training_changes_later_does_not_change_a_frame(source, model):
    frame = make_frame(source)
    before = frame.materials.endmembers.clone()
    with source.device.training_turn(), torch.no_grad():
        model.endmembers.add_(1)
    assert_close(frame.materials.endmembers, before)
    assert_close(make_frame(source).materials.endmembers, before + 1)
    assert not frame.materials.endmembers.requires_grad


speeds = st.floats(1e3, 1e8)


@pytest.fixture(scope="module")
def maker(tmp_path_factory):
    return pictures.PictureMaker(make_source(tmp_path_factory.mktemp("run")))


@given(speeds, st.floats(0.2, 5), st.integers(16, 2048))
def test_a_moving_picture_takes_no_longer_than_its_time(maker, speed, aspect, largest):
    maker.speed = pictures.Speedometer(speed)
    render = maker.first_render(replace(some_pose(), aspect=aspect), largest)
    assert 1 <= render.camera.height <= largest
    assert render.num_rays <= max(0.07 * speed, 256) * 1.1  # the width is a whole number
    maker.speed = pictures.Speedometer(3e7)
    assert maker.first_render(replace(some_pose(), aspect=1.0), 512).camera.height == 512


@given(st.integers(1, 512), st.integers(16, 2048))
def test_pictures_become_finer_until_the_finest_and_then_no_more(maker, start, largest):
    pose, frame = some_pose(), make_frame(maker.source)
    finest = maker.target_height(pose, largest)
    heights = [min(start, finest)]
    for _ in range(13):
        frame = replace(frame, camera=camera_of(pose, heights[-1]))
        heights.append(maker.finer_render(pose, frame, largest, 1).camera.height)
    assert heights[-1] == finest
    assert all(finer > height or finer == height == finest for height, finer in pairwise(heights))


def test_a_speedometer_follows_what_is_measured():
    speed = pictures.Speedometer()
    for _ in range(30):
        speed.add(1000, 0.01)
    assert speed.rays_per_second == pytest.approx(1e5, rel=0.01)
    assert speed.block_rays == pytest.approx(1e5 * 0.03, rel=0.01)
    before = speed.rays_per_second
    speed.add(0, 1.0)
    speed.add(100, 0.0)
    assert speed.rays_per_second == before
    assert (pictures.Speedometer(1.0).block_rays, pictures.Speedometer(1e12).block_rays) == (256, 1 << 17)


def test_depth_is_along_the_axis_where_something_is_and_far_elsewhere(source):
    camera = camera_of(pose_of(source.record.train_cameras[0]), 32)
    frame = make_frame(source, camera)
    maker = pictures.PictureMaker(source)

    def depth_of(frame):
        return present(maker.paint(frame, LayerSettings(), True, False).depth)

    depth = depth_of(frame)
    accumulation = frame.coefficients.accumulation.numpy()
    assert depth.shape == (camera.height, camera.width)
    assert (depth[accumulation <= 0.5] == np.float32(np.round(160 / 512e-5) * 512e-5)).all()
    seen = accumulation > 0.5
    assert seen.any()
    bundle = camera.image_rays(0)
    distance = (frame.coefficients.distance / frame.coefficients.accumulation.clamp(min=1e-6)).flatten()
    _, expected = camera.project(bundle.origins + distance[:, None] * bundle.directions, 0)
    expected = expected.view(camera.height, camera.width).numpy()
    assert np.abs(depth[seen] - expected[seen]).max() < 0.003
    units = np.round(depth.astype(np.float64) * 100_000).astype(np.int64)  # the browser's; low bits are empty
    assert_close(units % 512, np.zeros_like(units))
    fine = make_frame(source, camera_of(pose_of(source.record.train_cameras[0]), 300))  # of every other pixel
    depth, accumulation = depth_of(fine), fine.coefficients.accumulation[1::2, 1::2].numpy()
    assert depth.shape == (150, fine.camera.width // 2)
    assert ((depth > 100) == (accumulation <= 0.5)).all()


@pytest.mark.parametrize(
    "edit", [Gloss(0, 0.5, (1.0, 0.8, 0.0)), Gloss(None, 1.0, (1.0, 0.8, 0.0)), Remove((1,))]
)
def test_every_layer_shows_edits_of_gloss_and_of_what_is_there(tmp_path, edit):
    maker = pictures.PictureMaker(make_source(tmp_path))
    change = Edit(Recipe((edit,)))
    render = gradual.FrameRender(camera_of(pose_of(maker.source.record.train_cameras[0]), 8))
    frame = maker.advance(render, change, render.num_rays, 1.0)
    assert isinstance(frame, MaterialView)
    for layer in set(maker.layers) - {"error", "index"}:
        assert maker.paint(frame, LayerSettings(layer=layer), False, False).picture.shape == (8, 12, 3)
    aids = maker.aids.for_layers(maker.edited(change))
    assert aids.reference_view(frame)["spectral"].isfinite().all()
    assert_close(aids.reference.abundances[:, 1].max() > 0, torch.tensor(not isinstance(edit, Remove)))
