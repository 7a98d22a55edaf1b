"""Settings of the hyperspectral data manager."""

from __future__ import annotations

from dataclasses import dataclass, field

from unmix_plugin.engine.configs import DataManagerConfig, Target
from unmix_plugin.engine.model import DataManager
from unmix_plugin.errors import require
from unmix_plugin.presets import Auto
from unmix_plugin.scenes.pixel_table import Components
from unmix_plugin.scenes.scene import SceneOptions


def _data_manager() -> type[DataManager]:
    from unmix_plugin.datamanager import HyperspectralDataManager

    return HyperspectralDataManager


@dataclass(frozen=True)
class HyperspectralDataManagerConfig(DataManagerConfig):
    """How a scene of spectral images is read and sampled."""

    _target: Target = field(default_factory=_data_manager)
    train_num_rays_per_batch: int = 2048
    """Rays of the first training step; the model adapts the number to its budget of samples."""
    scene: SceneOptions = SceneOptions()
    """How the files are read and split."""
    subpixels: int | Auto = "auto"
    """Rays cast through a pixel, along each of its edges; their mean is the pixel, in training and in rendering. Auto
    is 2, but 1 where the training views have more than 4 million pixels: more pixels teach more than exact ones."""
    single_ray_until: float | Auto = "auto"
    """Part of the training in which a pixel has a single ray: coarse shape needs many pixels, not exact ones. Auto is
    0.4 where alpha is known, otherwise 0.8."""
    grid_resolution: int | Auto = "auto"
    """Cells along an edge of the occupancy grid, from which space is carved that the views show to be empty. Auto is
    128 where alpha is known, otherwise 64: only what few cameras see can be carved then."""
    trust_alpha: bool = False
    """Believe alpha even where the light of a pixel contradicts it."""
    mend_values: bool = True
    """Replace stripes and spikes in training views by what is around them: values that stand out from the bands
    beside them and from the pixels around them in that. From 8 bands on, for pixels that memory holds."""
    max_initial_pixels: int = 50_000
    """Pixels, drawn from all training views, from which the endmembers are initialised."""

    memory_gb: float | Auto = "auto"
    """GiB of memory for training pixels. Auto is most of what the device has left. Pixels that need more stay in the
    scene's files, and a part of them is held that is renewed while training goes on."""

    target_components: Components = "auto"
    """Numbers to keep of each training pixel instead of one a band: its components in the subspace that the scene's
    spectra lie in. Auto is none where all bands fit into the memory for training pixels; otherwise, from 100 bands on,
    as many as leave out no more than noise. What training compares are spectra on all bands in any case."""

    def __post_init__(self) -> None:
        """Refuse impossible settings.

        Raises:
            ConfigError: a number out of its range.
        """
        super().__post_init__()
        rules = {
            "memory-gb of at least 0.01 or auto": self.memory_gb == "auto" or self.memory_gb >= 0.01,
            "subpixels of 1 to 8 or auto": self.subpixels == "auto" or 1 <= self.subpixels <= 8,
            "single-ray-until in [0, 1] or auto": self.single_ray_until == "auto"
            or 0 <= self.single_ray_until <= 1,
            "grid-resolution of 8 to 512 or auto": self.grid_resolution == "auto"
            or 8 <= self.grid_resolution <= 512,
            "target-components of at least 1, auto or none": isinstance(self.target_components, str)
            or self.target_components >= 1,
            "max-initial-pixels of at least 1": self.max_initial_pixels >= 1,
        }
        require("the data manager", self, rules)
