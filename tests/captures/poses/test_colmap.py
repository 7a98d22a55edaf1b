import struct
from pathlib import Path

import numpy as np
import pytest

from tests.factories.files import present
from tests.factories.poses import FLIP, LENS, assert_same_poses, ring
from unmix_plugin.captures.poses.reading import read_poses
from unmix_plugin.errors import CaptureError

pycolmap = pytest.importorskip("pycolmap")
OPENCV = (*LENS.focal_px, *LENS.center_px, *LENS.distortion)


def make_model(model: str = "OPENCV", parameters: tuple[float, ...] = OPENCV):
    """A reconstruction of COLMAP's own with the ring's cameras and two points."""
    made = pycolmap.Reconstruction()
    camera = pycolmap.Camera(camera_id=7, model=model, width=640, height=480, params=list(parameters))
    made.add_camera_with_trivial_rig(camera)
    for number, (name, pose) in enumerate(ring().items(), start=1):
        rotation = (pose[:, :3] @ FLIP).T
        rigid = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ pose[:, 3])
        image = pycolmap.Image(name=f"folder/{name} x.jpg", camera_id=7, image_id=number)
        made.add_image_with_trivial_frame(image, rigid)
    for place in ([0.5, 0.25, -1.0], [1.0, 2.0, 3.0]):
        made.add_point3D(np.array(place), pycolmap.Track(), np.array([1, 2, 255], np.uint8))
    return made


def expected():
    return {f"folder/{name} x.jpg": pose for name, pose in ring().items()}


@pytest.mark.parametrize("kind", ["binary", "text"])
def test_models_that_colmap_wrote_are_read_alike(tmp_path, kind):
    folder = tmp_path / "sparse" / "0"
    folder.mkdir(parents=True)
    getattr(make_model(), f"write_{kind}")(folder)
    for place in (tmp_path, folder, folder / ("images.bin" if kind == "binary" else "images.txt")):
        found = read_poses(place)
        assert_same_poses(found, expected())
        assert {camera.lens for camera in found.cameras.values()} == {LENS}
        points = sorted(present(found.points).tolist())
        np.testing.assert_allclose(points, [[0.5, 0.25, -1.0], [1.0, 2.0, 3.0]])
        np.testing.assert_array_equal(present(found.colours), [[1, 2, 255]] * 2)


MODELS = {
    "SIMPLE_PINHOLE": (500, 321, 239),
    "PINHOLE": (500, 510, 321, 239),
    "SIMPLE_RADIAL": (500, 321, 239, 0.05),
    "RADIAL": (500, 321, 239, 0.05, -0.03),
    "OPENCV": OPENCV,
    "FULL_OPENCV": (500, 510, 321, 239, 0.01, -0.02, 0.001, -0.002, 0.01, 0.002, 0.003, -0.004),
    "OPENCV_FISHEYE": (900, 900, 321, 239, 0.01, -0.02, 0.001, -0.002),
    "RADIAL_FISHEYE": (900, 321, 239, 0.01, -0.02),
    "SIMPLE_RADIAL_FISHEYE": (900, 321, 239, 0.01),
    "FISHEYE": (250, 260, 321, 239),
    "FOV": (500, 510, 321, 239, 0.9),
    "THIN_PRISM_FISHEYE": (300, 310, 321, 239, 0.01, 0.02, 0.003, -0.002, 0.01, 0.001, 0.004, -0.003),
    "RAD_TAN_THIN_PRISM_FISHEYE": (300, 310, 321, 239, *[0.01, -0.002] * 3, 4e-3, -3e-3, *[2e-3, -1e-3] * 2),
    "DIVISION": (500, 510, 321, 239, -0.3),
    "SIMPLE_DIVISION": (500, 321, 239, 0.1),
    "EUCM": (300, 310, 321, 239, 0.6, 1.1),
    "EQUIRECTANGULAR": (640, 480),
}


@pytest.mark.parametrize("model", MODELS)
def test_lenses_see_what_colmaps_own_projection_sees(tmp_path, model):
    made = make_model(model, MODELS[model])
    made.write_binary(tmp_path)
    found = read_poses(tmp_path)
    lens = present(next(iter(found.cameras.values())).lens)
    ideal = np.random.default_rng(0).uniform([-0.3, -0.22], [0.3, 0.22], (50, 2))
    wanted = made.cameras[7].img_from_cam(np.column_stack([ideal, np.ones(50)]))
    if lens.resampled_from is not None:
        np.testing.assert_allclose(lens.resampled_from(ideal), wanted, atol=1e-9)
        assert any(f"lens model {model}" in note and "interpolated" in note for note in found.notes)
        return
    is_exact = model in ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
    assert is_exact == (not any("replaced by the nearest" in note for note in found.notes))
    np.testing.assert_allclose(lens.pixels_of(ideal), wanted, atol=1e-9 if is_exact else 0.3)


@pytest.mark.parametrize("places", [("sparse/0", "sparse/1"), ("c/d/0", "c/d/0/m/0", "c/d/0/m/1")])
def test_of_several_models_the_one_with_the_most_images_is_read_and_the_others_named(tmp_path, places):
    smaller = make_model()
    smaller.deregister_frame(1)
    for place in places:
        (tmp_path / place).mkdir(parents=True, exist_ok=True)
        (make_model() if place == places[-1] else smaller).write_binary(tmp_path / place)
    found = read_poses(tmp_path)
    assert_same_poses(found, expected())
    (note,) = (note for note in found.notes if f"{len(places)} COLMAP models" in note)
    assert str(Path(places[-2])) in note


@pytest.mark.parametrize("second_line", ["", "\n", "10.5 11.5 1 20 21 -1\n"])
@pytest.mark.parametrize("line_end", ["\n", "\r\n"])
def test_images_keep_their_poses_whatever_stands_between_their_lines(tmp_path, second_line, line_end):
    make_model().write_text(tmp_path)
    path = tmp_path / "images.txt"
    lines = [line for line in path.read_text().splitlines() if line.endswith(".jpg")]
    path.write_bytes("".join(f"{line}\n{second_line}" for line in lines).replace("\n", line_end).encode())
    assert_same_poses(read_poses(tmp_path), expected())


@pytest.mark.parametrize(
    ("name", "spoil", "message"),
    [
        ("cameras.txt", lambda _: b"# no cameras", "has no camera 7"),
        ("images.txt", lambda data: data[:-40].rsplit(b" ", 4)[0], r"line \d+: .*expected number, quat"),
        ("points3D.bin", lambda data: struct.pack("<Q", 2**60) + data[8:], "promises 1152921504606846976 "),
        ("cameras.txt", lambda _: b"7 DIVISION 640 480 500 500 321 239 1e9", "DIVISION can't be foll"),
    ],
)
def test_a_damaged_file_is_refused_by_name_before_anything_is_allocated(tmp_path, name, spoil, message):
    (make_model().write_text if name.endswith("txt") else make_model().write_binary)(tmp_path)
    (tmp_path / name).write_bytes(spoil((tmp_path / name).read_bytes()))
    with pytest.raises(CaptureError, match=message):
        read_poses(tmp_path)
