"""Tiny models and ray bundles for tests of the method."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import RayBundle, SceneBox
from unmix_plugin.engine.runs.loading import SceneRecord
from unmix_plugin.field import CoefficientField
from unmix_plugin.losses.terms import ComparedPixels
from unmix_plugin.model import TrainingBatch, UnmixModel
from unmix_plugin.poses.training import CorrectedRays
from unmix_plugin.rendering.renderer import RenderedRays
from unmix_plugin.sensors.views import from_batch
from unmix_plugin.settings import RendererConfig, UnmixFieldConfig, UnmixModelConfig
from unmix_plugin.spectral.intervals import Interval
from unmix_plugin.spectral.materials import Coefficients, Materials
from unmix_plugin.trained.open_run import unmix_scene
from unmix_plugin.trained.trained_scene import TrainedScene

NUM_BANDS = 5
WAVELENGTHS_NM = [450.0, 500.0, 550.0, 600.0, 650.0]
POSE = torch.tensor([[[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4.0]]])
CAMERA = Cameras(POSE, torch.full((1, 2), 20.0), torch.tensor([[6.0, 5.0]]), torch.zeros(1, 4), 12, 10)
BOX = SceneBox(torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]))
CONFIG = UnmixModelConfig(
    num_endmembers=3,
    field=UnmixFieldConfig(
        num_levels=2, coarsest_resolution=4, cells_per_pixel=0.34, log2_rows_per_level=10, hidden_width=16
    ),
    renderer=RendererConfig(samples_per_pixel=1.0, smallest_weight=0.0),
)


def around_endmembers(materials: Materials) -> Interval:
    """90 % intervals of endmembers, 0.05 to both sides."""
    spectra = materials.endmembers.double().numpy()
    return Interval((spectra - 0.05).clip(min=0), spectra + 0.05, 0.9)


def make_model(
    seed: int = 0,
    has_alpha: bool = True,
    light: list[float] | None = None,
    more_metadata: dict[str, Any] | None = None,
    more_data: dict[str, np.ndarray] | None = None,
    **settings: Any,
) -> UnmixModel:
    """A model with random parameters of some size, so that its picture isn't uniform."""
    torch.manual_seed(seed)
    metadata = {"wavelengths_nm": WAVELENGTHS_NM, "illuminant": light, "has_alpha": has_alpha, "subpixels": 2}
    metadata |= {"grid_resolution": 8, "num_train_views": 3, "pixel_size": 0.087, **(more_metadata or {})}
    model: UnmixModel = replace(CONFIG, **settings).setup(scene_box=BOX, metadata=metadata)
    with torch.no_grad():
        model.initialise({**initial_data(), **(more_data or {})}, torch.Generator().manual_seed(seed))
        model.field.get_parameter("table").normal_(std=0.5)
    return model.eval()


def scene_of(model: UnmixModel, cameras: Cameras = CAMERA) -> TrainedScene:
    """The scene of a model as it is now, whose training and evaluation views are `cameras`."""
    return unmix_scene(model, SceneRecord(BOX, dict(model.metadata), cameras, cameras, {}))


def with_a_sky(field: Any) -> CoefficientField:
    """The field with a black sky behind all that is rendered."""
    world, black = copy.deepcopy(field), torch.tensor([*[0.0] * field.num_endmembers, -100.0])
    world.sky_network = lambda features: black.expand(len(features), -1)
    return world


def make_scene(
    seed: int = 0, has_alpha: bool = True, light: list[float] | None = None, **settings: Any
) -> TrainedScene:
    """The scene of `make_model` with the same arguments."""
    return scene_of(make_model(seed, has_alpha, light, **settings))


def initial_data() -> dict[str, np.ndarray]:
    """Pixels of three well separated materials, and a box with nothing carved away."""
    g = np.random.default_rng(0)
    shapes = np.eye(3, NUM_BANDS, dtype=np.float32) * 0.6 + 0.1
    pixels = shapes[g.integers(0, 3, 300)] * g.uniform(0.5, 1, (300, 1)).astype(np.float32)
    return {
        "pixels": pixels + g.normal(0, 1e-3, pixels.shape).astype(np.float32) ** 2,
        "reachable": np.ones((8, 8, 8), bool),
    }


def make_rays(num_rays: int, seed: int = 0) -> RayBundle:
    """Rays towards the box from all around; the last one misses it."""
    g = torch.Generator().manual_seed(seed)
    origins = 3 * torch.nn.functional.normalize(torch.randn(num_rays, 3, generator=g), dim=-1)
    targets = torch.rand(num_rays, 3, generator=g) - 0.5
    directions = torch.nn.functional.normalize(targets - origins, dim=-1)
    directions[-1:] *= -1
    return RayBundle(origins, directions, torch.zeros(num_rays, dtype=torch.int64))


def losses_of(
    model: UnmixModel,
    batch: dict[str, torch.Tensor],
    spectra: torch.Tensor,
    opacities: torch.Tensor,
    abundances: torch.Tensor | None = None,
    sparsity: float = 0.0,
    certainty: float = 0.0,
) -> dict[str, torch.Tensor]:
    """Losses of pixels, with one ray each, that are rendered so; `spectra` are on black."""
    count, none = len(spectra), torch.zeros(0)
    abundances = torch.zeros(count, model.num_endmembers) if abundances is None else abundances
    nothing = Coefficients(torch.zeros(count, 2), 0)
    sums = torch.tensor(sparsity), torch.tensor(certainty)
    rendered = RenderedRays(nothing, abundances, *sums, torch.zeros(0, 3), none, none.long(), ())
    [measured] = from_batch({"pixels": torch.arange(count), **batch}, count, model.seen_by.num_channels)
    mixtures = model.comparison.unmix(measured)
    compared = ComparedPixels(measured, 1.0, slice(0, count, 1), spectra, opacities, abundances, *mixtures)
    return model.losses(TrainingBatch(CorrectedRays(make_rays(count)), rendered, [compared]))
