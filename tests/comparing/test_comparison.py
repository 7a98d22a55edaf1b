"""What was planted between two captures is found, and nothing else; what can't be compared is refused."""

from dataclasses import replace

import numpy as np
import pytest

from tests.factories.changed_objects import (
    BANDS,
    CHALK,
    CLAY,
    LEAF,
    MOVED,
    PIXEL,
    capture,
    in_world,
    later,
    surface_of_shape,
)
from unmix_plugin.comparing.comparison import compare
from unmix_plugin.comparing.files import place_rows, summary, summary_lines
from unmix_plugin.comparing.materials import join_materials
from unmix_plugin.comparing.series import series_rows
from unmix_plugin.errors import ConfigError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.trained.measures import Scale
from unmix_plugin.trained.regions import Box

CENTER = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def surface():
    return surface_of_shape(subdivisions=4)


@pytest.fixture(scope="module")
def cosines(surface):
    return surface.positions @ CENTER / np.linalg.norm(surface.positions, axis=1)


@pytest.fixture(scope="module")
def spot(cosines):
    return cosines > 0.88


@pytest.fixture(scope="module")
def elsewhere(cosines):
    """Where no vertex has a neighbour in the spot."""
    return cosines < 0.83


@pytest.fixture(scope="module")
def stained(surface, spot):
    spectra = surface.spectra.copy()
    spectra[spot] += 0.3 * (np.array(CHALK) - spectra[spot])
    return compare(capture(surface), later(replace(surface, spectra=spectra)))


def test_an_unchanged_object_has_no_places(surface):
    found = compare(capture(surface), later(surface))
    assert found.places == ()
    np.testing.assert_allclose(found.registration.light, 1.2, rtol=0.01)
    for name in ("spectrum", "brightness", "distance"):
        assert abs(np.nanmean(found.differences[name].p <= 0.05) - 0.05) <= 0.03
    assert "nothing has changed" in summary_lines(found)[-1]


def test_more_of_a_material_is_found_where_it_is_and_by_how_much(stained, surface, spot, elsewhere):
    areas = surface.areas
    assert areas[stained.changed & spot].sum() > 0.95 * areas[spot].sum()
    assert areas[stained.changed & elsewhere].sum() < 0.01 * areas[elsewhere].sum()
    [place] = stained.places
    assert place.what in ("spectrum", "brightness")
    assert place.center == pytest.approx(tuple(surface.positions[spot].mean(axis=0)), abs=2 * PIXEL)
    assert place.p < 0.01
    amount = place.amounts["abundance chalk"]
    assert amount.low < amount.mean < amount.high
    assert 0.1 < amount.mean < 0.3


def test_a_stain_with_a_blurred_edge_ends_where_half_of_it_is_there(surface, cosines):
    part = np.clip((cosines - 0.83) / 0.1, 0.0, 1.0)[:, None]
    found = compare(
        capture(surface),
        later(replace(surface, spectra=surface.spectra + 0.4 * part * (CHALK - surface.spectra))),
    )
    areas, part = surface.areas, part[:, 0]
    assert areas[found.changed & (part > 0.75)].sum() > 0.95 * areas[part > 0.75].sum()
    beside = (part > 0.0) & (part < 0.25)
    assert areas[found.changed & beside].sum() < 0.25 * areas[beside].sum()


def test_a_dent_is_found_along_the_normal(surface, spot):
    dented = replace(surface, positions=surface.positions - 2.0 * PIXEL * surface.normals * spot[:, None])
    found = compare(capture(surface), later(dented))
    assert found.places[0].what == "distance"
    # Averaged with the border over four rings of a mesh of 1.6 pixels.
    assert found.places[0].amounts["distance"].mean == pytest.approx(-2.0 * PIXEL, rel=0.35)
    assert surface.areas[found.changed & spot].sum() > 0.35 * surface.areas[spot].sum()


def test_tables_say_where_what_and_how_sure(stained):
    head, row = place_rows(stained)
    values = dict(zip(head, row, strict=True))
    assert float(str(values["area"])) == pytest.approx(stained.places[0].area, rel=1e-4)
    assert float(str(values["abundance_chalk_low"])) < float(str(values["abundance_chalk_high"]))
    found = summary(stained)
    assert found["registration"]["scale"] == pytest.approx(1 / MOVED.scale, rel=0.01)
    assert len(found["materials"]["same"]) == 3
    assert found["materials"]["new"] == []


def test_a_series_has_a_row_for_each_region_and_later_capture(surface, stained):
    before = replace(capture(surface), regions={"top": Box((-0.5, -0.5, 0.5), (0.5, 0.5, 3.0))})
    again = replace(stained, before=before)
    head, *rows = series_rows([again, again], ["june", "july"])
    assert [row[:2] for row in rows[:4]] == [
        ["everything", "june"], ["everything", "july"], ["top", "june"], ["top", "july"],
    ]  # fmt: skip
    changed = [float(str(row[head.index("changed_part")])) for row in rows[:4]]
    assert changed[2] > 3 * changed[0] > 0


def test_other_bands_are_compared_in_the_common_ones_and_said(surface):
    nm = np.array([480.0, 520.0, 560.0, 600.0, 680.0, 750.0])
    wider = Bands.of(nm)

    def resampled(rows: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(nm, BANDS.centers_nm, row) for row in rows])

    moved = in_world(replace(surface, spectra=resampled(surface.spectra)), MOVED)
    endmembers = resampled(np.array([LEAF, CLAY, CHALK])).tolist()
    after = capture(moved, "later", endmembers, wider, own_pixel=PIXEL * MOVED.scale, seed=1)
    found = compare(capture(surface), after)
    assert found.bands == Bands.of([520.0, 600.0, 680.0])
    assert found.places == ()
    assert "other bands" in found.notes[0]
    infrared = Bands.of([900.0, 1000.0, 1100.0, 1200.0])
    with pytest.raises(ConfigError, match="common bands"):
        compare(capture(surface), replace(later(surface), own_bands=infrared))


def test_scales_of_both_fix_the_ratio_and_one_alone_is_said(surface):
    known = replace(capture(surface), scale=Scale(0.1, "ruler"))
    other = replace(later(surface), scale=Scale(0.1 / MOVED.scale, "ruler"))
    assert compare(known, other).registration.to_before.scale == pytest.approx(1 / MOVED.scale, rel=1e-9)
    with pytest.raises(ConfigError, match="level"):
        compare(known, other, level=5.0)


def test_materials_are_joined_by_angle_and_new_and_vanished_ones_named():
    soot = [0.05, 0.04, 0.06, 0.05]
    before = (("leaf", "clay", "chalk"), np.array([LEAF, CLAY, CHALK]), np.array([0.4, 0.3, 0.3]))
    after = (("clay", "x", "leaf"), np.array([CLAY, soot, LEAF]) * 1.01, np.array([0.3, 0.2, 0.5]))
    found = join_materials(before, after)
    assert {pair[:2] for pair in found.pairs} == {("leaf", "leaf"), ("clay", "clay")}
    assert (found.new, found.vanished) == (("x",), ("chalk",))
    assert found.names == ("leaf", "clay", "chalk", "x")
    mixed = np.array([[0.25 * np.array(LEAF) + 0.75 * np.array(soot)]], dtype=np.float32)
    np.testing.assert_allclose(found.abundances(mixed)[0, 0], [0.25, 0, 0, 0.75], atol=0.02)
