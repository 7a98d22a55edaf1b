"""Pictures in blocks are the pictures that a scene renders at once."""

import pytest
import torch
from torch.testing import assert_close

from tests.viewer.view_factory import make_frame, make_source
from unmix_plugin.trained.material_view import MaterialView
from unmix_plugin.trained.trained_scene import TrainedScene
from unmix_plugin.viewer.rendering.pictures import FrameRender, num_channels
from unmix_plugin.viewer.view_cameras import camera_of, pose_of


@pytest.mark.parametrize("subpixels", [1, 2])
@pytest.mark.parametrize("block", [7, 10_000])
@pytest.mark.parametrize("specular", ["none", "dictionary", "full"])
def test_blocks_give_what_the_scene_gives_at_once(tmp_path, subpixels, block, specular):
    source = make_source(tmp_path, specular=specular)
    camera = camera_of(pose_of(source.record.train_cameras[0]), 6)
    with source.borrowed() as scene:
        assert isinstance(scene, TrainedScene)
        expected = scene.look(camera, subpixels).coefficients
        render = FrameRender(camera, subpixels)
        total = 0
        while render.rays_left:
            total += render.render_block(scene, block)
        frame = render.frame(scene)
        assert isinstance(frame, MaterialView)
        assert num_channels(scene.materials) == expected.packed.shape[-1]
    assert total == render.num_rays == camera.width * camera.height * subpixels**2
    assert frame.coefficients.num_endmembers == expected.num_endmembers
    assert_close(frame.coefficients.packed, expected.packed, atol=1e-5, rtol=1e-5)


def test_a_block_is_spread_over_the_picture(source):
    camera = camera_of(pose_of(source.record.train_cameras[0]), 20)
    render = FrameRender(camera)
    with source.borrowed() as scene:
        render.render_block(scene, render.num_rays // 10)
    assert render._coefficients is not None
    rows = (render._coefficients.accumulation != 0).view(camera.height, camera.width)
    seen = make_frame(source, camera).coefficients.accumulation > 0
    halves = rows[:10].sum() / seen[:10].sum(), rows[10:].sum() / seen[10:].sum()
    assert all(0.05 < float(half) < 0.15 for half in halves)


def test_what_training_changes_later_does_not_change_a_frame(source, model):
    frame = make_frame(source)
    before = frame.materials.endmembers.clone()
    with source.device.training_turn(), torch.no_grad():
        model.endmembers.add_(1)
    assert_close(frame.materials.endmembers, before)
    assert_close(make_frame(source).materials.endmembers, before + 1)
    assert not frame.materials.endmembers.requires_grad


def test_a_render_leaves_the_model_in_the_mode_it_was_in(source, model):
    model.train()
    with source.borrowed() as scene:
        assert not scene.field.training
        scene.look(source.record.train_cameras[0])
    assert model.training
    assert model.field.training
