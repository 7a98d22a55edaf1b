"""What can be wrong with the files of a scene: each fault gets one clear message, and all of them come at once."""

import os
import pickle

import numpy as np
import pytest
from PIL import Image

from tests.scenes.scene_factory import HEIGHT, WIDTH, SceneFolder, fault_of, make_scene, set_frame
from tests.systems import needs_posix
from unmix_plugin.errors import SceneError
from unmix_plugin.scenes.reading.faults import MAX_LISTED, Faults
from unmix_plugin.scenes.reading.images import UnreadableImageError, read_colour
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.settings import SceneOptions


@pytest.fixture
def folder(tmp_path) -> SceneFolder:
    return make_scene(tmp_path / "scene")


@pytest.mark.parametrize(
    ("path", "named"),
    [
        ("cubes/view_2.npy", "'cubes/view_2.npy' is missing"),
        ("images/view_2.png", "'images/view_2.png' is missing"),
        ("labels/view_2.png", "'labels/view_2.png' is missing"),
        ("abundances/view_2.npy", "'abundances/view_2.npy' is missing"),
    ],
)
def test_a_listed_file_that_is_missing_is_named(folder, path, named):
    (folder.root / path).unlink()
    assert f"frames[2]: {named}" in fault_of(folder)


def test_a_listed_mask_that_is_missing_is_named(folder):
    assert "'mask.png' is missing" in fault_of(folder.edit(set_frame(2, mask_path="mask.png")))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda cube: cube[..., :3], "the cube has 3 bands; expected 4"),
        (lambda cube: cube[:-1], "the cube has 20 x 15 pixels (width x height); expected 20 x 16"),
        (lambda cube: cube[..., 0], "has shape (16, 20); expected (H, W, B)"),
        (lambda cube: cube[:0], "has shape (0, 20, 4); expected (H, W, B)"),
        (
            lambda cube: cube.astype(np.complex64),
            "holds complex64 values; expected a float or an integer type",
        ),
        (lambda cube: cube.astype(bool), "holds bool values"),
        (lambda cube: cube.astype("U4"), "holds <U4 values"),
    ],
)
def test_a_cube_of_another_shape_or_type_is_refused(folder, change, message):
    fault = fault_of(folder.edit_cube(3, change))
    assert f"frames[3] cubes/view_3.npy: {message}" in fault


def test_nan_infinite_and_negative_values_are_counted_by_frame(folder):
    def spoil(cube):
        cube[0, 0, :2] = np.nan
        cube[1, 1, 1] = np.inf
        cube[2, 2, :3] = -0.25

    fault = fault_of(folder.edit_cube(4, spoil))
    assert (
        "frames[4] cubes/view_4.npy: the cube has 2 NaN, 1 infinite, 3 negative values in 3 of 320 pixels"
        in fault
    )
    assert "--invalid-pixels mask" in fault


def test_a_frame_without_any_valid_pixel_is_refused_even_when_masking(folder):
    folder.edit_cube(4, lambda cube: np.full_like(cube, np.nan))
    assert "every pixel of the cube has a NaN" in fault_of(folder, invalid_pixels="mask")


def test_a_double_beyond_single_precision_counts_as_infinite(folder):
    def spoil(cube):
        changed = cube.astype(np.float64)
        changed[0, 0, 0] = 1e300
        return changed

    assert "the cube has 1 infinite values in 1 of 320 pixels" in fault_of(folder.edit_cube(2, spoil))


@pytest.mark.parametrize(
    ("factor", "scale"), [(100.0, "100"), (255.0, "255"), (4000.0, "10000"), (60000.0, "65535")]
)
def test_float_cubes_in_other_units_get_a_scale_proposed_that_then_works(folder, factor, scale):
    folder.edit_cubes(lambda cube: cube.astype(np.float32) * factor)
    fault = fault_of(folder)
    assert "values are far outside [0, 1]" in fault
    assert f"--value-scale {scale}" in fault
    assert load_scene(folder.root, SceneOptions(value_scale=float(scale))).cube(1).max() <= 1.0


def test_noise_around_black_is_one_message_with_two_remedies(folder):
    for index in range(6):
        folder.edit_cube(index, lambda cube, i=index: cube - np.float16(0.001 * (i + 1)) * (cube < 0.1))
    fault = fault_of(folder)
    assert "faults in the scene" not in fault
    assert "frames[2] cubes/view_2.npy and 3 more: their cubes have " in fault
    assert "negative values in" in fault
    assert "down to -0.006" in fault
    assert "--invalid-pixels mask; for noise around black --invalid-pixels clip" in fault
    scene = load_scene(folder.root, SceneOptions(invalid_pixels="clip"))
    assert scene.valid_mask(3).all()
    assert scene.cube(3).min() == 0.0


def test_clipping_leaves_out_what_is_no_number(folder):
    def spoil(cube):
        cube[0, 0, 1], cube[1, 1, 2], cube[2, 2, 3] = np.nan, np.inf, -0.01

    scene = load_scene(folder.edit_cube(2, spoil).root, SceneOptions(invalid_pixels="clip"))
    assert np.argwhere(~scene.valid_mask(2)).tolist() == [[0, 0], [1, 1]]
    assert np.isfinite(scene.cube(2)).all()
    assert scene.cube(2).min() >= 0.0


def test_a_cube_that_is_mostly_negative_is_not_clipped(folder):
    folder.edit_cube(2, lambda cube: cube - 1)
    assert "values far below 0, which is not noise" in fault_of(folder, invalid_pixels="clip")


@pytest.mark.parametrize(
    ("dtype", "factor", "scale"),
    [
        ("u1", 255, "255"),
        ("<u2", 1023, "1023"),
        ("<u2", 4095, "4095"),
        ("<u2", 16383, "16383"),
        ("<i2", 10000, "10000"),
        ("<u2", 65535, "65535"),
    ],
)
def test_integer_cubes_are_refused_with_the_scale_that_fits(folder, dtype, factor, scale):
    folder.edit_cubes(lambda cube: np.round(cube.astype(np.float64) * factor).astype(dtype))
    fault = fault_of(folder)
    assert "the cube holds integers" in fault
    assert f"--value-scale {scale}" in fault


def test_a_value_scale_that_is_much_too_small_is_refused(folder):
    folder.edit_cubes(lambda cube: np.full(cube.shape, 4000, np.uint16))
    assert "after division by --value-scale 255" in fault_of(folder, value_scale=255.0)


@pytest.mark.parametrize("scale", [0.0, -1.0, 1e-320, float("nan"), float("inf")])
def test_a_value_scale_that_is_no_positive_number_is_refused(folder, scale):
    assert "--value-scale: is" in fault_of(folder, value_scale=scale)


class Exploding:
    """A pickle of this leaves a mark when it is loaded."""

    def __init__(self, mark):
        self.mark = str(mark)

    def __reduce__(self):
        return os.mkdir, (self.mark,)


def test_a_pickled_array_is_refused_without_being_loaded(folder, tmp_path):
    mark = tmp_path / "exploded"
    np.save(folder.root / "cubes/view_2.npy", np.array([Exploding(mark)], dtype=object), allow_pickle=True)
    assert "holds pickled Python objects, which are never loaded" in fault_of(folder)
    assert not mark.exists()


def test_a_bare_pickle_is_refused_without_being_loaded(folder, tmp_path):
    mark = tmp_path / "exploded"
    (folder.root / "cubes/view_2.npy").write_bytes(pickle.dumps(Exploding(mark)))
    assert "is not a .npy file" in fault_of(folder)
    assert not mark.exists()


@pytest.mark.parametrize("kept_bytes", [0, 5, 9, 60, 128, 500])
def test_a_cube_that_was_cut_short_is_refused_wherever_the_cut_is(folder, kept_bytes):
    path = folder.root / "cubes/view_2.npy"
    path.write_bytes(path.read_bytes()[:kept_bytes])
    assert "frames[2] cubes/view_2.npy: " in fault_of(folder)


@pytest.mark.parametrize("shape", [b"(-1, 20, 4)", b"(True, 9, 4)", b"(-6,-2, 4) "])
def test_a_header_with_an_impossible_shape_is_refused(folder, shape):
    path = folder.root / "cubes/view_2.npy"
    data = path.read_bytes()
    assert data.count(b"(16, 20, 4)") == 1
    extra = len(shape) - len(b"(16, 20, 4)")
    path.write_bytes(data.replace(b"(16, 20, 4)", shape).replace(b" " * extra + b"\n", b"\n", 1))
    assert "frames[2] cubes/view_2.npy: has the shape (" in fault_of(folder)


def test_a_header_that_claims_more_than_the_file_holds_allocates_nothing(folder):
    path = folder.root / "cubes/view_2.npy"
    content = path.read_bytes().replace(b"(16, 20, 4)", b"(9999999, 99999, 99)", 1)
    path.write_bytes(content.replace(b" " * 9 + b"\n", b"\n", 1))
    assert "is cut short" in fault_of(folder)


@pytest.mark.parametrize("outside", ["../secret.npy", "cubes/../../secret.npy", "{absolute}"])
def test_a_path_out_of_the_scene_folder_is_refused(folder, tmp_path, outside):
    np.save(tmp_path / "secret.npy", np.zeros((HEIGHT, WIDTH, 4)))
    text = outside.format(absolute=tmp_path / "secret.npy")
    fault = fault_of(folder.edit(set_frame(2, hyperspectral_file_path=text)))
    assert f"frames[2]: {text!r} leaves the scene folder" in fault


def test_an_absolute_path_out_of_the_scene_folder_is_refused_too(folder, tmp_path):
    np.save(tmp_path / "view_9.npy", np.zeros((HEIGHT, WIDTH, 4)))
    text = str(tmp_path / "view_9.npy")
    assert "leaves the scene folder" in fault_of(folder.edit(set_frame(2, hyperspectral_file_path=text)))


@pytest.mark.parametrize("is_folder", [True, False])
def test_a_symbolic_link_out_of_the_scene_folder_is_refused(folder, tmp_path, is_folder):
    np.save(tmp_path / "secret.npy", np.zeros((HEIGHT, WIDTH, 4)))
    (folder.root / "link").symlink_to(tmp_path if is_folder else tmp_path / "secret.npy")
    text = "link/secret.npy" if is_folder else "link"
    assert "leaves the scene folder" in fault_of(folder.edit(set_frame(2, hyperspectral_file_path=text)))


@pytest.mark.parametrize("key", ["illuminant_path", "endmembers_path"])
def test_the_tables_must_lie_in_the_scene_folder_too(folder, tmp_path, key):
    (tmp_path / "secret.csv").write_text("wavelength,power\n400,1\n", encoding="utf-8")
    assert f"'{key}': '../secret.csv' leaves" in fault_of(
        folder.edit(lambda c: c.update({key: "../secret.csv"}))
    )


@needs_posix
def test_a_pipe_is_no_plain_file(folder):
    os.mkfifo(folder.root / "pipe")
    fault = fault_of(folder.edit(set_frame(2, hyperspectral_file_path="pipe")))
    assert "'pipe' is not a plain file" in fault


def test_no_frames_to_evaluate_are_refused(folder):
    folder.edit(lambda c: c.update(test_filenames=[], train_filenames=[f["file_path"] for f in c["frames"]]))
    assert "no frame is left to evaluate" in fault_of(folder)


def test_no_frames_to_train_on_are_refused(folder):
    folder.edit(lambda c: c.update(train_filenames=[]))
    assert "no frame is left to train on" in fault_of(folder)


def test_a_frame_both_trained_on_and_evaluated_is_refused(folder):
    folder.edit(lambda c: c["train_filenames"].append("images/view_0.png"))
    assert "frames[0]: is listed for training and for evaluation" in fault_of(folder)


def save_labels(folder: SceneFolder, labels: np.ndarray) -> SceneFolder:
    Image.fromarray(labels).save(folder.root / "labels/view_2.png")
    return folder


@pytest.mark.parametrize(
    ("labels", "message"),
    [
        (np.zeros((HEIGHT, WIDTH + 1), np.uint8), "the picture has 21 x 16 pixels"),
        (np.zeros((HEIGHT, WIDTH, 3), np.uint8), "is a picture of mode RGB; expected one 8-bit channel"),
        (np.zeros((HEIGHT, WIDTH), np.uint16), "expected one 8-bit channel"),
        (np.full((HEIGHT, WIDTH), 2, np.uint8), "has label 2; expected 0 to 1 for the materials, or 255"),
    ],
)
def test_labels_of_another_size_or_type_or_range_are_refused(folder, labels, message):
    fault = fault_of(save_labels(folder, labels))
    assert "frames[2] labels/view_2.png" in fault
    assert message in fault


def test_a_picture_of_another_size_or_a_damaged_one_is_refused(folder):
    Image.new("RGBA", (WIDTH, HEIGHT + 2)).save(folder.root / "images/view_1.png")
    path = folder.root / "images/view_2.png"
    path.write_bytes(path.read_bytes()[:60])
    fault = fault_of(folder)
    assert "frames[1] images/view_1.png: the picture has 20 x 18 pixels" in fault
    assert "frames[2] images/view_2.png: cannot be read as a picture: PNG, JPEG, TIFF" in fault


def test_a_small_file_that_decodes_to_gigabytes_is_refused_by_its_size(folder, monkeypatch):
    path = folder.root / "images/view_2.png"
    Image.new("RGBA", (3000, 2000)).save(path)
    monkeypatch.setattr("PIL.ImageFile.ImageFile.load", lambda _: pytest.fail("it was decoded"))
    with pytest.raises(UnreadableImageError, match="3000 x 2000 pixels"):
        read_colour(path, (HEIGHT, WIDTH))


@pytest.mark.parametrize("form", ["EPS", "GIF", "BMP", "PPM"])
def test_a_picture_of_another_format_is_refused_whatever_its_name(folder, form):
    Image.new("RGB", (WIDTH, HEIGHT)).save(folder.root / "images/view_2.png", form)
    assert "view_2.png: cannot be read as a picture: PNG, JPEG, TIFF" in fault_of(folder)


def test_alpha_in_some_pictures_only_is_refused(folder):
    Image.new("RGB", (WIDTH, HEIGHT)).save(folder.root / "images/view_2.png")
    assert "frames[2] images/view_2.png: has no picture with alpha, while frames[0]" in fault_of(folder)


def test_a_mask_that_is_black_everywhere_is_refused(folder):
    Image.new("L", (WIDTH, HEIGHT)).save(folder.root / "mask.png")
    assert "the mask is black everywhere" in fault_of(folder.edit(set_frame(2, mask_path="mask.png")))


@pytest.mark.parametrize(
    ("abundances", "message"),
    [
        (np.zeros((HEIGHT, WIDTH, 3)), "has 3 abundances a pixel; expected 2, one a material"),
        (np.zeros((HEIGHT + 1, WIDTH, 2)), "has 20 x 17 pixels"),
        (np.full((HEIGHT, WIDTH, 2), np.nan), "has abundances outside [0, 1] or NaN"),
        (np.full((HEIGHT, WIDTH, 2), 7), "has abundances outside [0, 1] or NaN"),
        (np.zeros((HEIGHT, WIDTH)), "has shape (16, 20); expected (H, W, K)"),
    ],
)
def test_abundances_that_do_not_fit_are_refused(folder, abundances, message):
    np.save(folder.root / "abundances/view_0.npy", abundances)
    fault = fault_of(folder)
    assert "frames[0] abundances/view_0.npy" in fault
    assert message in fault


@pytest.mark.parametrize(
    "text", ["", "wavelength,power\n", "wavelength,power\n450,x\n", "wavelength,power\n500,1\n"]
)
def test_a_table_that_is_no_spectrum_of_these_bands_is_refused(folder, text):
    (folder.root / "illuminant.csv").write_text(text, encoding="utf-8")
    assert "'illuminant_path': " in fault_of(folder)


def test_alpha_that_contradicts_the_poses_is_refused(folder):
    for index in (1, 2, 3):  # these look through everything that 4 and 5 show
        Image.new("RGBA", (WIDTH, HEIGHT)).save(folder.root / f"images/view_{index}.png")
    fault = fault_of(folder)
    assert "alpha and poses contradict: only " in fault
    assert "OpenGL axes" in fault


def test_alpha_that_is_transparent_everywhere_is_refused(folder):
    for index in range(6):
        Image.new("RGBA", (WIDTH, HEIGHT)).save(folder.root / f"images/view_{index}.png")
    assert "alpha and poses contradict" in fault_of(folder)


def test_all_faults_of_a_scene_come_in_one_message(folder):
    folder.edit_cube(1, lambda cube: cube[..., :2])
    folder.edit_cube(2, lambda cube: np.full_like(cube, np.nan))
    (folder.root / "labels/view_3.png").unlink()
    folder.edit(
        lambda c: (c.update(fl_x="wide"), c.pop("train_filenames"), c["frames"][4].pop("transform_matrix"))
    )
    fault = fault_of(folder)
    assert "5 faults in the scene" in fault
    for part in (
        "has 2 bands",
        "1280 NaN",
        "'labels/view_3.png' is missing",
        "'fl_x' is \"wide\"",
        "is absent",
    ):
        assert part in fault


def test_a_fault_of_many_frames_is_told_once_with_their_number(tmp_path):
    folder = make_scene(tmp_path / "scene").edit_cubes(lambda cube: cube[..., :3])
    fault = fault_of(folder)
    assert fault.count("the cube has 3 bands") == 1
    assert (
        "frames[0] cubes/view_0.npy, frames[1] cubes/view_1.npy, frames[2] cubes/view_2.npy and 3 more: "
        in fault
    )


def test_a_long_list_of_faults_is_cut_with_a_count(tmp_path):
    faults = Faults(tmp_path)
    for number in range(MAX_LISTED + 13):
        faults.add(f"frames[{number}]", f"fault {number}")
    with pytest.raises(SceneError) as caught:
        faults.raise_if_any()
    message = str(caught.value)
    assert f"{MAX_LISTED + 13} faults" in message
    assert "fault 19" in message
    assert "fault 20" not in message
    assert message.endswith("and 13 more")


def test_refusing_a_scene_writes_nothing(folder):
    folder.edit_cube(1, lambda cube: cube[..., :2])
    before = sorted(path for path in folder.root.rglob("*"))
    fault_of(folder)
    assert sorted(path for path in folder.root.rglob("*")) == before
