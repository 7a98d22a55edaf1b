import os
import pickle

import numpy as np
import pytest
from PIL import Image

from tests.factories.scenes import HEIGHT, WIDTH, fault_of, set_frame
from tests.factories.systems import needs_posix
from unmix_plugin.errors import SceneError
from unmix_plugin.scenes.reading.faults import MAX_LISTED, Faults
from unmix_plugin.scenes.reading.images import UnreadableImageError, read_colour
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.settings import SceneOptions


def beyond_single_precision(cube):
    changed = cube.astype(np.float64)
    changed[0, 0, 0] = 1e300
    return changed


def spoil(cube):
    cube[0, 0, :2], cube[1, 1, 1], cube[2, 2, :3] = np.nan, np.inf, -0.25


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda cube: cube[..., :3], "the cube has 3 bands; expected 4"),
        (lambda cube: cube[:-1], "the cube has 20 x 15 pixels (width x height); expected 20 x 16"),
        (lambda cube: cube[..., 0], "has shape (16, 20); expected (H, W, B)"),
        (lambda cube: cube[:0], "has shape (0, 20, 4); expected (H, W, B)"),
        (lambda cube: cube.astype(np.complex64), "holds complex64 values; expected a float or an integer"),
        (lambda cube: cube.astype(bool), "holds bool values"),
        (lambda cube: cube.astype("U4"), "holds <U4 values"),
        (beyond_single_precision, "the cube has 1 infinite values in 1 of 320 pixels"),
        (spoil, "the cube has 2 NaN, 1 infinite, 3 negative values in 3 of 320 pixels, down to -0.25;"),
    ],
)
def test_a_cube_of_another_shape_or_type_or_with_values_that_are_none_is_refused(folder, change, message):
    assert f"frames[3] cubes/view_3.npy: {message}" in fault_of(folder.edit_cube(3, change))


@pytest.mark.parametrize(
    ("dtype", "factor", "scale"),
    [
        *(("<f4", 100, 100), ("<f4", 255, 255), ("<f4", 4000, 10000), ("<f4", 60000, 65535)),
        *(("<u2", factor, factor) for factor in (1023, 4095, 16383, 65535)),
        *(("u1", 255, 255), ("<i2", 10000, 10000)),
    ],
)
def test_cubes_in_other_units_get_a_scale_proposed_that_then_works(folder, dtype, factor, scale):
    digits = 1 if dtype == "<f4" else 0
    folder.edit_cubes(lambda cube: np.round(cube.astype(np.float64) * factor, digits).astype(dtype))
    fault = fault_of(folder)
    assert ("values are far outside [0, 1]" if dtype == "<f4" else "the cube holds integers") in fault
    assert f"--value-scale {scale}" in fault
    assert load_scene(folder.root, SceneOptions(value_scale=float(scale))).cube(1).max() <= 1.0


@pytest.mark.parametrize("scale_in", ["options", "transforms.json"])
def test_a_scale_that_clips_more_than_highlights_is_said_with_one_that_does_not(folder, scale_in):
    folder.edit_cubes(lambda cube: np.round(cube.astype(np.float64) * 10000).astype(np.uint16))

    def read(scale):
        in_options = scale if scale_in == "options" else None
        folder.edit(lambda content: content.update(value_scale=None if in_options else scale))
        return load_scene(folder.root, SceneOptions(value_scale=in_options)).warnings

    (said,) = read(6000.0)
    share = max((np.load(path) > 6000).mean() for path in (folder.root / "cubes").iterdir())
    assert f"up to {share:.2g} of the values are above 1 after division by the value scale 6000" in said
    assert "(up to 7998 as stored); if they are no highlights, give --value-scale 10000" in said
    assert not read(10000.0)


def test_values_far_above_the_scale_in_few_places_or_far_below_it_everywhere_are_said(folder):
    folder.edit_cubes(lambda cube: np.round(cube.astype(np.float64) * 900).astype(np.uint16))

    def read(scale):
        return load_scene(folder.root, SceneOptions(value_scale=scale)).warnings

    assert not read(1023.0)
    (dark,) = read(250_000.0)
    assert "no value of the cubes is above 0.0029 after division by the value scale 250000 (up to 720" in dark
    assert "give --value-scale 1023" in dark

    def brighten(cube):
        cube[0, 0] = 20_000
        return cube

    folder.edit_cube(1, brighten)
    (bright,) = read(1023.0)
    assert "cubes/view_1.npy: up to 0.00" in bright
    assert "up to 20000 as stored" in bright


@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        (lambda cube: cube * np.nan, {"invalid_pixels": "mask"}, "every pixel of the cube has a NaN"),
        (lambda cube: cube - 1, {"invalid_pixels": "clip"}, "values far below 0, which is not noise"),
        (lambda cube: np.uint16(0 * cube + 4000), {"value_scale": 255.0}, "division by --value-scale 255"),
    ],
)
def test_options_that_can_not_mend_the_cubes_are_refused(folder, change, options, message):
    assert message in fault_of(folder.edit_cubes(change), **options)


def test_noise_around_black_is_one_message_with_two_remedies(folder):
    for index in range(6):
        folder.edit_cube(index, lambda cube, i=index: cube - np.float16(0.001 * (i + 1)) * (cube < 0.1))
    fault = fault_of(folder)
    assert "faults in the scene" not in fault
    for part in (
        "frames[2] cubes/view_2.npy and 3 more: their cubes have ",
        "down to -0.006",
        "--invalid-pixels mask; for noise around black --invalid-pixels clip",
    ):
        assert part in fault
    scene = load_scene(folder.root, SceneOptions(invalid_pixels="clip"))
    assert scene.valid_mask(3).all()
    assert scene.cube(3).min() == 0.0


class Exploding:
    """A pickle of this leaves a mark when it is loaded."""

    def __init__(self, mark):
        self.mark = str(mark)

    def __reduce__(self):
        return os.mkdir, (self.mark,)


@pytest.mark.parametrize("is_array", [True, False])
def test_pickles_are_refused_without_being_loaded(folder, tmp_path, is_array):
    mark, path = tmp_path / "exploded", folder.root / "cubes/view_2.npy"
    if is_array:
        np.save(path, np.array([Exploding(mark)], dtype=object), allow_pickle=True)
    else:
        path.write_bytes(pickle.dumps(Exploding(mark)))
    said = "holds pickled Python objects, which are never loaded" if is_array else "is not a .npy file"
    assert said in fault_of(folder)
    assert not mark.exists()


def with_shape(data: bytes, shape: bytes) -> bytes:
    """A .npy file that claims another shape, its header as long as before."""
    assert data.count(b"(16, 20, 4)") == 1
    padding = b" " * max(len(shape) - len(b"(16, 20, 4)"), 0)
    return data.replace(b"(16, 20, 4)", shape).replace(padding + b"\n", b"\n", 1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        *((lambda data, n=n: data[:n], "") for n in (0, 5, 9, 60, 128, 500)),
        *(
            (lambda data, shape=shape: with_shape(data, shape), "has the shape (")
            for shape in (b"(-1, 20, 4)", b"(True, 9, 4)", b"(-6,-2, 4) ")
        ),
        (lambda data: with_shape(data, b"(9999999, 99999, 99)"), "is cut short"),  # which allocates nothing
    ],
)
def test_a_cube_that_was_cut_short_or_claims_an_impossible_shape_is_refused(folder, change, message):
    path = folder.root / "cubes/view_2.npy"
    path.write_bytes(change(path.read_bytes()))
    assert f"frames[2] cubes/view_2.npy: {message}" in fault_of(folder)


@pytest.mark.parametrize("link", [None, "folder", "file"])
@pytest.mark.parametrize("outside", ["../view_9.npy", "cubes/../../view_9.npy", "{absolute}"])
def test_a_path_or_a_link_out_of_the_scene_folder_is_refused(folder, tmp_path, outside, link):
    np.save(tmp_path / "view_9.npy", np.zeros((HEIGHT, WIDTH, 4)))
    text = outside.format(absolute=tmp_path / "view_9.npy")
    if link is not None:
        (folder.root / "link").symlink_to(tmp_path if link == "folder" else tmp_path / "view_9.npy")
        text = "link/view_9.npy" if link == "folder" else "link"
    fault = fault_of(folder.edit(set_frame(2, hyperspectral_file_path=text)))
    assert f"frames[2]: {text!r} leaves the scene folder" in fault


@needs_posix
def test_a_pipe_is_no_plain_file(folder):
    os.mkfifo(folder.root / "pipe")
    fault = fault_of(folder.edit(set_frame(2, hyperspectral_file_path="pipe")))
    assert "'pipe' is not a plain file" in fault


LABELS, PICTURE, ABUNDANCES = "labels/view_2.png", "images/view_2.png", "abundances/view_2.npy"
MASK, NO_PICTURE = "mask.png", "cannot be read as a picture: PNG, JPEG, TIFF"


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        (LABELS, np.zeros((HEIGHT, WIDTH + 1), np.uint8), "the picture has 21 x 16 pixels"),
        (LABELS, np.zeros((HEIGHT, WIDTH, 3), np.uint8), "is a picture of mode RGB; expected one 8-bit"),
        (LABELS, np.zeros((HEIGHT, WIDTH), np.uint16), "expected one 8-bit channel"),
        (LABELS, np.full((HEIGHT, WIDTH), 2, np.uint8), "has label 2; expected 0 to 1 for the materials, or"),
        (
            ABUNDANCES,
            np.zeros((HEIGHT, WIDTH, 3)),
            "has 3 abundances per pixel; expected 2, one per material",
        ),
        (ABUNDANCES, np.zeros((HEIGHT + 1, WIDTH, 2)), "has 20 x 17 pixels"),
        (ABUNDANCES, np.full((HEIGHT, WIDTH, 2), np.nan), "has abundances outside [0, 1] or NaN"),
        (ABUNDANCES, np.full((HEIGHT, WIDTH, 2), 7), "has abundances outside [0, 1] or NaN"),
        (ABUNDANCES, np.zeros((HEIGHT, WIDTH)), "has shape (16, 20); expected (H, W, K)"),
        (PICTURE, Image.new("RGBA", (WIDTH, HEIGHT + 2)), "the picture has 20 x 18 pixels"),
        (PICTURE, b"\x89PNG\r\n\x1a\n" + bytes(50), NO_PICTURE),
        (PICTURE, Image.new("RGB", (WIDTH, HEIGHT)), "has no picture with alpha, while frames[0]"),
        (MASK, Image.new("L", (WIDTH, HEIGHT)), "the mask is black everywhere"),
        *(
            (f"{PICTURE} {kind}", Image.new("RGB", (20, 16)), NO_PICTURE)
            for kind in ("EPS", "GIF", "BMP", "PPM")
        ),
    ],
)
def test_files_beside_a_cube_that_do_not_fit_it_are_refused(folder, name, content, message):
    """Pictures of another format also, whatever their name."""
    name, _, form = name.partition(" ")
    path = folder.root / name
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif path.suffix == ".npy":
        np.save(path, content)
    else:
        (content if isinstance(content, Image.Image) else Image.fromarray(content)).save(path, form or "PNG")
    if name == MASK:
        folder.edit(set_frame(2, mask_path=MASK))
    fault = fault_of(folder)
    assert f"frames[2] {name}" in fault
    assert message in fault


def test_a_mask_that_leaves_nothing_but_invalid_pixels_is_refused(folder):
    mask = np.where(np.arange(WIDTH) < 5, 0, 255).astype(np.uint8)[None].repeat(HEIGHT, 0)
    Image.fromarray(mask).save(folder.root / MASK)
    folder.edit_cube(2, lambda cube: np.where(mask[..., None] > 0, np.nan, cube))
    message = fault_of(folder.edit(set_frame(2, mask_path=MASK)), invalid_pixels="mask")
    assert "frames[2] cubes/view_2.npy: the mask leaves only pixels with NaN" in message


def test_a_small_file_that_decodes_to_gigabytes_is_refused_by_its_size(folder, monkeypatch):
    path = folder.root / PICTURE
    Image.new("RGBA", (3000, 2000)).save(path)
    monkeypatch.setattr("PIL.ImageFile.ImageFile.load", lambda _: pytest.fail("it was decoded"))
    with pytest.raises(UnreadableImageError, match="3000 x 2000 pixels"):
        read_colour(path, (HEIGHT, WIDTH))


def test_a_table_that_is_no_spectrum_of_these_bands_is_refused(folder):
    for text in ("", "wavelength,power\n", "wavelength,power\n450,x\n", "wavelength,power\n500,1\n"):
        (folder.root / "illuminant.csv").write_text(text, encoding="utf-8")
        assert "'illuminant_path': " in fault_of(folder)


@pytest.mark.parametrize("views", [(1, 2, 3), range(6)])
def test_alpha_that_contradicts_the_poses_is_refused(folder, views):
    """Views that look through everything that the others show, or all of them."""
    for index in views:
        Image.new("RGBA", (WIDTH, HEIGHT)).save(folder.root / f"images/view_{index}.png")
    fault = fault_of(folder)
    assert "alpha and poses contradict" in fault
    assert "OpenGL axes" in fault


def test_all_faults_of_a_scene_come_in_one_message(folder):
    folder.edit_cube(1, lambda cube: cube[..., :2])
    folder.edit_cube(2, lambda cube: np.full_like(cube, np.nan))
    (folder.root / "labels/view_3.png").unlink()
    folder.edit(set_frame(4, transform_matrix=None))
    folder.edit(lambda content: (content.update(fl_x="wide"), content.pop("train_filenames")))
    before = sorted(folder.root.rglob("*"))
    fault = fault_of(folder)
    assert sorted(folder.root.rglob("*")) == before  # nothing is written
    parts = ("has 2 bands", "1280 NaN", "'labels/view_3.png' is missing", "'fl_x' is \"wide\"", "is absent")
    for part in ("5 faults in the scene", *parts):
        assert part in fault


def test_a_fault_of_many_frames_is_told_once_and_a_long_list_is_cut_with_a_count(folder):
    fault = fault_of(folder.edit_cubes(lambda cube: cube[..., :3]))
    names = ", ".join(f"frames[{index}] cubes/view_{index}.npy" for index in range(3))
    assert fault.count(f"{names} and 3 more: the cube has 3 bands") == 1
    faults = Faults(folder.root)
    for number in range(MAX_LISTED + 13):
        faults.add(f"frames[{number}]", f"fault {number}")
    with pytest.raises(SceneError, match=rf"(?s){MAX_LISTED + 13} faults.*fault 19\n.*and 13 more$"):
        faults.raise_if_any()
