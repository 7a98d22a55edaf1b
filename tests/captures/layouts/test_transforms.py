"""Layouts with a transforms.json: unmix-nerf, nerfstudio.

From the folder of each layout to a scene that loads, with the values and splits that were there.
"""

import json
import shutil
from functools import partial

import numpy as np
import pytest
from PIL import Image

from tests.factories.captures import process
from tests.factories.data_sets import (
    LENS,
    PLAIN,
    cube,
    intensity,
    pose,
    write_json,
    write_nespof,
    write_picture,
    write_real,
    write_unmix,
)
from tests.factories.files import check_file, present, warnings_of, write_envi
from unmix_plugin.captures.cube import BandTable, ReadOptions
from unmix_plugin.captures.layouts.transforms import find_nerfstudio, find_unmix_nerf
from unmix_plugin.captures.options import LAYOUTS, find_views
from unmix_plugin.errors import CaptureError, ConfigError
from unmix_plugin.scenes.reading.loader import load_scene


def edit(root, change):
    path = root / "transforms.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def scene_of(tmp_path, **options):
    """What `tmp_path / "data"` becomes, of the layout unmix-nerf."""
    process(tmp_path / "data", tmp_path / "scene", "unmix-nerf", mask="none", **options)
    return load_scene(tmp_path / "scene")


@pytest.mark.parametrize("written", ["eval", "val"])
def test_cubes_pictures_labels_and_poses_are_found_where_the_converter_left_them(tmp_path, written):
    write_unmix(tmp_path, written)
    (tmp_path / "train" / "frame_00001.png").unlink()  # which is no fault
    capture = find_unmix_nerf(tmp_path, PLAIN)
    assert [view.picture is None for view in capture.views] == [False, True, False, False, False]
    for index, view in enumerate(capture.views):
        check_file(view.cube, values=cube(index), nm=[450, 500, 550, 600], evidence="transforms.json")
        assert (np.asarray(Image.open(present(view.labels))) == index).all()
        camera = present(capture.poses).cameras[f"frame_{index:05d}"]
        np.testing.assert_allclose(camera.camera_to_world, pose(index)[:3], atol=1e-6)
        assert present(camera.lens).focal_px == (9.0, 9.0)
    told = any("2 paths name a folder 'val' whose files lie in 'eval'" in note for note in capture.notes)
    assert told == (written == "eval")
    given = ReadOptions(bands=BandTable(np.array([400.0, 410.0, 420.0, 430.0])))
    check_file(find_unmix_nerf(tmp_path, given).views[0].cube, nm=[400, 410, 420, 430])


def test_lists_go_before_folders_and_one_folder_for_all_says_nothing(tmp_path):
    lists: dict[str, list[str]] = {"train_filenames": [f"./train/frame_0000{k}.png" for k in (0, 1)]}
    lists["test_filenames"] = ["train/frame_00002.npy"]
    write_unmix(tmp_path / "lists", "eval", "val", **lists)
    splits = [view.split for view in find_unmix_nerf(tmp_path / "lists", PLAIN).views]
    assert splits[:3] == ["train", "train", "eval"]
    write_unmix(tmp_path / "one", written="train", named="train")
    assert {view.split for view in find_unmix_nerf(tmp_path / "one", PLAIN).views} == {None}


@pytest.mark.parametrize(
    ("lists", "expected"),
    [
        ({"train": [0, 1]}, ["train", "train", "eval", "eval", "eval"]),
        ({"val": [2], "test": [4]}, ["train", "train", None, "train", "eval"]),
        ({"train": [0, 1], "val": [2], "test": [3]}, ["train", "train", None, "eval", None]),
    ],
)
def test_frames_of_some_lists_are_split_as_scenes_are(tmp_path, lists, expected):
    listed = {f"{k}_filenames": [f"train/frame_0000{i}.png" for i in v] for k, v in lists.items()}
    write_unmix(tmp_path / "data", "train", "train", **listed)
    assert [view.split for view in find_unmix_nerf(tmp_path / "data", PLAIN).views] == expected
    scene = scene_of(tmp_path, scale=1.0)
    for indices, split in ((scene.train_indices, "train"), (scene.eval_indices, "eval")):
        assert list(indices) == [index for index, one in enumerate(expected) if one == split]


@pytest.mark.parametrize("key", ["train_filenames", "val_filenames", "test_filenames"])
@pytest.mark.parametrize(
    ("listed", "message"),
    [
        (["frame_00000.png"], "lists 'frame_00000.png', which is the file_path of no frame"),
        (["./train/frame_00000.png", "train/frame_00001.jpg"], "lists 'train/frame_00001.jpg', which"),
        (["./train/frame_00000.png", None], "is a list of 2; expected a list of file paths"),
    ],
)
def test_lists_that_name_no_frame_are_refused(tmp_path, key, listed, message):
    write_unmix(tmp_path, "train", "train", **{key: listed})
    for find in (find_unmix_nerf, find_nerfstudio):
        with pytest.raises(CaptureError, match=f"'{key}':? {message}"):
            find(tmp_path, PLAIN)


def test_a_scene_folder_is_read_with_its_scale_and_widths_and_says_what_it_leaves_out(tmp_path):
    """Numbers of 16 bits of which 1000 stands for 1."""
    write_unmix(tmp_path / "data", written="val", materials=["leaf"], value_scale=1000, fwhm=[5, 6, 7, 8])
    for path in (tmp_path / "data").rglob("*.npy"):
        np.save(path, np.rint(1000 * np.load(path)).astype(np.uint16))
    capture = find_unmix_nerf(tmp_path / "data", PLAIN)
    assert any("not taken over from transforms.json: materials;" in note for note in capture.notes)
    for index, view in enumerate(capture.views):
        check_file(view.cube, scale=1000, fwhm=[5, 6, 7, 8])
        np.testing.assert_allclose(view.cube.read() / 1000, cube(index), atol=5.01e-4)
    scene_of(tmp_path)
    process(tmp_path / "scene", tmp_path / "again", "unmix-nerf", mask="none")
    for folder in ("scene", "again"):
        scene = load_scene(tmp_path / folder)
        np.testing.assert_allclose(scene.cube(2), cube(2), atol=6e-4)
        assert present(scene.fwhm_nm).tolist() == [5, 6, 7, 8]


def test_frames_of_a_scene_folder_have_bands_sensor_and_shot_of_their_own(tmp_path):
    write_unmix(tmp_path / "data", written="val")
    paths = sorted((tmp_path / "data").rglob("*.npy"))
    order = [[3, 0], [3, 0], [1, 2], None, None]
    for path, bands in zip(paths, order, strict=True):
        np.save(path, np.load(path)[..., bands or [0, 1, 2, 3]])

    def change(content):
        content["fwhm"] = [5, 6, 7, None]
        for frame, bands in zip(content["frames"], order, strict=True):
            frame.update({"bands": bands} if bands else {"sensor": "wide", "capture": "shot 1"})

    edit(tmp_path / "data", change)
    capture = find_unmix_nerf(tmp_path / "data", PLAIN)
    expected = [[600, 450], [600, 450], [500, 550], [450, 500, 550, 600], [450, 500, 550, 600]]
    for view, nm in zip(capture.views, expected, strict=True):
        check_file(view.cube, nm=nm, fwhm=None)
    assert [view.sensor for view in capture.views] == ["bands 1", "bands 1", "bands 2", "wide", "wide"]
    assert [view.shot for view in capture.views] == ["", "", "", "shot 1", "shot 1"]
    assert any("'fwhm' has 0 or null for 1 of 4 bands" in text for text in capture.warnings)
    scene = scene_of(tmp_path, scale=1.0)
    for index, bands in enumerate(order):
        shown = sorted(bands or [0, 1, 2, 3])
        np.testing.assert_allclose(scene.cube(index), cube(index)[..., shown], atol=1e-4)


@pytest.mark.parametrize(
    ("top", "own", "message"),
    [
        ({"value_scale": 0}, {}, "'value_scale' is 0; expected what stands for 1"),
        ({"fwhm": [5, 5]}, {}, "'fwhm' must have a width in nm above 0 for each"),
        ({}, {"bands": [0, 1, 2]}, "frame_00001.npy has 4 bands, 'bands' of its frame 3 indices"),
        ({}, {"bands": [1, 2, 3, 4]}, r"frames\[1\]: 'bands' is \[1, 2, 3, 4\]; expected indices of the 4"),
        ({}, {"bands": [0, 1, 2, -1]}, r"frames\[1\]: 'bands' is \[0, 1, 2, -1\]; expected indices"),
        ({}, {"bands": [0, 0, 1, 2]}, "'bands' repeats 0"),
        ({}, {"responses_path": "a.csv"}, "'responses_path' is set: channels of many bands"),
        ({}, {"row_poses": [[]]}, "'row_poses' is set: a line camera"),
        ({}, {"key_poses": [{"row": 0}]}, "'key_poses' is set: a line camera"),
    ],
)
def test_keys_of_a_scene_folder_that_cannot_be_followed_are_refused(tmp_path, top, own, message):
    write_unmix(tmp_path, **top)
    edit(tmp_path, lambda content: content["frames"][1].update(own))
    with pytest.raises(CaptureError, match=message):
        find_unmix_nerf(tmp_path, PLAIN)


@pytest.mark.parametrize("stated", [None, [450, 500], ["blue", "green", "red", "nir"]])
def test_wavelengths_are_never_made_up_and_poses_that_can_not_be_used_are_told(tmp_path, stated):
    write_unmix(tmp_path, wavelengths=stated)
    edit(tmp_path, lambda content: content["frames"][1].update(transform_matrix=np.zeros((4, 4)).tolist()))
    capture = find_unmix_nerf(tmp_path, PLAIN)
    assert capture.views[0].cube.bands.wavelengths_nm is None
    assert (capture.poses, len(capture.views)) == (None, 5)
    assert any("poses of the capture can't be used" in note for note in capture.notes)


def test_wavelengths_settle_which_axis_is_that_of_bands(tmp_path):
    write_unmix(tmp_path)
    edit(tmp_path, lambda content: content.update(wavelengths=np.linspace(400, 900, 40).tolist()))
    for path in tmp_path.rglob("*.npy"):
        np.save(path, np.random.default_rng(0).random((6, 8, 40)))  # more bands than rows
    for view in find_unmix_nerf(tmp_path, PLAIN).views:
        assert view.cube.shape == (6, 8, 40)
        assert warnings_of(view.cube) == []


def with_path(text):
    def spoil(root):
        np.save(root.parent / "outside.npy", cube(0))
        (root / "link.npy").symlink_to(root.parent / "outside.npy")
        shutil.copy(root / "train/frame_00001.npy", root / "train/frame 00001.npy")
        edit(root, lambda content: content["frames"][0].update(hyperspectral_file_path=text))

    return spoil


def with_content(text):
    return lambda root: (root / "transforms.json").write_text(text)


OUTSIDE = ("../outside.npy", "/etc/passwd", "link.npy")
NO_LIST = ("{", '{"frames": 3}', '{"frames": [3]}', "", '{"no": "frames"}')


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda root: [path.unlink() for path in root.glob("train/*.npy")], r"lacks 3 files .*nerfstudio"),
        (with_path(None), r"frames\[0\] has no 'hyperspectral_file_path'"),
        *((with_path(text), r"frames\[0\].*leaves the folder") for text in OUTSIDE),
        (with_path("train/frame 00001.npy"), "would both be the view 'frame_00001'"),
        *((with_content(text), "transforms.json") for text in NO_LIST),
    ],
)
def test_a_spoilt_list_of_frames_is_refused(tmp_path, spoil, message):
    write_unmix(tmp_path / "scene")
    spoil(tmp_path / "scene")
    with pytest.raises(CaptureError, match=message):
        find_unmix_nerf(tmp_path / "scene", PLAIN)


def test_a_mask_that_is_not_there_is_refused_and_missing_labels_are_said(tmp_path):
    write_unmix(tmp_path)
    (tmp_path / "train" / "frame_00001_seg.png").unlink()
    (tmp_path / "eval" / "frame_00003_seg.png").unlink()
    notes = find_unmix_nerf(tmp_path, PLAIN).notes
    assert any("2 views without the labels that transforms.json names" in note for note in notes)
    for named, said in (("masks/1.png", r"lacks 1 file of its views: masks/1\.png"), (5, "'mask_path' is 5")):
        edit(tmp_path, lambda content, named=named: content["frames"][1].update(mask_path=named))
        with pytest.raises(CaptureError, match=said):
            find_unmix_nerf(tmp_path, PLAIN)


@pytest.mark.parametrize("mode", ["RGB", "RGBA"])
def test_pictures_are_cubes_of_three_bands(tmp_path, mode):
    pixels = write_picture(tmp_path / "images" / "a.png", mode)
    write_picture(tmp_path / "images" / "b.png", mode)
    Image.fromarray(np.full((6, 8), 255, np.uint8)).save(tmp_path / "mask.png")
    frames = [{"file_path": f"images/{name}.png", "transform_matrix": pose(k)} for k, name in enumerate("ab")]
    frames[1]["mask_path"] = "mask.png"
    write_json(tmp_path / "transforms.json", LENS | {"frames": frames})
    first, second = find_nerfstudio(tmp_path, PLAIN).views
    evidence = "--wavelengths 610,550,465"
    check_file(first.cube, values=pixels[..., :3], encoding="sRGB", nm=None, evidence=evidence)
    assert (first.picture, first.mask, second.mask is None) == (first.cube.path, None, False)


def test_frames_may_name_envi_headers_in_a_folder_of_their_own(tmp_path):
    (tmp_path / "raw").mkdir()
    write_envi(tmp_path / "raw" / "a.hdr", cube(3), "bip", "wavelength = {450, 500, 550, 600}")
    frames = [{"file_path": "a.hdr", "transform_matrix": pose(0)}]
    write_json(tmp_path / "transforms.json", LENS | {"datadir": "raw", "frames": frames})
    (view,) = find_nerfstudio(tmp_path, PLAIN).views
    check_file(view.cube, values=cube(3), nm=[450, 500, 550, 600])
    assert view.picture is None


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


@pytest.mark.parametrize("layout", LAYOUTS)
def test_an_empty_folder_is_refused_by_every_layout(tmp_path, layout):
    with pytest.raises(CaptureError, match=r"holds no"):
        find_views(layout, tmp_path, PLAIN)


def linear_picture(root):
    pixels = np.asarray(Image.open(root / "train/frame_00002.png"))[..., ::-1] / 255
    return np.where(pixels <= 0.04045, pixels / 12.92, ((pixels + 0.055) / 1.055) ** 2.4)


def halves_of(*wavelengths):
    return np.stack([intensity(2, nm) / 2 for nm in wavelengths], axis=-1)


write_val = partial(write_unmix, written="val")
write_three = partial(write_real, views=("a", "b", "c"))
OPACITY = np.linspace(0, 1, 35).reshape(5, 7)
SEEN = (OPACITY > 0)[..., None]
NM = [450, 500, 550, 600]
SCENES = {
    "nerfstudio": (write_val, {"wavelengths": "610,550,465"}, [465, 550, 610], linear_picture),
    "unmix-nerf": (write_unmix, {"mask": "none"}, NM, lambda _: cube(2)),
    "nespof": (write_nespof, {"scale": 2.0}, [450, 460, 470], lambda _: SEEN * halves_of(450, 460, 470)),
    "nespof-real": (write_three, {"scale": 2.0}, [450, 460], lambda _: halves_of(450, 460)),
}


def test_a_layout_that_is_gone_is_refused_with_what_to_do(tmp_path):
    with pytest.raises(ConfigError, match="'hs-nerf' is no longer read: save its"):
        process(tmp_path, tmp_path / "scene", "hs-nerf")


@pytest.mark.parametrize("layout", SCENES)
def test_each_layout_becomes_a_scene_with_its_values_and_splits(tmp_path, layout):
    """Or asks for the wavelengths that it lacks."""
    write, options, nm, values = SCENES[layout]
    write(tmp_path / "data")
    if "wavelengths" in options:
        with pytest.raises(CaptureError, match="--wavelengths"):
            process(tmp_path / "data", tmp_path / "scene", layout)
    process(tmp_path / "data", tmp_path / "scene", layout, **{"scale": 1.0, **options})
    scene = load_scene(tmp_path / "scene")
    np.testing.assert_allclose(scene.cube(2), values(tmp_path / "data"), atol=1e-4)
    assert scene.wavelengths_nm.tolist() == nm
    evaluated = [scene.frames[index].name for index in scene.eval_indices]
    if layout == "unmix-nerf":
        assert (present(scene.labels(4)) == 4).all()
        assert evaluated == ["frame_00003", "frame_00004"]
    elif layout == "nespof":
        np.testing.assert_allclose(present(scene.alpha(2)), OPACITY, atol=0.003)
        assert evaluated == ["r_0"]
