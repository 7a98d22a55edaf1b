"""Layouts with a transforms.json: unmix-nerf, hs-nerf, nerfstudio.

From the folder of each layout to a scene that loads, with the values and splits that were there.
"""

import json
import shutil

import numpy as np
import pytest
import torch
from PIL import Image

from tests.captures.file_factory import centres_nm, present
from tests.captures.layouts.data_sets import (
    LENS,
    PLAIN,
    cube,
    intensity,
    pose,
    write_hs,
    write_json,
    write_nespof,
    write_picture,
    write_real,
    write_unmix,
)
from unmix_plugin.captures.layouts.registry import LAYOUTS, find_views
from unmix_plugin.captures.layouts.transforms import find_hs_nerf, find_nerfstudio, find_unmix_nerf
from unmix_plugin.captures.options import ProcessOptions
from unmix_plugin.captures.process import process_capture
from unmix_plugin.captures.spectral_file import ReadOptions
from unmix_plugin.errors import CaptureError
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.scenes.scene import Scene


def edit(root, change):
    path = root / "transforms.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


@pytest.mark.parametrize("written", ["eval", "val"])
def test_cubes_pictures_and_labels_are_found_where_the_converter_left_them(tmp_path, written):
    write_unmix(tmp_path, written)
    capture = find_unmix_nerf(tmp_path, PLAIN)
    for index, view in enumerate(capture.views):
        np.testing.assert_array_equal(view.cube.read(), cube(index))
        assert view.picture is not None
        assert view.labels is not None
        assert (np.asarray(Image.open(view.labels)) == index).all()
    told = any("2 paths name a folder 'val' whose files lie in 'eval'" in note for note in capture.notes)
    assert told == (written == "eval")


def test_lists_go_before_folders(tmp_path):
    lists: dict[str, list[str]] = {"train_filenames": [f"./train/frame_0000{k}.png" for k in (0, 1)]}
    lists["test_filenames"] = ["train/frame_00002.npy"]
    write_unmix(tmp_path, "eval", "val", **lists)
    splits = [view.split for view in find_unmix_nerf(tmp_path, PLAIN).views]
    assert splits[:3] == ["train", "train", "eval"]


def test_one_folder_for_all_says_nothing(tmp_path):
    write_unmix(tmp_path, written="train", named="train")
    assert {view.split for view in find_unmix_nerf(tmp_path, PLAIN).views} == {None}


def test_wavelengths_are_those_of_the_file_unless_given(tmp_path):
    write_unmix(tmp_path)
    cube = find_unmix_nerf(tmp_path, PLAIN).views[0].cube
    assert centres_nm(cube).tolist() == [450.0, 500.0, 550.0, 600.0]
    assert "transforms.json" in cube.bands.evidence
    given = ReadOptions(wavelengths_nm=np.array([400.0, 410.0, 420.0, 430.0]))
    assert centres_nm(find_unmix_nerf(tmp_path, given).views[0].cube).tolist() == [400.0, 410.0, 420.0, 430.0]


def test_wavelengths_settle_which_axis_is_that_of_bands(tmp_path):
    write_unmix(tmp_path)
    edit(tmp_path, lambda content: content.update(wavelengths=np.linspace(400, 900, 40).tolist()))
    for path in tmp_path.rglob("*.npy"):
        np.save(path, np.random.default_rng(0).random((6, 8, 40)))  # more bands than rows
    for view in find_unmix_nerf(tmp_path, PLAIN).views:
        assert view.cube.shape == (6, 8, 40)
        assert view.cube.warnings == ()


@pytest.mark.parametrize("stated", [None, [450, 500], ["blue", "green", "red", "nir"]])
def test_wavelengths_are_never_made_up(tmp_path, stated):
    write_unmix(tmp_path, wavelengths=stated)
    assert find_unmix_nerf(tmp_path, PLAIN).views[0].cube.bands.wavelengths_nm is None


def test_poses_come_by_the_names_of_views(tmp_path):
    write_unmix(tmp_path)
    poses = present(find_unmix_nerf(tmp_path, PLAIN).poses)
    assert sorted(poses.cameras) == [f"frame_0000{index}" for index in range(5)]
    np.testing.assert_allclose(poses.cameras["frame_00004"].camera_to_world, pose(4)[:3], atol=1e-6)
    lens = present(poses.cameras["frame_00004"].lens)
    assert lens.focal_px == (9.0, 9.0)


def test_corrupt_poses_are_told_and_others_may_be_given(tmp_path):
    write_unmix(tmp_path)
    edit(tmp_path, lambda content: content["frames"][1].update(transform_matrix=np.zeros((4, 4)).tolist()))
    capture = find_unmix_nerf(tmp_path, PLAIN)
    assert capture.poses is None
    assert len(capture.views) == 5
    assert any("poses of the capture can't be used" in note for note in capture.notes)


def test_a_missing_picture_is_no_fault(tmp_path):
    write_unmix(tmp_path)
    (tmp_path / "train" / "frame_00001.png").unlink()
    views = find_unmix_nerf(tmp_path, PLAIN).views
    assert [view.picture is None for view in views] == [False, True, False, False, False]


def test_missing_cubes_are_counted_and_another_layout_named(tmp_path):
    write_unmix(tmp_path)
    for index in range(3):
        (tmp_path / "train" / f"frame_0000{index}.npy").unlink()
    with pytest.raises(CaptureError, match=r"lacks 3 files .*train/frame_00000.npy.*nerfstudio"):
        find_unmix_nerf(tmp_path, PLAIN)
    edit(tmp_path, lambda content: content["frames"][2].pop("hyperspectral_file_path"))
    with pytest.raises(CaptureError, match=r"frames\[2\] has no 'hyperspectral_file_path'"):
        find_unmix_nerf(tmp_path, PLAIN)


@pytest.mark.parametrize("text", ["../outside.npy", "/etc/passwd", "link.npy"])
def test_paths_that_leave_the_folder_are_refused(tmp_path, text):
    root = tmp_path / "scene"
    write_unmix(root)
    np.save(tmp_path / "outside.npy", cube(0))
    (root / "link.npy").symlink_to(tmp_path / "outside.npy")
    edit(root, lambda content: content["frames"][0].update(hyperspectral_file_path=text))
    with pytest.raises(CaptureError, match=r"frames\[0\].*leaves the folder"):
        find_unmix_nerf(root, PLAIN)


def test_views_that_would_share_a_name_are_refused(tmp_path):
    write_unmix(tmp_path)
    shutil.copy(tmp_path / "train/frame_00000.npy", tmp_path / "train/frame 00000.npy")
    twin = {"hyperspectral_file_path": "train/frame 00000.npy"}
    edit(tmp_path, lambda content: content["frames"][1].update(twin))
    with pytest.raises(CaptureError, match="would both be the view 'frame_00000'"):
        find_unmix_nerf(tmp_path, PLAIN)


@pytest.mark.parametrize("content", ["{", '{"frames": 3}', '{"frames": [3]}', '{"no": "frames"}', ""])
def test_a_damaged_list_of_frames_is_refused(tmp_path, content):
    (tmp_path / "transforms.json").write_text(content)
    with pytest.raises(CaptureError, match=r"transforms.json"):
        find_unmix_nerf(tmp_path, PLAIN)


@pytest.mark.parametrize(("kind", "scale"), [(torch.uint8, 255.0), (torch.float32, None)])
def test_tensors_of_8_bits_are_fractions_of_255(tmp_path, kind, scale):
    write_hs(tmp_path, kind)
    capture = find_hs_nerf(tmp_path, PLAIN)
    assert capture.layout == "hs-nerf"
    for index, view in enumerate(capture.views):
        assert view.cube.scale == scale
        np.testing.assert_allclose(view.cube.read() / (scale or 1.0), cube(index), atol=1.01 / 255)
        assert view.cube.bands.wavelengths_nm is None
        assert view.picture is not None
        assert view.picture.name == f"frame_{index:05d}.jpg"


def test_given_wavelengths_must_be_one_a_band(tmp_path):
    write_hs(tmp_path)
    with pytest.raises(CaptureError, match=r"frame_00000.pt.* 3 "):
        find_hs_nerf(tmp_path, ReadOptions(wavelengths_nm=np.array([450.0, 500.0, 550.0])))


@pytest.mark.parametrize("mode", ["RGB", "RGBA"])
def test_pictures_are_cubes_of_three_bands(tmp_path, mode):
    pixels = write_picture(tmp_path / "images" / "a.png", mode)
    write_picture(tmp_path / "images" / "b.png", mode)
    Image.fromarray(np.full((6, 8), 255, np.uint8)).save(tmp_path / "mask.png")
    frames = [{"file_path": f"images/{name}.png", "transform_matrix": pose(k)} for k, name in enumerate("ab")]
    frames[1]["mask_path"] = "mask.png"
    write_json(tmp_path / "transforms.json", LENS | {"frames": frames})
    first, second = find_nerfstudio(tmp_path, PLAIN).views
    np.testing.assert_array_equal(first.cube.read(), pixels[..., :3])
    assert first.cube.metadata["encoding"] == "sRGB"
    assert first.picture == first.cube.path
    assert first.mask is None
    assert second.mask is not None
    assert first.cube.bands.wavelengths_nm is None
    assert "--wavelengths 610,550,465" in first.cube.bands.evidence


def test_frames_may_name_envi_headers_in_a_folder_of_their_own(tmp_path):
    import spectral.io.envi

    (tmp_path / "raw").mkdir()
    bands = {"wavelength": [450, 500, 550, 600], "wavelength units": "nm"}
    spectral.io.envi.save_image(str(tmp_path / "raw" / "a.hdr"), cube(3), metadata=bands)
    frames = [{"file_path": "a.hdr", "transform_matrix": pose(0)}]
    write_json(tmp_path / "transforms.json", LENS | {"datadir": "raw", "frames": frames})
    (view,) = find_nerfstudio(tmp_path, PLAIN).views
    np.testing.assert_array_equal(view.cube.read(), cube(3))
    assert view.picture is None
    assert view.cube.bands.wavelengths_nm is not None


def test_pictures_of_blender_have_no_suffix_and_a_file_for_each_split(tmp_path):
    for index, split in enumerate(("train", "val", "test")):
        write_picture(tmp_path / split / "r_0.png", "RGBA")
        frame = {"file_path": f"./{split}/r_0", "transform_matrix": pose(index)}
        write_json(tmp_path / f"transforms_{split}.json", {"camera_angle_x": 0.7, "frames": [frame]})
    capture = find_nerfstudio(tmp_path, PLAIN)
    splits = {view.name: view.split for view in capture.views}
    assert splits == {"test_r_0": "eval", "train_r_0": "train", "val_r_0": "eval"}
    assert capture.poses is not None
    np.testing.assert_allclose(capture.poses.cameras["test_r_0"].camera_to_world, pose(2)[:3], atol=1e-6)


def test_a_turned_picture_stays_as_it_is_stored(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(np.zeros((6, 8, 3), np.uint8)).save(tmp_path / "a.jpg", exif=exif)
    frames = [{"file_path": "a.jpg", "transform_matrix": pose(0)}]
    write_json(tmp_path / "transforms.json", LENS | {"frames": frames})
    assert find_nerfstudio(tmp_path, PLAIN).views[0].cube.shape == (6, 8, 3)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_an_empty_folder_is_refused_by_every_layout(tmp_path, layout):
    with pytest.raises(CaptureError, match=r"holds no"):
        find_views(layout, tmp_path, PLAIN)


def process(layout, root, output, **given) -> Scene:
    options = ProcessOptions(layout, data=root, output_dir=output, **given)
    process_capture(options, lambda _: None, lambda _, views: views)
    return load_scene(output)


def names(scene, indices):
    return [scene.frames[index].name for index in indices]


def test_nespof(tmp_path):
    write_nespof(tmp_path / "ajar")
    scene = process("nespof", tmp_path / "ajar", tmp_path / "scene", scale=2.0)
    assert scene.wavelengths_nm.tolist() == [450.0, 460.0, 470.0]
    assert names(scene, scene.eval_indices) == ["r_0"]
    assert names(scene, scene.train_indices) == ["r_1", "r_2", "r_3", "r_4"]
    index = [frame.name for frame in scene.frames].index("r_3")
    alpha = present(scene.alpha(index))
    np.testing.assert_allclose(alpha, np.linspace(0, 1, 35).reshape(5, 7), atol=0.003)
    seen = alpha > 0
    expected = np.stack([intensity(3, wavelength) for wavelength in (450, 460, 470)], axis=-1) / 2.0
    np.testing.assert_allclose(scene.cube(index)[seen], expected[seen], atol=1e-4)


def test_nespof_real(tmp_path):
    write_real(tmp_path / "real", views=("a", "b", "c"))
    scene = process("nespof-real", tmp_path / "real", tmp_path / "scene", scale=2.0)
    expected = np.stack([intensity(1, 450), intensity(1, 460)], axis=-1) / 2.0
    np.testing.assert_allclose(scene.cube(1), expected, atol=1e-4)


def test_unmix_nerf(tmp_path):
    write_unmix(tmp_path / "hotdog")
    scene = process("unmix-nerf", tmp_path / "hotdog", tmp_path / "scene", scale=1.0, mask="none")
    assert names(scene, scene.eval_indices) == ["frame_00003", "frame_00004"]
    np.testing.assert_allclose(scene.cube(1), cube(1), atol=1e-4)
    labels = present(scene.labels(4))
    assert (labels == 4).all()


def test_hs_nerf_asks_for_wavelengths(tmp_path):
    write_hs(tmp_path / "basil")
    with pytest.raises(CaptureError, match=r"wavelengths of its 4 bands are unknown .*--wavelengths"):
        process("hs-nerf", tmp_path / "basil", tmp_path / "scene")
    options = {"wavelengths": "450,500,550,600", "scale": 1.0}
    scene = process("hs-nerf", tmp_path / "basil", tmp_path / "scene", **options)
    assert scene.wavelengths_nm.tolist() == [450.0, 500.0, 550.0, 600.0]
    np.testing.assert_allclose(scene.cube(2), cube(2), atol=1.01 / 255)


def test_nerfstudio_says_what_three_bands_may_stand_for(tmp_path):
    write_unmix(tmp_path / "room", written="val")
    with pytest.raises(CaptureError, match=r"--wavelengths 610,550,465"):
        process("nerfstudio", tmp_path / "room", tmp_path / "scene")
    scene = process("nerfstudio", tmp_path / "room", tmp_path / "scene", wavelengths="610,550,465", scale=1.0)
    assert scene.wavelengths_nm.tolist() == [465.0, 550.0, 610.0]
    pixels = np.asarray(Image.open(tmp_path / "room" / "train" / "frame_00002.png")) / 255
    linear = np.where(pixels <= 0.04045, pixels / 12.92, ((pixels + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(scene.cube(2), linear[..., ::-1], atol=1e-4)
