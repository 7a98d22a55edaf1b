"""Which outputs become which files."""

import re

import pytest

from tests.factories.models import WAVELENGTHS_NM, make_scene
from unmix_plugin.engine.outputs import Output
from unmix_plugin.errors import UnmixError
from unmix_plugin.products.render.files import choose_formats, file_name
from unmix_plugin.trained.plain_outputs import OUTPUTS

SCENE = make_scene()


def formats(*outputs, asked=(), is_path=False):
    """Formats by output."""
    chosen = choose_formats(outputs, asked, SCENE, is_path)
    names = dict.fromkeys(one.output.name for one in chosen)
    return {name: [one.format for one in chosen if one.output.name == name] for name in names}


def test_all_is_every_output_that_the_model_has_and_each_has_formats_that_suit_it():
    assert set(formats("all")) == set(OUTPUTS) - {
        "reflectance",
        "unexplained",
    }  # without a light and what was measured
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


def test_asked_formats_go_to_the_outputs_that_they_suit_once_each():
    assert formats("spectral", "rgb", "segmentation", "rgb", asked=("exr", "png", "npy", "png")) == {
        "spectral": ["exr", "npy"],
        "rgb": ["png", "npy"],
        "segmentation": ["png", "npy"],
    }


def test_an_index_is_a_map_and_says_so_where_the_light_is_unknown():
    [png, npy] = choose_formats(["index:(r650-r500)/(r650+r500)"], [], SCENE, False)
    assert (png.format, npy.format) == ("png", "npy")
    assert "of radiance, since the scene's light is unknown" in png.output.what
    [known, _] = choose_formats(["index:r650/r500"], [], make_scene(light=[1.0] * 5), False)
    assert "radiance" not in known.output.what


def name_of(output):
    return file_name(Output(output, "map", "", ""))


def test_files_are_named_for_outputs_without_odd_letters_folders_or_clashes():
    assert name_of("false-colour:650,550,450") == "false-colour-650-550-450"
    assert name_of("target:ace:some/folder/paint.csv#gold>0.5") == "target-ace-paint.csv-gold-0.5"
    assert name_of("index:ndvi") == "index-ndvi"
    names = {name_of(f"index:r650{sign}r550") for sign in "/*+-^"}
    assert len(names) == 5
    assert all(re.fullmatch(r"index-r650[+-]r550-[0-9a-f]{8}", name) for name in names)
    long = "index:" + "+".join(["r500"] * 60)
    assert len(name_of(long)) < 120
    assert name_of(long) != name_of(long + "+r600")


BAD = [
    (["spectrl"], [], r"no output named 'spectrl' \(did you mean spectral.*\?\); known are rgb"),
    (["index:ndvi"], [], "ndvi needs .* nothing is extrapolated"),
    (["false-colour:650,550,300"], [], "no band at 300 nm: 5 bands, 450-650 nm"),
    (["rgb"], ["xyz"], "there is no format 'xyz'; known are envi, exr, npy, png, mp4"),
    (["rgb"], ["pngs"], r"there is no format 'pngs' \(did you mean png\?\)"),
    (["spectral"], ["png"], "spectral can't be written as png: a PNG shows colours: ask for rgb"),
    (["rgb"], ["exr"], "rgb can't be written as exr: .* ask for linear_rgb"),
    (["segmentation"], ["exr", "envi"], "segmentation can't be written as exr or envi: ids are"),
    (["pca"], ["exr"], "Formats for pca: png, npy, envi, mp4"),
    (["rgb", "pca"], ["png", "exr"], "--formats exr suits none of the outputs asked for: rgb or pca"),
    (["band:550", "band:550 "], [], "would have the same files"),
]


@pytest.mark.parametrize(("outputs", "asked", "said"), BAD)
def test_what_cannot_be_written_is_refused(outputs, asked, said):
    with pytest.raises(UnmixError, match=said):
        formats(*outputs, asked=asked)


def test_files_that_differ_in_capitals_alone_are_the_same_on_some_systems(tmp_path):
    rows = "\n".join(f"{nm},0.2,0.{index + 1}" for index, nm in enumerate(WAVELENGTHS_NM))
    (tmp_path / "foils.csv").write_text(f"wavelength,Gold,gold\n{rows}\n")
    with pytest.raises(UnmixError, match=r"foils.csv#Gold and .*foils.csv#gold would have the same files"):
        formats(f"target:{tmp_path}/foils.csv#Gold", f"target:{tmp_path}/foils.csv#gold")
