"""Objects from their folders, in colours and in bands, and what is refused."""

import json
import shutil
from functools import partial

import numpy as np
import OpenEXR
import pytest
import torch
import trimesh
from numpy.testing import assert_allclose
from PIL import Image

from tests.factories import objects
from tests.factories.objects import CENTRE, COLOUR, ENDMEMBERS, LAMP, RADIUS, SIZE, WAVELENGTHS
from tests.factories.surfaces import TURN, mesh_from
from unmix_plugin.errors import UnmixError
from unmix_plugin.formats.exr import write_exr, write_spectral_exr
from unmix_plugin.neumatex.fit.data_manager import ObjectDataManager, ObjectDataManagerConfig, PixelList
from unmix_plugin.neumatex.fit.object_scene import load_object
from unmix_plugin.neumatex.fit.pictures import read_picture
from unmix_plugin.neumatex.tracing.rays import RayMesh
from unmix_plugin.scenes.placement import Placement
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.trained.measures import recorded_scale

DIM = "relit/dim"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return objects.write_object(tmp_path_factory.mktemp("object") / "ball")


@pytest.fixture
def folder(made, tmp_path):
    return shutil.copytree(made, tmp_path / "ball")


@pytest.fixture(scope="module")
def made_spectral(tmp_path_factory):
    return objects.write_spectral_object(tmp_path_factory.mktemp("object") / "ball")


@pytest.fixture
def spectral_folder(made_spectral, tmp_path):
    return shutil.copytree(made_spectral, tmp_path / "ball")


def _present(values):
    return {key: value for key, value in values.items() if value is not None}


def _frames(folder):
    return json.loads((folder / "transforms.json").read_text())["frames"]


def _change(folder, **keys):
    """Change keys of transforms.json; None takes one out."""
    path = folder / "transforms.json"
    path.write_text(json.dumps(_present(json.loads(path.read_text()) | keys)))


def _change_frames(folder, only=None, **keys):
    """The same for keys of all frames, or of one."""
    changed = [
        frame | keys if only in (None, index) else frame for index, frame in enumerate(_frames(folder))
    ]
    _change(folder, frames=[_present(frame) for frame in changed])


def _change_poses(folder, moved):
    """Change rotations and positions of cameras."""
    for index, frame in enumerate(_frames(folder)):
        pose = np.array(frame["transform_matrix"])
        pose[:3, :3], pose[:3, 3] = moved(pose[:3, :3], pose[:3, 3])
        _change_frames(folder, index, transform_matrix=pose.tolist())


def _change_arrays(folder, changed):
    for path in folder.glob("*.npy"):
        np.save(path, changed(np.load(path)))


def _notes(folder, *words):
    return [note for note in load_object(folder).notes if all(word in note for word in words)]


def _manager(folder):
    return ObjectDataManager(ObjectDataManagerConfig(), data=folder, device=torch.device("cpu"))


def test_the_mesh_fills_model_space_and_cameras_see_it_where_alpha_is(made):
    scene = load_object(made)
    assert float(scene.mesh.vertices.abs().max()) == pytest.approx(1, abs=1e-5)
    assert_allclose(scene.frame.to_world(np.zeros(3)), CENTRE, atol=1e-6)
    assert scene.frame.scale == pytest.approx(1 / RADIUS, rel=1e-5)
    assert (scene.split.evaluation, len(scene.split.train)) == ((0,), 5)
    rays = scene.pictures.cameras.image_rays(2)
    seen = RayMesh(scene.mesh).blocked(rays.origins, rays.directions).reshape(24, 24).numpy()
    assert (seen == (scene.pictures.read(2).opacity > 0.5)).mean() > 0.96


def test_light_truth_tone_and_held_out_lights_are_read(made):
    scene = load_object(made)
    [light] = scene.lights
    assert (scene.pictures.tone, light.name, len(light.pictures)) == ("linear", "dim", 2)
    assert float(light.environment.image.max()) == 0.5
    assert_allclose(scene.truth(0)["base_colour"][12, 12], COLOUR, rtol=1e-6)
    assert scene.truth(1) == {}


def test_poses_that_nerfstudio_turned_and_scaled_find_the_mesh_in_the_world(made, folder):
    placement = Placement(TURN, np.array([1.0, 2.0, 3.0]), 0.25, np.array([5.0, 0.0, 0.0]))
    _change_poses(folder, lambda rotation, position: (TURN @ rotation, placement.to_scene(position)))
    _change(folder, **placement.to_json())
    expected, found = (load_object(place).pictures.cameras.camera_to_world for place in (made, folder))
    assert_allclose(found, expected, atol=1e-5)


def _write_pillar(folder, has_alpha=True):
    """A pillar at the world's origin in place of the ball, seen by cameras around it; its vertices."""
    _change_poses(folder, lambda rotation, position: (rotation, position - CENTRE))
    shutil.rmtree(folder / "relit")
    pillar = trimesh.creation.icosphere(subdivisions=3, radius=RADIUS)
    pillar.apply_scale([0.8, 0.8, 1.0])
    pillar.export(folder / "mesh.ply")
    cameras = load_object(folder).pictures.cameras
    shape = RayMesh(mesh_from(pillar).transformed(1 / RADIUS, torch.zeros(3)))
    for index, path in enumerate(sorted((folder / "images").glob("[!.]*"))):
        rays = cameras.image_rays(index)
        alpha = shape.blocked(rays.origins, rays.directions).reshape(SIZE, SIZE).numpy().astype(np.float32)
        write_exr(path, {**dict.fromkeys("RGB", 0.5 * alpha), **({"A": alpha} if has_alpha else {})}, {})
    return np.array(pillar.vertices)


@pytest.mark.parametrize("suffix", ["ply", "obj", "glb"])
def test_of_two_orientations_that_both_fit_somewhat_the_better_is_taken_and_a_turn_is_said(folder, suffix):
    vertices = _write_pillar(folder)
    mesh, normals = trimesh.load_mesh(folder / "mesh.ply", process=False), load_object(folder).mesh.normals
    (folder / "mesh.ply").unlink()
    said = f"mesh.{suffix} has y as its upward axis, the poses have z: the mesh was turned"
    for stored, notes in ((vertices, []), (vertices[:, [0, 2, 1]] * [1, 1, -1], [said])):
        mesh.vertices = stored
        mesh.export(folder / f"mesh.{suffix}")
        scene = load_object(folder)
        assert_allclose(scene.frame.to_world(scene.mesh.vertices.double().numpy()), vertices, atol=1e-5)
        assert_allclose(scene.mesh.normals, normals, atol=1e-3)
        assert [note for note in scene.notes if "turned" in note] == notes


@pytest.mark.parametrize("is_open", [False, True])
def test_a_mesh_whose_triangles_face_inwards_is_turned_and_that_is_said(made, folder, is_open):
    mesh = trimesh.load_mesh(folder / "mesh.ply", process=False)
    faces = np.array(mesh.faces)[int(is_open) :, ::-1]
    trimesh.Trimesh(mesh.vertices, faces, process=False).export(folder / "mesh.ply", vertex_normal=False)
    assert_allclose(load_object(folder).mesh.normals, load_object(made).mesh.normals, atol=0.1)
    count = len(faces)
    assert _notes(folder, f"mesh.ply: cameras saw {count} of {count} triangles from behind; they were turned")
    assert not _notes(made, "behind")


def test_without_alpha_it_is_said_that_the_meshs_place_is_not_known_to_be_right(made, folder):
    _write_pillar(folder, has_alpha=False)
    assert _notes(folder, "mesh.ply lies as they show the object, and which of its axes is upwards")
    assert not _notes(made, "could not be checked")
    # Nor do pixels beside the mesh count, in evaluation and in training.
    manager = _manager(folder)
    alpha = manager.eval_image(0)[1]["alpha"]
    assert (alpha[0, 0], alpha[SIZE // 2, SIZE // 2]) == (0, 1)
    assert len(manager._pixels.views) == pytest.approx(5 * int(alpha.sum()), rel=0.1)


def test_tone_turn_exposure_and_metres_are_the_folders(tmp_path):
    folder = objects.write_object(tmp_path / "ball", suffix=".png")
    assert load_object(folder).pictures.tone == "camera"
    _change(folder, tone_mapping="agx", environment_rotation_deg=90, environment_exposure_stops=1)
    _change(folder, metres_per_unit=0.001)
    found, scale = load_object(folder), recorded_scale(_manager(folder).summary())
    assert found.pictures.tone == "agx"
    assert (found.environment.rotation_deg, found.environment.exposure_stops) == (90, 1)
    assert scale is not None
    assert scale.metres_per_unit == 0.001
    with pytest.raises(UnmixError, match="pictures have 3 colours; leave it out"):
        load_object(folder, "D65")


def _reshape(folder, factor, shift=0.0):
    """Scale the mesh about its middle, and move it up."""
    mesh = trimesh.load_mesh(folder / "mesh.ply", process=False)
    mesh.vertices = factor * (mesh.vertices - CENTRE) + CENTRE + [0.0, 0.0, shift]
    mesh.export(folder / "mesh.ply")


def test_a_mesh_of_another_size_is_said_to_fit_badly(made, folder):
    _reshape(folder, 1.25)
    assert _notes(folder, "mesh.ply and alpha show different outlines: their overlap is 6")
    assert not _notes(made, "outlines")


def test_pictures_and_light_of_different_units_are_told_and_mere_shade_is_not(made, folder):
    assert not _notes(made, "units")
    for sky, stops in ((1e4, "-13"), (1e-3, "10")):
        objects.write_light(folder, sky=sky)
        assert len(_notes(folder, "different units", f"'environment_exposure_stops' {stops} higher")) == 1
    objects.write_light(folder, sky=1.0)
    for path in (folder / "images").glob("[!.]*"):
        objects.write_picture(path, COLOUR, lit_rows=SIZE // 2 - 4)
    assert not _notes(folder, "units")


def test_what_means_nothing_where_alpha_is_0_is_0(folder):
    path = folder / "images" / "001.exr"
    given = read_picture(path)
    hidden = given.opacity == 0
    assert hidden.any()
    channels = {name: np.where(hidden, np.nan, given.numbers[..., i]) for i, name in enumerate("RGB")}
    write_exr(path, {**channels, "A": given.opacity}, {})
    found = read_picture(path).numbers
    assert (found[hidden] == 0).all()
    assert_allclose(found[~hidden], given.numbers[~hidden])


@pytest.mark.parametrize("layer", ["", "View.Combined."])
def test_colours_of_an_exr_are_red_green_and_blue_whatever_else_it_holds(tmp_path, layer):
    values = {"R": 0.9, "G": 0.5, "B": 0.1, "A": 0.4}
    channels = {layer + name: np.full((2, 3), value, np.float32) for name, value in values.items()}
    found = read_picture(write_exr(tmp_path / "a.exr", {**channels, "Depth.Z": np.ones((2, 3), "f4")}, {}))
    assert_allclose(found.numbers[1, 2], [0.9, 0.5, 0.1])
    assert_allclose(found.opacity, 0.4)


@pytest.mark.parametrize("channels", ["XYZ", [f"{side}.{colour}" for side in "ab" for colour in "RGB"]])
def test_channels_of_an_exr_that_are_no_colours_are_refused(tmp_path, channels):
    path = write_exr(tmp_path / "a.exr", dict.fromkeys(channels, np.ones((2, 3), np.float32)), {})
    with pytest.raises(UnmixError, match=r"expected R, G and B, of one layer"):
        read_picture(path)


def test_outside_of_the_data_window_of_an_exr_alpha_is_0(tmp_path):
    windows = {"displayWindow": ((0, 0), (7, 7)), "dataWindow": ((2, 2), (5, 5))}
    header = {name: tuple(np.array(corner, np.int32) for corner in two) for name, two in windows.items()}
    header |= {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    OpenEXR.File(header, dict.fromkeys("RGBA", np.ones((4, 4), np.float32))).write(str(tmp_path / "a.exr"))
    found = read_picture(tmp_path / "a.exr")
    assert (found.has_alpha, found.opacity.sum()) == (True, 16)


def test_pictures_under_held_out_lights_have_names_that_differ(folder):
    for light, picture in (("a-b", "c"), ("a", "b-c")):
        there = shutil.copytree(folder / DIM, folder / "relit" / light)
        shutil.move(there / "images" / "000.exr", there / "images" / f"{picture}.exr")
        _change(there, frames=[{**_frames(there)[0], "file_path": f"images/{picture}.exr"}])
    manager = _manager(folder)
    names = [manager.eval_name(index) for index in range(manager.num_eval_images)]
    assert len(set(names)) == len(names) == 5
    assert set(names) >= {"a-b-c", "a-b-c_1", "dim-000"}  # others keep theirs


def test_keys_that_nobody_knows_are_told_also_of_held_out_lights(folder):
    _change(folder, tone_mapping="linear", mesh_path="mesh.ply", environment_exposure_stops=0)
    assert not _notes(folder, "not known")
    _change(folder, environment_rotation=90)
    _change(folder / DIM, tonemapping="srgb")
    unknown = "transforms.json: keys that are not known and not used:"
    assert _notes(folder, f"relit/dim/{unknown} tonemapping")
    assert f"{unknown} environment_rotation" in load_object(folder).notes


def _pictures(folder, channels):
    for path in (folder / "images").glob("[!.]*"):
        planes = {name: np.full((SIZE, SIZE), value, np.float32) for name, value in channels.items()}
        write_exr(path, planes, {})


def _truth(folder, size, names):
    planes = dict.fromkeys(names, np.ones((size, size), np.float32))
    write_exr(folder / "truth/base_colour/000.exr", planes, {})


def _second_mesh(folder):
    shutil.move(folder / "mesh.ply", folder / "a.ply")
    shutil.copy(folder / "a.ply", folder / "b.ply")


def _move_mesh_out(folder):
    shutil.move(folder / "mesh.ply", folder.parent / "mesh.ply")
    _change(folder, mesh_path="../mesh.ply")


def _mixed_pictures(folder):
    objects.write_picture(folder / "images" / "png.png", COLOUR)
    _change_frames(folder, 3, file_path="images/png.png")


def _without(name):
    return lambda folder: (folder / name).unlink()


def _other_light(folder, **keys):
    objects.write_cubes(folder / DIM, 2, 0.5, **keys)


BANDS_AS_COLOURS = {f"S0.{nm},0nm": 1.0 for nm in (450, 550, 650)}
NO_POSE = {"only": 3, "transform_matrix": None}
FAULTS = [
    (
        partial(_truth, size=12, names="RGB"),
        r"000.exr: has shape \(12, 12, 3\); expected \(24, 24, 3\): rows",
    ),
    (partial(_truth, size=SIZE, names="PQRST"), "24, 5.; expected"),
    (
        lambda folder: objects.write_views(folder / DIM, ".png", COLOUR, count=2),
        "is camera, a response that is learnt from .* but those are linear; expected linear, srgb or agx",
    ),
    (partial(_other_light, wavelengths=None), "dim: pictures of 5 bands; the object has 3 colours"),
    (partial(_pictures, channels=BANDS_AS_COLOURS), "light's spectrum is not known"),
    (
        partial(_reshape, factor=1.0, shift=2.0),
        r"is not where .* in 6 of 6 views .* is \(0.3, -0.2, 3.5\), the cameras look at \(0.3, -0.2, 1.5\), 2 away",
    ),
    (
        partial(_reshape, factor=0.001),
        "0.001 long; its middle is .*, 0 away from there, and stand 3 from what they look at",
    ),
    (partial(_pictures, channels=dict.fromkeys("RGBA", 0.0)), "no pixel shows the object"),
    (partial(_reshape, factor=0.0), "has an area"),
    (_without("mesh.ply"), r"has no mesh; put mesh.glb or .* there"),
    (_second_mesh, r"has several: a.ply, b.ply; name one with 'mesh_path'"),
    (_move_mesh_out, r"leaves the scene folder; copy the file into it$"),  # no setting, for there is none
    (_without("environment.exr"), "no environment; put environment.exr"),
    (partial(objects.write_light, sky=np.nan), "environment.exr: negative values, NaN"),
    (partial(_change_frames, **NO_POSE), r"frames\[3\]: 'transform_matrix' is absent"),
    (
        partial(_change_frames, **NO_POSE, row_poses=[np.eye(4).tolist()] * 5),
        rf"frames\[3\]: 'row_poses' has 5 poses, but the image has {SIZE} rows",
    ),
    (_without("images/004.exr"), "'images/004.exr' is missing"),
    (partial(_change, tone_mapping="filmic"), "'tone_mapping' is \"filmic\""),
    (partial(_change, environment_rotation_deg="north"), "environment_rotation_deg"),
    (
        lambda folder: objects.write_picture(folder / "images/001.exr", (-1.0, 0.0, 0.0)),
        "001.exr: negative values, NaN or infinity in .* pixels?,",
    ),
    (_mixed_pictures, "mix pictures of light"),
    (lambda folder: objects.write_light(folder / DIM, sky=0.0), "relit/dim/environment.exr"),
]


@pytest.mark.parametrize(("spoil", "expected"), FAULTS)
def test_a_fault_is_told_in_one_message(folder, spoil, expected):
    spoil(folder)
    with pytest.raises(UnmixError, match=expected) as error:
        load_object(folder)
    assert len(str(error.value).splitlines()) == 1


def test_light_and_materials_of_a_spectral_object_are_read(made_spectral):
    scene = load_object(made_spectral)
    assert scene.bands == Bands.of(WAVELENGTHS)
    assert scene.lamp == pytest.approx(LAMP)
    assert_allclose(scene.environment.image[0, 0], LAMP, rtol=1e-6)
    assert_allclose(scene.lights[0].environment.image[0, 0], 0.5 * LAMP, rtol=1e-6)
    assert scene.true_materials is not None
    assert scene.true_materials.names == ("blue", "red")
    assert_allclose(scene.truth(0)["true_endmembers"], ENDMEMBERS, rtol=1e-6)
    assert scene.truth(0)["true_abundances"][3, 12].tolist() == [1, 0]


def test_a_held_out_light_may_have_its_own_lamp_and_an_option_replaces_the_objects(spectral_folder):
    objects.write_table(spectral_folder / DIM / "lamp.csv", ("power",), LAMP[None, ::-1])
    _change(spectral_folder / DIM, illuminant_path="lamp.csv")
    [light] = load_object(spectral_folder).lights
    assert_allclose(light.environment.image[0, 0], 0.5 * LAMP[::-1], rtol=1e-6)
    assert load_object(spectral_folder, "E").lamp == pytest.approx(np.ones(5))


def _store_integers(folder):
    _change_arrays(folder / "cubes", lambda cube: np.rint(cube * 10000).astype(np.uint16))


def test_integers_are_divided_by_the_value_scale(made_spectral, spectral_folder, made, tmp_path):
    _store_integers(spectral_folder)
    _change(spectral_folder, value_scale=10000.0)
    expected, found = (load_object(one).pictures.read(1).numbers for one in (made_spectral, spectral_folder))
    assert_allclose(found, expected, atol=1e-4)
    colours = shutil.copytree(made, tmp_path / "colours")
    np.save(colours / "images" / "all.npy", np.full((SIZE, SIZE, 3), 2000, np.uint16))
    _change_frames(colours, file_path="images/all.npy")
    _change(colours, value_scale=4000)
    assert load_object(colours).pictures.read(0).numbers.max() == 0.5


def test_pixels_that_a_mask_leaves_out_are_not_trained_on(made_spectral, spectral_folder):
    scene, half = load_object(made_spectral), SIZE // 2
    mask = np.full((SIZE, SIZE), 255, np.uint8)
    mask[:, :half] = 0
    Image.fromarray(mask).save(spectral_folder / "mask.png")
    _change_frames(spectral_folder, scene.split.train[0], mask_path="mask.png")
    pixels, all_pixels = (PixelList(one, 10**6, 0) for one in (load_object(spectral_folder), scene))
    masked = (all_pixels.views == 0) & (all_pixels.corners[:, 0] < half)
    assert masked.any()
    assert len(pixels.views) == int((~masked).sum())


@pytest.mark.parametrize("kind", ["cubes/000.npy", "images/000.png", "mask.png"])
def test_another_cube_alpha_or_mask_makes_it_another_object(spectral_folder, kind):
    Image.new("L", (SIZE, SIZE), 255).save(spectral_folder / "mask.png")
    _change_frames(spectral_folder, mask_path="mask.png")
    before, path = load_object(spectral_folder).input_hashes, spectral_folder / kind
    if path.suffix == ".npy":
        np.save(path, np.load(path) * np.float32(0.9))
    else:
        pixels = np.array(Image.open(path))
        pixels[0, 0] = 0 if pixels[0, 0].any() else 1
        Image.fromarray(pixels).save(path)
    assert load_object(spectral_folder).input_hashes != before


def _bands_per_frame(folder, bands):
    """Cubes of some bands, and frames that say which."""
    _change_arrays(folder / "cubes", lambda cube: cube[..., bands])
    _change_frames(folder, bands=bands)


def _own_responses(folder):
    objects.write_table(folder / "responses.csv", ("a", "b", "c", "d", "e"), np.eye(5)[::-1])
    _change_frames(folder, responses_path="responses.csv")


def _exr_cubes(folder, shift_nm):
    """Cubes as spectral images whose channels name other wavelengths."""
    bands = Bands.of([nm + shift_nm for nm in WAVELENGTHS])
    for index, frame in enumerate(_frames(folder)):
        cube = np.load(folder / frame["hyperspectral_file_path"])
        write_spectral_exr(folder / f"cubes/{index}.exr", cube, bands, None)
        _change_frames(folder, index, hyperspectral_file_path=f"cubes/{index}.exr")


def test_wavelengths_of_spectral_images_count_as_those_of_transforms_json_do(made_spectral, spectral_folder):
    expected = load_object(made_spectral)
    _bands_per_frame(spectral_folder, [0, 1, 2, 3, 4])  # all in their order, which changes nothing
    _exr_cubes(spectral_folder, 0.0)
    for wavelengths in (WAVELENGTHS, None):
        _change(spectral_folder, wavelengths=wavelengths)
        found = load_object(spectral_folder)
        assert found.bands == expected.bands
        assert_allclose(found.pictures.read(1).numbers, expected.pictures.read(1).numbers, rtol=1e-6)


def _spectral_light(folder, dark_nm):
    """A spectral environment in place of the lamp, black in one band."""
    shutil.rmtree(folder / "relit")
    _change(folder, illuminant_path=None)
    sky = {f"S0.{nm:g},0nm": np.full((8, 16), nm != dark_nm, np.float32) for nm in WAVELENGTHS}
    write_exr(folder / "environment.exr", sky, {})


def _arrays(kind, changed):
    return lambda folder: _change_arrays(folder / kind, changed)


SPECTRAL_FAULTS = [
    (partial(_spectral_light, dark_nm=500.0), "environment.exr: is black at 500 nm, where nothing"),
    (partial(_change, illuminant_path=None), "light's spectrum is not known"),
    (partial(_change, illuminant_path="none.csv"), "none.csv"),
    (partial(_change, wavelengths=None), "no 'wavelengths' for pictures of 5 bands"),
    (partial(_change, wavelengths=[450, 550]), "2 'wavelengths' for pictures of 5 bands"),
    (partial(_change, wavelengths=[450, 500, 550, 600, 900]), "do not reach"),
    (partial(_change, tone_mapping="srgb"), "expected linear light"),
    (partial(_change, materials=["blue"]), "endmembers_path"),
    (partial(_bands_per_frame, bands=[4, 3, 2, 1, 0]), "'bands' does not list all 5 bands of its picture"),
    (partial(_bands_per_frame, bands=[0, 1, 2]), "5 'wavelengths' for pictures of 3 bands"),
    (_own_responses, "has 'responses_path', which is not followed here"),
    (partial(_exr_cubes, shift_nm=200.0), "450-650 nm, but the files of the pictures say 5 bands, 650-"),
    (
        _arrays("abundances", lambda shares: shares[::2, ::2]),
        r"has shape \(12, 12, 2\); expected \(24, 24, 2\): .* and 2 materials",
    ),
    (
        partial(_other_light, tone_mapping="srgb"),
        "of 5 bands with 'tone_mapping' srgb; expected linear light",
    ),
    (_store_integers, "holds uint16; expected floats, or 'value_scale'"),
    (_arrays(f"{DIM}/cubes", lambda cube: cube[..., :4]), "pictures of 4 bands; the object has 5 bands"),
    (partial(_other_light, wavelengths=[1, 2]), "wavelengths"),
]


@pytest.mark.parametrize(("spoil", "expected"), SPECTRAL_FAULTS)
def test_light_that_is_not_known_in_every_band_is_refused(spectral_folder, spoil, expected):
    spoil(spectral_folder)
    with pytest.raises(UnmixError, match=expected):
        load_object(spectral_folder)
