from __future__ import annotations

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from tests.factories.scenes import fault_of
from unmix_plugin.scenes.reading import cubes as arrays
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.settings import SceneOptions


def test_headers_are_parsed_one_at_a_time(tmp_path, monkeypatch):
    """Python 3.11 fails where two threads parse literals at the same moment."""
    path = tmp_path / "cube.npy"
    np.save(path, np.arange(24.0).reshape(2, 3, 4))
    at_work, most, load = threading.Semaphore(1), [0], np.lib.format.read_array_header_1_0

    def watched(file):
        alone = at_work.acquire(blocking=False)
        most[0] += not alone
        time.sleep(0.002)
        found = load(file)
        if alone:
            at_work.release()
        return found

    monkeypatch.setitem(arrays.READ_HEADER, (1, 0), watched)
    with ThreadPoolExecutor(8) as threads:
        headers = list(threads.map(arrays.read_array_header, [path] * 30))
        sums = list(threads.map(lambda place: float(arrays.map_array(place).sum()), [path] * 30))
    assert {header.shape for header in headers} == {(2, 3, 4)}
    assert most == [0]
    assert sums == [276.0] * 30


@pytest.fixture
def integers(folder):
    return folder.edit_cubes(lambda cube: np.full(cube.shape, 1000, np.uint16))


@pytest.mark.parametrize(("option", "value"), [(None, 0.25), (2000.0, 0.5)])
def test_integers_are_divided_by_the_scale_of_the_scene_unless_an_option_is_given(integers, option, value):
    integers.edit(lambda content: content.update(value_scale=4000))
    scene = load_scene(integers.root, SceneOptions(value_scale=option))
    assert scene.options.value_scale == (option or 4000)
    np.testing.assert_allclose(scene.cube(0), value)


@pytest.mark.parametrize("scale", [0, -1, "65535", 1e40])
def test_a_scale_that_is_none_is_refused(integers, scale):
    fault = fault_of(integers.edit(lambda content: content.update(value_scale=scale)))
    assert "'value_scale' is " in fault
    assert "; expected what stands for 1, above 0" in fault
