"""Configs survive the way through JSON, and a file that does not fit says where."""

import json
import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.factories.rgb_nerf import rgb_nerf
from unmix_plugin.engine.configs import InstantiateConfig, OptimizerConfig, Target, TrainerConfig
from unmix_plugin.engine.runs.config_json import config_from_json, config_to_json
from unmix_plugin.errors import ConfigError


@dataclass(frozen=True)
class Inner(InstantiateConfig):
    _target: Target = field(default_factory=lambda: dict)
    size: int = 3
    name: str = "x"


@dataclass(frozen=True)
class Larger(Inner):
    extra: float = 0.5


@dataclass(frozen=True)
class Everything(InstantiateConfig):
    number: float = 1.0
    count: int | None = None
    flag: bool = False
    path: Path | None = Path("a/b")
    kind: Literal["none", "some", "full"] = "none"
    pair: tuple[float, int] = (0.5, 2)
    many: tuple[int, ...] = ()
    names: list[str] = field(default_factory=list)
    inner: Inner = field(default_factory=Larger)
    perhaps: Inner | None = None
    optimizer: OptimizerConfig = OptimizerConfig()
    named: dict[str, Inner] = field(default_factory=lambda: {"a": Larger()})


finite = st.floats(allow_nan=False, allow_infinity=False)
larger = st.builds(Larger, _target=st.just(dict), size=st.integers(), name=st.text(), extra=finite)
inner = st.builds(Inner, _target=st.just(dict), size=st.integers(), name=st.text())
everything = st.builds(
    Everything,
    _target=st.just(object),
    number=finite,
    count=st.none() | st.integers(),
    flag=st.booleans(),
    path=st.none() | st.sampled_from([Path("x"), Path("/y z/ü")]),
    kind=st.sampled_from(["none", "some", "full"]),
    pair=st.tuples(finite, st.integers()),
    many=st.lists(st.integers(), max_size=3).map(tuple),
    names=st.lists(st.text(), max_size=3),
    inner=larger,
    perhaps=st.none() | inner,
    named=st.fixed_dictionaries({"a": larger}, optional={"b": inner}),
)


def without_targets(config: Any) -> Any:
    """Lambdas make the default targets unequal in identity, not in effect."""
    return replace(config, _target=object)


@settings(deadline=None, max_examples=150)
@given(everything)
def test_any_config_comes_back_equal(config):
    text = json.dumps(config_to_json(config), allow_nan=False)
    assert without_targets(config_from_json(json.loads(text), Everything())) == without_targets(config)


def test_a_registered_method_comes_back_with_its_classes_and_what_a_file_lacks_is_the_default():
    config = replace(rgb_nerf.config, data=Path("scene"), max_seconds=3.5, average_decay=0.99)
    found = config_from_json(json.loads(json.dumps(config_to_json(config))), rgb_nerf.config)
    assert found == config
    assert type(found.pipeline.model) is type(config.pipeline.model)
    assert config_from_json({"seed": 7}, rgb_nerf.config) == replace(rgb_nerf.config, seed=7)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"count": "three"}, r"config\.count: expected int or None, found 'three'$"),
        ({"count": True}, r"config\.count: expected int or None, found True$"),
        ({"flag": 1}, r"config\.flag: expected bool, found 1$"),
        ({"number": None}, r"config\.number: expected float, found None$"),
        ({"kind": "most"}, r"config\.kind: expected 'none' or 'some' or 'full', found 'most'$"),
        ({"pair": [1.0]}, r"config\.pair: expected tuple\[float, int\], found \[1.0\]$"),
        ({"pair": 1.0}, r"config\.pair: expected tuple\[float, int\], found 1.0$"),
        ({"many": [1, "x"]}, r"config\.many: expected tuple\[int, \.\.\.\], found \[1, 'x'\]$"),
        ({"inner": {"size": 1.5}}, r"config\.inner\.size: expected int, found 1\.5$"),
        ({"inner": {"sise": 1}}, r"config\.inner: Larger has no field sise"),
        ({"inner": 3}, r"config\.inner: expected Inner, found 3$"),
        ({"named": {"a": {"extra": "x"}}}, r"config\.named\.a\.extra: expected float, found 'x'$"),
        ({"_target": "os.system"}, r"config: Everything has no field _target"),
        ({"inner": {"_target": "os.system"}}, r"config\.inner: Larger has no field _target"),
        ([], r"config: expected an object, found \[\]$"),
        ({"optimizer": {"lr": -1.0}}, r"config\.optimizer: .*lr above 0 and finite \(got -1.0\)$"),
    ],
)
def test_a_value_that_does_not_fit_is_named_by_its_path(values, message):
    with pytest.raises(ConfigError, match=message):
        config_from_json(values, Everything())


def test_what_no_file_can_hold_is_refused_before_it_is_written():
    with pytest.raises(ConfigError, match="finite"):
        config_to_json(Everything(number=math.inf))
    with pytest.raises(TypeError, match="holds a set"):
        config_to_json(Everything(names={1}))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("settings_", "rule"),
    [
        ({"seed": 2**63}, r"seed of -2\^63 to 2\^63 - 1 \(got 9223372036854775808\)$"),
        ({"max_num_iterations": -1}, r"max-num-iterations of at least 0 \(got -1\)$"),
        ({"max_seconds": 0.0}, r"max-seconds above 0 and finite \(got 0.0\)$"),
        ({"max_seconds": math.inf}, r"max-seconds above 0 and finite \(got inf\)$"),
        ({"max_num_iterations": None}, r"or max-seconds \(got max-num-iterations none, max-seconds none\)$"),
        ({"steps_per_log": 0}, "steps-per-log of at least 1"),
        ({"average_decay": 1.0}, "average-decay in"),
        ({"method_name": "../x"}, "a file name as method-name"),
    ],
)
def test_impossible_training_settings_are_refused(settings_, rule):
    with pytest.raises(ConfigError, match=rule):
        replace(TrainerConfig(), **settings_)


@pytest.mark.parametrize("bad", [{"lr": 0.0}, {"final_factor": 0.0}, {"weight_decay": -1.0}])
def test_impossible_optimizer_settings_are_refused(bad):
    [name] = bad
    with pytest.raises(ConfigError, match=name.replace("_", "-")):
        OptimizerConfig(**bad)
