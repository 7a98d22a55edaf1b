"""Methods are found through entry points, and one broken plugin harms no other."""

from dataclasses import replace
from importlib.metadata import EntryPoint

import pytest

from tests.factories.rgb_nerf import rgb_nerf
from unmix_plugin.engine.registry import METHOD_GROUP, MethodSpecification, discover_methods, find_method
from unmix_plugin.errors import ConfigError


def entry(name: str, value: str) -> EntryPoint:
    return EntryPoint(name, value, METHOD_GROUP)


def test_a_method_is_found_under_its_configs_name_and_another_of_that_name_is_skipped(registered):
    registered[0] = entry("another-name", registered[0].value)
    registered.append(entry("z-again", registered[0].value))
    methods, broken = discover_methods()
    assert list(methods) == ["rgb-nerf"]
    assert methods["rgb-nerf"].description == "Plain RGB radiance field."
    assert "z-again: a method rgb-nerf is registered already" in str(broken[0])


def test_settings_have_the_name_of_the_method_by_which_their_runs_are_found_again():
    made_later = MethodSpecification(lambda: rgb_nerf.config, "A copy.", name="mine")
    assert made_later.config == replace(rgb_nerf.config, method_name="mine")


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        ("no_such_module_at_all:method", "ModuleNotFoundError: No module named 'no_such_module_at_all'"),
        ("tests.factories.rgb_nerf:no_such_name", "AttributeError"),
        ("tests.factories.rgb_nerf:VIEWS", "is a int, not a MethodSpecification"),
        ("plugin_that_fails:method", "RuntimeError: this plugin fails on import"),
    ],
)
def test_a_broken_plugin_is_named_with_its_reason_and_skipped(
    registered, value, reason, tmp_path, monkeypatch
):
    code = 'raise RuntimeError("this plugin fails on import\\nbadly")'
    (tmp_path / "plugin_that_fails.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    registered.append(entry("broken-one", value))
    methods, broken = discover_methods()
    assert list(methods) == ["rgb-nerf"]
    assert [plugin.name for plugin in broken] == ["broken-one"]
    assert str(broken[0]).startswith("skipped the plugin broken-one: ")
    assert reason in str(broken[0])
    assert "\n" not in str(broken[0])


def test_an_unknown_method_is_answered_with_near_names_the_list_and_what_was_skipped(registered):
    registered.append(entry("broken-one", "no_such_module_at_all:method"))
    with pytest.raises(ConfigError) as caught:
        find_method("rgb-nurf")
    message = str(caught.value)
    assert "unknown method 'rgb-nurf'; did you mean rgb-nerf?" in message
    assert "installed: rgb-nerf" in message
    assert "skipped the plugin broken-one: ModuleNotFoundError" in message
    with pytest.raises(ConfigError, match="unknown method 'xyz'\ninstalled: rgb-nerf"):
        find_method("xyz")
