"""`unmix-asset`: one command from cubes or a capture to glTF, textures, light, page and what is what; and what it
refuses."""

import json

import numpy as np
import pytest
import trimesh

from tests.factories.commands import done, refused
from tests.factories.objects import CENTRE, LAMP, WAVELENGTHS, write_spectral_object
from unmix_plugin.commands.asset import asset
from unmix_plugin.neumatex.tracing.light_files import read_exr

FILES = (
    "material.glb",
    "material.json",
    "abundances.exr",
    "endmembers.csv",
    "environment.exr",
    "page.html",
    "splats.glb",
    "splats.ply",
)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """What the command makes of a ball without mesh and light, and what it prints."""
    words = small(tmp_path_factory.mktemp("asset") / "ball")
    return words[3], done(asset, *words), words


def small(ball):
    """A ball without mesh and light, and options with which an object is made of it in a moment."""
    write_spectral_object(ball, metres_per_unit=0.5)
    for name in ("mesh.ply", "environment.exr"):
        (ball / name).unlink()
    words = ["--data", ball, "--output", ball.parent / "made", "--output-dir", ball.parent / "out"]
    words += ["--field-seconds", 4, "--material-seconds", 1, "--endmembers", 2, "--mesh-triangles", 400]
    return [*words, "--texture-size", 256, "--page-resolution", 32, "--splat-steps", 5, "--device", "cpu"]


@pytest.mark.slow
def test_all_files_are_there_and_the_manifest_says_what_they_are(made):
    folder, ended, _ = made
    content = json.loads((folder / "asset.json").read_text())
    for name in FILES:
        assert (folder / name).is_file()
    assert set(content["files"]) <= {path.name for path in folder.iterdir()}
    assert content["metres_per_unit"] == 0.5
    assert content["figures"]["relit_psnr"] > 5
    assert "per_image" not in content["figures"]
    assert {each["subject"] for each in content["decisions"]} == {"mesh", "light"}
    for step in range(1, 7):
        assert f"[{step}/6]" in ended.out
    assert "unmix-train neumatex --from-run" in ended.out


@pytest.mark.slow
def test_the_gltf_is_upright_and_in_metres(made):
    scene = trimesh.load_scene(made[0] / "material.glb")
    mesh = scene.to_geometry()
    extras = next(iter(scene.geometry.values())).metadata
    assert np.allclose(extras["up"], [0, 0, 1], atol=1e-6)
    middle = 0.5 * np.array([CENTRE[0], CENTRE[2], -CENTRE[1]])
    assert np.linalg.norm(mesh.bounds.mean(axis=0) - middle) < 0.15


@pytest.mark.slow
def test_the_light_is_written_in_all_bands(made):
    values, _, wavelengths = read_exr(made[0] / "environment.exr")
    assert wavelengths is not None
    assert np.allclose(wavelengths, WAVELENGTHS)
    mean = values.mean(axis=(0, 1))
    assert np.allclose(mean / mean.max(), LAMP, atol=1e-3)


@pytest.mark.slow
def test_a_capture_is_made_a_scene_first_with_the_options_of_unmix_process(tmp_path):
    words = small(tmp_path / "ball")
    ended = done(asset, "unmix-nerf", *words, "--drop-bands", 600)
    scene = tmp_path / "out" / "scenes" / "ball"
    assert 600 not in json.loads((scene / "transforms.json").read_text())["wavelengths"]
    assert (
        f"unmix-process unmix-nerf --data {tmp_path / 'ball'} --output-dir {scene} --drop-bands 600"
        in ended.out
    )
    assert "[7/7]" in ended.out
    assert (tmp_path / "made" / "asset.json").is_file()
    assert "holds a scene already" in refused(asset, "unmix-nerf", *words, "--output", tmp_path / "other")


@pytest.mark.slow
def test_earlier_files_stay(made):
    folder, _, words = made
    before = (folder / "asset.json").read_bytes()
    assert "--overwrite" in refused(asset, *words)
    assert (folder / "asset.json").read_bytes() == before


def test_files_of_others_and_odd_times_are_refused_before_anything_is_trained(tmp_path):
    (tmp_path / "asset.json").write_text("{}")
    assert "asset.json" in refused(asset, "--data", "demo", "--output", tmp_path)
    assert "--field-seconds is -1" in refused(asset, "--data", "demo", "--field-seconds", -1)
    assert "--material-seconds is inf" in refused(asset, "--data", "demo", "--material-seconds", "inf")


def test_options_of_unmix_process_are_checked_before_a_capture_is_read(tmp_path):
    capture = ["--data", tmp_path, "--output-dir", tmp_path]
    assert "'inspect' is not a layout" in refused(asset, "inspect", *capture)
    needs_white = refused(asset, "cubes", *capture, "--white-reflectance", 0.9)
    assert "--white-reflectance needs a white reference" in needs_white
    assert "whose LAYOUT comes first" in refused(asset, *capture, "--scene", tmp_path / "scene")
