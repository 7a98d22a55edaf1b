"""A second method, as a third party would write it: a plain RGB radiance field with a tiny synthetic scene."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from unmix_plugin.engine import (
    Cameras,
    DataManager,
    DataManagerConfig,
    Field,
    MethodSpecification,
    Model,
    ModelConfig,
    OptimizerConfig,
    Output,
    PipelineConfig,
    RayBundle,
    SceneBox,
    Target,
    TrainerConfig,
    step_generator,
    upright_cameras,
)

VIEWS, SIZE = 12, 20


@dataclass(frozen=True)
class BallConfig(DataManagerConfig):
    _target: Target = field(default_factory=lambda: BallDataManager)
    train_num_rays_per_batch: int = 512
    eval_views: tuple[int, ...] = (4, 7)


class BallDataManager(DataManager):
    """Views of a ball coloured by its normals, traced analytically."""

    def __init__(self, config: BallConfig, *, data: Path, device: torch.device, seed: int = 0) -> None:
        super().__init__(config, data=data, device=device, seed=seed)
        turns, heights = np.arange(VIEWS) * 2.399963, np.linspace(-0.7, 0.7, VIEWS)
        across = np.sqrt(1 - heights**2)[:, None] * np.stack([np.cos(turns), np.sin(turns)], axis=1)
        backs = np.concatenate([across, heights[:, None]], axis=1)
        cameras = upright_cameras(3.0 * backs, backs, SIZE, 2 * np.arctan(1 / 3.6))
        self.eval_cameras = cameras[list(config.eval_views)]
        self.train_cameras = cameras[[view for view in range(VIEWS) if view not in config.eval_views]]
        self.scene_box = SceneBox(torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]))
        self.num_rays = config.train_num_rays_per_batch

    def next_train(self, step: int) -> tuple[RayBundle, dict[str, Tensor]]:
        return self._sample(self.train_cameras, step)

    def eval_image(self, index: int) -> tuple[Cameras, dict[str, Tensor]]:
        truth = _trace(self.eval_cameras.image_rays(index)).reshape(SIZE, SIZE, 3)
        return self.eval_cameras[index], {"rgb": truth.to(self.device)}

    def get_train_rays_per_batch(self) -> int:
        return self.num_rays

    def set_train_rays_per_batch(self, num_rays: int) -> None:
        self.num_rays = num_rays

    def metadata(self) -> dict[str, Any]:
        return {"grid_size": 20}

    def initial_data(self) -> Mapping[str, np.ndarray]:
        return {"raw_density": np.full(1, -2.0, dtype=np.float32)}

    def summary(self) -> dict[str, Any]:
        return {"scene": "ball"}

    def _sample(self, cameras: Cameras, step: int) -> tuple[RayBundle, dict[str, Tensor]]:
        generator = step_generator(self.seed, step)
        indices = torch.randint(len(cameras), (self.num_rays,), generator=generator)
        rays = cameras.generate_rays(indices, SIZE * torch.rand(self.num_rays, 2, generator=generator))
        return rays.to(self.device), {"rgb": _trace(rays).to(self.device)}


class GridField(Field):
    """Raw density and colour on a dense grid over [-1, 1]^3."""

    def __init__(self, grid_size: int) -> None:
        super().__init__()
        self.grid = nn.Parameter(0.01 * torch.randn(1, 4, grid_size, grid_size, grid_size))

    def get_density(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        points = positions.reshape(1, 1, 1, -1, 3)
        values = nn.functional.grid_sample(self.grid, points, align_corners=True).reshape(4, -1)
        values = values.T.reshape(*positions.shape[:-1], 4)
        return 10.0 * nn.functional.softplus(values[..., 0]), values[..., 1:]

    def get_outputs(self, positions: Tensor, directions: Tensor, features: Tensor) -> dict[str, Tensor]:
        return {"rgb": features.sigmoid()}


@dataclass(frozen=True)
class RgbNerfConfig(ModelConfig):
    _target: Target = field(default_factory=lambda: RgbNerf)
    eval_num_rays_per_chunk: int = 256
    num_samples_per_ray: int = 32


class RgbNerf(Model):
    """Stratified samples through the box, composited front to back on black."""

    config: RgbNerfConfig
    outputs = (
        Output("rgb", "srgb", "colour", "sRGB on black, 0 to 1"),
        Output("accumulation", "map", "opacity", "opacity, 0 to 1", (0.0, 1.0), "gray"),
    )

    def populate_modules(self) -> None:
        self.field = GridField(self.metadata["grid_size"])

    def initialise(self, initial_data: Mapping[str, np.ndarray], generator: torch.Generator) -> None:
        self.field.grid[:, 0] += float(initial_data["raw_density"][0])

    def get_param_groups(self) -> dict[str, list[nn.Parameter]]:
        return {"fields": list(self.field.parameters())}

    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, Tensor]:
        count = self.config.num_samples_per_ray
        t_near, t_far = self.scene_box.to(self.device).intersect(ray_bundle.origins, ray_bundle.directions)
        edges = torch.linspace(0.0, 1.0, count + 1, device=self.device)[:-1].expand(len(ray_bundle), count)
        jitter = torch.full_like(edges, 0.5)
        if self.training:
            jitter = torch.rand(edges.shape, generator=self.generator, device=self.device)
        ts = t_near[:, None] + (t_far - t_near)[:, None] * (edges + jitter / count)
        positions = ray_bundle.origins[:, None] + ts[..., None] * ray_bundle.directions[:, None]
        densities, found = self.field(positions, ray_bundle.directions[:, None].expand_as(positions))
        optical = densities * ((t_far - t_near) / count)[:, None]
        transmittances = torch.exp(optical - optical.cumsum(dim=-1))
        weights = transmittances * (1.0 - torch.exp(-optical))
        return {"rgb": (weights[..., None] * found["rgb"]).sum(dim=1), "accumulation": weights.sum(dim=1)}

    def get_metrics_dict(self, outputs: dict[str, Tensor], batch: dict[str, Tensor]) -> dict[str, Tensor]:
        return {"psnr": -10.0 * (outputs["rgb"] - batch["rgb"]).detach().square().mean().log10()}

    def get_loss_dict(
        self,
        outputs: dict[str, Tensor],
        batch: dict[str, Tensor],
        metrics_dict: dict[str, Tensor] | None = None,
    ) -> dict[str, Tensor]:
        return {"rgb_loss": (outputs["rgb"] - batch["rgb"]).square().mean()}

    def get_image_metrics_and_images(
        self, outputs: dict[str, Tensor], batch: dict[str, Tensor]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        return {"psnr": float(self.get_metrics_dict(outputs, batch)["psnr"])}, {"rgb": outputs["rgb"]}

    def next_num_rays(self, num_samples: int, current: int) -> int | None:
        return min(current + 1, 600)


rgb_nerf = MethodSpecification(
    TrainerConfig(
        method_name="rgb-nerf",
        max_num_iterations=200,
        pipeline=PipelineConfig(datamanager=BallConfig(), model=RgbNerfConfig()),
        optimizers={"fields": OptimizerConfig(lr=0.2, final_factor=0.1)},
    ),
    "Plain RGB radiance field.",
)


def _trace(rays: RayBundle) -> Tensor:
    """Colour of the ball of radius 0.6 at the origin, black beside it."""
    along = (rays.origins * rays.directions).sum(dim=-1)
    discriminant = along.square() - rays.origins.square().sum(dim=-1) + 0.36
    normals = (rays.origins + (-along - discriminant.clamp_min(0).sqrt())[:, None] * rays.directions) / 0.6
    return torch.where(discriminant[:, None] > 0, 0.5 + 0.4 * normals, torch.zeros(3))
