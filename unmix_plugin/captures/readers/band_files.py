"""Files that hold one band each, as one image: a folder of them, or those that a layout lists."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from unmix_plugin.captures.camera_tags import radiometric_model
from unmix_plugin.captures.cube import BandTable, Cube, Exposure, Factor, Linear
from unmix_plugin.captures.names import natural_order
from unmix_plugin.captures.report import Code, Remark, merged
from unmix_plugin.captures.wavelengths import wavelengths_in_names
from unmix_plugin.errors import CaptureError
from unmix_plugin.limits import allow_parts

_KINDS = {".tif": "TIFF", ".tiff": "TIFF", ".png": "PNG", ".exr": "OpenEXR", ".jpg": "JPEG", ".jpeg": "JPEG"}
_PLAIN = Cube(Path(), "", (0, 0, 0), np.dtype("u1"))
"""Says nothing."""


_SHARED = ("camera", "is_srgb", "reflectance_source", "dataset", "orientation", "map_entries", "is_geotiff")
"""Fields that a stack has where all its parts have the same."""


def open_band_folder(folder: Path, open_band: Callable[[Path], Cube]) -> Cube:
    """Open the files of a folder as the bands of one image, by rising wavelength or in the order of their names.

    Wavelengths are in the files, or in their names. Raises CaptureError: there are no such files, they hold several
    bands each or differ in size, or a lens of a rig took each.
    """
    found = sorted(path for path in folder.iterdir() if path.is_file() and not path.name.startswith("."))
    kinds = Counter(_KINDS[path.suffix.lower()] for path in found if path.suffix.lower() in _KINDS)
    if not kinds:
        raise CaptureError(f"{folder}: no band files in this folder; expected one {', '.join(_KINDS)} a band")
    # JPEG beside as many others are previews of them.
    (kind, number), *less = sorted(kinds.items(), key=lambda one: (-one[1], one[0] == "JPEG", one[0]))
    if less and less[0][1] == number and less[0][0] != "JPEG":
        raise CaptureError(
            f"{folder}: as many files of {kind} as of {less[0][0]} ({number}); expected the bands of one image: move "
            "one kind away"
        )
    allow_parts(folder, number, "band files", CaptureError)
    files = [path for path in found if _KINDS.get(path.suffix.lower()) == kind]
    bands = [open_band(path) for path in sorted(files, key=lambda path: natural_order(path.name))]
    for band in bands:
        if band.shape[2] != 1:
            if (folder / "transforms.json").is_file():
                raise CaptureError(
                    f"{folder}: its transforms.json names pictures as views, which are no bands of one image; give one "
                    "of them, or read all with unmix-process nerfstudio"
                )
            raise CaptureError(f"{band.path}: {band.shape[2]} bands; expected one band a file in {folder}")
        if (model := radiometric_model(band)) is not None:
            raise CaptureError(
                f"{band.path}: of one lens of a {model.maker} camera, with a calibration of its own, and bands of "
                "several lenses do not lie on each other; read the folder with unmix-process rig"
            )
    centres = _joined([band.bands.wavelengths_nm for band in bands])
    named = wavelengths_in_names([band.path.stem for band in bands]) if centres is None else None
    centres = named[0] if named else centres
    order = np.arange(len(bands)) if centres is None else np.argsort(centres, kind="stable")
    stack, others = stack_bands([bands[index] for index in order], folder), kinds.total() - number
    if named is not None:
        source = f"names of files, such as {bands[0].path.name!r}: {named[1]}"
        widths = stack.bands.fwhm_nm if named[2] is None else named[2][order]
        table = replace(stack.bands, wavelengths_nm=named[0][order], source=source, fwhm_nm=widths)
        stack = replace(stack, bands=table)
    if others:
        pictures = "picture of another kind" if others == 1 else "pictures of other kinds"
        facts = {"number": others, "pictures": pictures, "kind": kind}
        stack = stack.remarking(Remark.of(Code.BANDS_OF_OTHER_KINDS, **facts))
    return replace(stack, interleave="bsq")


def stack_bands(parts: Sequence[Cube], path: Path) -> Cube:
    """Files of one view that hold one band each, as one file with all of them, in the order given.

    Other facts are those that all parts share. A number that is no data in one part is missing there alone, but 0 in
    all.

    Args:
        parts: At least one, all of one size.
        path: What the whole is called in messages: the folder that holds them.
    Raises:
        CaptureError: their sizes differ.
    """
    first = parts[0]
    for part in parts:
        if part.shape[:2] != first.shape[:2]:
            raise CaptureError(
                f"{part.path} has {part.shape[0]} x {part.shape[1]} pixels; expected the "
                f"{first.shape[0]} x {first.shape[1]} of {first.path}: the bands of one view have one size"
            )
    remarks = merged(remark for part in parts for remark in part.remarks)
    stated = [part.linear for part in parts if part.linear is not None]
    if 0 < len(stated) < len(parts):
        remarks.append(Remark.of(Code.GAINS_OF_SOME_FILES))
    each = [part.linear or Linear(np.ones(1), np.zeros(1), "") for part in parts]
    gains, offsets = (np.concatenate([getattr(one, name) for one in each]) for name in ("gains", "offsets"))
    without_zeros = [
        replace(part, no_data=tuple(number for number in part.no_data if number != 0)) for part in parts
    ]
    differ = len({(repr(part.no_data), part.valid_range) for part in without_zeros}) > 1
    of_all = [number for part in parts for number in part.no_data if number == 0 or not differ]
    tables = [part.bands for part in parts]
    centres = _joined([table.wavelengths_nm for table in tables])
    is_partial = centres is None and any(table.wavelengths_nm is not None for table in tables)
    marks = [
        np.zeros(1, bool) if table.bad is None else table.bad for table in tables
    ]  # unmarked ones are good
    names = _joined([table.names for table in tables])
    bands = BandTable(
        centres,
        "only some of the files give wavelengths" if is_partial else tables[0].source,
        _joined([table.fwhm_nm for table in tables]),
        np.concatenate(marks) if any(table.bad is not None for table in tables) else None,
        None if names is None else tuple(names.tolist()),
    )
    return replace(
        first,
        path=path,
        shape=(*first.shape[:2], len(parts)),
        dtype=np.result_type(*(part.dtype for part in parts)),
        numbers=None,
        parts=tuple(without_zeros),
        bands=bands,
        linear=replace(stated[0], gains=gains, offsets=offsets) if stated else None,
        no_data=tuple(dict.fromkeys(of_all)),
        valid_range=None if differ else first.valid_range,
        exposure=_exposure_of_bands(parts, remarks),
        **{
            name: getattr(
                first if all(getattr(part, name) == getattr(first, name) for part in parts) else _PLAIN, name
            )
            for name in _SHARED
        },
        others=_other_entries(parts),
        remarks=tuple(remarks),
        sources=tuple(source for part in parts for source in part.files),
        dark_lines=0,
        masks=(),
    )


def _joined(columns: Sequence[Any]) -> np.ndarray | None:
    """One column of several; lacking where one is."""
    return None if any(column is None for column in columns) else np.concatenate(columns)


def _other_entries(parts: Sequence[Cube]) -> dict[str, Any]:
    """Entries that all parts share, and lines that their headers do; what else they say is listed by part."""
    same, *_ = [dict(part.others) for part in parts]
    for part in parts:
        same = {key: value for key, value in same.items() if repr(part.others.get(key)) == repr(value)}
    headers = [header for part in parts if isinstance(header := part.others.get("header"), dict)]
    if "header" not in same and len(headers) == len(parts):
        shared = set.intersection(*(set(header.items()) for header in headers))
        same["header"] = {key: value for key, value in headers[0].items() if (key, value) in shared}
    facts = [part.facts for part in parts]
    differ = [
        {
            key: value
            for key, value in of_part.items()
            if any(repr(one.get(key)) != repr(value) for one in facts)
        }
        for of_part in facts
    ]
    return same | ({"parts": differ} if any(differ) else {})


def _exposure_of_bands(parts: Sequence[Cube], remarks: list[Remark]) -> Exposure:
    """That of all parts where they have the same; otherwise time times gain of each band, with the f-number of all, or
    nothing where they are not known."""
    each = [part.exposure for part in parts]
    times: list[tuple[float, ...]] = [() if one.time is None else one.time.numbers for one in each]
    gains = [(1.0,) if one.gain is None else one.gain.numbers for one in each]
    f_numbers = [one.f_number or 1.0 for one in each]
    lacking = [part.path.name for part in parts if part.exposure.f_number is None]
    without = [part.path.name for part in parts if part.exposure.gain is None]
    is_exposed = any(times)
    has_gains = is_exposed and 0 < len(without) < len(parts)
    if has_gains and any(gain != (1.0,) for gain in gains):
        remarks.append(Remark.of(Code.BAND_GAINS_UNKNOWN, lacking=without))
        return Exposure()
    is_partial = is_exposed and 0 < len(lacking) < len(parts)
    if is_partial:
        f_numbers = [1.0] * len(parts)
    is_same = len({*zip(times, gains, f_numbers, strict=True)}) == 1
    if not is_same and not all(len(numbers) == 1 for numbers in (*times, *gains)):
        remarks += [Remark.of(Code.BAND_EXPOSURES_UNKNOWN)] if is_exposed else []
        return Exposure()
    if has_gains:
        remarks.append(Remark.of(Code.BAND_GAINS_TAKEN_AS_ONE, lacking=without))
    remarks += [Remark.of(Code.BAND_F_NUMBERS_UNKNOWN, lacking=lacking)] if is_partial else []
    f_number = None if lacking else f_numbers[0]
    if is_same:
        return Exposure(each[0].time, None if without else each[0].gain, f_number)
    # As if all bands had the f-number of the first.
    seconds = [
        time[0] * gain[0] * (f_numbers[0] / f_number_of_band) ** 2
        for time, gain, f_number_of_band in zip(times, gains, f_numbers, strict=True)
    ]
    return Exposure(Factor(tuple(seconds)), None, f_number)
