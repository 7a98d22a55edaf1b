"""Several processes share the views of a render and of an export, and write what one process writes."""

import numpy as np
import pytest

from tests.commands.running import run
from tests.formats.video_reading import read_video
from unmix_plugin.commands.export import PRODUCTS, _write, export
from unmix_plugin.commands.render import render
from unmix_plugin.engine.processes.processes import Processes
from unmix_plugin.errors import ConfigError

pytestmark = pytest.mark.usefixtures("no_wait_for_the_disk")


def written(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_video_and_stills_are_the_same_from_two_processes_even_of_an_odd_number_of_views(trained, tmp_path):
    words = ["--run", trained.run, "--device", "cpu", "--cameras", "orbit", "--frames", 3, "--size", "24x20"]
    words += ["--outputs", "rgb", "depth", "--formats", "mp4", "npy"]
    found = {}
    for count in (1, 2):
        folder = tmp_path / str(count)
        ended = run(render, *words, "--output", folder, "--num-devices", count)
        assert ended.status == 0, ended.err
        found[count] = written(folder)
    assert found[1].keys() == found[2].keys()
    for name, content in found[1].items():
        if name.endswith(".mp4"):
            one, two = (read_video(tmp_path / str(count) / name) for count in (1, 2))
            assert len(one[0]) == 3
            np.testing.assert_array_equal(one[0], two[0])
        else:
            assert content == found[2][name], name


def test_maps_of_each_view_are_the_same_from_two_processes(trained, tmp_path):
    for count in (1, 2):
        words = ["segmentation", "--run", trained.run, "--device", "cpu", "--output", tmp_path / str(count)]
        ended = run(export, *words, "--num-devices", count)
        assert ended.status == 0, ended.err
    assert written(tmp_path / "1") == written(tmp_path / "2")


def test_files_that_one_process_would_overwrite_end_all_with_one_message(trained, tmp_path):
    words = ["abundances", "--run", trained.run, "--device", "cpu", "--output", tmp_path, "--num-devices", 2]
    assert run(export, *words).status == 0
    before = written(tmp_path)
    assert run(export, *words).status == 2
    assert written(tmp_path) == before


@pytest.mark.parametrize("command", [export, render])
def test_no_process_at_all_is_refused(trained, command):
    words = ["cubes"] if command is export else []
    ended = run(command, *words, "--run", trained.run, "--num-devices", 0)
    assert ended.status == 2
    assert "num-devices" in ended.err


def test_products_that_are_made_as_a_whole_refuse_several_processes():
    mesh = next(product for product in PRODUCTS if product.name == "mesh")
    with pytest.raises(ConfigError, match="mesh runs in one process"):
        _write(mesh, {}, Processes(1, 2))
