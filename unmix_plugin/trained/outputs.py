"""Every output of a scene of mixed materials by its name: the plain ones, and families that differ by an argument."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import torch
from torch import Tensor

from unmix_plugin.engine.outputs import OutputKind, no_output
from unmix_plugin.errors import ConfigError, did_you_mean
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import band_composite_matrix
from unmix_plugin.spectral.intervals import COVERAGE
from unmix_plugin.spectral.materials import Materials, find_endmember
from unmix_plugin.spectral.segmentation import NOTHING_ID
from unmix_plugin.trained.intervals import SeenPlaces, no_interval, reflectance_number
from unmix_plugin.trained.mixture_view import MaterialOutput, MixtureView, scored
from unmix_plugin.trained.plain_outputs import OUTPUTS, caveat, fitted, light_through
from unmix_plugin.trained.reflectance_maps import parse_reflectance_map


@dataclass(frozen=True)
class _Family:
    """Outputs of one kind that differ by an argument after a colon."""

    kind: OutputKind
    title: str
    asks: str
    """What the argument is."""
    example: str
    make: Callable[[str, str, Materials], MaterialOutput]
    """From name, argument and materials to the output; raises a ConfigError where the argument can't be read, and a
    SpectrumError where the bands don't cover it."""


def _shown_nm(bands: Bands, wavelengths_nm: Sequence[float]) -> tuple[tuple[float, ...], str]:
    """Centres of the bands that are nearest to the wavelengths asked for, and both in words where they differ."""
    centers = tuple(float(bands.centers_nm[bands.nearest(asked)]) for asked in wavelengths_nm)
    shown, asked = (", ".join(f"{nm:g}" for nm in values) for values in (centers, wavelengths_nm))
    return centers, f"{shown} nm" + (f" (asked: {asked} nm)" if shown != asked else "")


def _band(name: str, argument: str, materials: Materials) -> MaterialOutput:
    wavelength = _wavelength_nm(argument, name)
    centers, shown = _shown_nm(materials.bands, [wavelength])
    band = materials.bands.nearest(wavelength)
    column = torch.eye(len(materials.bands))[:, band : band + 1]
    return MaterialOutput(
        name,
        "grey",
        FAMILIES["band"].title,
        f"{materials.quantity} of one band",
        quantity=materials.quantity,
        centers_nm=centers,
        is_on_black=True,
        remarks=(f"1 = full scale: {shown}",),
        compute=lambda view: view.materials.through(view.coefficients, column)[..., 0],
    )


def _false_colour(name: str, argument: str, materials: Materials) -> MaterialOutput:
    wavelengths = [_wavelength_nm(part, name) for part in argument.split(",")]
    if len(wavelengths) != 3:
        raise ConfigError(
            f"false-colour takes three wavelengths, as in {FAMILIES['false-colour'].example}; got {name}"
        )
    light = light_through(lambda bands: band_composite_matrix(bands, wavelengths))
    band_composite_matrix(materials.bands, wavelengths)  # which refuses wavelengths without a band
    centers, shown = _shown_nm(materials.bands, wavelengths)
    return MaterialOutput(
        name,
        "linear",
        FAMILIES["false-colour"].title,
        f"three bands as red, green and blue, {materials.quantity}",
        quantity=materials.quantity,
        centers_nm=centers,
        is_on_black=True,
        legend="red {:.0f} nm, green {:.0f} nm, blue {:.0f} nm".format(*centers),
        remarks=(f"the bands: {shown}",),
        light=light,
        compute=lambda view: light(view).clamp(0, 1),
    )


def _reflectance_map(name: str, _: str, materials: Materials) -> MaterialOutput:
    if materials.sensor is not None and name.startswith("library:"):
        raise ConfigError(
            f"{name} compares with spectra known in the run's own bands and can't be seen through the sensor "
            f"{materials.sensor}; leave out --sensor"
        )
    asked = parse_reflectance_map(name, materials.bands, materials.is_lit)
    undefined = ("NaN where undefined",) if asked.kind == "map" else ()

    def compute(view: MixtureView) -> Tensor:
        if asked.is_local:
            return scored(view, asked.fit(torch.empty(0, len(view.materials.bands))))
        reflectance = view.materials.reflectance(view.coefficients)
        return asked.fit(reflectance[view.coefficients.is_occupied])(reflectance)

    return MaterialOutput(
        name,
        asked.kind,
        FAMILIES[name.partition(":")[0]].title,
        asked.label,
        asked.usual_range,
        classes=asked.classes,
        nothing=NOTHING_ID if asked.kind == "labels" else None,
        remarks=(*asked.remarks, *caveat(materials), *undefined),
        score=asked,
        compute=compute,
    )


def _endmember(name: str, materials: Materials) -> int:
    """Number of the endmember that an output such as `abundance:leaf` names."""
    argument = name.partition(":")[2]
    index = find_endmember(argument, materials.names)
    if index is None:
        hint = did_you_mean(argument, materials.names, likeness=0.5, form=" ({})")
        raise ConfigError(
            f"{name}: there is no endmember {argument!r}{hint}; known are {', '.join(materials.names)}"
        )
    return index


def _abundance(name: str, _: str, materials: Materials) -> MaterialOutput:
    index = _endmember(name, materials)
    return MaterialOutput(
        name,
        "map",
        FAMILIES["abundance"].title,
        f"abundance of {materials.names[index]}",
        (0.0, 1.0),
        is_premultiplied=True,
        compute=lambda view: view.coefficients.abundances[..., index],
    )


Ends: TypeAlias = Callable[[SeenPlaces, float], tuple[Tensor, Tensor]]
"""From what is seen at places, and a coverage, to the low and high ends of intervals."""


def interval_ends(name: str, materials: Materials) -> Ends:
    """Intervals of an output by its name; errors are those of `find_output`, and a ConfigError where it has none."""
    if name == "abundances":
        return SeenPlaces.of_abundances
    if name == "spectral":
        return SeenPlaces.of_spectra
    output, prefix = find_output(name, materials), name.partition(":")[0]
    if prefix == "abundance":
        index = _endmember(name, materials)

        def of_one(seen: SeenPlaces, coverage: float) -> tuple[Tensor, Tensor]:
            low, high = seen.of_abundances(coverage)
            return low[..., index], high[..., index]

        return of_one
    if prefix == "band":
        band = materials.bands.nearest(_wavelength_nm(name.partition(":")[2], name))

        def of_band(seen: SeenPlaces, coverage: float) -> tuple[Tensor, Tensor]:
            low, high = seen.of_spectra(coverage)
            return low[..., band], high[..., band]

        return of_band
    if name == "reflectance":
        to_reflectance = reflectance_number(materials)

        def of_reflectance(seen: SeenPlaces, coverage: float) -> tuple[Tensor, Tensor]:
            low, high = seen.of_spectra(coverage)
            return to_reflectance(low), to_reflectance(high)

        return of_reflectance
    if output.score is not None and output.score.is_local and output.kind == "map":
        number = reflectance_number(materials, output.score.fit(torch.empty(0, len(materials.bands))))
        return lambda seen, coverage: seen.of_number(number, coverage)
    raise no_interval(name)


def _interval(name: str, argument: str, materials: Materials) -> MaterialOutput:
    """Width of the interval of an output of one number a pixel; of `abundance`, that of the largest one."""
    about = f"width of the {COVERAGE:.0%} interval"
    if argument == "abundance":
        what = "largest abundance"

        def width(view: MixtureView) -> Tensor:
            low, high = view.seen_places.of_abundances()
            largest = view.coefficients.abundances.argmax(dim=-1, keepdim=True)
            return (high - low).gather(-1, largest)[..., 0]

    else:
        one = find_output(argument, materials)
        if one.kind not in ("map", "grey"):
            raise no_interval(argument)
        ends, what = interval_ends(argument, materials), one.label

        def width(view: MixtureView) -> Tensor:
            low, high = ends(view.seen_places, COVERAGE)
            return high - low

    is_abundance = argument.partition(":")[0] == "abundance"
    return MaterialOutput(
        name,
        "map",
        FAMILIES["interval"].title,
        f"{about}, {what}",
        (0.0, 0.5) if is_abundance else None,
        remarks=("NaN where not determined, which is hatched",),
        compute=width,
    )


def _wavelength_nm(text: str, name: str) -> float:
    try:
        return float(text.strip().removesuffix("nm"))
    except ValueError:
        raise ConfigError(f"{text!r} in the output {name} is not a wavelength in nm, such as 650nm") from None


FAMILIES: dict[str, _Family] = {
    "band": _Family("grey", "one band", "a wavelength", "band:650nm", _band),
    "false-colour": _Family(
        "linear", "false colour", "wavelengths", "false-colour:860,650,550", _false_colour
    ),
    "abundance": _Family(
        "map", "abundance of one endmember", "a name or a number from 0", "abundance:0", _abundance
    ),
    "index": _Family("map", "spectral index", "to know which", "index:ndvi", _reflectance_map),
    "target": _Family("map", "likeness to a target", "to know which", "target:paint.csv", _reflectance_map),
    "library": _Family("labels", "nearest of a library", "a file", "library:mine.csv<0.1", _reflectance_map),
    "absorption": _Family("map", "absorption", "wavelengths", "absorption:650-700", _reflectance_map),
    "interval": _Family("map", "width of the interval", "an output", "interval:abundance", _interval),
}
"""By the part of the name before the colon."""


def find_output(name: str, materials: Materials) -> MaterialOutput:
    """An output by its name, such as `rgb`, `band:650nm` or `index:ndvi`.

    Raises:
        ConfigError: there is none, or its argument can't be read.
        SpectrumError: the bands don't cover what it needs.
    """
    if name in OUTPUTS:
        return fitted(OUTPUTS[name], materials)
    prefix, _, argument = name.partition(":")
    family = FAMILIES.get(prefix)
    if family is None:
        examples = [family.example for family in FAMILIES.values()]
        raise no_output(name, [*OUTPUTS, *FAMILIES], [*OUTPUTS, *examples])
    if not argument:
        raise ConfigError(f"the output {prefix} needs {family.asks}, as in {family.example}")
    return family.make(name, argument, materials)
