"""`unmix-export endmembers`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from unmix_plugin.commands.products.product import Job, Product


@dataclass(frozen=True)
class Endmembers(Product):
    """Spectra of the endmembers: endmembers.csv, the ENVI spectral library endmembers.hdr and .sli, and a plot over
    wavelength, endmembers.png."""

    name = "endmembers"

    def write(self, job: Job) -> list[Path]:
        """Write table, library and plot."""
        from unmix_plugin.products.endmembers import endmember_paths, write_endmembers

        materials = job.materials
        job.claim(endmember_paths(job.folder))
        return write_endmembers(job.folder, materials)
