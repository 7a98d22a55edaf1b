"""Artificial landscapes whose materials are known, to choose and to judge methods that unmix single images.

Scene `n` is always the same. Scenes of even number are there to choose by; those of odd number are looked at once, when
everything is settled. They differ in what decides whether unmixing works: the sensor, the number of materials and how
much they resemble each other, how materials mix (smoothly, in patches, at edges, with thin roads, never pure), how much
each varies from place to place, shading, haze, noise and dead bands. True endmembers are what a pixel of that material
alone would show on average in full light, haze included; true abundances are shares of area.

Notation: `N` pixels, `B` bands, `K` materials; reflectances in [0, 1].
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from unmix_plugin.spectral.library.material_library import measured_library

SIZE = 56
"""Pixels along an edge of a scene."""
NUM_LANDSCAPES = 60

Array = np.ndarray
_SENSORS = {
    "visible": (405.0, 715.0),
    "vnir": (400.0, 1000.0),
    "full": (400.0, 2450.0),
    "swir": (1000.0, 2450.0),
}
_RANDOM_FIELD_SMOOTHNESS = (2.0, 8.0)
_LEAST_ANGLE = 0.08
"""Between two materials, in radians, unless they are meant to be near twins."""
_TWIN_ANGLE = (0.05, 0.08)
_LEAST_COVER = 0.015
"""Mean abundance that each material has at least."""


@dataclass(frozen=True)
class Landscape:
    """An image and what it shows."""

    pixels: Array
    """(N, B)."""
    abundances: Array
    """(N, K), shares of area."""
    endmembers: Array
    """(K, B)."""
    names: tuple[str, ...]
    """Of the materials."""
    traits: dict[str, float | str]
    """What makes it easy or hard."""


def landscape(number: int) -> Landscape:
    """Scene `number`."""
    rng = np.random.default_rng(4600 + number)
    sensor = rng.choice(list(_SENSORS), p=[0.15, 0.3, 0.4, 0.15])
    num_bands = int(np.exp(rng.uniform(np.log(30), np.log({"visible": 120, "vnir": 250}.get(sensor, 400)))))
    wavelengths = np.linspace(*_SENSORS[sensor], num_bands)
    num_materials = int(rng.choice([3, 4, 4, 5, 5, 6, 7, 8, 10, 12]))
    has_twins = bool(rng.random() < 0.25)
    names, spectra = draw_materials(rng, wavelengths, num_materials, sensor, has_twins)
    layout = str(rng.choice(["smooth", "patches", "edges", "roads"]))
    abundances = _LAYOUTS[layout](rng, num_materials)
    purity = 1.0
    if rng.random() < 0.25:  # nothing is pure: every pixel has a trace of its surroundings
        purity = float(rng.uniform(0.7, 0.9))
        abundances = purity * abundances + (1 - purity) * _blurred(abundances, 5.0)
    varied = float(rng.choice([0.01, 0.03, 0.06, 0.1]))
    shade = float(rng.choice([0.0, 0.2, 0.4, 0.6]))
    haze = float(rng.choice([0.0, 0.0, 0.01, 0.03]))
    snr_db = float(rng.uniform(28, 45))
    glint = float(rng.choice([0.0, 0.01, 0.03]))
    skylight = float(rng.choice([0.0, 0.15]))
    image, endmembers = _varied_mixture(rng, abundances, spectra, names, varied, glint)
    blue = (wavelengths / wavelengths[0]) ** -2.0
    shadow = shade * _unit_field(rng, _random_scale(rng))[..., None]
    image = image * (1 - shadow + skylight * shadow * blue)
    path_light = haze * (wavelengths / wavelengths[0]) ** -float(rng.uniform(1, 4))
    veil = 1 + 0.3 * (_unit_field(rng, 12.0) - 0.5)
    image = image + path_light * veil[..., None]
    endmembers = endmembers + path_light
    image = _noisy(rng, image, wavelengths, snr_db)
    if rng.random() < 0.3:
        dead = rng.integers(0, num_bands, max(1, num_bands // 60))
        image[..., dead] = endmembers[:, dead] = 0
    traits: dict[str, float | str] = {
        "sensor": str(sensor),
        "bands": num_bands,
        "materials": num_materials,
        "layout": layout,
        "twins": has_twins,
        "purity": round(purity, 2),
        "variability": varied,
        "shade": shade,
        "haze": haze,
        "glint": glint,
        "skylight": skylight,
        "snr_db": round(snr_db),
    }
    flat = abundances.reshape(-1, num_materials)
    return Landscape(image.reshape(-1, num_bands), flat, endmembers, names, traits)


# What the ground is made of


def _bell(wavelengths: Array, centre: float, width: float) -> Array:
    return np.exp(-0.5 * ((wavelengths - centre) / width) ** 2)


def _rise(wavelengths: Array, centre: float, width: float) -> Array:
    return 1 / (1 + np.exp(-(wavelengths - centre) / width))


def _leaf_water(nm: Array, amount: float) -> Array:
    depths = 0.15 * _bell(nm, 970, 25) + 0.3 * _bell(nm, 1200, 40) + 1.6 * _bell(nm, 1450, 60)
    depths = depths + 2.4 * _bell(nm, 1940, 80) + 0.5 * _rise(nm, 1400, 60) + 0.9 * _rise(nm, 2450, 150)
    return np.exp(-amount * depths)


def _plant(rng: np.random.Generator, nm: Array) -> Array:
    chlorophyll, edge = rng.uniform(1.0, 3.0), rng.uniform(705, 725)
    absorbed = _bell(nm, 440, 45) + 0.75 * _bell(nm, 490, 35) + 0.45 * _bell(nm, 610, 40) + _bell(nm, 672, 26)
    green = rng.uniform(0.1, 0.2) * np.exp(-chlorophyll * absorbed)
    plateau = rng.uniform(0.3, 0.55) * (1 + 0.05 * (nm - 850) / 400 * (nm < 1300))
    return (green + plateau * _rise(nm, edge, 11)) * _leaf_water(nm, rng.uniform(0.5, 1.3))


def _dry_plant(rng: np.random.Generator, nm: Array) -> Array:
    top = rng.uniform(0.3, 0.5) * (1 - np.exp(-(nm - 330) / rng.uniform(250, 450)))
    cellulose = 0.25 * _bell(nm, 2100, 60) + 0.2 * _bell(nm, 2300, 50) + 0.12 * _bell(nm, 1730, 30)
    return top * (1 - cellulose) * _leaf_water(nm, rng.uniform(0.1, 0.3))


def _soil(rng: np.random.Generator, nm: Array) -> Array:
    bright, slope = rng.uniform(0.15, 0.45), rng.uniform(250, 700)
    iron = rng.uniform(0, 0.4) * (_bell(nm, 500, 50) + 0.6 * _bell(nm, 900, 70))
    clay = rng.uniform(0, 0.25) * _bell(nm, 2205, 30) + rng.uniform(0.05, 0.3) * _bell(nm, 1920, 50)
    fall = 1 - 0.25 * rng.random() * _rise(nm, 2100, 150)
    return bright * (0.15 + 0.85 * (1 - np.exp(-(nm - 350) / slope))) * (1 - iron) * (1 - clay) * fall


def _water(rng: np.random.Generator, nm: Array) -> Array:
    clear = rng.uniform(0.02, 0.05) * np.exp(-np.clip(nm - 480, 0, None) / rng.uniform(60, 140))
    mud = rng.uniform(0, 0.06) * _bell(nm, 570, 60) + rng.uniform(0, 0.02) * _bell(nm, 705, 20)
    return clear + mud + rng.uniform(0.006, 0.015)


def _asphalt(rng: np.random.Generator, nm: Array) -> Array:
    return rng.uniform(0.06, 0.16) * (
        1 + rng.uniform(0.05, 0.5) * (nm - 400) / 1000 * (1 - (nm - 400) / 5000)
    )


def _concrete(rng: np.random.Generator, nm: Array) -> Array:
    top = rng.uniform(0.25, 0.45) * (1 - 0.5 * np.exp(-(nm - 350) / rng.uniform(80, 200)))
    return top * (1 - 0.1 * _bell(nm, 1920, 50) - rng.uniform(0.03, 0.15) * _bell(nm, 2340, 35))


def _tile(rng: np.random.Generator, nm: Array) -> Array:
    low, high = rng.uniform(0.04, 0.08), rng.uniform(0.25, 0.45)
    edge = rng.uniform(560, 610)
    dips = rng.uniform(0, 0.2) * _bell(nm, 870, 70) + 0.1 * _bell(nm, 2200, 40)
    return (low + (high - low) * (0.75 * _rise(nm, edge, 22) + 0.25 * _rise(nm, 1200, 250))) * (1 - dips)


def _metal(rng: np.random.Generator, nm: Array) -> Array:
    return rng.uniform(0.25, 0.55) * (1 + rng.uniform(-0.35, 0.1) * (nm - 400) / 2000)


def _mineral(rng: np.random.Generator, nm: Array) -> Array:
    base = rng.uniform(0.3, 0.7) * (1 - rng.uniform(0.3, 0.8) * np.exp(-(nm - 350) / rng.uniform(100, 400)))
    for _ in range(rng.integers(2, 5)):
        base = base * (
            1 - rng.uniform(0.15, 0.5) * _bell(nm, rng.uniform(nm[0], nm[-1]), rng.uniform(20, 90))
        )
    return base


def _paint(rng: np.random.Generator, nm: Array) -> Array:
    """A measured spectrum; beyond the visible as bright as at its end, with a pigment's broad edges."""
    library = measured_library()
    material = library.materials[rng.integers(len(library.materials))]
    seen = np.interp(nm, material.bands.centers_nm, material.reflectance)
    beyond = _rise(nm, rng.uniform(800, 1100), 60) * rng.uniform(-0.3, 0.4)
    return np.clip(seen + beyond * _rise(nm, 790, 20), 0.01, 0.9) * _leaf_water(nm, rng.uniform(0, 0.2))


FAMILIES: dict[str, Callable[[np.random.Generator, Array], Array]] = {
    "plant": _plant,
    "dry plant": _dry_plant,
    "soil": _soil,
    "water": _water,
    "asphalt": _asphalt,
    "concrete": _concrete,
    "tile": _tile,
    "metal": _metal,
    "mineral": _mineral,
    "paint": _paint,
}
_COUNTRYSIDE = ("plant", "soil", "water", "asphalt")


def draw_materials(
    rng: np.random.Generator, nm: Array, count: int, sensor: str, has_twins: bool
) -> tuple[tuple[str, ...], Array]:
    """Names and spectra (K, B), no two of one shape."""
    families = list(FAMILIES)
    names: list[str] = list(_COUNTRYSIDE[:count]) if rng.random() < 0.5 and sensor != "visible" else []
    weights = np.array([5.0 if sensor == "visible" and name == "paint" else 1.0 for name in families])
    spectra: list[Array] = []
    while len(spectra) < count:
        is_drawn = len(names) == len(spectra)
        name = str(rng.choice(families, p=weights / weights.sum())) if is_drawn else names[len(spectra)]
        spectrum = FAMILIES[name](rng, nm)
        if all(_angle(spectrum, other) > _LEAST_ANGLE for other in spectra):
            spectra.append(spectrum)
            names[len(spectra) - 1 : len(spectra)] = [name]
        elif not is_drawn:
            names = names[: len(spectra)]
    if has_twins:
        names[-1] = f"twin of {names[0]}"
        spectra[-1] = _twin(rng, spectra[0], nm)
    return tuple(names), np.stack(spectra)


def _twin(rng: np.random.Generator, spectrum: Array, nm: Array) -> Array:
    """The same but for a smooth change."""
    change = sum(rng.normal() * _bell(nm, rng.uniform(nm[0], nm[-1]), np.ptp(nm) / 8) for _ in range(4))
    wanted, strength = rng.uniform(*_TWIN_ANGLE), 0.01
    while _angle(spectrum, spectrum * np.exp(strength * change)) < wanted:
        strength *= 1.1
    return np.clip(spectrum * np.exp(strength * change), 0, 0.95)


def _angle(a: Array, b: Array) -> float:
    return float(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1)))


# Where it lies


def _random_scale(rng: np.random.Generator) -> float:
    return float(rng.uniform(*_RANDOM_FIELD_SMOOTHNESS))


def _field(rng: np.random.Generator, smoothness: float) -> Array:
    """A random field of mean 0 and deviation 1."""
    values = gaussian_filter(rng.normal(size=(SIZE, SIZE)), smoothness, mode="wrap")
    return (values - values.mean()) / values.std()


def _unit_field(rng: np.random.Generator, smoothness: float) -> Array:
    """A random field in [0, 1]."""
    values = _field(rng, smoothness)
    return (values - values.min()) / np.ptp(values)


def _blurred(abundances: Array, radius: float) -> Array:
    spread = gaussian_filter(abundances, (radius, radius, 0), mode="nearest")
    return spread / spread.sum(axis=-1, keepdims=True)


def _covering(rng: np.random.Generator, scores: Callable[[], Array]) -> Array:
    """Scores (SIZE, SIZE, K) of which each material wins somewhere, some more often than others."""
    found = scores()
    found = found + rng.normal(scale=0.5, size=found.shape[-1])
    for _ in range(200):
        cover = np.bincount(found.argmax(axis=-1).ravel(), minlength=found.shape[-1]) / SIZE**2
        if cover.min() >= _LEAST_COVER:
            break
        found = found + 0.2 * (cover < _LEAST_COVER)
    return found


def _smooth(rng: np.random.Generator, count: int) -> Array:
    """Gradual transitions: most pixels are mixtures."""
    smoothness, sharpness = rng.uniform(4, 8), rng.uniform(3.0, 7.0)
    scores = _covering(rng, lambda: np.stack([_field(rng, smoothness) for _ in range(count)], axis=-1))
    weights = np.exp(sharpness * (scores - scores.max(axis=-1, keepdims=True)))
    return weights / weights.sum(axis=-1, keepdims=True)


def _patches(rng: np.random.Generator, count: int) -> Array:
    """Fields with soft borders: Voronoi cells."""
    num_cells = max(5 * count, 30)
    centres = rng.uniform(0, SIZE, (num_cells, 2))
    material = np.concatenate([np.arange(count), rng.integers(0, count, num_cells - count)])
    grid = np.stack(np.meshgrid(np.arange(SIZE), np.arange(SIZE), indexing="ij"), axis=-1)
    nearest = np.linalg.norm(grid[:, :, None] - centres, axis=-1).argmin(axis=-1)
    return _blurred(np.eye(count)[material[nearest]], rng.uniform(0.5, 1.5))


def _edges(rng: np.random.Generator, count: int) -> Array:
    """Irregular regions whose borders take up much of the image, with single trees in them."""
    smoothness = rng.uniform(2, 4)
    scores = _covering(rng, lambda: np.stack([_field(rng, smoothness) for _ in range(count)], axis=-1))
    ids = scores.argmax(axis=-1)
    scattered = rng.random((SIZE, SIZE)) < 0.03
    ids = np.where(scattered, rng.integers(0, count, (SIZE, SIZE)), ids)
    return _blurred(np.eye(count)[ids], rng.uniform(0.5, 1.2))


def _roads(rng: np.random.Generator, count: int) -> Array:
    """Regions, and the last material in thin lines only."""
    smoothness = rng.uniform(4, 8)
    scores = _covering(rng, lambda: np.stack([_field(rng, smoothness) for _ in range(count - 1)], axis=-1))
    cover = np.eye(count)[scores.argmax(axis=-1)]
    rows, columns = np.meshgrid(np.arange(SIZE), np.arange(SIZE), indexing="ij")
    for _ in range(rng.integers(2, 4)):
        turn, offset, width = rng.uniform(0, np.pi), rng.uniform(-15, 15), rng.uniform(0.8, 1.6)
        across = (rows - SIZE / 2) * np.cos(turn) + (columns - SIZE / 2) * np.sin(turn) - offset
        cover[np.abs(across + 3 * np.sin(rows / 15)) < width] = np.eye(count)[-1]
    return _blurred(cover, rng.uniform(0.5, 1.0))


_LAYOUTS = {"smooth": _smooth, "patches": _patches, "edges": _edges, "roads": _roads}


# What the sensor sees


def _varied_mixture(
    rng: np.random.Generator,
    abundances: Array,
    spectra: Array,
    names: tuple[str, ...],
    strength: float,
    glint: float,
) -> tuple[Array, Array]:
    """Mixtures of spectra, and these as they are in the mean, (K, B). Each varies over the image in brightness and
    in slow changes along the bands. Water is deeper here and shallower there, and reflects the sky (`glint`, a
    reflectance at most).
    """
    num_bands = spectra.shape[1]
    image, means = np.zeros((SIZE, SIZE, num_bands)), []
    for name, share, spectrum in zip(names, np.moveaxis(abundances, -1, 0), spectra, strict=True):
        changes = np.zeros_like(image)
        for _ in range(3):
            along = np.cos(np.pi * rng.uniform(0.5, 4) * np.linspace(0, 1, num_bands) + rng.uniform(0, 6.3))
            changes += _field(rng, _random_scale(rng))[..., None] * along
        brightness = 1 + 2 * strength * _field(rng, 1.0)
        varied = np.clip(brightness, 0.3, 2)[..., None] * spectrum * np.exp(strength * changes / 2)
        if name == "water":
            depth = 1 + 0.3 * _field(rng, _random_scale(rng))[..., None]
            shape = spectrum / spectrum.max()
            varied = varied * shape ** (np.clip(depth, 0.3, 2) - 1)
            varied = varied + glint * _unit_field(rng, _random_scale(rng))[..., None] ** 2
        image += share[..., None] * varied
        means.append((share[..., None] * varied).sum(axis=(0, 1)) / share.sum())
    return image, np.stack(means)


def _noisy(rng: np.random.Generator, image: Array, wavelengths: Array, snr_db: float) -> Array:
    """With shot noise and noise of the sensor, more where air absorbs; 0 or above."""
    weak = (
        1
        - 0.9 * (_bell(wavelengths, 1400, 45) + _bell(wavelengths, 1890, 55))
        - 0.5 * _bell(wavelengths, 2450, 100)
    )
    weak = np.clip(weak * (1 - 0.4 * _bell(wavelengths, 400, 30)), 0.08, 1)
    level = 10 ** (-snr_db / 20) * np.sqrt(np.mean(image**2))
    shot = np.sqrt(np.clip(image, 0, None) / image.mean())
    noise = rng.normal(size=image.shape) * level * np.sqrt(0.2 + 0.8 * shot**2) / weak
    noisy = image + noise
    return np.clip(noisy, 0, None)
