"""The scale of a scene by two points a known distance apart: what lenses, worlds and found poses make of it."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from tests.factories.captures import HEIGHT, WIDTH, make_capture, process
from tests.factories.poses import by_hand
from unmix_plugin.captures import process as process_module
from unmix_plugin.captures.poses.reading import read_poses
from unmix_plugin.errors import ConfigError
from unmix_plugin.scenes.reading.loader import load_scene

MM = 0.001
ENDS = np.array([[-0.8, 0.4, 0.2], [0.8, -0.5, -0.4]])
"""In units of the poses, on the object."""
FOCAL = 1.2 * WIDTH
LENSES = {
    "pinhole": {},
    "bent": {"camera_model": "OPENCV", "k1": -0.35, "k2": 0.1, "p1": 0.01, "p2": -0.02},
    "fisheye": {"camera_model": "OPENCV_FISHEYE", "k1": -0.05, "k2": 0.01},
}


def seen_at(pose: np.ndarray, lens: dict, point: np.ndarray) -> str:
    """Column and row by the formulas of OpenCV's manual, 0 being the centre of the first pixel."""
    x, y, z = np.diag([1, -1, -1]) @ pose[:3, :3].T @ (point - pose[:3, 3])
    radial = [lens.get(key, 0.0) for key in ("k1", "k2")]
    tangential = (lens.get("p1", 0.0), lens.get("p2", 0.0))
    is_fisheye = lens.get("camera_model") == "OPENCV_FISHEYE"
    center, ideal = (WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5), np.array([[x / z, y / z]])
    ((column, row),) = by_hand(ideal, (FOCAL, FOCAL), center, radial, tangential, is_fisheye=is_fisheye)
    return f"{column:.2f},{row:.2f}"


def capture_with(folder, lens: dict, **keys):
    """A capture with the lens in its poses; and what to give as --known-distance, without the metres."""
    root = make_capture(folder).root
    content = {**json.loads((root / "transforms.json").read_text()), "fl_x": FOCAL, **lens, **keys}
    (root / "transforms.json").write_text(json.dumps(content))
    poses = [np.array(frame["transform_matrix"]) for frame in content["frames"]]
    ends = [(ENDS[0], 0), (ENDS[0], 1), (ENDS[1], 1), (ENDS[1], 2)]
    return root, [f"view_{view:02d}:{seen_at(poses[view], lens, point)}" for point, view in ends]


def true_metres(unit: float = MM) -> float:
    return unit * float(np.linalg.norm(ENDS[1] - ENDS[0]))


@pytest.mark.parametrize("kind", LENSES)
def test_given_poses_keep_their_world_and_get_metres(tmp_path, kind):
    root, words = capture_with(tmp_path / "capture", LENSES[kind])
    process(root, tmp_path / "scene", known_distance=(*words, true_metres()))
    written = json.loads((tmp_path / "scene" / "transforms.json").read_text())
    assert written["metres_per_unit"] == pytest.approx(MM, rel=0.003)
    assert load_scene(tmp_path / "scene").metres_per_unit == written["metres_per_unit"]
    assert f"two points {true_metres():g} m apart" in (tmp_path / "scene" / "report.txt").read_text()


def test_found_poses_become_metres_in_the_upright_world(tmp_path, monkeypatch):
    root, words = capture_with(tmp_path / "capture", LENSES["bent"])
    given = read_poses(root / "transforms.json")
    cameras = {name.split("/")[-1].removesuffix(".png"): camera for name, camera in given.cameras.items()}
    found = replace(given, cameras=cameras, up=None, has_world=False)
    monkeypatch.setattr(process_module, "poses_of_written_views", lambda *_: found)
    asked = {"known_distance": (*words, true_metres(1.0)), "crop": (2, 2, 20, 28)}
    process(root, tmp_path / "scene", poses="estimate", **asked)
    scene = load_scene(tmp_path / "scene")
    assert scene.metres_per_unit == 1.0
    world = scene.normalisation.to_world(scene.cameras.camera_to_world[:, :, 3].double().numpy())
    assert np.linalg.norm(world[1] - world[0]) == pytest.approx(3.0 * np.sqrt(2.0), rel=0.003)
    np.testing.assert_allclose(world[:, 2], world[0, 2], atol=1e-4)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({4: 0.0}, "the distance is 0; expected metres, 1e-06 to 1e+06"),
        ({4: float("nan")}, "the distance is nan"),
        ({4: float("inf")}, "the distance is inf"),
        ({0: "view_1:3,4"}, "no view 'view_1' (did you mean view_01"),
        ({0: "view_00"}, "'view_00' is no pixel; expected VIEW:column,row"),
        ({0: "view_00:32,4"}, "outside the view; expected columns 0 to 31, rows 0 to 23"),
        ({2: "view_01:3,-1"}, "outside the view"),
        ({0: "view_01:3,4"}, "both pixels of point 1 are of one view; expected two"),
        ({2: "view_01:30,2", 3: "view_02:2,22"}, "views view_01 and view_02: its rays miss each other by 1"),
        ({"same": True}, "the two points are 0.0 px apart; expected more than 5"),
        ({"beside": True}, "nearly parallel (0.00 degrees between them); expected 2 or more"),
        ({"unposed": True}, "view_00 has no pose; choose another view"),
        ({"metres": True}, "transforms.json gives metres already; leave it out"),
        ({"markers": True}, "--known-distance and --marker-size both give the scale"),
    ],
)
def test_what_can_not_be_is_refused(tmp_path, changes, said):
    keys = {"metres_per_unit": 0.5} if "metres" in changes else {}
    root, words = capture_with(tmp_path / "capture", LENSES["pinhole"], **keys)
    asked = [*words, true_metres()]
    for index in changes.keys() & set(range(5)):
        asked[index] = changes[index]
    content = json.loads((root / "transforms.json").read_text())
    if "same" in changes:
        asked[2:4] = asked[:2]
    elif "beside" in changes:
        moved = np.array(content["frames"][0]["transform_matrix"])
        moved[:3, 3] += 0.01 * moved[:3, 0]
        content["frames"][1]["transform_matrix"] = moved.tolist()
        asked[1] = asked[0].replace("view_00", "view_01")
    elif "unposed" in changes:
        del content["frames"][0]
    (root / "transforms.json").write_text(json.dumps(content))
    markers = {"poses": "markers", "marker_size": 0.05} if "markers" in changes else {}
    with pytest.raises(ConfigError, match=re.escape(said)):
        process(root, tmp_path / "scene", known_distance=tuple(asked), **markers)
    assert not (tmp_path / "scene").exists()
