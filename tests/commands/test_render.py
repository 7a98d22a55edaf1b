"""`unmix-render`: that files are the model's, from any camera, edited or not, and that nothing is lost."""

import json

import numpy as np
import pytest

from tests.factories.commands import done, refused, run
from tests.factories.outputs import read_video
from tests.factories.renders import read_envi, read_exr
from tests.factories.runs import lose_scene
from unmix_plugin.commands.render import render
from unmix_plugin.editing.edited_run import load_edited_run
from unmix_plugin.engine import processes
from unmix_plugin.trained.open_run import load_run

pytestmark = pytest.mark.usefixtures("no_wait_for_the_disk")


def files(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("[!.]*") if path.is_file())


def rendered(loaded, index, *names):
    """What the model itself renders of an evaluation view."""
    outputs = loaded.scene.render(loaded.record.eval_cameras[index], names)
    return [outputs[name].numpy() for name in names]


def test_by_default_every_evaluation_view_is_written_in_what_suits_each_output(trained, tmp_path):
    ended = done(render, "--run", trained.run, "--output", tmp_path, "--device", "cpu")
    views = ("eval_002", "eval_006")
    formats = {"spectral": ["hdr", "img"], "abundances": ["hdr", "img", "png"], "depth": ["npy", "png"]}
    formats |= {"rgb": ["png"], "segmentation": ["png"]}
    expected = [f"{name}/{view}.{end}" for name, ends in formats.items() for end in ends for view in views]
    expected += [f"{name}_legend.png" for name in ("abundances", "depth", "segmentation")]
    expected += ["segmentation_legend.csv", "cameras-dataset-eval.json"]
    assert files(tmp_path) == sorted(expected)
    loaded = load_run(trained.run, "cpu")
    for index, view in enumerate(views):
        spectra, shares, depth = rendered(loaded, index, "spectral", "abundances", "depth")
        np.testing.assert_array_equal(read_envi(tmp_path / "spectral" / view)[0], spectra)
        np.testing.assert_array_equal(read_envi(tmp_path / "abundances" / view)[0], shares)
        np.testing.assert_array_equal(np.load(tmp_path / "depth" / f"{view}.npy"), depth)
    for name in (*formats, "cameras-dataset-eval.json"):
        assert str(tmp_path / name) in ended.out


def test_a_map_without_coordinates_is_said_to_have_none(trained, tmp_path):
    words = ["--run", trained.run, "--device", "cpu", "--outputs", "abundances", "--pixel-size", 0.2]
    for direction, has_none in (("bottom", True), ("south", False)):
        ended = done(render, *words, "--output", tmp_path / direction, "--cameras", f"map:{direction}")
        header = (tmp_path / direction / "abundances" / f"map_{direction}.hdr").read_text()
        assert ("files have no map coordinates" in " ".join(ended.out.split())) == has_none
        assert ("map info" in header) != has_none


def test_renders_go_into_the_run_by_default_and_need_nothing_else(trained, run_copy):
    lose_scene(run_copy, trained.scene)
    done(render, "--run", run_copy, "--outputs", "rgb")
    assert (run_copy / "exports" / "render" / "rgb" / "eval_006.png").is_file()


def test_chosen_outputs_formats_views_and_size(trained, tmp_path):
    words = ["--outputs", "spectral", "band:550nm", "--formats", "exr", "--view", "1", "--size", "24x12"]
    done(render, "--run", trained.run, "--output", tmp_path, *words)
    written = ["band-550nm/eval_006.exr", "cameras-dataset-eval.json", "spectral/eval_006.exr"]
    assert files(tmp_path) == written
    channels = read_exr(tmp_path / "spectral" / "eval_006.exr")
    assert {pixels.shape for pixels in channels.values()} == {(12, 24)}
    assert sum(name.startswith("S0.") for name in channels) == 8


def test_cameras_of_a_render_can_be_rendered_again(trained, tmp_path):
    words = ["--run", trained.run, "--outputs", "spectral", "--formats", "npy", "--device", "cpu"]
    done(render, *words, "--output", tmp_path / "a", "--cameras", "orbit", "--frames", 2, "--downscale", 1)
    path = tmp_path / "a" / "cameras-orbit.json"
    done(render, *words, "--output", tmp_path / "b", "--cameras", path)
    for name in ("orbit_0000.npy", "orbit_0001.npy"):
        one, other = (np.load(tmp_path / folder / "spectral" / name) for folder in "ab")
        assert one.max() > 0
        assert np.abs(one - other).mean() < 1e-4


def test_the_scenes_own_transforms_are_a_camera_file(trained, tmp_path):
    content = json.loads((trained.scene / "transforms.json").read_text())
    content["frames"] = [frame for frame in content["frames"] if "eval_006" in frame["file_path"]]
    path = tmp_path / "mine.json"
    path.write_text(json.dumps({**content, "w": 16, "h": 16}))
    words = ["--outputs", "spectral", "--formats", "npy", "--cameras", path, "--device", "cpu"]
    done(render, "--run", trained.run, "--output", tmp_path / "out", *words)
    [expected] = rendered(load_run(trained.run, "cpu"), 1, "spectral")
    found = np.load(tmp_path / "out" / "spectral" / "eval_006.npy")
    assert np.abs(found - expected).mean() < 1e-4


def test_a_path_becomes_a_video_and_frames_a_second_without_one_are_refused(trained, tmp_path):
    words = ["--run", trained.run, "--output", tmp_path, "--fps", 10, "--size", "16x16"]
    assert "--fps is for videos, and none is asked for" in refused(render, *words, "--outputs", "rgb")
    ended = done(render, *words, "--cameras", "interpolate", "--frames", 5)
    assert files(tmp_path) == ["cameras-interpolate.json", "rgb.mp4"]
    frames, facts = read_video(tmp_path / "rgb.mp4")
    assert (frames.shape, facts["fps"]) == ((5, 16, 16, 3), 10.0)
    assert f"{tmp_path / 'rgb.mp4'}  5 frames" in ended.out


def test_a_recipe_and_another_light_are_rendered_as_the_edited_model_does(trained, tmp_path):
    recipe = tmp_path / "recipe.yml"
    recipe.write_text("edits:\n  - rename: {endmember: 0, name: granite}\n")
    words = ["--outputs", "spectral", "abundances", "--formats", "envi", "--device", "cpu", "--edits", recipe]
    done(render, "--run", trained.run, "--output", tmp_path, *words, "--illuminant", "A")
    [as_taken] = rendered(load_run(trained.run, "cpu"), 0, "spectral")
    [edited] = rendered(load_edited_run(trained.run, "cpu", None, "A"), 0, "spectral")
    found, _ = read_envi(tmp_path / "spectral" / "eval_002")
    np.testing.assert_array_equal(found, edited)
    assert not np.allclose(found, as_taken, atol=1e-3)
    assert read_envi(tmp_path / "abundances" / "eval_002")[1]["band names"][0] == "granite"


def test_files_of_an_earlier_render_are_kept_unless_overwrite_is_given(trained, tmp_path):
    words = ["--run", trained.run, "--output", tmp_path, "--outputs", "rgb", "depth"]
    done(render, *words)
    (tmp_path / "rgb" / "eval_002.png").unlink()
    assert "--overwrite" in refused(render, *words)
    assert not (tmp_path / "rgb" / "eval_002.png").exists()
    before = (tmp_path / "rgb" / "eval_006.png").read_bytes()
    done(render, *words, "--overwrite", "--illuminant", "A")
    assert (tmp_path / "rgb" / "eval_006.png").read_bytes() != before
    assert (tmp_path / "rgb" / "eval_002.png").exists()
    (tmp_path / "rgb" / "eval_002.png").write_bytes(b"mine")
    assert "eval_002.png is in the way" in refused(render, *words, "--overwrite")
    assert (tmp_path / "rgb" / "eval_002.png").read_bytes() == b"mine"
    # Further outputs of the same cameras may join them.
    done(render, *words[:-2], "accumulation")
    assert "cameras-dataset-eval.json" in refused(render, *words[:-2], "pca", "--downscale", 2)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--outputs", "spectrl"], "no output named 'spectrl' (did you mean spectral"),
        (["--size", "64x99999"], "--size: 64 x 99999 pixels"),
        (["--illuminant", "sun"], "sun"),
        (["--edits", "none.yml"], "none.yml"),
    ],
)
def test_what_cannot_be_rendered_is_refused_before_anything_is_written(trained, tmp_path, words, said):
    assert said in refused(render, "--run", trained.run, "--output", tmp_path / "out", *words)
    assert list(tmp_path.iterdir()) == []


def test_a_size_that_is_none_is_refused_before_processes_start_and_the_run_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr(processes, "start_together", lambda *_: pytest.fail("processes were started"))
    said = refused(render, "--run", tmp_path / "none", "--num-devices", 2, "--size", "64")
    assert "--size 64: expected width and height in pixels, as in 640x480" in said


def test_a_folder_that_cannot_be_made_exits_2_before_rendering(trained, tmp_path):
    (tmp_path / "file").write_text("in the way")
    ended = run(render, "--run", trained.run, "--output", tmp_path / "file" / "here")
    assert (ended.status, "rendering" in ended.out) == (2, False)
    assert str(tmp_path / "file" / "here") in ended.err
