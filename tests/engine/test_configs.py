"""Trees of settings: walked, and changed setting by setting."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import pytest

from unmix_plugin.engine.configs import (
    CommonFlag,
    InstantiateConfig,
    Setting,
    Settings,
    Within,
    map_settings,
    settings_of,
)
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


@dataclass(frozen=True)
class Bounded(Settings):
    rate: Annotated[float | Literal["auto"], Within("(0, 1]")] = "auto"
    steps: Annotated[int | None, Within("[1, 9]")] = None
    factor: Annotated[float, CommonFlag, Within("(0, inf)")] = 1.0
    count: Annotated[int, Within("[0, inf)")] = 0


@dataclass(frozen=True)
class Refined(Bounded):
    steps: int | None = 4


@pytest.mark.parametrize("kind", [Bounded, Refined])
@pytest.mark.parametrize(
    ("values", "rule"),
    [
        ({"rate": 0.0}, r"rate in \(0, 1\] or auto \(got 0.0\)$"),
        ({"rate": 1.01}, "rate in"),
        ({"steps": 0}, r"steps of 1 to 9 \(got 0\)$"),
        ({"steps": 10}, "steps of 1 to 9"),
        ({"factor": 0.0}, r"factor above 0 and finite \(got 0.0\)$"),
        ({"factor": float("inf")}, "factor above 0 and finite"),
        ({"factor": float("nan")}, "factor above 0 and finite"),
        ({"count": -1}, r"count of at least 0 \(got -1\)$"),
        ({"steps": 0, "count": -1}, r"steps of 1 to 9 \(got 0\) and count of at least 0"),
    ],
)
def test_a_number_outside_its_interval_is_refused_also_of_a_class_with_another_default(kind, values, rule):
    with pytest.raises(ConfigError, match=rule):
        kind(**values)


def test_ends_of_intervals_words_and_none_are_taken():
    assert [Bounded(rate=1.0).rate, Bounded(rate="auto").rate, Bounded(steps=None).steps] == [
        1.0,
        "auto",
        None,
    ]
    assert [Bounded(steps=count).steps for count in (1, 9)] == [1, 9]
