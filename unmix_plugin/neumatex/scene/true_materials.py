"""True endmembers and abundances of an object's spectral pictures, where a folder has them.

Notation: `H x W` pixels, `B` bands, `M` true materials.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64

from unmix_plugin.errors import SceneError
from unmix_plugin.neumatex.scene.spectral_light import SpectralLight
from unmix_plugin.scenes.reading.cubes import UnreadableArrayError, map_array
from unmix_plugin.scenes.reading.faults import Faults, resolve_path
from unmix_plugin.scenes.reading.loader import read_endmembers
from unmix_plugin.scenes.reading.transforms_json import SceneEntry


@dataclass(frozen=True)
class TrueMaterials:
    """What an object is really made of."""

    names: tuple[str, ...]
    endmembers: Float64[np.ndarray, "M B"]
    """Reflectances."""
    abundance_files: tuple[Path | None, ...]
    """One a view."""

    def abundances(self, view: int) -> Float32[np.ndarray, "H W M"] | None:
        """True abundances of a view's pixels; None where they are unknown.

        Raises:
            SceneError: the file can't be read, or has another number of materials.
        """
        path = self.abundance_files[view]
        if path is None:
            return None
        try:
            found = np.array(map_array(path), dtype=np.float32)
        except UnreadableArrayError as error:
            raise SceneError(f"{path} {error}") from error
        if found.ndim != 3 or found.shape[2] != len(self.names):
            raise SceneError(
                f"{path}: has shape {found.shape}; expected rows x columns x {len(self.names)} materials"
            )
        return found


def read_true_materials(
    root: Path, entry: SceneEntry, spectral: SpectralLight | None
) -> TrueMaterials | None:
    """What 'endmembers_path' and each frame's 'abundance_file_path' name; None without spectra or endmembers.

    Raises:
        SceneError: a file is missing, or does not fit the bands.
    """
    if spectral is None or entry.endmembers_path is None:
        return None
    faults = Faults(root)
    path = resolve_path(root, entry.endmembers_path, None, "'endmembers_path'", faults)
    table = None
    if path is not None:
        centers = spectral.bands.centers_nm
        table = read_endmembers(path, centers, entry.materials, "'endmembers_path'", faults)
    files = tuple(
        resolve_path(root, frame.paths["abundance_file_path"], None, frame.where, faults)
        if "abundance_file_path" in frame.paths
        else None
        for frame in entry.frames
    )
    faults.raise_if_any()
    assert table is not None
    return TrueMaterials(table.names, table.spectra, files)
