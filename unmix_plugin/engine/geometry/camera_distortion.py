"""OPENCV lens distortion of normalised image coordinates, forward and inverse.

Notation: `x, y` are image coordinates divided by depth, x to the right and y **down** (OpenCV); `k1` to `k4` are radial
and `p1, p2` tangential coefficients; r2 = x^2 + y^2; `D` coefficients, 4 (k1, k2, p1, p2) or 6 (and k3, k4):

    x' = x (1 + k1 r2 + k2 r2^2 + k3 r2^3 + k4 r2^4) + 2 p1 x y + p2 (r2 + 2 x^2)
    y' = y (1 + k1 r2 + k2 r2^2 + k3 r2^3 + k4 r2^4) + 2 p2 x y + p1 (r2 + 2 y^2)

Source: OpenCV, "Camera Calibration and 3D Reconstruction" (Brown 1966); k4 as Metashape and nerfstudio have it.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

NEWTON_STEPS = 12
"""Steps of the inversion; quadratic convergence reaches float64 precision in 5 or 6 for photographic lenses."""


def distort(
    coords: Float[Tensor, "*points 2"], coefficients: Float[Tensor, "*#points D"]
) -> Float[Tensor, "*points 2"]:
    """Bend ideal coordinates as the lens does.

    Args:
        coords: Ideal x, y, without unit.
        coefficients: k1, k2, p1, p2 and perhaps k3, k4, one row a point or one that broadcasts.
    """
    x, y = coords.unbind(-1)
    p1, p2 = coefficients[..., 2], coefficients[..., 3]
    r2 = x * x + y * y
    radial, _ = _radial(r2, coefficients)
    bent_x = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    bent_y = y * radial + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y)
    return torch.stack([bent_x, bent_y], dim=-1)


def undistort(
    bent: Float[Tensor, "*points 2"], coefficients: Float[Tensor, "*#points D"]
) -> Float[Tensor, "*points 2"]:
    """Invert `distort` by Newton's method, started at the bent point itself.

    Exact to rounding where the lens model is invertible along the way, as it is for every lens whose image does not
    fold over; where its Jacobian vanishes the step is left out.

    Args:
        bent: Distorted x', y', without unit.
        coefficients: k1, k2, p1, p2 and perhaps k3, k4, one row a point or one that broadcasts.
    """
    p1, p2 = coefficients[..., 2], coefficients[..., 3]
    coords = bent
    for _ in range(NEWTON_STEPS):
        x, y = coords.unbind(-1)
        error_x, error_y = (distort(coords, coefficients) - bent).unbind(-1)
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
