"""What batches hold and which randomness they depend on."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch.testing import assert_close

from tests.factories.scenes import make_scene
from unmix_plugin import datamanager
from unmix_plugin.datamanager import HyperspectralDataManager
from unmix_plugin.engine.runs.run_folder import RunFolder
from unmix_plugin.engine.runs.scene_record import SceneRecord, check_same_scene, scene_record_to_json
from unmix_plugin.errors import ConfigError, RunError, SceneError
from unmix_plugin.scenes import judged_views, pixel_pool, pixel_table
from unmix_plugin.scenes.demo.scene import make_demo_scene
from unmix_plugin.scenes.evidence import relative_power
from unmix_plugin.settings import HyperspectralDataManagerConfig, SceneOptions

CONFIG = HyperspectralDataManagerConfig(train_num_rays_per_batch=64, grid_resolution=16, single_ray_until=0.0)


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("scenes") / "tiny"
    make_demo_scene(folder, size=16, bands=6, views=8)
    return folder


def make(folder: Path, seed: int = 0, **settings) -> HyperspectralDataManager:
    return replace(CONFIG, **settings).setup(data=folder, device=torch.device("cpu"), seed=seed)


def edit_scene(folder: Path, change: Callable[[dict], object]) -> Path:
    """Change transforms.json in place."""
    path = folder / "transforms.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
    return folder


def without_pictures(content: dict) -> None:
    for frame in content["frames"]:
        frame["file_path"] = None
    for key in ("train_filenames", "val_filenames", "test_filenames"):
        del content[key]


def edit_cubes(folder: Path, change: Callable[[str, np.ndarray], np.ndarray]) -> Path:
    for path in sorted((folder / "cubes").glob("[!.]*")):
        cube = np.load(path)
        np.save(path, change(path.stem, cube).astype(cube.dtype))
    return folder


def test_a_batch_is_a_function_of_seed_and_step(scene_folder):
    batches = [make(scene_folder, seed).next_train(step) for seed, step in ((0, 3), (0, 3), (0, 4), (1, 3))]
    directions = [bundle.directions for bundle, _ in batches]
    assert torch.equal(directions[0], directions[1])
    assert not torch.equal(directions[0], directions[2])
    assert not torch.equal(directions[0], directions[3])


def test_the_rays_of_a_pixel_lie_within_it_one_in_each_cell(scene_folder):
    manager = make(scene_folder, subpixels=3)
    bundle, batch = manager.next_train(0)
    assert len(bundle) == 9 * len(batch["spectra"])
    for pixel in range(len(batch["spectra"])):
        rays = bundle[slice(9 * pixel, 9 * pixel + 9)]
        camera = int(rays.camera_indices[0])
        points, _ = manager.train_cameras.project(rays.origins + 2 * rays.directions, camera)
        corner = points.mean(dim=0).floor()
        cells = ((points - corner) * 3).floor().long()
        assert sorted((cells[:, 1] * 3 + cells[:, 0]).tolist()) == list(range(9))
        row, column = int(corner[1]), int(corner[0])
        cube = manager.scene.cube(manager.scene.train_indices[camera])
        assert_close(batch["spectra"][pixel], torch.from_numpy(cube[row, column]))


def test_batches_from_disk_depend_on_seed_and_step_and_hold_what_was_measured(scene_folder, monkeypatch):
    monkeypatch.setattr(pixel_pool, "_CHUNK_BYTES", 12 * 40)
    monkeypatch.setattr(pixel_pool, "_PIXELS_PER_STEP", 8)
    monkeypatch.setattr(pixel_table, "available_bytes", lambda _: 4000)
    going_on, resumed = make(scene_folder), make(scene_folder)
    assert any("stay on disk" in warning for warning in going_on.warnings())
    bundle, batch = [going_on.next_train(step) for step in range(30)][-1]
    again, expected = resumed.next_train(29)
    assert torch.equal(bundle.directions, again.directions)
    assert all(torch.equal(batch[name], expected[name]) for name in expected)
    held = make(scene_folder, memory_gb=1.0)
    assert held.warnings() == []
    scene = held.scene
    measured = np.concatenate(
        [scene.cube(i).reshape(-1, len(scene.wavelengths_nm)) for i in scene.train_indices]
    )
    assert_close(batch["spectra"], torch.from_numpy(measured)[batch["pixels"]])
    np.testing.assert_array_equal(going_on.initial_data()["pixels"], held.initial_data()["pixels"])


def test_masked_and_invalid_pixels_are_never_drawn(scene_folder, tmp_path):
    folder = Path(shutil.copytree(scene_folder, tmp_path / "holes"))
    edit_cubes(folder, lambda _, cube: np.where(np.arange(16)[:, None] < 8, np.nan, cube))
    with pytest.raises(SceneError, match=r"(?s)NaN.*leave these out with --invalid-pixels mask"):
        make(folder)
    manager = make(folder, scene=SceneOptions(invalid_pixels="mask"))
    bundle, batch = manager.next_train(0)
    assert torch.isfinite(batch["spectra"]).all()
    for index in range(0, len(bundle), 4):
        ray = bundle[slice(index, index + 1)]
        points, _ = manager.train_cameras.project(ray.origins + ray.directions, int(ray.camera_indices[0]))
        assert points[0, 0] >= 8 - 1e-3


def test_an_evaluation_image_carries_the_truth(scene_folder):
    manager = make(scene_folder)
    camera, batch = manager.eval_image(1)
    view = manager.scene.eval_indices[1]
    assert_close(batch["spectra"], torch.from_numpy(manager.scene.cube(view)))
    assert batch["alpha"].shape == batch["labels"].shape == batch["valid"].shape == (16, 16)
    assert batch["abundances"].shape == (16, 16, 6)
    assert_close(camera.camera_to_world[0], manager.scene.cameras.camera_to_world[view])


def test_initial_pixels_come_from_opaque_pixels_of_all_training_views(scene_folder, monkeypatch):
    manager = make(scene_folder)
    data = manager.initial_data()
    opaque = sum(int((manager.scene.alpha(i) > 0.99).sum()) for i in manager.scene.train_indices)  # type: ignore[operator]
    assert data["pixels"].shape == (opaque, 6)
    assert data["reachable"].shape == (16, 16, 16)
    assert 0.02 < data["reachable"].mean() < 1
    monkeypatch.setattr(datamanager, "_MOST_INITIAL_PIXELS", 50)
    assert len(make(scene_folder).initial_data()["pixels"]) == 50


@pytest.mark.parametrize(("has_alpha", "power"), [(True, 1.5), (False, 0.0)])
def test_errors_are_relative_where_alpha_is_known_and_some_pixels_glare(scene_folder, has_alpha, power):
    scene = replace(make(scene_folder).scene, has_alpha=has_alpha)
    pixels = torch.full((100, 6), 0.05)
    pixels[:20] = 0.5
    assert relative_power(scene, pixels) == power
    assert make(scene_folder).initial_data()["relative"] == 0.0  # as it is lit evenly


def test_the_number_of_rays_can_be_changed(scene_folder):
    manager = make(scene_folder)
    manager.set_train_rays_per_batch(41)
    bundle, batch = manager.next_train(0)
    assert manager.get_train_rays_per_batch() == len(bundle) == 40  # whole pixels of four rays
    assert len(batch["spectra"]) == 10
    manager.set_train_rays_per_batch(1)
    assert manager.get_train_rays_per_batch() == 4


def test_impossible_settings_are_refused():
    for name, value, said in (("subpixels", 0, "subpixels of 1 to 8"), ("grid_resolution", 4, "of 8 to 512")):
        with pytest.raises(ConfigError, match=said):
            replace(CONFIG, **{name: value})


@pytest.mark.parametrize(("alpha", "until", "share"), [(True, 0.5, 0.5), (False, "auto", 0.8)])
def test_rays_a_pixel_grow_after_the_first_part_of_training(tmp_path, alpha, until, share):
    manager = make(make_scene(tmp_path / "scene", alpha=alpha).root, single_ray_until=until)
    (callback,) = manager.get_training_callbacks()
    pixels = []
    for progress in (0.0, share - 0.01, share, 1.0):
        callback.func(0, progress)
        bundle, batch = manager.next_train(0)
        assert len(bundle) == manager.get_train_rays_per_batch() == 64
        pixels.append(len(batch["spectra"]))
    assert pixels == [64, 64, 16, 16]


def scene_record(manager: HyperspectralDataManager) -> SceneRecord:
    values = json.loads(json.dumps(scene_record_to_json(manager)))
    cameras = manager.train_cameras, manager.eval_cameras
    return SceneRecord(manager.scene_box, values["metadata"], *cameras, values["summary"])


def test_a_run_goes_on_with_the_scene_as_another_machine_rounds_it(tmp_path):
    folder = make_scene(tmp_path / "scene", alpha=False)
    record = scene_record(make(folder.root))
    run = RunFolder(tmp_path / "run")

    def round_otherwise(content):
        for frame in content["frames"]:
            pose = np.array(frame["transform_matrix"])
            frame["transform_matrix"] = [*np.nextafter(pose[:3], 9.0).tolist(), pose[3].tolist()]

    manager = make(folder.edit(round_otherwise).root)
    check_same_scene(record, manager, run)
    manager = make(folder.edit(lambda c: c.update(fl_x=35.0)).root)
    with pytest.raises(RunError, match=r"pixel_size.*cameras\.focal_px.* differ"):
        check_same_scene(record, manager, run)
    folder = make_scene(tmp_path / "other")
    record = scene_record(make(folder.root))
    manager = make(folder.edit_cube(0, lambda cube: cube * np.float16(0.5)).root)
    with pytest.raises(RunError, match=r"files\.cubes/view_0\.npy differ; name the right one with --data"):
        check_same_scene(record, manager, run)


def test_views_of_many_pixels_are_seen_by_one_ray_a_pixel(scene_folder, monkeypatch):
    assert make(scene_folder).metadata()["subpixels"] == 2
    monkeypatch.setattr("unmix_plugin.datamanager._MANY_PIXELS", 1000)
    assert make(scene_folder).metadata()["subpixels"] == 1
    assert make(scene_folder, subpixels=3).metadata()["subpixels"] == 3


def test_light_outside_a_mask_counts_as_evidence(scene_folder, tmp_path):
    """A hole in one mask, through which the cube still shows matter, is neither trusted nor carved."""
    folder = Path(shutil.copytree(scene_folder, tmp_path / "holed"))
    scene = make(folder).scene
    frame = scene.frames[scene.train_indices[0]]
    assert frame.image_path is not None
    picture = np.array(Image.open(frame.image_path))
    holed = np.zeros_like(picture[..., 3], dtype=bool)
    holed[4:12, 4:12] = True
    holed &= picture[..., 3] == 255
    picture[holed, 3] = 0
    Image.fromarray(picture).save(frame.image_path)
    true, spoilt = make(scene_folder), make(folder)
    assert holed.sum() > 20
    np.testing.assert_array_equal(true.initial_data()["reachable"], spoilt.initial_data()["reachable"])
    trust = torch.cat([spoilt.next_train(step)[1]["alpha_confidence"] for step in range(20)])
    assert 0.005 < float((trust == 0).double().mean()) < 0.1
    believing = make(folder, trust_alpha=True)
    assert bool((believing.next_train(0)[1]["alpha_confidence"] == 1).all())


def test_noise_stripes_and_spikes_are_found_and_named(tmp_path):
    folder = tmp_path / "demo"
    make_demo_scene(folder, size=32, bands=16, views=8)
    sound = make(folder)
    assert sound.warnings() == []
    assert (sound.initial_data()["band_weights"] == 1).all()
    generator = np.random.default_rng(0)

    def spoil(name: str, cube: np.ndarray) -> np.ndarray:
        if name.startswith("train"):
            cube[..., 5] = generator.uniform(0, 0.5, cube.shape[:2])
            cube[:, 16, 11] *= 0.1
            cube[20, 12, 13] = 1.0
        return cube

    edit_cubes(folder, spoil)
    manager = make(folder)
    noisy, bad = manager.warnings()
    assert f"band {manager.scene.wavelengths_nm[5]:g} nm is mostly noise" in noisy
    assert "stripes, spikes" in bad
    weights = manager.initial_data()["band_weights"]
    assert weights.argmin() == 5
    assert weights[5] < 0.1 * weights[4]
    assert make(folder, mend_values=False).warnings() == [noisy]


def before_grey_paper(folder: Path) -> Path:
    """The demo scene without alpha, before a grey backdrop that is brighter to the right."""
    make_demo_scene(folder, size=48, bands=6, views=12)
    paper = np.linspace(0.3, 0.4, 48)[None, :, None]

    def stand_before(name: str, cube: np.ndarray) -> np.ndarray:
        alpha = np.asarray(Image.open(folder / "images" / f"{name}.png"))[..., 3:] / 255.0
        return cube + (1 - alpha) * paper

    return edit_scene(edit_cubes(folder, stand_before), without_pictures)


def test_what_stands_before_a_plain_backdrop_is_carved_without_alpha(tmp_path):
    make_demo_scene(tmp_path / "alpha", size=48, bands=6, views=12)
    with_alpha, manager = make(tmp_path / "alpha"), make(before_grey_paper(tmp_path / "paper"))
    assert manager.metadata()["has_backdrop"]
    assert not with_alpha.metadata()["has_backdrop"]
    np.testing.assert_allclose(manager.scene_box.size, with_alpha.scene_box.size, rtol=0.15)
    own, expected = (x.initial_data()["reachable"].mean() for x in (manager, with_alpha))
    assert own < 1.3 * expected
    own, expected = (float(x.initial_data()["exposure"]) for x in (manager, with_alpha))
    assert own == pytest.approx(expected, rel=0.1)
    as_told = make(tmp_path / "paper", scene=SceneOptions(world="bounded"))
    assert not as_told.metadata()["has_backdrop"]
    (warning,) = manager.warnings()
    assert "share a plain backdrop: it is learnt as what lies behind the scene" in warning
    found = manager.scene.before_backdrop
    assert found is not None
    for view, before in zip(manager.scene.train_indices, found.masks(), strict=True):
        name = manager.scene.frames[view].name
        opaque = np.asarray(Image.open(tmp_path / "alpha" / "images" / f"{name}.png"))[..., 3] > 128
        assert before[opaque].mean() > 0.99


@pytest.mark.parametrize("how", ["masked out", "without values"])
def test_a_backdrop_is_found_beside_pixels_that_dont_count_and_they_are_not_looked_through(tmp_path, how):
    """The left half of every view is noise that a mask leaves out, or has no values."""
    folder, generator = before_grey_paper(tmp_path / "paper"), np.random.default_rng(0)
    is_masked, is_left = how == "masked out", np.arange(48) < 20
    Image.fromarray(np.where(is_left, 0, 255).astype(np.uint8)[None].repeat(48, 0)).save(folder / "mask.png")

    def spoil(_: str, cube: np.ndarray) -> np.ndarray:
        return np.where(is_left[:, None], generator.uniform(0, 1, cube.shape) if is_masked else np.nan, cube)

    def mask(content):
        for frame in content["frames"]:
            frame["mask_path"] = "mask.png" if is_masked else None

    edit_scene(edit_cubes(folder, spoil), mask)
    scene = make(folder, scene=SceneOptions(invalid_pixels="mask")).scene
    assert scene.before_backdrop is not None
    for before in scene.before_backdrop.masks():
        assert before[:, :20].all()
        assert not before[:, 20:].all()


def test_light_without_alpha_is_judged_by_the_pixels_that_masks_leave(tmp_path, monkeypatch):
    folder = make_scene(tmp_path / "scene", alpha=False)
    manager = make(folder.root)
    height, width = manager.scene.valid_mask(1).shape
    Image.fromarray(np.tri(height, width) > 0).save(folder.root / "mask.png")
    folder.edit(lambda content: [frame.update(mask_path="mask.png") for frame in content["frames"]])
    asked = []
    monkeypatch.setattr(judged_views, "find_matched_points", lambda views: asked.append(views.valid(0)))
    assert make(folder.root).initial_data()["light"] == "fixed"
    assert np.array_equal(asked[0], np.tri(height, width) > 0)


def test_a_cube_that_two_views_share_is_named(scene_folder, tmp_path):
    folder = tmp_path / "copied"
    shutil.copytree(scene_folder, folder)
    cubes = sorted(folder.rglob("*.npy"), key=lambda path: path.name)
    first, second = [path for path in cubes if path.parent == cubes[0].parent][:2]
    shutil.copy(first, second)
    (warning,) = [text for text in make(folder).warnings() if "very same values" in text]
    assert f"under different poses: {first.stem} = {second.stem}. " in warning
