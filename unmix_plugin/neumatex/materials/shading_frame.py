"""Local frames of shading: an orthonormal basis whose z axis is a normal, and directions in it."""

import torch
from jaxtyping import Float
from torch import Tensor


def frames(normals: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3 3"]:
    """Right-handed orthonormal frames; the rows are tangent, bitangent and normal.

    Args:
        normals: Unit length.
    Source:
        Duff et al. 2017, Building an orthonormal basis, revisited.

    >>> frames(torch.tensor([[0.0, 0.0, 1.0]]))[0].diagonal()
    tensor([1., 1., 1.])
    """
    x, y, z = normals.unbind(-1)
    sign = torch.copysign(torch.ones_like(z), z)
    a = -1.0 / (sign + z)
    b = x * y * a
    tangents = torch.stack([1.0 + sign * x * x * a, sign * b, -sign * x], -1)
    bitangents = torch.stack([b, sign + y * y * a, -y], -1)
    return torch.stack([tangents, bitangents, normals], -2)


def to_local(frames: Float[Tensor, "N 3 3"], directions: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
    """World directions as seen in their frames."""
    return (frames * directions[:, None, :]).sum(-1)


def to_world(frames: Float[Tensor, "N 3 3"], directions: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
    """Directions of local frames as seen in the world."""
    return (frames * directions[:, :, None]).sum(-2)
