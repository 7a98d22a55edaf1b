"""`unmix-process lines`: scans of line cameras with tables of poses or stages, from the demo and by hand."""

import json
import shutil
from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.factories.captures import HEIGHT, WIDTH, make_capture, process
from tests.factories.commands import done
from unmix_plugin.captures import demo as demo_capture
from unmix_plugin.captures.demo import (
    FIELD_OF_VIEW_DEG,
    LINE_POSES,
    SCANNED,
    STAGES,
    STAGES_FILE,
    make_demo_capture,
    scanning_cameras,
)
from unmix_plugin.commands.process import process as process_command
from unmix_plugin.errors import CaptureError, ConfigError
from unmix_plugin.scenes.demo.shading import render_view
from unmix_plugin.scenes.reading.loader import load_scene

SIZE, SCANS = 32, 4
ANGLE = 30.0
"""Field of view of captures by hand."""
TURNED = (np.cos(0.2), 0.0, np.sin(0.2), 0.0)
"""A quaternion, w first."""


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lines") / "capture"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demo_capture, "render_view", partial(render_view, subpixels=1))
        make_demo_capture(folder, SIZE, 12, SCANS, place=SCANNED, poses=STAGES_FILE)
    return folder


@pytest.fixture
def scans(tmp_path):
    """Two scans without poses."""
    made = make_capture(tmp_path / "scans", views=2)
    (made.root / "transforms.json").unlink()
    return made.root


def written_lines(scene):
    """Poses of lines by the name of their scan, in the tables' world."""
    content = json.loads((scene / "transforms.json").read_text())
    way, scale = np.array(content["applied_transform"]), content["applied_scale"]
    offset = np.array(content.get("offset", (0.0, 0.0, 0.0)))
    found = {}
    for frame in content["frames"]:
        poses = np.array(frame["row_poses"])[:, :3]
        rotations = way[:, :3].T @ poses[:, :, :3]
        places = (poses[:, :, 3] / scale - way[:, 3]) @ way[:, :3] + offset
        found[frame["file_path"].split("/")[-1][:-4]] = np.concatenate([rotations, places[..., None]], axis=2)
    return found


def import_lines(root, table, **options):
    (root / "poses.csv").write_text(table)
    out = root.parent / "scene"
    shutil.rmtree(out, ignore_errors=True)
    given = {"poses": None, "field_of_view": ANGLE, "mask": "none"} | options
    process(root, out, "lines", **given)
    return written_lines(out)


def refusal(root, table, error: type[Exception] = CaptureError, **options):
    with pytest.raises(error) as caught:
        import_lines(root, table, **options)
    return str(caught.value)


def table_of_lines(columns="scan,line,x,y,z,qw,qx,qy,qz", lines=HEIGHT, first=0):
    rows = [columns]
    for scan, x in (("view_00", 0.0), ("view_01", 2.0)):
        for line in range(lines):
            quaternion = ",".join(map(repr, map(float, TURNED)))
            rows.append(f"{scan},{line + first},{x},{0.1 * line},3,{quaternion}")
    return "\n".join(rows) + "\n"


def stage(columns, *rows):
    return "\n".join([columns, *rows]) + "\n"


LINEAR = "scan,moves,x,y,z,look_x,look_y,look_z,direction_x,direction_y,direction_z,step"
LINEAR_ROWS = ("view_00,camera,0,0,3,0,0,-1,1,0,0,0.1", "view_01,camera,0,1,3,0,-0.2,-1,1,0,0,0.1")
ROTATION = "scan,moves,x,y,z,look_x,look_y,look_z,axis_x,axis_y,axis_z,centre_x,centre_y,centre_z,turn"
ROTATION_ROWS = ("view_00,object,3,0,0,-1,0,0,0,0,1,0,0,0,2", "view_01,object,3,0,1,-1,0,-0.3,0,0,2,0,0,0,2")


@pytest.mark.parametrize("table", [STAGES, LINE_POSES])
def test_rays_of_the_scene_are_those_of_the_demos_camera_and_its_pixels_the_truth(demo, tmp_path, table):
    words = ["lines", "--data", demo, "--output-dir", tmp_path / "scene", "--poses", demo / table]
    words += ["--white", demo / "white.hdr", "--dark", demo / "dark.hdr", "--mask", "black"]
    done(process_command, *words, "--field-of-view", FIELD_OF_VIEW_DEG)
    scene = load_scene(tmp_path / "scene")
    truth = scanning_cameras(SIZE, SCANS)
    assert len(scene.frames) == SCANS
    assert all(scene.cameras.is_line_camera(index) for index in range(SCANS))
    content = json.loads((tmp_path / "scene" / "transforms.json").read_text())
    assert content["metres_per_unit"] == 1.0
    for index in range(SCANS):
        found, expected = scene.cameras.image_rays(index), truth.image_rays(index)
        origins = scene.normalisation.to_world(found.origins.double().numpy())
        np.testing.assert_allclose(origins, expected.origins.numpy(), atol=2e-4)
        turned = found.directions.double().numpy() @ scene.normalisation.rotation
        np.testing.assert_allclose(turned, expected.directions.numpy(), atol=2e-5)
    for index in (0, 3):  # from the linear stage and from the arm: rays hit what the pixels show
        view = render_view(truth, index, subpixels=1, things=SCANNED.things)
        seen = np.load(tmp_path / "scene" / content["frames"][index]["hyperspectral_file_path"])
        assert 0.05 < view.alpha.mean() < 0.95
        assert np.corrcoef(view.alpha.ravel() > 0.5, seen.max(axis=2).ravel() > 2000)[0, 1] > 0.95


def test_lines_of_a_table_become_the_rows_of_their_scan(scans):
    found = import_lines(scans, table_of_lines())
    assert set(found) == {"view_00", "view_01"}
    rotation = Rotation.from_quat(np.roll(TURNED, -1)).as_matrix()
    for name, x in (("view_00", 0.0), ("view_01", 2.0)):
        places = np.stack([np.full(HEIGHT, x), 0.1 * np.arange(HEIGHT), np.full(HEIGHT, 3.0)], axis=1)
        np.testing.assert_allclose(found[name][:, :, 3], places, atol=1e-9)
        np.testing.assert_allclose(
            found[name][:, :, :3], np.broadcast_to(rotation, (HEIGHT, 3, 3)), atol=1e-9
        )
    content = json.loads((scans.parent / "scene" / "transforms.json").read_text())
    assert content["fl_x"] == pytest.approx(WIDTH / 2 / np.tan(np.radians(ANGLE / 2)))
    assert "metres_per_unit" not in content
    turned = import_lines(scans, table_of_lines(), camera_axes="opencv")
    np.testing.assert_allclose(
        turned["view_00"][:, :, :3] @ np.diag([1, -1, -1]), found["view_00"][:, :, :3], atol=1e-9
    )


@pytest.mark.parametrize(
    "table",
    [
        table_of_lines(first=1),
        table_of_lines().replace(",", ";").replace(".", ","),
        table_of_lines("view\tframe\tx\ty\tz\tqw\tqx\tqy\tqz").replace(",", "\t"),
        "\n".join([table_of_lines().splitlines()[0], *reversed(table_of_lines().splitlines()[1:])]),
    ],
    ids=["counted from 1", "semicolons and decimal commas", "tabs and other names", "in any order"],
)
def test_tables_of_other_spellings_say_the_same(scans, table):
    expected = import_lines(scans, table_of_lines())
    found = import_lines(scans, table)
    for name, lines in expected.items():
        np.testing.assert_allclose(found[name], lines, atol=1e-9)


def test_a_matrix_says_what_a_quaternion_says_and_millimetres_are_metres(scans):
    expected = import_lines(scans, table_of_lines())
    matrix = Rotation.from_quat(np.roll(TURNED, -1)).as_matrix().ravel()
    names = [f"r{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3)]
    rows = [",".join(["scan", "line", "x (mm)", "y_mm", "z [mm]", *names])]
    for row in table_of_lines().splitlines()[1:]:
        scan, line, *place = row.split(",")[:5]
        rows.append(
            ",".join([scan, line, *(repr(1000 * float(x)) for x in place), *map(repr, matrix.tolist())])
        )
    found = import_lines(scans, "\n".join(rows))
    np.testing.assert_allclose(found["view_01"], expected["view_01"], atol=1e-9)
    assert json.loads((scans.parent / "scene" / "transforms.json").read_text())["metres_per_unit"] == 1.0


def test_a_table_a_scan_is_taken_from_a_folder(scans):
    folder = scans.parent / "tracks"
    folder.mkdir()
    head, *rows = table_of_lines().splitlines()
    for name in ("view_00", "view_01"):
        own = [row.partition(",")[2] for row in rows if row.startswith(name)]
        (folder / f"{name}.csv").write_text("\n".join([head.partition(",")[2], *own]))
    expected = import_lines(scans, table_of_lines())
    found = import_lines(scans, "", poses=str(folder))
    np.testing.assert_allclose(found["view_01"], expected["view_01"], atol=1e-9)


def test_poses_at_moments_are_interpolated_at_the_times_of_lines(scans):
    rows = ["scan,time (ms),x,y,z,qw,qx,qy,qz"]
    for scan in ("view_00", "view_01"):
        for moment in range(101):  # 10 ms apart, while lines are 25 ms apart: 24 lines take 575 ms
            angle = 0.01 * moment
            rows.append(
                f"{scan},{10 * moment},{0.01 * moment},0,3,{np.cos(angle / 2)!r},0,0,{np.sin(angle / 2)!r}"
            )
    table = "\n".join(rows).replace("np.float64(", "").replace(")", "").replace("time (ms", "time (ms)")
    found = import_lines(scans, table, line_rate=40.0)["view_00"]
    times = np.arange(HEIGHT) / 40.0
    np.testing.assert_allclose(found[:, 0, 3], times, atol=1e-9)
    np.testing.assert_allclose(Rotation.from_matrix(found[:, :, :3]).as_rotvec()[:, 2], times, atol=1e-9)

    assert "give --line-rate" in refusal(scans, table)
    in_seconds = refusal(scans, table.replace("(ms)", "(s)").replace(",0,0.0,", ",5,0.0,"), line_rate=40.0)
    assert "count time from the first line on" in in_seconds
    kept = [rows[0], *(row for row in table.splitlines()[1:] if not 200 < float(row.split(",")[1]) < 500)]
    assert "no pose between 0.2 and 0.5 s" in refusal(scans, "\n".join(kept), line_rate=40.0)
    late = [rows[0], *(row for row in table.splitlines()[1:] if float(row.split(",")[1]) < 400)]
    assert "the 24 lines take 0 to 0.575 s" in refusal(scans, "\n".join(late), line_rate=40.0)
    falling = [rows[0], *reversed(table.splitlines()[1:])]
    assert "times must rise" in refusal(scans, "\n".join(falling), line_rate=40.0)


def test_a_linear_stage_moves_the_camera_or_the_object_the_other_way(scans):
    camera = import_lines(scans, stage(LINEAR, *LINEAR_ROWS))["view_00"]
    np.testing.assert_allclose(camera[:, :, 3], [[0.1 * line, 0, 3] for line in range(HEIGHT)], atol=1e-9)
    # It looks down, and what passes goes down the picture: +y is against the movement, so that +x is to the left of it.
    np.testing.assert_allclose(camera[0, :, :3].T, [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-9)
    moved = import_lines(scans, stage(LINEAR, *LINEAR_ROWS).replace("camera", "object"))["view_00"]
    np.testing.assert_allclose(moved[:, :, 3], [[-0.1 * line, 0, 3] for line in range(HEIGHT)], atol=1e-9)
    np.testing.assert_allclose(moved[0, :, :2], -camera[0, :, :2], atol=1e-9)

    rolled = stage(LINEAR + ",roll", *(f"{row},180" for row in LINEAR_ROWS))
    np.testing.assert_allclose(import_lines(scans, rolled)["view_00"][0, :, :2], -camera[0, :, :2], atol=1e-9)
    speed = stage(LINEAR.replace("step", "speed"), *(row[:-3] + "2" for row in LINEAR_ROWS))
    np.testing.assert_allclose(import_lines(scans, speed, line_rate=20.0)["view_00"], camera, atol=1e-9)
    for header in scans.glob("view*.hdr"):  # as Specim writes it
        header.write_text(header.read_text() + "fps = {20.00}\n")
    np.testing.assert_allclose(import_lines(scans, speed)["view_00"], camera, atol=1e-9)


def test_a_rotation_stage_turns_what_the_camera_sees_about_its_axis(scans):
    found = import_lines(scans, stage(ROTATION, *ROTATION_ROWS))["view_00"]
    point = np.array([1.0, 0.2, 0.4])
    for line in (0, 7, HEIGHT - 1):
        # What stands at `point` of the object lies where the stage has turned it, before a camera that stands still.
        turned = Rotation.from_euler("z", 2.0 * line, degrees=True).apply(point)
        seen = (point - found[line, :, 3]) @ found[line, :, :3]
        np.testing.assert_allclose(seen, (turned - found[0, :, 3]) @ found[0, :, :3], atol=1e-9)
    assert abs(found[0, :, 0] @ [0, 0, 1]) == pytest.approx(1.0), "the line lies along the axis"
    assert np.linalg.norm(found[:, :, 3], axis=1) == pytest.approx(3.0)
    around = import_lines(scans, stage(ROTATION, *ROTATION_ROWS).replace("object", "camera"))["view_00"]
    np.testing.assert_allclose(around[:, 1, 3], 3 * np.sin(np.radians(2.0 * np.arange(HEIGHT))), atol=1e-9)
    still = stage(ROTATION.replace("turn", "spin (rpm)"), *(row[:-1] + "10" for row in ROTATION_ROWS))
    np.testing.assert_allclose(import_lines(scans, still, line_rate=30.0)["view_00"], found, atol=1e-9)


def test_cropped_and_averaged_lines_have_the_poses_of_their_middle(scans):
    whole = import_lines(scans, table_of_lines())["view_01"]
    found = import_lines(scans, table_of_lines(), crop=(3, 0, 12, WIDTH), bin_pixels=2)["view_01"]
    assert len(found) == 6
    np.testing.assert_allclose(found[:, 1, 3], whole[3:15, 1, 3].reshape(6, 2).mean(axis=1), atol=1e-9)
    scene = load_scene(scans.parent / "scene")
    assert scene.cameras.height == 6


def test_lines_with_a_closed_shutter_may_be_in_the_table(scans):
    for header in scans.glob("view*.hdr"):
        header.write_text(header.read_text() + f"autodarkstartline = {HEIGHT - 4}\n")
    assert len(import_lines(scans, table_of_lines())["view_00"]) == HEIGHT - 4


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (table_of_lines(lines=HEIGHT - 3), "lacks lines 21 to 23; expected lines 0 to 23"),
        (table_of_lines().replace("view_00,5,", "view_00,6,"), "line 6 is there twice"),
        (table_of_lines(lines=HEIGHT + 2), "has lines 24 to 25"),
        (table_of_lines().replace("view_00,5,", "view_00,5.5,"), "line is no whole number"),
        (table_of_lines().replace("view", "scan"), "names the scans scan_00, scan_01"),
        (table_of_lines().replace("scan", "time", 1), "time is 'view_00'; expected a number"),
        (table_of_lines("time,line,x,y,z,qw,qx,qy,qz").replace("view_0", ""), "no column 'scan'"),
        (table_of_lines("scan,line,time,x,y,z,qw,qx,qy"), "the column time says again what 'line' says"),
        (table_of_lines().replace("x,y", "x (mm),y"), "x has a unit and y, z"),
        (table_of_lines().replace("x,y,z", "x (s),y (s),z (s)"), "the column x has the unit 's'; expected such as"),
        (table_of_lines().replace("x,y,z", "x (furlong),y (furlong),z (furlong)"), "the unit 'furlong'"),
        (table_of_lines().replace("qw", "qq"), "the column 'qq' is not known"),
        (table_of_lines().replace(f"{float(TURNED[0])!r}", "0.5", 1), "the quaternion has the length"),
        (table_of_lines().replace("0.1,3", "zero,3", 1), "y is 'zero'; expected a number"),
        (table_of_lines("scan,line,x,y,z,look_x,qx,qy,qz"), "is one of stages"),
        ("one,two\n1,2\n", "no line that names the columns x, y and z"),
        ("scan,line,x,y,z\n", "has no row below its head"),
        (stage("scan,line,x,y,z", "view_00,0,0,0,0"), "no rotation"),
        (stage(LINEAR, LINEAR_ROWS[0], LINEAR_ROWS[0]), "a second row for scan view_00"),
        (stage(LINEAR, LINEAR_ROWS[0].replace("1,0,0,0.1", "0,0,0,0.1")), "direction is 0, 0, 0"),
        (stage(LINEAR, LINEAR_ROWS[0].replace("1,0,0,0.1", ",,,0.1")), "neither a direction nor an axis"),
        (stage(LINEAR, LINEAR_ROWS[0].replace("1,0,0,0.1", "0,0,1,0.1")), "looks along its own movement"),
        (stage(LINEAR, LINEAR_ROWS[0].replace("camera", "")), "moves is missing; expected 'camera' or 'object'"),
        (stage(LINEAR, LINEAR_ROWS[0][:-3] + "0"), "the stage does not move"),
        (stage(LINEAR, LINEAR_ROWS[0][:-3]), "has no step and speed; expected one"),
        (stage(LINEAR.replace("step", "turn"), *LINEAR_ROWS), "a linear stage has no turn"),
        (stage(LINEAR.replace("step", "step (mm/line)"), *LINEAR_ROWS), "step has a unit and x, y, z has none"),
        (stage(LINEAR.replace("step", "step (deg/line)"), *LINEAR_ROWS), "the unit 'deg/line'"),
        (stage(LINEAR.replace("step", "speed"), *LINEAR_ROWS), "give --line-rate"),
        (stage(ROTATION, ROTATION_ROWS[0][:-1] + "120"), "turns by 120 degrees from line to line"),
        (stage(ROTATION, ROTATION_ROWS[0].replace("0,0,0,2", ",,,2")), "no centre_x"),
        (stage(ROTATION, ROTATION_ROWS[0].replace("-1,0,0", "0,0,0")), "look is 0, 0, 0"),
    ],
)  # fmt: skip
def test_a_wrong_table_is_refused_with_what_was_expected(scans, table, message):
    assert message in refusal(scans, table)


def test_options_that_do_not_go_with_lines_are_refused(scans):
    assert "--field-of-view is not given" in refusal(scans, table_of_lines(), ConfigError, field_of_view=None)
    assert "--field-of-view is 190" in refusal(scans, table_of_lines(), ConfigError, field_of_view=190.0)
    assert "each line of a scan has its own" in refusal(
        scans, table_of_lines(), ConfigError, poses="estimate"
    )
    assert "--line-rate -5" in refusal(scans, table_of_lines(), ConfigError, line_rate=-5.0)
    distance = ("view_00:1,1", "view_01:1,1", "view_00:2,2", "view_01:2,2", 1.0)
    assert "frame cameras alone" in refusal(scans, table_of_lines(), ConfigError, known_distance=distance)
    assert "no.csv is not there" in refusal(scans, table_of_lines(), poses="no.csv")
    with pytest.raises(ConfigError, match="go with the layout 'lines'"):
        process(scans, scans.parent / "other", field_of_view=30.0)


def test_a_camera_that_stands_still_is_refused(scans):
    rows = [row.split(",") for row in table_of_lines().splitlines()]
    still = [rows[0], *([*row[:3], "0", *row[4:]] for row in rows[1:])]
    assert "have one pose; expected a camera that moves" in refusal(scans, "\n".join(map(",".join, still)))


def test_jumps_and_cameras_that_look_away_are_named(scans):
    found = []
    table = table_of_lines().replace("view_01,9,2.0,0.9", "view_01,9,2.0,90")
    (scans / "poses.csv").write_text(table)
    wrong = process(scans, scans.parent / "jumps", "lines", poses=None, field_of_view=ANGLE, mask="none")
    assert any("scan view_01: the camera jumps from line 8 to 9" in text for text in wrong)
    away = stage(LINEAR, "view_00,camera,3,0,0,1,0,0,0,1,0,0.1", "view_01,camera,-3,0,0,-1,0,0.1,0,1,0,0.1")
    (scans / "poses.csv").write_text(away)
    wrong = process(
        scans, scans.parent / "away", "lines", found.append, poses=None, field_of_view=ANGLE, mask="none"
    )
    assert any("look away from the place" in text for text in wrong)
