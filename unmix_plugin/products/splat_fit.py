"""Gaussians that are fitted to what a trained scene renders, so that viewers of splats show nearly what its field does.

They start as flat discs on the surface that the training views see, and are then moved, turned, stretched, faded and
coloured until pictures blended of them are like the field's own, from its training cameras and from cameras between
these. No view that is kept for evaluation is rendered.

The fit knows what viewers do: colours are blended as sRGB, front to back by depth, and each Gaussian is blurred by a
third of a pixel of the screen, of which an object seen near has many more than the capture had. So pictures are means
over parts of pixels, in linear light, as the field's are, and steps take turns in how large a screen they stand for.
Drawn as small as the capture's pictures, splats are blurred by viewers.

What lies outside the scene box, and a sky or a backdrop behind all, stays out, as of other exports of the surface.

Notation: `P` Gaussians, `H x W` pixels, `C` coefficients. Model space; camera axes as in `Cameras`.

Source: Kerbl et al. 2023, 3D Gaussian Splatting for Real-Time Radiance Field Rendering; the projection is that of
Zwicker et al. 2002, EWA Splatting.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from unmix_plugin.engine.geometry.camera_paths import interpolated
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.sampling import evenly_spaced
from unmix_plugin.formats.meshes import least_turns
from unmix_plugin.operators.splatting import splat, tile_lists
from unmix_plugin.products.point_cloud import even_cover
from unmix_plugin.spectral.colour.conversion import linear_to_srgb, srgb_to_linear
from unmix_plugin.spectral.materials import OCCUPIED_ACCUMULATION, Coefficients
from unmix_plugin.trained.run_views import cameras_of, views_of
from unmix_plugin.trained.surface import Follow, SeenSurface, SurfaceAppearance, look_at
from unmix_plugin.trained.trained_scene import TrainedScene

_BLUR = 0.3
"""Variance, square pixels of the screen, that viewers add to what they draw."""
_BLURS = (_BLUR, _BLUR / 16, _BLUR / 4, _BLUR, _BLUR / 16)
"""Of screens with once, four and two times as many pixels a side as are drawn here, in turns; the extremes, which are
hardest to fit together, twice."""
_NEAR = 1e-3
"""Depth, model units, before which nothing is drawn."""
_MARGIN = 1.3
"""Of the picture, beyond which the slope of the projection stays what it is, as in viewers: it has no bound."""

_WIDTH, _THICKNESS, _OPACITY = 0.75, 0.1, 0.88
"""At the start: standard deviation along the surface and across it, over the distance to neighbours."""
_RAYS_PER_SPLAT = 4
_SPACING = 1.0
"""Distance of discs at the start, at least, pixels in the middle of the scene: smaller ones are drawn too large."""
_NEIGHBOURS = 3

_FINE_PICTURE = 1 << 15
"""Pixels up to which each is drawn in `_SUBPIXELS` squared parts."""
_SUBPIXELS = 2
_LARGEST_PICTURE = 1 << 16
_NUM_PIXELS = 1 << 21
"""Of all pictures together."""
_PICTURES_PER_VIEW = 4
"""At most: those between the training views keep Gaussians from fitting these alone."""

_RATES = {"positions": 0.1, "rotations": 0.01, "log_scales": 0.02, "opacity_logits": 0.05, "srgb": 0.006}
"""Of Adam; of positions in pixels in the middle of the scene."""
_LAST_RATE = 0.05
"""Of the first, falling geometrically."""
_LEAST_SEEN = 0.1
"""Pixels that a Gaussian fills in the training view that shows most of it, below which it is left out: what is not seen
was not fitted."""


@dataclass(frozen=True)
class FittedSplats:
    """Gaussians as they are fitted."""

    positions: Float[Tensor, "P 3"]
    rotations: Float[Tensor, "P 4"]
    """Quaternions x, y, z, w of any length, from an ellipsoid's axes to model space."""
    log_scales: Float[Tensor, "P 3"]
    """Logarithms of the standard deviations along these axes."""
    opacity_logits: Float[Tensor, " P"]
    srgb: Float[Tensor, "P 3"]
    """A little beyond [0, 1] where that fits better; what is below 0 shows as 0."""

    def __len__(self) -> int:
        return len(self.positions)

    def select(self, chosen: Bool[Tensor, " P"]) -> FittedSplats:
        """Some of them."""
        return FittedSplats(*(getattr(self, field.name)[chosen] for field in fields(self)))

    def to(self, device: torch.device) -> FittedSplats:
        """The same on another device."""
        return FittedSplats(*(getattr(self, field.name).to(device) for field in fields(self)))

    def picture(self, camera: Cameras, subpixels: int = 1, blur: float = _BLUR) -> Float[Tensor, "H W 4"]:
        """What a viewer shows through one pinhole camera: sRGB on black and opacity; with `subpixels` squared parts a
        pixel means over these, in linear light. Each Gaussian gets `blur` more variance, in square parts of a pixel."""
        fine = camera.resized(subpixels * camera.width, subpixels * camera.height)
        colours = torch.cat([self.srgb.clamp(min=0), torch.ones_like(self.srgb[:, :1])], dim=-1)
        blended = self._blended(fine, colours, blur)
        if subpixels == 1:
            return blended
        light = torch.cat([srgb_to_linear(blended[..., :3].clamp(max=1)), blended[..., 3:]], dim=-1)
        means = light.unflatten(0, (-1, subpixels)).unflatten(2, (-1, subpixels)).mean(dim=(1, 3))
        return torch.cat([linear_to_srgb(means[..., :3]), means[..., 3:]], dim=-1)

    def seen_means(
        self, cameras: Sequence[Cameras], pictures: Sequence[Float[Tensor, "H W C"]]
    ) -> tuple[Float[Tensor, "P C"], Float[Tensor, " P"]]:
        """Of each, the mean of what pictures show where it is seen, weighted by how much it shows there; and the sum of
        these weights, pixels, in the picture that shows it most."""
        sums = self.positions.new_zeros(len(self), pictures[0].shape[-1])
        total, most = self.positions.new_zeros(len(self)), self.positions.new_zeros(len(self))
        for camera, picture in zip(cameras, pictures, strict=True):
            # A picture is linear in its colours, so its slope by a colour is the sum of what a Gaussian is seen by.
            values = torch.cat([picture, torch.ones_like(picture[..., :1])], dim=-1).to(sums.device)
            colours = self.positions.new_zeros(len(self), values.shape[-1]).requires_grad_()
            seen = torch.autograd.grad(self._blended(camera, colours), colours, values)[0]
            sums, total, most = sums + seen[:, :-1], total + seen[:, -1], torch.maximum(most, seen[:, -1])
        return sums / total.clamp(min=1e-9)[:, None], most

    def _blended(
        self, camera: Cameras, colours: Float[Tensor, "P C"], blur: float = _BLUR
    ) -> Float[Tensor, "H W C"]:
        """Colours blended through one pinhole camera."""
        camera = camera.to(self.positions.device)
        pose, focal, center = camera.camera_to_world[0], camera.focal_px[0], camera.center_px[0]
        turn = pose[:, :3] * pose.new_tensor([1.0, -1.0, -1.0])  # to x right, y down, z forward
        local = (self.positions - pose[:, 3]) @ turn
        depths = local[:, 2]
        slopes = local[:, :2] / depths.clamp(min=_NEAR)[:, None]
        most = _MARGIN * pose.new_tensor([camera.width, camera.height]) / (2 * focal)
        bounded = torch.minimum(torch.maximum(slopes, -most), most)

        # Rows of the matrix whose product with its transpose is the covariance in the picture.
        axes = (turn.T @ _rotation_matrices(self.rotations)) * self.log_scales.exp()[:, None, :]
        axes = axes / depths.clamp(min=_NEAR)[:, None, None]
        across, down = (focal[i] * (axes[:, i] - bounded[:, i, None] * axes[:, 2]) for i in (0, 1))
        xx, xy, yy = (
            (one * other).sum(-1) for one, other in ((across, across), (across, down), (down, down))
        )
        xx, yy = xx + blur, yy + blur
        conics = torch.stack([yy, -xy, xx], dim=-1) / (xx * yy - xy * xy)[:, None]

        means, opacities = slopes * focal + center, torch.sigmoid(self.opacity_logits)
        drawn = torch.where(depths > _NEAR, depths, 0.0)
        lists = tile_lists(means, conics, opacities, drawn, camera.width, camera.height)
        return splat(means, conics, opacities, colours, lists)


def _rotation_matrices(quaternions: Float[Tensor, "P 4"]) -> Float[Tensor, "P 3 3"]:
    x, y, z, w = torch.nn.functional.normalize(quaternions, dim=-1).unbind(-1)
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        *(2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        *(2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def pinhole(camera: Cameras) -> Cameras:
    """A camera of one frame without what bends its lens: of a line camera the frame camera in its middle."""
    straight = torch.zeros_like(camera.distortion)
    return Cameras(
        camera.camera_to_world, camera.focal_px, camera.center_px, straight, camera.width, camera.height
    )


@torch.no_grad()
def start_splats(scene: TrainedScene, count: int, follow: Follow) -> FittedSplats:
    """At most so many discs on the surface that the training views see, in the colour that it has from straight above.

    Raises:
        RunError: no camera of the run sees a surface.
    """
    from scipy.spatial import KDTree

    cameras = [view.camera for view in views_of(scene.views, "train")]
    points = SeenSurface(scene, _RAYS_PER_SPLAT * count, cameras, follow).points()
    cubes = np.floor(points.positions.double().numpy() / (_SPACING * scene.pixel_size))
    points, normals = even_cover(points, min(count, len(np.unique(cubes, axis=0))))
    places = points.positions.double().numpy()
    neighbours = min(_NEIGHBOURS, max(len(places) - 1, 1))
    distances = KDTree(places).query(places, k=neighbours + 1)[0][:, 1:].mean(axis=1)
    distances = distances[:, None].clip(0.01 * scene.pixel_size, 10 * scene.pixel_size)
    seen = look_at(scene, points.positions, torch.from_numpy(-normals).float())
    seen = seen.map(lambda packed: packed.cpu() / packed[:, :1].clamp(min=1e-6).cpu())
    looks = SurfaceAppearance(
        scene.materials.to("cpu"), seen.abundances, scene.materials.to("cpu").spectra(seen)
    )
    return FittedSplats(
        points.positions,
        torch.from_numpy(least_turns(np.array([0.0, 0.0, 1.0]), normals)).float(),
        torch.from_numpy(np.log(distances * [_WIDTH, _WIDTH, _THICKNESS])).float(),
        torch.full((len(points),), _OPACITY).logit(),
        torch.from_numpy(looks.srgb).float(),
    )


@dataclass(frozen=True)
class _Target:
    """What the field shows of a view."""

    camera: Cameras
    subpixels: int
    picture: Float[Tensor, "H W 4"]
    """sRGB on black, and opacity."""
    counts: Float[Tensor, "H W 4"]
    """How much each number counts: light from what is behind all, and all that is outside the box, do not."""


def _targets(scene: TrainedScene, follow: Follow) -> list[_Target]:
    """Pictures of the field from training cameras, and from others between these."""
    train = cameras_of(scene.views, "train")
    size = train.one_size().shrunk(_LARGEST_PICTURE)
    pixels = size.width * size.height
    subpixels = _SUBPIXELS if pixels <= _FINE_PICTURE else 1
    most = max(1, _NUM_PIXELS // pixels)
    cameras = [pinhole(train[index]).shrunk(_LARGEST_PICTURE) for index in evenly_spaced(len(train), most)]
    num_between = min(most, _PICTURES_PER_VIEW * len(train)) - len(cameras)
    if num_between > 0 and len(train) > 1:
        between = interpolated(train, scene.scene_box, num_between)
        cameras += [between[index].shrunk(_LARGEST_PICTURE) for index in range(num_between)]
    return [_target(scene, camera, subpixels) for camera in follow("rendering views to fit to", cameras)]


@torch.no_grad()
def _target(scene: TrainedScene, camera: Cameras, subpixels: int) -> _Target:
    view = scene.lit_head_on.look(camera)
    srgb, opacity = view["rgb"].cpu().float(), view.opacity.cpu().float()[..., None]
    counts = torch.ones_like(opacity)
    if scene.renderer.space.is_unbounded:
        rays = camera.to(scene.device).image_rays(0)
        ends = rays.at(view.coefficients.ray_distance.flatten())
        counts = scene.scene_box.contains(ends).cpu().view_as(opacity).float()
    of_colour = counts * opacity if scene.field.has_sky else counts
    picture = torch.cat([srgb, opacity], dim=-1)
    return _Target(camera, subpixels, picture, torch.cat([*[of_colour] * 3, counts], dim=-1))


def fit_splats(
    scene: TrainedScene, start: FittedSplats, steps: int, generator: torch.Generator, follow: Follow
) -> FittedSplats:
    """Make Gaussians look like the field: Adam, one view a step, the squared difference of colours and opacity."""
    targets = _targets(scene, follow)
    on_device = start.to(scene.device)
    values = {field.name: getattr(on_device, field.name).clone().requires_grad_() for field in fields(start)}
    rates = {**_RATES, "positions": _RATES["positions"] * scene.pixel_size}
    groups = [{"params": [values[name]], "lr": rate} for name, rate in rates.items()]
    optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-15)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, _LAST_RATE ** (1 / max(steps, 1)))
    rounds = -(-steps // len(targets))
    order = torch.cat([torch.randperm(len(targets), generator=generator) for _ in range(rounds)])
    for step, index in enumerate(follow("fitting splats", order[:steps].tolist())):
        target, blur = targets[index], _BLURS[step % len(_BLURS)]
        shown = FittedSplats(**values).picture(target.camera, target.subpixels, blur)
        difference = shown - target.picture.to(shown.device)
        loss = (target.counts.to(shown.device) * difference.square()).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return FittedSplats(**{name: value.detach().cpu() for name, value in values.items()})


def seen_splats(
    scene: TrainedScene, splats: FittedSplats, follow: Follow
) -> tuple[FittedSplats, Coefficients]:
    """The Gaussians that training views see, and coefficients of what is seen there, as if it were opaque."""
    cameras = [pinhole(view.camera).shrunk(_LARGEST_PICTURE) for view in views_of(scene.views, "train")]
    looked = [
        scene.lit_head_on.look(camera, subpixels=1).coefficients.map(lambda packed: packed.detach().cpu())
        for camera in follow("finding what splats are made of", cameras)
    ]
    found = splats.to(scene.device).seen_means(cameras, [one.packed for one in looked])
    means, most = (values.cpu() for values in found)
    is_seen = (most > _LEAST_SEEN) & (means[:, 0] > OCCUPIED_ACCUMULATION)
    means = means[is_seen] / means[is_seen, :1]
    return splats.select(is_seen), replace(looked[0], packed=means)
