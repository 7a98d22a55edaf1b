"""A field without some of its materials: what vanishes, what stays, and what is left of mixtures."""

import torch
from torch import Tensor
from torch.testing import assert_close

from unmix_plugin.editing.edited_field import EditedField
from unmix_plugin.field import CoefficientField

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

    def get_density(self, positions):
        return self.density_of(self.encode(positions))

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


def test_density_is_whole_where_mostly_kept_matter_is_and_none_where_mostly_removed_matter_is():
    densities, _ = look(EditedField(GivenField(MIXTURES), torch.tensor([False, True, True]), PLAIN), 5)
    assert_close(densities, torch.tensor([0.0, 0.0, 2.5, 5.0, 5.0]))


def test_what_is_removed_and_what_is_isolated_make_up_the_whole():
    shares = torch.linspace(0, 1, 21)
    field = GivenField(torch.stack([shares, 1 - shares, 0 * shares], dim=-1))
    without, alone = (
        look(EditedField(field, torch.tensor(kept), PLAIN), 21)[0]
        for kept in ([False, True, True], [True, False, False])
    )
    assert_close(without + alone, torch.full((21,), 5.0))
    assert (alone.diff() >= 0).all()


def test_abundances_of_what_is_left_keep_their_proportions_and_sum_to_one():
    kept = torch.tensor([False, True, True])
    _, outputs = look(EditedField(GivenField(MIXTURES), kept, PLAIN), 5)
    assert_close(outputs["abundances"][2], torch.tensor([0.0, 0.6, 0.4]))
    assert_close(outputs["scaled_abundances"], 0.5 * outputs["abundances"])
    assert_close(outputs["abundances"].sum(-1), torch.tensor([0.0, 1, 1, 1, 1]))
    assert torch.isfinite(outputs["abundances"]).all()


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


def test_nothing_removed_costs_no_look_at_the_materials():
    field = GivenField(MIXTURES)
    field.abundances_of = None  # type: ignore[method-assign,assignment]
    assert_close(EditedField(field, ALL, PLAIN).get_density(torch.zeros(5, 3))[0], torch.full((5,), 5.0))
