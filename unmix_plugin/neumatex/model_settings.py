"""Settings of the model neumatex, and how those that follow from the object are found."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch

from unmix_plugin.engine import Model, ModelConfig, Target
from unmix_plugin.engine.configs import Common, short
from unmix_plugin.errors import require
from unmix_plugin.neumatex.material_surface import MaterialName
from unmix_plugin.neumatex.tone.curves import LightCurve
from unmix_plugin.spectral.unmixing.endmembers import EndmemberMethod

Auto = Literal["auto"]
PriorName = Literal["small", "none"]


def _model() -> type[Model]:
    from unmix_plugin.neumatex.model import NeumatexModel

    return NeumatexModel


@dataclass(frozen=True)
class NeumatexModelConfig(ModelConfig):
    """What is fitted, and how it is rendered meanwhile."""

    _target: Target = field(default_factory=_model)
    eval_num_rays_per_chunk: int = 4096
    """Pixels rendered at once for a whole image; fewer take less memory."""
    material: Annotated[MaterialName, Common] = "neural"
    """Family of materials: neural (base colour and latents of a shared decoder), pbr (base colour, roughness,
    metallicity), or for pictures of many bands spectral (a mixture of endmember reflectances under a grey gloss)."""
    num_endmembers: Annotated[int | Auto | None, Common, short("endmembers")] = None
    """Of spectral materials: K, how many reflectances are mixed; auto proposes it from the training pixels. None is the
    number of --pipeline.model.from-run, otherwise 6, or the number of bands if that is smaller."""
    endmember_init: EndmemberMethod = "pairs"
    """Of spectral materials: first guess of the endmembers, from the pixels divided by the light that reaches them."""
    from_run: Annotated[Path | None, Common] = None
    """Of spectral materials: run of unmix-nerf whose endmembers and abundances the fit starts from."""
    samples: Annotated[int, Common] = 16
    """Paths a pixel in training, in two independent halves; more is slower and less noisy. Few leave a bias, since tone
    curves bend: at equal time, 16 in half as many pixels did better than 8, and 4 in twice as many worse."""
    bounces: Annotated[int, Common] = 1
    """How often light may be reflected between parts of the object before it reaches the point that is seen."""
    render_samples: Annotated[int, Common] = 64
    """Paths a pixel in renders and in the viewer."""
    eval_samples: Annotated[int, Common] = 256
    """Paths a pixel in evaluation, where noise would count as an error of the material: with 64 a good fit measures
    1.4 dB worse than it is, with 256 0.2 dB."""
    prior: Annotated[PriorName, Common] = "small"
    """Where the fit starts and what it is held to: small is the prior of the package; none starts from a plain grey
    material. Spectral materials have no prior: they start from the pictures or from a run."""
    fit_networks: bool = True
    """Fit the networks that read the planes, too. Published with a prior: the planes alone."""
    regularisation: float = 1e-5
    """Weight of the distance from the prior, over its expected squared error. Less than the squared error of a fitted
    pixel: what the prior has wrong it has wrong in whole regions, so that many of its points count as few."""
    plane_resolution: int = 128
    """Texels along an edge of each of the three planes."""
    light_curve: LightCurve | Auto = "auto"
    """Tone curve through which pictures of linear light are compared in training; others are compared as they are. Auto
    is agx for colours; for bands light over the lamp's power, its logarithm above 1, so that dim bands count too."""

    def __post_init__(self) -> None:
        """Refuse impossible settings.

        Raises:
            ConfigError: a number out of its range.
        """
        super().__post_init__()
        rules = {
            "samples of 2 to 1024": 2 <= self.samples <= 1024,
            "bounces of 0 to 8": 0 <= self.bounces <= 8,
            "render-samples of 1 to 65536": 1 <= self.render_samples <= 65536,
            "eval-samples of 1 to 65536": 1 <= self.eval_samples <= 65536,
            "regularisation of at least 0": 0 <= self.regularisation < float("inf"),
            "plane-resolution of 2 to 2048": 2 <= self.plane_resolution <= 2048,
        }
        count = self.num_endmembers
        rules["num-endmembers of 1 to 64 or auto"] = count in (None, "auto") or 1 <= int(count) <= 64
        rules["from-run with the material spectral only"] = (
            self.from_run is None or self.material == "spectral"
        )
        require("the model", self, rules)

    def resolve_auto(
        self, initial_data: Callable[[], Mapping[str, np.ndarray]], generator: torch.Generator
    ) -> tuple[NeumatexModelConfig, str]:
        """With a number of endmembers, where the material is spectral.

        Raises:
            SpectrumError: no pixel is neither dark nor saturated.
            ConfigError, RunError: the run to start from is unusable.
        """
        if self.material != "spectral" or isinstance(self.num_endmembers, int):
            return self, ""
        from unmix_plugin.neumatex.spectral_start import resolved_num_endmembers

        count, reason = resolved_num_endmembers(self, initial_data(), generator)
        return replace(self, num_endmembers=count), reason
