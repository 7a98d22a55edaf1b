"""What is written of a render: which outputs there are, which formats suit each, and what each is by default.

Notation: `H x W` pixels, `B` bands, `K` endmembers.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from unmix_plugin.errors import ConfigError, did_you_mean
from unmix_plugin.spectral.maps.reflectance_maps import is_reflectance_map, parse_reflectance_map
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.trained.outputs import find_output

Format = Literal["envi", "exr", "npy", "png", "mp4"]
FORMATS: tuple[Format, ...] = ("envi", "exr", "npy", "png", "mp4")

_LONGEST_FILE_NAME = 100

EVERY_OUTPUT = "all"
"""Stands for every output that takes no argument."""


@dataclass(frozen=True)
class OutputKind:
    """Outputs that are written alike."""

    name: Literal["spectra", "shares", "srgb", "light", "picture", "radiance", "map", "labels", "vectors"]
    """Spectra (H, W, B); shares of the endmembers (H, W, K); sRGB, or linear light, on black (H, W, 3); a picture that
    is not multiplied by opacity (H, W, 3); radiance of a band, or any other number (H, W); ids (H, W); unit vectors
    (H, W, 3)."""
    formats: tuple[Format, ...]
    """Formats that suit it."""
    stills: tuple[Format, ...]
    """Formats that it gets where none are asked for, of single views."""
    moving: tuple[Format, ...]
    """The same where views follow each other."""


_SPECTRA = OutputKind("spectra", ("envi", "exr", "npy", "mp4"), ("envi",), ("envi",))
_SHARES = OutputKind("shares", ("envi", "exr", "npy", "png", "mp4"), ("envi", "png"), ("mp4",))
_SRGB = OutputKind("srgb", ("png", "npy", "envi", "mp4"), ("png",), ("mp4",))
_LIGHT = OutputKind("light", ("exr", "npy", "envi", "png", "mp4"), ("exr",), ("mp4",))
_COMPOSITE = OutputKind("light", ("png", "exr", "npy", "envi", "mp4"), ("png",), ("mp4",))
_PICTURE = OutputKind("picture", ("png", "npy", "envi", "mp4"), ("png",), ("mp4",))
_RADIANCE = OutputKind("radiance", ("png", "npy", "exr", "envi", "mp4"), ("png", "npy"), ("mp4",))
_MAP = OutputKind("map", ("png", "npy", "exr", "envi", "mp4"), ("png", "npy"), ("mp4",))
_LABELS = OutputKind("labels", ("png", "npy", "mp4"), ("png",), ("mp4",))
_VECTORS = OutputKind("vectors", ("png", "npy", "exr", "envi", "mp4"), ("png", "npy"), ("mp4",))

_NAMED: dict[str, tuple[OutputKind, str]] = {
    "spectral": (_SPECTRA, "radiance on black, 1 = full scale"),
    "diffuse": (_SPECTRA, "radiance without the view-dependent part, 1 = full scale"),
    "specular": (_SPECTRA, "view-dependent part of the radiance, 1 = full scale"),
    "rgb": (_SRGB, "sRGB on black, 0 to 1"),
    "linear_rgb": (_LIGHT, "linear light in sRGB primaries on black, 0 to 1"),
    "pca": (_PICTURE, "three principal components of the spectra, stretched alike in all views"),
    "abundances": (_SHARES, "abundances, summing to the opacity"),
    "material_scores": (_SHARES, "cosine of the spectrum to each endmember"),
    "probe_probabilities": (_SHARES, "softmax of the cosines of the spectrum to the endmembers"),
    "segmentation": (_LABELS, "index of the material, 255 where nothing is"),
    "confidence": (_MAP, "estimated probability that the material is right"),
    "depth": (_MAP, "distance along the viewing axis in world units, 0 where nothing is"),
    "ray_distance": (_MAP, "distance along the ray in world units, 0 where nothing is"),
    "accumulation": (_MAP, "opacity, 0 to 1"),
    "normals": (_VECTORS, "unit normals in world axes, 0 where nothing is"),
}

_WITH_WAVELENGTHS: dict[str, tuple[OutputKind, str, str]] = {
    "band": (_RADIANCE, "radiance of one band on black, 1 = full scale", "band:650nm"),
    "false-colour": (
        _COMPOSITE,
        "three bands as red, green and blue, radiance on black",
        "false-colour:860,650,550",
    ),
}

_REFLECTANCE_EXAMPLES = {"index": "index:ndvi", "target": "target:paint.csv"}

_REASONS = {
    ("spectra", "png"): "a PNG shows colours: ask for rgb, band:NMnm, false-colour:NM,NM,NM or pca",
    ("srgb", "exr"): "it is encoded for displays and EXR holds linear light: ask for linear_rgb",
    ("picture", "exr"): "it is made for displays and EXR holds linear light",
    ("labels", "envi"): "ids are written as PNG, with their palette, or .npy",
    ("labels", "exr"): "ids are written as PNG, with their palette, or .npy",
}


@dataclass(frozen=True)
class RenderOutput:
    """One output of a render."""

    name: str
    """As `get_outputs_for_camera` knows it."""
    kind: OutputKind
    what: str
    """What its numbers are, with their unit."""

    @property
    def file_name(self) -> str:
        """The name with whatever a file name had better not have replaced by `-`, without folders of a target's file.

        >>> RenderOutput("false-colour:860,650,550", _COMPOSITE, "").file_name
        'false-colour-860-650-550'
        """
        short = re.sub(r"[^:]*/", "", self.name) if self.name.startswith("target:") else self.name
        plain = re.sub(r"[^\w.+-]+", "-", short).strip("-.")
        if len(plain) <= _LONGEST_FILE_NAME:
            return plain
        return f"{plain[:_LONGEST_FILE_NAME]}-{hashlib.sha256(self.name.encode()).hexdigest()[:8]}"


@dataclass(frozen=True)
class Product:
    """An output in a format."""

    output: RenderOutput
    format: Format


def default_outputs(is_path: bool) -> tuple[str, ...]:
    """What is rendered where no outputs are asked for."""
    return ("rgb",) if is_path else ("spectral", "rgb", "abundances", "segmentation", "depth")


def choose_products(
    outputs: Sequence[str], formats: Sequence[str], materials: Materials, is_path: bool
) -> tuple[Product, ...]:
    """Every output in every asked format that suits it.

    Args:
        outputs: Names, or `all`.
        formats: Of `FORMATS`; none: what suits each output best.
        materials: Of the model; they decide which wavelengths there are.
        is_path: Whether views follow each other.
    Raises:
        ConfigError: an unknown output or format, a format that suits no output, or an output that no format suits.
        SpectrumError: a wavelength outside the bands.
    """
    chosen = [_output(name, materials) for name in dict.fromkeys(_expanded(outputs))]
    wanted: list[Format] = [_format(name) for name in dict.fromkeys(formats)]
    _refuse_same_files(chosen)
    products = [
        Product(output, one)
        for output in chosen
        for one in (
            _suited(output, wanted) if wanted else output.kind.moving if is_path else output.kind.stills
        )
    ]
    for one in wanted:
        if all(product.format != one for product in products):
            names = " or ".join(output.name for output in chosen)
            raise ConfigError(f"--formats {one} suits none of the outputs asked for: {names}")
    return tuple(products)


def _expanded(outputs: Sequence[str]) -> Iterable[str]:
    for name in outputs:
        if name == EVERY_OUTPUT:
            yield from _NAMED
        else:
            yield name


def _output(name: str, materials: Materials) -> RenderOutput:
    if name in _NAMED:
        kind, what = _NAMED[name]
        return RenderOutput(name, kind, what)
    prefix, _, argument = name.partition(":")
    if is_reflectance_map(name):
        return _reflectance_output(name, argument, materials)
    if prefix not in _WITH_WAVELENGTHS:
        known = [*_NAMED, *_WITH_WAVELENGTHS, *_REFLECTANCE_EXAMPLES, EVERY_OUTPUT]
        hint = did_you_mean(prefix, known, likeness=0.5, form=" ({})")
        examples = [example for _, _, example in _WITH_WAVELENGTHS.values()]
        examples += _REFLECTANCE_EXAMPLES.values()
        raise ConfigError(
            f"there is no output named {name!r}{hint}; known are {', '.join([*_NAMED, *examples, EVERY_OUTPUT])}"
        )
    kind, what, example = _WITH_WAVELENGTHS[prefix]
    if not argument:
        raise ConfigError(f"the output {prefix} needs wavelengths, as in {example}")
    find_output(name, materials)
    return RenderOutput(name, kind, f"{what}: {argument}")


def _reflectance_output(name: str, argument: str, materials: Materials) -> RenderOutput:
    kind = name.partition(":")[0]
    if not argument:
        raise ConfigError(f"the output {kind} needs to know which, as in {_REFLECTANCE_EXAMPLES[kind]}")
    what = parse_reflectance_map(name, materials.bands).what
    caveat = "" if materials.light is not None else "; of radiance, since the scene's light is unknown"
    return RenderOutput(name, _MAP, f"{what}{caveat}; NaN where undefined")


def _format(name: str) -> Format:
    for known in FORMATS:
        if name == known:
            return known
    hint = did_you_mean(name, FORMATS, likeness=0.5, form=" ({})")
    raise ConfigError(f"there is no format {name!r}{hint}; known are {', '.join(FORMATS)}")


def _suited(output: RenderOutput, wanted: Sequence[Format]) -> list[Format]:
    suited: list[Format] = [one for one in wanted if one in output.kind.formats]
    if not suited:
        reason = _REASONS.get((output.kind.name, wanted[0]), "the format does not suit it")
        raise ConfigError(
            f"{output.name} can't be written as {' or '.join(wanted)}: {reason}. "
            f"Formats for {output.name}: {', '.join(output.kind.formats)}"
        )
    return suited


def _refuse_same_files(outputs: Sequence[RenderOutput]) -> None:
    seen: dict[str, str] = {}
    for output in outputs:
        if output.file_name in seen:
            raise ConfigError(
                f"the outputs {seen[output.file_name]} and {output.name} would have the same files; ask for one of them"
            )
        seen[output.file_name] = output.name
