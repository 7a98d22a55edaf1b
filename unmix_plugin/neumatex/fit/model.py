"""The model neumatex: materials on a known mesh under known light, fitted to pictures through a path tracer.

The loss is the squared error of tone-mapped light. Rendered light is a random estimate, whose square would add its
variance to the error: each of the two factors has an estimate of its own, from independent samples. That is unbiased
where the tone curve is linear over the spread of the estimates, and nearly so where it bends.

How bright a spectral material is known light tells soon. The shape of a spectrum is less certain: where it may move as
fast, it drifts towards mixtures. So each endmember has a gain with a rate of its own, which is folded into it after
every step.

Notation: `R` rays, one a pixel; `N` of them meet the mesh; `C` colours; `P` parameters of a material; `K` endmembers
and `B` bands of a spectral one; `H x W` pixels.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import cast

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from unmix_plugin.engine import Cameras, Model, RayBundle, TrainingCallback, TrainingCallbackLocation
from unmix_plugin.errors import ConfigError
from unmix_plugin.neumatex.fit.evaluation import evaluate_object_image, evaluation_outputs
from unmix_plugin.neumatex.fit.refinement import FittedLight, FittedNormals
from unmix_plugin.neumatex.fit.settings import NeumatexModelConfig, ObjectRecord
from unmix_plugin.neumatex.fit.start import fit_abundances, spectral_start, start_plain, views_of
from unmix_plugin.neumatex.fit.tone import LampRatio, SpectralDisplay, ToneMapping, psnr_db, tone_curve
from unmix_plugin.neumatex.tracing.environment import Environment, MovingFrame
from unmix_plugin.neumatex.tracing.families import PbrFamily, SpectralFamily
from unmix_plugin.neumatex.tracing.lamp_and_sky import LampAndSky
from unmix_plugin.neumatex.tracing.mesh import Mesh
from unmix_plugin.neumatex.tracing.neural import NeuralFamily
from unmix_plugin.neumatex.tracing.path_tracer import TracedObject
from unmix_plugin.neumatex.tracing.rays import RayMesh
from unmix_plugin.neumatex.tracing.surface import Triplane, TriplaneSurface

_START_SEED = 0
"""Of networks and planes before training; the run's own seed draws everything else."""


class NeumatexModel(Model):
    """Triplane, family of materials, tone curve; mesh and environment as buffers."""

    batches_at_once = 2
    config: NeumatexModelConfig

    def populate_modules(self) -> None:
        """Modules and buffers in the shapes that config and object ask for."""
        record = ObjectRecord.from_json(self.metadata)
        self.record = record
        shares = self._checked_num_endmembers()
        self.endmembers = nn.Parameter(torch.zeros(shares, record.num_colours)) if shares else None
        self.gains = nn.Parameter(torch.ones(shares)) if shares else None
        if self.endmembers is not None:
            self.family = SpectralFamily(self.endmembers, self.gains)
        else:
            self.family = NeuralFamily() if self.config.material == "neural" else PbrFamily()
        self.family_parts = nn.ModuleDict()
        if isinstance(self.family, NeuralFamily):  # a run keeps the decoder that it was fitted with
            self.family_parts.update({"decoder": self.family.decoder, "encoder": self.family.encoder})
        generator = torch.Generator().manual_seed(_START_SEED)
        parameters, resolution = self.family.num_parameters, self.config.plane_resolution
        mixes_gloss = self.config.refine and record.mixes_gloss and shares > 0
        self.triplane = Triplane(parameters, resolution, generator, shares, mixes_others=mixes_gloss)
        self.light_curve = self._light_curve()
        self.anchor = nn.ModuleDict()  # under which name runs keep the prior
        if self.config.prior != "none" and not record.is_spectral:
            prior = Triplane(parameters, resolution, generator=generator).requires_grad_(False)
            self.anchor["triplane"] = prior
        if not self.config.fit_networks:
            self.triplane.readers.material_network.requires_grad_(False)
            self.triplane.readers.variance_network.requires_grad_(False)
        self.curve: nn.Module = tone_curve("agx" if record.tone_mapping == "linear" else record.tone_mapping)
        if record.bands is not None:
            self.curve = SpectralDisplay(record.bands)
        for name, buffer in _empty_buffers(record).items():
            self.register_buffer(name, buffer)
        refine = self.config.refine
        self.light = FittedLight() if refine and record.has_estimated_light else None
        self.relief = FittedNormals(record.num_vertices) if refine and record.has_estimated_mesh else None
        self._tree: tuple[RayMesh, Tensor, int] | None = None

    def initialise(self, initial_data: Mapping[str, np.ndarray], generator: torch.Generator) -> None:
        """Take mesh and environment over, and begin with the prior's material, or a plain one."""
        for name in _empty_buffers(self.record):
            self.get_buffer(name).copy_(torch.from_numpy(initial_data[name]))
        if self.light is not None:
            self.light.start_from(LampAndSky.from_tensor(torch.from_numpy(initial_data["lamp_and_sky"])))
        if self.endmembers is not None:
            start = spectral_start(
                self.traced,
                initial_data,
                generator,
                count=len(self.endmembers),
                method=self.config.endmember_init,
                bands=self.record.bands,
                from_run=self.config.from_run,
            )
            self.endmembers.copy_(start.endmembers)
            start_plain(self.triplane, self.family)
            fit_abundances(self.triplane, start, generator)
        elif self.prior is None:
            start_plain(self.triplane, self.family)
        else:
            from unmix_plugin.neumatex.prior.small import predict

            assert self.config.material != "spectral"  # which has no prior
            assert self.config.material != "auto"  # settled when training starts
            found = predict(
                views_of(initial_data),
                self.traced.ray_mesh,
                self.traced.environment,
                self.config.material,
                resolution=self.config.plane_resolution,
                generator=generator,
            )
            self.triplane.load_state_dict(found.state_dict())
            self.prior.load_state_dict(found.state_dict())

    def get_param_groups(self) -> dict[str, list[nn.Parameter]]:
        """Planes, networks unless they stay as they are, the camera's response where there is one, and what of the
        object was estimated."""
        readers = self.triplane.readers
        networks = [*readers.material_network.parameters(), *readers.variance_network.parameters()]
        return {
            "planes": [self.triplane.planes],
            "networks": networks if self.config.fit_networks else [],
            "gloss": [] if readers.others_of_shares is None else [readers.others_of_shares],
            "response": [*self.curve.parameters()],
            "endmembers": [] if self.endmembers is None else [self.endmembers],
            "gains": [] if self.gains is None else [self.gains],
            "light": [] if self.light is None else [*self.light.parameters()],
            "normals": [] if self.relief is None else [*self.relief.parameters()],
        }

    def get_training_callbacks(self) -> list[TrainingCallback]:
        """Gains become the endmembers' own brightness."""
        if self.endmembers is None:
            return []
        family = self.family
        assert isinstance(family, SpectralFamily)
        after = TrainingCallbackLocation.AFTER_TRAIN_ITERATION
        return [TrainingCallback(after, lambda _step, _progress: family.settle_gains())]

    @property
    def prior(self) -> Triplane | None:
        """Neither its material nor its log-variance changes while the object is fitted; None without a prior."""
        return cast("Triplane", self.anchor["triplane"]) if len(self.anchor) else None

    @property
    def mesh(self) -> Mesh:
        """In model space, with the normals that it was given."""
        uv = self.get_buffer("uv") if self.record.has_uv else None
        return Mesh(self.get_buffer("vertices"), self.get_buffer("faces"), self.get_buffer("normals"), uv)

    @property
    def surface(self) -> TriplaneSurface:
        """The materials as they are now."""
        return TriplaneSurface(self.family, self.triplane)

    @property
    def traced(self) -> TracedObject:
        """Mesh, light and materials, ready for rays."""
        return self.traced_with(self.light, self.relief)

    def traced_with(self, light: FittedLight | None, relief: FittedNormals | None) -> TracedObject:
        """The same with copies of what is fitted of light and mesh; the tree over triangles is kept while the vertices
        stay as they are."""
        vertices = self.get_buffer("vertices")
        if self._tree is None or self._tree[1] is not vertices or self._tree[2] != vertices._version:
            self._tree = RayMesh(self.mesh, vertices.device), vertices, vertices._version
        ray_mesh = self._tree[0]
        if relief is not None:
            ray_mesh = ray_mesh.with_normals(relief(self.get_buffer("normals"), self.get_buffer("faces")))
        record = self.record
        moves = MovingFrame.of_numbers(record.moving_frame) if record.moving_frame else None
        image, placement = self.get_buffer("light_map"), (record.rotation_deg, record.exposure_stops)
        if light is not None:
            image, placement = light.light().radiance() * image.new_tensor(record.lamp), (0.0, 0.0)
        environment = Environment(image, *placement, moves)
        return TracedObject(ray_mesh, environment, self.surface)

    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, Tensor]:
        """Two independent estimates of the light along the rays, `halves` (2, R, C); which rays meet the mesh, `found`
        (R), and where, `positions` (N, 3). Pictures are those of `TrainedObject`."""
        traced = self.traced
        found, points = traced.ray_mesh.seen(ray_bundle.origins, ray_bundle.directions)
        rows = found.nonzero()[:, 0]
        twice = points.select(torch.arange(len(rows), device=rows.device).repeat(2))
        light = traced.light(twice, self.config.samples // 2, self.config.bounces, self.generator)
        halves = light.new_zeros(2, len(found), light.shape[1])
        halves = halves.index_copy(1, rows, light.unflatten(0, (2, -1)))
        return {"halves": halves, "found": found, "positions": points.positions}

    def get_loss_dict(
        self,
        outputs: dict[str, Tensor],
        batch: dict[str, Tensor],
        metrics_dict: dict[str, Tensor] | None = None,
    ) -> dict[str, Tensor]:
        """`picture`: the squared error of tone-mapped light, from two independent estimates, of spectral pictures with
        weights; `prior`: the distance from the prior's material."""
        residuals = self._residuals(outputs, batch)
        if isinstance(self.light_curve, LampRatio):
            residuals = residuals * self.light_curve.weights(batch["numbers"])
        losses = {"picture": unbiased_squared_error(residuals, outputs["found"])}
        if self.prior is not None and self.config.regularisation > 0:
            positions = outputs["positions"]
            distance = prior_distance(self.prior, self.surface.parameters(positions), positions)
            losses["prior"] = self.config.regularisation * distance
        return losses

    def get_metrics_dict(self, outputs: dict[str, Tensor], batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """PSNR of the batch, the noise of its few samples left out."""
        with torch.no_grad():
            error = unbiased_squared_error(self._residuals(outputs, batch), outputs["found"])
        return {"psnr": psnr_db(error)}

    @torch.no_grad()
    def get_evaluation_outputs(self, camera: Cameras, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Light and base colour of the pixels that count, under the light that the batch may hold."""
        samples, bounces = self.config.eval_samples, self.config.bounces
        return evaluation_outputs(
            self.traced, camera.to(self.device), batch, samples=samples, bounces=bounces
        )

    def get_image_metrics_and_images(
        self, outputs: dict[str, Tensor], batch: dict[str, Tensor]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """Figures and pictures of one view."""
        compare = partial(self.compared, light_curve=tone_curve("agx"))
        return evaluate_object_image(outputs, batch, family=self.family, display=self.curve, compare=compare)

    def warm_up(self) -> None:
        """Compile the kernels, forward and backward, on a few rays that meet the mesh."""
        towards = -nn.functional.normalize(self.mesh.vertices[:4] + 1e-3, dim=-1)
        bundle = RayBundle(
            -3 * towards, towards, torch.zeros(len(towards), dtype=torch.int64, device=self.device)
        )
        generator, self.generator = self.generator, torch.Generator(self.device).manual_seed(0)
        halves = self.get_outputs(bundle)["halves"]
        torch.autograd.grad(halves.sum(), [self.triplane.planes], allow_unused=True)
        self.generator = generator

    def compared(
        self,
        light: Float[Tensor, "*n C"],
        numbers: Float[Tensor, "*m C"],
        tone: ToneMapping,
        light_curve: nn.Module,
    ) -> tuple[Tensor, Tensor]:
        """Predicted light and a picture's numbers, which are light or what `tone` makes of it, as they are compared;
        `light_curve` is what both go through where the numbers are light."""
        if tone == "linear":
            return light_curve(light), light_curve(numbers)
        curve = self.curve if tone == self.record.tone_mapping else tone_curve(tone)
        return curve(light), numbers.clamp(0, 1)

    def _residuals(self, outputs: dict[str, Tensor], batch: dict[str, Tensor]) -> Float[Tensor, "2 R C"]:
        tone = self.record.tone_mapping
        shown, wanted = self.compared(outputs["halves"], batch["numbers"], tone, self.light_curve)
        return shown - wanted

    def _light_curve(self) -> nn.Module:
        name = self.config.light_curve
        if self.record.is_spectral:
            if name == "agx":
                raise ConfigError("light-curve is agx, which is for 3 colours; choose auto, srgb or linear")
            return LampRatio(self.record.lamp) if name == "auto" else tone_curve(name)
        return tone_curve("agx" if name == "auto" else name)

    def _checked_num_endmembers(self) -> int:
        """K of a spectral material; 0 of materials in colours."""
        is_spectral, bands = self.record.is_spectral, self.record.num_colours
        if is_spectral != (self.config.material == "spectral"):
            raise ConfigError(
                f"the material {self.config.material} does not fit pictures of {bands} "
                f"{'bands' if is_spectral else 'colours'}; choose {'spectral' if is_spectral else 'neural or pbr'}"
            )
        if not is_spectral:
            return 0
        count = self.config.num_endmembers
        if not isinstance(count, int):
            raise ConfigError("num-endmembers is not settled: call resolve_auto first")
        if count > bands:
            raise ConfigError(f"num-endmembers is {count} but the pictures have {bands} bands; choose fewer")
        return count


def prior_distance(
    prior: Triplane, parameters: Float[Tensor, "N P"], positions: Float[Tensor, "N 3"]
) -> Float[Tensor, ""]:
    """Squared distance of parameters from the prior's, each over its expected squared error; mean over the points of
    the sum over the parameters."""
    with torch.no_grad():
        expected, precision = prior.parameters_at(positions), (-prior.log_variance(positions)).exp()
    return ((parameters - expected).square() * precision).sum(dim=-1).mean()


def unbiased_squared_error(residuals: Float[Tensor, "2 R C"], found: Tensor) -> Float[Tensor, ""]:
    """Mean over the pixels that meet the mesh; may be below 0 by chance where the error is small."""
    products = residuals[0] * residuals[1] * found[:, None]
    return products.sum() / (found.sum().clamp(min=1) * residuals.shape[-1])


def _empty_buffers(record: ObjectRecord) -> dict[str, Tensor]:
    buffers = {
        "vertices": torch.zeros(record.num_vertices, 3),
        "faces": torch.zeros(record.num_faces, 3, dtype=torch.int32),
        "normals": torch.zeros(record.num_vertices, 3),
        "light_map": torch.zeros(*record.environment_size, record.num_light_colours),
    }
    return {**buffers, "uv": torch.zeros(record.num_vertices, 2)} if record.has_uv else buffers
