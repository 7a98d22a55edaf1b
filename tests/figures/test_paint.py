"""The one painter: what lies behind, what is undefined, and light as a display shows it."""

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from unmix_plugin.engine.outputs import Output, OutputKind
from unmix_plugin.figures.look import NEUTRAL, Look
from unmix_plugin.figures.paint import ColourScale, colour_table, id_palette, legend_of, paint
from unmix_plugin.spectral.colour.conversion import linear_to_srgb, srgb_to_linear

CLASSES = (("clay", (0.8, 0.4, 0.2)), ("wax", (0.1, 0.2, 0.9)))


def output(kind: OutputKind, **more) -> Output:
    return Output(kind, kind, kind, "what it is", **more)


VALUES = {
    "srgb": torch.rand(3, 4, 3, generator=torch.Generator().manual_seed(0)),
    "linear": torch.rand(3, 4, 3, generator=torch.Generator().manual_seed(1)),
    "grey": torch.rand(3, 4, generator=torch.Generator().manual_seed(2)),
    "picture": torch.rand(3, 4, 3, generator=torch.Generator().manual_seed(3)),
    "vectors": 2 * torch.rand(3, 4, 3, generator=torch.Generator().manual_seed(4)) - 1,
    "map": torch.rand(3, 4, generator=torch.Generator().manual_seed(5)),
    "shares": torch.rand(3, 4, 2, generator=torch.Generator().manual_seed(6)),
}


@pytest.mark.parametrize("kind", VALUES)
def test_an_opaque_picture_is_the_transparent_one_laid_over_its_background(kind):
    opacity = torch.linspace(0.3, 1, 12).view(3, 4)
    scaled = VALUES[kind] * (opacity.view(3, 4, *(1,) * (VALUES[kind].dim() - 2)) if kind != "vectors" else 1)
    painted = paint(output(kind, value_range=(0.0, 1.0)), scaled, opacity)
    rgba = painted.rgba()
    part, straight = rgba[..., 3:] / 255, rgba[..., :3] / 255
    if painted.is_light:
        light = srgb_to_linear(torch.from_numpy(straight)).numpy()
        behind = float(srgb_to_linear(torch.tensor(NEUTRAL)))
        expected = linear_to_srgb(torch.from_numpy(light * part + behind * (1 - part))).numpy()
    else:
        expected = straight * part + NEUTRAL * (1 - part)
    np.testing.assert_allclose(painted.over().numpy(), expected, atol=0.006)


@pytest.mark.parametrize("kind", VALUES)
def test_where_nothing_is_the_background_shows(kind):
    for background in (0.0, NEUTRAL, 1.0):
        painted = paint(output(kind, value_range=(0.0, 1.0)), VALUES[kind], torch.zeros(3, 4))
        shown = painted.over(background)
        assert_close(shown, torch.full_like(shown, background), atol=1e-6, rtol=0)
        assert not painted.rgba().any()


def test_values_beyond_a_scale_have_the_colours_of_its_ends_and_undefined_ones_are_hatched():
    given = output("map", value_range=(0.0, 1.0))
    painted = paint(given, torch.tensor([[-1.0, 0.0, 0.5, 1.0, 7.0, torch.nan]]), torch.ones(1, 6))
    [row] = painted.over()[:, :, 0].numpy()
    table = colour_table("viridis")
    np.testing.assert_allclose(row[:5], table[[0, 0, 128, 255, 255]])
    assert np.ptp(row[5]) == 0
    assert painted.rgba()[0, :, 0, 3].tolist() == [255] * 6
    nothing = torch.full((16, 16), torch.nan)
    greys = paint(given, nothing, torch.ones(16, 16)).picture()
    assert len(np.unique(greys)) == 2
    np.testing.assert_array_equal(greys[1:, :-1], greys[:-1, 1:])  # along diagonals
    assert not paint(given, nothing, torch.full((16, 16), 0.4)).rgba().any()
    chosen = paint(
        given, torch.tensor([[1.5]]), torch.ones(1, 1), look=Look(colour_map="gray", value_range=(1.0, 2.0))
    )
    assert chosen.legend == ColourScale("gray", 1.0, 2.0, "what it is")
    np.testing.assert_allclose(chosen.picture()[0, 0], 0.5, atol=0.01)


@pytest.mark.parametrize("classes", [(), CLASSES])
def test_ids_have_the_colours_of_their_classes_whatever_the_opacity_and_others_are_grey(classes):
    ids = torch.tensor([[0, 1, 7, 255]], dtype=torch.uint8)
    painted = paint(output("labels", classes=classes), ids, torch.full((1, 4), 0.6))
    [row] = painted.picture(1.0)
    if classes:
        np.testing.assert_allclose(row, [*(colour for _, colour in classes), [NEUTRAL] * 3, [1.0] * 3])
        assert painted.legend == classes
    else:
        assert len({tuple(colour) for colour in row}) == 4
    assert painted.rgba()[0, :, 0, 3].tolist() == [255, 255, 255, 0]
    np.testing.assert_array_equal(
        id_palette([(1.0, 0.0, 0.0)])[[0, 1, 255]], [[1, 0, 0], [NEUTRAL] * 3, [NEUTRAL] * 3]
    )


def test_fractions_are_a_picture_each_or_mixed_in_the_colours_of_their_classes():
    given = output("shares", value_range=(0.0, 1.0), classes=CLASSES, is_premultiplied=True)
    half, opacity = torch.tensor([[[0.3, 0.1]]]), torch.full((1, 1), 0.4)
    tiles = paint(given, half, opacity).colours[0, 0]
    np.testing.assert_allclose(tiles.numpy(), colour_table("viridis")[[192, 64]])
    mixed = paint(given, half, opacity, look=Look(mixed=True))
    expected = 0.75 * np.array(CLASSES[0][1]) + 0.25 * np.array(CLASSES[1][1])
    np.testing.assert_allclose(mixed.colours[0, 0, 0].numpy(), expected, atol=1e-6)
    assert mixed.legend == CLASSES


def test_a_single_band_is_grey_light_or_in_a_colour_map_as_a_value_of_what_is_seen():
    light, opacity = torch.full((1, 1), 0.2), torch.full((1, 1), 0.5)
    grey = paint(output("grey"), light, opacity)
    assert grey.is_light
    np.testing.assert_allclose(grey.colours[0, 0, 0].numpy(), 0.4, atol=1e-6)
    chosen = paint(output("grey"), light, opacity, (0.0, 0.8), Look(colour_map="magma"))
    np.testing.assert_allclose(chosen.colours[0, 0, 0].numpy(), colour_table("magma")[128])
    assert isinstance(legend_of(output("grey"), (0.0, 0.8), Look(colour_map="magma")), ColourScale)


def displayed(light: torch.Tensor, **look) -> torch.Tensor:
    """Opaque light as sRGB."""
    return (
        paint(output("linear"), light[None], torch.ones(1, len(light)), look=Look(**look))
        .over()[0, :, 0]
        .float()
    )


GREYS = torch.logspace(-3, 2, 200)[:, None].expand(-1, 3)


def test_light_is_srgb_up_to_white_gamma_lifts_the_dark_and_a_stop_doubles_the_light():
    light = torch.rand(50, 3, generator=torch.Generator().manual_seed(0))
    plain = displayed(light)
    assert_close(plain, linear_to_srgb(light))
    assert_close(displayed(light + 1), torch.ones(50, 3), atol=1e-6, rtol=0)
    assert_close(displayed(light, gamma=2.0), plain**0.5)
    for stops in (-3.0, 0.5, 2.0):
        kept = displayed(light * 2**stops, highlights="kept")
        assert_close(displayed(light, exposure=stops, highlights="kept"), kept)


@pytest.mark.parametrize("highlights", ["cut", "kept"])
def test_more_light_is_never_darker_and_grey_stays_grey(highlights):
    shown = displayed(GREYS, highlights=highlights)
    assert (shown.diff(dim=0) >= -1e-6).all()
    assert (shown.amax(dim=1) - shown.amin(dim=1)).max() < 1e-3
    assert 0 <= shown.min() <= shown.max() <= 1


def test_kept_highlights_show_middle_grey_in_the_middle_and_let_bright_colours_fade():
    middle = displayed(torch.full((1, 3), 0.18), highlights="kept")
    assert float(middle.mean()) == pytest.approx(0.5, abs=0.01)
    bright = displayed(torch.tensor([[1.0], [2.0], [4.0]]).expand(-1, 3), highlights="kept")[:, 0]
    assert bright.diff().min() > 0.03
    dim, bright = displayed(torch.tensor([[0.2, 0.0, 0.0], [16.0, 0.0, 0.0]]), highlights="kept")
    assert float(dim[1] / dim[0]) < 0.5 < 0.6 < float(bright[1] / bright[0])
