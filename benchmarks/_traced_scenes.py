"""Descriptions of the path-traced scenes that benchmarks train on, and a generator of further ones.

The first six are made by hand: objects on a table, a closed room, pots with infrared, a turntable with a lamp, a raw
capture before a grey corner, and an object outdoors. `unseen(seed)` draws shapes, materials, light and
cameras; settings of the package are never chosen by looking at those.

Notation: `K` materials, `B` bands. Reflectances are in [0, 1].
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import _landscapes
import numpy as np
from _traced_bodies import (
    Body,
    ball,
    block,
    graded,
    ground,
    leaf,
    mottled,
    plain,
    random_field,
    ring,
    striped,
    turned,
)

from unmix_plugin.engine.geometry.camera_paths import upright_cameras
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.spectral.library.material_library import measured_library

Array = np.ndarray
VISIBLE, INFRARED = np.linspace(400, 700, 31), np.linspace(400, 1000, 31)
FEWER_VISIBLE, FEWER_INFRARED = np.linspace(420, 680, 21), np.linspace(400, 1000, 21)
NUM_UNSEEN = 6


@dataclass(frozen=True)
class Lamp:
    """A bright sphere."""

    place: tuple[float, float, float]
    radius: float
    radiance: float
    follows_camera: bool = False
    """Whether `place` is in the camera's axes (right, up, back), as for a lamp on a tripod beside a turntable."""


@dataclass(frozen=True)
class TracedScene:
    """All that is rendered of a scene."""

    name: str
    like: str
    """What it stands for, in words."""
    wavelengths_nm: Array
    names: tuple[str, ...]
    """Of the materials."""
    reflectances: Array
    """(K, B)."""
    light: str
    """CIE name of the one spectrum that all light has."""
    bodies: Sequence[Body]
    lamp: Lamp | None
    sky: float
    """Radiance of a uniform surrounding light."""
    sun: tuple[float, float, float] | None
    """Direction in which parallel light of irradiance 2 travels."""
    cameras: Cameras
    has_alpha: bool
    is_evaluation: Array
    """Whether each camera's view is kept from training (N)."""
    paths: int = 36
    """Per pixel and band of a training view; evaluation views have more."""
    noise: float = 0.0
    """Standard deviation of a sensor's noise, of the full range."""
    exposure: float = 1.0
    """Above 1, highlights and the brightest surfaces are blown out."""
    has_wrong_masks: bool = False
    """Whether masks of training views err, as masks made by hand or by thresholds do."""
    is_raw: bool = False
    """Whether it is written as raw counts with a white reference and a dark frame."""


def scene_names() -> list[str]:
    """Every scene there is, those that nobody tunes on last."""
    return [*_BY_HAND, *(f"unseen-{number}" for number in range(1, NUM_UNSEEN + 1))]


def describe(name: str) -> TracedScene:
    """The scene of a name, always the same."""
    return _BY_HAND[name]() if name in _BY_HAND else unseen(int(name.removeprefix("unseen-")))


# Cameras


def _around(
    views: int,
    size: int,
    distance: float,
    target: Sequence[float],
    elevations_deg: tuple[float, float],
    angle_deg: float,
    seed: int = 0,
) -> Cameras:
    """Cameras on a dome, azimuths spread by the golden angle; elevations vary independently of their order."""
    index = np.arange(views)
    azimuths = index * np.pi * (3 - np.sqrt(5)) + seed
    low, high = np.sin(np.deg2rad(elevations_deg))
    heights = low + (high - low) * ((index * np.sqrt(2) + 0.5 / views) % 1)
    flat = np.sqrt(1 - heights**2)
    backward = np.stack([flat * np.cos(azimuths), flat * np.sin(azimuths), heights], axis=1)
    return upright_cameras(np.asarray(target) + distance * backward, backward, size, np.deg2rad(angle_deg))


def _facing(
    views: int, size: int, centre: Sequence[float], spread: float, target: Sequence[float], angle_deg: float
) -> Cameras:
    """Cameras about a place, all looking towards a target."""
    rng = np.random.default_rng(5)
    positions = np.asarray(centre) + rng.uniform(-spread, spread, (views, 3))
    backward = positions - (np.asarray(target) + rng.uniform(-0.2, 0.2, (views, 3)))
    return upright_cameras(
        positions, backward / np.linalg.norm(backward, axis=1, keepdims=True), size, np.deg2rad(angle_deg)
    )


def _every_fourth(views: int) -> Array:
    return np.arange(views) % 4 == 2


# Materials


def _measured(wavelengths_nm: Array, *names: str) -> Array:
    library = measured_library()
    found = [library.find(name) for name in names]
    return np.stack([np.interp(wavelengths_nm, each.bands.centers_nm, each.reflectance) for each in found])


def _modelled(seed: int, wavelengths_nm: Array, *families: str) -> Array:
    rng = np.random.default_rng(seed)
    return np.stack([_landscapes.FAMILIES[family](rng, wavelengths_nm) for family in families]).clip(
        0.01, 0.95
    )


# Scenes made by hand


def _table() -> TracedScene:
    names = ("white card", "red", "blue flower", "yellow green", "orange yellow", "foliage", "dark grey")
    spectra = _measured(
        VISIBLE,
        "ColorChecker/white 9.5",
        "ColorChecker/red",
        "ColorChecker/blue flower",
        "ColorChecker/yellow green",
        "ColorChecker/orange yellow",
        "ColorChecker/foliage",
        "ColorChecker/neutral 3.5",
    )
    rng, count = np.random.default_rng(11), len(names)
    vase = [
        (0, 0),
        (0.32, 0),
        (0.42, 0.25),
        (0.3, 0.6),
        (0.16, 0.8),
        (0.22, 0.95),
        (0.17, 0.95),
        (0.1, 0.8),
        (0, 0.75),
    ]
    bodies = [
        Body.of(block((2.6, 2.6, 0.08), (0, 0, -0.04)), (0, 6), mottled(rng, 2, 0.35, 2.5), count),
        Body.of(turned(vase, (-0.45, 0.25, 0)), (1, 4), mottled(rng, 2, 0.25), count, roughness=0.25),
        Body.of(ball(0.3, (0.5, 0.35, 0.3)), (2, 0), striped(2, 0.2), count, roughness=0.15),
        Body.of(block((0.45, 0.35, 0.5), (0.35, -0.5, 0.25), 0.5), (3, 5), graded(2, 0.0, 0.5), count),
        Body.of(ring(0.26, 0.1, (-0.4, -0.55, 0.1)), (4, 6), mottled(rng, 2, 0.3), count, roughness=0.3),
    ]
    return TracedScene(
        "table", "objects on a table, transparent background", VISIBLE, names, spectra, "D50", bodies,
        Lamp((1.5, -1.0, 3.5), 0.5, 12.0), 0.35, None, _around(32, 96, 4.4, (0, 0, 0.25), (15, 65), 36), True,
        _every_fourth(32),
    )  # fmt: skip


def _room() -> TracedScene:
    wavelengths = np.linspace(450, 650, 15)
    names = ("white paint", "red paint", "green paint", "wood", "blue")
    spectra = _measured(
        wavelengths,
        "ColorChecker/white 9.5",
        "ColorChecker/red",
        "ColorChecker/green",
        "ColorChecker/orange",
        "ColorChecker/blue",
    )
    count, rng, t = len(names), np.random.default_rng(12), 0.1
    walls = [
        (block((2, 2 + t, t), (0, 0, -t / 2)), (3, 0), mottled(rng, 2, 0.5, 3.0)),
        (block((2, 2 + t, t), (0, 0, 2 + t / 2)), (0,), plain),
        (block((t, 2 + t, 2), (-1 - t / 2, 0, 1)), (1,), plain),
        (block((t, 2 + t, 2), (1 + t / 2, 0, 1)), (2,), plain),
        (block((2, t, 2), (0, 1 + t / 2, 1)), (0,), plain),
    ]
    bodies = [Body.of(mesh, materials, pattern, count) for mesh, materials, pattern in walls]
    bodies += [
        Body.of(ball(0.38, (-0.4, 0.25, 0.38)), (4, 0), striped(2, 0.28), count),
        Body.of(block((0.55, 0.55, 0.9), (0.45, 0.3, 0.45), 0.35), (3, 0), graded(2, 0.1, 0.8), count),
    ]
    return TracedScene(
        "room", "inside a room, no alpha", wavelengths, names, spectra, "D50", bodies,
        Lamp((0.4, -3.4, 1.9), 0.45, 40.0), 0.05, None,
        _facing(32, 96, (0, -2.2, 1.0), 0.55, (0, 0.4, 0.9), 50), False, _every_fourth(32),
    )  # fmt: skip


def _pots() -> TracedScene:
    wavelengths = np.linspace(400, 1000, 61)
    names = ("leaf", "dry leaf", "soil", "clay", "grey plastic", "paint")
    spectra = np.concatenate([
        _modelled(21, wavelengths, "plant", "dry plant", "soil", "tile", "asphalt"),
        _modelled(7, wavelengths, "paint"),
    ])  # fmt: skip
    rng, count = np.random.default_rng(13), len(names)
    bodies = [Body.of(block((2.4, 1.6, 0.06), (0, 0, -0.03)), (4,), plain, count)]
    for place, pot, seed in (((-0.55, 0.0), 3, 1), ((0.55, 0.1), 5, 2)):
        bodies += _potted_plant(rng, place, pot, count, leaves=9 + seed)
    return TracedScene(
        "pots", "potted plants, visible and near infrared, transparent background", wavelengths, names, spectra, "A",
        bodies, Lamp((-1.0, -1.5, 3.5), 0.6, 11.0), 0.3, None,
        _around(24, 80, 4.4, (0, 0, 0.5), (12, 60), 34), True, _every_fourth(24),
    )  # fmt: skip


def _potted_plant(
    rng: np.random.Generator, place: tuple[float, float], pot: int, count: int, leaves: int
) -> list[Body]:
    x, y = place
    walls = [(0, 0), (0.24, 0), (0.34, 0.42), (0.29, 0.42), (0.26, 0.34), (0, 0.34)]
    earth = turned([(0, 0), (0.27, 0), (0.25, 0.03), (0, 0.04)], (x, y, 0.34))
    bodies = [
        Body.of(turned(walls, (x, y, 0)), (pot,), plain, count, roughness=0.35),
        Body.of(earth, (2, 1), mottled(rng, 2, 0.1, 2.0), count),
    ]
    for azimuth in np.linspace(0, 2 * np.pi, leaves, endpoint=False) + rng.uniform(0, 0.5, leaves):
        start = (x + 0.05 * np.cos(azimuth), y + 0.05 * np.sin(azimuth), 0.36)
        length, width, rise = rng.uniform(0.45, 0.75), rng.uniform(0.14, 0.24), rng.uniform(0.5, 1.0)
        blade = leaf(start, azimuth, length, width, rise, rng.uniform(0.3, 0.8))
        reach = float(np.linalg.norm(blade.vertices - np.asarray(start), axis=1).max())
        bodies.append(Body.of(blade, (0, 1), _withered(start, reach, rng.uniform(0.6, 1.3)), count))
    return bodies


def _withered(start: Sequence[float], reach: float, healthy: float) -> Callable[[Array], Array]:
    """Healthy near the stem, dry from a share of the length on."""

    def pattern(places: Array) -> Array:
        share = np.linalg.norm(places - np.asarray(start), axis=1) / reach
        dry = np.clip((share - healthy) / 0.3 + 0.5, 0, 1)
        return np.stack([1 - dry, dry], axis=1)

    return pattern


def _turntable() -> TracedScene:
    names = ("leaf", "dry leaf", "soil", "ceramic", "card", "paint")
    spectra = np.concatenate([
        _modelled(31, INFRARED, "plant", "dry plant", "soil", "concrete", "mineral"),
        _modelled(9, INFRARED, "paint"),
    ])  # fmt: skip
    rng, count = np.random.default_rng(14), len(names)
    label = block((0.3, 0.03, 0.36), (0.42, -0.3, 0.2), 0.4)
    bodies = [
        Body.of(
            turned([(0, 0), (0.8, 0), (0.8, -0.05), (0, -0.05)], (0, 0, 0)),
            (4, 5),
            mottled(rng, 2, 0.4),
            count,
        ),
        *_potted_plant(rng, (0.0, 0.0), 3, count, leaves=11),
        Body.of(label, (5, 4), striped(2, 0.12), count, roughness=0.2),
    ]
    index = np.arange(36)
    azimuths, heights = index * np.pi / 9, np.where(index < 18, 0.25, 0.6)
    backward = np.stack(
        [np.cos(azimuths) * np.cos(heights), np.sin(azimuths) * np.cos(heights), np.sin(heights)], axis=1
    )
    cameras = upright_cameras(np.array([0, 0, 0.45]) + 4.2 * backward, backward, 96, np.deg2rad(28))
    return TracedScene(
        "turntable", "a plant turned before a fixed camera and lamp, with noise, blown-out pixels and masks that err",
        INFRARED, names, spectra, "A", bodies, Lamp((-1.6, 1.8, 0.5), 0.25, 45.0, follows_camera=True), 0.12, None,
        cameras, True, index % 4 == 2, noise=0.004, exposure=1.25, has_wrong_masks=True,
    )  # fmt: skip


def _corner() -> TracedScene:
    names = ("white card", "red", "cyan", "foliage", "orange", "grey board")
    spectra = _measured(
        VISIBLE,
        "ColorChecker/white 9.5",
        "ColorChecker/red",
        "ColorChecker/cyan",
        "ColorChecker/foliage",
        "ColorChecker/orange",
        "ColorChecker/neutral 6.5",
    )
    rng, count, t = np.random.default_rng(15), len(names), 0.05
    boards = [
        block((6, 6, t), (0, 0, -t / 2)), block((t, 6, 3), (-3, 0, 1.5)), block((6, t, 3), (0, 3, 1.5)),
    ]  # fmt: skip
    bodies = [Body.of(board, (5,), plain, count) for board in boards]
    bodies += [
        Body.of(block((1.1, 0.9, 0.3), (0, 0, 0.15), 0.3), (0, 1), mottled(rng, 2, 0.12, 6.0), count),
        Body.of(ball(0.32, (0.1, 0.1, 0.62)), (2, 0), mottled(rng, 2, 0.15, 6.0), count, roughness=0.3),
        Body.of(block((0.3, 0.3, 0.6), (-0.35, -0.15, 0.6), 0.8), (3, 4), mottled(rng, 2, 0.12, 6.0), count),
    ]
    index = np.arange(32)
    azimuths = np.deg2rad(-45 + 60 * np.sin(index * 2.4))
    heights = np.deg2rad(20 + 30 * ((index * np.sqrt(2)) % 1))
    backward = np.stack(
        [np.cos(azimuths) * np.cos(heights), np.sin(azimuths) * np.cos(heights), np.sin(heights)], axis=1
    )
    cameras = upright_cameras(np.array([0, 0, 0.45]) + 3.4 * backward, backward, 128, np.deg2rad(36))
    return TracedScene(
        "corner", "a raw capture of objects before a grey corner: counts, white reference, dark frame", VISIBLE, names,
        spectra, "A", bodies, Lamp((1.8, -1.4, 3.2), 0.5, 14.0), 0.3, None, cameras, False, index % 4 == 2, paths=25,
        is_raw=True,
    )  # fmt: skip


def _outdoors() -> TracedScene:
    names = ("grass", "soil", "stone", "rust", "bark")
    spectra = _modelled(41, FEWER_INFRARED, "plant", "soil", "concrete", "tile", "dry plant")
    rng, count = np.random.default_rng(16), len(names)
    hills = random_field(rng, 9.0)

    def relief(places: Array) -> Array:
        return 0.04 * np.hypot(places[:, 0], places[:, 1]) * (hills(places) + 1.0) * 0.5

    statue = [(0, 0), (0.45, 0), (0.45, 0.25), (0.3, 0.3), (0.2, 0.6), (0.3, 0.9), (0.22, 1.2), (0, 1.3)]
    bodies = [
        Body.of(ground(40.0, 0.0, relief), (0, 1), mottled(rng, 2, 1.2, 3.0), count),
        Body.of(turned(statue, (0, 0, 0)), (2, 3), mottled(rng, 2, 0.3), count),
        Body.of(block((0.5, 0.4, 0.35), (0.9, -0.5, 0.17), 0.7), (3, 2), graded(2, 0.0, 0.35), count),
    ]
    for _ in range(14):
        away, angle, tall = rng.uniform(5, 18), rng.uniform(0, 2 * np.pi), rng.uniform(1.0, 3.0)
        place = (away * np.cos(angle), away * np.sin(angle), tall)
        bodies.append(Body.of(ball(0.5 * tall, place), (0, 4), mottled(rng, 2, 0.8), count))
        trunk = block((0.15 * tall, 0.15 * tall, tall), (place[0], place[1], 0.4 * tall), 0.0, edge=0.3)
        bodies.append(Body.of(trunk, (4,), plain, count))
    return TracedScene(
        "outdoors", "a statue on uneven ground with trees far behind it, sun and sky, no alpha", FEWER_INFRARED, names,
        spectra, "E", bodies, None, 0.7, (-0.5, 0.35, -0.8), _around(36, 96, 3.6, (0, 0, 0.6), (8, 45), 52), False,
        _every_fourth(36), paths=25, exposure=0.85,
    )  # fmt: skip


_BY_HAND: dict[str, Callable[[], TracedScene]] = {
    "table": _table,
    "room": _room,
    "pots": _pots,
    "turntable": _turntable,
    "corner": _corner,
    "outdoors": _outdoors,
}


# Scenes that nobody tunes on


def unseen(number: int) -> TracedScene:
    """A scene that is drawn: shapes, materials, how they mix, light and cameras."""
    rng = np.random.default_rng(9000 + number)
    sensor, wavelengths = (("visible", FEWER_VISIBLE), ("vnir", FEWER_INFRARED))[int(rng.integers(2))]
    count = int(rng.integers(4, 8))
    names, spectra = _landscapes.draw_materials(rng, wavelengths, count, sensor, has_twins=False)
    has_alpha = bool(rng.random() < 0.6)
    bodies = [_support(rng, count, has_alpha), *_objects(rng, count, int(rng.integers(3, 6)))]
    # Above all cameras, so that it is behind them.
    lamp = Lamp((*rng.uniform(-3, 3, 2), float(rng.uniform(5.5, 7))), float(rng.uniform(0.5, 1.2)), 25.0)
    views = int(rng.integers(24, 37))
    low = float(rng.uniform(8, 25))
    cameras = _around(
        views, 96, float(rng.uniform(3.8, 4.8)), (0, 0, 0.3), (low, low + float(rng.uniform(25, 45))),
        float(rng.uniform(30, 40)), seed=number,
    )  # fmt: skip
    light = str(rng.choice(["A", "E"] if sensor == "vnir" else ["A", "D50", "D65"]))
    return TracedScene(
        f"unseen-{number}", "drawn objects on a table" if has_alpha else "drawn objects on a wide floor", wavelengths,
        _told_apart(names), spectra.clip(0.01, 0.95), light, bodies, lamp, float(rng.uniform(0.2, 0.6)), None, cameras,
        has_alpha, _every_fourth(views), noise=float(rng.choice([0.0, 0.002, 0.005])),
    )  # fmt: skip


def _told_apart(names: Sequence[str]) -> tuple[str, ...]:
    """The same names, numbered where several are alike."""
    numbers = [list(names[: k + 1]).count(name) for k, name in enumerate(names)]
    return tuple(
        f"{name} {number}" if list(names).count(name) > 1 else name
        for name, number in zip(names, numbers, strict=True)
    )


def _support(rng: np.random.Generator, count: int, has_alpha: bool) -> Body:
    """A table that ends, or a floor that fills every picture."""
    mesh = block((2.6, 2.6, 0.08), (0, 0, -0.04)) if has_alpha else ground(30.0, 0.0)
    first, second = rng.choice(count, 2, replace=False)
    return Body.of(mesh, (int(first), int(second)), mottled(rng, 2, float(rng.uniform(0.2, 0.8)), 3.0), count)


def _objects(rng: np.random.Generator, count: int, number: int) -> list[Body]:
    """Objects in a circle; together they show every material."""
    order = [int(k) for k in rng.permutation(count)]
    bodies = []
    for turn in range(number):
        angle = 2 * np.pi * (turn + rng.uniform(-0.15, 0.15)) / number
        x, y = 0.62 * np.cos(angle), 0.62 * np.sin(angle)
        materials = (order[(2 * turn) % count], order[(2 * turn + 1) % count])
        size, roughness = float(rng.uniform(0.22, 0.34)), float(rng.uniform(0.15, 0.5))
        mesh = _drawn_shape(rng, size, (float(x), float(y)))
        low, high = mesh.bounds[:, 2]
        patterns = (
            mottled(rng, 2, float(rng.uniform(0.15, 0.5)), float(rng.uniform(2, 6))),
            striped(2, float(rng.uniform(0.12, 0.3))),
            graded(2, float(low), float(high)),
        )
        coat = roughness if rng.random() < 0.5 else None
        bodies.append(Body.of(mesh, materials, patterns[int(rng.integers(3))], count, coat))
    return bodies


def _drawn_shape(rng: np.random.Generator, size: float, place: tuple[float, float]):  # noqa: ANN202 - a mesh of trimesh
    x, y = place
    kind = int(rng.integers(5))
    if kind == 0:
        return ball(size, (x, y, size))
    if kind == 1:
        bumps = random_field(rng, 0.9)
        return ball(size, (x, y, size), lambda places: 0.12 * bumps(places))
    if kind == 2:
        return block((rng.uniform(0.8, 1.8, 3) * size).tolist(), (x, y, size * 0.9), float(rng.uniform(0, 3)))
    if kind == 3:
        return ring(size, 0.4 * size, (x, y, 0.4 * size))
    radii = rng.uniform(0.4, 1.0, 4) * size
    profile = [
        (0, 0),
        *((float(r), float(h)) for r, h in zip(radii, np.linspace(0, 2.6 * size, 4), strict=True)),
    ]
    return turned([*profile, (0.0, 2.6 * size)], (x, y, 0))
