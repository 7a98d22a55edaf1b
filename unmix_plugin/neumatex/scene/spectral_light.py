"""What is known of the light of pictures of many bands: their wavelengths, and the lamp's spectrum.

Notation: `B` bands.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from unmix_plugin.errors import SceneError
from unmix_plugin.neumatex.lighting.environment import Environment
from unmix_plugin.neumatex.lighting.lamp import mean_spectrum, read_lamp
from unmix_plugin.neumatex.scene.posed_pictures import PosedPictures
from unmix_plugin.scenes.reading.faults import Faults, resolve_path
from unmix_plugin.scenes.reading.transforms_json import FILE_NAME, SceneEntry
from unmix_plugin.spectral.bands import Bands

_NUM_COLOURS = 3


@dataclass(frozen=True)
class SpectralLight:
    """Bands and lamp of spectral pictures."""

    bands: Bands
    lamp: Float64[np.ndarray, " B"] | None
    """Relative power, greatest 1; None where it is not given."""

    def lamp_of(self, environment: Environment) -> Float64[np.ndarray, " B"]:
        """The lamp; the environment's mean spectrum where none is given."""
        return mean_spectrum(environment).double().numpy() if self.lamp is None else self.lamp

    def of_held_out(self, folder: Path, entry: SceneEntry, pictures: PosedPictures) -> SpectralLight:
        """The same bands, lit by the held-out light's own lamp where it has one.

        Raises:
            SceneError: its pictures have other bands.
        """
        own = entry.wavelengths_nm
        if pictures.num_colours != len(self.bands) or (own is not None and Bands(own) != self.bands):
            raise SceneError(
                f"{folder}: pictures of {pictures.num_colours} bands"
                + ("" if own is None else f", wavelengths of {Bands(own)}")
                + f"; the object has {self.bands}: give the same"
            )
        lamp = _own_lamp(folder, entry, self.bands)
        return self if lamp is None else replace(self, lamp=lamp)


def spectral_light(
    root: Path, entry: SceneEntry, pictures: PosedPictures, lamp: str | None
) -> SpectralLight | None:
    """Bands and lamp of an object's pictures; None for pictures in colours.

    Args:
        root: The object's folder.
        entry: Its transforms.json.
        pictures: Its pictures.
        lamp: What to take instead of the folder's lamp; see `read_lamp`.
    Raises:
        SceneError: pictures of more than three colours without wavelengths, or with another number of them; display
            pictures; a lamp for pictures in colours.
        SpectrumError: the lamp can't be read, or is not known at all bands.
    """
    found, count = entry.wavelengths_nm, pictures.num_colours
    if count == _NUM_COLOURS and (found is None or len(found) != count):
        if lamp is not None:
            raise SceneError(f"{root}: a lamp is given, but its pictures have {count} colours; leave it out")
        return None
    if found is None or len(found) != count:
        given = "no 'wavelengths'" if found is None else f"{len(found)} 'wavelengths'"
        raise SceneError(
            f"{root / FILE_NAME}: {given} for pictures of {count} bands; list the centre of each band in nm"
        )
    if pictures.tone != "linear":
        raise SceneError(
            f"{root / FILE_NAME}: pictures of {count} bands with 'tone_mapping' {pictures.tone}; expected linear light"
        )
    bands = Bands(found)
    return SpectralLight(bands, _own_lamp(root, entry, bands) if lamp is None else read_lamp(lamp, bands))


def _own_lamp(root: Path, entry: SceneEntry, bands: Bands) -> Float64[np.ndarray, " B"] | None:
    """What 'illuminant_path' names; None where there is none."""
    if entry.illuminant_path is None:
        return None
    faults = Faults(root)
    path = resolve_path(root, entry.illuminant_path, None, "'illuminant_path'", faults)
    faults.raise_if_any()
    return None if path is None else read_lamp(str(path), bands)
