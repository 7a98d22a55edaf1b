"""Files of an unmixed image: spectra as a table and a plot, abundances and confidence as ENVI cubes and as maps.

Notation: `H x W` pixels, `B` bands, `K` materials.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64, Int

from unmix_plugin.engine.outputs import Output
from unmix_plugin.engine.runs.replacing import remove
from unmix_plugin.figures.paint import paint, scale_of
from unmix_plugin.figures.pictures import Picture, TitledPicture, draw_panels, in_rows
from unmix_plugin.figures.plotting import distinct_colours, own_colours
from unmix_plugin.formats.envi import envi_cube_paths, write_envi_cube
from unmix_plugin.formats.files import csv_bytes, make_folder, write_file
from unmix_plugin.products.endmembers import angles_csv, draw_spectra, write_intervals
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.features import NoiseFractions
from unmix_plugin.spectral.library.material_library import MaterialLibrary
from unmix_plugin.spectral.library.spectra_csv import SpectraTable, write_spectra_csv
from unmix_plugin.spectral.unmixing.image import UnmixedImage

_FIRST_COLOURS = np.array(
    [[0.8, 0.3, 0.2], [0.2, 0.6, 0.3], [0.2, 0.4, 0.8], [0.8, 0.6, 0.1], [0.6, 0.3, 0.7]]
)


def unmixed_image_paths(folder: Path, has_library: bool, has_fractions: bool) -> list[Path]:
    """Files that `write_unmixed_image` makes."""
    cubes = [
        path for name in ("abundances", "intervals", "confidence") for path in envi_cube_paths(folder / name)
    ]
    cubes += [folder / "angles.csv"] if has_library else []
    cubes += [*envi_cube_paths(folder / "mnf"), folder / "mnf.csv"] if has_fractions else []
    tables = ("endmembers.csv", "endmembers-intervals.csv", "endmembers.png", "maps.png")
    return [*(folder / name for name in tables), *cubes]


def write_unmixed_image(
    folder: Path,
    found: UnmixedImage,
    wavelengths_nm: Float64[np.ndarray, " B"] | None,
    numbers: Int[np.ndarray, " B"],
    on_map: Mapping[str, str] | None,
    library: MaterialLibrary | None,
    fractions: NoiseFractions | None,
) -> list[str]:
    """Write everything, and return the materials' names.

    Args:
        folder, found: Where and what.
        wavelengths_nm, numbers: Of the bands, strictly increasing if known, and from 1 in the file.
        on_map: Where the image lies, as entries of an ENVI header.
        library: Known spectra to which angles are written, where wavelengths are known.
        fractions: Minimum noise fractions, if asked for.
    """
    make_folder(folder)
    names = [f"material {number}" for number in range(1, len(found.endmembers) + 1)]
    spectra = found.endmembers.astype(np.float64)
    bands = None if wavelengths_nm is None else Bands.of(wavelengths_nm)
    of_endmembers = found.endmember_interval()
    if bands is None:
        x, x_label, own = numbers, "band", np.resize(_FIRST_COLOURS, (len(names), 3))
        rows = [
            [number, *(f"{value:.9g}" for value in row)] for number, row in zip(x, spectra.T, strict=True)
        ]
        write_file(folder / "endmembers.csv", csv_bytes([["band", *names], *rows]))
        remove(folder / "endmembers-intervals.csv")  # its columns are spectra over wavelengths
    else:
        x, x_label = bands.centers_nm, "wavelength (nm)"
        own = own_colours(torch.from_numpy(spectra / max(float(spectra.max()), 1e-12)), bands)
        write_spectra_csv(folder / "endmembers.csv", SpectraTable(bands, tuple(names), spectra))
        write_intervals(folder / "endmembers-intervals.csv", bands, names, of_endmembers)
    colours, labels = distinct_colours(own), (x_label, "value in the image's unit")
    write_file(folder / "endmembers.png", draw_spectra(spectra, x, names, colours, labels, of_endmembers))
    write_file(folder / "maps.png", _maps(found, names, colours))
    about = f"abundances: shares of {found.shares}, 0 to 1"
    write_envi_cube(folder / "abundances", found.abundances, None, names, about, on_map)
    interval = found.interval()
    ends = np.concatenate([interval.low, interval.high], axis=-1).astype(np.float32)
    end_names = [f"{name}{end}" for end in ("_low", "_high") for name in names]
    reason = (
        f"not determined: {interval.not_determined}" if interval.not_determined else "NaN without abundances"
    )
    about = f"ends of the {interval.coverage:.0%} intervals of abundances; {reason}"
    write_envi_cube(folder / "intervals", ends, None, end_names, about, on_map)
    trust = np.stack([found.confidence, found.misfit], axis=-1)
    about = (
        "probability that the largest abundance is the largest in truth; angle between pixel and mixture, rad"
    )
    write_envi_cube(folder / "confidence", trust, None, ["confidence", "misfit"], about, on_map)
    if library is not None and bands is not None:
        write_file(folder / "angles.csv", angles_csv(library, names, spectra, bands, None))
    if fractions is not None:
        cube = fractions.components.numpy().astype(np.float32)
        fraction_names = [f"MNF {number}" for number in range(1, cube.shape[2] + 1)]
        about = "minimum noise fractions: noise 1; 0 where nothing was measured"
        write_envi_cube(folder / "mnf", cube, None, fraction_names, about, on_map)
        ratios = enumerate(fractions.signal_to_noise.tolist(), 1)
        table = [("component", "signal to noise"), *((number, f"{ratio:.9g}") for number, ratio in ratios)]
        write_file(folder / "mnf.csv", csv_bytes(table))
    return names


def _maps(found: UnmixedImage, names: list[str], colours: np.ndarray) -> bytes:
    """A map of each material, the main materials in their colours, and confidence."""
    output = Output("share", "map", "share", f"share of {found.shares}, or probability", (0.0, 1.0))

    def painted(values: np.ndarray) -> Picture:
        return paint(output, values, np.ones(values.shape)).picture()

    panels = [
        TitledPicture(painted(found.abundances[..., index]), name, colours[index])
        for index, name in enumerate(names)
    ]
    shown = found.abundances.sum(axis=-1, keepdims=True) > 0
    main = np.where(shown, colours[found.abundances.argmax(axis=-1)], 0.9)
    panels.append(TitledPicture(main, "main material"))
    panels.append(TitledPicture(painted(found.confidence), "confidence"))
    return draw_panels(
        in_rows(panels), "Abundances", scale_of(output), list(zip(names, colours, strict=True))
    )
