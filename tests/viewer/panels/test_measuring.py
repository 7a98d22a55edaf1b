"""Clicks on a picture: probes, distances that set the scale, regions that are drawn and kept."""

import re

import numpy as np
import pytest

from tests.factories.viewers import opened, serving
from tests.factories.views import make_source
from unmix_plugin.trained.measured_surface import MeasuredSurface
from unmix_plugin.trained.measures import Scale, keep_region, keep_scale, read_measures
from unmix_plugin.trained.regions import Box, InView


def test_a_click_is_a_probe_with_a_chart_and_bars_and_one_on_nothing_says_so(viewer, page):
    page.click(0.5, 0.5)
    page.wait_for_text(page.props("endmember")["options"][0], "position")
    assert any(props.get("type") == "GuiUplotMessage" for props in page.controls.values())
    page.set("save as CSV")
    page.wait_until(lambda: len(page.downloads) == 2)
    saved = sorted(path.name for path in viewer.services.folder.glob("[!.]*"))
    assert saved == ["probe-abundances.csv", "probes.csv"]
    page.look_from(0.0, distance=40.0)
    page.click(0.01, 0.01)
    page.wait_for_notice("nothing is there")
    assert page.props("probe")["options"] == [page.props("probe")["value"]]
    page.set("forget all")
    page.wait_until(lambda: page.props("probe")["options"] == ["none yet"])


@pytest.mark.slow
def test_two_clicks_and_a_distance_set_the_scale_that_commands_read(viewer):
    run = viewer.services.source.run
    with opened(viewer) as page:
        probing = page.props("probe where I click")
        page.set("set scale")
        page.wait_for_notice("click two points of the object first")
        page.set("measure where I click")
        page.wait_until(lambda: probing["value"] is False)
        page.click(0.5, 0.5)
        page.wait_for_text("Click a second point")
        page.click(0.4, 0.5)
        page.wait_for_text(" units</td>")
        assert page.props("probe")["options"] == ["none yet"]
        units = float(re.findall(r"([0-9.]+) units</td>", page.texts)[-1])
        page.set("set scale")
        page.wait_for_notice("the distance is 0 m")
        assert not (run.path / "measures.json").exists()
        page.set("distance (m)", 0.05)
        in_the_way = run.path / "measures.json"
        in_the_way.mkdir()
        page.set("set scale")
        page.wait_for_notice("can't read")
        in_the_way.rmdir()
        page.set("set scale")
        page.wait_for_text("5 cm</td>", "1 unit is")
        scale = read_measures(run).scale
        assert scale is not None
        assert scale.metres_per_unit == pytest.approx(0.05 / units, rel=1e-3)
        page.set("probe where I click")
        page.wait_until(lambda: page.props("measure where I click")["value"] is False)
    (run.path / "measures.json").unlink()


@pytest.mark.slow
def test_a_region_is_drawn_named_kept_as_commands_read_it_and_removed(tmp_path):
    source = make_source(tmp_path, initial_opacity=0.95)

    def kept():
        region = read_measures(source.run).regions["middle part"]
        assert isinstance(region, InView)
        return region

    def area_of(region):
        with source.locked_materials() as scene:
            return MeasuredSurface.of(scene).measure(region, "").area

    with serving(source) as (viewer, _), opened(viewer) as page:
        options = lambda: page.props("region")["options"]  # noqa: E731
        page.set("keep the region")
        page.wait_for_notice("can't be the name of a region")
        page.set("region name", "middle part")
        page.set("keep the region")
        page.wait_for_notice("draw a region first")
        page.set("draw where I click")
        page.wait_until(lambda: page.props("probe where I click")["value"] is False)
        page.click(0.4, 0.4)
        page.wait_for_text("Corners: 1")
        page.click(0.6, 0.6)
        page.wait_for_text("Corners: 2")
        page.set("keep the region")
        page.wait_until(lambda: options() == ["none: choose one", "middle part"])
        page.wait_for_text(" square units</td>")
        mask, area = kept().mask(), area_of(kept())
        rows, columns = np.nonzero(mask)
        assert rows.min() / mask.shape[0] == pytest.approx(0.4, abs=0.01)
        assert columns.max() / mask.shape[1] == pytest.approx(0.6, abs=0.01)
        assert f"{area:.4g} square units" in page.texts
        page.look_from(0.9)
        page.click(0.5, 0.5)
        page.wait_for_text("Corners: 1")
        page.look_from(0.3)
        page.click(0.5, 0.5)
        page.wait_for_text("The view has changed, so the outline begins here")
        page.click(0.75, 0.7)
        page.wait_for_text("Corners: 2")
        page.set("keep the region")  # once more under its name
        page.wait_for_notice("in place of the one before")
        page.wait_until(lambda: not np.array_equal(kept().mask(), mask))
        redrawn = area_of(kept())
        assert redrawn != pytest.approx(area, rel=0.01)
        page.wait_for_text(f"{redrawn:.4g} square units")
        page.set("shape", "polygon")
        page.wait_for_text("Tick the box")
        for count, place in enumerate(((0.5, 0.4), (0.6, 0.6), (0.45, 0.6)), 1):
            page.click(*place)
            page.wait_for_text(f"Corners: {count}.")
        page.set("region name", "wedge")
        page.set("keep the region")
        page.wait_until(lambda: options() == ["none: choose one", "middle part", "wedge"])
        for name in ("wedge", "middle part"):
            page.set("region", name)
            page.set("remove the region")
            page.wait_until(lambda name=name: ("region removed", name) in page.notices)
            assert name not in options()
        assert read_measures(source.run).regions == {}


def test_a_region_kept_or_removed_elsewhere_is_listed_or_not_and_numbers_are_of_the_one_chosen(tmp_path):
    source = make_source(tmp_path, initial_opacity=0.6)
    keep_region(source.run, "far away", Box((50.0, 50.0, 50.0), (51.0, 51.0, 51.0)))
    with serving(source) as (viewer, _), opened(viewer) as page:
        keep_region(source.run, "all of it", Box((-5.0, -5.0, -5.0), (5.0, 5.0, 5.0)))
        page.wait_until(lambda: "all of it" in page.props("region")["options"])
        page.set("region", "all of it")
        page.wait_for_text(" square units</td>")
        page.set("region", "far away")
        page.wait_for_notice("far away has nothing")
        assert " square units</td>" not in page.texts
        page.set("region", "all of it")
        page.wait_for_text(" square units</td>")
        before = page.texts
        keep_region(source.run, "all of it", Box((-5.0, -5.0, -5.0), (5.0, 5.0, 0.0)))
        page.wait_until(lambda: " square units</td>" in page.texts and page.texts != before)
        keep_scale(source.run, Scale(0.01, "known"))
        page.wait_for_text(" cm²</td>", "1 unit is 0.01 m")
        keep_region(source.run, "all of it", None)
        page.wait_until(lambda: "all of it" not in page.props("region")["options"])


def test_the_axis_of_spectra_says_reflectance_only_in_a_light_of_1(tmp_path):
    source = make_source(tmp_path, light=[1.0] * 5)

    def axes(page):
        charts = [one for one in page.controls.values() if one.get("type") == "GuiUplotMessage"]
        return sorted(chart["axes"][1]["label"] for chart in charts)

    with serving(source) as (viewer, _), opened(viewer) as page:
        page.click(0.5, 0.5)
        page.wait_until(lambda: axes(page) == ["reflectance"] * 3)  # of materials, the probe, all probes
        page.set("light", "A: incandescent lamp, 2856 K")
        page.wait_until(lambda: axes(page) == ["radiance", "reflectance", "reflectance"])
        page.click(0.5, 0.5)  # the first probe keeps its light
        page.wait_until(lambda: axes(page) == ["radiance", "radiance", "radiance or reflectance"])
