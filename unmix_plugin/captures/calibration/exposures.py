"""How long views and their references were exposed, and what becomes of it.

Notation: `b` is 1, or the bands of a file.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from unmix_plugin.captures.calibration.references import finished_by
from unmix_plugin.captures.spectral_file import SpectralFile
from unmix_plugin.errors import counted, name_some


def exposure_of(file: SpectralFile, to_light: bool = True) -> Float64[np.ndarray, " b"] | None:
    """Exposure time times gain, and over the square of the f-number if that is known, one number or one a band; None
    where the file does not say the time.

    Args:
        to_light: Whether the aperture counts, which lets in light but no dark current.
    """
    time, gain = file.metadata.get("exposure_s"), file.metadata.get("gain", 1.0)
    f_number = file.metadata.get("f_number", 1.0) if to_light else 1.0
    try:
        exposure = np.asarray(time, dtype=np.float64) * np.asarray(gain, dtype=np.float64)
        exposure = np.atleast_1d(exposure / f_number**2)
    except (TypeError, ValueError):
        return None
    is_usable = len(exposure) in (1, file.shape[2]) and np.isfinite(exposure).all() and (exposure > 0).all()
    return exposure if is_usable else None


@dataclass(frozen=True)
class Exposures:
    """What becomes of the exposures of views and references."""

    common: Float64[np.ndarray, " b"] | None = None
    """What all are brought to (see `exposure_of`), one number or one a band; None where exposures are not compared."""
    notes: tuple[str, ...] = ()
    """What was done."""
    warnings: tuple[str, ...] = ()
    """What may be wrong."""


def compare_exposures(
    views: Sequence[SpectralFile],
    whites: Sequence[SpectralFile],
    darks: Sequence[tuple[SpectralFile, SpectralFile]],
    is_bent: bool,
    may_be_finished: bool = False,
) -> Exposures:
    """The exposure of the white reference, to which views are brought; without one, that of the first view.

    Args:
        views: At least one.
        whites: References of all views, or one a view.
        darks: Each dark frame with a view or a white that it is subtracted from.
        is_bent: Whether the files are pictures for people, in which twice the exposure is not twice the number.
        may_be_finished: Whether values look like reflectances, which nothing is divided by but a reference.
    """
    known, of_whites = (
        [exposure for file in files if (exposure := exposure_of(file)) is not None]
        for files in (views, whites)
    )
    differs = len({tuple(exposure) for exposure in known}) > 1 or any(len(exposure) > 1 for exposure in known)
    apertures = {"f_number" in file.metadata for file in (*views, *whites) if exposure_of(file) is not None}
    unit = "s times gain over the square of the f-number" if True in apertures else "s times gain"
    taken = f"were exposed {_in_words(known)} {unit}" if known else ""
    finished = [finished_by(file, by_name=not whites) for file in views]
    if None not in finished and not is_bent:
        if not differs:
            return Exposures()
        kept = f"values are not divided by that, as {finished[0]} says that they are reflectance or radiance already"
        return Exposures(notes=(f"views {taken}: {kept}",))
    warnings, misfits = _missing_units([*views, *whites]), _misfits(views, whites)
    warnings += misfits
    if len(known) < len(views):
        missing = (
            f"{counted(len(views) - len(known), 'view')} without exposure time: exposures are not compared"
        )
        is_partial = bool(known or of_whites) and not misfits
        return Exposures(warnings=(*warnings, missing) if is_partial else tuple(warnings))
    if len(apertures) > 1:
        lacking = [file.path.name for file in (*views, *whites) if "f_number" not in file.metadata]
        unknown = f"the f-number of the lens is known of some files and not of {name_some(lacking)}"
        return Exposures(
            warnings=(*warnings, f"{unknown}: exposures are not compared; write it into all, or none")
        )
    if is_bent:
        bent = f"pictures {taken}, which can't be undone as cameras bend the brightness of pictures: fix the exposure"
        return Exposures(warnings=(*warnings, bent) if differs else tuple(warnings))
    if may_be_finished and differs and not (whites or darks):
        kept = (
            f"views {taken}: values are not divided by that, as they are at most about 1 and taken for reflectances. "
            "If they grow with the exposure, as raw numbers do, give a white reference, or divide them by it yourself"
        )
        return Exposures(warnings=(*warnings, kept))
    if len(of_whites) < len(whites) and differs and not misfits:
        warnings.append(
            f"views {taken}, the white reference does not say how long: reflectances may be off by a factor"
        )
    pairs = [(exposure_of(dark, False), exposure_of(other, False)) for dark, other in darks]
    unlike = [(a, b) for a, b in pairs if a is not None and b is not None and not np.array_equal(a, b)]
    if unlike:
        of_darks, of_others = (_in_words(exposures) for exposures in zip(*unlike, strict=True))
        warnings.append(
            f"the dark frame was exposed {of_darks} s times gain, what it is subtracted from {of_others}: dark current "
            "grows with exposure, so take a dark frame at each"
        )
    common, of_whom = np.median(known[0], keepdims=True), "that of the first view"
    if of_whites:
        common, of_whom = (
            of_whites[0],
            "that of the white reference" if len(whites) == 1 else "that of its white reference",
        )
    is_same = len({tuple(exposure) for exposure in [*known, *of_whites, common]}) == 1
    brought = f"views {taken}: each is brought to {of_whom}, {_in_words(of_whites or [common])}"
    return Exposures(common, () if is_same else (brought,), tuple(warnings))


def _in_words(exposures: Iterable[Float64[np.ndarray, " _"]]) -> str:
    """The range of exposures.

    >>> _in_words([np.array([0.01]), np.array([0.02])])
    '0.01 to 0.02'
    """
    every = np.concatenate(list(exposures))
    low, high = every.min(), every.max()
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


def _misfits(views: Sequence[SpectralFile], whites: Sequence[SpectralFile]) -> list[str]:
    """A warning where exposures are neither one number nor one a band, unless a white has the same ones."""
    stated = {
        repr((file.metadata.get("exposure_s"), file.metadata.get("gain"))) for file in (*views, *whites)
    }
    if whites and len(stated) == 1:
        return []
    found = []
    for file in (*views, *whites):
        sizes = {np.size(file.metadata.get(name, 1.0)) for name in ("exposure_s", "gain")} - {
            1,
            file.shape[2],
        }
        if sizes and "exposure_s" in file.metadata:
            found.append((file.path.name, max(sizes), file.shape[2]))
    if not found:
        return []
    names, numbers = name_some([name for name, *_ in found]), sorted({size for _, size, _ in found})
    what = f"{' or '.join(map(str, numbers))} exposure times or gains for {counted(found[0][2], 'band')}"
    said = f"{names}: {what}: exposures may differ and were not compared"
    return [f"{said}. Give one number, or one a band, with points as decimal marks"]


def _missing_units(files: Iterable[SpectralFile]) -> list[str]:
    """Warnings where units are missing and matter."""
    metadata = [file.metadata for file in files if "exposure_s" in file.metadata]
    warnings = []
    for what, kind in (("exposure", "exposure times"), ("gain", "gains")):
        evidence = sorted({str(own.get(f"{what}_evidence", "")) for own in metadata} - {""})
        guessed = [text for text in evidence if "no unit" in text]
        gains = {repr(own.get("gain", 1.0)) for own in metadata}
        if guessed and (len(guessed) < len(evidence) if what == "exposure" else len(gains) > 1):
            warnings.append(
                f"{kind} have no unit in some files ({'; '.join(evidence)}): values may be off by a factor"
            )
    return warnings
