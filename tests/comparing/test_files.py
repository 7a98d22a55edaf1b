"""Files of a comparison hold what was found, and the page asks for nothing."""

import csv
import json
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from plyfile import PlyData

from tests.factories.changed_objects import CHALK, MOVED, capture, later, surface_of_shape
from unmix_plugin.comparing.comparison import compare
from unmix_plugin.comparing.files import ChangeFiles
from unmix_plugin.comparing.shown import carried_camera
from unmix_plugin.errors import ConfigError


@pytest.fixture(scope="module")
def comparison():
    surface = surface_of_shape(subdivisions=4)
    spectra = surface.spectra.copy()
    spectra[surface.positions[:, 0] > 0.8] = CHALK
    return compare(
        capture(surface, "a <b> & c"), later(replace(surface, spectra=spectra)), indices=("r600/r450",)
    )


@pytest.fixture(scope="module")
def folder(comparison, tmp_path_factory):
    folder = tmp_path_factory.mktemp("changes")
    assert ChangeFiles(folder, 1).write(comparison)
    return folder


def test_every_place_has_a_row_in_the_table_and_a_number_on_the_surface(comparison, folder):
    with (folder / "changes.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["place"]) for row in rows] == [place.number for place in comparison.places] != []
    vertices = PlyData.read(folder / "changes.ply")["vertex"]
    assert set(vertices["place"]) == {0, *(place.number for place in comparison.places)}
    np.testing.assert_allclose(vertices["angle"], comparison.angle, rtol=1e-5)
    assert "index_r600_r450" in {one.name for one in vertices.properties}


def test_the_summary_says_how_the_captures_were_laid_on_each_other(comparison, folder):
    found = json.loads((folder / "changes.json").read_text())
    assert found["registration"]["rms_px"] == comparison.registration.rms_px
    assert found["places"] == len(comparison.places)


def test_maps_have_a_number_for_each_pixel_of_a_view(comparison, folder):
    [view] = ChangeFiles(folder, 1).views(comparison)
    values = np.load(folder / "maps" / "angle" / f"{view.name}.npy")
    assert values.shape == (view.camera.height, view.camera.width)
    assert np.load(folder / "maps" / "angle" / f"{view.name}-p.npy").shape == values.shape


def test_the_page_holds_all_that_it_shows_and_names_are_text(folder):
    page = (folder / "changes.html").read_text()
    assert "a &lt;b&gt; &amp; c" in page
    assert not re.search(r"(src|href)=\"(?!data:)[^\"]+\"", page)
    assert "default-src 'none'" in page
    data = json.loads(re.search(r"const data = (.*);\n", page)[1])  # type: ignore[index]
    view = data["views"][0]
    assert sum(length for _, length in view["runs"]) == view["width"] * view["height"]
    assert len(view["maps"]) == page.count('class="bar"')


def test_the_report_for_print_has_a_page_for_what_was_found_and_for_each_view(folder):
    data = (folder / "changes.pdf").read_bytes()
    assert data.startswith(b"%PDF")
    assert len(re.findall(rb"/Type /Page\b", data)) == 2


def test_a_carried_camera_sees_the_object_where_it_was(comparison):
    camera = comparison.before.scene.views[0].camera
    points = comparison.before.scene.frame.to_world(np.random.default_rng(0).uniform(-0.5, 0.5, (30, 3)))
    back = comparison.registration.to_before.inverse
    model = comparison.after.scene.frame.to_model(back.apply(points))
    own = comparison.before.scene.frame.to_model(points)
    first, _ = camera.project(torch.from_numpy(own).float(), 0)
    second, _ = carried_camera(comparison, camera).project(torch.from_numpy(model).float(), 0)
    torch.testing.assert_close(first, second, atol=0.02, rtol=0)
    assert not np.allclose(MOVED.translation, 0)


def test_no_view_is_refused(comparison, tmp_path):
    with pytest.raises(ConfigError, match="--max-views"):
        ChangeFiles(tmp_path, 0).views(comparison)
