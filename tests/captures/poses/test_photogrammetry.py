"""Poses of Metashape, MicMac and OpenSfM, against documents written by hand."""

import shutil

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.factories.files import present
from tests.factories.poses import (
    BROWN,
    CALIBRATION,
    FLIP,
    IDEAL,
    METASHAPE_CALIBRATION,
    ORIENTATION,
    PERSPECTIVE,
    RADIAL,
    as_json,
    assert_same_poses,
    by_hand,
    lens_of,
    metashape_document,
    pixels_in_file,
    reconstruction,
    ring,
    text_of,
    world_to_camera,
    write_json,
)
from unmix_plugin.captures.poses.pose_set import PosedCamera
from unmix_plugin.captures.poses.reading import read_poses
from unmix_plugin.errors import CaptureError
from unmix_plugin.scenes.placement import Placement


def read_metashape(tmp_path, *args, **options):
    path = tmp_path / "cameras.xml"
    path.write_text(metashape_document(*args, **options), encoding="utf-8")
    return read_poses(path)


@pytest.mark.parametrize(
    ("options", "lens", "note"),
    [
        ({}, {"focal_px": (500, 500), "center_px": (323, 236), "distortion": (0, 0, 0, 0)}, None),
        ({"terms": "<k3>-0.05</k3><k4>0.01</k4>"}, {"higher_radial": (-0.05, 0.01)}, None),
        ({"calibration": ""}, {"focal_px": (500, 400)}, "not calibrated"),
        ({"terms": "<b2>0.1</b2><k3>0.01</k3>"}, {}, "replaced by the nearest"),
        ({"extra": f"<!--{' ' * (17 << 20)}-->"}, {}, None),  # a large export
    ],
)
def test_cameras_of_groups_are_read_in_the_chunks_own_coordinates(tmp_path, options, lens, note):
    found = read_metashape(tmp_path, ring(), **options)
    assert_same_poses(found, ring())
    assert {name: getattr(lens_of(found), name) for name in lens} == lens
    assert found.up is None
    assert [note in text for text in found.notes] == [True] * (note is not None)


@pytest.mark.parametrize("place", ["component", "chunk"])
def test_the_similarity_leads_to_geocentric_coordinates_with_an_offset(tmp_path, place):
    rotation, scale = Rotation.from_euler("xyz", [0.5, 1.0, -2.0]).as_matrix(), 12.35
    middle = np.array([-2499366.43, -4256836.52, 4029217.97])
    parts = f"<rotation>{text_of(rotation)}</rotation><translation>{text_of(middle)}</translation>"
    element = f"<transform>{parts}<scale>{scale}</scale></transform>"
    found = read_metashape(tmp_path, ring(), **{place: element})
    way = Placement(rotation, middle / scale, scale)
    world = {name: PosedCamera(pose, None).moved(way).camera_to_world for name, pose in ring().items()}
    assert_same_poses(found, world, atol=1e-8)
    assert np.abs(next(iter(found.cameras.values())).camera_to_world).max() < 100
    np.testing.assert_allclose(present(found.up), middle / np.linalg.norm(middle), atol=1e-4)


OLD = METASHAPE_CALIBRATION.replace("<f>500</f><cx>3</cx><cy>-4</cy>", "<fx>500</fx><fy>510</fy>")
GROWING = "<k1>0.01</k1><p1>0.003</p1><p2>-0.002</p2><p3>8</p3><p4>-3</p4>"
GROWN = {"radial": (0.01,), "tangential": (-0.002, 0.003), "growth": (8, -3)}
USUAL = {"focal": (500, 500), "center": (323, 236)}


@pytest.mark.parametrize(
    ("written", "lens", "note"),
    [
        (  # in Metashape's own order
            {"terms": "<k1>0.1</k1><p1>0.01</p1><p2>0.02</p2><b1>2</b1>"},
            USUAL | {"focal": (502, 500), "radial": (0.1,), "tangential": (0.02, 0.01)},
            "",
        ),
        ({"terms": GROWING}, USUAL | GROWN, "Metashape with p3, p4"),
        ({"terms": GROWING, "kind": "fisheye"}, USUAL | GROWN | {"is_fisheye": True}, "Metashape fisheye"),
        ({"terms": "<b2>80</b2>"}, USUAL | {"skew": 80}, "pixels are interpolated"),
        (  # 2 mm over those of pixels
            {"calibration": "", "kind": "fisheye"},
            {"focal": (500, 400), "center": (320, 240), "is_fisheye": True},
            "Metashape fisheye",
        ),
    ],
)
def test_metashapes_lenses_see_what_its_manuals_say(tmp_path, written, lens, note):
    found = read_metashape(tmp_path, ring(), **written)
    atol = 0.1 if lens_of(found).note else 1e-9
    np.testing.assert_allclose(pixels_in_file(found, IDEAL), by_hand(IDEAL, **lens), atol=atol)
    assert any(note in said for said in found.notes) == bool(note)


def test_calibrations_of_photoscan_are_refused_by_name(tmp_path):
    with pytest.raises(
        CaptureError, match=r"as PhotoScan up to 1\.3 wrote them, which is not read; open the project in Meta"
    ):
        read_metashape(tmp_path, ring(), calibration=OLD)


def test_a_sensor_without_calibration_keeps_its_type(tmp_path):
    found = read_metashape(tmp_path, ring(), kind="spherical", calibration="")
    x, y = IDEAL.T
    angles = np.column_stack([np.arctan(x), np.arctan2(y, np.hypot(x, 1))])
    expected = (320, 240) + angles * (640 / (2 * np.pi), 480 / np.pi)
    np.testing.assert_allclose(pixels_in_file(found, IDEAL), expected, atol=0.1)
    assert any("Metashape spherical" in note for note in found.notes)
    with pytest.raises(CaptureError, match="of the type equisolid_fisheye; expected frame"):
        read_metashape(tmp_path, ring(), kind="equisolid_fisheye", calibration="")


def test_a_rolling_shutter_is_said_not_to_be_followed_and_terms_that_are_not_known_are_named(tmp_path):
    for value in ("true", "1", "false"):
        shutter = f'<property name="rolling_shutter" value="{value}"/>{METASHAPE_CALIBRATION}'
        warnings = read_metashape(tmp_path, ring(), calibration=shutter).warnings
        said = ["sensor lens: 'rolling_shutter' is set and not followed" in text for text in warnings]
        assert said == [True] * (value != "false")
    terms = "<p3>8</p3><k5>0.1</k5><k6>0</k6><date>2019-05-01</date>"
    found = read_metashape(tmp_path, ring(), terms=terms)
    assert found.notes == ("sensor lens: numbers that are not known and not used: k5",)
    assert lens_of(found).distortion == (0, 0, 0, 0)


@pytest.mark.parametrize("off", ["false", "0"])
def test_cameras_that_are_disabled_or_not_aligned_are_left_out_and_named(tmp_path, off):
    extra = (
        '<camera id="90" sensor_id="0" label="loose"/>'
        f'<camera id="91" sensor_id="0" label="off" enabled="{off}"><transform>1</transform></camera>'
    )
    found = read_metashape(tmp_path, ring(), extra=extra)
    assert_same_poses(found, ring())
    assert "1 camera without transform: loose" in found.notes
    assert "1 disabled camera left out" in found.notes
    with pytest.raises(CaptureError, match="none of 2 cameras is enabled and has a transform"):
        read_metashape(tmp_path, {}, extra=extra)


@pytest.mark.parametrize(("on", "off"), [("true", "false"), ("1", "0")])
def test_a_chunk_that_is_disabled_is_left_out_even_if_it_has_the_most_cameras(tmp_path, on, off):
    def chunk_of(count, enabled):
        text = metashape_document(ring(count)).replace('enabled="true"', f'enabled="{enabled}"')
        return text[text.index("<chunk") : text.index("</document>")]

    path = tmp_path / "cameras.xml"
    path.write_text(f'<document version="1.5.0">{chunk_of(8, off)}{chunk_of(4, on)}</document>')
    assert_same_poses(read_poses(path), ring(4))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda text: text[:400], "not valid XML"),
        (lambda text: text.replace("<document", "<!DOCTYPE d><document", 1), "DOCTYPE"),
        (lambda text: text.replace("<transform>", "<transform>nan "), "expected 16 finite numbers"),
        (lambda text: text.replace('"frame"', '"conic"'), "conic; expected frame, fisheye or spherical"),
        (lambda text: text.replace('width="640"', 'width="-1"'), "has no resolution"),
        (lambda text: text.replace("<f>500", "<f>0"), "focal length 0"),
        (lambda text: text.replace("<cx>3<", "<cx>323<"), "principal point 643, 236, outside its 640 x 480"),
        (lambda text: text.replace("document", "kml").replace("chunk", "c"), "<kml>"),
    ],
)
def test_damaged_documents_are_refused(tmp_path, spoil, message):
    path = tmp_path / "cameras.xml"
    path.write_text(spoil(metashape_document(ring())), encoding="utf-8")
    with pytest.raises(CaptureError, match=message):
        read_poses(path)


def write_micmac(tmp_path, distortion="<ModNoDist/>", orientation=("", ""), calibration=("", "")):
    """With one text of the orientations, or of the calibration, in place of another."""
    folder = tmp_path / "Ori-All"
    folder.mkdir(exist_ok=True)
    for name, pose in ring().items():
        rows = dict(zip(("l1", "l2", "l3"), map(text_of, pose[:, :3] @ FLIP), strict=True))
        text = ORIENTATION.format(center=text_of(pose[:, 3]), convention="eConvApero_DistM2C", **rows)
        path = folder / f"Orientation-{name.split('/')[-1]}.xml"
        path.write_text(text.replace(*orientation))
    text = CALIBRATION.format(distortion=distortion)
    (folder / "AutoCal.xml").write_text(text.replace(*calibration))
    return folder


def test_orientations_of_a_project_are_read_with_their_calibration(tmp_path):
    folder = write_micmac(tmp_path)
    for place in (tmp_path, folder, folder / "Orientation-view_0.png.xml"):
        found = read_poses(place)
        assert_same_poses(found, {name.split("/")[-1]: pose for name, pose in ring().items()})
    lens = present(found.cameras["view_0.png"].lens)
    assert (lens.focal_px, lens.center_px, lens.distortion) == ((500, 500), (321, 239), (0, 0, 0, 0))


WITH_P1 = f"<ModPhgrStd><RadiaPart>{RADIAL}</RadiaPart><P1>1e-6</P1></ModPhgrStd>"


@pytest.mark.parametrize(("distortion", "p1"), [(f"<ModRad>{RADIAL}</ModRad>", 0.0), (WITH_P1, 1e-6)])
def test_distortion_in_pixels_about_its_own_centre_is_ours_within_half_a_pixel(tmp_path, distortion, p1):
    found = read_poses(write_micmac(tmp_path, distortion.format(a="-2e-7")))
    lens = present(found.cameras["view_0.png"].lens)
    wanted = by_hand(500 * IDEAL - (1.5, 2.5), (1, 1), (322.5, 241.5), (-2e-7, -1e-14), (0.0, p1))
    np.testing.assert_allclose(lens.pixels_of(IDEAL), wanted, atol=0.5)
    assert np.abs(500 * IDEAL + [321, 239] - wanted).max() > 3


def affinity(shift, axis="1 0"):
    return f"<I00>{shift}</I00><V10>{axis}</V10><V01>0 1</V01>"


def moved(*args):
    return ("<FileInterne>", f"<OrIntImaM2C>{affinity(*args)}</OrIntImaM2C><FileInterne>")


@pytest.mark.parametrize("distortion", ["<ModNoDist/>", f"<ModRad>{RADIAL.format(a='-2e-7')}</ModRad>"])
def test_the_lens_of_a_cut_picture_is_that_of_the_whole_seen_from_its_corner(tmp_path, distortion):
    whole = lens_of(read_poses(write_micmac(tmp_path, distortion, moved("0 0"))))
    sized = ("<CalibDistortion>", "<PixelSzIm>320 240</PixelSzIm><CalibDistortion>")
    cut = lens_of(read_poses(write_micmac(tmp_path, distortion, moved("-100 -80"), sized)))
    assert (whole.width, whole.height, cut.width, cut.height) == (640, 480, 320, 240)
    ideal = np.array([[0.0, 0.0], [0.1, -0.05]])
    np.testing.assert_allclose(cut.pixels_of(ideal), whole.pixels_of(ideal) - (100, 80))


GLOBAL = f"<OrIntGlob><Affinite>{affinity('-9 0')}</Affinite></OrIntGlob><CalibDistortion>"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"orientation": moved("-100 -80")}, "no <PixelSzIm>"),
        ({"orientation": moved("0 0", "0.5 0")}, "<OrIntImaM2C> turns or stretches"),
        ({"orientation": ("<FileInterne>", "<OrIntImaM2C/><FileInterne>")}, "<OrIntImaM2C> lacks <I00>"),
        ({"calibration": ("<CalibDistortion>", GLOBAL)}, "<OrIntGlob> moves the picture"),
        ({"orientation": ("eProjStenope", "eProjOrtho")}, "projection eProjOrtho; expected eProjStenope"),
        ({"calibration": ("_DistM2C", "_DistC2M")}, "AutoCal.xml has the convention eConvApero_DistC2M; exp"),
        ({"distortion": "<ModUnif/>"}, "ModUnif"),
        ({"distortion": "<ModRad/>"}, "no centre <CDist>"),
        ({"orientation": ("_DistM2C", "")}, "eConvApero; expected eConvApero_DistM2C"),
    ],
)
def test_other_models_and_conventions_are_refused(tmp_path, options, message):
    write_micmac(tmp_path, **options)
    with pytest.raises(CaptureError, match=message):
        read_poses(tmp_path)


def test_incomplete_projects_and_several_orientations_are_refused(tmp_path):
    folder = write_micmac(tmp_path)
    shutil.copytree(folder, tmp_path / "Ori-First")
    with pytest.raises(CaptureError, match="several orientations: Ori-All, Ori-First"):
        read_poses(tmp_path)
    (folder / "AutoCal.xml").unlink()
    with pytest.raises(CaptureError, match=r"names the calibration 'Ori-All/AutoCal\.xml'"):
        read_poses(folder)


def read_opensfm(tmp_path, *contents):
    return read_poses(write_json(tmp_path / "reconstruction.json", list(contents)))


def test_the_reconstruction_with_the_most_shots_is_read(tmp_path):
    small = reconstruction()
    small["shots"].popitem()
    found = read_opensfm(tmp_path, small, reconstruction())
    assert_same_poses(found, ring())
    assert any("2 reconstructions" in note for note in found.notes)
    np.testing.assert_array_equal(present(found.points), [[1, 2, 3]])
    np.testing.assert_array_equal(present(found.colours), [[36, 25, 255]])


def test_lengths_are_in_parts_of_the_longer_side(tmp_path):
    lens = lens_of(read_opensfm(tmp_path, reconstruction()))
    assert (lens.focal_px, lens.center_px, lens.distortion) == ((512, 512), (320, 240), (0.1, -0.05, 0, 0))
    lens = lens_of(read_opensfm(tmp_path, reconstruction(BROWN)))
    assert lens.focal_px == pytest.approx((512, 480))
    assert lens.center_px == pytest.approx((240 + 6.4, 320 - 12.8))
    assert lens.distortion == (0.1, -0.05, 0.001, 0.002)


def test_poses_of_a_rig_are_composed(tmp_path):
    turn, shift = Rotation.from_euler("xyz", [0.1, 0.2, 0.3]).as_matrix(), np.array([0.1, -0.2, 0.3])
    content = reconstruction()
    content["rig_cameras"] = {"left": as_json(turn, shift)}
    content["rig_instances"] = {}
    for name, shot in content["shots"].items():
        rotation, translation = world_to_camera(ring()[name])
        outer = as_json(turn.T @ rotation, turn.T @ (translation - shift))
        content["rig_instances"][name] = {**outer, "rig_camera_ids": {name: "left"}}
        del shot["rotation"], shot["translation"]
    assert_same_poses(read_opensfm(tmp_path, content), ring())
    with pytest.raises(CaptureError, match="names \"left\", not in 'rig_cameras'"):
        read_opensfm(tmp_path, content | {"rig_cameras": {}})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cameras": {}}, "names the camera"),
        ({"cameras": {"c": {**PERSPECTIVE, "projection_type": "omni"}}}, "omni.*expected one of"),
        ({"cameras": {"c": {**PERSPECTIVE, "focal": 0}}}, "not above 0"),
        ({"cameras": {"c": {**BROWN, "k1": float("nan")}}}, "c: 'k1' is NaN; expected a finite number"),
        ({"cameras": {"c": {**BROWN, "c_x": None}}}, "'c_x' is null"),
        ({"cameras": {"c": {**BROWN, "p1": "0.001"}}}, "'p1' is \"0.001\""),
        ({"cameras": {"c": {**PERSPECTIVE, "width": True}}}, "'width' is true"),
        ({"shots": {}}, "has no camera"),
        ({"shots": {"a": {"rotation": [1, 2], "translation": [0, 0, 0], "camera": "c"}}}, "3 finite numbers"),
        ({"points": {"1": {"coordinates": [1, None, 2]}}}, "a point has no 3 finite"),
    ],
)
def test_faults_are_told(tmp_path, change, message):
    with pytest.raises(CaptureError, match=message):
        read_opensfm(tmp_path, reconstruction() | change)
