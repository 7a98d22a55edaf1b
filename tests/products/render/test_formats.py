"""Which outputs become which files."""

import re

import pytest

from tests.method_factory import make_scene
from unmix_plugin.engine.registry import Output
from unmix_plugin.errors import ConfigError, UnmixError
from unmix_plugin.products.render.files import choose_formats, file_name
from unmix_plugin.trained.outputs import OUTPUTS

SCENE = make_scene()


def formats(*outputs, asked=(), is_path=False):
    """Formats by output."""
    found = {}
    for product in choose_formats(outputs, asked, SCENE, is_path):
        found.setdefault(product.output.name, []).append(product.format)
    return found


def test_all_is_every_output_that_the_model_has():
    assert set(formats("all")) == set(OUTPUTS) - {"reflectance"}  # the light is unknown


def test_each_output_has_formats_that_suit_it():
    assert formats("spectral", "rgb", "abundances", "segmentation", "depth", "linear_rgb", "band:550nm") == {
        "spectral": ["envi"],
        "rgb": ["png"],
        "abundances": ["envi", "png"],
        "segmentation": ["png"],
        "depth": ["png", "npy"],
        "linear_rgb": ["exr"],
        "band:550nm": ["png", "npy"],
    }


def test_on_a_path_pictures_become_videos_and_spectra_stay_numbers():
    found = formats("all", is_path=True)
    for name in ("spectral", "diffuse", "specular", "continuum", "derivative", "second_derivative"):
        assert found.pop(name) == ["envi"]
    assert set(map(tuple, found.values())) == {("mp4",)}


def test_asked_formats_go_to_the_outputs_that_they_suit():
    assert formats("spectral", "rgb", "segmentation", asked=("exr", "png", "npy")) == {
        "spectral": ["exr", "npy"],
        "rgb": ["png", "npy"],
        "segmentation": ["png", "npy"],
    }


def test_an_output_asked_for_twice_is_written_once():
    assert formats("rgb", "rgb", asked=("png", "png")) == {"rgb": ["png"]}


def test_names_of_files_have_no_odd_letters():
    [product] = choose_formats(["false-colour:650,550,450"], [], SCENE, False)
    assert file_name(product.output) == "false-colour-650-550-450"


def test_an_index_is_a_map_and_says_so_where_the_light_is_unknown():
    [png, npy] = choose_formats(["index:(r650-r500)/(r650+r500)"], [], SCENE, False)
    assert (png.format, npy.format) == ("png", "npy")
    assert "of radiance, since the scene's light is unknown" in png.output.what
    [known, _] = choose_formats(["index:r650/r500"], [], make_scene(light=[1.0] * 5), False)
    assert "radiance" not in known.output.what


def test_a_target_is_named_for_its_file_not_for_where_that_lies(tmp_path):
    (tmp_path / "paint.csv").write_text("wavelength,gold,red\n450,0.1,0.3\n650,0.9,0.8\n")
    [output] = {
        product.output
        for product in choose_formats([f"target:ace:{tmp_path}/paint.csv#gold>0.5"], [], SCENE, False)
    }
    assert file_name(output) == "target-ace-paint.csv-gold-0.5"


def test_formulas_that_differ_in_an_operator_have_files_of_their_own():
    names = {file_name(Output(f"index:r650{sign}r550", "map", "", "")) for sign in "/*+-^"}
    assert len(names) == 5
    assert all(re.fullmatch(r"index-r650[+-]r550-[0-9a-f]{8}", name) for name in names)
    assert file_name(Output("index:ndvi", "map", "", "")) == "index-ndvi"


def test_a_long_formula_has_a_file_name_of_its_own():
    long = "index:" + "+".join(["r500"] * 60)
    one, other = (choose_formats([name], ["npy"], SCENE, False)[0].output for name in (long, long + "+r600"))
    assert len(file_name(one)) < 120
    assert file_name(one) != file_name(other)


BAD = {
    "unknown output": (
        ["spectrl"],
        [],
        r"no output named 'spectrl' \(did you mean spectral.*\?\); known are rgb",
    ),
    "unknown kind": (["ban:650nm"], [], r"no output named 'ban:650nm' \(did you mean band\?\)"),
    "index of none": (["index"], [], "the output index needs to know which, as in index:ndvi"),
    "index beyond the bands": (["index:ndvi"], [], "ndvi needs .* nothing is extrapolated"),
    "target without file": (["target:"], [], "the output target needs to know which, as in target:paint.csv"),
    "nearly an index": (["indx:ndvi"], [], "did you mean index or band"),
    "argument of none": (["rgb:1"], [], "no output named 'rgb:1'"),
    "band without wavelength": (["band"], [], "the output band needs a wavelength, as in band:650nm"),
    "band of no number": (["band:red"], [], "'red' in the output band:red is not a wavelength"),
    "two wavelengths": (["false-colour:650,550"], [], "false-colour takes three wavelengths"),
    "outside the bands": (["band:900nm"], [], "no band at 900 nm: 5 bands, 450-650 nm"),
    "one outside": (["false-colour:650,550,300"], [], "no band at 300 nm"),
    "unknown format": (["rgb"], ["xyz"], "there is no format 'xyz'; known are envi, exr, npy, png, mp4"),
    "nearly a format": (["rgb"], ["pngs"], r"there is no format 'pngs' \(did you mean png\?\)"),
    "spectra as png": (
        ["spectral"],
        ["png"],
        "spectral can't be written as png: a PNG shows colours: ask for rgb",
    ),
    "encoded light as exr": (["rgb"], ["exr"], "rgb can't be written as exr: .* ask for linear_rgb"),
    "ids as exr": (
        ["segmentation"],
        ["exr", "envi"],
        "segmentation can't be written as exr or envi: ids are",
    ),
    "pca as exr": (["pca"], ["exr"], "Formats for pca: png, npy, envi, mp4"),
    "same files": (["band:550", "band:550 "], [], "would have the same files"),
}


@pytest.mark.parametrize("fault", BAD)
def test_what_cannot_be_written_is_refused(fault):
    outputs, asked, said = BAD[fault]
    with pytest.raises(UnmixError, match=said):
        formats(*outputs, asked=asked)


def test_a_format_that_no_output_uses_is_refused():
    with pytest.raises(ConfigError, match="--formats exr suits none of the outputs asked for: rgb or pca"):
        formats("rgb", "pca", asked=("png", "exr"))
