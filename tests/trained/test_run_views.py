"""A view by its name or number means the same in every command."""

import pytest

from tests.trained.camera_files.camera_scenes import around
from unmix_plugin.errors import ConfigError
from unmix_plugin.trained.run_views import RunView, find_view

VIEWS = [RunView(name, around()[0]) for name in ("left", "right", "0042")]
OTHERS = [RunView(name, around()[1]) for name in ("1", "far")]


def test_a_view_is_found_by_its_number_among_the_numbered_or_by_any_name():
    assert find_view(VIEWS, "2").name == "0042"
    assert find_view(VIEWS, "0042").name == "0042"
    assert find_view(VIEWS, "1").name == "right"
    assert find_view(VIEWS, "far", OTHERS).name == "far"
    assert find_view(VIEWS, "1", OTHERS).name == "1"


def test_a_view_that_is_not_there_is_refused_with_those_that_are():
    with pytest.raises(ConfigError, match=r"no view '3'; give a number from 0 to 2, or a name such as left"):
        find_view(VIEWS, "3")
    with pytest.raises(ConfigError, match=r"no view 'rihgt' \(did you mean right\?\)"):
        find_view(VIEWS, "rihgt")
