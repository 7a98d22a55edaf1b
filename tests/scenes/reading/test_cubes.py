"""Headers of .npy files, read by several threads.

The scale of a scene's cubes, from transforms.json or from the options.
"""

from __future__ import annotations

import json
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from tests.scenes.scene_factory import make_scene
from unmix_plugin.errors import SceneError
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
    assert {header.shape for header in headers} == {(2, 3, 4)}
    assert most == [0]
    with ThreadPoolExecutor(8) as threads:
        sums = list(threads.map(lambda place: float(arrays.map_array(place).sum()), [path] * 30))
    assert sums == [276.0] * 30


def _with_scale(root: Path, scale: object) -> Path:
    folder = make_scene(root)
    for path in folder.root.rglob("cubes/*.npy"):
        np.save(path, np.full(np.load(path).shape, 1000, np.uint16))
    path = folder.root / "transforms.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "value_scale": scale}))
    return folder.root


@pytest.mark.parametrize(("option", "value"), [(None, 0.25), (2000.0, 0.5)])
def test_integers_are_divided_by_the_scale_of_the_scene_unless_an_option_says_another(
    tmp_path: Path, option, value
):
    scene = load_scene(_with_scale(tmp_path, 4000), SceneOptions(value_scale=option))
    assert scene.options.value_scale == (option or 4000)
    np.testing.assert_allclose(scene.cube(0), value)


@pytest.mark.parametrize("scale", [0, -1, "65535", 1e40])
def test_a_scale_that_is_none_is_refused(tmp_path: Path, scale: object):
    with pytest.raises(SceneError, match=r"'value_scale' is .*; expected what stands for 1, above 0"):
        load_scene(_with_scale(tmp_path, scale))
