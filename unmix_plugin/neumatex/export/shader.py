"""The decoder of neural materials for other programs: GLSL that stands alone, and the same numbers as JSON."""

from __future__ import annotations

import json
from importlib.resources import files
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from unmix_plugin.formats.files import make_folder, write_file
from unmix_plugin.neumatex.tracing import layers
from unmix_plugin.neumatex.tracing.neural import NeuralFamily

_PLACE = "//@constants"
_NUMBERS_A_LINE = 8
_SCALARS = tuple(f"LARGEST_{name}" for name in ("COVER", "SHEEN", "COAT_ROUGHNESS", "HAZE", "DIELECTRIC_F0"))
_SCALARS += ("SMALLEST_SHEEN_WIDTH",)
"""Constants of the layers that the shader has by the same names."""


def shader_paths(folder: Path) -> list[Path]:
    """Files that `write_shader` makes."""
    return [folder / "decoder.glsl", folder / "decoder.json"]


def write_shader(folder: Path, family: NeuralFamily) -> list[Path]:
    """Write `decoder.glsl`, a function `reflectance` with all its numbers, and `decoder.json`, the numbers."""
    constants = _decoder_constants(family)
    text, numbers = shader_paths(make_folder(folder))
    template = files("unmix_plugin.neumatex.export").joinpath("decoder.glsl").read_text(encoding="utf-8")
    assert _PLACE in template
    declared = "\n".join(_declaration(name, value) for name, value in constants.items())
    about = (
        "numbers of decoder.glsl, by the same names; matrices row after row, tables a row for each roughness"
    )
    return [
        write_file(text, template.replace(_PLACE, declared).encode()),
        write_file(numbers, json.dumps({"about": about, **constants}).encode()),
    ]


def _decoder_constants(family: NeuralFamily) -> dict[str, Any]:
    """Every number that the shader needs, by its name there: ints, floats, and lists of floats."""
    linear = [*family.decoder.hidden, family.decoder.last]
    constants: dict[str, Any] = {
        "LATENTS": linear[0].weight.shape[1],
        "WIDTH": linear[0].weight.shape[0],
        "OUTPUTS": linear[2].weight.shape[0],
    }
    for index, layer in enumerate(linear):
        constants[f"WEIGHT_{index}"] = _floats(layer.weight)
        constants[f"BIAS_{index}"] = _floats(layer.bias)
    ggx, white = layers.ggx_table(), layers.sheen_table()
    means = layers.mean_ggx_albedo(torch.linspace(0, 1, ggx.shape[0])[None])
    return {
        **constants,
        **{name: getattr(layers, name) for name in _SCALARS},
        "DUST_COLOUR": list(layers.DUST_COLOUR),
        "NODES": len(layers.DUST_NODES),
        "NODE_PLACES": list(layers.DUST_NODES),
        "NODE_WEIGHTS": list(layers.DUST_WEIGHTS),
        "ROWS": ggx.shape[0],
        "COLUMNS": ggx.shape[1],
        "GGX_A": _floats(ggx[..., 0]),
        "GGX_B": _floats(ggx[..., 1]),
        "GGX_MEAN_A": _floats(means[0]),
        "GGX_MEAN_B": _floats(means[1]),
        "SHEEN": _floats(white[..., 0]),
    }


def _floats(values: Tensor) -> list[float]:
    """Float32 numbers in as few digits as give them back."""
    return [float(f"{value:.9g}") for value in values.detach().float().reshape(-1).tolist()]


def _declaration(name: str, value: Any) -> str:
    if isinstance(value, int):
        return f"const int {name} = {value};"
    if isinstance(value, float):
        return f"const float {name} = {_glsl(value)};"
    if name == "DUST_COLOUR":
        return f"const vec3 {name} = vec3({', '.join(map(_glsl, value))});"
    rows = [value[start : start + _NUMBERS_A_LINE] for start in range(0, len(value), _NUMBERS_A_LINE)]
    numbers = ",\n  ".join(", ".join(map(_glsl, row)) for row in rows)
    return f"const float {name}[{len(value)}] = float[{len(value)}](\n  {numbers});"


def _glsl(value: float) -> str:
    """A number that GLSL reads as a float: with a point or an exponent."""
    text = f"{value:.9g}"
    return text if "." in text or "e" in text else f"{text}.0"
