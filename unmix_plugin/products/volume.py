"""Density and abundances on a regular grid, as an .npz.

Notation: `X x Y x Z` grid points, `K` endmembers, `B` bands.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from unmix_plugin.engine.runs.atomic_files import whole_file, write_errors_as
from unmix_plugin.products.product import Job
from unmix_plugin.products.scene_products import Volume
from unmix_plugin.scenes.scene import Normalisation
from unmix_plugin.trained.run_views import affine_to_world
from unmix_plugin.trained.surface import GridPoints, sample_field
from unmix_plugin.trained.trained_scene import TrainedScene

_FASTEST = 1
"""Compression that the disk doesn't wait for; most of a volume is empty and shrinks to nothing anyway."""


def export(job: Job, asked: Volume) -> list[Path]:
    """Sample the field, slice by slice."""
    grid, path = GridPoints.over(job.scene.scene_box.aabb, asked.resolution), job.folder / "volume.npz"
    job.claim([path])
    write_volume(path, job.scene, grid, job.frame, job.follow("sampling the field", range(grid.shape[0])))
    return [path]


def write_volume(
    path: Path, scene: TrainedScene, grid: GridPoints, frame: Normalisation, slices: Iterable[int]
) -> None:
    """Write a volume, of which one slice is in memory at a time, and all densities.

    Arrays: `density` (X, Y, Z) float32 per world unit; `abundances` (X, Y, Z, K) float32, summing to 1; both are 0 in
    cells that are never rendered. `index_to_world` (4, 4) float64 leads from (i, j, k, 1) to world points, of which a
    unit is `metres_per_unit` long (NaN where unknown).
    `endmember_names`, `endmembers` (K, B) float32 and `wavelengths_nm` (B,) say what the abundances are of.
    """
    materials = scene.materials
    density = np.zeros(grid.shape, dtype=np.float32)
    others = {
        "index_to_world": affine_to_world(frame, grid.origin.astype(np.float64), grid.cell),
        "metres_per_unit": np.array(np.nan if scene.scale is None else scene.scale.metres_per_unit),
        "endmember_names": np.array(materials.names),
        "endmembers": materials.endmembers.detach().cpu().numpy().astype(np.float32),
        "wavelengths_nm": np.asarray(materials.bands.centers_nm),
    }
    with (
        whole_file(path) as temporary,
        write_errors_as(path),
        zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED, compresslevel=_FASTEST) as archive,
    ):
        with archive.open("abundances.npy", "w", force_zip64=True) as stream:
            shape = (*grid.shape, len(materials.names))
            np.lib.format.write_array_header_1_0(
                stream, {"descr": "<f4", "fortran_order": False, "shape": shape}
            )
            for index in slices:
                found, abundances = sample_field(scene, grid.slice_points(index))
                density[index] = found.numpy() * np.float32(frame.scale)
                stream.write(np.ascontiguousarray(abundances.numpy(), dtype="<f4").tobytes())
        for name, values in {"density": density, **others}.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
                np.lib.format.write_array(stream, values, allow_pickle=False)
