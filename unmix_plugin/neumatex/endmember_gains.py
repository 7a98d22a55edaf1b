"""Endmembers of a spectral material as they are fitted: their shapes slowly, their brightness fast.

How bright a material is known light tells soon. The shape of a spectrum is less certain: where it may move as fast, it
drifts towards mixtures. So each endmember has a gain with a rate of its own, which is folded into it after every step.

Notation: `K` endmembers, `B` bands.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor, nn

from unmix_plugin.errors import ConfigError

if TYPE_CHECKING:
    from unmix_plugin.neumatex.model_settings import NeumatexModelConfig
    from unmix_plugin.neumatex.object_record import ObjectRecord


def empty_endmembers(config: NeumatexModelConfig, record: ObjectRecord) -> nn.Parameter | None:
    """Endmembers (K, B) of a spectral material, not yet filled; None for materials in colours.

    Raises:
        ConfigError: the material does not fit the pictures.
    """
    count, bands = config.num_endmembers, record.num_colours
    if record.is_spectral != (config.material == "spectral"):
        fitting = "spectral" if record.is_spectral else "neural or pbr"
        raise ConfigError(
            f"the material {config.material} does not fit pictures of {bands} "
            f"{'bands' if record.is_spectral else 'colours'}; choose {fitting}"
        )
    if not record.is_spectral:
        return None
    if not isinstance(count, int):
        raise ConfigError("num-endmembers is not settled: call resolve_auto first")
    if count > bands:
        raise ConfigError(f"num-endmembers is {count} but the pictures have {bands} bands; choose fewer")
    return nn.Parameter(torch.zeros(count, bands))


@torch.no_grad()
def settle(endmembers: Float[Tensor, "K B"], gains: Float[Tensor, " K"]) -> None:
    """Make endmembers as bright as their gains say, as far as reflectances can be, and the gains 1; in place."""
    bright = endmembers.clamp(0, 1) * gains.clamp(min=0)[:, None]
    endmembers.copy_(bright / bright.amax(dim=1, keepdim=True).clamp(min=1))
    gains.fill_(1)
