"""Posed cameras: from pixels to rays and from points to pixels.

Notation: `N` cameras, `R` rays, `P` points. Axes are OpenGL: +x right, +y up, a camera looks along -z. Pixel
coordinates are x to the right and y down in pixels from the image's top left corner, so pixel centres lie at +0.5.

A pose is a function of the camera and of y: constant for frame cameras, interpolated between key poses for line
cameras. At each y a line camera sees the line that its x axis and its optical axis span; its focal length and principal
point along y don't count, nor does p1, which would bend that line.

Lens distortion is OPENCV's, of image coordinates divided by depth, x to the right and y **down**, r2 = x^2 + y^2, with
`D` coefficients, 4 (k1, k2, p1, p2) or 6 (and k3, k4):

    x' = x (1 + k1 r2 + k2 r2^2 + k3 r2^3 + k4 r2^4) + 2 p1 x y + p2 (r2 + 2 x^2)
    y' = y (1 + k1 r2 + k2 r2^2 + k3 r2^3 + k4 r2^4) + 2 p2 x y + p1 (r2 + 2 y^2)

Source: OpenCV, "Camera Calibration and 3D Reconstruction" (Brown 1966); k4 as Metashape and nerfstudio have it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Any, TypeAlias

import msgspec
import numpy as np
import torch
from jaxtyping import Float, Int
from msgspec import Meta
from torch import Tensor

from unmix_plugin.engine.geometry.key_poses import (
    KeyPoses,
    WrittenKeyPoses,
    WrittenPose,
    are_rigid,
    project_by_row,
)
from unmix_plugin.engine.geometry.space import RayBundle

_Edge: TypeAlias = Annotated[int, Meta(ge=1, le=1 << 16)]
"""Of an image in files, pixels."""


class _WrittenCameras(msgspec.Struct):
    """What `Cameras.to_json` writes."""

    width: _Edge
    height: _Edge
    camera_to_world: list[WrittenPose]
    focal_px: list[tuple[float, float]]
    center_px: list[tuple[float, float]]
    distortion: list[Annotated[list[float], Meta(min_length=4, max_length=6)]]
    sizes: list[tuple[_Edge, _Edge]] = []
    key_poses: WrittenKeyPoses | None = None


@dataclass(frozen=True)
class Cameras:
    """Pinhole cameras, optionally with OPENCV distortion; line cameras among them where there are key poses."""

    camera_to_world: Float[Tensor, "N 3 4"]
    """Rotation (orthonormal, determinant 1) and position in scene units, OpenGL axes; of a line camera its pose in the
    middle of the image, for whoever wants one pose a view."""
    focal_px: Float[Tensor, "N 2"]
    """Focal lengths along x and y in pixels, > 0."""
    center_px: Float[Tensor, "N 2"]
    """Principal point x, y in pixels."""
    distortion: Float[Tensor, "N D"]
    """k1, k2, p1, p2 of the OPENCV model, and perhaps k3, k4 (D is 4 or 6); zeros are a pinhole."""
    width: int
    """Columns of every image, pixels; of the largest image where sizes differ."""
    height: int
    """Rows of every image, pixels; of the largest image where sizes differ."""
    sizes: tuple[tuple[int, int], ...] | None = None
    """Width and height of each image where they differ; None where all have one size."""
    key_poses: KeyPoses | None = None
    """Of all cameras, where one of them is a line camera."""

    def __len__(self) -> int:
        return self.camera_to_world.shape[0]

    @staticmethod
    def of_sizes(
        camera_to_world: Float[Tensor, "N 3 4"],
        focal_px: Float[Tensor, "N 2"],
        center_px: Float[Tensor, "N 2"],
        distortion: Float[Tensor, "N D"],
        sizes: Sequence[tuple[int, int]],
        key_poses: KeyPoses | None = None,
    ) -> Cameras:
        """Cameras whose images have these widths and heights, at least one."""
        largest = max(sizes, key=lambda size: size[0] * size[1])
        own = None if len(set(sizes)) == 1 else tuple(sizes)
        if key_poses is not None and max(key_poses.counts) == 1:
            key_poses = None
        return Cameras(camera_to_world, focal_px, center_px, distortion, *largest, own, key_poses)

    def size(self, index: int) -> tuple[int, int]:
        """Width and height of one image in pixels."""
        return (self.width, self.height) if self.sizes is None else self.sizes[index]

    def __getitem__(self, index: int | slice | list[int]) -> Cameras:
        """Some of the cameras, in the order asked for; an int gives a `Cameras` of one."""
        rows = [index] if isinstance(index, int) else index
        parts = (self.camera_to_world[rows], self.focal_px[rows], self.center_px[rows], self.distortion[rows])
        numbers = range(len(self))[rows] if isinstance(rows, slice) else rows
        if len(numbers) == 0 or (self.sizes is None and self.key_poses is None):
            return Cameras(*parts, self.width, self.height)
        keys = None if self.key_poses is None else KeyPoses.join([self.key_poses.of(row) for row in numbers])
        return Cameras.of_sizes(*parts, [self.size(row) for row in numbers], keys)

    def to(self, device: torch.device | str) -> Cameras:
        """The same cameras on another device."""
        return replace(
            self,
            camera_to_world=self.camera_to_world.to(device),
            focal_px=self.focal_px.to(device),
            center_px=self.center_px.to(device),
            distortion=self.distortion.to(device),
            key_poses=None if self.key_poses is None else self.key_poses.to(device),
        )

    def resized(self, width: int, height: int) -> Cameras:
        """The same cameras with another number of pixels: the vertical field of view stays, the horizontal follows."""
        old = [self.size(index) for index in range(len(self))]
        scale = self.focal_px.new_tensor([[height / rows] for _, rows in old]).reshape(-1, 1)
        middle = self.center_px.new_tensor(old).reshape(-1, 2) / 2
        center_px = (self.center_px - middle) * scale + self.center_px.new_tensor((width, height)) / 2
        keys = self.key_poses
        if keys is not None:
            factors = scale[:, 0].repeat_interleave(torch.tensor(keys.counts, device=scale.device))
            keys = replace(keys, heights=keys.heights * factors)
        parts = (self.camera_to_world, self.focal_px * scale, center_px, self.distortion)
        return Cameras(*parts, width, height, key_poses=keys)

    def crop(self, left: int, top: int, width: int, height: int) -> Cameras:
        """The same cameras of a part of each image, pixels: what is rendered of it is that part of the image."""
        keys = self.key_poses
        return replace(
            self,
            center_px=self.center_px - self.center_px.new_tensor([float(left), float(top)]),
            width=width,
            height=height,
            sizes=None,
            key_poses=None if keys is None else replace(keys, heights=keys.heights - top),
        )

    def poses_at(self, camera_indices: Int[Tensor, " R"], y: Float[Tensor, " R"]) -> Float[Tensor, "R 3 4"]:
        """Camera to world at heights in the images, px."""
        if self.key_poses is None:
            if len(self.camera_to_world) == 1:  # which is not copied for every ray
                return self.camera_to_world.expand(len(camera_indices), 3, 4)
            return self.camera_to_world[camera_indices]
        return self.key_poses.at(camera_indices, y)

    def is_line_camera(self, index: int) -> bool:
        """Whether each row of an image has a pose of its own."""
        return self.key_poses is not None and self.key_poses.counts[index] > 1

    def one_size(self) -> Cameras:
        """The same cameras with images as large as the largest, where sizes differ."""
        return self if self.sizes is None else self.resized(self.width, self.height)

    def shrunk(self, num_pixels: int) -> Cameras:
        """The same cameras with about `num_pixels` pixels, or themselves where they have no more."""
        scale = (num_pixels / (self.width * self.height)) ** 0.5
        if scale >= 1:
            return self
        return self.resized(max(1, round(scale * self.width)), max(1, round(scale * self.height)))

    @cached_property
    def is_distorted(self) -> bool:
        """Whether any lens bends, or is learning to; found once, since the answer costs a device synchronisation."""
        return self.distortion.requires_grad or bool(self.distortion.ne(0.0).any())

    def generate_rays(
        self, camera_indices: Int[Tensor, " R"], pixel_coords: Float[Tensor, "R 2"]
    ) -> RayBundle:
        """Rays of cameras (int64) through points of their images, lens distortion undone; x, y in pixels, the centre of
        column c, row r is (c + 0.5, r + 0.5)."""
        coords = (pixel_coords - self.center_px[camera_indices]) / self.focal_px[camera_indices]
        is_frame: Tensor | None = None
        if self.key_poses is not None:
            is_frame = ~self.key_poses.is_line[camera_indices][:, None]
            coords = torch.cat([coords[:, :1], coords[:, 1:].where(is_frame, 0.0)], dim=1)
        if self.is_distorted:
            bending = self.distortion[camera_indices]
            if is_frame is not None:
                p1 = bending[:, 2:3].where(is_frame, 0.0)
                bending = torch.cat([bending[:, :2], p1, bending[:, 3:]], dim=1)
            coords = undistort(coords, bending)
        local = torch.stack([coords[:, 0], -coords[:, 1], -torch.ones_like(coords[:, 0])], dim=-1)
        poses = self.poses_at(camera_indices, pixel_coords[:, 1])
        directions = (poses[:, :, :3] * local[:, None, :]).sum(dim=-1)
        directions = directions / directions.norm(dim=-1, keepdim=True)
        return RayBundle(
            poses[:, :, 3].contiguous(), directions, camera_indices, -poses[:, :, 2], pixel_coords, coords
        )

    def image_rays(self, index: int, subpixel_offset: tuple[float, float] = (0.5, 0.5)) -> RayBundle:
        """One ray a pixel of a whole image, H * W of them, row after row, each through that part x, y of its pixel, in
        [0, 1]."""
        device = self.camera_to_world.device
        x, y = (
            torch.arange(count, device=device, dtype=torch.float32) + offset
            for count, offset in zip(self.size(index), subpixel_offset, strict=True)
        )
        pixel_coords = torch.cartesian_prod(y, x).flip(-1)
        indices = torch.full((len(pixel_coords),), index, dtype=torch.int64, device=device)
        return self.generate_rays(indices, pixel_coords)

    def project(
        self, points: Float[Tensor, "P 3"], index: int
    ) -> tuple[Float[Tensor, "P 2"], Float[Tensor, " P"]]:
        """Where a camera sees points, the inverse of `generate_rays`.

        Returns:
            Pixel coordinates x, y (meaningless where the depth is not positive) and depths along the optical axis in
            scene units, positive in front of the camera. What no row of a line camera sees has depth -1, as has what
            lies so far outside that the lens model folds over, back into the image.
        """
        rows: Tensor | None = None
        if self.key_poses is not None and self.is_line_camera(index):
            rows, local = project_by_row(points, self.key_poses.of(index), self.size(index)[1])
            local = local * local.new_tensor([1.0, 0.0, 1.0])  # each row is seen along an axis of its own
        else:
            pose = self.camera_to_world[index]
            local = (points - pose[:, 3]) @ pose[:, :3]
        depths = -local[:, 2]
        # Points on the camera plane have no image; any finite number does, since the caller looks at the depth.
        divisor = torch.where(depths.abs() < 1e-12, torch.full_like(depths, 1e-12), depths)
        # One axis at a time: a last axis of two takes thrice as long.
        x, y = local[:, 0] / divisor, -local[:, 1] / divisor
        if self.is_distorted:
            coords = torch.stack([x, y], dim=-1)
            depths = torch.where(coords.norm(dim=-1) < _fold_radius(self.distortion[index]), depths, -1.0)
            x, y = distort(coords, self.distortion[index]).unbind(-1)
        focal, center = self.focal_px[index], self.center_px[index]
        columns = x * focal[0] + center[0]
        if rows is None:
            return torch.stack([columns, y * focal[1] + center[1]], dim=-1), depths
        return torch.stack([columns, rows], dim=-1), torch.where(depths > 0, depths, -1.0)

    def to_json(self) -> dict[str, Any]:
        """The cameras as numbers and lists; `from_json` restores the same bits."""
        return {
            "width": self.width,
            "height": self.height,
            **({} if self.sizes is None else {"sizes": [list(size) for size in self.sizes]}),
            "camera_to_world": self.camera_to_world.tolist(),
            "focal_px": self.focal_px.tolist(),
            "center_px": self.center_px.tolist(),
            "distortion": self.distortion.tolist(),
            **({} if self.key_poses is None else {"key_poses": self.key_poses.to_json()}),
        }

    @staticmethod
    def from_json(values: Any) -> Cameras:
        """The cameras that `to_json` wrote. Raises ValueError, RuntimeError: a part is missing, of another shape or out
        of its range."""
        written = msgspec.convert(values, _WrittenCameras)
        count, sizes, keys = len(written.camera_to_world), written.sizes, written.key_poses
        if sizes and len(sizes) != count:
            raise ValueError(f"{len(sizes)} image sizes for {count} cameras")
        cameras = Cameras(
            torch.tensor(written.camera_to_world, dtype=torch.float32).reshape(count, 3, 4),
            torch.tensor(written.focal_px, dtype=torch.float32).reshape(count, 2),
            torch.tensor(written.center_px, dtype=torch.float32).reshape(count, 2),
            torch.tensor(written.distortion, dtype=torch.float32).reshape(count, -1 if count else 4),
            written.width,
            written.height,
            tuple(sizes) or None,
            None if keys is None else KeyPoses.read(keys, count),
        )
        if cameras.distortion.shape[1] not in (4, 6):
            raise ValueError(f"{cameras.distortion.shape[1]} coefficients of distortion; expected 4 or 6")
        parts = (cameras.center_px, cameras.distortion, cameras.focal_px)
        if not (all(part.isfinite().all() for part in parts) and (cameras.focal_px > 0).all()):
            raise ValueError("centres and distortion must be finite, focal lengths above 0")
        if not are_rigid(cameras.camera_to_world):
            raise ValueError("poses must be rotations and finite positions")
        return cameras


_NEWTON_STEPS = 12
"""Steps of the inversion; quadratic convergence reaches float64 precision in 5 or 6 for photographic lenses."""


def distort(
    coords: Float[Tensor, "*points 2"], coefficients: Float[Tensor, "*#points D"]
) -> Float[Tensor, "*points 2"]:
    """Bend ideal coordinates x, y as a lens of these coefficients does, one row a point or one that broadcasts."""
    x, y = coords.unbind(-1)
    p1, p2 = coefficients[..., 2], coefficients[..., 3]
    r2 = x * x + y * y
    radial, _ = _radial(r2, coefficients)
    distorted_x = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    distorted_y = y * radial + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y)
    return torch.stack([distorted_x, distorted_y], dim=-1)


def _fold_radius(coefficients: Float[Tensor, " D"]) -> float:
    """Distance of ideal coordinates from the axis at which the radial terms turn back towards it; inf: nowhere."""
    k1, k2, _, _, *higher = coefficients.tolist()
    slope = [(2 * power + 1) * k for power, k in enumerate([1.0, k1, k2, *higher])]  # by r, in powers of r2
    roots = np.roots(slope[::-1])
    return float(min(roots.real[(roots.imag == 0) & (roots.real > 0)], default=np.inf)) ** 0.5


def undistort(
    distorted: Float[Tensor, "*points 2"], coefficients: Float[Tensor, "*#points D"]
) -> Float[Tensor, "*points 2"]:
    """Invert `distort` by Newton's method, started at the distorted point itself.

    Exact to rounding where the lens model is invertible along the way, as it is for every lens whose image does not
    fold over; where its Jacobian vanishes the step is left out.
    """
    p1, p2 = coefficients[..., 2], coefficients[..., 3]
    coords = distorted
    for _ in range(_NEWTON_STEPS):
        x, y = coords.unbind(-1)
        error_x, error_y = (distort(coords, coefficients) - distorted).unbind(-1)
        r2 = x * x + y * y
        radial, slope = _radial(r2, coefficients)
        dxx = radial + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
        dxy = 2.0 * x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
        dyy = radial + 2.0 * y * y * slope + 2.0 * p2 * x + 6.0 * p1 * y
        determinant = dxx * dyy - dxy * dxy
        inverse = torch.where(determinant.abs() > 1e-6, 1.0 / determinant, torch.zeros_like(determinant))
        step_x = (dyy * error_x - dxy * error_y) * inverse
        step_y = (dxx * error_y - dxy * error_x) * inverse
        coords = torch.stack([x - step_x, y - step_y], dim=-1)
    return coords


def _radial(
    r2: Float[Tensor, "*points"], coefficients: Float[Tensor, "*#points D"]
) -> tuple[Float[Tensor, "*points"], Float[Tensor, "*points"]]:
    """The radial factor and its derivative by r2."""
    k1, k2, _, _, *higher = coefficients.unbind(-1)
    factor, slope = torch.zeros_like(r2), torch.zeros_like(r2)
    for k in reversed([k1, k2, *higher]):  # Horner's scheme
        slope = factor + slope * r2
        factor = k + factor * r2
    return 1.0 + factor * r2, factor + slope * r2
