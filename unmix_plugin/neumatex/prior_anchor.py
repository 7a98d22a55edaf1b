"""What a prior said of an object's material, kept while the object is fitted.

Notation: `N` points, `P` parameters, `V` views of `H x W` pixels.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from unmix_plugin.engine import Cameras
from unmix_plugin.neumatex.prior.views import PosedViews, well_spread
from unmix_plugin.neumatex.scene.object_scene import ObjectScene
from unmix_plugin.neumatex.scene.posed_pictures import opacity
from unmix_plugin.neumatex.triplane import Triplane
from unmix_plugin.spectral.colour.conversion import srgb_to_linear

MOST_VIEWS = 12
LONGEST_EDGE_PX = 512
"""Of the views that a prior sees; larger ones are thinned out."""


class PriorAnchor(nn.Module):
    """The prior's material and its log-variance, neither of which changes."""

    def __init__(self, triplane: Triplane) -> None:
        """
        Args:
            triplane: Is copied by `adopt` later; gives the shapes.
        """
        super().__init__()
        self.triplane = triplane.requires_grad_(False)

    @torch.no_grad()
    def adopt(self, triplane: Triplane) -> None:
        """Keep what a triplane holds now."""
        self.triplane.load_state_dict(triplane.state_dict())

    def distance(
        self, parameters: Float[Tensor, "N P"], positions: Float[Tensor, "N 3"]
    ) -> Float[Tensor, ""]:
        """Squared distance of parameters from the prior's, each over its expected squared error; mean over the points
        of the sum over the parameters."""
        with torch.no_grad():
            expected = self.triplane.parameters_at(positions)
            precision = (-self.triplane.log_variance(positions)).exp()
        return ((parameters - expected).square() * precision).sum(dim=-1).mean()


def view_arrays(scene: ObjectScene) -> dict[str, np.ndarray]:
    """Training views that a prior may look at, as arrays by name; `views_of` puts them together again."""
    train = list(scene.split.train)
    cameras = scene.pictures.cameras[train]
    arrays: dict[str, np.ndarray] = {}
    chosen = well_spread(cameras.camera_to_world[:, :, 3], MOST_VIEWS)
    for number, row in enumerate(chosen):
        picture = scene.pictures.read(train[row])
        height, width = picture.numbers.shape[:2]
        step = max(1, -(-max(height, width) // LONGEST_EDGE_PX))
        # Pixel c of a thinned-out view is pixel c step of the whole one; centres are at + 0.5.
        lens = torch.cat([cameras.focal_px[row] / step, (cameras.center_px[row] - 0.5) / step + 0.5])
        light = torch.from_numpy(picture.numbers[::step, ::step].copy())
        if scene.pictures.tone != "linear":
            light = srgb_to_linear(light)  # about; an unknown response is only known after the fit
        arrays[f"view_{number}_light"] = light.numpy()
        arrays[f"view_{number}_alpha"] = opacity(picture)[::step, ::step].copy()
        arrays[f"view_{number}_pose"] = cameras.camera_to_world[row].numpy()
        arrays[f"view_{number}_lens"] = torch.cat([lens, cameras.distortion[row]]).numpy()
    return arrays


def views_of(arrays: Mapping[str, np.ndarray]) -> PosedViews:
    """The views of `view_arrays`."""
    count = sum(name.startswith("view_") and name.endswith("_pose") for name in arrays)
    kinds = {
        kind: [torch.from_numpy(arrays[f"view_{number}_{kind}"]) for number in range(count)]
        for kind in ("light", "alpha", "pose", "lens")
    }
    lenses = torch.stack(kinds["lens"])
    sizes = [(alpha.shape[1], alpha.shape[0]) for alpha in kinds["alpha"]]
    cameras = Cameras.of_sizes(
        torch.stack(kinds["pose"]), lenses[:, :2], lenses[:, 2:4], lenses[:, 4:], sizes
    )
    return PosedViews(cameras, kinds["light"], kinds["alpha"])
