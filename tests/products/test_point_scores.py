"""Indices and targets of points: whose light is divided out, what they are called, what is refused."""

import numpy as np
import pytest
import torch

from tests.method_factory import WAVELENGTHS_NM, make_model
from unmix_plugin.errors import ConfigError, SpectrumError
from unmix_plugin.products.point_cloud import _require_point_scores
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.library.spectra_csv import SpectraTable, write_spectra_csv

BANDS = Bands.of(WAVELENGTHS_NM)
LIGHT = [0.2, 0.4, 0.6, 0.8, 1.0]
PAINT = torch.tensor([0.1, 0.2, 0.5, 0.7, 0.8])


@pytest.fixture
def paint(tmp_path):
    path = tmp_path / "my paint.csv"
    write_spectra_csv(path, SpectraTable(BANDS, ("gold",), PAINT[None].double().numpy()))
    return path


def properties(*outputs):
    return [score.property for score in _require_point_scores(outputs, BANDS)]


def test_named_indices_keep_their_names_and_the_rest_is_numbered(paint):
    outputs = ("index:r650/r450", "index:PRI", "index:iron-oxide", "index:1+r450", f"target:ace:{paint}")
    assert properties(*outputs) == ["index_1", "index_pri", "index_iron_oxide", "index_2", "target_1"]


def test_an_output_asked_for_twice_is_given_once():
    assert properties("index:pri", "index: PRI", "index:r650/r450", "index:r650/r450") == [
        "index_pri",
        "index_1",
    ]


def test_values_are_of_reflectance_and_undefined_where_the_index_is():
    (score,) = _require_point_scores(["index:r650/r450"], BANDS)
    reflectances = torch.tensor([[0.1, 0.2, 0.3, 0.4, 0.5], [0.0, 0.2, 0.3, 0.4, 0.5]])
    light = torch.tensor(LIGHT)
    values = score.values(reflectances * light, light)
    assert values.dtype == np.float32
    assert values[0] == pytest.approx(5.0, rel=1e-5)
    assert np.isnan(values[1])
    assert score.values(reflectances * light, None)[0] == pytest.approx(25.0, rel=1e-5)


def test_a_target_is_judged_against_the_points_themselves(paint):
    (score,) = _require_point_scores([f"target:mf:{paint}"], BANDS)
    g = torch.Generator().manual_seed(0)
    others = 0.3 + 0.05 * torch.randn(400, 5, generator=g)
    both = torch.cat([others, PAINT[None]])
    values = score.values(both, None)
    assert values[-1] == pytest.approx(1.0, abs=1e-4)
    assert abs(values.mean()) < 1e-4  # scores are taken from the mean of the points


def test_a_comment_says_what_a_property_is_and_whether_the_light_was_known():
    formula, named = _require_point_scores(["index:r650/r450", "index:pri"], BANDS)
    unknown, known = make_model().materials, make_model(light=LIGHT).materials
    assert formula.comment(known) == (
        "index_1: index:r650/r450, formula r650/r450; from the bands at 450, 650 nm"
    )
    assert formula.comment(unknown).endswith("; of radiance, since the scene's light is unknown")
    assert named.comment(known).startswith("index_pri: index:pri, photochemical reflectance index")


@pytest.mark.parametrize("output", ["rgb", "band:650nm", "index", "index:", "target:", "ndvi", ""])
def test_other_outputs_are_refused_with_what_points_take(output):
    with pytest.raises(ConfigError, match=f"--outputs {output}: points take spectral indices, index:NAME"):
        _require_point_scores(["index:pri", output], BANDS)


@pytest.mark.parametrize(
    ("output", "error", "message"),
    [
        ("index:prri", ConfigError, "there is no index 'prri'; nearest: pri"),
        ("index:ndvi", SpectrumError, "needs 800 nm"),
        ("target:none.csv", ConfigError, "none.csv"),
    ],
)
def test_what_cannot_be_computed_is_refused(output, error, message):
    with pytest.raises(error, match=message):
        _require_point_scores([output], BANDS)
