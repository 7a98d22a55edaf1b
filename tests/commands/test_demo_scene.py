"""`unmix-demo-scene`: what it prints, writes and refuses."""

import json
import shlex

import pytest

from tests.factories.commands import done, refused, run
from unmix_plugin.commands.demo_scene import write_demo_scene

SMALL = ["--size", "16", "--bands", "3", "--views", "4"]


def test_it_writes_a_scene_of_the_wanted_size_and_names_what_it_wrote(tmp_path):
    ended = done(write_demo_scene, tmp_path / "scene", *SMALL)
    transforms = json.loads((tmp_path / "scene" / "transforms.json").read_text())
    assert (transforms["w"], len(transforms["wavelengths"]), len(transforms["frames"])) == (16, 3, 4)
    assert "4 views (3 to train on, 1 for evaluation) of 16 x 16 pixels and 3 bands" in ended.out
    for path in (tmp_path / "scene").glob("[!.]*"):
        assert str(path) in ended.out


def test_a_folder_with_something_in_it_needs_overwrite(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    assert "--overwrite" in refused(write_demo_scene, tmp_path, *SMALL)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
    done(write_demo_scene, tmp_path, *SMALL, "--overwrite")
    assert (tmp_path / "transforms.json").exists()
    assert (tmp_path / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize("words", [["--size", "5"], ["--bands", "0"], ["--views", "1"]])
def test_a_number_out_of_bounds_exits_2_with_the_bounds(tmp_path, words):
    ended = run(write_demo_scene, tmp_path / "scene", *words)
    assert ended.status == 2
    assert ended.err.startswith(f"error: {words[0]} of a demo scene must be")
    assert ended.err.rstrip().endswith(f"found {words[1]}")
    assert not (tmp_path / "scene").exists()


def test_the_light_is_chosen_by_name(tmp_path):
    done(write_demo_scene, tmp_path / "scene", *SMALL, "--illuminant", "a")
    powers = (tmp_path / "scene" / "illuminant.csv").read_text().splitlines()
    assert [line.split(",")[0] for line in powers] == ["wavelength", "400", "550", "700"]
    assert powers[-1] == "700,1"
    words = [tmp_path / "other", *SMALL]
    assert "there is no light 'candle'" in refused(write_demo_scene, *words, "--illuminant", "candle")
    assert "give --raw too" in refused(write_demo_scene, *words, "--markers")
    assert not (tmp_path / "other").exists()


def test_raw_writes_a_capture_and_names_the_command_that_makes_a_scene_of_it(tmp_path):
    capture = tmp_path / "my capture"
    printed = done(write_demo_scene, "--raw", capture, "--size", "16", "--bands", "10", "--views", "4").out
    assert "4 raw views of 16 x 16 pixels and 10 bands, 3 of them bad" in printed
    shown = ("view_000.hdr", "white.hdr", "dark.hdr", "poses-true.json", "truth")
    assert all((capture / name).exists() for name in shown)
    assert all(f"  {capture / name}  " in printed for name in shown)
    words = shlex.split(printed.splitlines()[-1].partition(": ")[2])
    assert words[:6] == ["unmix-process", "cubes", "--data", str(capture), "--output-dir", "SCENE"]
    references = ["--white", f"{capture}/white.hdr", "--dark", f"{capture}/dark.hdr"]
    assert words[6:] == [*references, "--poses", "estimate"]
    assert not (capture / "transforms.json").exists()


def test_lines_writes_scans_and_names_the_command_that_makes_a_scene_of_them(tmp_path):
    capture = tmp_path / "scans"
    printed = done(write_demo_scene, "--lines", capture, "--size", "16", "--bands", "10", "--views", "4").out
    assert "4 raw scans of 16 lines, 16 columns and 10 bands, 3 of them bad" in printed
    shown = ("view_000.hdr", "white.hdr", "dark.hdr", "stages.csv", "poses-true.csv", "truth")
    assert all((capture / name).exists() for name in shown)
    assert all(f"  {capture / name}  " in printed for name in shown)
    words = shlex.split(printed.splitlines()[-1].partition(": ")[2])
    assert words[:6] == ["unmix-process", "lines", "--data", str(capture), "--output-dir", "SCENE"]
    assert words[-4:] == ["--poses", f"{capture}/stages.csv", "--field-of-view", "38"]
    assert "give one of them" in refused(write_demo_scene, "--lines", "--raw", tmp_path / "both")
    assert "--place world" in refused(write_demo_scene, "--lines", tmp_path / "world", "--place", "world")
