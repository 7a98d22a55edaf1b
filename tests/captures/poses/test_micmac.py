import numpy as np
import pytest

from tests.captures.poses.pose_factory import (
    CALIBRATION,
    FLIP,
    ORIENTATION,
    RADIAL,
    assert_same_poses,
    ring,
    text_of,
)
from unmix_plugin.captures.poses.reading import read_poses
from unmix_plugin.errors import CaptureError


def write(tmp_path, distortion="<ModNoDist/>", convention="eConvApero_DistM2C"):
    folder = tmp_path / "Ori-All"
    folder.mkdir(exist_ok=True)
    for name, pose in ring().items():
        rows = dict(zip(("l1", "l2", "l3"), map(text_of, pose[:, :3] @ FLIP), strict=True))
        text = ORIENTATION.format(center=text_of(pose[:, 3]), convention=convention, **rows)
        (folder / f"Orientation-{name.split('/')[-1]}.xml").write_text(text)
    (folder / "AutoCal.xml").write_text(CALIBRATION.format(distortion=distortion))
    return folder


def test_orientations_of_a_project_are_read_with_their_calibration(tmp_path):
    folder = write(tmp_path)
    for place in (tmp_path, folder, folder / "Orientation-view_0.png.xml"):
        found = read_poses(place)
        assert_same_poses(found, {name.split("/")[-1]: pose for name, pose in ring().items()})
    lens = found.cameras["view_0.png"].lens
    assert lens is not None
    assert (lens.focal_px, lens.center_px, lens.distortion) == ((500, 500), (321, 239), (0, 0, 0, 0))


@pytest.mark.parametrize(
    ("distortion", "p1"),
    [
        (f"<ModRad>{RADIAL}</ModRad>", 0.0),
        (f"<ModPhgrStd><RadiaPart>{RADIAL}</RadiaPart><P1>1e-6</P1></ModPhgrStd>", 1e-6),
    ],
)
def test_distortion_in_pixels_about_its_own_centre_is_ours_within_half_a_pixel(tmp_path, distortion, p1):
    found = read_poses(write(tmp_path, distortion.format(a="-2e-7")))
    lens = found.cameras["view_0.png"].lens
    assert lens is not None
    ideal = np.random.default_rng(0).uniform([-0.55, -0.4], [0.55, 0.4], (40, 2))
    away = 500 * ideal + [-1.5, -2.5]
    x, y, squared = *away.T, (away**2).sum(1)
    factor = 1 - 2e-7 * squared - 1e-14 * squared**2
    bent = np.column_stack([x * factor + p1 * (squared + 2 * x**2), y * factor + 2 * p1 * x * y])
    wanted = bent + np.array([322.5, 241.5])
    mine = lens.pixels_of(ideal)
    np.testing.assert_allclose(mine, wanted, atol=0.5)
    assert np.abs(500 * ideal + [321, 239] - wanted).max() > 3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"distortion": "<ModUnif/>"}, "ModUnif is not supported; expected ModRad"),
        ({"distortion": "<ModRad/>"}, "no centre <CDist>"),
        ({"convention": "eConvAngErdas"}, "eConvAngErdas; expected eConvApero_DistM2C"),
    ],
)
def test_other_models_and_conventions_are_refused(tmp_path, options, message):
    with pytest.raises(CaptureError, match=message):
        read_poses(write(tmp_path, **options))


def test_a_missing_calibration_is_asked_for(tmp_path):
    folder = write(tmp_path)
    (folder / "AutoCal.xml").unlink()
    with pytest.raises(
        CaptureError, match=r"names the calibration 'Ori-All/AutoCal.xml', which is not beside it"
    ):
        read_poses(folder)


def test_of_several_orientations_one_has_to_be_chosen(tmp_path):
    write(tmp_path).rename(tmp_path / "Ori-First")
    write(tmp_path)
    with pytest.raises(CaptureError, match="several orientations: Ori-All, Ori-First"):
        read_poses(tmp_path)
