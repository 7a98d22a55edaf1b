"""Regions of a run while pages are drawn."""

import threading

import pytest

from tests.factories.views import make_source
from unmix_plugin.errors import ConfigError
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


def test_stopping_waits_for_what_is_measured_and_ends_it(tmp_path):
    regions = RunRegions(PictureMaker(make_source(tmp_path, initial_opacity=0.6)))
    begun, doing, reasons = threading.Event(), [], []

    def show(what):
        doing.append(what)
        begun.set()

    def measure():
        try:
            regions.measure("all of it", EVERYTHING, show)
        except ConfigError as error:
            reasons.append(str(error))

    thread = threading.Thread(target=measure, daemon=True)
    thread.start()
    assert begun.wait(60)
    regions.stop()
    done = len(doing)
    thread.join(10)
    assert reasons == ["the viewer was stopped"]
    assert len(doing) == done
    with pytest.raises(ConfigError, match="the viewer was stopped"):
        regions.measure("all of it", EVERYTHING, show)
