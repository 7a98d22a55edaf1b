"""Regions of a run while pages are drawn."""

import threading

from tests.viewer.view_factory import make_source
from unmix_plugin.trained.regions import Box
from unmix_plugin.viewer.rendering.pictures import PictureMaker
from unmix_plugin.viewer.rendering.regions import RunRegions

EVERYTHING = Box((-5.0, -5.0, -5.0), (5.0, 5.0, 5.0))


def test_regions_are_kept_and_removed_while_one_is_measured(tmp_path):
    regions = RunRegions(PictureMaker(make_source(tmp_path, initial_opacity=0.6)))
    is_kept = []

    def keep_and_remove():
        regions.keep("other", EVERYTHING)
        regions.keep("other", None)

    def show(_doing):
        if is_kept:
            return
        thread = threading.Thread(target=keep_and_remove, daemon=True)
        thread.start()
        thread.join(2.0)
        is_kept.append(not thread.is_alive())

    assert regions.measure("all of it", EVERYTHING, show).area > 0
    assert is_kept == [True]
