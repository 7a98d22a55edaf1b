"""One HTML page of a run, to mail to others: its surface in 3-D with spectra and mixtures, without a server.

The page holds a mesh with the coefficients of every vertex, and the spectra that they are multiplied with; its script
(page.js) makes every picture from both, as `trained/outputs.py` does from a rendered view. What depends on the
direction of view, gloss, is a polynomial of second degree in that direction (nine spherical harmonics), fitted to what
the training cameras see of each vertex.

Notation: `V` vertices, `F` faces, `K` endmembers, `J` specular spectra, `B` bands, `M` known spectra, `R` regions.
"""

from __future__ import annotations

import base64
import gzip
import io
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from itertools import compress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float64, Int, UInt16
from torch import Tensor
from torch.nn.functional import normalize

from unmix_plugin import __version__
from unmix_plugin.editing.apply import relighting_factors
from unmix_plugin.editing.recipe import Light, light_title
from unmix_plugin.errors import ConfigError, SpectrumError
from unmix_plugin.figures.paint import colour_table
from unmix_plugin.formats.files import eight_bits, write_file
from unmix_plugin.formats.html import fill_template
from unmix_plugin.formats.libraries import library_of
from unmix_plugin.products.product import Job
from unmix_plugin.products.regions import measure_regions
from unmix_plugin.products.scene_products import Page
from unmix_plugin.products.views import draw_abundances, draw_segmentation
from unmix_plugin.scenes.scene import Normalisation
from unmix_plugin.spectral.colour.conversion import describe_colour, rgb_matrix
from unmix_plugin.spectral.intervals import COVERAGE, Interval
from unmix_plugin.spectral.maps.indices import NAMED_INDICES, named_formula
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.trained.measured_surface import MeasuredSurface
from unmix_plugin.trained.run_materials import endmember_colours, relit
from unmix_plugin.trained.run_views import directions_to_world, world_up
from unmix_plugin.trained.surface import look_at
from unmix_plugin.trained.surface_mesh import TriangleMesh, surface_of, vertex_areas
from unmix_plugin.trained.trained_scene import TrainedScene

MOST_BYTES = 20_000_000
"""Of a page: what mail takes, and a phone loads in seconds."""

MOST_TRIANGLES = 600_000
"""Of a page: what phones and laptops without a graphics card turn smoothly."""
_COARSEST = 16
_MOST_KNOWN = 4000
"""Spectra of a library: all of ECOSTRESS or of USGS."""
_UNKNOWN = 65535
_PICTURE_PX = 320

_SCRIPTS = ("three.js", "spectra.js", "page.js")
_LIGHTS = ("D65", "D50", "A", "FL2", "FL11", "LED-B3")
_MOST_CAMERAS = 200
_CAMERAS = 16
_LEAST_FACING = 0.15
"""Cosine between normal and line of sight below which a camera tells little of a vertex."""
_RIDGE = 0.05
"""Weight of small harmonics beside the cameras' mean square error: few cameras don't make wild highlights."""
_CHUNK = 1 << 17
_LEAST_HALF_WIDTH = 1e-3
"""Of an interval that is determined: with 8 bits, smaller ones would be 0."""


@dataclass(frozen=True)
class PageContent:
    """What a page shows of an object; page.js reads facts and arrays by their names."""

    arrays: dict[str, Float[np.ndarray, "..."] | Int[np.ndarray, "..."]]
    """`positions` (V, 3) in the world, `faces` (F, 3) and `areas` (V), those of `vertex_areas`; of each vertex or of
    anything else, more numbers by name."""
    facts: dict[str, Any]
    """What else is to be known, by name; `notes` are sentences to be said."""
    pictures: dict[str, bytes]
    """PNG by caption, for browsers that can't draw in 3-D."""
    materials: Materials | None = None
    """Endmembers and the light that they are seen in, where there are bands."""


def export(job: Job, asked: Page) -> list[Path]:
    """Find the surface, look at every vertex, and write `page.html`, with as many triangles as fit."""
    path = job.folder / "page.html"
    job.claim([path])
    # A scene without mixed materials may say itself what a page shows of it, with about so many cells along an edge.
    own: Callable[[int], PageContent] | None = getattr(job.loaded.scene, "page_content", None)
    known = None if own is not None else _known_spectra(job.materials, asked.library)
    resolution, before = asked.resolution, math.inf
    while True:
        if own is not None:
            with job.working("looking at the surface"):
                content = own(resolution)
        else:
            content, resolution = _mixture_content(job, resolution)
        known = known or _known_spectra(content.materials, asked.library)
        notes = content.facts["notes"]
        if asked.edits is not None:
            notes.append(f"Edited: shown with the edits of {asked.edits.name}, not as found.")
        if resolution < asked.resolution:
            notes.append(
                f"The surface is as fine as {resolution} cells along the longest edge, not {asked.resolution}: "
                f"browsers turn {MOST_TRIANGLES:,} triangles smoothly, and a mail takes {MOST_BYTES / 1e6:g} MB."
            )
        page = _page(job, content, known, asked.title)
        if len(page) <= MOST_BYTES:
            break
        # No resolution shrinks scripts, library, pictures and tables of light.
        count = len(content.arrays["positions"])
        surface = {k: v for k, v in content.arrays.items() if k == "faces" or count in v.shape}
        shrinking = len(_packed(surface)[0])
        coarser = _coarser(resolution, (MOST_BYTES - len(page) + shrinking) / shrinking)
        if coarser < _COARSEST or len(page) >= before:
            job.say(f"the page has {len(page) / 1e6:.1f} MB, more than a mail takes")
            break
        job.say(
            f"a page of {len(content.arrays['faces'])} triangles would have {len(page) / 1e6:.1f} MB, more than the "
            f"{MOST_BYTES / 1e6:g} MB that a mail takes: made again with {coarser} cells along the longest edge"
        )
        resolution, before = coarser, len(page)
    for note in notes:
        job.say(note)
    job.say(f"{len(content.arrays['faces'])} triangles, {len(page) / 1e6:.1f} MB")
    return [write_file(path, page)]


class _KnownSpectra(NamedTuple):
    """Reflectances of a library at the bands of a page, without those that can't be compared there."""

    sources: list[dict[str, str]]
    """Name and source of each."""
    steps: UInt16[np.ndarray, "M B"]
    """Of 65534 for its greatest value, which angles don't ask for; `_UNKNOWN` where nothing was measured."""


def _known_spectra(materials: Materials | None, library: Sequence[Path]) -> _KnownSpectra:
    if materials is None or materials.sensor is not None:
        if library:
            own = "colours, not in bands" if materials is None else "channels of --sensor, not in its bands"
            raise ConfigError(f"the object is known in {own}: leave out --library")
        return _KnownSpectra([], np.zeros((0, 0), np.uint16))
    light = _light_of(materials)
    known = library_of(library, materials.bands, light)
    chosen = known.comparable(materials.bands, light)
    if chosen.sum() > _MOST_KNOWN:
        raise ConfigError(
            f"the library has {chosen.sum()} spectra; a page has room for {_MOST_KNOWN}: choose fewer"
        )
    reflectances = known.resampled(materials.bands)[chosen]
    steps = reflectances / np.nanmax(reflectances, axis=1, keepdims=True, initial=1e-9) * (_UNKNOWN - 1)
    sources = [{"name": one.name, "source": one.source} for one in compress(known.materials, chosen)]
    return _KnownSpectra(sources, np.nan_to_num(np.round(steps), nan=_UNKNOWN).astype("<u2"))


def _light_of(materials: Materials) -> Float64[np.ndarray, " B"] | None:
    return None if materials.light is None else materials.light.cpu().double().numpy()


def _page(job: Job, content: PageContent, known: _KnownSpectra, title: str) -> bytes:
    """The whole page: the template with scripts and data in it."""
    arrays, layout = _packed({**content.arrays, "known": known.steps})
    scale = job.loaded.scale
    name = title or job.loaded.scene_name

    cameras, views = [], job.views("all")
    for view in views[:: -(-len(views) // _MOST_CAMERAS)]:
        pose, size = view.camera.camera_to_world[0].double().cpu().numpy(), view.camera.size(0)
        camera = {
            "name": view.name,
            "position": job.frame.to_world(pose[None, :, 3])[0].tolist(),
            "axes": directions_to_world(job.frame, pose[:, :3].T).tolist(),
            "size": list(size),
            "focal_px": view.camera.focal_px[0].tolist(),
        }
        cameras.append(camera)

    facts = {
        "title": name,
        "subtitle": f"{job.loaded.config.method_name}, run {job.loaded.folder.path.name}",
        "made": f"unmix-nerf {__version__}, {datetime.now(timezone.utc):%Y-%m-%d}",
        "arrays": layout,
        "metres_per_unit": None if scale is None else scale.metres_per_unit,
        "scale": None if scale is None else scale.in_words,
        **_spectral_facts(content.materials, job.loaded.record.summary.get("illuminant")),
        "known": known.sources,
        "regions": [],
        **content.facts,
        "up": rounded(world_up(job.loaded.scene.views, job.frame)),
        "cameras": cameras,
    }
    try:
        scripts = [(Path(__file__).parent / name).read_text(encoding="utf-8") for name in _SCRIPTS]
    except OSError as error:
        raise ConfigError(
            f"the installation lacks the page's scripts ({error}); install unmix-nerf again"
        ) from error
    pictures = {caption: base64.b64encode(content).decode() for caption, content in content.pictures.items()}
    values = {"facts": facts, "arrays": arrays, "pictures": pictures, "scripts": scripts, "title": name}
    return fill_template("unmix_plugin.products.page", "page.html", values).encode()


def _coarser(resolution: int, part: float) -> int:
    """The resolution for a part of the triangles, and so of the bytes: both grow with its square."""
    return int(0.95 * resolution * math.sqrt(max(part, 0.0)))


def _mixture_content(job: Job, resolution: int) -> tuple[PageContent, int]:
    """Of a scene of mixed materials, and the resolution that `MOST_TRIANGLES` leave."""
    mesh, notes = surface_of(job.scene, resolution, follow=job.follow, working=job.working)[0], []
    while len(mesh.faces) > MOST_TRIANGLES:
        resolution = _coarser(resolution, MOST_TRIANGLES / len(mesh.faces))
        job.say(
            f"the surface of {len(mesh.faces):,} triangles is made again with {resolution} cells along the longest "
            f"edge: browsers turn {MOST_TRIANGLES:,} smoothly"
        )
        mesh, _ = surface_of(job.scene, resolution, follow=job.follow, working=job.working)
    with job.working("looking at the surface's points"):
        arrays = _vertex_arrays(job.scene, mesh, job.frame)
    arrays["areas"] = vertex_areas(mesh.areas() / job.frame.scale**2, mesh.faces, len(mesh.vertices))
    kept = job.loaded.measures.regions
    names: list[str] = []
    of_regions: list[dict[str, Any]] = []
    if kept:
        found, failed = measure_regions(MeasuredSurface(job.scene, mesh), kept)
        notes += [f"Not shown: {reason}." for reason in failed.values()]
        inside = [region.vertex_areas for region in found.values()]
        of_regions = [
            {"abundances": _ends(region.probe.interval()), "area": _ends(region.area_interval)[0]}
            for region in found.values()
        ]
        names, of_vertex = list(found), np.maximum(arrays["areas"], 1e-30)
        if names:  # how much of each vertex is in each, 255 for all of it
            arrays["regions"] = np.round(255 * np.stack(inside) / of_vertex).astype(np.uint8)
    view = [*job.views("eval"), *job.views("all")][0]
    width, height = view.camera.size(0)
    enlarged = _PICTURE_PX / max(width, height)
    camera = view.camera.resized(max(1, round(enlarged * width)), max(1, round(enlarged * height)))
    seen = job.render(replace(view, camera=camera))
    pictures = {
        f"{view.name}: materials": draw_segmentation(view.name, seen, job.materials),
        f"{view.name}: abundances": draw_abundances(view.name, seen, job.materials),
    }
    errors = job.scene.errors
    intervals = {"not_determined": errors if isinstance(errors, str) else "", "regions": of_regions}
    facts = {"regions": names, "notes": notes, "interval": intervals}
    return PageContent(arrays, facts, pictures, job.materials), resolution


def _ends(interval: Interval) -> list[list[float] | None]:
    """Low and high of each value, None where not determined."""
    pairs = np.stack([interval.low, interval.high], axis=-1).reshape(-1, 2)
    return [pair if np.isfinite(pair).all() else None for pair in rounded(pairs)]


def _spectral_facts(materials: Materials | None, recorded: Sequence[float] | None) -> dict[str, Any]:
    """Spectra, lights and names, as page.js reads them; empty where there are no bands. `recorded` is the power of the
    light that the scene was recorded in; None where it is unknown."""
    if materials is None:
        names = "wavelengths_nm ranges_nm names colours endmembers specular rgb indices is_lit".split()  # noqa: SIM905
        empty: dict[str, Any] = {name: [] for name in names}
        return {**empty, "light": None, "is_light_known": False, "colour_map": _colour_map()}
    bands, power = materials.bands, _light_of(materials)
    endmembers = materials.endmembers.detach().cpu().double().numpy()
    own, shown, dark = "the scene's own", materials.light_name, list[str]()
    lights = [
        {"name": shown or own, "title": light_title(shown or own), "factors": [1.0] * len(bands), "notes": []}
    ]
    if shown is not None and materials.sensor is None:  # whose channels the recorded light is not known in
        assert power is not None
        before = np.ones(len(bands)) if recorded is None else np.array(recorded, dtype=np.float64)
        back = relit(np.ones(len(bands)), power.tolist(), before)
        dark = [f"black where {shown} does not reach"] if not materials.is_lit.all() else []
        lights.append({"name": own, "factors": rounded(back), "notes": dark})
    for light in _LIGHTS if materials.sensor is None else ():  # a light is lit before a sensor looks
        if light == shown:
            continue
        try:
            factors, notes = relighting_factors(bands, power, Light(light))
        except SpectrumError:
            continue  # it does not reach these bands: not offered
        notes = [*dark, *notes[len(dark) :]]  # the first takes the light shown for the scene's own
        lights.append(
            {"name": light, "title": light_title(light), "factors": rounded(factors), "notes": notes}
        )
    return {
        "wavelengths_nm": rounded(bands.centers_nm),
        "ranges_nm": rounded(bands.ranges_nm),
        "is_lit": materials.is_lit.tolist(),
        "names": list(materials.names),
        "colours": rounded(endmember_colours(materials)),
        "endmembers": rounded(endmembers),
        "specular": rounded(materials.specular_spectra.detach().cpu().double().numpy()),
        "light": None if power is None else rounded(power),
        "is_light_known": materials.is_light_known,
        "rgb": rounded(rgb_matrix(bands, torch.float64).numpy()),
        "colour": describe_colour(bands),
        "lights": lights,
        "indices": [
            {"name": name, "formula": formula, "title": named.title, "range": named.usual_range}
            for name, named in NAMED_INDICES.items()
            if (formula := named_formula(name, bands))
        ],
        "colour_map": _colour_map(),
    }


def _vertex_arrays(
    scene: TrainedScene, mesh: TriangleMesh, frame: Normalisation
) -> dict[str, Float[np.ndarray, "..."] | Int[np.ndarray, "..."]]:
    """What the page knows of every vertex, and which three make a triangle.

    The mixture is what is seen from straight above, as in other exports of surfaces; gloss is fitted to what the
    training cameras in front of a vertex see.
    """
    positions = torch.from_numpy(mesh.vertices).float()
    normals = torch.from_numpy(mesh.normals).float()
    above = look_at(scene, positions, -normals).map(lambda packed: packed.cpu())
    found = above.map(lambda packed: packed / packed[:, :1].clamp(min=1e-6))
    tints = torch.zeros_like(above.specular)
    # Least squares of each vertex: how much gloss is sent along a direction.
    squares, products = _RIDGE * torch.eye(9).repeat(len(positions), 1, 1), torch.zeros(len(positions), 9)
    trained = [view.camera for view in scene.views if view.split == "train"]
    for camera in trained[:: -(-len(trained) // _CAMERAS)]:
        directions = normalize(camera.camera_to_world[0, :, 3].cpu() - positions, dim=1)
        facing = ((directions * normals).sum(dim=1) > _LEAST_FACING).nonzero()[:, 0]
        for part in facing.split(_CHUNK):
            seen = look_at(scene, positions[part], -directions[part]).map(lambda packed: packed.cpu())
            gloss = seen.specular / seen.accumulation.clamp(min=1e-6)[:, None]
            tints[part] += gloss
            along = torch.from_numpy(directions_to_world(frame, directions[part].numpy())).float()
            basis = _harmonics(along)
            squares[part] += basis[:, :, None] * basis[:, None, :]
            products[part] += basis * gloss.sum(dim=1, keepdim=True)
    arrays = {
        "positions": frame.to_world(mesh.vertices),
        "faces": mesh.faces,
        "scaled": found.scaled_abundances.numpy(),
        "abundances": found.abundances.numpy(),
        "materials": scene.materials.to("cpu").ids(found).numpy(),
        "confidence": scene.materials.to("cpu").confidence(found).numpy(),
    }
    errors = scene.errors
    if not isinstance(errors, str):
        spectra = found.scaled_abundances @ scene.materials.endmembers.cpu()
        local = errors.at(positions, found.abundances, spectra).abundances.cpu()
        half = errors.half_widths(found.abundances.to(local), local, COVERAGE)
        arrays["half_widths"] = half.clamp(_LEAST_HALF_WIDTH, 1).nan_to_num(0.0).numpy()  # 0: not determined
    if scene.unexplained is not None:
        arrays["unexplained"] = scene.unexplained.at(positions).nan_to_num(0.0).numpy()
    if len(scene.materials.specular_spectra):
        arrays["gloss"] = torch.linalg.solve(squares, products[..., None])[..., 0].numpy()
        arrays["tints"] = (tints / tints.sum(dim=1, keepdim=True).clamp(min=1e-9)).numpy()
    return arrays


def _harmonics(directions: Float[Tensor, "V 3"]) -> Float[Tensor, "V 9"]:
    """The polynomials of second degree on the sphere, as page.js has them; not normalised but for similar size."""
    x, y, z = directions.unbind(-1)
    one = torch.ones_like(x)
    return torch.stack([one, x, y, z, x * y, y * z, x * z, x * x - y * y, 3 * z * z - 1], dim=-1)


def _packed(arrays: dict[str, np.ndarray]) -> tuple[str, dict[str, Any]]:
    """All arrays as one text (base64 of gzip), and for each where it lies and how its numbers are got back.

    Positions have 16 bits over their box; shares and brightness 8 bits of their square root, as an eye sees them; what
    may be negative 16 bits of its column's largest; areas, which differ by orders of magnitude and are summed, 32 bits;
    whole numbers stay. Each corner of a triangle is stored as its difference from the one before.
    """
    arrays = dict(arrays)
    positions, faces = arrays.pop("positions"), arrays.pop("faces")
    low, high = positions.min(axis=0), positions.max(axis=0)
    extent = float((high - low).max())
    parts: dict[str, tuple[np.ndarray, dict[str, Any]]] = {
        "positions": (
            np.round((positions - low) / extent * 65535).astype("<u2"),
            {"scale": extent / 65535, "offset": low.tolist()},
        ),
        "faces": (np.diff(faces.reshape(-1), prepend=0).astype("<i4"), {}),
    }
    for name, values in arrays.items():
        if values.dtype.kind in "iu":
            parts[name] = (values, {})
        elif name == "areas":
            parts[name] = (values.astype("<f4"), {})
        elif values.min(initial=0) < 0:
            largest = np.maximum(np.abs(values).max(axis=0), 1e-9)
            # A few vertices may have far more gloss than all others: 16 bits serve both.
            steps = np.round(values / largest * 32767).astype("<i2")
            parts[name] = (steps, {"scales": (largest / 32767).tolist()})
        else:
            largest = max(float(values.max()), 1e-9)
            parts[name] = (
                eight_bits(np.sqrt(values / largest)),
                {"scale": largest / 255**2, "is_root": True},
            )
    layout, content = {}, io.BytesIO()
    for name, (values, how) in parts.items():
        width = values.shape[1] if values.ndim > 1 and name != "faces" else 1
        content.write(b"\0" * (-content.tell() % 4))
        layout[name] = {
            "start": content.tell(),
            "count": values.size,
            "type": values.dtype.str[-2:],
            "width": width,
        } | how
        content.write(np.ascontiguousarray(values).tobytes())
    return base64.b64encode(gzip.compress(content.getvalue(), 6, mtime=0)).decode(), layout


def rounded(values: Float[np.ndarray, "..."]) -> list[Any]:
    """Numbers as JSON has them, with six digits."""
    return json.loads(
        json.dumps(np.asarray(values).tolist()), parse_float=lambda text: float(f"{float(text):.6g}")
    )


def _colour_map() -> list[list[int]]:
    """Of values from 0 to 1, in 256 steps of 8 bits: viridis."""
    return np.round(255 * colour_table("viridis")).astype(int).tolist()
