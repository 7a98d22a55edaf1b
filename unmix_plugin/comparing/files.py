"""Files of a comparison: tables, maps of each view, the surface with its changes, a page, a report for print."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from unmix_plugin.comparing.comparison import Comparison
from unmix_plugin.comparing.page import changes_page
from unmix_plugin.comparing.places import Amount
from unmix_plugin.comparing.printed import printed_report
from unmix_plugin.comparing.shown import ShownView, change_maps, panels, show_view
from unmix_plugin.engine.sampling import evenly_spaced
from unmix_plugin.errors import ConfigError, counted
from unmix_plugin.figures.pictures import draw_panels, in_rows
from unmix_plugin.formats.files import array_bytes, csv_bytes, write_file
from unmix_plugin.formats.meshes import write_ply
from unmix_plugin.trained.measures import describe_area, describe_length, describe_scale
from unmix_plugin.trained.run_views import RunView, positions_for_files, views_of
from unmix_plugin.trained.surface import Follow, property_names

MOST_VIEWS = 4
"""That the page and the report show unless asked otherwise."""


@dataclass(frozen=True)
class ChangeFiles:
    """What of a comparison is written, and where."""

    folder: Path
    max_views: int = MOST_VIEWS
    follow: Follow = field(default=lambda _doing, items: items)

    def __post_init__(self) -> None:
        if self.max_views < 1:
            raise ConfigError(f"--max-views is {self.max_views}; choose at least 1")

    def views(self, comparison: Comparison) -> list[RunView]:
        """The views of the first capture that are shown: evaluation views, or training views where there are none."""
        views = comparison.before.scene.views
        offered = views_of(views, "eval") or views_of(views, "train")
        return [offered[index] for index in evenly_spaced(len(offered), self.max_views)]

    def paths(self) -> list[Path]:
        """Files whose names are known before."""
        names = ("changes.csv", "changes.json", "changes.ply", "changes.html", "changes.pdf")
        return [self.folder / name for name in names]

    def write(self, comparison: Comparison) -> list[Path]:
        """Write all of it."""
        csv_path, json_path, ply_path, html_path, pdf_path = self.paths()
        written = [
            write_file(csv_path, csv_bytes(place_rows(comparison))),
            write_file(json_path, _json_bytes(summary(comparison))),
            _write_surface(ply_path, comparison),
        ]
        maps = change_maps(comparison)
        shown: list[ShownView] = []
        for view in self.follow("rendering both captures", self.views(comparison)):
            one = show_view(comparison, view)
            shown.append(one)
            for each in maps:
                folder = self.folder / "maps" / each.name
                for suffix, values in (("", each.values), ("-p", each.p)):
                    data = array_bytes(one.of_pixels(values).astype(np.float32))
                    written.append(write_file(folder / f"{view.name}{suffix}.npy", data))
            figure = draw_panels(in_rows(panels(one, comparison, maps), 3), f"{view.name}: what has changed")
            written.append(write_file(self.folder / "maps" / f"{view.name}.png", figure))
        written.append(write_file(html_path, changes_page(comparison, shown, maps)))
        written.append(write_file(pdf_path, printed_report(comparison, shown, maps)))
        return written


def _json_bytes(values: Any) -> bytes:
    return (json.dumps(values, indent=1) + "\n").encode()


def _number(value: float) -> str:
    return f"{value:.6g}" if np.isfinite(value) else ""


def place_rows(comparison: Comparison) -> Iterable[Sequence[object]]:
    """A row for each place: where, how large, what, by how much with intervals, how sure."""
    names = [name for name in comparison.differences if name != "spectrum"]
    head = ["place", "what", "area", "area_in_words", "x", "y", "z", "p_corrected", "spectral_angle_rad"]
    for name in names:
        plain = name.replace(" ", "_")
        plain = "brightness_factor" if name == "brightness" else plain
        head += [plain, f"{plain}_low", f"{plain}_high"]
    yield head
    for place in comparison.places:
        row: list[object] = [place.number, place.what, _number(place.area)]
        row += [describe_area(place.area, comparison.before.scale), *map(_number, place.center)]
        row += [_number(place.p), _number(place.angle)]
        for name in names:
            amount = place.amounts.get(name, Amount(np.nan, np.nan, np.nan))
            row += [_number(amount.mean), _number(amount.low), _number(amount.high)]
        yield row


def summary(comparison: Comparison) -> dict[str, Any]:
    """How the captures were laid on each other, and what was found, as JSON has it."""
    found, materials = comparison.registration, comparison.materials
    similarity = found.to_before
    return {
        "before": comparison.before.name,
        "after": comparison.after.name,
        "registration": {
            "rms_px": found.rms_px,
            "overlap": found.overlap,
            "agreement": found.agreement,
            "markers_px": found.markers_px,
            "scale": similarity.scale,
            "rotation": similarity.rotation.tolist(),
            "translation": similarity.translation.tolist(),
        },
        "wavelengths_nm": comparison.bands.centers_nm.tolist(),
        "light_after_over_before": found.light.tolist(),
        "lengths": describe_scale(comparison.before.scale),
        "materials": {
            "names": list(materials.names),
            "same": [list(pair) for pair in materials.pairs],
            "new": list(materials.new),
            "vanished": list(materials.vanished),
        },
        "level": comparison.level,
        "changed_part_of_area": comparison.changed_area,
        "places": len(comparison.places),
        "notes": list(comparison.notes),
    }


def summary_lines(comparison: Comparison) -> list[str]:
    """What a user is told first."""
    places = comparison.places
    lines = [*comparison.notes, comparison.registration.in_words(), comparison.materials.in_words()]
    light = comparison.registration.light
    lines.append(
        f"light: {np.median(light):.3g} times ({light.min():.3g} to {light.max():.3g} over the bands)"
    )
    if not places:
        return [*lines, f"nothing has changed, at a level of {comparison.level:g}"]
    lines.append(
        f"{comparison.changed_area:.2%} of the surface changed, in {counted(len(places), 'place')}; the largest:"
    )
    for place in places[:5]:
        area = describe_area(place.area, comparison.before.scale)
        where = " ".join(f"{value:.3g}" for value in place.center)
        what = place.in_words()
        if place.what == "distance":
            size = describe_length(abs(place.amounts["distance"].mean), comparison.before.scale)
            what = f"surface {'raised' if place.amounts['distance'].mean > 0 else 'lowered'} by {size}"
        lines.append(f"  {place.number}: {area} at {where}: {what} (p {place.p:.2g})")
    return lines


def _write_surface(path: Path, comparison: Comparison) -> Path:
    """The first surface with every difference as a number of its vertices."""
    surface, world = comparison.surface, positions_for_files(comparison.surface.positions)
    vertices: dict[str, np.ndarray] = {name: world[:, axis] for axis, name in enumerate("xyz")}
    vertices |= {f"n{name}": surface.normals[:, axis].astype(np.float32) for axis, name in enumerate("xyz")}
    numbers = np.zeros(len(world), np.int32)
    for place in comparison.places:
        numbers[place.vertices] = place.number
    maps = change_maps(comparison)
    names = [name.removeprefix("abundance_") for name in property_names(tuple(one.name for one in maps))]
    vertices["place"] = numbers
    for name, one in zip(names, maps, strict=True):
        vertices[name] = one.values.astype(np.float32)
        vertices[f"{name}_p"] = one.p.astype(np.float32)
    return write_ply(
        path,
        vertices,
        surface.faces,
        ["what has changed; NaN where too few views see a vertex", describe_scale(comparison.before.scale)],
    )
