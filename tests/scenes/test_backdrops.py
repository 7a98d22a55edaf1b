from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tests.factories.files import present
from tests.factories.scenes import cameras_of
from unmix_plugin.scenes.backdrops import Backdrop, find_before_backdrop, judge_backdrop
from unmix_plugin.scenes.geometry.views import Views

HEIGHT, WIDTH, BANDS, VIEWS = 90, 120, 6, 5
ROWS, COLUMNS = np.mgrid[:HEIGHT, :WIDTH]
COLOUR = np.linspace(1.0, 0.8, BANDS)
STRIPES = 0.02 * np.random.default_rng(7).standard_normal((WIDTH, BANDS))
STRIPES[[0, 1, -1]] = 0.05

Light = Callable[[int, np.random.Generator], np.ndarray]


def grey(level: float) -> Light:
    return lambda *_: np.full((HEIGHT, WIDTH, BANDS), level)


def shaded_with_a_seam(view: int, _: np.random.Generator) -> np.ndarray:
    """A wall and a floor, both brighter to the right, that meet at a height that changes from view to view."""
    side = np.where(40 + 2 * view + 0.1 * COLUMNS > ROWS, 0.35, 0.5)
    return (side * (0.7 + 0.3 * COLUMNS / WIDTH))[..., None] * COLOUR


def with_a_faint_seam(view: int, _: np.random.Generator) -> np.ndarray:
    """A wall hardly darker than the floor, but in one view, where it stands in the shade."""
    wall = 0.23 if view == 0 else 0.415
    return np.where(40 + 2 * view > ROWS, wall, 0.45)[..., None] * COLOUR


def with_a_round_floor(view: int, _: np.random.Generator) -> np.ndarray:
    """A wall around a floor, which two views show between their lower corners alone."""
    width = 45 if view < 2 else 400
    floor = np.hypot((COLUMNS - 60) / width, (ROWS - 100) / 40) < 1
    return np.where(floor, 0.5, 0.3)[..., None] * COLOUR


BACKDROPS: dict[str, Light] = {
    "black": grey(0.02),
    "grey": grey(0.2),
    "white": grey(0.95),
    "a gradient": lambda *_: (0.2 + 0.5 * ROWS / HEIGHT)[..., None] * COLOUR,
    "stripes of the sensor": lambda *_: np.broadcast_to(0.1 + STRIPES, (HEIGHT, WIDTH, BANDS)),
    "a wall that is darker towards the sides": lambda *_: (
        0.9 * (1 - 0.3 * (2 * COLUMNS / WIDTH - 1.2) ** 2)[..., None] * COLOUR
    ),
    "a shaded wall and floor": shaded_with_a_seam,
    "a wall that is hardly darker than the floor": with_a_faint_seam,
    "a wall around a round floor": with_a_round_floor,
}


def textured(generator: np.random.Generator, low: float, high: float) -> np.ndarray:
    """Patches of six pixels a side."""
    shape = (HEIGHT // 6, WIDTH // 6, BANDS)
    return np.kron(generator.uniform(low, high, shape), np.ones((6, 6, 1)))


def walls(_: int, generator: np.random.Generator) -> np.ndarray:
    """Plain walls of a room: other colours in every view."""
    return np.broadcast_to(generator.uniform(0.1, 0.9, BANDS), (HEIGHT, WIDTH, BANDS))


def landscape(_: int, generator: np.random.Generator) -> np.ndarray:
    """A plain sky above grass."""
    sky = np.broadcast_to(0.9 * COLOUR[::-1], (HEIGHT, WIDTH, BANDS))
    return np.where((ROWS < 45)[..., None], sky, textured(generator, 0.1, 0.4))


def corner(_: int, generator: np.random.Generator) -> np.ndarray:
    """Four plain sides of a room around its back wall."""
    brightness = generator.permutation(np.linspace(0.15, 0.9, 4))[:, None]
    colours = brightness * np.random.default_rng(1).uniform(0.3, 1, (4, BANDS))
    across, down = COLUMNS / WIDTH - 0.5, ROWS / HEIGHT - 0.5
    side = np.where(np.abs(across) > np.abs(down), 2 * (across > 0), 1 + 2 * (down > 0))
    return colours[side]


NO_BACKDROP: dict[str, Light] = {
    "a texture": lambda _, generator: textured(generator, 0.2, 0.6),
    "walls of many colours": walls,
    "a landscape": landscape,
    "a room": corner,
}


def disc(view: int) -> np.ndarray:
    """How much of each pixel a disc covers, that moves from view to view."""
    fine = np.arange(4) / 4 + 0.125
    rows, columns = ROWS[..., None, None] + fine[:, None], COLUMNS[..., None, None] + fine
    return (np.hypot(rows - 46, columns - 55 - 4 * view) < 25).mean(axis=(2, 3))


def pictures(light: Light, matter: bool = True) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Views and how much of each pixel is matter."""
    generator, images, covers = np.random.default_rng(3), [], []
    for view in range(VIEWS):
        cover = disc(view) if matter else np.zeros((HEIGHT, WIDTH))
        thing = textured(generator, 0.35, 0.75) * np.linspace(0.3, 1.0, BANDS)
        image = cover[..., None] * thing + (1 - cover[..., None]) * light(view, generator)
        noisy = image + 0.002 * generator.standard_normal(image.shape)
        images.append(noisy.clip(0, 1).astype(np.float32))
        covers.append(cover)
    return images, covers


EVERYWHERE = np.ones((HEIGHT, WIDTH), bool)


def judge(images: list[np.ndarray], known: np.ndarray = EVERYWHERE) -> Backdrop | None:
    sample = np.concatenate([image[::5, ::3].reshape(-1, BANDS) for image in images])
    return judge_backdrop([(image, known) for image in images], sample)


def seen_in(image: np.ndarray, images: list[np.ndarray], known: np.ndarray = EVERYWHERE) -> Any:
    """The backdrop of some views, and what it looks like in one."""
    backdrop = present(judge(images, known))
    return backdrop, backdrop.find(backdrop.features(image), known)


@pytest.mark.parametrize("name", BACKDROPS)
def test_a_plain_backdrop_is_found_said_and_cut_out_with_soft_edges(name: str):
    images, covers = pictures(BACKDROPS[name])
    backdrop = present(judge(images))
    assert name not in ("black", "grey", "white") or backdrop.in_words.startswith(name)
    for image, cover in zip(images, covers, strict=True):
        seen = present(backdrop.find(backdrop.features(image), EVERYWHERE))
        opacity = seen.opacity(~seen.shown)
        assert ((opacity > 0.5) != (cover > 0.5)).mean() < 0.012
        sides = np.r_[0:3, WIDTH - 3 : WIDTH]
        assert (opacity[:, sides] > 0).mean() < 0.05  # stripes at the ends of a line too
        edge = (cover > 0.2) & (cover < 0.8)
        assert np.abs(opacity - cover)[edge].mean() < 0.2
        assert np.abs(opacity - (cover > 0.5))[edge].mean() > 0.2  # not a step


def test_what_the_backdrop_looks_like_is_known_where_matter_hides_it():
    images, covers = pictures(BACKDROPS["a gradient"])
    backdrop, seen = seen_in(images[0], images)
    hidden = covers[0] == 1
    expected = BACKDROPS["a gradient"](0, np.random.default_rng(0))[hidden]
    np.testing.assert_allclose(backdrop.spectra(seen.behind[hidden]), expected, atol=0.03)


@pytest.mark.parametrize("name", NO_BACKDROP)
def test_rooms_and_landscapes_have_none(name: str):
    assert judge(pictures(NO_BACKDROP[name])[0]) is None


def test_plain_ground_with_little_on_it_is_no_backdrop():
    images, _ = pictures(BACKDROPS["grey"], matter=False)
    for view, image in enumerate(images):
        image[20 + view : 34 + view, 30:60] = 0.7  # a tenth of the height and a quarter of the width
    assert judge(images) is None
    for view, image in enumerate(images):
        image[10 + view : 60 + view, 20:80] = 0.7
    assert judge(images) is not None


def test_a_view_that_matter_fills_keeps_all_of_it():
    close = textured(np.random.default_rng(0), 0.35, 0.75).astype(np.float32)
    _, seen = seen_in(close, pictures(BACKDROPS["grey"])[0])
    assert seen is None or not seen.shown.any()


def test_a_view_without_any_surface_at_its_border_is_judged_with_the_others():
    """As a printed floor fills one view, which the others show beside a plain wall."""
    images, _ = pictures(BACKDROPS["grey"])
    printed = np.random.default_rng(1).uniform(0, 1, (HEIGHT, WIDTH, BANDS)).astype(np.float32)
    assert judge([printed, *images[1:]]) is not None
    assert judge([printed, printed[::-1], *images[3:]]) is None


@pytest.mark.parametrize("is_plain", [False, True])
def test_matter_that_reaches_the_border_stays(is_plain: bool):
    """A dark pot that the picture's lower edge cuts off is no second surface, even where it reaches a corner, nor are
    the dark leaves above it."""
    images, _ = pictures(BACKDROPS["white"])
    texture = textured(np.random.default_rng(4), 0.3, 0.6)
    stand = (0.01 * texture if is_plain else texture).astype(np.float32)
    for view, image in enumerate(images):
        left = 0 if view < 2 else 40
        image[50:, left:70] = stand[50:, left:70]
    for image in images[1:3]:
        _, seen = seen_in(image, images)
        assert not seen.shown[50:, 41:69].any()


def test_pixels_without_a_measurement_are_not_the_backdrop():
    images, _ = pictures(BACKDROPS["black"])
    _, seen = seen_in(images[0], images, EVERYWHERE & (COLUMNS >= 4))
    assert not seen.shown[:, :4].any()
    assert seen.shown[:, 4:8].all()


def test_a_backdrop_of_large_views_is_kept_thinned_out():
    views = [np.full((450, 500, 4), 0.3, np.float32) for _ in range(5)]
    for shift, view in enumerate(views):
        view[100 : 300 + 10 * shift, 150:350] = np.linspace(0.05, 0.9, 200)[:, None]
    cameras = cameras_of([np.eye(4)] * 5, 500, 450, 1.0)
    found = present(find_before_backdrop(Views(cameras, lambda view, part: views[view][part])))
    assert sum(mask.size for mask in found.thinned) == 5 * 150 * 167
    for mask, view in zip(found.masks(), views, strict=True):
        assert mask.shape == (450, 500)
        assert (mask != (view != np.float32(0.3)).any(axis=-1)).mean() < 0.05
