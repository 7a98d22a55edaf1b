"""Trees of settings: walked, and changed setting by setting."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import pytest

from unmix_plugin.engine.configs import CommonFlag, InstantiateConfig, Setting, map_settings, settings_of
from unmix_plugin.errors import ConfigError


@dataclass(frozen=True)
class Inner:
    width: int = 4

    def __post_init__(self) -> None:
        if self.width < 1:
            raise ConfigError(f"width must be at least 1; got {self.width}")


@dataclass(frozen=True)
class Outer(InstantiateConfig):
    name: Annotated[str, CommonFlag] = "plain"
    inner: Inner = Inner()


def doubled(setting: Setting) -> Setting:
    return replace(setting, value=2 * setting.value) if isinstance(setting.value, int) else setting


def test_values_change_alone_in_a_tree_of_the_same_classes_and_keep_their_rules():
    found = map_settings(Outer(_target=dict), doubled)
    assert found == Outer(_target=dict, inner=Inner(8))
    assert (type(found), type(found.inner)) == (Outer, Inner)
    with pytest.raises(ConfigError, match="width must be at least 1; got -1"):
        map_settings(Outer(), lambda each: replace(each, value=-1) if each.path[-1] == "width" else each)


def test_annotations_change_in_classes_that_are_made_for_them_and_values_stay():
    marked = map_settings(
        Outer(inner=Inner(7)), lambda each: replace(each, hint=Annotated[each.hint, "seen"])
    )
    assert isinstance(marked, Outer)
    assert isinstance(marked.inner, Inner)
    assert [(each.path, each.value, each.marks) for each in settings_of(marked)] == [
        (("name",), "plain", (CommonFlag, "seen")),
        (("inner", "width"), 7, ("seen",)),
    ]
    assert type(marked)().inner.width == 7  # what is shown as default
