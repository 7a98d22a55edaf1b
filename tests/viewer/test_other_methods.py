"""A run of a method without endmembers is shown by the outputs that its model names."""

import numpy as np
import pytest
import torch

from tests.engine.rgb_nerf_plugin import RgbNerf, RgbNerfConfig
from tests.viewer.pages import decoded, has_control, opened, serving, show_layer
from tests.viewer.view_factory import BOX, ring
from unmix_plugin.engine.outputs import Output
from unmix_plugin.engine.runs.load_run import SceneRecord
from unmix_plugin.engine.runs.run_folder import RunFolder
from unmix_plugin.engine.training.training_control import DeviceShare
from unmix_plugin.trained.model_scene import ModelScene
from unmix_plugin.trained.run_views import recorded_views
from unmix_plugin.trained.world_frame import world_frame
from unmix_plugin.viewer.rendering.scene import SceneSource

OUTPUTS = (
    Output("rgb", "srgb", "colour", "sRGB on black, 0 to 1"),
    Output("accumulation", "map", "opacity", "opacity, 0 to 1", (0.0, 1.0)),
    Output("label", "labels", "half", "upper or lower half"),
    Output("direction", "vectors", "direction", "viewing direction"),
)


class Described(RgbNerf):
    """The plain radiance field with outputs of each kind."""

    outputs = OUTPUTS

    def get_outputs(self, ray_bundle):
        found = super().get_outputs(ray_bundle)
        found["label"] = (ray_bundle.directions[:, 2] > -0.35).to(torch.uint8)
        found["direction"] = ray_bundle.directions
        return found


@pytest.fixture
def source(tmp_path):
    torch.manual_seed(0)
    model = Described(RgbNerfConfig(), scene_box=BOX, metadata={"grid_size": 6})
    cameras = ring()
    record = SceneRecord(BOX, {"grid_size": 6}, cameras, cameras[[1, 3]], {})
    scene = ModelScene(model.eval(), world_frame(record), recorded_views(record), OUTPUTS)
    return SceneSource(RunFolder(tmp_path), record, DeviceShare(), lambda: scene)


def test_all_that_a_method_names_is_shown_by_its_kind(source):
    with serving(source) as (viewer, _), opened(viewer) as page:
        assert page.controls[page.control("layer")]["options"] == [output.title for output in OUTPUTS]
        assert not has_control(page, "known material")
        assert not has_control(page, "save the spectra (EXR)")
        pictures = [show_layer(page, output.title) for output in OUTPUTS[1:]]
        assert all(picture.std() > 4 for picture in pictures)
        assert len(np.unique(pictures[1].reshape(-1, 3), axis=0)) == 2
        page.click(0.5, 0.5)
        page.wait_until(lambda: "direction" in page.texts and "rgb" in page.texts)
        page.set("width", 32)
        page.set("height", 24)
        page.set("save a screenshot (PNG)", True)
        page.wait_until(lambda: page.downloads == ["view.png"])


def test_the_finest_picture_is_the_view_that_the_scene_renders(source):
    with serving(source) as (viewer, _), opened(viewer, rows=48) as page:
        page.set("background", "black")
        before = len(page.pictures)
        page.set("layer", "direction")
        page.wait_until(lambda: len(page.pictures) > before)
        (view,) = (session.view for session in viewer._sessions.values())
        assert view.frame is not None
        with source.borrowed() as scene:
            expected = scene.look(view.frame.camera)
        torch.testing.assert_close(view.frame["direction"], expected["direction"])
        assert decoded(page.last_picture).shape == (48, 64, 3)
