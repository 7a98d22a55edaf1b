"""Pictures in strips are the pictures of the whole."""

import threading

import numpy as np
import pytest

from tests.viewer.view_factory import make_frame, make_services, some_pose
from unmix_plugin.errors import ConfigError
from unmix_plugin.viewer.layers.painting import LayerSettings
from unmix_plugin.viewer.rendering import captures
from unmix_plugin.viewer.rendering.captures import (
    PictureCanvas,
    PictureRequest,
    SpectraCanvas,
    StripCapture,
    check_size,
)
from unmix_plugin.viewer.rendering.scene import Edit
from unmix_plugin.viewer.view_cameras import sized_camera


@pytest.fixture
def services(source):
    running = make_services(source)
    yield running
    running.stop()


def captured(services, camera, take, subpixels=1):
    """Capture a picture strip by strip; what it ended with, and the parts told."""
    ended, reasons, parts = threading.Event(), [], []

    def done(reason):
        reasons.append(reason)
        ended.set()

    request = PictureRequest(camera, Edit(), subpixels)
    capture = StripCapture(services.loop, request, take, done, parts.append)
    capture.start()
    assert ended.wait(120)
    return reasons[0], parts


@pytest.mark.parametrize("layer", ["rgb", "band", "depth", "segmentation", "pca"])
def test_strips_make_up_the_picture_of_the_whole(services, source, monkeypatch, layer):
    monkeypatch.setattr(captures, "_STRIP_PIXELS", 100)
    camera = sized_camera(some_pose(), 31, 23)
    settings, canvas = LayerSettings(layer=layer), PictureCanvas(camera)

    def take(row, frame):
        canvas.take(row, services.maker.paint(frame, settings, False, False).picture)

    reason, parts = captured(services, camera, take)
    assert reason == ""
    assert len(parts) >= 8
    assert parts == sorted(parts)
    assert parts[-1] == pytest.approx(1.0)
    whole = services.maker.paint(make_frame(source, camera), settings, False, False).picture
    assert np.abs(canvas.pixels.astype(int) - whole.astype(int)).max() <= 1


def test_spectra_of_strips_are_those_of_the_whole(services, source, monkeypatch):
    monkeypatch.setattr(captures, "_STRIP_PIXELS", 64)
    camera = sized_camera(some_pose(), 17, 13)
    canvas = SpectraCanvas(camera, 5)
    reason, _ = captured(services, camera, canvas.take)
    assert reason == ""
    frame = make_frame(source, camera)
    np.testing.assert_allclose(canvas.spectra, frame["spectral"].numpy(), atol=1e-5)
    np.testing.assert_allclose(canvas.coverage, frame.coverage.numpy(), atol=1e-5)


def test_a_strip_that_cannot_be_taken_ends_the_capture(services, caplog):
    def refuse(*_):
        raise OSError("the disk is full")

    reason, _ = captured(services, sized_camera(some_pose(), 16, 16), refuse)
    assert reason == "OSError: the disk is full"
    services.stop()
    assert "the disk is full" in caplog.text


def test_a_capture_can_be_cancelled(services, monkeypatch):
    monkeypatch.setattr(captures, "_STRIP_PIXELS", 64)
    ended, reasons = threading.Event(), []

    def done(reason):
        reasons.append(reason)
        ended.set()

    capture = StripCapture(
        services.loop,
        PictureRequest(sized_camera(some_pose(), 400, 400), Edit(), 1),
        lambda *_: capture.cancel(),
        done,
        lambda _: None,
    )
    capture.start()
    assert ended.wait(120)
    assert reasons == ["cancelled"]


@pytest.mark.parametrize(
    ("size", "message"),
    [
        ((8192, 8192, None), "67108864|too many for one picture"),
        ((4096, 4096, 31), "spectra of 4096 x 4096 pixels"),
    ],
)
def test_pictures_that_would_not_fit_are_refused(size, message):
    with pytest.raises(ConfigError, match=message):
        check_size(*size)
    check_size(4096, 4096)
    check_size(1024, 1024, 31)
