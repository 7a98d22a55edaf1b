"""The rendered and the real scenes of NeSpoF."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image

from tests.factories.data_sets import (
    PLAIN,
    intensity,
    pose,
    stokes,
    write_exr,
    write_nespof,
    write_real,
)
from tests.factories.files import check_file, present, rows_and_bands_of
from unmix_plugin.captures.cube import BandTable, ReadOptions
from unmix_plugin.captures.layouts.transforms import (
    find_nespof,
    find_nespof_real,
    open_intensity,
    open_opacity,
)
from unmix_plugin.captures.readers.exr import channel_names
from unmix_plugin.errors import CaptureError


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """The rendered scene as its layout finds it; not to be changed."""
    root = tmp_path_factory.mktemp("nespof")
    write_nespof(root)
    return find_nespof(root, PLAIN)


def test_views_have_the_first_stokes_component_of_all_wavelengths_opacity_poses_and_lens(scene, tmp_path):
    splits = {view.name: view.split for view in scene.views}
    assert splits == {"r_0": "eval", "r_1": "train", "r_2": "train", "r_3": "train", "r_4": "train"}
    assert any("5 frames of transforms_test.json listed before" in note for note in scene.notes)
    for index, view in enumerate(scene.views):
        expected = np.stack([intensity(index, wavelength) for wavelength in (450, 460, 470)], axis=-1)
        check_file(view.cube, values=expected, nm=[450, 460, 470])
        np.testing.assert_allclose(view.alpha.read()[..., 0], np.linspace(0, 1, 35).reshape(5, 7), atol=1e-6)
        camera = scene.poses.cameras[view.name]
        np.testing.assert_allclose(camera.camera_to_world, pose(index)[:3], atol=1e-6)
        assert (camera.lens.width, camera.lens.height) == (7, 5)
        assert camera.lens.focal_px[0] == pytest.approx(0.5 * 7 / np.tan(0.4))
    rows_and_bands_of(scene.views[2].cube, scene.views[2].cube.read())
    write_nespof(tmp_path)
    given = ReadOptions(bands=BandTable(np.array([500.0, 510.0, 520.0])))
    check_file(find_nespof(tmp_path, given).views[0].cube, nm=[500, 510, 520])


def test_labels_lie_in_seg_and_views_of_one_name_in_two_splits_keep_their_folder(tmp_path):
    write_nespof(tmp_path, wavelengths=(450,), alpha=False)
    (tmp_path / "seg" / "train").mkdir(parents=True)
    Image.fromarray(np.zeros((5, 7), np.uint8)).save(tmp_path / "seg" / "train" / "r_3.png")
    for split in ("train", "val"):
        path = tmp_path / f"transforms_{split}.json"
        content = json.loads(path.read_text())
        content["frames"].append({**content["frames"][0], "file_path": f"./{split}/same"})
        path.write_text(json.dumps(content))
        write_exr(tmp_path / "450" / split / "same.exr", stokes(intensity(9, 450)))
    views = {view.name: view for view in find_nespof(tmp_path, PLAIN).views}
    assert {"train_same", "val_same"} < views.keys()
    assert [name for name, view in views.items() if view.labels is not None] == ["train_r_3"]
    assert {view.alpha for view in views.values()} == {None}


@pytest.mark.parametrize("kind", [np.float32, np.float16])
def test_raw_files_of_mitsuba_have_the_intensity_in_the_fifth_channel(tmp_path, kind):
    names = [f"ch{index:02d}" for index in range(16)]
    write_exr(tmp_path / "a.exr", {name: np.full((3, 4), float(i)) for i, name in enumerate(names)}, kind)
    assert (open_intensity(tmp_path / "a.exr").read() == 4.0).all()
    assert open_opacity(tmp_path / "a.exr") is None


def test_channels_are_known_by_name_wherever_they_stand_and_others_are_refused(tmp_path):
    path = tmp_path / "a.exr"
    write_exr(path, {"A": np.full((3, 4), 0.5), **stokes(np.full((3, 4), 2.0))})
    assert (open_intensity(path).read() == 2.0).all()
    assert (present(open_opacity(path)).read() == 0.5).all()
    write_exr(path, {"R": np.zeros((3, 4)), "G": np.zeros((3, 4))})
    with pytest.raises(CaptureError, match="has the channels G, R; expected s0 to s3"):
        open_intensity(path)


def _outside(root):
    path = root / "transforms_val.json"
    path.write_text(path.read_text().replace("./val/r_0", "../../r_0"))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda root: shutil.rmtree(root / "460/train"), r"lacks 4 files .*460/train/r_1.exr, .* and 1 more"),
        (lambda root: [path.unlink() for path in root.glob("*.json")], "holds no"),
        (lambda root: [shutil.rmtree(root / name) for name in ("450", "460", "470")], "holds no"),
        (lambda root: (root / "450/val/r_0.exr").write_bytes(b"v/1"), r"r_0.exr can't be read as OpenEXR"),
        (lambda root: write_exr(root / "460/val/r_0.exr", stokes(np.zeros((5, 8)))), "have one size"),
        (_outside, "leaves the folder"),
    ],
)
def test_a_spoilt_scene_is_refused(tmp_path, spoil, message):
    write_nespof(tmp_path / "scene")
    spoil(tmp_path / "scene")
    with pytest.raises(CaptureError, match=message):
        find_nespof(tmp_path / "scene", PLAIN)


def test_real_captures_have_one_folder_a_view_and_poses_in_the_order_of_names(tmp_path):
    write_real(tmp_path, views=("v10", "v2", "v1"), poses=False)
    capture = find_nespof_real(tmp_path, PLAIN)
    assert [view.name for view in capture.views] == ["v1", "v10", "v2"]
    expected = np.stack([intensity(1, 450), intensity(1, 460)], axis=-1)
    np.testing.assert_array_equal(capture.views[2].cube.read(), expected)
    assert capture.poses is None
    assert any("poses_bounds.npy is not there" in note for note in capture.notes)
    write_real(tmp_path, views=("v10", "v2", "v1"))
    poses = present(find_nespof_real(tmp_path, PLAIN).poses)
    for index, view in enumerate(capture.views):
        np.testing.assert_allclose(poses.cameras[view.name].camera_to_world, pose(index)[:3], atol=1e-12)
        lens = present(poses.cameras[view.name].lens)
        assert (lens.height, lens.width, lens.focal_px) == (5, 7, (9.0, 9.0))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda exr: shutil.rmtree(exr / "v2"), r"holds 2 poses, .* 1 views"),
        (lambda exr: (exr / "v2" / "460.exr").unlink(), "460 nm in one of them alone"),
        (lambda exr: write_exr(exr / "v2" / "450nm.exr", stokes(intensity(1, 450))), "are both 450 nm"),
        (shutil.rmtree, "holds no folder exr"),
    ],
)
def test_a_spoilt_real_capture_is_refused(tmp_path, spoil, message):
    write_real(tmp_path)
    spoil(tmp_path / "exr")
    with pytest.raises(CaptureError, match=message):
        find_nespof_real(tmp_path, PLAIN)


@pytest.mark.parametrize("place", [9, 17, 40])
def test_a_damaged_header_is_told_and_ends_no_process(tmp_path, place):
    """The library crashed, or raised SystemError: seed 1, cases 336, 437 and 1950 of benchmarks/fuzz_commands.py."""
    path = tmp_path / "450.exr"
    path.write_bytes(b"\x76\x2f\x31\x01\x02\0\0\0channels\0chlist\0\x25\0\0\0" + b"\xff" * place)
    with pytest.raises(CaptureError, match=r"450\.exr can't be read as OpenEXR"):
        channel_names(path)
