"""Functions of directions that small networks take, or give the coefficients of.

Notation: `S` samples, `R` rays.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

NUM_DIRECTION_FEATURES = 15


def direction_features(directions: Float[Tensor, "S 3"]) -> Float[Tensor, "S 15"]:
    """Real spherical harmonics of degrees 1 to 3 of unit directions (the constant carries nothing), up to scale."""
    x, y, z = directions.t().contiguous()  # rows: arithmetic on columns takes twice as long
    xx, yy, zz = x * x, y * y, z * z
    return torch.stack(
        [
            x,
            y,
            z,
            1.7320508 * x * y,
            1.7320508 * y * z,
            0.5 * (3 * zz - 1),
            1.7320508 * x * z,
            0.8660254 * (xx - yy),
            0.7905694 * y * (3 * xx - yy),
            3.8729833 * x * y * z,
            0.6123724 * y * (5 * zz - 1),
            0.5 * z * (5 * zz - 3),
            0.6123724 * x * (5 * zz - 1),
            1.9364917 * z * (xx - yy),
            0.7905694 * x * (xx - 3 * yy),
        ]
    ).t()


_SKY_OCTAVES = 4
NUM_SKY_FEATURES = NUM_DIRECTION_FEATURES + 6 * _SKY_OCTAVES


def sky_features(directions: Float[Tensor, "R 3"]) -> Float[Tensor, "R 39"]:
    """Harmonics of unit directions, and sines and cosines of 1, 2, 4 and 8 times their components."""
    angles = torch.cat([2.0**octave * directions for octave in range(_SKY_OCTAVES)], dim=-1)
    return torch.cat([direction_features(directions), angles.sin(), angles.cos()], dim=-1)
