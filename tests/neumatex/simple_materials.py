"""Reflectances with closed forms, for tests of what uses materials."""

import math

import torch


def unit(vectors):
    return torch.nn.functional.normalize(vectors, dim=-1)


def cosine_directions(uniforms):
    azimuth, radius = 2 * math.pi * uniforms[:, 0], uniforms[:, 1].sqrt()
    z = (1 - uniforms[:, 1]).sqrt()
    return torch.stack([radius * azimuth.cos(), radius * azimuth.sin(), z], dim=-1)


class Lambert:
    """Albedo in three colours."""

    num_parameters = 3
    num_colours = 3

    def evaluate(self, parameters, wi, wo):
        above = (wi[:, 2:] > 0) & (wo[:, 2:] > 0)
        return torch.where(above, parameters / math.pi, 0.0)

    def sample(self, parameters, wo, uniforms):
        return cosine_directions(uniforms)

    def density(self, parameters, wi, wo):
        return wi[:, 2].clamp(min=0.0) / math.pi

    def base_colour(self, parameters):
        return parameters


class Glossy:
    """Lambert, and a Phong lobe of exponent 1 + 60 p about the mirrored direction; parameters albedo, strength, p."""

    num_parameters = 5
    num_colours = 3

    def _lobe(self, parameters, wi, wo):
        exponent = 1 + 60 * parameters[:, 4]
        mirrored = wo * torch.tensor([-1.0, -1.0, 1.0])
        cosine = (wi * mirrored).sum(dim=-1).clamp(min=1e-6)
        return (exponent + 1) / (2 * math.pi) * cosine**exponent

    def evaluate(self, parameters, wi, wo):
        above = (wi[:, 2:] > 0) & (wo[:, 2:] > 0)
        lobe = parameters[:, 3] * self._lobe(parameters, wi, wo)
        return torch.where(above, parameters[:, :3] / math.pi + lobe[:, None], 0.0)

    def sample(self, parameters, wo, uniforms):
        cosine = uniforms[:, 1] ** (1 / (2 + 60 * parameters[:, 4]))
        sine, azimuth = (1 - cosine**2).clamp(min=0).sqrt(), 2 * math.pi * uniforms[:, 0]
        mirrored = wo * torch.tensor([-1.0, -1.0, 1.0])
        first = unit(torch.linalg.cross(mirrored, torch.tensor([0.3, 0.5, -0.8]).expand_as(mirrored)))
        second = torch.linalg.cross(mirrored, first)
        lobe = cosine[:, None] * mirrored + sine[:, None] * (
            azimuth.cos()[:, None] * first + azimuth.sin()[:, None] * second
        )
        return torch.where(uniforms[:, 2:] < 0.5, lobe, cosine_directions(uniforms[:, :2]))

    def density(self, parameters, wi, wo):
        return 0.5 * wi[:, 2].clamp(min=0.0) / math.pi + 0.5 * self._lobe(parameters, wi, wo)

    def base_colour(self, parameters):
        return parameters[:, :3]


class Uniform:
    """One material everywhere."""

    def __init__(self, family, values):
        self.family = family
        self.values = torch.as_tensor(values, dtype=torch.float32)

    def parameters(self, positions):
        return self.values.expand(len(positions), -1)
