from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from unmix_plugin.captures.capture import CaptureView
from unmix_plugin.captures.poses.lens import Lens
from unmix_plugin.captures.poses.pose_set import PosedCamera
from unmix_plugin.captures.posing import complete_rigs
from unmix_plugin.captures.spectral_file import SpectralFile

LENS = Lens(4, 3, (5.0, 5.0), (2.0, 1.5))
FLIP = np.diag([1.0, -1.0, -1.0])
ANGLES = {"a": "0,0,0", "b": "2,-3,1.5", "c": "-1,0.5,4"}


def view(release: str, sensor: str, angles: str | None = None) -> CaptureView:
    metadata = {"xmp": {} if angles is None else {"Camera:RigRelatives": angles}}
    cube = SpectralFile(
        Path("x.tif"), "tiff", (3, 4, 1), np.dtype("u2"), lambda *_: np.zeros(0), metadata=metadata
    )
    return CaptureView(f"{release}{sensor}", cube, sensor, lens=LENS, release=release)


def camera(seed: int) -> PosedCamera:
    pose = np.column_stack(
        [Rotation.from_euler("xyz", [seed, 0.3, 2.0 * seed]).as_matrix(), np.array([1.0, 2.0, 3.0]) * seed]
    )
    return PosedCamera(pose, LENS)


def test_rotations_in_the_files_turn_a_lens_against_another():
    views = [view("r1", sensor, ANGLES[sensor]) for sensor in "abc"]
    posed = {"r1b": camera(3)}
    completed, notes = complete_rigs(views, posed)
    to_reference = {
        sensor: Rotation.from_euler(
            "XYZ", [float(text) for text in angles.split(",")], degrees=True
        ).as_matrix()
        for sensor, angles in ANGLES.items()
    }
    base = posed["r1b"].camera_to_world
    for sensor in "ac":
        expected = base[:, :3] @ FLIP @ to_reference["b"].T @ to_reference[sensor] @ FLIP
        found = completed[f"r1{sensor}"].camera_to_world
        np.testing.assert_allclose(found[:, :3], expected, atol=1e-12)
        np.testing.assert_allclose(found[:, 3], base[:, 3], atol=1e-12)
        assert completed[f"r1{sensor}"].lens == LENS
    assert all("turned as the files say" in note for note in notes)


def test_offsets_between_posed_lenses_go_before_those_in_the_files():
    offset = np.eye(4)
    offset[:3, :3] = Rotation.from_euler("xyz", [1, 2, 3], degrees=True).as_matrix()
    offset[:3, 3] = (0.1, -0.2, 0.3)
    views = [view(release, sensor, ANGLES[sensor]) for release in ("r1", "r2", "r3") for sensor in "ab"]
    posed = {f"{release}a": camera(index + 1) for index, release in enumerate(("r1", "r2", "r3"))}
    for release in ("r1", "r2"):
        square = np.vstack([posed[f"{release}a"].camera_to_world, [0, 0, 0, 1]])
        posed[f"{release}b"] = PosedCamera((square @ offset)[:3], LENS)
    completed, notes = complete_rigs(views, posed)
    expected = np.vstack([posed["r3a"].camera_to_world, [0, 0, 0, 1]]) @ offset
    np.testing.assert_allclose(completed["r3b"].camera_to_world, expected[:3], atol=1e-12)
    assert notes == (
        "1 view of lens b got the pose of another lens of their release, moved as in other releases",
    )


def test_views_without_any_help_are_left_out_and_said():
    views = [view("r1", "a"), view("r1", "b"), view("r2", "a", ANGLES["a"]), view("r2", "b", ANGLES["b"])]
    completed, notes = complete_rigs(views, {"r1a": camera(1)})
    assert set(completed) == {"r1a"}
    assert any("1 view of lens b left out: there is no pose, and nothing says" in note for note in notes)
    assert sum("no lens of their release has a pose" in note for note in notes) == 2


def test_views_without_release_are_left_alone():
    single = [CaptureView("one", view("", "a").cube), CaptureView("two", view("", "a").cube)]
    completed, notes = complete_rigs(single, {"one": camera(1)})
    assert set(completed) == {"one"}
    assert notes == ()
