"""Settings of the renderer."""

from __future__ import annotations

from dataclasses import dataclass

from unmix_plugin.errors import require
from unmix_plugin.presets import Auto, choose

_LARGE_BOX = 300
"""Pixels along the scene box from which on fewer samples a pixel do."""


@dataclass(frozen=True)
class RendererConfig:
    """How finely rays are sampled and what is left out."""

    samples_per_pixel: float | Auto = "auto"
    """Samples of a ray along the length of a pixel's edge where it meets the middle of the scene box. Auto is 1.5, but
    1 where alpha is known and the box is more than 300 pixels long: more rays teach more than closer samples."""
    coarse_samples: int | Auto = "auto"
    """Samples along the longest edge of the scene box at the start of training, if there are more in the end: what is
    coarse must be found first, by many rays of few samples. Auto is 256, but 64 in an unbounded world, where rays go
    on outside the box."""
    coarse_until: float = 0.5
    """Part of the training in which samples move together to the distance they have in the end."""
    smallest_weight: float | Auto = "auto"
    """Samples that contribute less than this share of their ray's light are left out. Auto is 0.004 where alpha is
    known, else 0.001."""
    visible_weight: float | Auto = "auto"
    """Share of its ray's light from which a sample counts as seen. Cells that no two training views have lately seen
    are left out; 1 leaves none out. Auto is 0.05 where alpha is known, else 1."""

    def __post_init__(self) -> None:
        """Refuse impossible settings.

        Raises:
            ConfigError: a number out of its range.
        """
        rules = {
            "samples-per-pixel of 0.01 to 100 or auto": self.samples_per_pixel == "auto"
            or 0.01 <= self.samples_per_pixel <= 100,
            "coarse-samples of at least 1 or auto": self.coarse_samples == "auto" or self.coarse_samples >= 1,
            "coarse-until in [0, 1]": 0 <= self.coarse_until <= 1,
            "smallest-weight in [0, 1) or auto": self.smallest_weight == "auto"
            or 0 <= self.smallest_weight < 1,
            "visible-weight in (0, 1] or auto": self.visible_weight == "auto" or 0 < self.visible_weight <= 1,
        }
        require("the renderer", self, rules)

    def sample_distance(self, pixel_size: float, longest_edge: float, has_alpha: bool) -> float:
        """Distance of samples in the unit of a pixel's edge and of the scene box's longest one.

        >>> [RendererConfig().sample_distance(1.0, edge, has_alpha=True) for edge in (270.0, 480.0)]
        [0.6666666666666666, 1.0]
        """
        is_large = has_alpha and longest_edge > _LARGE_BOX * pixel_size
        return pixel_size / choose(self.samples_per_pixel, 1.0 if is_large else 1.5)

    def coarseness(self, samples: float, coarse_samples: int, progress: float) -> float:
        """Factor on the distance of samples when that part of the training is over.

        Args:
            samples, coarse_samples: Along the longest edge of the scene box in the end, and at the start.
            progress: In [0, 1].

        >>> RendererConfig(coarse_until=0.5).coarseness(400.0, 100, 0.25)
        2.0
        """
        left = 0.0 if progress >= self.coarse_until else 1.0 - progress / self.coarse_until
        return max(samples / coarse_samples, 1.0) ** left
