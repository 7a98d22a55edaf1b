"""Readers under test, and damage to their valid inputs: bytes flipped, cut and swapped for what parsers trip over.

A mutation depends on the generator alone, so a seed and the number of a case reproduce its bytes.
"""

from __future__ import annotations

import copy
import io
import json
import random
import zipfile
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

TOKENS = tuple(
    token.encode("utf-8", "surrogatepass")
    for token in (
        *(
            "0",
            "-1",
            "1e-320",
            "1e400",
            "-1e308",
            "1_0",
            "9" * 400,
            "2**64",
            "nan",
            "NaN",
            "inf",
            "-Infinity",
        ),
        *("true", "True", "null", "None", *"{}[]\"'(),:;=\\/"),
        *("\0", "\r", "\n", "\n\n\n\n", "\t", " " * 64, "..", "~", "%s", "{}", "é", "\ufeff", "\ud800"),
        *('"\\ud800"', '"\\u0000"', "[" * 40, "-" * 40, "(" * 60, "1e", "0x10", "1e999999999"),
        *("255", "256", "65535", "65536", "-2147483648", "4294967296", "9223372036854775808"),
    )
)
"""What tends to break parsers of text, in UTF-8 but for a lone surrogate."""

VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 0.5, -0.0, 1e-320, 1e300, -1e300),
    *(10**400, 2**64, float("nan"), float("inf")),
    *("", "0", "nan", "..", "/", "/dev/null", "\0", "\ud800", "a" * 5000, ".", "../..", "~", "é", "\u202e"),
    *([], {}, [[]], [None], [[[]]], {"": None}, [1.0, 2.0], [True, False], ["a", "a"]),
)
"""What may be anywhere in JSON."""

_NESTED = "nested lists"
"""Stands for lists nested deeper than the JSON module writes."""

Mutator = Callable[[Sequence[bytes], random.Random], bytes]
"""From valid samples and a generator to a damaged one."""


def mutate_bytes(samples: Sequence[bytes], generator: random.Random) -> bytes:
    """One to six edits of the bytes of one sample."""
    data = bytearray(generator.choice(samples))
    for _ in range(generator.choice((1, 1, 1, 2, 3, 6))):
        generator.choice(_EDITS)(data, samples, generator)
    return bytes(data)


def mutate_png(samples: Sequence[bytes], generator: random.Random) -> bytes:
    """Damage to bytes; half of the PNGs get right checksums again, so that more of them is decoded."""
    data = bytearray(mutate_bytes(samples, generator))
    start = 8 if generator.random() < 0.5 and data.startswith(b"\x89PNG") else len(data)
    while start + 12 <= len(data):
        end = start + 8 + int.from_bytes(data[start : start + 4], "big")
        if end + 4 > len(data):
            break
        data[end : end + 4] = zlib.crc32(data[start + 4 : end]).to_bytes(4, "big")
        start = end + 4
    return bytes(data)


def mutate_zip(samples: Sequence[bytes], generator: random.Random) -> bytes:
    """Damage to a member of an archive before it is packed, so that its checksum is right; or to the archive."""
    data = generator.choice(samples)
    if generator.random() < 0.3 or not zipfile.is_zipfile(io.BytesIO(data)):
        return mutate_bytes([data], generator)
    buffer = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as found, zipfile.ZipFile(buffer, "w") as damaged:
        spoiled = generator.choice(found.infolist())
        for info in found.infolist():
            content = found.read(info)
            damaged.writestr(info, mutate_bytes([content], generator) if info is spoiled else content)
    return buffer.getvalue()


def mutate_json(samples: Sequence[bytes], generator: random.Random) -> bytes:
    """Values anywhere in a JSON sample replaced, dropped, repeated or moved; sometimes its bytes are damaged too."""
    if generator.random() < 0.2:
        return mutate_bytes(samples, generator)
    content = json.loads(generator.choice(samples))
    for _ in range(generator.choice((1, 1, 2, 4))):
        content = _with_damage(content, generator)
    data = json.dumps(content).encode().replace(json.dumps(_NESTED).encode(), b"[" * 3000 + b"]" * 3000)
    return mutate_bytes([data], generator) if generator.random() < 0.1 else data


def _with_damage(content: Any, generator: random.Random) -> Any:
    """The value with one place of it changed, at any depth."""
    if not isinstance(content, dict | list) or not content or generator.random() < 0.15:
        return _other_value(content, generator)
    keys = list(content) if isinstance(content, dict) else range(len(content))
    key = generator.choice(keys)
    kind = generator.random()
    if kind < 0.1:
        del content[key]
    elif kind < 0.2 and isinstance(content, list):
        content.insert(key, copy.deepcopy(content[generator.choice(keys)]))
    elif kind < 0.3:
        other = generator.choice(keys)
        content[key], content[other] = content[other], content[key]
    else:
        content[key] = _with_damage(content[key], generator)
    return content


def _other_value(value: Any, generator: random.Random) -> Any:
    kind = generator.random()
    if kind < 0.03:
        return _NESTED
    if isinstance(value, float) and kind < 0.5:
        return value * generator.choice((-1, 0.001, 1000, 1e200)) + generator.choice((0, 1, -1e-9))
    if isinstance(value, str) and kind < 0.5:
        position = generator.randint(0, len(value))
        return value[:position] + generator.choice(("\0", "\ud800", "/", "..", "é", " ")) + value[position:]
    return copy.deepcopy(generator.choice(VALUES))


def _flip(data: bytearray, _: Sequence[bytes], generator: random.Random) -> None:
    if data:
        data[generator.randrange(len(data))] ^= 1 << generator.randrange(8)


def _set(data: bytearray, _: Sequence[bytes], generator: random.Random) -> None:
    if data:
        data[generator.randrange(len(data))] = generator.randrange(256)


def _cut(data: bytearray, _: Sequence[bytes], generator: random.Random) -> None:
    first, last = _span(data, generator)
    del data[first:last]


def _truncate(data: bytearray, _: Sequence[bytes], generator: random.Random) -> None:
    del data[generator.randint(0, len(data)) :]


def _repeat(data: bytearray, _: Sequence[bytes], generator: random.Random) -> None:
    first, last = _span(data, generator)
    data[first:first] = data[first:last] * generator.choice((1, 2, 50))


def _splice(data: bytearray, samples: Sequence[bytes], generator: random.Random) -> None:
    other = generator.choice(samples)
    first, last = _span(data, generator)
    start, end = _span(other, generator)
    data[first:last] = other[start:end]


def _insert(data: bytearray, _: Sequence[bytes], generator: random.Random) -> None:
    position = generator.randint(0, len(data))
    data[position:position] = generator.choice(TOKENS)


def _replace(data: bytearray, _: Sequence[bytes], generator: random.Random) -> None:
    first, last = _span(data, generator, longest=12)
    data[first:last] = generator.choice(TOKENS)


def _span(data: bytes | bytearray, generator: random.Random, longest: int = 200) -> tuple[int, int]:
    first = generator.randint(0, len(data))
    return first, min(len(data), first + generator.randint(0, longest))


def _grow(data: bytearray, _: Sequence[bytes], generator: random.Random) -> None:
    """A few bytes repeated until they are many: what takes time or memory out of proportion shows itself."""
    if generator.random() < _GROWN:
        first, last = _span(data, generator, longest=16)
        part = bytes(data[first:last]) or generator.choice(TOKENS)
        data[first:first] = part * (_MOST_GROWTH // len(part))


_GROWN, _MOST_GROWTH = 0.1, 1 << 17
_EDITS = (_flip, _set, _cut, _truncate, _repeat, _splice, _insert, _insert, _replace, _replace, _grow)


@dataclass(frozen=True)
class Reader:
    """One reader under test."""

    samples: tuple[bytes, ...]
    """Valid inputs, of many kinds."""
    file_name: str
    """What the file is called that `read` gets."""
    read: Callable[[Path], object]
    """Reads a file; nothing else lies beside it but what `companions` names."""
    allowed: tuple[type[Exception], ...]
    """What it may raise."""
    mutate: Mutator = mutate_bytes
    companions: tuple[tuple[str, bytes], ...] = ()
    """Names and contents of files beside it."""
