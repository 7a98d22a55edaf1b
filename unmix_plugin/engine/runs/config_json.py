"""Configs as JSON: written from the dataclass tree, read back by overlaying the values onto a method's defaults.

The file holds values only. Which classes they belong to is said by the registered method, so reading a config runs no
code that the file names.
"""

import dataclasses
import math
import types
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from unmix_plugin.errors import ConfigError

ConfigT = TypeVar("ConfigT")


def config_to_json(value: Any) -> Any:
    """Numbers, strings, booleans, None, lists and dictionaries that say what the config says.

    Raises:
        ConfigError: a number is infinite or not a number.
        TypeError: a config holds something that is not a plain value.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: config_to_json(getattr(value, field.name)) for field in _fields(value)}
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
    if any(config_from_json(config_to_json(config), base) != config for base in (config, default)):
        raise ConfigError(
            "the settings are read back as others: keys of mappings must be text, lists lists, and classes that may "
            "stand in one place must differ in their fields"
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
        raise _WrongTypeError(where, "an object", values)
    known = {field.name: field for field in _fields(default)}
    unknown = sorted(set(values) - set(known))
    if unknown:
        raise ConfigError(f"{where}: {type(default).__name__} has no field {', '.join(unknown)}")
    hints = get_type_hints(type(default))
    changes = {
        name: value_from_json(value, hints[name], getattr(default, name), f"{where}.{name}")
        for name, value in values.items()
    }
    try:
        return dataclasses.replace(default, **changes)  # type: ignore[type-var]
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from error


class _WrongTypeError(ConfigError):
    """A value of another type than expected."""

    def __init__(self, where: str, expected: str, value: Any) -> None:
        text = repr(value)
        found = f"{type(value).__name__} {text if len(text) <= 60 else text[:57] + '...'}"
        super().__init__(f"{where}: expected {expected}, found {found}")
        self.where, self.expected = where, expected


def _fields(config: Any) -> list[dataclasses.Field[Any]]:
    return [field for field in dataclasses.fields(config) if not field.name.startswith("_")]


def value_from_json(value: Any, hint: Any, default: Any, where: str) -> Any:
    """One value as the type `hint` says, `default` what it was before; ConfigError names `where`."""
    if get_origin(hint) is Annotated:
        hint = get_args(hint)[0]
    origin = get_origin(hint)
    if origin in (Union, types.UnionType):
        return _read_union(value, get_args(hint), default, where)
    if origin is Literal:
        if any(value == choice and type(value) is type(choice) for choice in get_args(hint)):
            return value
        raise _WrongTypeError(where, f"one of {', '.join(map(repr, get_args(hint)))}", value)
    if origin is tuple or origin is list:
        return _read_sequence(value, origin, get_args(hint), default, where)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        if not isinstance(value, dict):
            raise _WrongTypeError(where, "an object", value)
        of_entries, defaults = get_args(hint)[1], default if isinstance(default, Mapping) else {}
        return {
            key: value_from_json(entry, of_entries, defaults.get(key), f"{where}.{key}")
            for key, entry in value.items()
        }
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return config_from_json(value, default if isinstance(default, hint) else hint(), where)
    return _read_scalar(value, hint, where)


def _read_union(value: Any, choices: tuple[Any, ...], default: Any, where: str) -> Any:
    """The member type of `default` is tried first, then the others in their order."""
    classes = [choice for choice in choices if isinstance(choice, type) and get_origin(choice) is None]
    fits_default = [choice for choice in classes if isinstance(default, choice)]
    problems: list[ConfigError] = []
    for choice in fits_default + [choice for choice in choices if choice not in fits_default]:
        try:
            return value_from_json(value, choice, default, where)
        except ConfigError as error:  # noqa: PERF203
            problems.append(error)
    mismatches = [
        problem for problem in problems if isinstance(problem, _WrongTypeError) and problem.where == where
    ]
    if len(mismatches) == len(problems):
        expected = sorted((problem.expected for problem in mismatches), key=lambda kind: kind == "null")
        raise _WrongTypeError(where, " or ".join(expected), value)
    raise ConfigError("; or ".join(map(str, problems)))


def _read_sequence(value: Any, kind: type, hints: tuple[Any, ...], default: Any, where: str) -> Any:
    if not isinstance(value, list):
        raise _WrongTypeError(where, "a list", value)
    repeated = kind is list or (len(hints) == 2 and hints[1] is Ellipsis)
    if not repeated and len(value) != len(hints):
        raise ConfigError(f"{where}: expected {len(hints)} entries, found {len(value)}")
    defaults = default if isinstance(default, kind) and len(default) == len(value) else [None] * len(value)
    return kind(
        value_from_json(entry, hints[0] if repeated else hints[i], defaults[i], f"{where}[{i}]")
        for i, entry in enumerate(value)
    )


def _read_scalar(value: Any, hint: Any, where: str) -> Any:
    kinds = {
        type(None): "null",
        Path: "a path",
        float: "a number",
        int: "an integer",
        bool: "true or false",
        str: "text",
    }
    hint = type(None) if hint is None else hint
    if hint is Path and isinstance(value, str):
        return Path(value)
    if hint is float and type(value) is int:
        return float(value)
    if type(value) is hint:
        return value
    raise _WrongTypeError(where, kinds.get(hint, str(hint)), value)
