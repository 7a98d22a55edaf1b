"""What the exported page shows of an object: its material at each vertex, and lights that it can be seen in.

The page has no path tracer. Of light from far away it knows, at each vertex, the share of each spherical harmonic that
arrives there past the object itself, once reflected on it included (precomputed radiance transfer, Sloan et al. 2002),
and for specular reflection each environment blurred to several roughnesses (split sum, Karis 2013). Materials are those
of glTF.

Notation: `V` vertices, `F` faces, `N` rays a vertex, `S` sizes of a table.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from trimesh import triangles

from unmix_plugin.formats.files import rgba_png_bytes
from unmix_plugin.light.shading import direction_features
from unmix_plugin.neumatex.export.material import InColours
from unmix_plugin.neumatex.export.pbr_fit import fit_pbr
from unmix_plugin.neumatex.tracing.environment import Environment, directions_of_pixels, solid_angles
from unmix_plugin.neumatex.tracing.families import PbrFamily, SpectralFamily
from unmix_plugin.neumatex.tracing.mesh import Mesh, mesh_of
from unmix_plugin.neumatex.tracing.microfacet import alpha_of, frames, to_world
from unmix_plugin.neumatex.tracing.rays import RayMesh
from unmix_plugin.neumatex.tracing.surface import Surface
from unmix_plugin.products.page.page import PageContent, rounded
from unmix_plugin.scenes.scene import Normalisation
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import agx, rgb_matrix
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.trained.run_views import directions_to_world
from unmix_plugin.trained.surface_mesh import vertex_areas

_MOST_TRIANGLES = 400_000
_RAYS = 128
_CHUNK = 1 << 13
_MAP = (48, 96)
"""Rows and columns of a blurred environment."""
_FINER = 4
"""Times finer the environment is looked up, so that a small sun is not missed."""
_LEVELS = 6
"""Roughnesses from 0 to 1 that environments are blurred to."""
_TONES, _STOPS = 40, (-12.0, 5.0)
"""Of the table from light to what a display is given: sizes, and powers of 2 of its first and last light."""


@dataclass(frozen=True)
class ObjectForPage:
    """An object as a page needs it."""

    mesh: Mesh
    """In model space, on the device to compute on."""
    surface: Surface
    bands: Bands | None
    """Of spectral materials; None for colours."""
    curve: Callable[[Float[Tensor, "*pixels C"]], Float[Tensor, "*pixels 3"]]
    """From light to the sRGB numbers that are shown."""
    frame: Normalisation
    lights: Mapping[str, Environment]
    """That it can be seen in, by name."""
    pictures: Mapping[str, Float[Tensor, "H W 3"]]
    """In sRGB, by title."""
    notes: tuple[str, ...] = ()
    """What is to be said beside it."""


def page_content(scene: ObjectForPage, resolution: int) -> PageContent:
    """What a page shows of an object; its mesh has vertices about as dense as cells of the resolution."""
    mesh = _resampled(scene.mesh, 2.0 / resolution).to(scene.mesh.vertices.device)
    family, notes, materials = scene.surface.family, list(scene.notes), None
    parameters = scene.surface.parameters(mesh.vertices)
    arrays: dict[str, np.ndarray] = {}
    if isinstance(family, SpectralFamily) and scene.bands is not None:
        shares = family.abundances(parameters).cpu()
        flat = torch.ones(len(scene.bands))
        none = torch.zeros(0, len(scene.bands))
        materials = Materials(scene.bands, family.endmembers.detach().cpu(), none, light=flat)
        materials = materials.called_by_colour()
        arrays = {"scaled": shares.numpy(), "abundances": shares.numpy()}
        arrays["materials"] = shares.argmax(dim=1).numpy().astype(np.uint8)
        family = InColours(family, scene.bands)
    fitted, error = fit_pbr(family, parameters, torch.Generator().manual_seed(0))
    if not isinstance(family, PbrFamily):
        notes.append(
            "The page lights the nearest metallic-roughness material, which differs from the trained one by "
            f"{100 * error:.1f} % of the reflected light."
        )
    if len(mesh.faces) < len(scene.mesh.faces):
        notes.append(f"The mesh of {len(scene.mesh.faces):,} triangles is reduced to {len(mesh.faces):,}.")
    lit, roughness, metallicity = fitted.clamp(0, 1).split([3, 1, 1], dim=1)
    base = family.base_colour(parameters).clamp(0, 1)
    transfer = _transfer(mesh, lit.mean(dim=1) * (1 - metallicity[:, 0]))
    base, lit, roughness, metallicity, transfer = (
        one.cpu() for one in (base, lit, roughness, metallicity, transfer)
    )
    mesh = mesh.to("cpu")
    openness = (transfer[:, :1] / _harmonics(torch.tensor([[0.0, 0.0, 1.0]]))[:, :1]).clamp(0, 1)
    maps = [_picture(light, scene.bands) for light in scene.lights.values()]
    areas = triangles.area(mesh.corners().double().numpy()) / scene.frame.scale**2
    arrays |= {
        "areas": vertex_areas(areas, mesh.faces.numpy(), len(mesh.vertices)),
        "positions": scene.frame.to_world(mesh.vertices.double().numpy()),
        "faces": mesh.faces.long().numpy(),
        "normals": directions_to_world(scene.frame, mesh.normals.numpy()),
        "base": base.numpy(),
        "lit": lit.numpy(),
        "polish": torch.cat([roughness, metallicity, openness], dim=1).numpy(),
        "transfer": transfer.numpy(),
        "mirrored": _blurred(torch.stack(maps)).numpy().view("<u2"),
        "tones": _tone_table(scene),
    }
    num_bands = 0 if materials is None else len(materials.bands)
    harmonics = [rounded(_projected(picture).numpy()) for picture in maps]
    relit_lights = [
        {"name": name, "factors": [1.0] * num_bands, "notes": [], "harmonics": numbers}
        for name, numbers in zip(scene.lights, harmonics, strict=True)
    ]
    facts: dict[str, Any] = {
        "lights": relit_lights,
        "notes": notes,
        "colour": "with the tones of the pictures; shadows are soft",
        "relit": {"map": [_MAP[1], _MAP[0], _LEVELS], "tones": _TONES, "stops": _STOPS},
    }
    pictures = {
        title: rgba_png_bytes((255 * values.clamp(0, 1)).round().byte().cpu().numpy())
        for title, values in scene.pictures.items()
    }
    return PageContent(arrays, facts, pictures, materials)


def _resampled(mesh: Mesh, cell: float) -> Mesh:
    """The mesh with triangles about as large as a cell: split where they are larger, vertices of a cell merged where
    there are far too many."""
    vertices, faces = mesh.vertices.cpu().double().numpy(), mesh.faces.cpu().long().numpy()
    normals = mesh.normals.cpu().double().numpy()
    if len(faces) > _MOST_TRIANGLES:
        _, of = np.unique(np.round(vertices / cell), axis=0, return_inverse=True)
        faces = of.reshape(-1)[faces]
        count = np.bincount(of.reshape(-1))[:, None]
        vertices, normals = (
            np.stack([np.bincount(of.reshape(-1), weights=column) for column in values.T], axis=1)
            for values in (vertices, normals)
        )
        vertices = vertices / count
        apart = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
        faces = np.unique(faces[apart], axis=0)
    from trimesh.remesh import subdivide

    while 4 * len(faces) <= _MOST_TRIANGLES and _usual_edge(vertices, faces) > 1.5 * cell:
        split: Any = subdivide(vertices, faces, vertex_attributes={"normals": normals})
        vertices, faces, normals = split[0], split[1], split[2]["normals"]
    return mesh_of(torch.from_numpy(vertices), torch.from_numpy(faces), torch.from_numpy(normals))


def _usual_edge(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> float:
    return float(np.quantile(np.linalg.norm(vertices[faces] - vertices[np.roll(faces, 1, 1)], axis=2), 0.9))


def _transfer(mesh: Mesh, reflected: Float[Tensor, " V"]) -> Float[Tensor, "V 16"]:
    """What a white matt surface at each vertex sends back of each harmonic of light, less what the object hides, and
    with what comes by one reflection on it, given the share of light that each vertex sends back."""
    device = mesh.vertices.device
    traced, steps = RayMesh(mesh, device), torch.arange(_RAYS, dtype=torch.float32, device=device)
    height = ((steps + 0.5) / _RAYS).sqrt()  # density: the cosine
    angle, flat = math.pi * (3 - math.sqrt(5)) * steps, (1 - height * height).sqrt()
    local = torch.stack([flat * angle.cos(), flat * angle.sin(), height], dim=1)
    direct, hits = [], []
    for part in torch.arange(len(mesh.vertices), device=device).split(_CHUNK):
        normals = mesh.normals[part]
        turned = frames(normals).repeat_interleave(_RAYS, dim=0)
        directions = to_world(turned, local.repeat(len(part), 1))
        origins = (mesh.vertices[part] + 1e-3 * normals).repeat_interleave(_RAYS, dim=0)
        found = traced.closest(origins, directions)
        arriving = _harmonics(directions) * ~found.found[:, None]
        direct.append(arriving.unflatten(0, (-1, _RAYS)).mean(dim=1))
        hits.append(found.triangles.int())
    sent = torch.cat(direct) * reflected[:, None]
    of_faces = torch.cat([sent[mesh.faces.long()].mean(dim=1), sent.new_zeros(1, 16)])  # -1: nothing is met
    once = [of_faces[part.long()].unflatten(0, (-1, _RAYS)).mean(dim=1) for part in hits]
    return torch.cat(direct) + torch.cat(once)


def _harmonics(directions: Float[Tensor, "*d 3"]) -> Float[Tensor, "*d 16"]:
    """Real spherical harmonics of degrees 0 to 3, orthonormal; number l^2 + l + m has degree l and order m."""
    found = direction_features(directions.reshape(-1, 3)).reshape(*directions.shape[:-1], -1)
    x, y, z, *others = found.unbind(dim=-1)
    degrees = torch.tensor([0, *[1] * 3, *[2] * 5, *[3] * 7], device=directions.device)
    return (
        torch.stack([torch.ones_like(x), y, z, x, *others], dim=-1)
        * ((2 * degrees + 1) / (4 * math.pi)).sqrt()
    )


def _picture(light: Environment, bands: Bands | None) -> Float[Tensor, "rows columns 3"]:
    """Radiance in three colours, each pixel the mean of its part of the sphere."""
    (rows, columns), n = _MAP, _FINER
    radiance = light.radiance(directions_of_pixels(n * rows, n * columns).flatten(0, 1).to(light.image)).cpu()
    if bands is not None:
        radiance = (radiance @ rgb_matrix(bands)).clamp(min=0)
    weights = solid_angles(n * rows, n * columns).float().reshape(rows, n, 1, 1, 1)
    summed = (radiance.reshape(rows, n, columns, n, 3) * weights).sum(dim=(1, 3))
    return summed / (n * weights.sum(dim=(1, 3)))


def _projected(picture: Float[Tensor, "rows columns 3"]) -> Float[Tensor, "16 3"]:
    """A light's spherical harmonics."""
    basis = _harmonics(directions_of_pixels(*_MAP)) * solid_angles(*_MAP).float()[:, None, None]
    return torch.einsum("rci,rck->ik", basis, picture)


def _blurred(pictures: Float[Tensor, "lights rows columns 3"]) -> Any:
    """Environments as lobes of each roughness see them around a direction, as half floats of four channels, the last
    of which is 1: (lights, levels, rows, columns, 4), flat."""
    directions = directions_of_pixels(*_MAP).flatten(0, 1)
    light = pictures.flatten(1, 2).permute(1, 0, 2).flatten(1)
    solid = solid_angles(*_MAP).float().repeat_interleave(_MAP[1])
    levels = [light]
    for roughness in torch.linspace(0, 1, _LEVELS)[1:]:
        a2 = float(alpha_of(roughness)) ** 2
        rows = []
        for part in directions.split(512):
            cosine = part @ directions.T
            # Density of the microfacets that reflect the one direction into the other, seen from the first.
            density = a2 / ((1 + cosine) / 2 * (a2 - 1) + 1).clamp(min=1e-9).square()
            lobe = density * cosine.clamp(min=0) * solid
            rows.append(lobe @ light / lobe.sum(dim=1, keepdim=True))
        levels.append(torch.cat(rows))
    colours = torch.stack(levels).unflatten(-1, (-1, 3)).permute(2, 0, 1, 3)
    whole = torch.cat([colours, torch.ones_like(colours[..., :1])], dim=-1)
    return whole.clamp(max=65504).half().flatten()


def _tone_table(scene: ObjectForPage) -> Any:
    """What a display is given for light, as the texture of a cube: red runs fastest; (S * S * S * 4) bytes."""
    steps = 2 ** torch.linspace(*_STOPS, _TONES)
    light = torch.stack(torch.meshgrid(steps, steps, steps, indexing="ij")[::-1], dim=-1)
    shown = agx(light) if scene.bands is not None else scene.curve(light.to(scene.mesh.vertices.device)).cpu()
    whole = torch.cat([shown.clamp(0, 1), torch.ones_like(shown[..., :1])], dim=-1)
    return np.round(255 * whole.detach().numpy()).astype(np.uint8).reshape(-1)
