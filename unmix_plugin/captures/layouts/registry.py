"""The layouts by name. Each is a function from a folder to a `Capture`, imported when it is used."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TypeAlias

import numpy as np
from jaxtyping import Float64

from unmix_plugin.captures.capture import Capture
from unmix_plugin.captures.readers.read_options import Axes, ReadOptions
from unmix_plugin.errors import CaptureError


@dataclass(frozen=True)
class LayoutOptions:
    """What a user says about the files of a capture."""

    wavelengths_nm: Float64[np.ndarray, " B"] | None = None
    """Band centres in nm, in the order of the files; they replace what the files say."""
    dataset: str | None = None
    """Data set to take from files that hold several."""
    axes: Axes | None = None
    """Order of the axes in files that don't fix it."""
    exclude: tuple[Path, ...] = ()
    """Files in the folder that are not views, such as dark and white references."""

    @property
    def read(self) -> ReadOptions:
        """What the readers get."""
        return ReadOptions(self.dataset, self.wavelengths_nm, self.axes)


FindViews: TypeAlias = Callable[[Path, LayoutOptions], Capture]
"""Finds the views below a folder; raises CaptureError where there are none or they can't be opened."""

_FUNCTIONS = {
    "cubes": "cubes:find_cubes",
    "nespof": "nespof:find_nespof",
    "nespof-real": "nespof_real:find_nespof_real",
    "hs-nerf": "unmix_nerf:find_hs_nerf",
    "unmix-nerf": "unmix_nerf:find_unmix_nerf",
    "nerfstudio": "nerfstudio:find_nerfstudio",
    "rig": "rig:find_rig",
}
"""Module in this package, and the function in it."""

LAYOUTS = tuple(_FUNCTIONS)


def find_views(layout: str, root: Path, options: LayoutOptions) -> Capture:
    """The views of a capture in one of `LAYOUTS`.

    Raises:
        CaptureError: there is no such folder, or the layout finds no views in it.
    """
    if not root.is_dir():
        found = "is a file" if root.is_file() else "is not there"
        raise CaptureError(f"{root} {found}; give the folder of the capture with --data")
    module, function = _FUNCTIONS[layout].split(":")
    find: FindViews = getattr(import_module(f"unmix_plugin.captures.layouts.{module}"), function)
    return find(root, options)
