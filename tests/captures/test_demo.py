"""The demo scene as raw counts, which calibration by hand turns into the truth; and its poses, found in them."""

import json
import re
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.factories.commands import done
from tests.factories.files import check_file, present
from tests.factories.poses import align_poses
from unmix_plugin.captures import demo as demo_capture
from unmix_plugin.captures.demo import MARKER_FAMILY, MARKER_SIZE, make_demo_capture, marked_place
from unmix_plugin.captures.poses.lens import Lens
from unmix_plugin.captures.poses.marker_detection import find_markers
from unmix_plugin.captures.poses.pose_set import PosedCamera
from unmix_plugin.captures.poses.reading import read_poses
from unmix_plugin.captures.readers.opening import open_spectral_file
from unmix_plugin.commands.process import process
from unmix_plugin.errors import ConfigError
from unmix_plugin.scenes.demo.scene import demo_cameras, label_image, reflected
from unmix_plugin.scenes.demo.shading import band_centers_nm, reflectances, render_view, speckled_things
from unmix_plugin.scenes.reading.loader import load_scene

SIZE, BANDS, VIEWS = 48, 12, 5
GOOD = [band for band in range(BANDS) if band not in (0, BANDS // 3, 2 * BANDS // 3)]


@pytest.fixture(scope="module", autouse=True)
def one_ray_a_pixel():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demo_capture, "render_view", partial(render_view, subpixels=1))
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("capture") / "capture"
    make_demo_capture(path, SIZE, BANDS, VIEWS)
    return path


@pytest.fixture(scope="module")
def truth():
    """The first view, rendered again."""
    return render_view(demo_cameras(SIZE, VIEWS), 0, subpixels=1, things=speckled_things())


def read_counts(path):
    """A bil file, without any reader of ours."""
    return np.fromfile(path, "<u2").reshape(-1, BANDS, SIZE).transpose(0, 2, 1).astype(float)


def test_the_folder_holds_views_references_true_poses_and_truth(folder):
    names = [f"view_{index:03d}" for index in range(VIEWS)]
    files = {path.relative_to(folder).as_posix() for path in folder.rglob("[!.]*") if path.is_file()}
    assert files == {
        *(f"{name}{suffix}" for name in (*names, "white", "dark") for suffix in (".hdr", ".raw")),
        *(f"truth/{name}.png" for name in names),
        *("truth/endmembers.csv", "truth/illuminant.csv", "poses-true.json"),
    }
    nm = np.linspace(400, 700, BANDS)
    for name, lines in (("view_003", SIZE), ("white", 100), ("dark", 100)):
        file = open_spectral_file(folder / f"{name}.hdr")
        check_file(file, shape=(lines, SIZE, BANDS), nm=nm, bad=[0, 4], interleave="bil")
        np.testing.assert_allclose(present(file.bands.fwhm_nm), 300 / (BANDS - 1), atol=1e-3)
        np.testing.assert_array_equal(file.read(), read_counts(folder / f"{name}.raw"))


def test_white_and_dark_turn_counts_into_the_true_reflectance(folder, truth):
    dark, white = (read_counts(folder / f"{name}.raw").mean(axis=0) for name in ("dark", "white"))
    counts = read_counts(folder / "view_000.raw")[..., GOOD]
    found = (counts - dark[:, GOOD]) / (white - dark)[:, GOOD]
    expected = reflected(truth, reflectances(band_centers_nm(BANDS)))[..., GOOD]
    whole = counts < 65535
    assert np.abs(found - expected)[whole].mean() < 0.005
    assert np.abs(counts / 65535 - expected)[whole].mean() > 0.05, "the references matter"


def test_labels_and_poses_are_those_of_the_views(folder, truth):
    assert (np.array(Image.open(folder / "truth/view_000.png")) == label_image(truth)).all()
    poses = json.loads((folder / "poses-true.json").read_text())
    assert [frame["file_path"] for frame in poses["frames"]] == [f"view_{i:03d}.hdr" for i in range(VIEWS)]
    cameras = demo_cameras(SIZE, VIEWS)
    assert (poses["w"], poses["h"], poses["fl_x"]) == (SIZE, SIZE, float(cameras.focal_px[0, 0]))
    found = [frame["transform_matrix"][:3] for frame in poses["frames"]]
    np.testing.assert_allclose(found, cameras.camera_to_world, atol=1e-7)


def test_a_capture_written_again_has_the_same_bytes_and_no_view_of_the_older_one(folder, tmp_path):
    make_demo_capture(tmp_path, 16, 10, 7)
    (tmp_path / "view_of_mine.hdr").write_text("mine")
    make_demo_capture(tmp_path, SIZE, BANDS, VIEWS, overwrite=True)
    (tmp_path / "view_of_mine.hdr").unlink()
    for path in tmp_path.rglob("[!.]*"):
        assert path.is_dir() or path.read_bytes() == (folder / path.relative_to(tmp_path)).read_bytes(), path


@pytest.mark.parametrize(("name", "value"), [("size", 8), ("bands", 9), ("views", 3)])
def test_a_number_out_of_bounds_is_refused_before_anything_is_written(tmp_path, name, value):
    with pytest.raises(ConfigError, match=rf"--{name} of a demo capture must be \d+ to \d+; found {value}"):
        make_demo_capture(tmp_path / "capture", **{name: value})
    assert not list(tmp_path.iterdir())


def test_a_board_of_markers_lies_around_the_plate_where_it_is_asked_for():
    pytest.importorskip("cv2")
    place = marked_place()
    cameras = place.cameras(240, VIEWS)
    view = render_view(cameras, 2, subpixels=2, things=place.things)
    light = reflected(view, reflectances(band_centers_nm(BANDS))).mean(axis=-1)
    found, _ = find_markers({"view": light}, MARKER_FAMILY)
    assert len(found["view"]) >= 6
    (across, down), (x, y) = cameras.focal_px[0].tolist(), cameras.center_px[0].tolist()
    lens = Lens(cameras.width, cameras.height, (across, down), (x, y))
    camera = PosedCamera(cameras.camera_to_world[2].double().numpy(), lens)
    steps = [(i, j) for i in range(-3, 4) for j in range(-3, 4) if max(abs(i), abs(j)) == 3]
    square = MARKER_SIZE * np.array([[-0.5, 0.5], [0.5, 0.5], [0.5, -0.5], [-0.5, -0.5]])
    for number, pixels in found["view"].items():
        corners = np.column_stack([0.553 * np.array(steps[number]) + square, np.full(4, -0.12)])
        assert np.median(np.abs(camera.pixels_of(corners) - pixels)) < 0.5


WHOLE_SIZE, WHOLE_BANDS, WHOLE_VIEWS = 192, 12, 24


@pytest.mark.slow
def test_estimated_poses_are_those_of_the_truth(tmp_path, monkeypatch):
    pytest.importorskip("pycolmap")
    monkeypatch.setattr(demo_capture, "render_view", partial(render_view, subpixels=2))
    capture, scene = tmp_path / "capture", tmp_path / "scene"
    demo_capture.make_demo_capture(capture, WHOLE_SIZE, WHOLE_BANDS, WHOLE_VIEWS)
    words = ["cubes", "--data", capture, "--output-dir", scene, "--poses", "estimate", "--mask", "black"]
    ended = done(process, *words, "--white", capture / "white.hdr", "--dark", capture / "dark.hdr")
    assert ended.last_line == f"scene: {scene}"
    found, truth = read_poses(scene / "transforms.json"), read_poses(capture / "poses-true.json")
    names = {name: f"{Path(name).stem}.hdr" for name in found.cameras}
    assert len(names) >= 0.8 * WHOLE_VIEWS
    assert align_poses(found, truth, names).rms_px < 0.5
    loaded = load_scene(scene)
    assert len(loaded.frames) == len(names)
    assert loaded.placement.is_identity, "exports come out in the upright world of transforms.json"
    report = (scene / "report.txt").read_text()
    left_out = (
        "marked as bad in the file (400 nm, 509.091 nm), the white reference is saturated there (618.182 nm)"
    )
    assert left_out in " ".join(report.split())
    assert re.search(r"saturation +from 65535\n", report)


def test_a_backdrop_shines_past_the_things(tmp_path, folder, truth):
    backdrop = lambda _, directions: np.full(len(directions), 0.2)  # noqa: E731
    make_demo_capture(tmp_path / "grey", SIZE, BANDS, VIEWS, backdrop=backdrop)
    bare, grey = (read_counts(path / "view_000.raw")[..., GOOD] for path in (folder, tmp_path / "grey"))
    white, dark = (read_counts(folder / f"{name}.raw")[..., GOOD].mean(axis=0) for name in ("white", "dark"))
    added = (grey - bare) / (white - dark)
    assert added[truth.alpha == 0].mean() == pytest.approx(0.2, abs=0.005)
    assert abs(added[truth.alpha == 1].mean()) < 0.005
