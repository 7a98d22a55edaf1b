import hashlib
import json
import os
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from PIL import Image

from tests.factories.files import present
from tests.factories.scenes import (
    FOCAL,
    HEIGHT,
    SPECTRUM,
    WAVELENGTHS,
    WIDTH,
    fault_of,
    look_at,
    make_scene,
    ring_poses,
    set_frame,
)
from unmix_plugin.scenes.reading import loader
from unmix_plugin.scenes.reading.faults import find_named
from unmix_plugin.scenes.reading.images import UnreadableImageError, read_colour, read_mask
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.settings import SceneOptions


def test_every_part_of_a_scene_is_what_was_written(folder):
    scene = load_scene(folder.root)
    assert scene.wavelengths_nm.tolist() == list(WAVELENGTHS)
    assert (scene.train_indices, scene.eval_indices) == ((1, 2, 3, 4, 5), (0,))
    assert (scene.has_alpha, scene.has_labels, scene.has_abundances) == (True, True, True)
    assert [frame.name for frame in scene.frames] == [f"view_{i}" for i in range(6)]
    assert scene.cube(3).dtype == np.float32
    pixels = np.asarray(Image.open(folder.root / "images/view_3.png"))
    for found, expected in (
        (scene.cube(3), np.load(folder.root / "cubes/view_3.npy")),
        (scene.alpha(3), pixels[..., 3] / 255.0),
        (scene.srgb(3), pixels[..., :3] / 255.0),
        (scene.labels(3), np.asarray(Image.open(folder.root / "labels/view_3.png"))),
        (scene.abundances(3), np.load(folder.root / "abundances/view_3.npy")),
    ):
        np.testing.assert_allclose(present(found), expected, atol=1e-7)
    assert scene.valid_mask(3).all()
    summary = json.loads(json.dumps(scene.summary(), allow_nan=False))
    assert summary["train_indices"] == list(scene.train_indices)
    assert summary["wavelengths_nm"] == list(WAVELENGTHS)
    assert summary["input_hashes"] == scene.input_hashes
    assert summary["normalisation"]["scale"] == scene.normalisation.scale
    assert summary["options"]["invalid_pixels"] == "refuse"


def test_endmembers_come_at_the_scenes_bands_by_the_names_of_materials(folder):
    scene, expected = load_scene(folder.root), np.array([[0.1, 0.3, 0.1, 0.1], SPECTRUM.tolist()])
    assert scene.material_names == ("leaf", "clay")
    np.testing.assert_allclose(present(scene.endmembers), expected, atol=1e-7)
    swapped = load_scene(folder.edit(lambda c: c.update(materials=["clay", "leaf"])).root)
    np.testing.assert_allclose(present(swapped.endmembers), expected[::-1], atol=1e-7)


def test_lines_of_a_lamp_between_bands_count_in_the_light_of_a_scene_as_in_a_light_to_show_it_in(folder):
    path = folder.root / "illuminant.csv"
    path.write_text("wavelength,power\n450,1\n559,1\n560,101\n561,1\n680,1\n")
    light = present(load_scene(folder.root).illuminant)
    # At 560 nm the bands at 520 and 600 nm meet, 75 and 80 nm wide: each has half of a triangle of 100 nm over 1.
    np.testing.assert_allclose(light, np.array([1, 1 + 50 / 75, 1 + 50 / 80, 1]) / (1 + 50 / 75))


def test_cameras_see_the_same_pixels_before_and_after_normalisation(folder):
    scene = load_scene(folder.root)
    pose = np.array(folder.content["frames"][2]["transform_matrix"])
    point = np.array([[0.3, -0.2, 0.1]])
    local = (point - pose[:3, 3]) @ pose[:3, :3]
    expected = [WIDTH / 2 - FOCAL * local[0, 0] / local[0, 2], HEIGHT / 2 + FOCAL * local[0, 1] / local[0, 2]]
    pixel, depth = scene.cameras.project(torch.from_numpy(scene.normalisation.to_model(point)).float(), 2)
    np.testing.assert_allclose(pixel[0].numpy(), expected, atol=1e-3)
    np.testing.assert_allclose(depth.item(), -local[0, 2] * scene.normalisation.scale, rtol=1e-5)


SCALES = {"u1": 255.0, "<u2": 65535.0, "<i2": 10000.0, "<i4": 10000.0}


@pytest.mark.parametrize("dtype", ["<f2", "<f4", ">f4", "<f8", "fortran", *SCALES])
def test_cubes_of_every_type_and_byte_order_read_alike(folder, dtype):
    expected, scale = load_scene(folder.root).cube(1), SCALES.get(dtype)

    def change(cube):
        scaled = cube if scale is None else np.round(cube.astype(np.float64) * scale)
        return np.asfortranarray(cube) if dtype == "fortran" else scaled.astype(dtype)

    found = load_scene(folder.edit_cubes(change).root, SceneOptions(value_scale=scale)).cube(1)
    np.testing.assert_allclose(found, expected, atol=0.0 if scale is None else 0.5 / scale + 1e-6, rtol=0)


@pytest.mark.parametrize("how", ["mask", "clip"])
def test_few_highlights_above_one_are_clipped_and_invalid_pixels_masked_and_zero_when_asked_to(folder, how):
    def spoil(cube):
        cube[2, 3, 1], cube[4, 5, 0], cube[6, 7, 3], cube[8, 10, 0] = np.nan, -0.01, np.inf, 3.0

    scene = load_scene(folder.edit_cube(2, spoil).root, SceneOptions(invalid_pixels=how))
    invalid = [[2, 3], [4, 5], [6, 7]] if how == "mask" else [[2, 3], [6, 7]]
    assert np.argwhere(~scene.valid_mask(2)).tolist() == invalid
    assert scene.cube(2).min() >= 0.0
    for part in ((slice(2, 7, 2), slice(3, 6)), (np.array([2, 3, 6]), np.array([3, 3, 7]))):
        np.testing.assert_array_equal(scene.valid_mask(2, part), scene.valid_mask(2)[part])
    assert np.isfinite(scene.cube(2)).all()
    assert not scene.cube(2)[2, 3].any()
    assert scene.cube(2)[8, 10, 0] == 1.0
    assert scene.valid_mask(1).all()


BLACK, WHITE = np.zeros((3, 4, 3), np.uint8), np.full((3, 4, 3), 255, np.uint8)
MASKS = {
    "255": lambda white: white * np.uint8(255),
    "1": lambda white: white.astype(np.uint8),
    "bits": lambda white: white,
    "16 bits": lambda white: white * np.uint16(65535),
    "1 in 16 bits": lambda white: white.astype(np.uint16),
    "38": lambda white: white * np.uint8(38),
    "colour": lambda white: np.dstack([white * np.uint8(255)] * 3),
    "opacity": lambda white: np.dstack([WHITE, white * np.uint8(255)]),
    "opacity of black": lambda white: np.dstack([BLACK, white * np.uint8(255)]),
}


@pytest.mark.parametrize("kind", MASKS)
def test_a_mask_is_white_where_pixels_count_whatever_its_numbers(tmp_path, kind):
    white = np.arange(12).reshape(3, 4) % 3 > 0
    Image.fromarray(MASKS[kind](white)).save(tmp_path / "mask.png")
    np.testing.assert_array_equal(read_mask(tmp_path / "mask.png", (3, 4)), white)


def test_masks_of_one_tone_and_soft_masks(tmp_path):
    for numbers in ((0, 0, 0, 0), (1, 1, 1, 1), (255, 255, 255, 255), (0, 100, 200, 255)):
        Image.fromarray(np.array([numbers], np.uint8)).save(tmp_path / "mask.png")
        expected = np.array(numbers) > (100 if max(numbers) > 127 else 0)
        assert np.array_equal(read_mask(tmp_path / "mask.png", (1, 4)), expected[None])
    Image.fromarray(np.array([[0, 1, 2, 3]], np.uint8)).save(tmp_path / "mask.png")
    with pytest.raises(UnreadableImageError, match="4 dark greys up to 3; expected 0 and 255"):
        read_mask(tmp_path / "mask.png", (1, 4))


@pytest.mark.parametrize(
    "renamed",
    [
        lambda path: path.replace("/", "\\"),
        lambda path: ".\\" + path.replace("/", "\\"),
        lambda path: "C:\\Users\\me\\pot\\" + path.replace("/", "\\"),
        lambda path: "/home/someone/pot/" + path,
        str.upper,
        lambda path: path.replace("view", "%76iew"),
    ],
)
def test_paths_of_other_systems_are_followed(folder, renamed):
    plain = load_scene(folder.root)

    def rename(content):
        for frame in content["frames"]:
            frame.update({key: renamed(value) for key, value in frame.items() if key.endswith("_path")})
        for key in ("train_filenames", "test_filenames"):
            content[key] = [renamed(path) for path in content[key]]

    scene = load_scene(folder.edit(rename).root)
    for found, frame in zip(scene.frames, plain.frames, strict=True):
        assert (found.cube_path, found.label_path) == (frame.cube_path, frame.label_path)


def test_a_file_of_another_machine_is_not_looked_for_by_its_bare_name_where_more_is_asked(tmp_path):
    (tmp_path / "a.png").write_bytes(b"a picture")
    assert find_named(tmp_path, "/home/someone/masks/a.png") == tmp_path / "a.png"
    assert find_named(tmp_path, "/home/someone/masks/a.png", least_parts=2) is None
    (tmp_path / "inside").mkdir()
    assert find_named(tmp_path / "inside", "../a.png") is None


def test_names_in_another_case_are_found_in_a_folder_of_thousands_and_after_it_changed(tmp_path, monkeypatch):
    (tmp_path / "Images").mkdir()
    for index in range(300):
        (tmp_path / "Images" / f"F_{index:04d}.PNG").touch()
    long_ago = time.time() - 60
    os.utime(tmp_path / "Images", (long_ago, long_ago))
    listed = []
    listing = Path.iterdir
    monkeypatch.setattr(Path, "iterdir", lambda folder: listed.append(folder) or listing(folder))
    for index in range(300):
        expected = tmp_path / "Images" / f"F_{index:04d}.PNG"
        assert find_named(tmp_path, f"Images/f_{index:04d}.png") == expected
    assert len(listed) == 1
    assert find_named(tmp_path, "Images/f_new.png") is None
    (tmp_path / "Images" / "F_NEW.png").touch()
    assert find_named(tmp_path, "Images/f_new.png") == tmp_path / "Images" / "F_NEW.png"


def test_black_pixels_of_a_mask_do_not_count_and_opaque_pictures_are_no_alpha(tmp_path):
    folder = make_scene(tmp_path / "scene", alpha=False)
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:3] = 0
    Image.fromarray(mask).save(folder.root / "mask.png")
    scene = load_scene(folder.edit(set_frame(1, mask_path="mask.png")).root)
    np.testing.assert_array_equal(scene.valid_mask(1), mask > 0)
    assert not scene.has_alpha
    assert scene.alpha(1) is None


@pytest.mark.parametrize("mode", ["RGB", "L", "P", "1", "RGBA"])
def test_a_colour_that_stands_for_transparency_is_alpha(folder, mode):
    for path in sorted((folder.root / "images").iterdir()):
        pixels = np.asarray(Image.open(path))
        is_seen = pixels[..., 3] > 127
        grey = Image.fromarray(np.where(is_seen, np.uint8(255), np.uint8(0)))
        if mode == "RGBA":
            Image.fromarray(np.dstack([np.asarray(grey)] * 3 + [255 * is_seen.astype(np.uint8)])).save(path)
        else:
            clear = {"RGB": (0, 0, 0), "P": np.asarray(grey.convert("P")).item(0)}.get(mode, 0)
            grey.convert(mode).save(path, transparency=clear)
        assert_allclose(read_colour(path, None)[..., 3], np.where(is_seen, 255, 0))
    assert load_scene(folder.root).has_alpha


def test_a_scene_needs_no_pictures_and_no_truth(folder):
    def bare(content):
        for key in ("materials", "illuminant_path", "endmembers_path", "train_filenames", "test_filenames"):
            del content[key]
        for frame in content["frames"]:
            for key in ("file_path", "seg_file_path", "abundance_file_path"):
                del frame[key]

    scene = load_scene(folder.edit(bare).root)
    absent = (scene.srgb(0), scene.labels(0), scene.abundances(0), scene.material_names, scene.illuminant)
    assert absent == (None,) * 5
    assert (scene.has_alpha, scene.has_labels, scene.has_abundances) == (False, False, False)


LENS = {"focal": [FOCAL, FOCAL], "center": [WIDTH / 2, HEIGHT / 2], "distortion": [0, 0, 0, 0]}
ANGLE = 2 * np.arctan(0.5 * WIDTH / 33.0)
MATRIX = [[34.0, 0, 9.5], [0, 34.0, 8.5], [0, 0, 1]]


@pytest.mark.parametrize(
    ("keys", "of_frame", "expected", "others"),
    [
        ({"camera_angle_x": ANGLE}, {}, {"focal": [33.0, 33.0]}, None),  # without any other key of a lens
        ({}, {"fl_x": 33.0, "cx": 9.5}, {"focal": [33.0, FOCAL], "center": [9.5, HEIGHT / 2]}, {}),
        ({}, {"k1": 0.01}, {"distortion": [0.01, 0, 0, 0]}, {}),
        ({}, {"camera_angle_x": ANGLE}, {"focal": [33.0, 33.0]}, {}),
        ({}, {"intrinsic_matrix": MATRIX}, {"focal": [34.0, 34.0], "center": [9.5, 8.5]}, {}),
        ({"distortion_params": [0.1, 0.2, 0, 0, 0.3, 0.4]}, {}, {"distortion": [0.1, 0.2, 0.3, 0.4]}, None),
        ({}, {"k3": 0.02, "k4": 0.3}, {"distortion": [0, 0, 0, 0, 0.02, 0.3]}, {"distortion": [0] * 6}),
    ],
)
def test_a_frames_own_lens_goes_before_that_of_the_scene(folder, keys, of_frame, expected, others):
    """And sizes may be left to the cubes. `others`: what other frames have; None where it is the same."""

    def change(content):
        for key in ("w", "h", *(("fl_x", "fl_y", "cx", "cy") if "camera_angle_x" in keys else ())):
            del content[key]
        content.update(keys)
        content["frames"][4].update(of_frame)

    cameras = load_scene(folder.edit(change).root).cameras
    assert (cameras.width, cameras.height) == (WIDTH, HEIGHT)
    for frame, lens in ((4, LENS | expected), (3, LENS | (expected if others is None else others))):
        assert_allclose(cameras.focal_px[frame].numpy(), lens["focal"], rtol=1e-6)
        assert_allclose(cameras.center_px[frame].numpy(), lens["center"], rtol=1e-6)
        assert_allclose(cameras.distortion[frame].numpy(), lens["distortion"], rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (set_frame(0, rolling_shutter=[0, 0, 1, 0]), ["'rolling_shutter' is set and not followed"]),
        (set_frame(0, mask_file="masks/0.png"), ["keys that are not known and not used: mask_file"]),
        *(
            (lambda c, key=key: c.update({key: [0, 1, 2, 3]}), [f"{key}: not followed beside 'frames'; give"])
            for key in ("mask_path", "bands", "sensor", "capture", "transform_matrix")
        ),
        (set_frame(2, applied_scale=2.0, materials=["leaf", "clay"]), ["applied_scale: not followed in fr"]),
        (set_frame(1, fl_x=FOCAL, fl_y=None), []),
        (set_frame(1, fl_x=33.0, k1=0.01), ["fl_x: frames have other values than the scene"]),
    ],
)
def test_keys_that_are_not_followed_not_known_or_given_twice_are_said(folder, change, said):
    found = load_scene(folder.edit(change).root).warnings
    assert len(found) == len(said)
    for text, expected in zip(found, said, strict=True):
        assert text.startswith(f"transforms.json: {expected}")


@pytest.mark.parametrize("key", ["value_scale", "wavelengths", "fwhm"])
def test_units_and_bands_of_a_frame_that_are_not_the_scenes_are_refused(folder, key):
    shared = {"value_scale": 1.0, "wavelengths": folder.content["wavelengths"], "fwhm": [5.0, 6.0, 7.0, 8.0]}
    own = 2.0 if key == "value_scale" else shared[key][::-1]
    folder.edit(lambda c: c.update(shared)).edit(set_frame(1, **{key: shared[key]}))
    assert not load_scene(folder.root).warnings
    message = fault_of(folder.edit(set_frame(1, **{key: own})))
    assert f"frames[1]: has a '{key}' of its own; all cubes of a scene share one" in message


def test_poses_of_three_rows_read_like_those_of_four(folder):
    expected = load_scene(folder.root).cameras.camera_to_world
    for index, frame in enumerate(folder.content["frames"]):
        folder.edit(set_frame(index, transform_matrix=frame["transform_matrix"][:3]))
    assert torch.equal(load_scene(folder.root).cameras.camera_to_world, expected)


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        (["CON.npy", "aux.x.npy"], ["_CON", "_aux.x"]),
        (["a:b.npy", "c. .npy"], ["a_b", "c"]),
        (["Leaf.npy", "leaf.npy"], ["0_Leaf", "1_leaf"]),
        (["x/nul.npy", "y/nul.npy"], ["x_nul", "y_nul"]),
        (["leaf (1).npy", "leaf (2).npy"], ["leaf (1)", "leaf (2)"]),
    ],
)
def test_names_are_those_of_different_files_on_every_system(files, expected):
    assert loader.distinct_names(files) == expected


def test_every_file_read_has_its_hash_and_a_changed_file_another(folder):
    scene = load_scene(folder.root)
    before = scene.input_hashes
    assert (len(before), len(scene.truth_hashes)) == (6 * 2 + 2, 6 * 2 + 1)
    for path, digest in {**before, **scene.truth_hashes}.items():
        assert digest == hashlib.sha256((folder.root / path).read_bytes()).hexdigest()
    folder.edit_cube(1, lambda cube: cube * np.float16(0.5))
    after = load_scene(folder.root).input_hashes
    assert {path for path in before if before[path] != after[path]} == {"cubes/view_1.npy"}


def test_links_out_of_the_folder_are_followed_when_allowed(folder, tmp_path):
    outside = tmp_path / "elsewhere.npy"
    (folder.root / "cubes/view_1.npy").rename(outside)
    (folder.root / "cubes/view_1.npy").symlink_to(outside)
    (folder.root / "cubes/view_2.npy").rename(tmp_path / "other.npy")
    folder.edit(set_frame(2, hyperspectral_file_path="../other.npy"))
    folder.edit(set_frame(3, hyperspectral_file_path=str(folder.root / "cubes/view_3.npy")))
    scene = load_scene(folder.root, SceneOptions(allow_outside_paths=True))
    assert scene.cube(1).shape == scene.cube(2).shape == (HEIGHT, WIDTH, len(WAVELENGTHS))


@pytest.mark.parametrize("away", [0.0, 5.0, 200.0])
def test_a_view_that_is_far_off_is_left_out_and_named(tmp_path, away):
    poses = ring_poses(16)
    poses[4][:3, 3] += away
    scene = load_scene(make_scene(tmp_path / "scene", alpha=False, poses=poses).root)
    assert (4 in scene.train_indices) == (away < 100)
    is_said = ["view_4.npy" in said and "its pose must be wrong" in said for said in scene.warnings]
    assert any(is_said) == (away > 100)


@pytest.mark.parametrize("lenses", [1, 5])
def test_far_off_is_told_among_ten_places_or_more(tmp_path, lenses):
    """Five lenses 2 cm apart, or views of one lens, and one 2 m away."""
    count, target = 9 if lenses == 1 else 15, np.zeros(3)
    places = [(3.0 + 0.02 * (index % lenses), 0.05 * (index // lenses), 0.5) for index in range(count)]
    poses = [look_at(np.array(place), target) for place in [*places, (3.0, 20.0, 0.5)]]
    folder = make_scene(tmp_path / "scene", poses=poses)
    for index in range(count if lenses > 1 else 0):
        folder.edit(set_frame(index, capture=f"shot_{index // lenses}"))
    scene = load_scene(folder.root)
    assert scene.train_indices == tuple(range(1, count + 1))
    assert not any("left out" in said for said in scene.warnings)


def test_bands_that_only_a_view_far_off_sees_are_refused(tmp_path):
    poses = ring_poses(16)
    poses[4][:3, 3] += 200.0
    folder = make_scene(tmp_path / "scene", alpha=False, poses=poses)
    for index in set(range(16)) - {4}:
        folder.edit_cube(index, lambda cube: cube[..., :3]).edit(set_frame(index, bands=[0, 1, 2]))
    fault = fault_of(folder)
    assert "no training frame sees the bands at 680 nm" in fault
    assert "left out of training: view_4.npy" in fault


def test_a_scene_of_nothing_but_sky_is_said_to_be_one(tmp_path):
    scene = load_scene(make_scene(tmp_path / "scene", alpha=False).root)
    assert not scene.has_backdrop
    assert "nothing but a plain backdrop or sky" in scene.warnings[0]
