"""Changes as pictures on the views of the first capture: before, after from the same place, and what differs.

Notation: `H x W` pixels, `P` vertices of the first surface, `B` bands.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int64
from scipy.spatial import KDTree

from unmix_plugin.comparing.comparison import Comparison
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.outputs import Output
from unmix_plugin.figures.paint import ColourScale, paint, scale_strip
from unmix_plugin.figures.pictures import Picture, TitledPicture
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import colour_mode
from unmix_plugin.spectral.materials import OCCUPIED_ACCUMULATION
from unmix_plugin.trained.evaluation import picture
from unmix_plugin.trained.run_views import RunView
from unmix_plugin.trained.trained_scene import MaterialView, TrainedScene

_SAME_PLACE_PX = 2.5
"""How far from a vertex a ray may end and still show what is known of it."""
_FAINT = 0.25
"""Opacity of what differs without being significant."""
_USUAL = 0.98
"""Quantile of sizes to which colours reach."""


@dataclass(frozen=True, eq=False)
class ShownView:
    """A view of the first capture, with what is known of each pixel."""

    name: str
    before: Picture
    after: Picture
    """From the same place, light taken out."""
    vertices: Int64[np.ndarray, "H W"]
    """Vertex of the first surface that a pixel shows; -1 where it shows none."""

    def of_pixels(
        self, values: Float[np.ndarray, " P"], otherwise: float = np.nan
    ) -> Float[np.ndarray, "H W"]:
        """What vertices have, where pixels show them."""
        return np.where(self.vertices >= 0, values[self.vertices], otherwise)

    def places(self, comparison: Comparison) -> Int64[np.ndarray, "H W"]:
        """Number of the place that each pixel shows, 0 where none."""
        numbers = np.zeros(len(comparison.surface.positions), np.int64)
        for place in comparison.places:
            numbers[place.vertices] = place.number
        return np.where(self.vertices >= 0, numbers[self.vertices], 0)


def carried_camera(comparison: Comparison, camera: Cameras) -> Cameras:
    """A camera of the first capture's model space, at the same place before the object in that of the second."""
    first, second = comparison.before.scene.frame, comparison.after.scene.frame
    back = comparison.registration.to_before.inverse
    pose = camera.camera_to_world[0].double().numpy()
    turned = second.rotation @ back.rotation @ first.rotation.T @ pose[:, :3]
    place = second.to_model(back.apply(first.to_world(pose[:, 3])))
    moved = torch.from_numpy(np.column_stack([turned, place])).to(camera.camera_to_world)
    return replace(camera, camera_to_world=moved[None], key_poses=None)


@torch.no_grad()
def show_view(comparison: Comparison, view: RunView) -> ShownView:
    """Render both captures from one place, and find what each pixel shows of the first surface."""
    camera = view.camera.to("cpu")
    first, second = comparison.before.scene, comparison.after.scene
    seen = first.look(camera)
    later = second.look(carried_camera(comparison, camera))
    rays = camera.image_rays(0)
    distance = seen.coefficients.ray_distance.flatten().cpu()
    ends = first.frame.to_world(rays.at(distance).double().numpy())
    away, nearest = KDTree(comparison.surface.positions).query(ends)
    there = seen.coefficients.accumulation.flatten().cpu().numpy() >= OCCUPIED_ACCUMULATION
    there &= away <= _SAME_PLACE_PX * comparison.before.pixel
    shape = seen.opacity.shape
    return ShownView(
        view.name,
        _coloured(seen, first, comparison.bands, None),
        _coloured(later, second, comparison.bands, comparison.registration.light),
        np.where(there, nearest, -1).reshape(shape).astype(np.int64),
    )


def _coloured(
    view: MaterialView, scene: TrainedScene, bands: Bands, light: Float[np.ndarray, " B"] | None
) -> Picture:
    """What is rendered in the common bands and the light of the first capture."""
    spectra = view["spectral"].detach().cpu().double()
    if scene.bands != bands:
        own = scene.bands.centers_nm
        rows = np.stack([np.interp(bands.centers_nm, own, row) for row in np.eye(len(own))])
        spectra = spectra @ torch.from_numpy(rows)
    if light is not None:
        spectra = spectra / torch.from_numpy(light)
    return picture(spectra, view.coverage.detach().cpu(), bands)


@dataclass(frozen=True, eq=False)
class ChangeMap:
    """One quantity of the first surface's vertices, and how it is painted."""

    name: str
    """Fit for file names."""
    title: str
    values: Float[np.ndarray, " P"]
    p: Float[np.ndarray, " P"]
    """After correction for all vertices."""
    scale: ColourScale

    def title_with_range(self) -> str:
        """What the colours of a figure reach."""
        low, high = self.scale.low, self.scale.high
        return f"{self.title} ±{high:.2g}" if low == -high else f"{self.title} {low:.2g} to {high:.2g}"

    def painted(self, view: ShownView, level: float) -> Picture:
        """Its colours on a view, faint where it is not significant, neutral where nothing is known."""
        values, p = view.of_pixels(self.values), view.of_pixels(self.p)
        opacity = np.where(np.isfinite(values), np.where(p <= level, 1.0, _FAINT), 0.0)
        ends = (self.scale.low, self.scale.high)
        output = Output(self.name, "map", self.title, self.scale.label, ends, self.scale.colour_map)
        return paint(output, values, opacity).picture()


def change_maps(comparison: Comparison) -> list[ChangeMap]:
    """Distance, spectral angle, brightness, then abundances and indices."""
    differences = comparison.differences
    found = [
        ChangeMap(
            "distance",
            "distance along the normal",
            differences["distance"].mean[:, 0],
            differences["distance"].q,
            _both_ways(differences["distance"].mean[:, 0], "units of the world, + is added"),
        ),
        ChangeMap(
            "angle",
            "spectral angle",
            comparison.angle,
            differences["spectrum"].q,
            ColourScale("magma", 0.0, _reach(comparison.angle), "spectral angle, rad"),
        ),
        ChangeMap(
            "brightness",
            "brightness",
            np.exp(differences["brightness"].mean[:, 0]) - 1,
            differences["brightness"].q,
            _both_ways(np.exp(differences["brightness"].mean[:, 0]) - 1, "relative change"),
        ),
    ]
    for name, one in differences.items():
        kind, _, what = name.partition(" ")
        if kind in ("abundance", "index"):
            values = one.mean[:, 0]
            found.append(
                ChangeMap(
                    name.replace(" ", "_"), name, values, one.q, _both_ways(values, f"change of {what}")
                )
            )
    return found


def _reach(values: Float[np.ndarray, " P"]) -> float:
    sizes = np.abs(values[np.isfinite(values)])
    return max(float(np.quantile(sizes, _USUAL)), 1e-6) if len(sizes) else 1.0


def _both_ways(values: Float[np.ndarray, " P"], label: str) -> ColourScale:
    reach = _reach(values)
    return ColourScale("RdBu_r", -reach, reach, label)


def outlined(view: ShownView, comparison: Comparison, colour: Sequence[float] = (0.9, 0.0, 0.6)) -> Picture:
    """The second capture with the borders of the places on it."""
    numbers = view.places(comparison)
    border = np.zeros(numbers.shape, bool)
    for axis in (0, 1):
        step = np.diff(numbers, axis=axis) != 0
        border |= np.pad(step, [(1, 0) if other == axis else (0, 0) for other in (0, 1)])
    border &= view.vertices >= 0
    return np.where(border[..., None], np.asarray(colour), view.after)


def panels(view: ShownView, comparison: Comparison, maps: Sequence[ChangeMap]) -> list[TitledPicture]:
    """What a printed figure of a view shows."""
    kind = "colour" if colour_mode(comparison.bands) == "true-colour" else "false colour"
    found = [
        TitledPicture(view.before, f"before, {kind}"),
        TitledPicture(view.after, "after, light taken out"),
        TitledPicture(outlined(view, comparison), "places that changed"),
    ]
    return found + [
        TitledPicture(one.painted(view, comparison.level), one.title_with_range()) for one in maps
    ]


def strip(scale: ColourScale) -> Picture:
    """The colours of a scale from left to right."""
    return scale_strip(scale, 160, 10)
