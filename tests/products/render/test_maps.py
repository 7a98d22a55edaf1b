"""Maps: an independent reader finds a known place within a pixel, in metres, from above and from the side."""

import json
from dataclasses import replace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import spectral.io.envi as envi
import tifffile

from tests.factories.ball_model import RADIUS, SHADE, ball_scene, lamplit_ball_scene
from unmix_plugin.errors import ConfigError
from unmix_plugin.products.render import RenderOptions, files
from unmix_plugin.products.render.cameras import choose_cameras
from unmix_plugin.products.render.files import choose_formats
from unmix_plugin.products.render.job import RenderJob, take_survey
from unmix_plugin.products.render.maps import gdal_metadata, map_camera
from unmix_plugin.scenes.scene import Normalisation
from unmix_plugin.trained.measures import Scale
from unmix_plugin.trained.run_materials import endmember_colours

TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
PLACE = np.array([500_010.0, 5_400_020.0, 300.0])
"""Where the ball lies in its world, as geo-referenced ones do."""
SCENE = replace(ball_scene(), frame=Normalisation(TURN, np.zeros(3), 0.25, PLACE))
SCALE = Scale(1.0, "test")


def rendered(
    folder, names, formats, pixel_size, cameras="map", scene=SCENE, scale: Scale | None = SCALE, epsg=None
):
    """The camera of a map that is rendered into a folder, and its survey."""
    chosen = choose_cameras(scene, RenderOptions(cameras=cameras, pixel_size=pixel_size, epsg=epsg), scale)
    outputs = files.with_units(choose_formats(names, formats, scene, False), chosen.map_info)
    survey = take_survey(scene, chosen.views, [one.output for one in outputs], chosen.map_info)
    job = RenderJob(scene, chosen, outputs, survey, folder)
    job.render(job.blocks())
    return chosen.views[0].camera, survey


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("maps")
    for cameras in ("map", "map:east"):
        rendered(folder, ["accumulation", "spectral"], ["tif", "envi"], 0.2, cameras)
    return folder


def outline(opacity, left, top, pixel):
    """Least and greatest x and y of what is opaque."""
    rows, columns = np.nonzero(opacity > 0.5)
    x = left + pixel * np.array([columns.min(), columns.max() + 1])
    y = top - pixel * np.array([rows.min(), rows.max() + 1])
    return np.array([*x, *y])


@pytest.mark.parametrize(("view", "axes"), [("map_top", (0, 1)), ("map_east", (1, 2))])
def test_a_geotiff_has_the_ball_where_it_is(folder, view, axes):
    with tifffile.TiffFile(folder / "accumulation" / f"{view}.tif") as file:
        tags, opacity = file.pages.first.tags, file.asarray()
        pixel, tie = tags[33550].value, tags[33922].value
        keys = np.array(tags[34735].value).reshape(-1, 4)
    assert (pixel, tie[:3]) == ((0.2, 0.2, 0.0), (0.0, 0.0, 0.0))
    reach, (x, y) = RADIUS / 0.25, PLACE[list(axes)]
    expected = [x - reach, x + reach, y + reach, y - reach]
    np.testing.assert_allclose(outline(opacity, tie[3], tie[4], 0.2), expected, atol=0.2)
    assert {tuple(key) for key in keys[1:]} >= {(1024, 0, 1, 1), (1025, 0, 1, 1), (3076, 0, 1, 9001)}
    assert len(keys) == keys[0, 3] + 1


def test_pixels_in_which_nothing_is_are_no_data_of_other_programs(tmp_path):
    outputs = {"depth": 0, "ray_distance": 0, "segmentation": 255, "accumulation": None}
    rendered(tmp_path, [*outputs], ["tif", "envi"], 0.5)
    for name, nothing in outputs.items():
        with tifffile.TiffFile(tmp_path / name / "map_top.tif") as file:
            page, values = file.pages.first, file.asarray()
        assert ("GDAL_NODATA" in page.tags) == (nothing is not None)
        if nothing is not None:
            assert page.nodata == nothing
            assert 0 < (values == nothing).sum() < values.size
        if name != "segmentation":
            image: Any = envi.open(tmp_path / name / "map_top.hdr")
            assert image.metadata.get("data ignore value") == (None if nothing is None else str(nothing))


def test_an_envi_header_says_the_same(folder):
    image: Any = envi.open(folder / "spectral" / "map_top.hdr")
    kind, column, row, left, top, x, y, units = image.metadata["map info"]
    assert (kind, float(column), float(row), float(x), float(y)) == ("Arbitrary", 1, 1, 0.2, 0.2)
    assert units == "units=Meters"
    with tifffile.TiffFile(folder / "spectral" / "map_top.tif") as file:
        tie = file.pages.first.tags[33922].value
        np.testing.assert_array_equal(np.moveaxis(file.asarray(), 0, -1), image.open_memmap())
    assert (float(left), float(top)) == tie[3:5]


@pytest.mark.parametrize("direction", ["top", "south", "east", "0,0,2"])
def test_coordinates_of_a_map_are_those_of_the_world_where_its_axes_are(direction):
    camera, info = map_camera(SCENE, SCALE, direction, 0.25)
    axes = {"south": (0, 2), "east": (1, 2)}.get(direction, (0, 1))
    rays = SCENE.frame.to_world(camera.image_rays(0).origins.double().numpy())
    rays = rays.reshape(camera.height, camera.width, 3)[3, 2, list(axes)]
    np.testing.assert_allclose(rays, [info.left + 2.5 * 0.25, info.top - 3.5 * 0.25], atol=0.05)
    assert info.geotiff
    assert "map info" in info.envi


@pytest.mark.parametrize("direction", ["bottom", "north", "west", "1,2,3", "0,0,-1"])
def test_a_map_along_no_axes_of_the_world_says_the_size_of_pixels_and_no_coordinates(direction):
    _, info = map_camera(SCENE, SCALE, direction, 0.25)
    assert info.envi == {"pixel size": [0.25, 0.25, "units=Meters"]}
    assert not info.geotiff


def test_units_and_a_coordinate_system_that_are_known_are_written():
    kinds = {}
    for code in (32632, 25832):
        asked = RenderOptions(cameras="map", pixel_size=1.0, epsg=code)
        found: Any = choose_cameras(SCENE, asked, SCALE).map_info
        directory = {tuple(key) for key in np.array(found.geotiff[2][3]).reshape(-1, 4)[1:]}
        assert directory >= {(1024, 0, 1, 1), (3072, 0, 1, code)}
        kinds[code] = found.envi["map info"]
    kind, *_, zone, half, datum, units = kinds[32632]
    assert (kind, zone, half, datum, units) == ("UTM", 32, "North", "WGS-84", "units=Meters")
    assert kinds[25832][0] == "Arbitrary"
    with pytest.raises(ConfigError, match=r"--epsg needs a world in metres, .*: leave --epsg out"):
        choose_cameras(SCENE, RenderOptions(cameras="map", epsg=32632), None)
    _, info = map_camera(SCENE, None, "top", 0.2)
    assert info.envi["map info"][-1] == "units=Unknown"
    _, millimetres = map_camera(SCENE, Scale(0.001, "test"), "top", 0.0002)
    assert millimetres.left == pytest.approx(info.left / 1000)


@pytest.mark.parametrize(
    ("scale", "unit", "factor"), [(Scale(0.01, "test"), "metres", 0.01), (None, "world units", 1.0)]
)
def test_heights_of_a_map_are_in_the_unit_of_its_coordinates_and_say_it(scale, unit, factor, tmp_path):
    factors = {"depth": factor, "ray_distance": factor, "accumulation": 1.0}
    camera, survey = rendered(tmp_path, [*factors], ["tif"], 0.5 * factor, scale=scale)
    view = SCENE.look(camera)
    for name, units in factors.items():
        with tifffile.TiffFile(tmp_path / name / "map_top.tif") as file:
            found, said = file.asarray(), json.loads(file.pages.first.tags[270].value)["what"]
        np.testing.assert_allclose(found, units * view[name].numpy(), rtol=1e-5)
        assert (f"in {unit}" in said) == (name != "accumulation")
    seen = view.opacity > 0.9
    relief = factor * np.ptp(view["depth"][seen].numpy())  # of half a ball, not known up to its edge
    assert 0.5 < relief / (factor * RADIUS / 0.25) < 1.05
    assert survey.ranges["depth"][1] == pytest.approx(factor * view["depth"][seen].max().item(), rel=0.2)


def test_more_than_a_tiff_can_hold_is_written_as_bigtiff(tmp_path, monkeypatch):
    setting = files.RenderSetting(tmp_path, (4, 3), {}, {}, {}, None)
    [depth] = choose_formats(["depth"], ["tif"], SCENE, False)
    values = np.arange(12, dtype=np.float32).reshape(3, 4)
    for limit, is_big in ((48, False), (47, True)):
        monkeypatch.setattr(files, "_LARGEST_TIFF", limit)
        with files.still(files.still_paths(setting.folder, depth, "v")[0], depth, setting) as sink:
            sink(files.Rows(0, {"depth": values}, {}, np.ones_like(values), np.ones_like(values)))
        with tifffile.TiffFile(tmp_path / "depth" / "v.tif") as file:
            assert file.is_bigtiff == is_big
            np.testing.assert_array_equal(file.asarray(), values)


@pytest.mark.parametrize(
    ("cameras", "more", "message"),
    [
        ("map", {"pixel_size": 0.0}, "--pixel-size is 0; it must be greater than 0"),
        ("map", {"pixel_size": 1e-7}, "--pixel-size 1e-07: .* expected whole numbers"),
        ("map:up", {}, "--cameras map:up: expected top, bottom"),
        ("map:0,0,0", {}, "--cameras map:0,0,0: expected top"),
        ("map", {"size": "10x10"}, "--cameras map has one view of the size that --pixel-size"),
        ("orbit", {"pixel_size": 0.1}, "--pixel-size is for --cameras map"),
        ("orbit", {"epsg": 32632}, "--epsg is for --cameras map"),
        ("map", {"epsg": 4326}, "--epsg 4326 is no projected coordinate system"),
        ("map:east", {"epsg": 32632}, "--epsg is for maps from above"),
    ],
)
def test_what_makes_no_map_is_refused(cameras, more, message):
    with pytest.raises(ConfigError, match=message):
        choose_cameras(SCENE, RenderOptions(cameras=cameras, **more), SCALE)


def test_where_a_lamp_goes_with_the_camera_a_map_is_lit_squarely(tmp_path):
    scene = lamplit_ball_scene()
    rendered(tmp_path, ["spectral", "accumulation"], ["npy"], 0.05, scene=scene, scale=None)
    spectra, opacity = (np.load(tmp_path / name / "map_top.npy") for name in ("spectral", "accumulation"))
    found = spectra[opacity > 0.99] / opacity[opacity > 0.99, None]
    assert len(found) > 30
    expected = SHADE * scene.materials.endmembers[0].numpy()
    np.testing.assert_allclose(found, np.broadcast_to(expected, found.shape), atol=5e-3)


def test_bands_of_a_geotiff_have_names_wavelengths_and_colours(tmp_path):
    names = {"spectral": "minisblack", "rgb": "rgb", "false-colour:650,550,450": "rgb", "depth": "minisblack"}
    rendered(tmp_path, [*names, "segmentation"], ["tif"], 0.5)
    centers = SCENE.bands.centers_nm
    for name, photometric in names.items():
        [path] = tmp_path.glob(f"{name.replace(':', '-').replace(',', '-')}/map_top.tif")
        with tifffile.TiffFile(path) as file:
            page: Any = file.pages.first
            assert page.photometric.name.lower() == photometric
            items = ElementTree.fromstring(page.tags["GDAL_METADATA"].value)
        found = {(one.get("name"), int(one.get("sample", -1))): (one.text, one.attrib) for one in items}
        if name == "spectral":
            for index, nm in enumerate(centers):
                assert found["DESCRIPTION", index][0] == f"{nm:g} nm"
                assert float(found["wavelength", index][0] or "") == pytest.approx(nm)
                value, where = found["CENTRAL_WAVELENGTH_UM", index]
                assert (float(value or ""), where["domain"]) == (pytest.approx(nm / 1000), "IMAGERY")
        elif name.startswith("false"):
            shown = [float(found["wavelength", index][0] or "") for index in range(3)]
            assert shown == [centers[SCENE.bands.nearest(nm)] for nm in (650.0, 550.0, 450.0)]
        elif name == "rgb":
            assert [found["DESCRIPTION", index][0] for index in range(3)] == ["red", "green", "blue"]
        else:
            assert set(found) == {("DESCRIPTION", 0)}
    with tifffile.TiffFile(tmp_path / "segmentation" / "map_top.tif") as file:
        page = file.pages.first
        colours, ids = np.asarray(page.colormap), file.asarray()
    assert set(np.unique(ids)) <= {0, 1, 2, 255}
    expected = endmember_colours(SCENE.materials)
    np.testing.assert_allclose(colours[:, :3].T / 65535, expected, atol=1e-4)


def test_names_of_bands_are_text_and_no_markup():
    *_, text, _ = gdal_metadata(['a<b>&"c"', "ß"])
    names = [one.text for one in ElementTree.fromstring(text.rstrip(b"\0").decode())]
    assert names == ['a<b>&"c"', "ß"]


@pytest.mark.parametrize("form", ["tif", "envi"])
def test_gdal_itself_shows_where_a_map_lies_and_names_and_wavelengths_of_bands(tmp_path, form):
    rasterio = pytest.importorskip("rasterio")
    suffix = {"tif": "tif", "envi": "img"}[form]
    rendered(tmp_path, ["spectral", "abundances", "false-colour:650,550,450"], [form], 0.5, epsg=32632)
    with rasterio.open(tmp_path / "spectral" / f"map_top.{suffix}") as file:
        assert (file.crs.to_epsg(), file.res) == (32632, (0.5, 0.5))
        assert file.bounds.left < PLACE[0] < file.bounds.right
        assert file.bounds.bottom < PLACE[1] < file.bounds.top
        for band, nm in zip(file.indexes, SCENE.bands.centers_nm, strict=True):
            tags = file.tags(band)
            assert (float(tags["wavelength"]), tags["wavelength_units"]) == (nm, "Nanometers")
            if form == "tif":
                assert file.descriptions[band - 1] == f"{nm:g} nm"
                shown_um = file.tags(band, ns="IMAGERY")["CENTRAL_WAVELENGTH_UM"]
                assert float(shown_um) == pytest.approx(nm / 1000)
    with rasterio.open(tmp_path / "abundances" / f"map_top.{suffix}") as file:
        assert file.descriptions == SCENE.materials.names
    if form == "tif":
        with rasterio.open(tmp_path / "false-colour-650-550-450" / "map_top.tif") as file:
            assert [one.name for one in file.colorinterp] == ["red", "green", "blue"]
