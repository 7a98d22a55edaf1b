"""What a user should know of captures that are pictures for people: how they are taken for measurements."""

from __future__ import annotations

from collections.abc import Sequence

from unmix_plugin.captures.calibration.linear import is_srgb
from unmix_plugin.captures.spectral_file import SpectralFile


def notes_on_pictures(files: Sequence[SpectralFile]) -> list[str]:
    """Notes on encoding, order of colours and orientation, one sentence each; none where there is no picture."""
    pictures = [file for file in files if file.reader == "picture"]
    notes = []
    if any(map(is_srgb, pictures)):
        notes.append("pictures are taken as sRGB and brought to linear light")
    notes += _order_of_colours(pictures)
    turned = sum(file.metadata.get("orientation", 1) != 1 for file in pictures)
    if turned:
        notes.append(
            f"EXIF's orientation of {turned} of {len(pictures)} pictures is ignored, as poses and lenses refer to the "
            "stored pixels; if yours were made from turned pictures, store these turned"
        )
    return notes


def _order_of_colours(pictures: Sequence[SpectralFile]) -> list[str]:
    for file in pictures:
        centres = file.bands.wavelengths_nm
        if centres is not None and len(centres) == 3 and centres[0] < centres[2]:
            red, green, blue = (f"{centre:g}" for centre in centres)
            note = (
                f"the channels of pictures are red, green and blue in this order: {red} nm is taken for red, "
                f"{green} nm for green, {blue} nm for blue. If this is wrong, give --wavelengths {blue},{green},{red}"
            )
            return [note]
    return []
