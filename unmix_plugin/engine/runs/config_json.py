"""Configs as JSON: written from the dataclass tree, read back by overlaying the values onto a method's defaults.

The file holds values only. Which classes they belong to is said by the registered method, so reading a config runs no
code that the file names.
"""

import dataclasses
import math
import types
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

import msgspec

from unmix_plugin.engine.configs import type_hints
from unmix_plugin.errors import ConfigError

ConfigT = TypeVar("ConfigT")


def config_to_json(value: Any) -> Any:
    """Numbers, strings, booleans, None, lists and dictionaries that say what the config says; not its fields that begin
    with `_`.

    Raises:
        ConfigError: a number is infinite or not a number.
        TypeError: a config holds something that is not a plain value.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        names = (field.name for field in dataclasses.fields(value) if not field.name.startswith("_"))
        return {name: config_to_json(getattr(value, name)) for name in names}
    if isinstance(value, Mapping):
        return {str(key): config_to_json(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [config_to_json(entry) for entry in value]
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float) and not math.isfinite(value):
        raise ConfigError(f"every number among the settings must be finite; found {value}")
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"a config holds a {type(value).__name__}, which JSON has no form for: {value!r}")


def require_kept(config: Any, default: Any) -> None:
    """Refuse settings that a run could not keep. Raises ConfigError: they are read back as others, or not at all, also
    over the method's `default`. TypeError: as `config_to_json`."""
    kept, why = config_to_json(config), ""
    try:
        is_kept = all(config_from_json(kept, base) == config for base in (config, default))
    except ConfigError as error:
        is_kept, why = False, f" ({error})"
    if not is_kept:
        raise ConfigError(
            f"the settings are read back as others{why}: keys of mappings must be text, lists lists, and classes that "
            "may stand in one place must differ in their fields"
        )


def flattened(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested values by their dotted names.

    >>> flattened({"scene": {"world": "auto"}, "seed": 42})
    {'scene.world': 'auto', 'seed': 42}
    """
    found: dict[str, Any] = {}
    for name, value in values.items():
        own = prefix + str(name)
        found |= flattened(value, f"{own}.") if isinstance(value, Mapping) and value else {own: value}
    return found


def config_from_json(values: Any, default: ConfigT, where: str = "config") -> ConfigT:
    """`default` with every value that `values` has, each checked against the field's type.

    Args:
        values: What `config_to_json` gave; fields that it lacks keep the default's value.
        default: A config of the class wanted; its nested configs say which subclasses are where.
        where: Name of the whole, for messages.
    Raises:
        ConfigError: an unknown field or a value of the wrong type or range, with the path of the field.
    """
    if not isinstance(values, dict):
        raise ConfigError(f"{where}: expected an object, found {values!r:.60}")
    hints = {name: hint for name, hint in type_hints(type(default)).items() if not name.startswith("_")}
    if unknown := sorted(values.keys() - hints.keys()):
        raise ConfigError(f"{where}: {type(default).__name__} has no field {', '.join(unknown)}")
    changes = {
        name: value_from_json(value, hints[name], getattr(default, name), f"{where}.{name}")
        for name, value in values.items()
    }
    try:
        return dataclasses.replace(default, **changes)  # type: ignore[type-var]
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from error


def value_from_json(value: Any, hint: Any, default: Any, where: str) -> Any:
    """One value as the type `hint` says, `default` what it was before; ConfigError names `where`."""
    if get_origin(hint) is Annotated:
        hint = get_args(hint)[0]
    kind, inner = get_origin(hint), get_args(hint)
    choices = inner if kind in (Union, types.UnionType) else (hint,)
    configs: list[Any] = [choice for choice in choices if dataclasses.is_dataclass(choice)]
    if configs and isinstance(value, dict):
        configs.sort(key=lambda config: not isinstance(default, config))
        problems = []
        for config in configs:
            try:
                return config_from_json(value, default if isinstance(default, config) else config(), where)
            except ConfigError as error:  # noqa: PERF203
                problems.append(str(error))
        raise ConfigError("; or ".join(problems))
    if isinstance(value, dict) and inner and dataclasses.is_dataclass(inner[-1]):
        known = default if isinstance(default, Mapping) else {}
        return {
            key: value_from_json(entry, inner[-1], known.get(key), f"{where}.{key}")
            for key, entry in value.items()
        }
    plain = [choice for choice in choices if choice not in configs]
    try:
        return msgspec.convert(value, Union[tuple(plain)] if plain else dict, dec_hook=_read_path)  # noqa: UP007
    except (msgspec.ValidationError, TypeError) as error:  # TypeError: it can't read such a type
        words = []
        for choice in choices:
            if get_origin(choice) is Literal:
                words += map(repr, get_args(choice))
            else:
                is_plain = isinstance(choice, type) and not get_args(choice)
                words.append(choice.__name__ if is_plain else str(choice))
        expected = " or ".join(words).replace("NoneType", "None")
        raise ConfigError(f"{where}: expected {expected}, found {value!r:.60}") from error


def _read_path(kind: type, value: Any) -> Any:
    if kind is Path and isinstance(value, str):
        return Path(value)
    raise TypeError(f"no setting of the type {kind.__name__} can be read")
