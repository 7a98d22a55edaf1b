import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.captures.poses.pose_factory import assert_same_poses, metashape_document, ring, text_of
from unmix_plugin.captures.poses.lens import project_opencv
from unmix_plugin.captures.poses.reading import read_poses
from unmix_plugin.errors import CaptureError


def read(tmp_path, *args, **options):
    path = tmp_path / "cameras.xml"
    path.write_text(metashape_document(*args, **options), encoding="utf-8")
    return read_poses(path)


def lens_of(found):
    lens = next(iter(found.cameras.values())).lens
    assert lens is not None
    return lens


def test_cameras_of_groups_are_read_in_the_chunks_own_coordinates(tmp_path):
    found = read(tmp_path, ring())
    assert_same_poses(found, ring())
    lens = lens_of(found)
    assert (lens.focal_px, lens.center_px, lens.distortion) == ((500, 500), (323, 236), (0, 0, 0, 0))
    assert found.up is None


@pytest.mark.parametrize("place", ["component", "chunk"])
def test_the_similarity_leads_to_geocentric_coordinates_with_an_offset(tmp_path, place):
    rotation, scale = Rotation.from_euler("xyz", [0.5, 1.0, -2.0]).as_matrix(), 12.35
    middle = np.array([-2499366.43, -4256836.52, 4029217.97])
    element = (
        f"<transform><rotation>{text_of(rotation)}</rotation><translation>{text_of(middle)}</translation>"
        f"<scale>{scale}</scale></transform>"
    )
    found = read(tmp_path, ring(), **{place: element})
    world = {
        name: np.column_stack([rotation @ pose[:, :3], scale * rotation @ pose[:, 3] + middle])
        for name, pose in ring().items()
    }
    assert_same_poses(found, world, atol=1e-8)
    assert np.abs(next(iter(found.cameras.values())).camera_to_world).max() < 100
    assert found.up is not None
    np.testing.assert_allclose(found.up, middle / np.linalg.norm(middle), atol=1e-4)


def test_metashapes_p1_and_b1_are_ours_in_its_own_order(tmp_path):
    found = read(tmp_path, ring(), terms="<k1>0.1</k1><p1>0.01</p1><p2>0.02</p2><b1>2</b1>")
    lens = lens_of(found)
    x, y, squared = 0.3, -0.2, 0.13
    bent_x = x * (1 + 0.1 * squared) + 0.01 * (squared + 2 * x**2) + 2 * 0.02 * x * y
    bent_y = y * (1 + 0.1 * squared) + 0.02 * (squared + 2 * y**2) + 2 * 0.01 * x * y
    mine = project_opencv(np.array([[x, y]]), lens.focal_px, lens.center_px, lens.radial, lens.tangential)
    np.testing.assert_allclose(mine, [[323 + bent_x * 502, 236 + bent_y * 500]])


def test_higher_radial_terms_are_kept(tmp_path):
    found = read(tmp_path, ring(), terms="<k3>-0.05</k3><k4>0.01</k4>")
    assert lens_of(found).higher_radial == (-0.05, 0.01)
    assert not any("replaced" in note for note in found.notes)


def test_skew_is_fitted_and_its_effect_said(tmp_path):
    found = read(tmp_path, ring(), terms="<b2>0.3</b2><k3>0.01</k3>")
    assert any("replaced by the nearest" in note and "px" in note for note in found.notes)
    assert lens_of(found).distortion != (0, 0, 0, 0)
    with pytest.raises(CaptureError, match=r"sensor lens: .*by up to [\d.]+ px"):
        read(tmp_path, ring(), terms="<b2>80</b2>")


def test_a_sensor_without_calibration_has_its_nominal_focal_length(tmp_path):
    found = read(tmp_path, ring(), calibration="")
    assert lens_of(found).focal_px == (500, 400)
    assert any("not calibrated" in note for note in found.notes)


def test_cameras_that_are_disabled_or_not_aligned_are_left_out_and_named(tmp_path):
    extra = (
        '<camera id="90" sensor_id="0" label="loose"/>'
        '<camera id="91" sensor_id="0" label="off" enabled="false"><transform>1</transform></camera>'
    )
    found = read(tmp_path, ring(), extra=extra)
    assert_same_poses(found, ring())
    assert "1 camera without transform: loose" in found.notes
    assert "1 disabled camera left out" in found.notes
    with pytest.raises(CaptureError, match="none of 2 cameras is enabled and has a transform"):
        read(tmp_path, {}, extra=extra)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda text: text[:400], "not valid XML"),
        (lambda text: text.replace("<document", "<!DOCTYPE d><document", 1), "DOCTYPE"),
        (lambda text: text.replace("<transform>", "<transform>nan "), "expected 16 finite numbers"),
        (
            lambda text: text.replace('type="frame"', 'type="spherical"'),
            "spherical; expected frame or fisheye",
        ),
        (lambda text: text.replace('width="640"', 'width="-1"'), "has no resolution"),
        (lambda text: text.replace("<f>500", "<f>0"), "focal length 0"),
        (
            lambda text: (
                text.replace("<document", "<kml").replace("</document", "</kml").replace("chunk", "c")
            ),
            "<kml>",
        ),
    ],
)
def test_damaged_documents_are_refused(tmp_path, spoil, message):
    path = tmp_path / "cameras.xml"
    path.write_text(spoil(metashape_document(ring())), encoding="utf-8")
    with pytest.raises(CaptureError, match=message):
        read_poses(path)
