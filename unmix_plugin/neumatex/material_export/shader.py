"""The decoder of neural materials for other programs: GLSL that stands alone, and the same numbers as JSON."""

from __future__ import annotations

import json
from importlib.resources import files
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from unmix_plugin.formats.files import make_folder, write_file
from unmix_plugin.neumatex.materials import dust, layer_stack, sheen
from unmix_plugin.neumatex.materials.albedos import ggx_table, mean_ggx_albedo, sheen_table
from unmix_plugin.neumatex.materials.neural import NeuralFamily

_PLACE = "//@constants"
_NUMBERS_A_LINE = 8


def shader_paths(folder: Path) -> list[Path]:
    """Files that `write_shader` makes."""
    return [folder / "decoder.glsl", folder / "decoder.json"]


def write_shader(folder: Path, family: NeuralFamily) -> list[Path]:
    """Write `decoder.glsl`, a function `reflectance` with all its numbers, and `decoder.json`, the numbers.

    Raises:
        RunError: the disk is full or refuses.
    """
    constants = decoder_constants(family)
    text, numbers = shader_paths(make_folder(folder))
    write_file(text, shader_text(constants).encode())
    about = (
        "numbers of decoder.glsl, by the same names; matrices row after row, tables a row for each roughness"
    )
    return [text, write_file(numbers, json.dumps({"about": about, **constants}).encode())]


def decoder_constants(family: NeuralFamily) -> dict[str, Any]:
    """Every number that the shader needs, by its name there: ints, floats, and lists of floats."""
    layers = [*family.decoder.hidden, family.decoder.last]
    constants: dict[str, Any] = {
        "LATENTS": layers[0].weight.shape[1],
        "WIDTH": layers[0].weight.shape[0],
        "OUTPUTS": layers[2].weight.shape[0],
    }
    for index, layer in enumerate(layers):
        constants[f"WEIGHT_{index}"] = _floats(layer.weight)
        constants[f"BIAS_{index}"] = _floats(layer.bias)
    ggx, white = ggx_table(), sheen_table()
    means = mean_ggx_albedo(torch.linspace(0, 1, ggx.shape[0])[None])
    nodes = tuple(dust._NODES), tuple(dust._WEIGHTS)
    return {
        **constants,
        "LARGEST_COVER": dust.LARGEST_COVER,
        "LARGEST_SHEEN": layer_stack.LARGEST_SHEEN,
        "LARGEST_COAT_ROUGHNESS": layer_stack.LARGEST_COAT_ROUGHNESS,
        "LARGEST_HAZE": layer_stack.LARGEST_HAZE,
        "LARGEST_DIELECTRIC_F0": layer_stack.LARGEST_DIELECTRIC_F0,
        "SMALLEST_SHEEN_WIDTH": sheen._SMALLEST_WIDTH,
        "DUST_COLOUR": list(dust.DUST_COLOUR),
        "NODES": len(nodes[0]),
        "NODE_PLACES": list(nodes[0]),
        "NODE_WEIGHTS": list(nodes[1]),
        "ROWS": ggx.shape[0],
        "COLUMNS": ggx.shape[1],
        "GGX_A": _floats(ggx[..., 0]),
        "GGX_B": _floats(ggx[..., 1]),
        "GGX_MEAN_A": _floats(means[0]),
        "GGX_MEAN_B": _floats(means[1]),
        "SHEEN": _floats(white[..., 0]),
    }


def shader_text(constants: dict[str, Any]) -> str:
    """The shader with its constants."""
    template = (
        files("unmix_plugin.neumatex.material_export").joinpath("decoder.glsl").read_text(encoding="utf-8")
    )
    assert _PLACE in template
    declared = [_declaration(name, value) for name, value in constants.items()]
    return template.replace(_PLACE, "\n".join(declared))


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
