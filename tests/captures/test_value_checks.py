"""What contradicts itself in values, masks and files."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.factories.files import file_of
from unmix_plugin.captures.checks import ViewSample, check_files, check_values
from unmix_plugin.captures.cube import BandTable, CaptureView
from unmix_plugin.captures.decide import is_below_black
from unmix_plugin.captures.options import ProcessOptions
from unmix_plugin.captures.report import Kind, sentences
from unmix_plugin.captures.writing.view_files import ViewRecord

BAND = np.arange(12)
WAVELENGTHS_NM = np.linspace(450.0, 850.0, 12)
RECORD = ViewRecord("view", "", {}, 1000, 0, 0, 0, 0, 0.5, 0, 0, 0.3, 1.0, [])
OPTIONS = ProcessOptions("cubes", Path("capture"), Path("scene"))


def scene() -> list[ViewSample]:
    """Shaded mixtures of three materials; ten views from around see other parts of it."""
    red_edge = 0.1 + 0.6 / (1 + np.exp(-(WAVELENGTHS_NM - 700) / 15))
    green = 0.3 + 0.2 * np.exp(-(((WAVELENGTHS_NM - 550) / 60) ** 2))
    materials = np.stack([red_edge, 0.5 - 0.3 * np.linspace(0, 1, 12) ** 2, green])
    samples = []
    for index in range(10):
        generator = np.random.default_rng(index)
        shares = generator.dirichlet(1 + np.abs(np.sin(index + np.arange(3))), 400)
        shading = generator.uniform(0.2, 0.9, (400, 1))
        spectra = shading * (shares @ materials) + generator.normal(0, 0.002, (400, 12))
        samples.append(ViewSample(replace(RECORD, name=f"view_{index}"), spectra.astype(np.float32)))
    return samples


def findings(samples: list[ViewSample]) -> list[str]:
    """Of views on a ring."""
    steps = np.abs(np.subtract.outer(np.arange(10), np.arange(10)))
    return sentences(check_values(samples, 12.0 * np.minimum(steps, 10 - steps), WAVELENGTHS_NM), Kind.WRONG)


def test_a_scene_that_is_right_gives_no_finding():
    assert findings(scene()) == []


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda spectra, index: spectra * (1.0, 0.5)[index % 2], "10 views brighter or darker .* 2.0"),
        (lambda spectra, index: spectra * (1.0 if index != 4 else 0.7), "as bright as view_4"),
        (lambda spectra, _: spectra + 0.04 * (1 + np.sin(BAND)), "a level seems to be added to all"),
        (lambda spectra, _: spectra * (1 + 0.3 * (BAND == 5)), r"1 band off .*: 631.818 nm \(1\.[23]"),
    ],
    ids=["two exposures", "one exposure", "a level", "a band's gain"],
)
def test_what_light_does_not_do_is_found_and_named(change, words):
    (finding,) = findings(
        [replace(one, spectra=change(one.spectra, i).astype(np.float32)) for i, one in enumerate(scene())]
    )
    assert re.search(words, finding), finding


def test_a_band_is_not_judged_by_bands_beyond_a_gap():
    kept, lamp = [0, 1, 2, 6, 7, 8, 9, 10, 11], 1 / (1 + ((WAVELENGTHS_NM - 550) / 60) ** 2)
    samples = [replace(one, spectra=(one.spectra * lamp)[:, kept].astype(np.float32)) for one in scene()]
    assert check_values(samples, np.full((10, 10), 30.0), WAVELENGTHS_NM[kept]) == []


@pytest.mark.parametrize(
    ("black", "level", "expected"), [(1.0, 0.0, False), (0.5, 0.1, True), (0.0, 0.3, True)]
)
def test_a_dark_frame_that_is_taken_off_twice_is_told_from_noise_around_black(black, level: float, expected):
    generator = np.random.default_rng(0)
    values = np.where(generator.random((5000, 1)) < black, 0.0, generator.random((5000, 1))) * np.ones(6)
    noisy = values - level + generator.normal(0, 0.02, values.shape)
    assert is_below_black(noisy.astype(np.float32)) == expected


INVERTED = {"brightness": 0.001, "background_brightness": 0.4, "background_spread": 0.9}


@pytest.mark.parametrize(
    ("views", "facts", "is_hollow", "said"),
    [
        (10, INVERTED, False, "the wrong way round"),
        (10, INVERTED | {"background_spread": 0.05}, False, None),  # dark matter before a white backdrop
        (7, {}, True, "7 views whose mask takes the border of the picture for foreground and its middle"),
        (5, {}, True, None),
        (1, {"matter_share": 0.95}, False, "view_0 (95%, near ones 50%)"),
    ],
)
def test_masks_that_are_wrong_in_most_views_or_unlike_their_neighbours_are_named(
    views, facts, is_hollow, said
):
    samples = scene()
    wrong = [
        replace(one, record=replace(one.record, **facts), is_hollow=is_hollow) for one in samples[:views]
    ]
    found = findings([*wrong, *samples[views:]])
    assert len(found) == (said is not None)
    assert said is None or said in found[0]


@pytest.mark.parametrize("inverted", [False, True])
def test_a_mask_is_hollow_where_it_covers_the_border_alone(tmp_path, inverted):
    mask = np.zeros((30, 40), np.uint8)
    mask[5:25, 8:32] = 255
    rgba = np.dstack([np.full((30, 40, 3), 99, np.uint8), 255 - mask if inverted else mask])
    Image.fromarray(rgba).save(tmp_path / "a.png")
    np.save(tmp_path / "a.npy", np.full((30, 40, 12), 9000, np.uint16))
    record = replace(RECORD, paths={"file_path": "a.png", "hyperspectral_file_path": "a.npy"})
    assert ViewSample.of(record, tmp_path).is_hollow == inverted


def test_a_file_of_which_most_was_not_read_is_named(tmp_path: Path):
    path = tmp_path / "view.exr"
    path.write_bytes(bytes(200_000))
    cube = replace(file_of(np.zeros((40, 50, 3), np.float32)), path=path)
    views = [CaptureView("view", cube)]
    assert check_files(views, replace(OPTIONS, dataset="spectral")) == []  # chosen on purpose
    (remark,) = check_files(views, OPTIONS)
    assert "view.exr (3 bands of 0.2 MB)" in remark.sentence
    path.write_bytes(bytes(30_000))
    assert check_files(views, OPTIONS) == []


def test_a_band_too_wide_for_one_wavelength_is_named(tmp_path: Path):
    table = BandTable(np.array([560.0, 634.5]), "tags", fwhm_nm=np.array([27.0, 463.0]))
    cube = replace(file_of(np.zeros((4, 5, 2), np.float32)), path=tmp_path / "none", bands=table)
    (remark,) = check_files([CaptureView("view", cube)], OPTIONS)
    assert "634.5 nm (463 nm wide)" in remark.sentence
