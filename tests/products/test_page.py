"""The page of a ball that is known exactly: regions, known spectra, lights, large surfaces."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.factories.ball_model import RADIUS
from tests.factories.ball_page import REGIONS, SCENE, export
from tests.factories.files import present
from unmix_plugin.editing import Light, Recipe, edit_scene
from unmix_plugin.editing.apply import with_sensor
from unmix_plugin.errors import ConfigError, SpectrumError
from unmix_plugin.products.page import page
from unmix_plugin.spectral.library.spectra_csv import SpectraTable, write_spectra_csv
from unmix_plugin.spectral.sensor import SpectralResponses
from unmix_plugin.trained.place_errors import ComparedPixels, PlaceErrors


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    return export(tmp_path_factory.mktemp("page"))


def test_regions_that_can_not_be_shown_are_said(exported):
    facts, said, _ = exported
    assert facts["regions"] == ["cap <b>", "below"]
    for text in (
        "Not shown: the region nowhere has nothing of the surface in it",
        "Not shown: the region of no material can't be found: the scene has no material 7; it has 3.",
    ):
        assert any(one.startswith(text) for one in said)


def test_values_stand_with_their_intervals_or_the_reason_why_there_are_none(exported, tmp_path):
    assert exported[0]["interval"]["not_determined"] == SCENE.errors
    assert "half_widths" not in exported[0]["arrays"]
    generator, count = torch.Generator().manual_seed(0), 4000
    places = RADIUS * torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    views, endmembers = torch.randint(0, 5, (count,), generator=generator), SCENE.materials.endmembers
    abundances, spectra = torch.full((count, 3), 1 / 3), torch.ones(count, len(SCENE.bands))
    possible = abundances + 0.05 * torch.randn(1, count, 3, generator=generator)
    pixels = ComparedPixels(places, views, spectra, 0.9 * spectra, abundances, possible)
    deviations = torch.tensor([[0.1], [0.1], [0.9]]) * endmembers
    errors = PlaceErrors.fit(pixels, endmembers, deviations, torch.full((3,), -1.0), SCENE.pixel_size)
    assert errors is not None
    facts, _, _ = export(tmp_path, replace(SCENE, measured_errors=errors), {"below": REGIONS["below"]})
    [region] = facts["interval"]["regions"]
    first, second, third = region["abundances"]
    assert 0 <= first[0] < first[1] < second[0] < second[1] <= 1
    assert third is None
    assert region["area"][0] < region["area"][1]
    assert facts["arrays"]["half_widths"]["width"] == 3


def test_a_page_of_an_edited_run_says_so_and_one_that_can_not_be_small_that(exported, tmp_path, monkeypatch):
    monkeypatch.setattr(page, "MOST_BYTES", 1000)
    facts, said, path = export(tmp_path, regions={}, edits=Path("aged.yml"))
    note = "Edited: shown with the edits of aged.yml, not as found."
    assert note in facts["notes"]
    assert note in said
    assert not any("Edited" in text for text in exported[0]["notes"])
    assert f"the page has {path.stat().st_size / 1e6:.1f} MB, more than a mail takes" in said


def test_a_library_is_given_in_full_and_too_large_or_strange_ones_are_refused(tmp_path):
    bands = SCENE.bands
    own = tmp_path / "own.csv"
    spectra = np.random.default_rng(0).random((3, len(bands)))
    write_spectra_csv(own, SpectraTable(bands, ("a", "b<script>", "c"), spectra))
    facts, _, _ = export(tmp_path, library=(own,))
    assert facts["known"] == [{"name": name, "source": "own.csv"} for name in ("a", "b<script>", "c")]
    with pytest.raises(SpectrumError, match="can't read"):
        export(tmp_path, library=(tmp_path / "none.csv",))
    names = tuple(f"sample {number}" for number in range(4001))
    write_spectra_csv(own, SpectraTable(bands, names, np.full((4001, len(bands)), 0.5)))
    with pytest.raises(ConfigError, match="the library has 4001 spectra; a page has room for 4000"):
        export(tmp_path, library=(own,))


def test_a_surface_of_too_many_triangles_is_made_coarser_and_that_is_said(exported, tmp_path, monkeypatch):
    most = round(1.15 * exported[0]["arrays"]["faces"]["count"] / 3)
    monkeypatch.setattr(page, "MOST_TRIANGLES", most)
    facts, said, _ = export(tmp_path, regions={}, resolution=64)
    assert 0.6 * most < facts["arrays"]["faces"]["count"] / 3 <= most
    assert any("triangles is made again with" in text for text in said)


def test_a_page_keeps_both_limits_and_each_surface_is_made_once(exported, tmp_path, monkeypatch):
    tried: list[int] = []
    found = page.surface_of
    monkeypatch.setattr(
        page, "surface_of", lambda scene, cells, **shown: tried.append(cells) or found(scene, cells, **shown)
    )
    most = round(1.15 * exported[0]["arrays"]["faces"]["count"] / 3)
    arrays = exported[2].read_text().split('id="data-arrays">')[1].split("<")[0]
    monkeypatch.setattr(page, "MOST_TRIANGLES", most)
    monkeypatch.setattr(page, "MOST_BYTES", exported[2].stat().st_size - len(arrays) // 8)
    facts, said, path = export(tmp_path, resolution=64)
    assert facts["arrays"]["faces"]["count"] / 3 <= most
    assert path.stat().st_size <= page.MOST_BYTES
    assert len(tried) == 3  # as asked, for the triangles, for the bytes
    assert sorted(set(tried), reverse=True) == tried
    again = [text for text in said if "made again with" in text]
    assert [f"{cells} cells" in text for cells, text in zip(tried[1:], again, strict=True)] == [True, True]
    (note,) = [note for note in facts["notes"] if "cells" in note]
    assert f"as fine as {tried[-1]} cells along the longest edge, not 64: browsers turn {most:,}" in note


def facts_of(folder, materials, illuminant=None):
    """Of the ball with other materials, hardly resolved."""
    scene = replace(SCENE, materials=materials)
    return export(folder, scene, regions={}, resolution=12, illuminant=illuminant)[0]


def test_a_relit_page_names_the_light_that_it_shows_and_offers_the_recorded_one(tmp_path):
    count = len(SCENE.bands)
    recorded = np.linspace(0.5, 1.0, count)
    light = torch.from_numpy(recorded).float()
    scene = replace(SCENE, materials=replace(SCENE.materials, light=light))
    relit = edit_scene(scene, Recipe(illuminant=Light("A"))).materials
    shown, own, *others = facts_of(tmp_path, relit, recorded.tolist())["lights"]
    assert (shown["name"], shown["factors"]) == ("A", [1.0] * count)
    assert own["name"] == "the scene's own"
    spectra = relit.endmembers.numpy() * np.array(own["factors"])
    np.testing.assert_allclose(spectra, scene.materials.endmembers.numpy(), rtol=1e-4)
    assert "A" not in [one["name"] for one in others]
    light = present(relit.light).clone()
    light[-1] = 0.0
    ends = replace(relit, light=light)
    for one in facts_of(tmp_path, ends, recorded.tolist())["lights"][1:]:
        assert one["notes"][0] == "black where A does not reach"
        assert not any("own light" in note for note in one["notes"])
    before = facts_of(tmp_path, scene.materials, recorded.tolist())["lights"]
    assert [one["name"] for one in before[:2]] == ["the scene's own", "D65"]


@pytest.mark.parametrize(("light", "is_assumed"), [(None, False), (torch.ones(len(SCENE.bands)), True)])
def test_a_page_says_that_the_light_is_unknown_though_another_was_lit(light, is_assumed, tmp_path):
    assert facts_of(tmp_path, SCENE.materials)["is_light_known"]
    unknown = replace(SCENE.materials, light=light, is_light_assumed=is_assumed)
    assert not facts_of(tmp_path, unknown)["is_light_known"]


def test_bands_that_the_light_leaves_dark_are_those_of_the_package(tmp_path):
    light = torch.ones(len(SCENE.bands))
    light[2] = 1e-4
    lit = replace(SCENE.materials, light=light)
    found = facts_of(tmp_path, lit)["is_lit"]
    assert found == lit.is_lit.tolist() == [band != 2 for band in range(len(light))]


def test_through_a_sensor_no_known_spectra_and_no_other_lights_are_offered(tmp_path):
    """They would be taken at the centres of its channels, which see the mean of what is around."""
    responses = np.array([[1.0, 1.0, 0.5, 0.0, 0.0], [0.0, 0.0, 0.5, 1.0, 1.0]])
    sensor = SpectralResponses("camera", SpectraTable(SCENE.bands, ("short", "long"), responses))
    seen = with_sensor(SCENE, sensor)
    facts, _, _ = export(tmp_path, seen, regions={}, resolution=12)
    assert facts["known"] == []
    assert [one["name"] for one in facts["lights"]] == ["the scene's own"]
    with pytest.raises(ConfigError, match=r"known in channels of --sensor, .*: leave out --library"):
        export(tmp_path, seen, library=(tmp_path,))
