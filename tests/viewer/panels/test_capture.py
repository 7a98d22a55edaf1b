"""Files that a page saves: pictures and spectra of a size, paths of cameras."""

import math

import numpy as np
import pytest
from PIL import Image

from tests.factories.renders import read_exr
from unmix_plugin.trained.camera_files import read_camera_file
from unmix_plugin.trained.run_views import world_frame


def test_pictures_and_spectra_have_the_size_asked_for_and_lie_in_the_run_folder(viewer, page):
    page.set_all({"width": 60, "height": 40, "file name": "../../../evil/../shot"})
    page.set("save a screenshot (PNG)")
    page.wait_until(lambda: bool(page.downloads))
    (path,) = viewer.services.folder.glob("[!.]*")
    assert path.name == "evil_.._shot.png"
    picture = Image.open(path)
    assert picture.size == (60, 40)
    assert np.asarray(picture).std() > 5
    page.set_all({"width": 32, "height": 24, "file name": "view"})
    page.set("save the spectra (EXR)")
    page.wait_until(lambda: "view.exr" in page.downloads)
    found = read_exr(viewer.services.folder / "view.exr")
    assert found["S0.450,000000nm"].shape == (24, 32)


@pytest.mark.slow
def test_sizes_that_are_too_large_or_out_of_bounds_are_refused(viewer, page):
    for label, value in (("width", 100_000), ("height", 1e9), ("width", -3)):
        page.set_all({"width": 1024, "height": 1024, label: value})
        page.set("save the spectra (EXR)" if value < 0 else "save a screenshot (PNG)")
        page.wait_for_notice(f"{label} is a number of pixels from 16 to 8192; found {value:g}")
    page.set_all({"width": 8192, "height": 8192})
    page.set("save a screenshot (PNG)")
    page.wait_for_notice("8192 x 8192 pixels are too many")
    assert not viewer.services.folder.exists()


def test_a_path_through_key_frames_is_a_camera_file(viewer, page):
    for number, angle in enumerate((0.3, 0.8, 1.3), start=1):
        page.look_from(angle)
        page.set("add a key frame here")
        key = page.props("key frame")
        page.wait_until(lambda key=key, number=number: key.get("value") == f"{number} of {number}")
    page.set_all({"seconds": 1.0, "frames a second": 10, "width": 641, "height": 360})
    page.set("save the path")
    page.wait_until(lambda: any(title == "saved" for title, _ in page.notices))
    (path,) = viewer.services.folder.glob("[!.]*")
    found = read_camera_file(path, world_frame(viewer.services.source.record))
    assert (len(found.views), found.frames_per_second) == (10, 10.0)
    camera = found.views[0].camera
    assert (camera.width, camera.height) == (640, 360)  # even, as encoders of videos want it
    place = camera.camera_to_world[0, :, 3].tolist()
    assert place == pytest.approx([4 * math.cos(0.3), 4 * math.sin(0.3), 1.5], abs=1e-4)
    assert camera.focal_px[0].tolist() == pytest.approx([180 / math.tan(0.4)] * 2, rel=1e-4)
