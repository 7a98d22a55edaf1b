"""Poses, lenses and masks of other programs: each is read as that program means it, or refused by its cause."""

from __future__ import annotations

import json
import struct
import unicodedata
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from tests.factories.forms import (
    FOCAL_PX,
    HEIGHT,
    RED_GREEN_BLUE,
    RGB,
    VIEWS,
    WIDTH,
    cube,
    cube_of,
    not_processed,
    pose_of,
    processed,
    ring,
    write_envi,
    write_transforms,
)

CUBES = [f"view_{index:03d}" for index in range(VIEWS)]
PICTURES = [f"{index:04d}" for index in range(VIEWS)]
Y, X = np.mgrid[:HEIGHT, :WIDTH]
DISC = (Y - HEIGHT / 2) ** 2 + (X - WIDTH / 2) ** 2 < 9**2


def write_cubes(root: Path, names=CUBES) -> None:
    for index, name in enumerate(names):
        write_envi(root / f"{name}.hdr", cube(index).astype(np.float32))


def write_pictures(root: Path) -> None:
    (root / "images").mkdir(parents=True)
    for index, name in enumerate(PICTURES):
        picture = np.rint(cube(index)[..., RED_GREEN_BLUE] * 255).astype(np.uint8)
        Image.fromarray(picture).save(root / f"images/{name}.png")


def rays_of_a_fisheye(focal_px, terms):
    """Where pixels of a 9 x 9 grid are, and their rays on the plane at depth 1, under OpenCV's fisheye model."""
    v, u = np.mgrid[0:1:9j, 0:1:9j] * np.array([HEIGHT, WIDTH])[:, None, None]
    radius = np.hypot(u - WIDTH / 2, v - HEIGHT / 2) / focal_px
    angle = radius
    for _ in range(60):
        angle = radius / (1 + sum(term * angle ** (2 * power + 2) for power, term in enumerate(terms)))
    around = np.arctan2(v - HEIGHT / 2, u - WIDTH / 2)
    return u, v, np.tan(angle) * np.cos(around), np.tan(angle) * np.sin(around)


def test_a_fisheye_of_instant_ngp_keeps_its_rays(tmp_path):
    focal_px, terms = 18.0, (0.01, -0.004, 0.001, 0.0)
    write_cubes(tmp_path)
    named = dict(zip(("k1", "k2", "k3", "k4"), terms, strict=True))
    write_transforms(
        tmp_path / "transforms.json",
        [f"./{name}.hdr" for name in CUBES],
        focal_px=focal_px,
        is_fisheye=True,
        **named,
    )
    scene = processed("cubes", "--data", tmp_path, "--poses", "transforms.json", output=tmp_path / "scene")
    lens = scene.views[0].entries
    u, v, x, y = rays_of_a_fisheye(focal_px, terms)
    k1, k2, k3, k4, p1, p2 = (float(lens.get(key) or 0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4
    found_u = lens["fl_x"] * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)) + lens["cx"]
    found_v = lens["fl_y"] * (y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y) + lens["cy"]
    assert np.hypot(found_u - u, found_v - v).max() < 0.6


@pytest.mark.parametrize("before", ["images\\", ".\\images\\"])
def test_a_backslash_is_a_slash(before, tmp_path):
    write_pictures(tmp_path)
    write_transforms(tmp_path / "transforms.json", [f"{before}{name}.png" for name in PICTURES])
    scene = processed("nerfstudio", "--data", tmp_path, *RGB, output=tmp_path / "scene")
    assert len(scene.views) == VIEWS
    scene.check_poses(pose_of)


def test_an_offset_of_instant_ngp_moves_nothing(tmp_path):
    write_cubes(tmp_path)
    hints = {"aabb_scale": 1, "scale": 0.5, "offset": [0.5, 0.5, 0.5]}
    write_transforms(tmp_path / "transforms.json", [f"{name}.hdr" for name in CUBES], **hints)
    scene = processed("cubes", "--data", tmp_path, "--poses", "transforms.json", output=tmp_path / "scene")
    scene.check_poses(pose_of)


def to_colmap(pose):
    """Quaternion (w, x, y, z) and translation of world to camera in OpenCV's axes."""
    rotation = (pose[:3, :3] @ np.diag([1.0, -1.0, -1.0])).T
    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    return (w, x, y, z, *(-rotation @ pose[:3, 3]))


def write_model(folder: Path, count: int) -> None:
    """A binary COLMAP model of the first views."""
    folder.mkdir(parents=True)
    camera = struct.pack("<IiQQ4d", 1, 1, WIDTH, HEIGHT, FOCAL_PX, FOCAL_PX, WIDTH / 2, HEIGHT / 2)
    (folder / "cameras.bin").write_bytes(struct.pack("<Q", 1) + camera)
    images = struct.pack("<Q", count)
    for index, pose in enumerate(ring()[:count]):
        images += struct.pack("<I7dI", index + 1, *to_colmap(pose), 1)
        images += CUBES[index].encode() + b".png\0" + struct.pack("<Q", 0)
    (folder / "images.bin").write_bytes(images)
    (folder / "points3D.bin").write_bytes(struct.pack("<Q", 0))


def test_the_largest_model_of_hloc_is_taken(tmp_path):
    write_cubes(tmp_path)
    for folder, count in {"0": 3, "0/models/0": 3, "0/models/1": VIEWS}.items():
        write_model(tmp_path / "colmap/sparse" / folder, count)
    scene = processed("cubes", "--data", tmp_path, "--poses", tmp_path, output=tmp_path / "scene")
    assert len(scene.views) == VIEWS
    scene.check_poses(pose_of)


@pytest.mark.parametrize("between", ["\n", "", "10.5 11.5 1 20 21 -1\n", "\r\n"])
def test_every_line_of_images_txt_is_read(between, tmp_path):
    names = [f"view {index:03d}" for index in range(VIEWS)]
    write_cubes(tmp_path, names)
    end = "\r\n" if between == "\r\n" else "\n"
    model = tmp_path / "sparse/0"
    model.mkdir(parents=True)
    camera = f"1 PINHOLE {WIDTH} {HEIGHT} {FOCAL_PX} {FOCAL_PX} {WIDTH / 2} {HEIGHT / 2}{end}"
    (model / "cameras.txt").write_text(camera, newline="")
    lines = f"# Image list with two lines of data per image:{end}"
    for index, (name, pose) in enumerate(zip(names, ring(), strict=True)):
        lines += (
            " ".join(f"{one:.12g}" for one in (index + 1, *to_colmap(pose), 1)) + f" {name}.png{end}{between}"
        )
    (model / "images.txt").write_text(lines, newline="")
    (model / "points3D.txt").write_text("")
    scene = processed("cubes", "--data", tmp_path, "--poses", "sparse/0", output=tmp_path / "scene")
    assert len(scene.views) == VIEWS
    scene.check_poses(pose_of)


@pytest.mark.parametrize("kind", ["with a mark of its order", "decomposed", "UTF-16"])
def test_names_in_other_forms_of_unicode_are_found(kind, tmp_path):
    root = tmp_path / "Größe 1"
    names = [unicodedata.normalize("NFC", f"Prüfling {index:03d}") for index in range(VIEWS)]
    write_cubes(root, names)
    write_transforms(root / "transforms.json", [f"{name}.hdr" for name in names])
    text = json.dumps(json.loads((root / "transforms.json").read_text()), ensure_ascii=False)
    text = unicodedata.normalize("NFD", text) if kind == "decomposed" else text
    encoding = {"UTF-16": "utf-16", "decomposed": "utf-8"}.get(kind, "utf-8-sig")
    (root / "transforms.json").write_text(text, encoding=encoding)
    scene = processed("cubes", "--data", root, "--poses", "transforms.json", output=tmp_path / "scene")
    assert len(scene.views) == VIEWS
    scene.check_poses(pose_of)
    scene.check_values(cube_of)


def mask_picture(kind):
    """A mask of the disc as programs write it."""
    match kind:
        case "0 and 255":
            return Image.fromarray((DISC * 255).astype(np.uint8))
        case "0 and 1":
            return Image.fromarray(DISC.astype(np.uint8))
        case "one bit":
            return Image.fromarray(DISC)
        case "a palette":
            picture = Image.fromarray(DISC.astype(np.uint8), "P")
            picture.putpalette([0, 0, 0, 255, 255, 255, *[0] * 750])
            return picture
        case "16 bits":
            return Image.fromarray(DISC.astype(np.uint16) * 65535)
    return Image.fromarray(np.dstack([DISC * 255] * 3 + [np.full_like(X, 255)]).astype(np.uint8), "RGBA")


def check_disc(scene):
    """That the alpha of every view is the disc."""
    for view in scene.views:
        with Image.open(scene.root / view.entries["file_path"]) as picture:
            alpha = np.asarray(picture.convert("RGBA"))[..., 3]
        np.testing.assert_array_equal(alpha > 127, DISC)


@pytest.mark.parametrize(
    "kind", ["0 and 255", "0 and 1", "one bit", "a palette", "16 bits", "opaque colours"]
)
@pytest.mark.filterwarnings("ignore:'mode' parameter is deprecated:DeprecationWarning")
def test_a_mask_of_any_kind_is_the_disc_that_it_shows(kind, tmp_path):
    write_pictures(tmp_path)
    (tmp_path / "masks").mkdir()
    for name in PICTURES:
        mask_picture(kind).save(tmp_path / f"masks/{name}.png")
    names = [f"images/{name}.png" for name in PICTURES]
    write_transforms(
        tmp_path / "transforms.json",
        names,
        of_frame=lambda index: {"mask_path": f"masks/{PICTURES[index]}.png"},
    )
    scene = processed("nerfstudio", "--data", tmp_path, *RGB, "--mask", "files", output=tmp_path / "scene")
    check_disc(scene)


MASKS = [
    "masks/{0}.png.png",
    "masks/{0}.png",
    "masks/{0}.jpg",
    "mask/{0}_mask.png",
    "Masks/mask_{0}.PNG",
    "masks/{0}.mask.png",
    "masks/images/{0}.png.png",
    "images/masks/{0}.png",
    "images/{0}_mask.png",
    "images/{0}.mask.png",
    "images/{0}.png.png",
    "images/{0}.png.mask.png",
]


@pytest.mark.parametrize(
    ("layout", "place"),
    [*(("nerfstudio", place) for place in MASKS), *(("cubes", place) for place in MASKS[:1] + MASKS[-5:-2])],
)
def test_a_mask_is_found_under_the_names_that_programs_give_it(layout, place, tmp_path):
    write_pictures(tmp_path)
    for name in PICTURES:
        path = tmp_path / place.format(name)
        path.parent.mkdir(parents=True, exist_ok=True)
        mask_picture("0 and 255").save(path, quality=95)
    write_transforms(tmp_path / "transforms.json", [f"images/{name}.png" for name in PICTURES])
    data = tmp_path / "images" if layout == "cubes" else tmp_path
    words = layout, "--data", data, *RGB, "--mask", "files", "--poses", tmp_path / "transforms.json"
    scene = processed(*words, output=tmp_path / "scene")
    assert len(scene.views) == VIEWS
    check_disc(scene)


@pytest.mark.parametrize(
    "place", ["masks/{0}.hdr.png", "data/masks/{0}.png", "data/{0}.hdr.png", "masks/{0}.raw.png"]
)
def test_a_mask_of_a_cube_is_found(place, tmp_path):
    write_cubes(tmp_path / "data")
    for name in CUBES:
        path = tmp_path / place.format(name)
        path.parent.mkdir(parents=True, exist_ok=True)
        mask_picture("0 and 255").save(path)
    write_transforms(tmp_path / "transforms.json", [f"{name}.hdr" for name in CUBES])
    words = "cubes", "--data", tmp_path / "data", "--mask", "files", "--poses", tmp_path / "transforms.json"
    check_disc(processed(*words, output=tmp_path / "scene"))


def test_masks_lie_in_the_folders_of_their_images(tmp_path):
    """As COLMAP has them of several cameras, with the same names in each."""
    names = [f"{camera}/{index:04d}" for index in range(VIEWS) for camera in ("left", "right")]
    for index, name in enumerate(names):
        path = tmp_path / f"images/{name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.rint(cube(index // 2)[..., RED_GREEN_BLUE] * 255).astype(np.uint8)).save(path)
        mask = tmp_path / f"masks/{name}.png.png"
        mask.parent.mkdir(parents=True, exist_ok=True)
        shown = DISC if "left" in name else ~DISC
        Image.fromarray((shown * 255).astype(np.uint8)).save(mask)
    frames = [
        {"file_path": f"images/{name}.png", "transform_matrix": pose.tolist()}
        for name, pose in zip(names, ring(len(names)), strict=True)
    ]
    lens = {"fl_x": FOCAL_PX, "fl_y": FOCAL_PX, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT}
    (tmp_path / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    scene = processed("nerfstudio", "--data", tmp_path, *RGB, "--mask", "files", output=tmp_path / "scene")
    for view in scene.views:
        alpha = np.asarray(Image.open(tmp_path / "scene/images" / f"{view.name}.png"))[..., 3] > 127
        assert (alpha == (DISC if "left" in view.name else ~DISC)).mean() > 0.95, view.name


def test_a_mask_that_is_not_found_is_missed_with_the_places_that_were_looked_in(tmp_path):
    write_pictures(tmp_path)
    (tmp_path / "masks").mkdir()
    for name in PICTURES[1:]:
        mask_picture("0 and 255").save(tmp_path / f"masks/{name}.png")
    write_transforms(tmp_path / "transforms.json", [f"images/{name}.png" for name in PICTURES])
    words = "nerfstudio", "--data", tmp_path, *RGB, "--mask", "files"
    said = not_processed(*words, output=tmp_path / "scene")
    for part in ("view 0000 has no mask", "0000.png.png", str(tmp_path / "masks"), str(tmp_path / "images")):
        assert part in said


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_the_poses_of_realitycapture_are_those_of_its_angles(delimiter, tmp_path):
    write_cubes(tmp_path)
    head = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2".replace(",", delimiter)
    rows = ["#cameras 5", head]
    for name, pose in zip(CUBES, ring(), strict=True):
        heading, pitch, roll = Rotation.from_matrix(pose[:3, :3]).as_euler("ZXY", degrees=True)
        entries = *pose[:3, 3], -heading, pitch, roll, FOCAL_PX * 36 / WIDTH, 0.5, -0.25, 0.1, *[0] * 5
        cells = [f"{one:.9f}".replace(".", "." if delimiter == "," else ",") for one in entries]
        rows.append(delimiter.join([f"{name}.png", *cells]))
    (tmp_path / "rc.csv").write_text("\n".join(rows) + "\n")
    scene = processed("cubes", "--data", tmp_path, "--poses", "rc.csv", output=tmp_path / "scene")
    assert len(scene.views) == VIEWS
    scene.check_poses(pose_of)
    lens = scene.views[0].entries
    per_mm = WIDTH / 36
    expected = FOCAL_PX, WIDTH / 2 + 0.5 * per_mm, HEIGHT / 2 - 0.25 * per_mm, 0.1
    np.testing.assert_allclose([lens[key] for key in ("fl_x", "cx", "cy", "k1")], expected, atol=1e-5)


def test_another_table_of_realitycapture_is_refused_with_the_one_to_export(tmp_path):
    write_cubes(tmp_path)
    rows = "".join(f"{name}.png,1,2,{index},0,0,{index}\n" for index, name in enumerate(CUBES))
    (tmp_path / "rc.csv").write_text(f"#name,x,y,alt,heading,pitch,roll\n{rows}")
    words = "cubes", "--data", tmp_path, "--poses", "rc.csv"
    assert "Internal/External camera parameters" in not_processed(*words, output=tmp_path / "scene")


@pytest.mark.parametrize("place", ["keyframes/corrected_cameras", "cameras"])
def test_cameras_of_polycam_are_read(place, tmp_path):
    write_cubes(tmp_path)
    (tmp_path / place).mkdir(parents=True)
    for name, pose in zip(CUBES, ring(), strict=True):
        camera = {f"t_{row}{column}": float(pose[row, column]) for row in range(3) for column in range(4)}
        camera |= {
            "fx": FOCAL_PX,
            "fy": FOCAL_PX,
            "cx": WIDTH / 2,
            "cy": HEIGHT / 2,
            "width": WIDTH,
            "height": HEIGHT,
        }
        (tmp_path / place / f"{name}.json").write_text(json.dumps(camera))
    scene = processed("cubes", "--data", tmp_path, "--poses", tmp_path, output=tmp_path / "scene")
    assert len(scene.views) == VIEWS
    scene.check_poses(pose_of)


BESIDE = np.eye(4)
BESIDE[:3, :3] = Rotation.from_euler("yx", [12, -3], degrees=True).as_matrix()
BESIDE[:3, 3] = [0.35, 0.03, -0.02]


def write_metashape_rig(path: Path, offset: str, master_sensor: int = 0, scale: float = 1.0) -> None:
    """A system of two cameras whose shots have a matrix of the camera of one sensor alone."""
    shots, cv = "", np.diag([1.0, -1, -1, 1])
    for index, pose in enumerate(ring()):
        matrix = pose @ cv @ (BESIDE if master_sensor else np.eye(4))
        turned = " ".join(f"{one:.12g}" for one in matrix.ravel())
        for sensor, lens in enumerate("LR"):
            camera = 2 * index + sensor
            own = "" if sensor == master_sensor else f' master_id="{2 * index + master_sensor}"'
            inner = "" if own else f"<transform>{turned}</transform>"
            shots += (
                f'<camera id="{camera}" sensor_id="{sensor}"{own} label="{lens}_{index:03d}">{inner}</camera>'
            )
    size = f'<resolution width="{WIDTH}" height="{HEIGHT}"/>'
    lens = f'{size}<calibration type="frame" class="adjusted">{size}<f>{FOCAL_PX}</f><cx>0</cx><cy>0</cy></calibration>'
    path.write_text(
        '<?xml version="1.0" encoding="UTF-8"?><document version="2.0.0"><chunk label="1" enabled="true">'
        f"<transform><scale>{scale}</scale></transform><sensors>"
        f'<sensor id="0" type="frame">{lens}</sensor><sensor id="1" type="frame" master_id="0">{lens}{offset}</sensor>'
        f"</sensors><cameras>{shots}</cameras></chunk></document>"
    )


def text_of(numbers: np.ndarray) -> str:
    return " ".join(f"{one:.12g}" for one in numbers.ravel())


BOTH = f"<rotation>{text_of(BESIDE[:3, :3])}</rotation><location>{text_of(BESIDE[:3, 3])}</location>"


@pytest.mark.parametrize("scale", [1.0, 2.5])
@pytest.mark.parametrize("master_sensor", [0, 1])
def test_lenses_of_metashape_stand_where_their_sensor_says(master_sensor, scale, tmp_path):
    """The master of the shots may be the other camera than that of the sensors."""
    names = [f"{lens}_{index:03d}" for index in range(VIEWS) for lens in "LR"]
    write_cubes(tmp_path, names)
    write_metashape_rig(tmp_path / "cameras.xml", BOTH, master_sensor, scale)
    scene = processed("cubes", "--data", tmp_path, "--poses", "cameras.xml", output=tmp_path / "scene")
    assert {view.name for view in scene.views} == set(names)
    cv = np.diag([1.0, -1, -1, 1])

    def true_pose(name):
        pose = ring()[int(name[2:])] @ cv @ (BESIDE if name[0] == "R" else np.eye(4)) @ cv
        pose[:3, 3] *= scale
        return pose

    scene.check_poses(true_pose)


def test_lenses_of_metashape_whose_place_is_not_written_are_named(tmp_path):
    """Their views are left out rather than put where the first lens of the system is."""
    names = [f"{lens}_{index:03d}" for index in range(VIEWS) for lens in "LR"]
    write_cubes(tmp_path, names)
    write_metashape_rig(tmp_path / "cameras.xml", "")
    scene = processed("cubes", "--data", tmp_path, "--poses", "cameras.xml", output=tmp_path / "scene")
    assert {view.name for view in scene.views} == {f"L_{index:03d}" for index in range(VIEWS)}
    scene.check_poses(pose_of)
    assert "R_000, R_001, R_002" in scene.printed
