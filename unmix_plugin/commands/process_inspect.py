"""`unmix-process inspect FILE...`: what files hold, and why one can't be read."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from unmix_plugin.captures.cube import Axes, ReadOptions
from unmix_plugin.captures.options import parse_mosaic
from unmix_plugin.commands.entry import DONE, USER_ERROR
from unmix_plugin.engine.printing import tell
from unmix_plugin.errors import CaptureError, ConfigError, counted

_SHOWN = ("axes", "source", "exposure_s", "exposure_evidence", "gain", "gain_evidence", "f_number", "map")
"""Metadata that have lines of their own."""


@dataclass(frozen=True)
class ReadingOptions:
    """What a user adds to files that don't say enough of themselves."""

    dataset: str | None = None
    """Variable, data set, layer or channel to take from a file that holds several."""
    axes: Axes | None = None
    """Order of the axes of arrays, the slowest first: y rows, x columns, b bands."""
    size: tuple[int, int] | None = None
    """Rows and columns of an image that is stored as a matrix of bands and pixels, column after column."""
    mosaic: Annotated[str | None, tyro.conf.arg(metavar="ROWSxCOLUMNS")] = None
    """Filters of a mosaic camera, such as 4x4, whose raw frame an image of one band is."""

    def for_readers(self) -> ReadOptions:
        """The same as readers take it."""
        return ReadOptions(
            dataset=self.dataset, axes=self.axes, size=self.size, mosaic=parse_mosaic(self.mosaic)
        )


@dataclass(frozen=True, kw_only=True)
class _InspectOptions(ReadingOptions):
    """Say what files of instruments hold: size, type, bands, wavelengths with their evidence, poses.

    Nothing but headers and one row of each image is read. Exit status 2 if a file is refused.
    """

    files: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="FILE...")]
    """Images, folders with one file a band, or poses."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """One JSON object a file, a line each."""


def inspect_command(arguments: list[str]) -> int:
    """Parse the arguments and print what each file holds; the exit status is 0, or 2 if a file was refused."""
    options = tyro.cli(_InspectOptions, prog="unmix-process inspect", args=arguments)
    from rich.table import Table
    from rich.text import Text

    from unmix_plugin.commands.reporting import CommandConsole

    if not options.files:
        raise ConfigError("no file is named; expected unmix-process inspect FILE...")
    console = CommandConsole()
    reports = [_report(path, options.for_readers()) for path in options.files]
    for report in reports:
        if options.json:
            tell(json.dumps(report))
            continue
        title = Text(report["file"], style="bold")
        table = Table(title=title, title_justify="left", show_header=False, box=None)
        for name, text in _rows(report):
            table.add_row(name, Text(text))
        console.print(table, markup=False, highlight=False)
    return USER_ERROR if any("error" in report for report in reports) else DONE


def _report(path: Path, options: ReadOptions) -> dict[str, Any]:
    from unmix_plugin.captures.readers.opening import inspect_file

    try:
        return inspect_file(path, options)
    except CaptureError as error:  # of this file alone
        return {"file": str(path), "error": str(error)}


def _rows(report: dict[str, Any]) -> list[tuple[str, str]]:
    """Facts worth a line."""
    if "error" in report:
        return [("refused", report["error"])]
    rows = [] if report["shape"] is None else _image_rows(report)
    if report.get("poses") is not None:
        source = report["metadata"].get("source", "")
        rows.append(("poses", f"{counted(report['poses'], 'camera')} ({source})"))
    rows += [("note", note) for note in report["notes"]]
    others = [name for name in report["metadata"] if name not in _SHOWN]
    return rows + ([("also holds", ", ".join(others))] if others else [])


def _image_rows(report: dict[str, Any]) -> list[tuple[str, str]]:
    height, width, num_bands = report["shape"]
    size = f"{height} rows x {width} columns x {counted(num_bands, 'band')}"
    interleave = f", {report['interleave']}" if report["interleave"] else ""
    rows = [("image", f"{size}, {report['dtype']}{interleave}, read as {report['reader']}")]
    rows.append(("wavelengths", _wavelength_text(report)))
    named = report["band_names"]
    if named and report["wavelengths_nm"] is None:
        rows.append(("bands", ", ".join(named[:8]) + (", ..." if len(named) > 8 else "")))
    if report["bad_bands"]:
        nm = report["wavelengths_nm"]
        marked = [f"{band}{f' ({nm[band]:g} nm)' if nm else ''}" for band in report["bad_bands"]]
        rows.append(("bad bands", f"{', '.join(marked)}, counted from 0"))
    if report["gains"] and report["scale"] is None:
        rows += [(key, _range_text(report[key])) for key in ("gains", "offsets")]
    for key, what in (("scale", "stored for 1"), ("no_data", "no data")):
        if report[key] is not None:
            each = report[key] if isinstance(report[key], list) else [report[key]]
            texts = [f"{number:g}" if isinstance(number, float) else str(number) for number in each]
            rows.append((what, " or ".join(texts)))
    found = report["metadata"]
    if "exposure_s" in found:
        rows.append(("exposure", f"{_range_text(found['exposure_s'])} s ({found['exposure_evidence']})"))
    if "gain" in found:
        rows.append(("gain", _range_text(found["gain"])))
    if "f_number" in found:
        rows.append(("f-number", f"{found['f_number']:g}"))
    rows += [(key, found["map"][key]) for key in ("map info",) if key in found.get("map", {})]
    return rows


def _range_text(numbers: float | list[float]) -> str:
    """One number, or the least and greatest of one a band."""
    low, high = (numbers, numbers) if isinstance(numbers, float | int) else (min(numbers), max(numbers))
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


def _wavelength_text(report: dict[str, Any]) -> str:
    found = report["wavelengths_nm"]
    if found is None:
        return f"unknown: {report['wavelength_evidence']}"
    span = f"{found[0]:g} nm" if len(found) == 1 else f"{found[0]:g} to {found[-1]:g} nm"
    widths = report["fwhm_nm"]
    ends = sorted({f"{width:g}" for width in (min(widths), max(widths))}, key=float) if widths else []
    width = f", FWHM {' to '.join(ends)} nm" if ends else ""
    return f"{span}{width} ({report['wavelength_evidence']})"
