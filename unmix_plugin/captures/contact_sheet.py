"""One picture of a whole capture: every view with its mask, cameras and points from above, mean spectra.

Notation: `h x w` pixels of a small picture, `B` bands.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64, UInt8

from unmix_plugin.captures.checks import SeenView
from unmix_plugin.figures.pictures import Canvas, CanvasLayout, columns_for
from unmix_plugin.figures.plotting import FIGURE_DPI, figure_bytes, plain_axes

_MOST_VIEWS = 96
"""Views that are shown; of more, as many evenly spaced."""
_SHEET_PX, _TILE_PX = 1300, (96, 300)
"""Width of all pictures beside each other; least and greatest longer side of one."""
OUTLINE, _IGNORED, _BEHIND = (255, 0, 200), (255, 60, 60), 60
"""Colours of the mask's outline and of pixels without a measurement; grey of the background."""
_CHARTS_INCHES, _LEAST_WIDTH_INCHES = 3.6, 11.0
_LETTERS_AN_INCH = 10
"""Of the heading."""
_MOST_POINTS = 6000


@dataclass(frozen=True)
class Spectra:
    """Mean spectra of the views of one sensor."""

    label: str
    wavelengths_nm: Float64[np.ndarray, " B"]
    views: Float64[np.ndarray, "N B"]
    dropped_nm: Float64[np.ndarray, " d"]
    """Wavelengths of bands that were left out."""


def contact_sheet(
    views: Sequence[SeenView],
    spectra: Sequence[Spectra],
    points: Float64[np.ndarray, "P 3"] | None,
    colours: UInt8[np.ndarray, "P 3"] | None,
    heading: str,
) -> bytes:
    """The sheet as a PNG.

    Args:
        views: At least one.
        spectra: One a sensor.
        points, colours: Sparse points in the scene's world and their sRGB.
        heading: First line.
    """
    from matplotlib.figure import Figure

    tiles = _tiles(views)
    height, width = (length / FIGURE_DPI for length in tiles.shape[:2])
    page_width = max(width + 0.4, _LEAST_WIDTH_INCHES)
    lines = textwrap.wrap(heading, int(page_width * _LETTERS_AN_INCH))
    top = 0.27 + 0.18 * len(lines)
    page = (page_width, top + height + _CHARTS_INCHES + 0.55)
    figure = Figure(figsize=page, facecolor="white")
    figure.text(0.2 / page[0], 1 - 0.15 / page[1], "\n".join(lines), fontsize=11, fontweight="bold", va="top")
    axes = figure.add_axes((0.2 / page[0], 1 - (top + height) / page[1], width / page[0], height / page[1]))
    axes.imshow(tiles, interpolation="none")
    axes.set_axis_off()
    third = (page_width - 0.4) / 3
    boxes = [(0.7 + index * third, 0.5, third - 0.75, _CHARTS_INCHES - 0.7) for index in range(3)]
    panels = [figure.add_axes((x / page[0], y / page[1], w / page[0], h / page[1])) for x, y, w, h in boxes]
    _draw_cameras(panels[0], views, points, colours, (0, 1), "cameras and points from above")
    _draw_cameras(panels[1], views, points, colours, (0, 2), "from the side")
    _draw_spectra(panels[2], spectra)
    return figure_bytes(figure)


def _tiles(views: Sequence[SeenView]) -> UInt8[np.ndarray, "H W 3"]:
    shown = [views[index] for index in _evenly(len(views), _MOST_VIEWS)]
    side_px = int(np.clip(_SHEET_PX / columns_for(len(shown)), *_TILE_PX))
    pictures = [_small_picture(view, side_px) for view in shown]
    size = max(picture.shape[1] for picture in pictures), max(picture.shape[0] for picture in pictures)
    captions = [view.name for view in shown]
    layout = CanvasLayout.of(size, captions)
    canvas = Canvas(layout, 3, captions)
    for index, picture in enumerate(pictures):
        row, column = layout.corner(index)
        canvas.pixels[row : row + picture.shape[0], column : column + picture.shape[1]] = picture
    return canvas.pixels


def _evenly(count: int, most: int) -> list[int]:
    return np.linspace(0, count - 1, min(count, most)).round().astype(int).tolist()


def _small_picture(view: SeenView, side_px: int) -> UInt8[np.ndarray, "h w 3"]:
    """The view on dark grey, with the outline of matter and with pixels that are ignored."""
    from PIL import Image
    from scipy import ndimage

    with Image.open(view.picture) as opened:
        scale = side_px / max(opened.size)
        size = max(1, round(opened.width * scale)), max(1, round(opened.height * scale))
        picture = np.asarray(opened.convert("RGBA").resize(size, Image.Resampling.BOX))
    opacity = picture[..., 3:] / 255.0
    pixels = np.rint(picture[..., :3] * opacity + _BEHIND * (1 - opacity)).astype(np.uint8)
    matter = picture[..., 3] > 127
    pixels[matter & ~ndimage.binary_erosion(matter, border_value=1)] = OUTLINE
    mask = view.record.paths.get("mask_path")
    if mask is not None:
        with Image.open(view.picture.parent.parent / mask) as opened:
            ignored = np.asarray(opened.convert("L").resize(size, Image.Resampling.BOX)) < 128
        pixels[ignored] = _IGNORED
    return pixels


def _draw_cameras(
    axes: Any,
    views: Sequence[SeenView],
    points: Float64[np.ndarray, "P 3"] | None,
    colours: UInt8[np.ndarray, "P 3"] | None,
    plane: tuple[int, int],
    title: str,
) -> None:
    """Cameras as arrows along their axes, on two axes of the world."""
    across, up = plane
    places, looks = (np.stack([getattr(view, name) for view in views]) for name in ("position", "axis"))
    if points is not None and len(points):
        kept = _evenly(len(points), _MOST_POINTS)
        tint = "0.5" if colours is None else np.clip(colours[kept] / 255.0 * 0.8, 0, 1)
        axes.scatter(points[kept, across], points[kept, up], s=1.0, c=tint, linewidths=0)
    arrows = (*places[:, [across, up]].T, *looks[:, [across, up]].T)
    axes.quiver(*arrows, color="#c03060", angles="xy", width=0.004, scale=12, pivot="tail")
    axes.scatter(places[:, across], places[:, up], s=9, c="#c03060", zorder=3)
    reach = 1.15 * float(np.abs(places[:, [across, up]]).max(initial=1e-9))
    axes.set_xlim(-reach, reach)
    axes.set_ylim(-reach, reach)
    axes.set_aspect("equal")
    axes.set_title(title, fontsize=9)
    axes.set_xlabel("xyz"[across], fontsize=8)
    axes.set_ylabel("xyz"[up], fontsize=8, labelpad=0)
    axes.tick_params(labelsize=7)
    plain_axes(axes)


def _draw_spectra(axes: Any, spectra: Sequence[Spectra]) -> None:
    """Mean spectra of views as thin lines, their mean as a thick one, bands that were left out as ticks above."""
    from matplotlib import colormaps

    for index, sensor in enumerate(spectra):
        colour = colormaps["tab10"](index % 10)
        marker = "." if len(sensor.wavelengths_nm) < 12 else None
        nm, style = sensor.wavelengths_nm, {"color": colour, "marker": marker}
        axes.plot(nm, sensor.views.T, alpha=0.15, linewidth=0.6, **style)
        label = f"{sensor.label}: mean" if sensor.label else "mean over views"
        axes.plot(nm, sensor.views.mean(axis=0), linewidth=1.8, label=label, **style)
    dropped = np.concatenate([sensor.dropped_nm for sensor in spectra])
    if len(dropped):
        style = {"color": "#d04040", "linewidth": 0.8, "alpha": 0.6, "label": "bands left out"}
        axes.vlines(dropped, 0.0, 1.0, transform=axes.get_xaxis_transform(), **style)
    axes.set_ylim(bottom=0.0)
    axes.set_title("mean spectra of matter", fontsize=9)
    axes.set_xlabel("wavelength in nm", fontsize=8)
    axes.tick_params(labelsize=7)
    axes.legend(fontsize=7, frameon=False)
    plain_axes(axes)
