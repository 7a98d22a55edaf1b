"""What is written of a render: which formats suit an output, and which it gets where none are asked for."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

from unmix_plugin.engine.registry import Output, OutputKind
from unmix_plugin.errors import ConfigError, did_you_mean
from unmix_plugin.trained.protocol import RenderableScene

Format = Literal["envi", "exr", "npy", "png", "mp4"]
FORMATS: tuple[Format, ...] = ("envi", "exr", "npy", "png", "mp4")
EVERY_OUTPUT = "all"
"""Stands for every output that takes no argument."""

_LONGEST_FILE_NAME = 100
_DEFAULT_STILLS = ("spectral", "rgb", "abundances", "segmentation", "depth")


class _KindFormats(NamedTuple):
    suited: tuple[Format, ...]
    stills: tuple[Format, ...]
    """Where none are asked for, of single views."""
    moving: tuple[Format, ...] = ("mp4",)
    """The same where views follow each other."""


_MAP = _KindFormats(("png", "npy", "exr", "envi", "mp4"), ("png", "npy"))
_PICTURE = _KindFormats(("png", "npy", "envi", "mp4"), ("png",))

_BY_KIND: dict[OutputKind, _KindFormats] = {
    "channels": _KindFormats(("envi", "exr", "npy", "mp4"), ("envi",), ("envi",)),
    "shares": _KindFormats(("envi", "exr", "npy", "png", "mp4"), ("envi", "png")),
    "srgb": _PICTURE,
    "linear": _KindFormats(("exr", "npy", "envi", "png", "mp4"), ("exr",)),
    "picture": _PICTURE,
    "grey": _MAP,
    "map": _MAP,
    "labels": _KindFormats(("png", "npy", "mp4"), ("png",)),
    "vectors": _MAP,
}
_COMPOSITE = _KindFormats(("png", "exr", "npy", "envi", "mp4"), ("png",))

_REASONS = {
    ("channels", "png"): "a PNG shows colours: ask for rgb, band:NMnm, false-colour:NM,NM,NM or pca",
    ("srgb", "exr"): "it is encoded for displays and EXR holds linear light: ask for linear_rgb",
    ("picture", "exr"): "it is made for displays and EXR holds linear light",
    ("labels", "envi"): "ids are written as PNG, with their palette, or .npy",
    ("labels", "exr"): "ids are written as PNG, with their palette, or .npy",
}


@dataclass(frozen=True)
class FormattedOutput:
    """An output in a format."""

    output: Output
    format: Format


def file_name(output: Output) -> str:
    """An output's name as part of a file's: odd characters become `-`, folders of a target's file are left out.

    >>> file_name(Output("false-colour:860,650,550", "linear", "", ""))
    'false-colour-860-650-550'
    """
    short = re.sub(r"[^:]*/", "", output.name) if output.name.startswith("target:") else output.name
    plain = re.sub(r"[^\w.+-]+", "-", short).strip("-.")
    if len(plain) <= _LONGEST_FILE_NAME:
        return plain
    return f"{plain[:_LONGEST_FILE_NAME]}-{hashlib.sha256(output.name.encode()).hexdigest()[:8]}"


def choose_formats(
    outputs: Sequence[str], formats: Sequence[str], scene: RenderableScene, is_path: bool
) -> tuple[FormattedOutput, ...]:
    """Every output in every asked format that suits it.

    Args:
        outputs: Names, or `all`; none: those that are usually wanted, as far as the scene has them.
        formats: Of `FORMATS`; none: what suits each output best.
        scene: It says what outputs there are.
        is_path: Whether views follow each other.
    Raises:
        ConfigError: an unknown output or format, a format that suits no output, or an output that no format suits.
        SpectrumError: a wavelength outside the bands.
    """
    names = dict.fromkeys(_expanded(outputs or _default_outputs(scene, is_path), scene))
    chosen = [scene.output(name) for name in names]
    wanted: list[Format] = [_format(name) for name in dict.fromkeys(formats)]
    _refuse_same_files(chosen)
    found = [
        FormattedOutput(output, one)
        for output in chosen
        for one in (_suited(output, wanted) if wanted else _usual(output, is_path))
    ]
    for one in wanted:
        if all(formatted.format != one for formatted in found):
            asked = " or ".join(output.name for output in chosen)
            raise ConfigError(f"--formats {one} suits none of the outputs asked for: {asked}")
    return tuple(found)


def _default_outputs(scene: RenderableScene, is_path: bool) -> list[str]:
    known = [output.name for output in scene.outputs]
    wanted = ("rgb",) if is_path else _DEFAULT_STILLS
    return [name for name in wanted if name in known] or known


def _expanded(outputs: Iterable[str], scene: RenderableScene) -> Iterable[str]:
    for name in outputs:
        if name == EVERY_OUTPUT:
            yield from (output.name for output in scene.outputs)
        else:
            yield name


def _kind_formats(output: Output) -> _KindFormats:
    # Linear light is for other programs, but a composite of bands is for people.
    is_composite = output.kind == "linear" and ":" in output.name
    return _COMPOSITE if is_composite else _BY_KIND[output.kind]


def _usual(output: Output, is_path: bool) -> tuple[Format, ...]:
    return _kind_formats(output).moving if is_path else _kind_formats(output).stills


def _format(name: str) -> Format:
    for known in FORMATS:
        if name == known:
            return known
    hint = did_you_mean(name, FORMATS, likeness=0.5, form=" ({})")
    raise ConfigError(f"there is no format {name!r}{hint}; known are {', '.join(FORMATS)}")


def _suited(output: Output, wanted: Sequence[Format]) -> list[Format]:
    known = _kind_formats(output).suited
    suited: list[Format] = [one for one in wanted if one in known]
    if not suited:
        reason = _REASONS.get((output.kind, wanted[0]), "the format does not suit it")
        raise ConfigError(
            f"{output.name} can't be written as {' or '.join(wanted)}: {reason}. "
            f"Formats for {output.name}: {', '.join(known)}"
        )
    return suited


def _refuse_same_files(outputs: Sequence[Output]) -> None:
    seen: dict[str, str] = {}
    for output in outputs:
        name = file_name(output)
        if name in seen:
            raise ConfigError(
                f"the outputs {seen[name]} and {output.name} would have the same files; ask for one of them"
            )
        seen[name] = output.name
