"""Tensors that torch.save wrote: read with weights_only, which loads no code."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from unmix_plugin.captures.readers.found_arrays import FoundArray
from unmix_plugin.captures.readers.image_of_arrays import image_of_arrays
from unmix_plugin.captures.readers.read_options import ReadOptions
from unmix_plugin.captures.spectral_file import SpectralFile
from unmix_plugin.errors import CaptureError


def open_torch(path: Path, options: ReadOptions) -> SpectralFile:
    """Open a tensor, or the image among the tensors of a dictionary.

    Raises:
        CaptureError: the file is damaged, holds other objects than tensors, or none can be the image.
    """
    return image_of_arrays(
        path, "torch", [_found(path, name, tensor) for name, tensor in _tensors(path)], options
    )


def _tensors(path: Path) -> list[tuple[str, Any]]:
    """Tensors by name, mapped where the file allows it."""
    import pickle

    import torch

    try:
        content = _load(path)
    except pickle.UnpicklingError as error:
        raise CaptureError(
            f"{path}: holds other objects than tensors, which are never loaded because they can run code; "
            "save a plain tensor with torch.save"
        ) from error
    named = content.items() if isinstance(content, dict) else [("", content)]
    return [(str(name), value) for name, value in named if isinstance(value, torch.Tensor)]


def _load(path: Path) -> Any:
    import torch

    with path.open("rb") as file:
        is_mappable = file.read(2) == b"PK"
    return torch.load(path, map_location="cpu", weights_only=True, mmap=is_mappable)


def _found(path: Path, name: str, tensor: Any) -> FoundArray:
    numbers = _numbers(tensor[:0] if tensor.ndim else tensor)

    def whole() -> np.ndarray:
        return _numbers(dict(_tensors(path))[name])

    return FoundArray(name, tuple(tensor.shape), numbers.dtype, whole)


def _numbers(tensor: Any) -> np.ndarray:
    """As an array; what NumPy has no type for becomes float32."""
    import torch

    tensor = tensor.detach()
    return (tensor.float() if tensor.dtype == torch.bfloat16 else tensor.resolve_neg()).numpy()
