"""Files that a page asks for."""

import math

import numpy as np
import pytest
from PIL import Image

from tests.viewer.pages import opened


def test_a_screenshot_has_the_size_asked_for_and_lies_in_the_run_folder(viewer):
    with opened(viewer) as page:
        for label, value in (("width", 60), ("height", 40), ("file name", "../../../evil/../shot")):
            page.set(label, value)
        page.set("save a screenshot (PNG)", True)
        page.wait_until(lambda: bool(page.downloads))
        (path,) = viewer.services.folder.iterdir()
        assert path.name == "evil_.._shot.png"
        picture = Image.open(path)
        assert picture.size == (60, 40)
        assert np.asarray(picture).std() > 5


def test_spectra_are_saved_as_exr(viewer):
    import OpenEXR

    with opened(viewer) as page:
        page.set("width", 32)
        page.set("height", 24)
        page.set("save the spectra (EXR)", True)
        page.wait_until(lambda: page.downloads == ["view.exr"])
        (path,) = viewer.services.folder.iterdir()
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = file.channels()
            assert sum(name.startswith("S0.") for name in channels) == 5
            assert channels["S0.450,000000nm"].pixels.shape == (24, 32)


def test_pictures_too_large_are_refused(viewer):
    with opened(viewer) as page:
        page.set("width", 8192)
        page.set("height", 8192)
        page.set("save a screenshot (PNG)", True)
        page.wait_until(lambda: bool(page.notices))
        assert "8192 x 8192 pixels are too many" in page.notices[0][1]


@pytest.mark.parametrize(("label", "value"), [("width", 100_000), ("height", 1e9), ("width", -3)])
def test_a_size_out_of_bounds_is_refused_with_its_name(viewer, label, value):
    with opened(viewer) as page:
        page.set(label, value)
        for button in ("save a screenshot (PNG)", "save the spectra (EXR)"):
            page.set(button, True)
        page.wait_until(lambda: bool(page.notices))
        assert f"{label} is a number of pixels from 16 to 8192; found {value:g}" in page.notices[0][1]
        assert not viewer.services.folder.exists()


def test_a_path_through_key_frames_is_a_camera_file(viewer):
    from unmix_plugin.trained.camera_files.camera_files import read_camera_file
    from unmix_plugin.trained.world_frame import world_frame

    with opened(viewer) as page:
        for number, angle in enumerate((0.3, 0.8, 1.3), start=1):
            page.look_from(angle)
            page.set("add a key frame here", True)
            key = page.controls[page.control("key frame")]
            page.wait_until(lambda key=key, number=number: key.get("value") == f"{number} of {number}")
        page.set("seconds", 1.0)
        page.set("frames a second", 10)
        page.set("save the path", True)
        page.wait_until(lambda: any(title == "saved" for title, _ in page.notices))
        (path,) = viewer.services.folder.iterdir()
        found = read_camera_file(path, world_frame(viewer.services.source.record))
        assert (len(found.views), found.frames_per_second) == (10, 10.0)
        first = found.views[0].camera.camera_to_world[0, :, 3].tolist()
        assert first == pytest.approx([4 * math.cos(0.3), 4 * math.sin(0.3), 1.5], abs=1e-4)
