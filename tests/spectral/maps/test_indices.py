import ast
import math
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch

from unmix_plugin.errors import ConfigError, SpectrumError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.maps.indices import NAMED_INDICES, available_indices, parse_formula, parse_index

VALUES = {450.0: 0.05, 550.0: 0.12, 670.0: 0.3, 800.0: 0.7}


def value(text, dtype=torch.float64):
    """The formula's value where r450 = 0.05, r550 = 0.12, r670 = 0.3, r800 = 0.7."""
    like = torch.zeros((), dtype=dtype)
    return parse_formula(text).evaluate(lambda nm: like.new_tensor(VALUES[nm]), like)


@pytest.mark.parametrize(
    "texts",
    [
        ("r800", "r800-r670-r550", "r800/r670/r550", "r800-(r670-r550)", "r800/(r670/r550)"),
        ("r800+r670*r550", "(r800+r670)*r550", "r800/r670*r550", "-r800**2", "(-r800)**2", "r800**-2"),
        ("r800**-r670**2", "2**r800**r670", "(2**r800)**r670", "r800*-r670", "--r800", "r800--r670"),
        ("-r800*r670-r550", "1/r550-1/r800", "2.5*(r800-r670)/(r800+6*r670-7.5*r450+1)"),
        ("1e-2*r800 + .5E1 + 3.", " ( r800 -\tr670 ) / r550 ", "max(min(r800, 1), r670/r550)"),
        ("sqrt(r800) + log(r670) * exp(-r550) - abs(r450-r800)", "min(r800, r670, 0.1) + max(r550, r450**2)"),
    ],
)
def test_operators_bind_as_in_python(texts):
    names = {f"r{nm:g}": number for nm, number in VALUES.items()}
    for text in texts:
        python = eval(text.strip(), {**vars(math), "abs": abs, "min": min, "max": max}, names)
        assert float(value(text)) == pytest.approx(python, rel=1e-14), text


UNDEFINED = (
    *("0*r800/(r670-r670)", "1/(1/(r800-r800))", "((r800-r800)/(r800-r800))**0", "1**log(-r800)"),
    *("max(r800, log(0))", "exp(-exp(1e4*r800))", "log(-r800)", "sqrt(-r800)", "(-r800)**0.5"),
    *("0*r800**-1e999", "r800*10**10**10", "r800+1e300*1e300", "r800*1e999"),
)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_what_is_undefined_anywhere_in_a_formula_is_nan(dtype):
    for text in UNDEFINED:
        result = value(text, dtype)
        assert result.dtype == dtype
        assert result.isnan(), text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("(r800-)", r"column 7: .*\n  \(r800-\)\n {8}\^\nallowed are numbers, r800"),
        ("r800)", "column 5: "),
        ("r800 r670", "column 6: "),
        ("r800nm", "column 1: "),
        ("R800+b3", "column 6: "),
        ("sqrt r800", "column 6: "),
        ("1+sqrt(r800, 2)", "column 3: "),
        ("min(r800)", "column 1: "),
        ("r800.5+ min(r800, *r800)", "column 19: "),
        ("r800 % 2", "column 6: "),
        ("r800\n+?", r"column 7: .*\n  r800 \+\?\n {8}\^"),
        ("", "column 1: "),
        ("1+2", "takes no wavelength; write r800 for the reflectance at 800 nm"),
        ("10**10**10", "takes no wavelength"),
    ],
)
def test_a_fault_is_shown_at_its_place_with_what_is_allowed(text, message):
    with pytest.raises(ConfigError, match=message):
        parse_formula(text)


HOSTILE = (
    *("__import__('os').system('true')", "r800.__class__", "(r800).real", "r800 if r800 else r670"),
    *("1if r800 else 2", "lambda: r800", "[r800 for _ in r800]", "r800; r670", "r800 = 1", "eval(r800)"),
    *("r800 // 2", "+r800", "2r800", "0x10*r800", "r800, r670", "r800(r670)", "sqrt(**r800)", "r800 + ..."),
    *("r\uff18\uff10\uff10", "\x00r800", "sqrt(" * 90 + "r800", "r800" + "+r800" * 100),
)


@pytest.mark.parametrize("text", HOSTILE)
def test_hostile_text_is_refused_at_once(text):
    start = time.process_time()  # not the clock on the wall: other work may run beside the tests
    with pytest.raises(ConfigError):
        parse_formula(text)
    assert time.process_time() - start < 0.5


def test_the_longest_and_most_nested_formula_is_read():
    longest = "r800" + "+r800" * 99
    assert float(value(longest)) == pytest.approx(70)
    with pytest.raises(ConfigError, match="at most 500 characters; this one has 504"):
        parse_formula(longest + "+r800")
    assert float(value("(" * 49 + "r800" + ")" * 49)) == 0.7
    assert float(value("-" * 60 + "r800")) == 0.7


def test_numbers_may_be_large_and_have_zeros_before_them():
    assert float(value("007*r800*00.50")) == pytest.approx(2.45)
    assert float(value("r800/" + "9" * 26)) == pytest.approx(0.7e-26)
    assert float(value("r800+" + "9" * 400)) != float(value("r800+" + "9" * 400))


def test_a_caret_is_the_power_operator_case_does_not_matter_and_wavelengths_may_have_decimals():
    assert value("R800^2^2*SQRT(R670)") == value("r800**2**2*sqrt(r670)")
    assert parse_formula("r800.5/(r670+r800.5)-r450").wavelengths_nm == (450.0, 670.0, 800.5)


FULL = Bands.of(range(350, 2501, 10))
VISIBLE = Bands.of(range(400, 701, 10))
VNIR = Bands.of(range(400, 1001, 10))

RATIOS = ["ndvi", "gndvi", "ndre", "pri", "sipi", "psri", "ndwi", "ndwi-gao", "nbr", "redness", "iron-oxide"]
"""The named indices that have no unit: a common factor of all bands cancels."""

LEAF = {
    "ndvi": 0.45 / 0.55,
    "gndvi": 0.4 / 0.6,
    "evi": 2.5 * 0.45 / (0.5 + 6 * 0.05 - 7.5 * 0.04 + 1),
    "savi": 1.5 * 0.45 / 1.05,
    "osavi": 0.45 / 0.71,
    "ndre": (0.49 - 0.2) / (0.49 + 0.2),
    "pri": (0.07 - 0.09) / (0.07 + 0.09),
    "mcari": ((0.12 - 0.05) - 0.2 * (0.12 - 0.1)) * 0.12 / 0.05,
    "tvi": 0.5 * (120 * (0.4 - 0.1) - 200 * (0.05 - 0.1)),
    "sipi": (0.5 - 0.03) / (0.5 - 0.06),
    "psri": (0.055 - 0.045) / 0.4,
    "cri1": 1 / 0.048 - 1 / 0.1,
    "ari1": 1 / 0.1 - 1 / 0.12,
    "ndwi": -0.4 / 0.6,
    "ndwi-gao": (0.52 - 0.44) / (0.52 + 0.44),
    "nbr": (0.51 - 0.15) / (0.51 + 0.15),
    "redness": (0.051 - 0.11) / (0.051 + 0.11),
    "iron-oxide": 0.051 / 0.042,
}
"""By hand, from the spectrum of `leaf`."""


def leaf():
    """A made-up leaf at just the wavelengths of the published definitions."""
    blue = {445: 0.03, 470: 0.04, 485: 0.042, 500: 0.045, 510: 0.048}
    green = {531: 0.07, 550: 0.1, 560: 0.11, 570: 0.09}
    red = {660: 0.051, 670: 0.05, 678: 0.055, 680: 0.06, 700: 0.12, 720: 0.2, 750: 0.4}
    infrared = {790: 0.49, 800: 0.5, 830: 0.51, 860: 0.52, 1240: 0.44, 2215: 0.15}
    spectrum = blue | green | red | infrared
    return Bands.of(list(spectrum)), torch.tensor(list(spectrum.values()), dtype=torch.float64)


@pytest.mark.parametrize("name", NAMED_INDICES)
def test_a_named_index_has_the_value_computed_by_hand_also_when_its_formula_is_typed(name):
    """Those without unit are blind to brightness, and the others need reflectance."""
    bands, spectrum = leaf()
    index, typed = parse_index(name, bands), parse_index(NAMED_INDICES[name].formula, bands)
    assert float(index(spectrum)) == pytest.approx(LEAF[name], rel=1e-12)
    assert float(typed(spectrum)) == float(index(spectrum))
    assert typed.usual_range is None
    change = abs(float(index(0.5 * spectrum) - index(spectrum)))
    assert change < 1e-12 if name in RATIOS else change > 0.01


def test_between_centres_reflectance_is_exact_for_a_linear_spectrum():
    bands = Bands.of([400, 430, 500, 650])
    wavelengths = torch.tensor(bands.centers_nm)
    for nm in (400, 401, 415, 430, 477.25, 500, 649.5, 650):
        assert float(parse_index(f"r{nm}", bands)(2e-3 * wavelengths - 0.5)) == pytest.approx(2e-3 * nm - 0.5)
    on_a_centre = parse_index("r400", bands)(torch.tensor([0.2, torch.nan, torch.nan, 0.1]))
    assert float(on_a_centre) == pytest.approx(0.2)


def test_half_a_spacing_beyond_the_outermost_centres_is_the_outermost_band():
    spectrum = torch.arange(31.0)
    assert parse_index("r395", VISIBLE)(spectrum) == 0
    assert parse_index("r705", VISIBLE)(spectrum) == 30
    with pytest.raises(SpectrumError, match=r"needs 705\.1 nm"):
        parse_index("r705.1", VISIBLE)
    assert parse_index("r552-r547", Bands.of([550]))(torch.tensor([[0.25]])).tolist() == [0]


def test_a_wavelength_that_the_bands_do_not_reach_and_spectra_of_another_sampling_are_refused():
    message = "index ndvi needs 800 nm but the bands cover 395-705 nm; nothing is extrapolated; named ones .*: pri, "
    with pytest.raises(SpectrumError, match=message):
        parse_index(" NDVI ", VISIBLE)
    with pytest.raises(SpectrumError, match=r"index r300/r900 needs 300, 900 nm but .* reach: none"):
        parse_index("r300/r900", Bands.of([600, 610]))
    with pytest.raises(SpectrumError, match=r"is made for 31 bands, 400-700 nm; found spectra of 61"):
        parse_index("pri", VISIBLE)(torch.zeros(2, 61))


def test_indices_of_a_sensor_are_those_whose_wavelengths_it_sees():
    assert available_indices(FULL) == list(NAMED_INDICES)
    assert [name for name in NAMED_INDICES if name not in available_indices(VNIR)] == ["ndwi-gao", "nbr"]
    assert available_indices(VISIBLE) == ["pri", "mcari", "cri1", "ari1", "redness", "iron-oxide"]


@pytest.mark.parametrize("centers", [(492, 560, 665, 833), (450, 560, 650, 730, 840), (660, 850)])
def test_multispectral_cameras_give_the_index_of_their_red_and_infrared(centers):
    """Interpolated between red or red edge and infrared, the ndvi of this leaf was as low as 0.55."""
    reflectance = torch.tensor([0.5 if nm > 740 else 0.25 if nm > 700 else 0.05 for nm in centers])
    index = parse_index("ndvi", Bands.of(centers))
    assert float(index(reflectance)) == pytest.approx(0.45 / 0.55)
    near = [min(centers, key=lambda nm: abs(nm - asked)) for asked in (800, 670)]
    assert f"(r{near[0]}-r{near[1]})/(r{near[0]}+r{near[1]})" in index.what
    with pytest.raises(SpectrumError, match="index pri needs 531"):  # of one band, or of none
        parse_index("pri", Bands.of(centers))


def test_a_band_alone_far_away_gives_no_index():
    """Both wavelengths of the ndvi lie nearest to the first band: it was 0 everywhere."""
    with pytest.raises(
        SpectrumError, match=r"within 50 nm, but the bands lie at 842, 1610 nm; .* reach: none"
    ):
        parse_index("ndvi", Bands.of([842, 1610]))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("rays", [(), (0,), (2, 3)])
def test_the_result_has_the_rays_and_the_type_of_the_input(rays, dtype):
    reflectance = torch.rand(*rays, len(FULL), dtype=dtype, generator=torch.Generator().manual_seed(1))
    for name in ("evi", "max(0.3, r800**2) / 2"):
        result = parse_index(name, FULL)(reflectance)
        assert (result.shape, result.dtype) == (rays, dtype)
        assert result.isfinite().all()


def test_where_nothing_is_seen_a_normalised_difference_is_nan_and_its_neighbours_are_not():
    index = parse_index("ndvi", Bands.of([670, 800]))
    result = index(torch.tensor([[0.0, 0.0], [0.1, 0.3], [torch.inf, 0.1]]))
    assert result.isnan().tolist() == [True, False, True]
    assert float(result[1]) == pytest.approx(0.5)


def test_what_names_the_formula_its_source_and_the_bands_used():
    said = "normalised difference vegetation index, (r800-r670)/(r800+r670) (Rouse et al. 1974); from the bands at "
    named, typed = parse_index("NDVI", VNIR), parse_index(" R800 /\n r670", Bands.of([670, 800]))
    assert (named.name, named.what) == ("ndvi", f"{said}670, 800 nm")
    assert (typed.name, typed.what) == ("R800 /\n r670", "formula r800 / r670; from the bands at 670, 800 nm")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("ndiv", "there is no index 'ndiv'; nearest: .*ndvi"),
        ("iron_oxide", "nearest: iron-oxide"),
        ("zzzz", "there is no index 'zzzz'; known: ndvi, gndvi"),
        ("__import__", "there is no index '__import__'"),
        ("  ", r"index: is followed by nothing; give a name \(ndvi, gndvi"),
        ("r800-ndvi", "column 6: "),
    ],
)
def test_a_text_that_is_no_index_is_refused(text, message):
    with pytest.raises(ConfigError, match=message):
        parse_index(text, VNIR)


def test_the_page_of_docs_lists_every_named_index_as_it_is_computed():
    page = (Path(__file__).parents[3] / "docs" / "guides" / "indices.md").read_text(encoding="utf-8")
    for name, named in NAMED_INDICES.items():
        low, high = named.usual_range
        assert f"| {named.title} | `{named.formula}` | {named.source} | {low:g} to {high:g} |" in page
        assert f"| `{name}` " in page


def test_formulas_are_parsed_one_at_a_time_and_once(monkeypatch):
    """`ast.parse` in two threads at once fails now and then: CPython issue 106905."""
    parse, running, most = ast.parse, [], []

    def slow_parse(*words, **options):
        running.append(1)
        most.append(len(running))
        time.sleep(0.02)
        running.pop()
        return parse(*words, **options)

    monkeypatch.setattr(ast, "parse", slow_parse)
    formulas = [f"(r800-r67{number})/(r800+r67{number})" for number in range(4)]
    with ThreadPoolExecutor(4) as threads:
        read = list(threads.map(parse_formula, 2 * formulas))
    assert [one.text for one in read] == 2 * formulas
    assert max(most) == 1
    count = len(most)
    assert parse_formula(formulas[0]).wavelengths_nm == (670.0, 800.0)
    assert len(most) == count
