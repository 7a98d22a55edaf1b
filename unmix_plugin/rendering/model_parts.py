"""The parts of a model that its settings choose: field, grid, renderer, gains of views and corrections of poses.

`metadata` describes the scene, as in `engine.model.Model`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from unmix_plugin.engine.geometry.space import SceneBox
from unmix_plugin.field import CoefficientField
from unmix_plugin.light.view_gains import ViewGains
from unmix_plugin.model_settings import UnmixModelConfig
from unmix_plugin.operators.occupancy import OccupancyGrid
from unmix_plugin.poses.refinement import PoseRefinement
from unmix_plugin.presets import AlphaPreset, choose
from unmix_plugin.rendering.renderer import VolumeRenderer


def make_field(
    config: UnmixModelConfig,
    preset: AlphaPreset,
    scene_box: SceneBox,
    metadata: Mapping[str, Any],
    num_spectra: tuple[int, int],
    first_step: float,
) -> CoefficientField:
    """The untrained field.

    Args:
        num_spectra: K endmembers and J specular coefficients.
        first_step: Distance of samples at the start of training, model units.
    """
    opacity = choose(config.initial_opacity, preset.initial_opacity)
    refines, field = config.poses == "refine", config.field
    if refines:
        coarsest = min(field.coarsest_resolution, config.pose_refinement.coarsest_resolution)
        field = replace(field, coarsest_resolution=coarsest)
    num_endmembers, num_specular = num_spectra
    return field.setup(
        scene_box=scene_box,
        num_endmembers=num_endmembers,
        num_specular=num_specular,
        initial_density=-math.log1p(-opacity) / first_step,
        pixel_size=metadata["pixel_size"],
        exposure=choose(config.losses.exposure, 1.0),
        lit_by_camera=config.light == "camera",
        lamp=config.moving_lamp,
        is_unbounded=bool(metadata.get("is_unbounded", False)),
        coarse_to_fine=refines,
    )


def make_grid(
    config: UnmixModelConfig, reachable: Bool[Tensor, "X Y Z"], is_unbounded: bool
) -> OccupancyGrid:
    """The occupancy grid before training.

    Where nothing was carved, cells are too many to wait until each was probed: what rays meet in them counts as well.
    """
    records_observed = is_unbounded or config.poses == "refine"
    return OccupancyGrid(reachable, config.moving_lamp is not None, records_observed)


def make_renderer(
    config: UnmixModelConfig,
    preset: AlphaPreset,
    scene_box: SceneBox,
    grid: OccupancyGrid,
    step: float,
    is_unbounded: bool,
) -> VolumeRenderer:
    """The renderer of rays through a grid as it is now.

    Args:
        scene_box: On the grid's device.
        step: Distance of samples, model units.
    """
    return VolumeRenderer(
        scene_box,
        grid.skips,
        grid.reachable,
        step,
        choose(config.renderer.smallest_weight, preset.smallest_weight),
        is_unbounded,
        config.losses.background == "last",
        config.eval_num_rays_per_chunk,
        grid.opaque_skips,
    )


def make_view_gains(config: UnmixModelConfig, metadata: Mapping[str, Any]) -> ViewGains | None:
    """Gains of the training views; None where they are not learnt."""
    if config.light != "per-view":
        return None
    return ViewGains(metadata["num_train_views"], torch.tensor(metadata["wavelengths_nm"]))


def make_pose_refinement(config: UnmixModelConfig, metadata: Mapping[str, Any]) -> PoseRefinement | None:
    """Corrections of the training views' poses; None where poses are taken as they are."""
    if config.poses != "refine":
        return None
    rows = metadata.get("line_rows") or [0] * metadata["num_train_views"]
    return PoseRefinement(rows, config.pose_refinement.lens)
