import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from spectral import GaussianStats, ace
from spectral import matched_filter as spy_matched_filter
from torch.testing import assert_close

from unmix_plugin.errors import ConfigError, SpectrumError
from unmix_plugin.formats.libraries import read_library
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.library.spectra_csv import SpectraTable, write_spectra_csv
from unmix_plugin.spectral.maps.targets import LOADING, Background, adaptive_coherence, matched_filter
from unmix_plugin.spectral.maps.targets import parse_target as _parse_target


def parse_target(text, bands):
    return _parse_target(text, bands, read_library)


# Mean (0.4, 0.3), sample covariance diag(0.02, 0.08) / 3.
FOUR = torch.tensor([[0.5, 0.3], [0.3, 0.3], [0.4, 0.5], [0.4, 0.1]], dtype=torch.float64)


def pixels(count=300, bands=5, seed=0):
    g = np.random.default_rng(seed)
    clean = g.uniform(0, 1, (count, 3)) @ g.uniform(0, 0.3, (3, bands))
    return torch.tensor(clean + g.normal(0, 0.02, (count, bands)))


SAMPLE = Background.fit(pixels())


TARGET = torch.linspace(0.2, 0.9, 5).double()


def test_the_matched_filter_is_one_at_the_target_zero_at_the_mean_and_linear_between():
    shares = torch.tensor([0.0, 0.25, 1.0, 2.0]).double()
    mixed = SAMPLE.mean + shares[:, None] * (TARGET - SAMPLE.mean)
    assert_close(matched_filter(mixed, TARGET, SAMPLE), shares)


@given(st.floats(0.01, 100.0))
def test_adaptive_coherence_tells_directions_from_the_mean_one_towards_the_target_and_zero_away(gain):
    offsets = pixels(seed=1) - SAMPLE.mean
    near, far = (adaptive_coherence(SAMPLE.mean + k * offsets, TARGET, SAMPLE) for k in (1.0, gain))
    assert_close(near, far, atol=1e-9, rtol=0)
    seen = torch.stack([SAMPLE.mean + share * (TARGET - SAMPLE.mean) for share in (0.1, -0.1, 0.0)])
    expected = torch.tensor([1.0, 0.0, torch.nan]).double()
    assert_close(adaptive_coherence(seen, TARGET, SAMPLE), expected, equal_nan=True)


def test_both_detectors_agree_with_spy():
    (background, seen), target = pixels(600).split(300), TARGET
    covariance = np.cov(background.numpy().T)
    loaded = covariance + LOADING * np.trace(covariance) / 5 * np.eye(5)
    stats = GaussianStats(background.mean(dim=0).numpy(), loaded)
    found = Background.fit(background)
    image = seen.reshape(20, 15, 5)
    expected = spy_matched_filter(image.numpy(), target.numpy(), background=stats)
    assert_close(matched_filter(image, target, found), torch.tensor(expected))
    unsigned = torch.tensor(ace(image.numpy(), target.numpy(), background=stats))
    is_alike = torch.tensor(expected) > 0
    assert 30 < is_alike.sum() < 270
    assert_close(adaptive_coherence(image, target, found), torch.where(is_alike, unsigned, 0.0))


def test_a_background_of_fewer_pixels_than_bands_still_gives_one_and_zero():
    target = torch.linspace(0.2, 0.9, 40).double()
    background = Background.fit(pixels(count=5, bands=40))
    scores = matched_filter(torch.stack([target, background.mean]), target, background)
    assert_close(scores, torch.tensor([1.0, 0.0]).double())


def test_empty_and_unknown_pixels_do_not_count_as_background():
    holes = torch.tensor([[0.0, 0.0], [torch.nan, 0.5], [0.2, torch.inf]]).double()
    found = Background.fit(torch.cat([holes, FOUR]))
    assert_close(found.mean, Background.fit(FOUR).mean)
    assert_close(found.whitening, Background.fit(FOUR).whitening)


def test_a_background_that_tells_nothing_is_refused():
    one = torch.tensor([[0.1, 0.2, 0.3]])
    for background, message in (
        (one[:0], "background has 0 pixels .*2 or more needed"),
        (torch.cat([one, 0 * one]), "background has 1 pixels"),
        (one.expand(7, 3), "all 7 pixels of the background are equal"),
    ):
        with pytest.raises(SpectrumError, match=message):
            Background.fit(background)


BANDS = Bands.of([450, 500, 550, 600, 650])
GOLD = [0.1, 0.2, 0.5, 0.7, 0.8]
PAINTS = SpectraTable(
    Bands.of([400, *BANDS.centers_nm, 700]),
    ("gold", "cobalt <45um", "black"),
    np.array([[0.1, *GOLD, 0.8], [0.3, 0.4, 0.3, 0.1, 0.1, 0.2, 0.3], [0.0] * 7]),
)


@pytest.fixture
def gold(tmp_path):
    """A file of gold alone, beside others: of all paints, of gold and of dark coal in percent, and one that is none."""
    write_spectra_csv(tmp_path / "paints.csv", PAINTS)
    for name, unit in (("gold", 1), ("percent", 100)):
        table = SpectraTable(PAINTS.bands, ("gold",), unit * PAINTS.spectra[:1])
        write_spectra_csv(tmp_path / f"{name}.csv", table)
    table = SpectraTable(PAINTS.bands, ("gold", "coal"), PAINTS.spectra[[0, 0]] * [[100], [2]])
    write_spectra_csv(tmp_path / "dark.csv", table)
    (tmp_path / "bad.csv").write_text("furlong,gold\n400,1\n")
    return tmp_path / "gold.csv"


def image():
    """20 x 30 pixels of two materials in all mixtures and shading, with a planted patch of gold; and where it is."""
    g = np.random.default_rng(0)
    shares, shade = g.uniform(size=(20, 30, 1)), g.uniform(0.7, 1, (20, 30, 1))
    planted = np.zeros((20, 30), dtype=bool)
    planted[5:9, 10:16] = True
    leaf, stone = np.array([0.05, 0.1, 0.4, 0.2, 0.1]), np.array([0.5, 0.5, 0.55, 0.6, 0.6])
    spectra = np.where(planted[..., None], GOLD, shares * leaf + (1 - shares) * stone) * shade
    return torch.tensor(spectra + g.normal(0, 0.005, spectra.shape)).float(), torch.tensor(planted)


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("gold.csv", ("angle", "gold", None)),  # no name is needed where there is one spectrum
        ("ace:paints.csv#gold>0.5", ("ace", "gold", 0.5)),
        ("mf:paints.csv#gold > -1e-1", ("mf", "gold", -0.1)),
        ("paints.csv#cobalt <45um", ("angle", "cobalt <45um", None)),  # names may hold signs of comparison
        ("paints.csv#cobalt <45um<.1", ("angle", "cobalt <45um", 0.1)),
        ("C:gold.csv", ("angle", "gold", None)),  # as may paths
        ("mf:a#b <1.csv#gold>1", ("mf", "gold", 1.0)),
        ("MF:gold.csv", ("angle", "gold", None)),
    ],
)
def test_each_part_of_the_text_is_read(gold, monkeypatch, text, parts):
    monkeypatch.chdir(gold.parent)
    for path in ("C:gold.csv", "a#b <1.csv", "MF:gold.csv"):
        (gold.parent / path).write_bytes(gold.read_bytes())
    target = parse_target(text, Bands.of([475, 525]))
    assert (target.method, target.name, target.threshold) == parts
    assert target.file in text
    if target.name == "gold":
        assert_close(target.reflectance, torch.tensor([0.15, 0.35]).double())


def test_the_angle_is_zero_at_the_target_and_ignores_brightness_and_background(gold):
    score = parse_target(str(gold), BANDS).fit(torch.zeros(0, 5))
    spectra, _ = image()
    assert_close(score(torch.tensor([GOLD]) * 0.3), torch.zeros(1), atol=1e-6, rtol=0)
    assert_close(score(spectra), score(0.2 * spectra), atol=1e-6, rtol=1e-5)
    [angle] = score(torch.tensor([[0.0, 1, 0, 0, 0]]).double()).tolist()
    assert math.cos(angle) == pytest.approx(0.2 / math.sqrt(1.43))


@pytest.mark.parametrize("method", ["angle", "mf", "ace"])
def test_a_planted_target_is_found_and_nothing_said_of_pixels_in_which_nothing_is_known(gold, method):
    spectra, planted = image()
    score = parse_target(f"{method}:{gold}", BANDS).fit(spectra.reshape(-1, 5))
    scores = score(spectra) * (-1 if method == "angle" else 1)
    assert scores.shape == planted.shape
    assert (scores[planted] > scores[~planted].quantile(0.99)).float().mean() > 0.95
    at_target = 0.0 if method == "angle" else 1.0
    assert float(score(torch.tensor(GOLD))) == pytest.approx(at_target, abs=1e-5)
    unknown = ([0.0] * 5, [torch.nan, 1, 1, 1, 1], [1, 1, torch.inf, 1, 1], [0.3, 0.2, 0.1, 0.3, 0.3])
    assert score(torch.tensor(unknown)).isnan().tolist() == [True, True, True, False]
    for shape in ((), (0,), (3, 2)):
        found = score(torch.full((*shape, 5), 0.4))
        assert (found.shape, found.dtype) == (shape, torch.float32)
    limit = 0.12 if method == "angle" else 0.5  # which gives one where the score passes and zero where not
    text = f"{method}:{gold}{'<' if method == 'angle' else '>'}{limit}"
    spectra[0, 0] = 0
    passes = parse_target(text, BANDS).fit(spectra.reshape(-1, 5))(spectra)
    assert passes.isnan().nonzero().tolist() == [[0, 0]]
    assert (passes == planted).float().mean() > 0.95
    assert set(passes.unique().nan_to_num(2).tolist()) == {0, 1, 2}


def test_a_target_says_what_its_numbers_are(gold):
    said = {text: parse_target(f"{text.format(gold)}", BANDS) for text in ("{}", "mf:{}", "ace:{}", "{}<0.1")}
    assert said["mf:{}"].what.startswith("matched filter score of 'gold' (gold.csv): 1 = like the target")
    assert said["{}<0.1"].what.endswith("in radians to 'gold' (gold.csv) below 0.1: 1 = yes, 0 = no")
    assert [one.usual_range for one in said.values()] == [(0, 0.5), (0, 1), None, (0, 1)]


@pytest.mark.parametrize(
    ("text", "error", "message"),
    [
        ("", ConfigError, r"target: must be target:\[METHOD:\]FILE\[#NAME\]"),
        ("{0}/gold.pdf", ConfigError, "must be .* as in paint.csv, ace:paint.csv"),
        ("{0}/gold.csv<nan", ConfigError, "must be .*<VALUE"),
        ("{0}/gold.csv>0.1", ConfigError, "small scores of angle are alike, .* is <0.1; found >0.1"),
        ("mf:{0}/gold.csv<0.1", ConfigError, "large scores of mf are alike, .* is >0.1; found <0.1"),
        ("ace:{0}/gold.csv>1", ConfigError, "of ace lie between 0 and 1, so >1 says the same of every pixel"),
        ("{0}/gold.csv<0", ConfigError, "scores of angle lie between 0 and 3.142, so <0 says the same"),
        ("{0}/none.csv", ConfigError, "there is no file .*none.csv with the spectrum of a target$"),
        ("ACE:{0}/gold.csv", ConfigError, "no file ACE:.*did you mean the method ace: .they are angle, mf"),
        ("{0}/paints.csv", ConfigError, "has 3 spectra; .* as in .*paints.csv#NAME: gold, cobalt <45um, bl"),
        ("{0}/paints.csv#golt", ConfigError, "no spectrum 'golt'; did you mean gold. it has gold, cobalt"),
        ("{0}/paints.csv#", ConfigError, "no spectrum ''; it has gold"),
        (
            "mf:{0}/percent.csv",
            SpectrumError,
            "'gold' .* reflectances, 1 for white; found 80. If .* divide perc",
        ),
        ("ace:{0}/dark.csv#coal", SpectrumError, "'coal' .* found 50 in its file. If .* divide percent"),
        ("{0}/paints.csv#black", SpectrumError, "'black' .* is zero in all bands: no angle to it is defined"),
        ("{0}/bad.csv", SpectrumError, r"bad\.csv: the first column must be headed 'wavelength'"),
    ],
)
def test_text_that_names_no_target_is_refused(gold, text, error, message):
    with pytest.raises(error, match=message):
        parse_target(text.format(gold.parent), BANDS)


def test_the_angle_takes_percent_and_the_matched_filter_black(gold):
    score = parse_target(f"{gold.parent}/percent.csv", BANDS).fit(torch.zeros(0, 5))
    assert_close(score(torch.tensor(GOLD).double()), torch.tensor(0.0).double(), atol=1e-7, rtol=0)
    spectra, _ = image()
    score = parse_target(f"mf:{gold.parent}/paints.csv#black", BANDS).fit(spectra.reshape(-1, 5))
    assert score(spectra).isfinite().all()


def test_what_a_target_can_not_be_compared_with_is_refused(gold):
    around = torch.tensor(GOLD).double() + torch.tensor([[0.1], [-0.1]]).double()
    with pytest.raises(SpectrumError, match=r"'gold' \(gold.csv\) is the mean of the background"):
        parse_target(f"mf:{gold}", BANDS).fit(around)
    with pytest.raises(SpectrumError, match="target 'gold' has 5 bands, the background 4"):
        parse_target(f"ace:{gold}", BANDS).fit(torch.rand(10, 4))
    for centers, said in (
        ([550], "angle compares spectra of two bands or more; found 1 band"),
        ([450, 750], r"gold\.csv: gold: spectra at .* 50 nm above their range; .*nothing is"),
    ):
        with pytest.raises(SpectrumError, match=said):
            parse_target(str(gold), Bands.of(centers))
