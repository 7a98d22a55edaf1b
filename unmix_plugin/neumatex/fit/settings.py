"""Settings of the model neumatex, and what an object adds to them: sizes, light and bands, as a run records them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import torch
import tyro

from unmix_plugin.engine import (
    AtStartOnly,
    Check,
    CommonFlag,
    ModelConfig,
    Target,
    Within,
    config_from_json,
    short_flag,
)
from unmix_plugin.neumatex.fit.tone import LightCurve, ToneMapping
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.unmixing.endmembers import EndmemberMethod

if TYPE_CHECKING:
    from unmix_plugin.neumatex.fit.object_scene import ObjectScene

Auto = Literal["auto"]
PriorName = Literal["small", "none"]
MaterialName = Literal["neural", "pbr", "spectral", "auto"]
"""Families that can be trained; auto becomes one of the others when training starts."""
_USUAL_ENDMEMBERS = 6


@dataclass(frozen=True)
class ObjectRecord:
    """Sizes of an object's buffers, and what does not fit in them."""

    num_vertices: int = 3
    num_faces: int = 1
    has_uv: bool = False
    environment_size: tuple[int, int] = (1, 2)
    """Rows and columns."""
    num_light_colours: int = 3
    rotation_deg: float = 0.0
    """Of the environment about +z."""
    exposure_stops: float = 0.0
    """Of the environment."""
    moving_frame: tuple[float, ...] = ()
    """`MovingFrame.numbers` in model space, where the light turns with the camera; empty where it stands still."""
    num_colours: int = 3
    """Of the pictures."""
    tone_mapping: ToneMapping = "linear"
    """What the pictures' numbers are of light."""
    wavelengths_nm: tuple[float, ...] = ()
    """Of spectral pictures; empty for RGB."""
    lamp: tuple[float, ...] = ()
    """Relative power of the light of spectral pictures, greatest band 1; empty for RGB."""
    has_estimated_mesh: bool = False
    """Whether the mesh was made of a run: its normals can be fitted."""
    has_estimated_light: bool = False
    """Whether the environment is a `LampAndSky` that shading told: it can be fitted."""
    mixes_gloss: bool = False
    """Whether roughness and specular level belong to the endmembers of a spectral material and are mixed as these are,
    where they are free at every point otherwise. On a mesh that was estimated dents would pass for changes of gloss."""

    @property
    def is_spectral(self) -> bool:
        """Whether the pictures have bands, not colours."""
        return bool(self.lamp)

    @property
    def bands(self) -> Bands | None:
        """Of spectral pictures."""
        return Bands.of(self.wavelengths_nm) if self.is_spectral else None

    @staticmethod
    def of(scene: ObjectScene) -> ObjectRecord:
        """The record of an object."""
        light = scene.environment
        height, width, light_colours = light.image.shape
        return ObjectRecord(
            num_vertices=len(scene.mesh.vertices),
            num_faces=len(scene.mesh.faces),
            has_uv=scene.mesh.uv is not None,
            environment_size=(height, width),
            num_light_colours=light_colours,
            rotation_deg=light.rotation_deg,
            exposure_stops=light.exposure_stops,
            moving_frame=() if light.moves is None else light.moves.numbers(),
            num_colours=scene.pictures.num_colours,
            tone_mapping=scene.pictures.tone,
            wavelengths_nm=() if scene.bands is None else tuple(scene.bands.centers_nm.tolist()),
            lamp=() if scene.lamp is None else tuple(scene.lamp.tolist()),
            has_estimated_mesh=scene.estimated.has_mesh,
            has_estimated_light=scene.estimated.light is not None,
            mixes_gloss=scene.estimated.has_mesh or scene.estimated.light is not None,
        )

    def to_json(self) -> dict[str, Any]:
        """As JSON-able values."""
        return {
            name: list(value) if isinstance(value, tuple) else value for name, value in vars(self).items()
        }

    @staticmethod
    def from_json(values: Mapping[str, Any]) -> ObjectRecord:
        """What `to_json` wrote. Raises ConfigError, ValueError: a value is of the wrong type or out of its range."""
        record = config_from_json(dict(values), ObjectRecord(), "the object")
        counts = (record.num_vertices, record.num_faces, *record.environment_size, record.num_colours)
        if min(*counts, record.num_light_colours) < 1:
            raise ValueError(f"an object needs sizes of at least 1; found {counts}")
        if len(record.moving_frame) not in (0, 7):
            raise ValueError(f"a moving frame has seven numbers; found {len(record.moving_frame)}")
        if record.is_spectral and {len(record.lamp), len(record.wavelengths_nm)} != {record.num_colours}:
            raise ValueError(
                f"an object of {record.num_colours} bands needs as many wavelengths and powers of its lamp; found "
                f"{len(record.wavelengths_nm)} and {len(record.lamp)}"
            )
        return record


@dataclass(frozen=True)
class NeumatexModelConfig(ModelConfig):
    """What is fitted, and how it is rendered meanwhile."""

    _target: Target = "unmix_plugin.neumatex.fit.model:NeumatexModel"
    eval_num_rays_per_chunk: tyro.conf.Suppress[int | Auto] = "auto"
    """No flag: pictures are traced in parts of a size of their own."""
    material: Annotated[MaterialName, CommonFlag] = "auto"
    """Family of materials: neural (base colour and latents of a shared decoder), pbr (base colour, roughness,
    metallicity), or for pictures of many bands spectral (a mixture of endmember reflectances under a grey specular
    layer). Auto is spectral for pictures of many bands, otherwise neural."""
    num_endmembers: Annotated[int | Auto | None, CommonFlag, short_flag("endmembers"), Within("[1, 64]")] = (
        None
    )
    """Of spectral materials: K, how many reflectances are mixed; auto proposes it from the training pixels. None is the
    number of --pipeline.model.from-run, otherwise 6, or the number of bands if that is smaller."""
    endmember_init: Annotated[EndmemberMethod, AtStartOnly] = "pairs"
    """Of spectral materials: first guess of the endmembers, from the pixels divided by the light that reaches them."""
    from_run: Annotated[Path | None, CommonFlag, AtStartOnly, short_flag("from-run")] = None
    """Of spectral materials: run of unmix-nerf whose endmembers and abundances the fit starts from. Without --data its
    mesh, cameras and pictures are those of the run, too."""
    samples: Annotated[int, CommonFlag, Within("[2, 1024]")] = 16
    """Paths a pixel in training, in two independent halves; more is slower and less noisy. Few leave a bias, since tone
    curves bend: at equal time, 16 in half as many pixels did better than 8, and 4 in twice as many worse."""
    bounces: Annotated[int, CommonFlag, Within("[0, 8]")] = 1
    """How often light may be reflected between parts of the object before it reaches the point that is seen."""
    render_samples: Annotated[int, CommonFlag, Within("[1, 65536]")] = 64
    """Paths a pixel in renders and in the viewer."""
    eval_samples: Annotated[int, CommonFlag, Within("[1, 65536]")] = 256
    """Paths a pixel in evaluation, where noise would count as an error of the material: with 64 a good fit measures
    1.4 dB worse than it is, with 256 0.2 dB."""
    prior: Annotated[PriorName, CommonFlag] = "small"
    """Where the fit starts and what it is held to: small is the prior of the package; none starts from a plain grey
    material. Spectral materials have no prior: they start from the pictures or from a run."""
    refine: Annotated[bool, CommonFlag] = True
    """Fit what --from-run estimated together with the materials: the light, and the normals of the mesh, with one gloss
    for each endmember. What is given stays as it is."""
    fit_networks: bool = True
    """Fit the networks that read the planes, too. Published with a prior: the planes alone."""
    regularisation: Annotated[float, Within("[0, inf)")] = 1e-5
    """Weight of the distance from the prior, over its expected squared error. Less than the squared error of a fitted
    pixel: what the prior has wrong it has wrong in whole regions, so that many of its points count as few."""
    plane_resolution: Annotated[int, Within("[2, 2048]")] = 128
    """Texels along an edge of each of the three planes."""
    light_curve: LightCurve | Auto = "auto"
    """Tone curve through which pictures of linear light are compared in training; others are compared as they are. Auto
    is agx for colours; for bands light over the lamp's power, its logarithm above 1, so that dim bands count too."""

    def rules(self) -> Iterator[Check]:
        """A run to start from is one of mixed spectra."""
        is_spectral = self.material in ("spectral", "auto")
        rule = "from-run with the material spectral only"
        yield Check(("material", "from_run"), rule, self.from_run is None or is_spectral)

    def resolve_auto(
        self, initial_data: Callable[[], Mapping[str, np.ndarray]], generator: torch.Generator
    ) -> tuple[NeumatexModelConfig, str]:
        """With a family of materials, and a number of endmembers where it is spectral. Raises SpectrumError: no pixel
        is neither dark nor saturated. Raises ConfigError, RunError: the run to start from is unusable."""
        if self.material == "auto":
            is_spectral = self.from_run is not None or "lamp" in initial_data()
            chosen = replace(self, material="spectral" if is_spectral else "neural")
            return chosen.resolve_auto(initial_data, generator)
        if self.material != "spectral" or isinstance(self.num_endmembers, int):
            return self, ""
        arrays = initial_data()
        if "lamp" not in arrays:  # pictures in colours, which the model refuses
            return replace(self, num_endmembers=_USUAL_ENDMEMBERS), ""
        if self.from_run is not None:
            from unmix_plugin.neumatex.fit.start import opened_run

            return replace(self, num_endmembers=len(opened_run(self.from_run).materials.endmembers)), ""
        if self.num_endmembers is None:
            return replace(self, num_endmembers=min(_USUAL_ENDMEMBERS, len(arrays["lamp"]))), ""
        from unmix_plugin.spectral.unmixing.endmembers import drop_uninformative_pixels
        from unmix_plugin.spectral.unmixing.num_materials import propose_num_materials

        pixels = drop_uninformative_pixels(torch.from_numpy(arrays["pixels"] / arrays["lamp"]).float())
        count = propose_num_materials(pixels, generator)
        return replace(self, num_endmembers=count.number), count.evidence()
