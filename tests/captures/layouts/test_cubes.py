"""Folders with one file a view, and trees as instruments write them."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from tests.factories.captures import HEIGHT, WIDTH, make_capture, process, write_cube, write_poses
from tests.factories.data_sets import PLAIN
from unmix_plugin.captures.layouts.cubes import find_cubes
from unmix_plugin.captures.names import view_names
from unmix_plugin.errors import CaptureError

NAMES = [f"{number}" for number in range(212, 216)]


def counts(level, rows=HEIGHT):
    return np.full((rows, WIDTH, 9), level, np.uint16)


def write_tree(root: Path, white="WHITEREF_{}", dark="DARKREF_{}", capture="capture") -> None:
    """Four captures of a Specim IQ; the white of each has another brightness."""
    for index, name in enumerate(NAMES):
        folder = root / name / capture
        folder.mkdir(parents=True)
        (root / name / "results").mkdir()
        write_cube(folder, name, counts(1100 + 100 * index))
        write_cube(folder, white.format(name), counts(2100 + 400 * index, 3))
        write_cube(folder, dark.format(name), counts(100, 3))
        write_cube(root / name / "results", f"REFLECTANCE_{name}", counts(7))


def stems(root):
    files = {view.name: (view.cube, view.white, view.dark) for view in find_cubes(root, PLAIN).views}
    return {name: tuple(file and file.path.stem for file in own) for name, own in files.items()}


@pytest.mark.parametrize(
    ("white", "dark", "folder"),
    [
        ("WHITEREF_{}", "DARKREF_{}", "capture"),
        ("whiteref_{}", "DarkRef_{}", "Capture"),
        ("{}_WhiteReference", "{}-dark", "raw"),
        ("white", "darkReference", "capture"),
    ],
)
def test_each_view_of_a_tree_has_its_own_references(tmp_path, white, dark, folder):
    """Also where its files were copied together, if their names tell it."""
    write_tree(tmp_path / "tree", white, dark, folder)
    expected = {name: (name, white.format(name), dark.format(name)) for name in NAMES}
    assert stems(tmp_path / "tree") == expected
    assert len(find_cubes(tmp_path / "tree", PLAIN).notes) == 2
    if white == "WHITEREF_{}":
        (tmp_path / "flat").mkdir()
        for path in tmp_path.glob("tree/*/capture/*"):
            shutil.copy(path, tmp_path / "flat")
        assert stems(tmp_path / "flat") == expected


def test_headers_called_x_bil_hdr_belong_to_the_view_x_its_references_and_its_picture(tmp_path):
    """Resonon writes x.bil and x.bil.hdr."""
    made = make_capture(tmp_path / "flat", views=2)
    write_tree(tmp_path / "tree")
    for header in [*tmp_path.rglob("*.hdr")]:
        header.rename(header.with_name(f"{header.stem}.raw.hdr"))
    for name in ("view_00.png", "view_01.RAW.png"):
        (made.root / name).touch()
    flat, tree = find_cubes(made.root, PLAIN), find_cubes(tmp_path / "tree", PLAIN)
    pictures = {view.name: view.picture and view.picture.name for view in flat.views}
    assert pictures == {"view_00": "view_00.png", "view_01": "view_01.RAW.png"}
    assert flat.notes[0].startswith("left out, as named like references: dark.raw.hdr, white.raw.hdr")
    assert [view.name for view in tree.views] == NAMES
    whites = [view.white and view.white.path.name for view in tree.views]
    assert whites == [f"WHITEREF_{name}.raw.hdr" for name in NAMES]
    (made.root / "view_00.hdr").write_bytes((made.root / "view_00.raw.hdr").read_bytes())
    with pytest.raises(CaptureError, match=r"view_00\.hdr and .*view_00\.raw\.hdr would both be the view"):
        find_cubes(made.root, PLAIN)


@pytest.mark.parametrize("name", ["tree/212/capture/212", "flat/Bl\u00e4tter (1) von oben"])
def test_a_picture_belongs_to_the_cube_beside_it_whatever_its_name_and_in_a_tree_too(tmp_path, name):
    write_tree(tmp_path / "tree")
    (tmp_path / "flat").mkdir()
    path = write_cube(tmp_path, name, counts(7)).with_suffix(".png")
    path.touch()
    assert find_cubes(tmp_path / name.split("/")[0], PLAIN).views[0].picture == path


@pytest.mark.parametrize(("folder", "own"), [("scene", "process.json"), ("scene.unfinished", "plan.json")])
def test_a_scene_that_was_written_into_a_tree_is_no_part_of_it(tmp_path, folder, own):
    write_tree(tmp_path)
    (tmp_path / folder / "cubes").mkdir(parents=True)
    (tmp_path / folder / own).touch()
    np.save(tmp_path / folder / "cubes" / "212.npy", counts(7))
    assert list(stems(tmp_path)) == NAMES


def test_trees_of_several_days_may_have_the_same_names_and_references_above_them_are_named(tmp_path):
    for day in ("monday", "tuesday"):
        write_tree(tmp_path / day)
    write_cube(tmp_path, "white", counts(3000))
    days = [f"{day}_{name}_{name}" for day in ("monday", "tuesday") for name in NAMES]
    assert sorted(stems(tmp_path)) == days
    assert any("references: white.hdr;" in note for note in find_cubes(tmp_path, PLAIN).notes)


def reflectances(tmp_path: Path) -> tuple[list[np.ndarray], list[str]]:
    """What the command makes of the tree, view by view, and what it says."""
    write_poses(tmp_path / "poses.json", NAMES)
    options = {"poses": str(tmp_path / "poses.json"), "saturation": 60000.0, "max_noise": 9.0}
    said = process(tmp_path / "tree", tmp_path / "scene", **options)
    return [np.load(tmp_path / "scene" / "cubes" / f"{name}.npy") / 65535 for name in NAMES], said


@pytest.mark.parametrize("names", ["WHITEDARKREF_{}", "whitedark_{}", "{}_White-Dark_Reference"])
def test_the_dark_frame_of_the_white_is_subtracted_from_that_alone(tmp_path, names):
    """Specim IQ writes WHITEDARKREF where the white was taken before, with another exposure."""
    write_tree(tmp_path / "tree")
    for name in NAMES:
        folder = tmp_path / "tree" / name / "capture"
        write_cube(folder, names.format(name), counts(300, 3), header={"tint": 10})
        for stem, tint in ((name, 40), (f"DARKREF_{name}", 40), (f"WHITEREF_{name}", 10)):
            with (folder / f"{stem}.hdr").open("a") as header:
                header.write(f"tint = {tint}\n")
    assert list(stems(tmp_path / "tree")) == NAMES
    said = "4 of 4 views have a dark frame for their white reference alone"
    assert said in str(find_cubes(tmp_path / "tree", PLAIN))
    found, wrong = reflectances(tmp_path)
    assert not any("dark current" in text for text in wrong)  # each was exposed like what it is taken off
    for index, values in enumerate(found):
        np.testing.assert_allclose(values, (1000 + 100 * index) / (1800 + 400 * index) / 4, atol=1e-4)


def test_reflectances_of_the_camera_are_taken_where_a_white_is_missing(tmp_path):
    write_tree(tmp_path)
    for path in tmp_path.glob("213/capture/WHITEREF*"):
        path.unlink()
    assert stems(tmp_path) == {name: (f"REFLECTANCE_{name}", None, None) for name in NAMES}
    assert any("the reflectances that the camera wrote" in note for note in find_cubes(tmp_path, PLAIN).notes)


def test_a_name_with_white_in_it_may_be_a_view_and_references_are_one_note(tmp_path):
    made = make_capture(tmp_path / "capture")
    (tmp_path / "alone").mkdir()
    for name in ("white_pot", "dark_frame_2019-06-09_010", "WHITEREF_9-a"):
        write_cube(made.root, name, counts(7))
    capture = find_cubes(made.root, PLAIN)
    assert [view.name for view in capture.views] == [*made.reflectance, "white_pot"]
    (note,) = capture.notes
    assert note.startswith("left out, as named like references: ")
    write_cube(tmp_path / "alone", "white", counts(7))
    with pytest.raises(CaptureError, match="holds references only"):
        find_cubes(tmp_path / "alone", PLAIN)


def test_views_of_several_sizes_become_sensors(tmp_path):
    made = make_capture(tmp_path / "capture")
    upright = made.reflectance["view_01"][:, : HEIGHT - 4]
    raw = upright * made.white[: HEIGHT - 4] + made.dark[: HEIGHT - 4]
    write_cube(made.root, "view_01", np.rint(raw).astype(np.uint16))
    content = (made.root / "transforms.json").read_text()
    own = f'"file_path": "images/view_01.png", "w": {HEIGHT - 4}, "h": {HEIGHT},'
    (made.root / "transforms.json").write_text(content.replace('"file_path": "images/view_01.png",', own))
    process(made.root, tmp_path / "scene")
    sizes = {path.stem: np.load(path).shape[:2] for path in (tmp_path / "scene/cubes").glob("*.npy")}
    assert sizes == {name: (HEIGHT, HEIGHT - 4 if name == "view_01" else WIDTH) for name in made.reflectance}


def test_a_white_that_was_taken_once_serves_all_views_and_gaps_are_refused(tmp_path):
    write_tree(tmp_path / "tree")
    for path in [*tmp_path.glob("tree/*/results/*"), *tmp_path.glob("tree/214/capture/WHITEREF*")]:
        path.unlink()
    with pytest.raises(CaptureError, match=r"1 view \(214\) without a white reference of their own"):
        reflectances(tmp_path)
    for path in tmp_path.glob("tree/21[35]/capture/WHITEREF*"):
        path.unlink()
    assert "of their own, which is used for all unless --white" in str(
        find_cubes(tmp_path / "tree", PLAIN).notes
    )
    for index, values in enumerate(reflectances(tmp_path)[0]):
        np.testing.assert_allclose(values, (1000 + 100 * index) / 2000, atol=1e-4)


def test_views_are_named_so_that_every_system_has_a_file_for_each():
    names = view_names(["aux.hdr", "leaf (1).hdr", "_x: .hdr"], "here")
    assert names == ["_aux", "leaf_1", "x"]


@pytest.mark.parametrize("twin", ["capture/213.npy", "results/REFLECTANCE_213.npy"])
def test_two_cubes_of_one_name_in_a_tree_are_refused(tmp_path, twin):
    write_tree(tmp_path)
    np.save(tmp_path / "213" / twin, counts(9))
    with pytest.raises(CaptureError, match=r"213\.hdr and .*213\.npy would both be the view"):
        find_cubes(tmp_path, PLAIN)


def test_numbers_that_no_header_describes_are_named(tmp_path):
    capture = make_capture(tmp_path / "capture", views=3)
    assert not find_cubes(capture.root, PLAIN).warnings
    (capture.root / "view_01.hdr").unlink()
    (capture.root / "view_07.fits").write_bytes(b"SIMPLE")
    found = find_cubes(capture.root, PLAIN)
    assert [view.name for view in found.views] == ["view_00", "view_02"]
    (said,) = found.warnings
    assert said == "left out, as no header beside them says what they hold: view_01.raw, view_07.fits"
