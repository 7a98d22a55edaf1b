"""Headers of .npy files, read by several threads."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from unmix_plugin.scenes.reading import cubes as arrays


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
