"""Pure spectral maths on tensors: bands last, wavelengths in nm. Knows no scene, no model and no file but CSV.

Importing this package costs torch and numpy; scipy, scikit-image and colour-science are imported by the functions that
need them.
"""

from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import (
    band_composite_matrix,
    colour_mode,
    describe_colour,
    linear_to_srgb,
    rgb_matrix,
    srgb_to_linear,
    xyz_matrix,
)
from unmix_plugin.spectral.library.spectra_csv import (
    SpectraTable,
    read_illuminant_csv,
    read_spectra_csv,
    resample_spectra,
    write_spectra_csv,
)
from unmix_plugin.spectral.metrics import (
    EndmemberMatching,
    abundance_rmse,
    endmember_angle,
    match_endmembers,
    psnr,
    rgb_psnr,
    rmse,
    sam,
    spectral_angle,
    ssim,
)
from unmix_plugin.spectral.segmentation import (
    SegmentationScores,
    SegmentationTally,
    material_ids,
    material_scores,
)
from unmix_plugin.spectral.unmixing.abundance_estimation import fcls, nnls, sunsal
from unmix_plugin.spectral.unmixing.endmembers import (
    EndmemberMethod,
    drop_uninformative_pixels,
    initialise_endmembers,
)
from unmix_plugin.spectral.unmixing.kmeans_normalised import (
    KmeansResult,
    normalised_kmeans,
    scale_to_lit_pixels,
)
from unmix_plugin.spectral.unmixing.minimum_volume import minimum_volume_simplex
from unmix_plugin.spectral.unmixing.nfindr_winter1999 import nfindr, simplex_volume
from unmix_plugin.spectral.unmixing.num_materials import MaterialCount, hysime, propose_num_materials
from unmix_plugin.spectral.unmixing.pixel_unmixing import comparable_brightness, unmix_pixels
from unmix_plugin.spectral.unmixing.two_material_mixtures import (
    TwoMaterialFit,
    two_material_endmembers,
    two_material_fits,
)
from unmix_plugin.spectral.unmixing.vca_nascimento2005 import VcaResult, estimate_snr_db, vca

__all__ = [
    "Bands",
    "EndmemberMatching",
    "EndmemberMethod",
    "KmeansResult",
    "MaterialCount",
    "SegmentationScores",
    "SegmentationTally",
    "SpectraTable",
    "TwoMaterialFit",
    "VcaResult",
    "abundance_rmse",
    "band_composite_matrix",
    "colour_mode",
    "comparable_brightness",
    "describe_colour",
    "drop_uninformative_pixels",
    "endmember_angle",
    "estimate_snr_db",
    "fcls",
    "hysime",
    "initialise_endmembers",
    "linear_to_srgb",
    "match_endmembers",
    "material_ids",
    "material_scores",
    "minimum_volume_simplex",
    "nfindr",
    "nnls",
    "normalised_kmeans",
    "propose_num_materials",
    "psnr",
    "read_illuminant_csv",
    "read_spectra_csv",
    "resample_spectra",
    "rgb_matrix",
    "rgb_psnr",
    "rmse",
    "sam",
    "scale_to_lit_pixels",
    "simplex_volume",
    "spectral_angle",
    "srgb_to_linear",
    "ssim",
    "sunsal",
    "two_material_endmembers",
    "two_material_fits",
    "unmix_pixels",
    "vca",
    "write_spectra_csv",
    "xyz_matrix",
]
