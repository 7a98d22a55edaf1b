from typing import Any

import pytest
import torch
from torch.testing import assert_close

from tests.factories.models import NUM_BANDS, losses_of, make_model, make_rays
from unmix_plugin.errors import ConfigError
from unmix_plugin.presets import WITHOUT_ALPHA
from unmix_plugin.settings import LossConfig
from unmix_plugin.spectral.evidence import relative_weights


def test_a_last_colour_background_closes_every_ray_that_meets_something():
    outputs = make_model(losses=LossConfig(background="last")).get_outputs(make_rays(20))
    assert_close(outputs["accumulation"][:-1], torch.ones(19))
    assert outputs["accumulation"][-1] == 0


@pytest.mark.parametrize("background", ["random", "black", "white"])
def test_a_perfect_prediction_has_no_loss_over_any_background(background):
    model = make_model(losses=LossConfig(background=background, rgb=1.0, abundances=0.0))
    spectra, alpha = torch.rand(8, NUM_BANDS), torch.rand(8)
    losses = losses_of(model, {"spectra": spectra, "alpha": alpha}, spectra, alpha)
    assert set(losses) == {"spectral", "rgb", "certainty"}
    assert all(float(loss) < 1e-12 for loss in losses.values())


def test_colours_count_by_default_where_alpha_tells_black_from_the_void():
    batch = {"spectra": torch.rand(8, NUM_BANDS), "alpha": torch.ones(8)}
    models = (make_model(has_alpha=has_alpha) for has_alpha in (True, False))
    masked, bare = (losses_of(model, batch, batch["spectra"] / 2, batch["alpha"]) for model in models)
    assert float(masked["rgb"]) > 0
    assert "rgb" not in bare


@pytest.mark.parametrize(
    ("background", "has_alpha", "least", "most"),
    [
        ("black", True, 0.0, 0.0),
        ("white", True, 1.0, 1.0),
        ("auto", False, 0.0, 0.0),  # black
        ("auto", True, 0.2, 0.5),  # random: the mean square of a grey drawn evenly from [0, 1]
    ],
)
def test_a_bright_background_penalises_missing_opacity(background, has_alpha, least, most):
    batch = {"spectra": torch.zeros(50, NUM_BANDS), "alpha": torch.ones(50)}
    model = make_model(has_alpha=has_alpha, losses=LossConfig(background=background, abundances=0.0))
    found = losses_of(model, batch, batch["spectra"], torch.zeros(50))
    assert least <= float(found["spectral"]) <= most


def test_brighter_than_a_saturated_sensor_is_no_error_but_darker_is():
    model = make_model(losses=LossConfig(background="black", abundances=0.0))
    batch = {"spectra": torch.ones(1, NUM_BANDS), "alpha": torch.ones(1)}
    rendered = (torch.full((1, NUM_BANDS), value) for value in (1.5, 0.5))
    error = [float(losses_of(model, batch, x, torch.ones(1))["spectral"]) for x in rendered]
    assert error == [0.0, 0.25]


@pytest.mark.parametrize("power", [0.0, 1.0, 2.0])
def test_relative_errors_count_the_more_the_darker_the_rendered_pixel_is(power):
    """By weights that pull at no pixel."""
    model = make_model(losses=LossConfig(background="black", rgb=0.0, abundances=0.0, relative=power))

    def loss(rendered: float) -> float:
        spectra = torch.full((1, NUM_BANDS), rendered)
        batch = {"spectra": 0.9 * spectra, "alpha": torch.ones(1)}
        return float(losses_of(model, batch, spectra, torch.ones(1))["spectral"])

    faint = (0.2 + 0.02) / (0.1 + 0.02)
    assert loss(0.2) == pytest.approx(0.02**2, rel=1e-4)
    assert loss(0.1) == pytest.approx(0.01**2 * faint**power, rel=1e-4)
    assert not relative_weights(torch.full((4, NUM_BANDS), 0.1, requires_grad=True), power).requires_grad


def test_transparency_is_penalised_only_where_no_alpha_says_what_is_solid():
    # The last pixel is black: it may be void.
    spectra = torch.tensor([0.5, 0.5, 0.0])[:, None].repeat(1, NUM_BANDS)
    batch = {"spectra": spectra, "alpha": torch.ones(3)}
    opacities = torch.tensor([1.0, 0.5, 0.0])
    closed = losses_of(make_model(has_alpha=False), batch, spectra, opacities)
    assert float(closed["spectral"]) == 0
    assert_close(closed["opacity"], torch.tensor(WITHOUT_ALPHA.opacity_loss_weight * 0.25 / 3))
    assert "opacity" not in losses_of(make_model(), batch, spectra, opacities)


@pytest.mark.parametrize(
    ("name", "has_alpha", "at", "expected"),
    [
        ("sparsity", False, (0.0, 0.125, 0.25, 1.0), (3.0, 0.75, 0.0, 0.0)),
        ("sparsity", True, (0.0, 1.0), (0.0, 0.0)),  # where alpha says what is empty
        ("certainty", False, (0.0, 0.25, 0.5, 1.0), (0.03, 0.0075, 0.0, 0.0)),
        ("certainty", True, (0.0, 0.25, 0.5, 1.0), (0.03, 0.0075, 0.0, 0.0)),
    ],
)
def test_sparsity_and_certainty_are_asked_for_less_and_less(name, has_alpha, at, expected):
    batch = {"spectra": torch.zeros(4, NUM_BANDS), "alpha": torch.ones(4)}
    model = make_model(has_alpha=has_alpha)
    begin_step, found = model.get_training_callbacks()[0].func, []
    weight = WITHOUT_ALPHA.sparsity_loss_weight if name == "sparsity" else 1.0
    given: dict[str, Any] = {name: 3.0}
    for progress in at:
        begin_step(1, progress)
        losses = losses_of(model, batch, batch["spectra"], torch.zeros(4), **given)
        found.append(float(losses.get(name, 0.0)) / weight)
    assert found == pytest.approx(expected)


def test_abundances_are_drawn_to_those_that_measured_spectra_show_and_let_go_as_training_goes_on():
    model = make_model(losses=LossConfig(abundances=0.5))
    begin_step = model.get_training_callbacks()[0].func
    shown = torch.tensor([0, 2, 1])
    spectra, right = 0.5 * model.guide.endmembers[shown], torch.eye(3)[shown]
    batch = {"spectra": spectra, "alpha": torch.ones(3), "pixels": torch.arange(3)}
    found = []
    for progress, abundances in ((0.0, right), *((x, right.roll(1, dims=1)) for x in (0.0, 0.5, 1.0))):
        begin_step(1, progress)
        found.append(float(losses_of(model, batch, spectra, torch.ones(3), abundances)["abundances"]))
    assert found[0] < 1e-6
    assert found[1:] == pytest.approx([1.0, 0.1**0.5, 0.1], rel=0.01)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"rgb": -1.0}, r"rgb of at least 0 and finite or auto \(got -1.0\)$"),
        ({"exposure": 0.0}, r"exposure above 0 and finite or auto"),
        ({"relative": -0.5}, r"relative of 0 to 2 or auto"),
        ({"relative": 2.5}, r"relative of 0 to 2 or auto"),
    ],
)
def test_impossible_losses_are_refused(settings, message):
    with pytest.raises(ConfigError, match=message):
        LossConfig(**settings)


def test_where_alpha_is_not_trusted_missing_opacity_costs_nothing():
    spectra = torch.full((2, NUM_BANDS), 0.3)
    batch = {
        "spectra": spectra,
        "alpha": torch.tensor([1.0, 1.0]),
        "alpha_confidence": torch.tensor([1.0, 0.0]),
    }
    model = make_model(losses=LossConfig(background="white", abundances=0.0, rgb=0.0))
    assert float(losses_of(model, batch, spectra, torch.zeros(2))["spectral"]) == pytest.approx(0.5)
