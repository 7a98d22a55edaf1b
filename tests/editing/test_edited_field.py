"""The field after edits, and how cameras see its materials."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from tests.factories.edited_scenes import CAMERAS, LIGHT, edited, lit_scene
from unmix_plugin.editing import sample_seen
from unmix_plugin.editing.edited_field import Appearance, EditedField, MaterialState, appearance_of
from unmix_plugin.field import CoefficientField
from unmix_plugin.figures.plotting import css_colour
from unmix_plugin.spectral.colour.conversion import linear_to_srgb, rgb_matrix
from unmix_plugin.spectral.materials import Coefficients
from unmix_plugin.trained.run_views import RunView

ALL = torch.tensor([True, True, True])
PLAIN = torch.ones(1, 3)


class GivenField(CoefficientField):
    """A field whose abundances are its features, of density 5 and two specular coefficients."""

    def __init__(self, abundances: Tensor) -> None:
        super().__init__()
        self.abundances = abundances

    def encode(self, positions, known=None):
        return self.abundances

    def density_of(self, encoded):
        return torch.full((len(encoded),), 5.0), encoded

    def abundances_of(self, features):
        return features

    def get_outputs(self, positions, directions, features, light=None):
        specular = torch.tensor([[0.2, 0.4]]).expand(len(features), 2)
        return {
            "abundances": features,
            "scaled_abundances": 0.5 * features,
            "specular_coefficients": specular,
        }


def look(field: CoefficientField, count: int) -> tuple[Tensor, dict[str, Tensor]]:
    positions = torch.zeros(count, 3)
    densities, features = field.get_density(positions)
    return densities, field.get_outputs(positions, positions, features)


MIXTURES = torch.tensor([[1.0, 0, 0], [0.8, 0.2, 0], [0.5, 0.3, 0.2], [0.2, 0.4, 0.4], [0, 0, 1.0]])


def test_what_is_left_is_as_dense_as_its_share_is_large_and_keeps_its_proportions():
    densities, outputs = look(EditedField(GivenField(MIXTURES), torch.tensor([False, True, True]), PLAIN), 5)
    assert_close(densities, torch.tensor([0.0, 0.0, 2.5, 5.0, 5.0]))
    assert_close(outputs["abundances"][2], torch.tensor([0.0, 0.6, 0.4]))
    assert_close(outputs["scaled_abundances"], 0.5 * outputs["abundances"])
    assert_close(outputs["abundances"].sum(-1), torch.tensor([0.0, 1, 1, 1, 1]))
    assert torch.isfinite(outputs["abundances"]).all()


def test_what_is_removed_and_what_is_isolated_make_up_the_whole():
    shares = torch.linspace(0, 1, 21)
    field = GivenField(torch.stack([shares, 1 - shares, 0 * shares], dim=-1))
    without, alone = (
        look(EditedField(field, torch.tensor(kept), PLAIN), 21)[0]
        for kept in ([False, True, True], [True, False, False])
    )
    assert_close(without + alone, torch.full((21,), 5.0))
    assert (alone.diff() >= 0).all()


def test_gloss_goes_by_shares_and_each_mirror_has_coefficients_of_its_own():
    gloss = torch.tensor([[1.0, 0.0, 3.0], [0.0, 2.0, 0.0]])
    _, outputs = look(EditedField(GivenField(MIXTURES), ALL, gloss), 5)
    specular = outputs["specular_coefficients"]
    assert specular.shape == (5, 4)
    shine = torch.tensor([0.5 + 0.6, 0.5 + 0.6, 0.6, 0.6])
    assert_close(specular[2], shine * torch.tensor([0.2, 0.4, 0.2, 0.4]))


def test_edits_over_edits_are_one():
    field = GivenField(MIXTURES)
    first = EditedField.over(field, torch.tensor([True, False, True]), torch.tensor([[1.0, 1, 0.5]]))
    both = EditedField.over(first, torch.tensor([True, True, False]), torch.tensor([[2.0, 1, 1], [0, 0, 4]]))
    assert both.field is field
    assert both.is_kept.tolist() == [True, False, False]
    assert_close(both.gloss, torch.tensor([[2.0, 1, 0.5], [0, 0, 2]]))


def seen_pixels(shading: list[float], share: float = 1.0) -> Coefficients:
    """Opaque pixels, all of endmember 0 and without gloss."""
    strengths, ones = torch.tensor(shading)[:, None], torch.ones(len(shading))
    abundances = torch.tensor([share, 1 - share, 0.0]).expand(len(shading), 3)
    return Coefficients.of(ones, ones, abundances, strengths * abundances, 0 * strengths)


def srgb(text: str) -> torch.Tensor:
    return torch.tensor([int(text[i : i + 2], 16) for i in (1, 3, 5)]).double() / 255


def own_srgb(spectrum: torch.Tensor, bands) -> torch.Tensor:
    return linear_to_srgb(spectrum.double() @ rgb_matrix(bands, torch.float64))


@pytest.mark.parametrize(
    ("index", "more", "seen"), [(0, "", None), (0, ", match: spectrum", [0.4] * 50), (1, "", [0.4] * 50)]
)
def test_a_spectrum_gets_the_colour_itself_where_the_picture_is_not_known_or_not_meant(index, more, seen):
    edit = f"retint: {{endmember: {index}, colour: '#807040'{more}}}"
    result = edited(lit_scene(), edit, seen=None if seen is None else seen_pixels(seen))
    found = own_srgb(result.materials.endmembers[index], result.bands)
    assert_close(found, srgb("#807040"), atol=1e-4, rtol=0)


@pytest.mark.parametrize("share", [1.0, 0.6])
def test_pixels_get_the_colour_in_the_mean_where_the_picture_is_known(share):
    scene = lit_scene()
    shading = torch.linspace(0.3, 0.8, 60)
    pixels = seen_pixels(shading.tolist(), share)
    result = edited(scene, "retint: {endmember: 0, colour: '#a09060'}", seen=pixels)
    shown = own_srgb(pixels.scaled_abundances @ result.materials.endmembers, result.bands).mean(0)
    assert_close(shown, srgb("#a09060"), atol=1e-4, rtol=0)


def test_highlights_count_in_the_mean_and_mixtures_hardly():
    pure, mixed = seen_pixels([0.6] * 30), seen_pixels([0.6] * 30, 0.55)
    pure.specular[:] = 0.1
    pixels = Coefficients.concatenate([pure, mixed])
    materials = edited(lit_scene(), "retint: {endmember: 0, colour: '#a09080'}", seen=pixels).materials
    asked = srgb("#a09080")
    of_pure, of_mixed = (own_srgb(materials.spectra(part), materials.bands)[0] for part in (pure, mixed))
    assert_close(of_pure, asked, atol=0.02, rtol=0)
    assert (of_mixed - asked).abs().max() > 0.05


def test_a_shaded_material_may_be_brighter_than_white_and_is_as_near_to_a_colour_as_its_pixels_allow():
    appearance = Appearance(np.linspace(0.2, 0.5, 100), np.zeros((100, 3)), np.ones(100))
    assert appearance.greatest_reflectance == pytest.approx(1 / 0.485, rel=0.01)
    assert Appearance(np.full(9, 2.0), np.zeros((9, 3)), np.ones(9)).greatest_reflectance == 1
    reddish = Appearance(np.full(20, 0.5), np.full((20, 3), [0.3, 0.0, 0.0]), np.ones(20))
    np.testing.assert_allclose(reddish.full_colour((0.2, 0.0, 0.5)), [0.0, 0.0, 2 * 0.21404], atol=1e-4)


def test_a_colour_that_pictures_cannot_have_becomes_the_nearest_that_they_can():
    seen = seen_pixels([0.1] * 50 + [0.6] * 10)
    scene = lit_scene()
    result = edited(scene, "retint: {endmember: 0, colour: '#ffffff'}", seen=seen)
    [note] = result.notes
    name = scene.materials.names[0]
    assert f"(retint): pictures of {name} can't be #ffffff in this light; took the nearest colour" in note
    reached = result.reached_colours["retint", 0]
    assert max(reached) < 0.9
    assert note.endswith(css_colour(reached))
    swapped = edited(lit_scene(), "retint: {endmember: 0, colour: '#ffffff'}", "swap: [0, 1]", seen=seen)
    assert swapped.reached_colours == {("retint", 1): reached}
    brightest = result.materials.endmembers[0].detach().double() / torch.tensor(LIGHT).double()
    all_of_bound = torch.full_like(brightest, 1 / 0.6)
    assert_close(brightest, all_of_bound, rtol=1e-3, atol=0)


@pytest.mark.parametrize(
    ("count", "index", "is_seen"), [(15, 0, False), (16, 0, True), (50, 2, False), (None, 0, False)]
)
def test_endmembers_that_are_hardly_seen_have_no_appearance(count, index, is_seen):
    state = MaterialState.of(lit_scene().materials, None)
    state.seen = None if count is None else seen_pixels([0.5] * count)
    assert (appearance_of(state, index) is not None) is is_seen


def test_what_is_seen_is_sampled_from_coarse_pictures_of_several_views():
    scene, wide = lit_scene(), CAMERAS.resized(96, 80)
    seen = sample_seen(scene)
    assert seen.abundances.shape == (2 * 12 * 10, 3)
    views = tuple(RunView(f"wide_{view}", wide[view], "train") for view in range(2))
    coarse = sample_seen(replace(scene, views=views))
    assert coarse.abundances.shape == (2 * 32 * 26, 3)
    assert_close(coarse.accumulation.mean(), seen.accumulation.mean(), rtol=0.05, atol=0)


@pytest.mark.parametrize(
    "before",
    [
        (),
        ("gloss: {scale: 0}",),
        ("gloss: {scale: 3, colour: '#c0a060'}",),
        ("gloss: {endmember: %d, scale: 3}", "gloss: {scale: 0.4}"),
        ("gloss: {endmember: %d, scale: 3, colour: '#c0a060'}",),
        ("isolate: %d",),
    ],
)
def test_pictures_of_a_scene_have_the_colour_in_the_mean_over_a_materials_pixels(before):
    scene = lit_scene()
    seen = sample_seen(scene)
    index = int(seen.abundances.argmax(-1)[seen.accumulation >= 0.5].mode().values)
    earlier = [edit % index if "%" in edit else edit for edit in before]
    result = edited(scene, *earlier, f"retint: {{endmember: {index}, colour: '#606858'}}")
    views = [result.look(CAMERAS[view], subpixels=1) for view in range(2)]
    shares = torch.cat([view["abundances"].flatten(0, 1) for view in views])
    opacity = torch.cat([view.opacity.flatten() for view in views])
    colours = torch.cat([view["rgb"].flatten(0, 1) for view in views])
    is_its = (shares.argmax(-1) == index) & (opacity >= 0.5)
    weights = (shares[is_its][:, index] / opacity[is_its])[:, None] ** 4
    mean = (weights * colours[is_its]).sum(0) / weights.sum()
    assert_close(mean.double(), srgb("#606858"), atol=2e-3, rtol=0)
