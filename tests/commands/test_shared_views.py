"""Several processes share the views of a render and of an export, and write what one process writes."""

import numpy as np
import pytest

from tests.factories.commands import done, refused, run
from tests.factories.outputs import read_video
from unmix_plugin.commands.export import PRODUCTS, export, write_product
from unmix_plugin.commands.render import render
from unmix_plugin.engine.processes import Processes
from unmix_plugin.errors import ConfigError

pytestmark = pytest.mark.usefixtures("no_wait_for_the_disk")


def written(folder):
    return {
        str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("[!.]*") if path.is_file()
    }


def test_a_video_and_stills_are_the_same_from_two_processes_even_of_an_odd_number_of_views(trained, tmp_path):
    words = ["--run", trained.run, "--device", "cpu", "--cameras", "orbit", "--frames", 3, "--size", "24x20"]
    words += ["--outputs", "rgb", "depth", "--formats", "mp4", "npy"]
    found = {}
    for count in (1, 2):
        folder = tmp_path / str(count)
        done(render, *words, "--output", folder, "--num-devices", count)
        found[count] = written(folder)
    for name in ("rgb.mp4", "depth.mp4"):
        one, other = (read_video(tmp_path / count / name)[0] for count in "12")
        np.testing.assert_array_equal(one, other)
        assert len(one) == 3
        del found[1][name], found[2][name]
    assert found[1] == found[2]


def test_maps_are_the_same_from_two_processes_which_overwrite_nothing(trained, tmp_path):
    words = ["segmentation", "--run", trained.run, "--device", "cpu", "--output"]
    for count in (1, 2):
        done(export, *words, tmp_path / str(count), "--num-devices", count)
    before = written(tmp_path / "1")
    assert written(tmp_path / "2") == before
    assert run(export, *words, tmp_path / "1", "--num-devices", 2).status == 2
    assert written(tmp_path / "1") == before


def test_no_process_at_all_and_several_for_what_is_made_as_a_whole_are_refused(trained):
    assert "num-devices" in refused(render, "--run", trained.run, "--num-devices", 0)
    mesh = next(product for product in PRODUCTS if product.name == "mesh")
    with pytest.raises(ConfigError, match="mesh runs in one process"):
        write_product(mesh, {}, Processes(1, 2))
