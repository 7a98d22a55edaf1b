"""Built-in environments: procedural studios, skies and rooms, each a function of a name and a seed.

Radiance is about 1 in the mean, so that a grey object in them is well exposed.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float64

from unmix_plugin.neumatex.tracing.environment import Environment, directions_of_pixels

_Directions = Float64[np.ndarray, "*pixels 3"]
_Radiance = Float64[np.ndarray, "*pixels 3"]
_Number = float | int

_MEAN_RADIANCE = 0.8
"""Of every built-in environment, over the sphere and the colours."""


def built_in_environment(name: str, seed: int = 0, height: int = 128) -> Environment:
    """One of `NAMES`; a seed turns its lights about +z and varies their heights, sizes and tints."""
    rng = np.random.default_rng([zlib.crc32(name.encode()), seed])
    # Averages of finer pixels: the edges of lights are then neither jagged nor lost between pixels.
    fine = 2 * height
    radiance = _MAKERS[name](directions_of_pixels(fine, 2 * fine).double().numpy(), rng)
    radiance = radiance.reshape(height, 2, 2 * height, 2, 3).mean(axis=(1, 3))
    environment = Environment(torch.from_numpy(np.ascontiguousarray(radiance, dtype=np.float32)))
    gain = _MEAN_RADIANCE / environment.mean_radiance().mean()
    return Environment(environment.image * gain)


def _towards(azimuth_deg: _Number, elevation_deg: _Number) -> np.ndarray:
    """Unit vector of an azimuth (from +x to +y) and an elevation."""
    azimuth, elevation = np.deg2rad(azimuth_deg), np.deg2rad(elevation_deg)
    flat = np.cos(elevation)
    return np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])


def _colour(*values: _Number) -> np.ndarray:
    return np.array(values, dtype=np.float64)


def _tint(rng: np.random.Generator, strength: _Number) -> np.ndarray:
    return 1.0 + strength * rng.uniform(-1, 1, 3)


def _step(values: np.ndarray, at: _Number, width: _Number) -> np.ndarray:
    """From 0 below `at` to 1 above, smooth over `width`."""
    t = np.clip((values - at) / width + 0.5, 0, 1)
    return t * t * (3 - 2 * t)


def _disc(d: _Directions, centre: np.ndarray, radius_deg: _Number, soft: _Number = 0.15) -> np.ndarray:
    """1 inside a round light, 0 outside, with an edge of `soft` radii."""
    angle = np.arccos(np.clip(d @ centre, -1, 1))
    radius = np.deg2rad(radius_deg)
    return _step(-angle, -radius, soft * radius)


def _panel(
    d: _Directions, azimuth_deg: _Number, elevation_deg: _Number, width_deg: _Number, height_deg: _Number
) -> np.ndarray:
    """1 on a rectangular light that faces the origin, 0 beside it."""
    forward = _towards(azimuth_deg, elevation_deg)
    right = np.cross((0.0, 0.0, 1.0), forward)
    right /= np.linalg.norm(right)
    up = np.cross(forward, right)
    depth = d @ forward
    safe = np.where(depth > 1e-3, depth, np.inf)
    x, y = (d @ right) / safe, (d @ up) / safe
    half_x, half_y = np.tan(np.deg2rad(width_deg / 2)), np.tan(np.deg2rad(height_deg / 2))
    inside = _step(half_x - np.abs(x), 0.0, 0.06 * half_x) * _step(half_y - np.abs(y), 0.0, 0.06 * half_y)
    return np.where(depth > 1e-3, inside, 0.0)


def _ground_and_sky(d: _Directions, ground: np.ndarray, horizon: np.ndarray, zenith: np.ndarray) -> _Radiance:
    z = d[..., 2:]
    sky = horizon + (zenith - horizon) * np.clip(z, 0, 1) ** 0.5
    return np.where(z > 0, sky, ground * (0.6 + 0.4 * np.exp(4 * np.minimum(z, 0))))


def _studio(d: _Directions, rng: np.random.Generator) -> _Radiance:
    """A large key, a dim fill, a rim light behind, in a dark room."""
    turn = rng.uniform(0, 360)
    radiance = 0.12 * (0.6 + 0.4 * d[..., 2:]) * _tint(rng, 0.1)
    lights = ((0, 40, 50, 36, 14.0), (105, 20, 40, 60, 3.5), (215, 35, 16, 60, 11.0))
    for azimuth, elevation, width, height, power in lights:
        place = _panel(
            d, turn + azimuth + rng.uniform(-12, 12), elevation + rng.uniform(-8, 8), width, height
        )
        radiance = radiance + power * place[..., None] * _tint(rng, 0.08)
    return radiance


def _softbox_strips(d: _Directions, rng: np.random.Generator) -> _Radiance:
    """Tall narrow lamps all around, cool and warm in turn."""
    turn = rng.uniform(0, 360)
    radiance = np.full_like(d, 0.08)
    for index in range(5):
        colour = _colour(1.0, 0.82, 0.62) if index % 2 else _colour(0.7, 0.86, 1.0)
        place = _panel(d, turn + 72 * index, 15 + rng.uniform(-6, 6), 11, 75)
        radiance = radiance + 13.0 * place[..., None] * colour
    return radiance


def _ring_light(d: _Directions, rng: np.random.Generator) -> _Radiance:
    """A ring of light high above a grey floor."""
    centre = _towards(rng.uniform(0, 360), rng.uniform(55, 75))
    ring = _disc(d, centre, 34) - _disc(d, centre, 22)
    floor = 0.35 * _step(-d[..., 2:], 0.0, 0.3) * _tint(rng, 0.15)
    return 9.0 * np.clip(ring, 0, 1)[..., None] * _colour(1.0, 0.97, 0.92) + floor + 0.1


def _clear_sky(d: _Directions, rng: np.random.Generator) -> _Radiance:
    """A high sun in a blue sky above a grassy ground."""
    sun = _towards(rng.uniform(0, 360), rng.uniform(35, 60))
    sky = _ground_and_sky(d, _colour(0.16, 0.2, 0.09), _colour(0.75, 0.9, 1.1), _colour(0.16, 0.32, 0.75))
    glow = np.exp(-np.arccos(np.clip(d @ sun, -1, 1)) / 0.18)[..., None]
    return (
        sky
        + 1.2 * glow * _colour(1.0, 0.92, 0.8)
        + 260.0 * _disc(d, sun, 3.0)[..., None] * _colour(1, 0.93, 0.82)
    )


def _sunset(d: _Directions, rng: np.random.Generator) -> _Radiance:
    """A low orange sun, a red horizon on its side and a violet sky opposite."""
    azimuth = rng.uniform(0, 360)
    sun = _towards(azimuth, rng.uniform(5, 12))
    sky = _ground_and_sky(d, _colour(0.10, 0.07, 0.06), _colour(0.75, 0.42, 0.36), _colour(0.12, 0.14, 0.34))
    toward = np.clip(0.5 + 0.5 * (d[..., :2] @ _towards(azimuth, 0)[:2]), 0, 1)[..., None]
    band = np.exp(-np.abs(d[..., 2:]) * 5) * toward**2
    disc = _disc(d, sun, 4.0)[..., None]
    return sky + 2.6 * band * _colour(1.0, 0.42, 0.12) + 130.0 * disc * _colour(1.0, 0.5, 0.18)


def _overcast(d: _Directions, rng: np.random.Generator) -> _Radiance:
    """The CIE's overcast sky, three times as bright above as at the horizon, with broad clouds."""
    z = d[..., 2:]
    sky = (1 + 2 * np.clip(z, 0, 1)) / 3
    clouds = sum(
        np.cos(d @ (rng.normal(size=3) * frequency) + rng.uniform(0, 6)) / (index + 2)
        for index, frequency in enumerate((2, 4, 7, 11))
    )
    sky = sky * (1 + 0.25 * np.asarray(clouds)[..., None])
    return np.where(z > 0, sky * _colour(0.92, 0.98, 1.06), _colour(0.2, 0.19, 0.17)) * _tint(rng, 0.04)


def _window_room(d: _Directions, rng: np.random.Generator) -> _Radiance:
    """A dim warm room with two bright windows on one side and a lamp on the other."""
    turn = rng.uniform(0, 360)
    radiance = 0.22 * _colour(1.0, 0.86, 0.7) * (0.75 + 0.25 * d[..., 2:])
    for azimuth in (-24, 24):
        pane = _panel(d, turn + azimuth, 14, 34, 46)
        bar = 1 - _panel(d, turn + azimuth, 14, 2.5, 46)
        radiance = radiance + 9.0 * (pane * bar)[..., None] * _colour(0.82, 0.94, 1.12)
    lamp = _disc(d, _towards(turn + 170 + rng.uniform(-25, 25), 32), 8)
    return radiance + 16.0 * lamp[..., None] * _colour(1.0, 0.68, 0.36)


def _neon(d: _Directions, rng: np.random.Generator) -> _Radiance:
    """Night: coloured tubes, magenta on one side, cyan on the other, and a few small lamps."""
    turn = rng.uniform(0, 360)
    radiance = np.full_like(d, 0.03)
    tubes = (
        (0, 10, 60, 12, (1.0, 0.12, 0.7)),
        (150, 25, 14, 60, (0.1, 0.75, 1.0)),
        (250, 55, 40, 10, (1, 0.7, 0.2)),
    )
    for azimuth, elevation, width, height, colour in tubes:
        radiance = radiance + 10.0 * _panel(d, turn + azimuth, elevation, width, height)[..., None] * colour
    for _ in range(6):
        lamp = _disc(d, _towards(rng.uniform(0, 360), rng.uniform(0, 60)), 3)
        radiance = radiance + 25.0 * lamp[..., None] * _tint(rng, 0.4)
    return radiance


def _lantern_from_below(d: _Directions, rng: np.random.Generator) -> _Radiance:
    """Moonlight from above and a warm light from below the horizon."""
    turn = rng.uniform(0, 360)
    sky = _ground_and_sky(d, _colour(0.08, 0.06, 0.05), _colour(0.12, 0.16, 0.26), _colour(0.05, 0.08, 0.18))
    fire = _disc(d, _towards(turn, rng.uniform(-40, -20)), 22, soft=0.8)[..., None]
    moon = _disc(d, _towards(turn + rng.uniform(100, 200), 50), 7)[..., None]
    return sky + 7.0 * fire * _colour(1.0, 0.55, 0.2) + 22.0 * moon * _colour(0.7, 0.82, 1.0)


_MAKERS: dict[str, Callable[[_Directions, np.random.Generator], _Radiance]] = {
    "studio": _studio,
    "softbox-strips": _softbox_strips,
    "ring-light": _ring_light,
    "clear-sky": _clear_sky,
    "sunset": _sunset,
    "overcast": _overcast,
    "window-room": _window_room,
    "neon": _neon,
    "lantern": _lantern_from_below,
}

NAMES = tuple(_MAKERS)
"""Of the built-in environments."""
