"""What the package registers: the methods `unmix-nerf` and `unmix-nerf-published`, with all their settings.

What takes long to import is imported where a method is used.
"""

from typing import Any

from unmix_plugin.engine.configs import OptimizerConfig, PipelineConfig, TrainerConfig
from unmix_plugin.engine.registry import MethodSpecification


def _scene(*arguments: Any) -> Any:
    from unmix_plugin.trained.open_run import unmix_scene

    return unmix_scene(*arguments)


def _unmix_nerf() -> TrainerConfig:
    from unmix_plugin.settings import HyperspectralDataManagerConfig, UnmixModelConfig

    return TrainerConfig(
        method_name="unmix-nerf",
        max_num_iterations=10_000,
        # With an average, steps may stay large: what they overshoot averages out. Its ramp decides, not the decay: it
        # spans about a ninth of the steps so far, short trainings and long ones alike.
        average_decay=0.999,
        pipeline=PipelineConfig(datamanager=HyperspectralDataManagerConfig(), model=UnmixModelConfig()),
        optimizers={
            # Without decay, floaters grow before single cameras: what few pixels ask for is as good as free.
            "grid": OptimizerConfig(lr=2e-2, final_factor=0.05, weight_decay=1e-7),
            "networks": OptimizerConfig(lr=2e-2, final_factor=0.15),
            "spectra": OptimizerConfig(lr=2e-3, final_factor=0.03),
            "poses": OptimizerConfig(lr=5e-3, final_factor=0.08),
        },
    )


unmix_nerf = MethodSpecification(
    _unmix_nerf,
    name="unmix-nerf",
    description="radiance field of spectral images whose every point is a mixture of a few materials",
    scene=_scene,
)

_AS_PUBLISHED = OptimizerConfig(lr=2e-2, final_factor=5e-4)


def _unmix_nerf_published() -> TrainerConfig:
    from unmix_plugin.settings import (
        HyperspectralDataManagerConfig,
        LossConfig,
        RendererConfig,
        UnmixFieldConfig,
        UnmixModelConfig,
    )

    return TrainerConfig(
        method_name="unmix-nerf-published",
        max_num_iterations=30_000,
        pipeline=PipelineConfig(
            datamanager=HyperspectralDataManagerConfig(subpixels=1, trust_alpha=True, mend_values=False),
            model=UnmixModelConfig(
                endmember_init="vca",
                specular="full",
                light="fixed",
                segmentation="probe",
                as_published=True,
                field=UnmixFieldConfig(
                    num_levels=16,
                    features_per_level=2,
                    finest_resolution=2048,
                    log2_rows_per_level=19,
                    temperature=0.4,
                    scale="per-endmember",
                ),
                renderer=RendererConfig(visible_weight=1.0),
                losses=LossConfig(
                    background="random",
                    spectral=5.0,
                    rgb=1.0,
                    abundances=0.0,
                    exposure=1.0,
                    band_weights=(),
                    relative=0.0,
                ),
            ),
        ),
        optimizers=dict.fromkeys(("grid", "networks", "spectra"), _AS_PUBLISHED),
    )


unmix_nerf_published = MethodSpecification(
    _unmix_nerf_published,
    name="unmix-nerf-published",
    description="UnMix-NeRF as its authors publish it, for comparison; docs/background/method.md says what differs",
    scene=_scene,
)
