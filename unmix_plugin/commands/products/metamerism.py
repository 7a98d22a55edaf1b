"""`unmix-export metamerism`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from unmix_plugin.commands.products.product import Job, Product


@dataclass(frozen=True)
class Metamerism(Product):
    """Pairs of materials that look alike in one light and differ in another, as an eye adapted to each light sees them:
    metamerism.csv, the pairs with their differences, and metamerism.png, swatches."""

    name = "metamerism"

    surfaces: Literal["run", "library", "all"] = "all"
    """Pair the run's endmembers, materials of the library, or both together."""
    lights: tuple[str, ...] = ("D65", "A", "FL2", "FL11")
    """Lights to compare: CIE illuminants, lamps or .csv files (wavelength,power)."""
    alike: float = 2.0
    """Colour difference (CIEDE2000) up to which two materials look alike."""
    different: float = 4.0
    """Colour difference from which they look different."""
    library: tuple[Path, ...] = ()
    """CSV files or ENVI spectral libraries with reflectances of your own, beside the measured ones."""

    def write(self, job: Job) -> list[Path]:
        """Compare all pairs in all lights."""
        import numpy as np

        from unmix_plugin.products.metamerism import (
            MetamerismOptions,
            find_metamers,
            metamerism_paths,
            write_metamerism,
        )
        from unmix_plugin.spectral.library.material_library import library_with

        job.claim(metamerism_paths(job.folder))
        light = job.loaded.scene.metadata.get("illuminant")
        options = MetamerismOptions(self.lights, self.surfaces, self.alike, self.different)
        with job.working("comparing colours"):
            found = find_metamers(
                job.materials, None if light is None else np.array(light), library_with(self.library), options
            )
            written = write_metamerism(job.folder, found)
        job.say(
            f"{len(found.pairs)} pairs of {len(found.names)} materials, seen in {', '.join(found.lights)}"
        )
        return written
