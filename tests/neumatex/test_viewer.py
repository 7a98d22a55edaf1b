"""An object in the viewer: its layers, its lights, and pictures that become finer."""

import numpy as np
import pytest
import torch
from PIL import Image

from tests.factories.surfaces import RECORD, make_object
from tests.factories.viewers import decoded, has_control, opened, serving, show_layer
from tests.factories.views import make_source, no_scene
from unmix_plugin.engine.runs.run_folder import RunFolder
from unmix_plugin.engine.training.training_control import DeviceLock
from unmix_plugin.errors import ConfigError, SceneError
from unmix_plugin.formats.exr import write_exr
from unmix_plugin.trained.model_scene import LightChoice, ModelView, relit
from unmix_plugin.viewer.rendering import render_loop
from unmix_plugin.viewer.rendering.scene import SceneSource
from unmix_plugin.viewer.session import Services
from unmix_plugin.viewer.view_cameras import camera_of, sized_camera


@pytest.fixture
def source(tmp_path):
    scene = make_object()
    return SceneSource(RunFolder(tmp_path), RECORD, DeviceLock(), lambda: scene)


def finished(page, viewer):
    """Wait for the last estimate of the finest picture; its colours."""
    (session,) = viewer.sessions
    view = session.view

    def is_finished():
        frame = view.frame
        return (
            isinstance(frame, ModelView)
            and frame.camera.height == 48
            and view.moved_at is view.restyled_at is None
            and frame.num_estimates == frame.num_wanted == 4
        )

    page.wait_until(is_finished)
    assert isinstance(view.frame, ModelView)
    return view.frame


def test_every_output_is_a_layer_and_the_picture_becomes_as_fine_as_a_finished_view(source):
    with serving(source) as (viewer, _), opened(viewer, rows=48) as page:
        with source.locked() as scene:
            titles = [output.title for output in scene.outputs]
        assert page.controls[page.control("layer")]["options"] == titles
        pictures = [show_layer(page, title) for title in titles[1:]]
        assert all(picture.std() > 3 for picture in pictures)
        frame = finished(page, viewer)
        estimates = [scene.estimate(frame.camera, 1, number) for number in range(4)]
        assert torch.allclose(frame["base_colour"], estimates[0]["base_colour"])
        assert frame["rgb"].shape == estimates[0]["rgb"].shape


def test_a_users_environment_is_offered_and_lights_the_object(source, tmp_path):
    path = tmp_path / "lamp.exr"
    colours = {name: np.full((4, 8), value, np.float32) for name, value in zip("RGB", (2, 0, 0), strict=True)}
    write_exr(path, colours, {})
    services = Services(source, no_scene, environments=[path])
    assert services.lights[-1] == str(path)
    with source.locked() as scene:
        red = relit(scene, LightChoice(services.lights[-1]), "neumatex")
    seen = red.render(RECORD.train_cameras[0], ["linear_rgb"])["linear_rgb"]
    assert float(seen[..., 0].max()) > 0.05
    assert float(seen[..., 1:].max()) == 0


def test_an_environment_that_is_missing_or_of_no_use_to_the_method_is_refused_at_once(source, tmp_path):
    with pytest.raises(SceneError, match=r"none.exr"):
        Services(source, no_scene, environments=[tmp_path / "none.exr"])
    with pytest.raises(ConfigError, match="no environment that could be exchanged"):
        Services(make_source(tmp_path), no_scene, environments=[tmp_path / "none.exr"])


def test_light_is_exchanged_and_turned_for_this_page_alone_and_kept_when_it_is_loaded_again(source):
    with serving(source) as (viewer, _), opened(viewer, rows=48) as page:
        assert has_control(page, "environment")
        before = finished(page, viewer)["linear_rgb"]
        page.set("environment", "studio")
        page.set("turned by (deg)", 90)
        (session,) = viewer.sessions
        page.wait_until(lambda: session.view.frame_edit.light.rotation_deg == 90)
        relit = finished(page, viewer)["linear_rgb"]
        assert float((relit - before).abs().mean()) > 0.1 * float(before.mean())
        assert session.state.light.name == "studio"
        page.set("environment", "no such light")
        page.set("turned by (deg)", float("nan"))
        page.set("turned by (deg)", 0)
        page.wait_until(lambda: session.view.frame_edit.light.rotation_deg == 0)
        again = finished(page, viewer)["linear_rgb"]
        np.testing.assert_allclose(again.mean(), before.mean(), rtol=0.05)
        assert decoded(page.last_picture).shape == (48, 64, 3)


def test_a_click_reads_the_numbers_of_the_light_that_is_shown(source):
    light = LightChoice("studio", exposure_stops=3.0)
    with serving(source) as (viewer, _), opened(viewer, rows=48) as page:
        page.set("environment", light.name)
        page.set("brightness (stops)", light.exposure_stops)
        (session,) = viewer.sessions
        page.wait_until(lambda: session.view.edit.light == light)
        page.click(0.5, 0.5)
        page.wait_until(lambda: "linear_rgb" in page.texts)
        camera = camera_of(session.pose(), 512)
        with source.locked() as scene:
            lit = relit(scene, light, "neumatex").probe(camera, camera.width // 2, camera.height // 2)
            plain = scene.probe(camera, camera.width // 2, camera.height // 2)
        first, other = (
            ", ".join(f"{value:.4g}" for value in one.values["linear_rgb"]) for one in (lit, plain)
        )
        assert first in page.texts
        assert other not in page.texts
        page.set("brightness (stops)", 0.0)
        page.wait_for_text("The light has changed")
        assert "linear_rgb" not in page.texts


def test_the_strips_of_a_screenshot_have_the_scale_of_the_picture_on_screen(source, monkeypatch):
    monkeypatch.setattr(render_loop, "_STRIP_PIXELS", 32 * 6)
    with serving(source) as (viewer, _), opened(viewer, rows=48) as page:
        show_layer(page, "depth")
        finished(page, viewer)
        (session,) = viewer.sessions
        page.set("width", 32)
        page.set("height", 24)
        page.set("save a screenshot (PNG)", True)
        page.wait_until(lambda: page.downloads == ["view.png"])
        camera, maker = sized_camera(session.pose(), 32, 24), viewer.services.maker
        settings = session.view.settings.changed("value_range", session.value_range_shown)
        with source.locked() as scene:
            whole = maker.paint(scene.look(camera, session.view.subpixels), settings, False, False).picture
    saved = np.asarray(Image.open(viewer.services.folder / "view.png").convert("RGB"))
    np.testing.assert_allclose(saved, whole, atol=1)
