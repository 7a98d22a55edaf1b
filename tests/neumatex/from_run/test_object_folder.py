"""An object made of a run of unmix-nerf: its files, what overrides them, and a training on nothing but the run."""

import json
import shutil
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from tests.factories.commands import SMALL_METHOD, done, refused, run_of
from tests.factories.objects import (
    CENTRE,
    LAMP,
    RADIUS,
    SMALL,
    WAVELENGTHS,
    write_light,
    write_spectral_object,
)
from unmix_plugin.commands.train import train
from unmix_plugin.engine import load_config
from unmix_plugin.errors import ConfigError, SceneError
from unmix_plugin.neumatex.fit.data_manager import ObjectDataManagerConfig
from unmix_plugin.neumatex.fit.object_scene import LIGHT_UNKNOWN, Estimated, load_object
from unmix_plugin.neumatex.fit.settings import NeumatexModelConfig
from unmix_plugin.neumatex.from_run.object_folder import ObjectRecipe, object_of_run
from unmix_plugin.neumatex.tracing.lamp_and_sky import LampAndSky
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.trained.model_scene import LightChoice
from unmix_plugin.trained.open_run import load_run, open_run

pytestmark = pytest.mark.usefixtures("coarse_hulls")

SHORT = ["--endmembers", 2, "--poses", "fixed", "--pipeline.model.initial-opacity", 0.6, *SMALL_METHOD]
WORDS = ["--endmembers", 2, "--device", "cpu", "--poses", "fixed", "--max-num-iterations", 60]
WORDS += ["--pipeline.datamanager.grid-resolution", 32, "--pipeline.model.samples-per-step", 8000]
"""From which a run knows where the ball is."""


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    """A scene without a mesh, with the light beside it, and a run of unmix-nerf on it."""
    folder = write_spectral_object(tmp_path_factory.mktemp("ball") / "ball")
    (folder / "mesh.ply").unlink()
    return folder, run_of(
        done(train, "unmix-nerf", "--data", folder, "--output-dir", folder.parent / "out", *WORDS)
    )


def test_the_object_of_a_run_is_a_folder_that_neumatex_reads(ball):
    scene, run = ball
    said = list[str]()
    folder = object_of_run(ObjectRecipe(run, 500), said.append)
    found = load_object(folder)
    mesh = trimesh.load_mesh(folder / "mesh.ply")
    assert len(mesh.faces) <= 500
    _, triangles = np.unique(mesh.edges_sorted, axis=0, return_counts=True)
    assert set(triangles % 2) == {0}  # no edge of a hole; where parts touch, an edge may have four triangles
    assert np.linalg.norm(mesh.vertices.mean(axis=0) - CENTRE) < 0.2
    assert abs(np.linalg.norm(mesh.vertices - CENTRE, axis=1).mean() - RADIUS) < 0.1
    assert found.bands is not None
    assert np.allclose(found.bands.centers_nm, WAVELENGTHS)
    assert np.array_equal(found.pictures.read(1).numbers > 0, load_cube(scene, 1) > 0)
    assert [light.name for light in found.lights] == ["dim"]
    assert found.true_materials is not None
    assert [each.subject for each in found.decisions] == ["mesh"]
    assert any("triangles" in line for line in said)
    said.clear()
    assert object_of_run(ObjectRecipe(run, 500), said.append) == folder
    assert not said  # it was there
    assert object_of_run(ObjectRecipe(run, 300), said.append) != folder


def load_cube(scene, index):
    return np.load(scene / "cubes" / f"{index:03d}.npy")


def test_exposures_that_training_found_are_undone_in_its_views(ball, tmp_path):
    words = ["--data", ball[0], "--output-dir", tmp_path, *SHORT, "--max-num-iterations", 20]
    words += ["--light", "per-view"]
    run, said = run_of(done(train, "unmix-nerf", *words)), list[str]()
    folder = object_of_run(ObjectRecipe(run, 300), said.append)
    assert any("exposures that training found are undone" in line for line in said)
    scene, gains = load_scene(ball[0]), open_run(run).view_gains
    assert gains is not None
    assert not np.allclose(gains, 1)
    for row, index in enumerate(scene.train_indices[:2]):
        written = np.load(folder / "cubes" / f"{scene.frames[index].name}.npy")
        assert np.allclose(written, scene.cube(index) / gains[row].numpy(), rtol=1e-5)
    kept = scene.eval_indices[0]
    written = np.load(folder / "cubes" / f"{scene.frames[kept].name}.npy")
    assert np.allclose(written, scene.cube(kept), rtol=1e-5)


def test_a_run_alone_is_enough_to_train(ball, tmp_path):
    words = ["--from-run", ball[1], "--mesh-triangles", 500, "--output-dir", tmp_path, *SMALL]
    trained = run_of(done(train, "neumatex", *words, "--max-num-iterations", 2))
    config = load_config(trained)
    assert config.data is not None
    assert (config.data / "mesh.ply").is_file()
    assert isinstance(config.pipeline.model, NeumatexModelConfig)
    assert config.pipeline.model.material == "spectral"
    assert config.pipeline.model.num_endmembers == 2
    assert "closed surface of the run" in (trained / "run.log").read_text()
    resumed = run_of(done(train, "neumatex", "--load-run", trained, "--max-num-iterations", 3))
    assert resumed == trained


def test_a_mesh_and_an_environment_that_are_given_take_the_place_of_the_runs(ball, tmp_path):
    mesh = tmp_path / "own.ply"
    own = trimesh.creation.icosphere(subdivisions=2, radius=RADIUS)
    own.apply_translation(CENTRE)
    own.export(mesh)
    light = write_light(tmp_path, sky=2.0)
    folder = object_of_run(ObjectRecipe(ball[1], 500, mesh, light), lambda _: None)
    assert not list(folder.glob("mesh.*"))
    assert not list(folder.glob("environment.*"))
    found = load_object(folder, mesh=mesh, environment=light)
    assert len(found.mesh.faces) == len(own.faces)
    assert float(found.environment.image.max()) == pytest.approx(2.0, rel=1e-3)
    assert found.decisions == ()


def test_what_a_run_can_not_give_is_refused(ball, tmp_path):
    scene, run = ball
    with pytest.raises(SceneError, match=r"there is no such file"):
        object_of_run(ObjectRecipe(run, 500, tmp_path / "none.ply"), lambda _: None)
    assert "from-run with the material spectral only" in refused(
        train, "neumatex", "--from-run", run, "--pipeline.model.material", "pbr"
    )
    with pytest.raises(ConfigError, match="mesh-triangles"):
        ObjectDataManagerConfig(mesh_triangles=3)
    moved = tmp_path / "moved"
    shutil.move(scene / "cubes", moved)
    try:
        with pytest.raises(SceneError, match="put it back"):
            object_of_run(ObjectRecipe(run, 501), lambda _: None)
    finally:
        shutil.move(moved, scene / "cubes")


def test_light_is_estimated_where_none_is_given_and_said_to_be_unknown_where_it_is_even(ball):
    scene, run = ball
    (scene / "environment.exr").rename(scene / "elsewhere")
    try:
        said = list[str]()
        folder = object_of_run(ObjectRecipe(run, 400), said.append)
        named = object_of_run(ObjectRecipe(run, 400, lamp="A"), said.append)
    finally:
        (scene / "elsewhere").rename(scene / "environment.exr")
    found = load_object(folder)
    light = next(each for each in found.decisions if each.subject == "light")
    assert light.is_undecided
    assert light.evidence["spectrum of the lamp"] == "of the scene"
    assert LIGHT_UNKNOWN in found.notes
    assert LIGHT_UNKNOWN in said
    mean = found.environment.mean_radiance().numpy()
    assert np.allclose(mean / mean.max(), LAMP, atol=1e-3)
    other = load_object(named)
    assert other.lamp is not None
    assert np.all(np.diff(other.lamp) > 0)  # as of an incandescent lamp
    own = load_object(folder, environment=scene / "environment.exr")
    assert LIGHT_UNKNOWN not in own.notes


def test_light_that_moves_with_the_camera_is_found_in_the_frame_in_which_it_stands_still(ball, tmp_path):
    scene, _ = ball
    words = ["--data", scene, "--output-dir", tmp_path, *WORDS, "--light", "camera"]
    run = run_of(done(train, "unmix-nerf", *words))
    with pytest.raises(ConfigError, match="moves with the camera, and the environment map"):
        object_of_run(ObjectRecipe(run, 400), lambda _: None)
    (scene / "environment.exr").rename(scene / "elsewhere")
    try:
        folder = object_of_run(ObjectRecipe(run, 400), lambda _: None)
    finally:
        (scene / "elsewhere").rename(scene / "environment.exr")
    found = load_object(folder)
    moves = found.environment.moves
    assert moves is not None
    light = next(each for each in found.decisions if each.subject == "light")
    assert light.evidence["moves with"] == ("the turntable" if moves.kind == "turntable" else "the camera")
    middle = found.frame.to_world(np.array([moves.middle]))[0]
    assert np.linalg.norm(middle - CENTRE) < 0.3  # which all cameras look at
    assert load_object(folder, environment=scene / "environment.exr").environment.moves is None
    words = ["neumatex", "--data", folder, "--output-dir", tmp_path / "materials", "--max-num-iterations", 1]
    trained = run_of(
        done(train, *words, "--pipeline.datamanager.train-num-rays-per-batch", 64, "--device", "cpu")
    )
    scene_of_run: Any = load_run(trained, "cpu").scene
    assert scene_of_run.environment.moves is not None
    assert scene_of_run.with_light(LightChoice("studio")).environment.moves is None
    own = scene_of_run.with_light(LightChoice("studio")).with_light(LightChoice(None))
    assert own.environment.moves == scene_of_run.environment.moves


def test_what_was_estimated_may_be_refined_and_what_was_put_in_its_place_may_not(ball, tmp_path):
    _, run = ball
    folder = tmp_path / "object"
    shutil.copytree(object_of_run(ObjectRecipe(run, 500), lambda _: None), folder)
    assert load_object(folder).estimated == Estimated(has_mesh=True)
    other_mesh = tmp_path / "other.ply"
    trimesh.load_mesh(folder / "mesh.ply").export(other_mesh)
    assert load_object(folder, mesh=other_mesh).estimated == Estimated()
    light = LampAndSky(torch.tensor([0.0, 0.0, 1.0]), torch.tensor([3.0, 14.0]), torch.ones(2), torch.ones(7))
    Estimated(light=light).write(folder)
    found = load_object(folder).estimated
    assert not found.has_mesh
    assert found.light is not None
    assert found.light.to_json() == light.to_json()
    (folder / "environment.exr").unlink()
    write_light(folder, 2.0)
    assert load_object(folder).estimated == Estimated()
    content = json.loads((folder / "estimated.json").read_text())
    content["light"]["sky"] = [1.0]
    Estimated(light=light).write(folder)
    content["environment"] = json.loads((folder / "estimated.json").read_text())["environment"]
    (folder / "estimated.json").write_text(json.dumps(content))
    with pytest.raises(SceneError, match=r"estimated\.json: is damaged"):
        load_object(folder)


def test_damaged_decisions_are_named(tmp_path):
    folder = write_spectral_object(tmp_path / "ball")
    (folder / "decisions.json").write_text(json.dumps([{"outcome": "no subject"}]))
    with pytest.raises(SceneError, match=r"decisions\.json: is damaged"):
        load_object(folder)


def test_pictures_of_bands_are_fitted_with_spectral_materials_and_colours_with_neural_ones():
    for arrays, expected in (({"lamp": np.ones(5)}, "spectral"), ({}, "neural")):
        settings, _ = NeumatexModelConfig().resolve_auto(lambda arrays=arrays: arrays, torch.Generator())
        assert settings.material == expected
