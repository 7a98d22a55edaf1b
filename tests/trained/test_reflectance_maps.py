import numpy as np
import pytest
import torch
from torch.testing import assert_close

from tests.factories.models import CAMERA, WAVELENGTHS_NM, make_scene
from unmix_plugin.editing.apply import edit_scene
from unmix_plugin.editing.recipe import Light, Recipe
from unmix_plugin.errors import ConfigError, SpectrumError
from unmix_plugin.formats.libraries import library_of
from unmix_plugin.products.render.files import choose_formats
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.materials import seen_reflectance
from unmix_plugin.trained.reflectance_maps import parse_reflectance_map

LIGHT = [0.5, 0.8, 1.0, 0.9, 0.6]
INDEX = "index:(r650-r500)/(r650+r500)"


@pytest.fixture(scope="module")
def target(tmp_path_factory):
    path = tmp_path_factory.mktemp("targets") / "paint.csv"
    rows = [f"{nm},{0.1 + 0.15 * index}" for index, nm in enumerate(WAVELENGTHS_NM)]
    path.write_text("\n".join(["wavelength,paint", *rows]))
    return path


def test_reflectance_is_what_is_seen_over_the_light_and_nan_where_hardly_anything_or_no_light_is():
    spectra = torch.tensor([[0.2, 0.4], [0.1, 0.2], [0.1, 0.2]])
    opacity = torch.tensor([1.0, 0.5, 0.4])
    found = seen_reflectance(spectra, opacity, torch.tensor([0.5, 1.0]))
    assert_close(found[:2], torch.tensor([[0.4, 0.4], [0.4, 0.4]]))
    assert found[2].isnan().all()
    for dark in (0.0, 1e-4):
        found = seen_reflectance(spectra[:1], torch.ones(1), torch.tensor([dark, 1.0]))
        assert found[0].isnan().tolist() == [True, False]
    # Where the light is unknown, radiance stands for reflectance.
    assert_close(seen_reflectance(spectra[:1], torch.ones(1), None), spectra[:1])


@pytest.mark.parametrize("dark", [0.0, 1e-4])
def test_a_library_map_leaves_out_the_bands_that_other_comparisons_leave_out(library, dark):
    bands, light = Bands.of(WAVELENGTHS_NM), np.array([dark, 0.8, 1.0, 0.9, 0.6])
    radiance = light * np.array([5e4, *WAVELENGTHS_NM[1:]]) / 1000  # noise, where there is hardly any light
    known = library_of([library], bands)
    [match] = known.nearest(radiance[None], bands, light, 1)[0]
    reflectance = seen_reflectance(torch.from_numpy(radiance)[None], torch.ones(1), torch.from_numpy(light))
    asked = parse_reflectance_map(f"library:angle:{library}", bands, torch.from_numpy(light > 1e-3))
    [angle] = asked.fit(torch.zeros(0, len(bands)))(reflectance)
    assert float(angle) == pytest.approx(match.angle_rad, abs=1e-7)
    assert match.num_bands == 4


def test_an_index_of_a_view_is_that_of_its_reflectance():
    scene = make_scene(light=LIGHT)
    view = scene.look(CAMERA)
    found = scene.render(CAMERA, [INDEX])[INDEX]
    seen = seen_reflectance(view.spectra, view.opacity, scene.light)
    at_500, at_650 = (seen[..., WAVELENGTHS_NM.index(nm)] for nm in (500, 650))
    assert found.isfinite().sum() > 20
    assert_close(found, (at_650 - at_500) / (at_650 + at_500), equal_nan=True)
    assert (found.isnan() == (view.opacity < 0.5)).all()


@pytest.mark.parametrize("method", ["angle", "mf", "ace"])
def test_outputs_of_reflectance_do_not_change_with_the_light(target, method):
    """ACE divides by covariances of almost nothing: what rounding leaves there is a thousandth."""
    scene = make_scene(light=LIGHT)
    lit = edit_scene(scene, Recipe(illuminant=Light("A")))
    assert lit.light is not None
    assert not np.allclose(lit.light, LIGHT)
    for name in (INDEX, f"target:{method}:{target}"):
        before, after = (one.render(CAMERA, [name])[name] for one in (scene, lit))
        assert before.isfinite().any()
        assert_close(after, before, equal_nan=True, atol=1e-3, rtol=1e-3)


@pytest.mark.parametrize("method", ["angle", "mf", "ace"])
@pytest.mark.parametrize("dark", [0.0, 1e-4])
def test_a_target_is_looked_for_in_the_bands_with_light(target, method, dark):
    spectra = torch.rand((20, 5), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    bands, light = Bands.of(WAVELENGTHS_NM), torch.tensor([0.5, dark, 1.0, 0.9, 0.6], dtype=torch.float64)
    reflectance = seen_reflectance(spectra * light, torch.ones(20), light)
    asked = parse_reflectance_map(f"target:{method}:{target}", bands, light > 1e-3)
    others = Bands(bands.centers_nm[[0, 2, 3, 4]])
    expected = parse_reflectance_map(f"target:{method}:{target}", others)
    found = asked.fit(reflectance)(reflectance)
    assert found.isfinite().all()
    assert_close(found, expected.fit(spectra[:, [0, 2, 3, 4]])(spectra[:, [0, 2, 3, 4]]))
    assert asked.what == f"{expected.what}, 1 of 5 bands left out: no light"


def test_an_absorption_is_that_of_the_bands_with_light():
    bands = Bands.of([400.0, 450.0, 500.0, 550.0, 600.0, 650.0])
    light = torch.tensor([0.0, 1.0, 1.0, 0.0, 1.0, 1.0])
    radiance = light * torch.tensor([[0.5, 0.5, 0.3, 0.9, 0.4, 0.5]])
    reflectance = seen_reflectance(radiance, torch.ones(1), light)
    asked = parse_reflectance_map("absorption:area:450-650", bands, light > 0)
    [area] = asked.fit(torch.zeros(0, 6))(reflectance)
    assert float(area) == pytest.approx(25 * 0.4 + 50 * (0.4 + 0.2) + 25 * 0.2)
    assert asked.what.endswith("450 to 650 nm; 1 of 5 bands left out: no light")


def test_too_few_bands_with_light_are_refused(target):
    bands, light = Bands.of(WAVELENGTHS_NM), torch.tensor([False, True, False, False, False])
    for name, said in (
        (f"target:{target}", "two bands or more; found 1 band"),
        ("absorption:450-650", "three bands or more with light from 450 to 650 nm, .* found 1 of"),
    ):
        with pytest.raises(SpectrumError, match=said):
            parse_reflectance_map(name, bands, light)
    with pytest.raises(SpectrumError, match="no power in any of the 5 bands"):
        parse_reflectance_map(f"target:mf:{target}", bands, torch.zeros(5, dtype=torch.bool))


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    """A file of three reflectances of one shape each."""
    path = tmp_path_factory.mktemp("libraries") / "mine.csv"
    rows = [f"{nm},{nm},{1200 - nm},500" for nm in WAVELENGTHS_NM]
    path.write_text("\n".join(["wavelength,rising,falling,flat", *rows]))
    return path


def test_a_library_maps_the_nearest_within_the_limit_and_its_angle(library):
    bands = Bands.of(WAVELENGTHS_NM)
    rows = np.array([np.array(WAVELENGTHS_NM), 1200 - np.array(WAVELENGTHS_NM), np.full(len(bands), 500.0)])
    generator = np.random.default_rng(0)
    spectra = generator.uniform(0.1, 1, (2, 30, 1)) * rows[generator.integers(0, 3, (2, 30))]
    spectra *= generator.uniform(0.8, 1.2, spectra.shape)
    spectra[0, 0], spectra[1, 3] = np.nan, 0.0
    lengths = np.linalg.norm(spectra, axis=-1, keepdims=True).clip(1e-9) * np.linalg.norm(rows, axis=1)
    cosines = spectra @ rows.T / lengths
    angles = np.arccos(np.clip(cosines, -1, 1))
    expected = np.where(angles.min(axis=-1) <= 0.12, angles.argmin(axis=-1), 255)
    expected[0, 0] = expected[1, 3] = 255
    asked = parse_reflectance_map(f"library:{library}<0.12", bands)
    found = asked.fit(torch.zeros(0, len(bands)))(torch.from_numpy(spectra))
    np.testing.assert_array_equal(found.numpy(), expected)
    assert {0, 1, 2, 255} <= set(expected.ravel().tolist())
    assert [name for name, _ in asked.classes] == ["rising", "falling", "flat"]
    least = parse_reflectance_map(f"library:angle:{library}", bands).fit(torch.zeros(0, len(bands)))
    found = least(torch.from_numpy(spectra))
    assert found.isnan().nonzero().tolist() == [[0, 0], [1, 3]]
    np.testing.assert_allclose(found[1, 4:], angles[1, 4:].min(axis=-1), atol=1e-7)


@pytest.mark.parametrize(
    ("name", "error", "said"),
    [
        ("library:none.csv", ConfigError, "there is no file or folder none.csv with a library"),
        ("library:{}<4", ConfigError, "the largest angle must lie between 0 and 3.142 rad"),
        ("library:angle:{}<0.1", ConfigError, "the angle itself takes no threshold"),
        *(
            (f"absorption:{text}", ConfigError, r"must be absorption:\[depth\|centre\|area:\]LOW-HIGH in nm")
            for text in ("red", "width:450-650", "4.5.0-650")
        ),
        ("absorption:650-450", SpectrumError, "needs three bands or more from 650 to 450 nm"),
        ("absorption:500-560", SpectrumError, "from 500 to 560 nm, all of it covered"),
        ("absorption:450-2250", SpectrumError, "from 450 to 2250 nm, all of it covered"),
    ],
)
def test_a_map_that_makes_no_sense_is_refused(library, name, error, said):
    with pytest.raises(error, match=said):
        parse_reflectance_map(name.format(library), Bands.of(WAVELENGTHS_NM))


def test_what_lies_where_bands_were_left_out_is_refused():
    """Water takes 83 % away at 1400 nm: of the bands beside it alone 1 % would be found."""
    nm = np.arange(1000.0, 1701, 10)
    spectrum = torch.tensor(0.6 - 0.5 * np.exp(-(((nm - 1400) / 25) ** 2)))[None]
    whole = parse_reflectance_map("absorption:1300-1500", Bands.of(nm)).fit(spectrum)(spectrum)
    assert whole.item() == pytest.approx(0.5 / 0.6, abs=1e-3)
    lit = torch.tensor((nm < 1345) | (nm > 1455))
    bands = Bands.of(nm[lit.numpy()])
    for name in ("absorption:1300-1500", "absorption:area:1300-1500", "index:r1240/r1400"):
        with pytest.raises(SpectrumError, match="cover 995-1345, 1455-1705 nm"):
            parse_reflectance_map(name, bands)
    with pytest.raises(SpectrumError, match=r"with light from 1300 to 1500 nm, .* cover 995-1345, 1455"):
        parse_reflectance_map("absorption:1300-1500", Bands.of(nm), lit)
    assert parse_reflectance_map("absorption:1200-1340", bands).what.endswith("1200 to 1340 nm")


def test_reflectance_is_an_output_where_the_light_is_known_and_words_follow_the_light():
    lit, white, unknown = make_scene(light=LIGHT), make_scene(light=[1.0] * 5), make_scene()
    dim = make_scene(light=[0.7] * 5)  # flat, but a white is 0.7
    view = lit.look(CAMERA)
    seen = view.opacity >= 0.5
    expected = view["spectral"][seen] / view.opacity[seen][:, None] / torch.tensor(LIGHT)
    assert_close(view["reflectance"][seen], expected)
    assert view["reflectance"][~seen].isnan().all()
    words = [scene.materials.quantity for scene in (lit, white, dim, unknown)]
    assert words == ["radiance", "reflectance", "radiance", "radiance"]
    assert white.output("spectral").what.startswith("reflectance on black")
    assert white.output("band:500nm").what.startswith("reflectance of one band")
    assert lit.output("spectral").what.startswith("radiance on black")
    assert "of radiance, since the scene's light is unknown" in unknown.output("continuum").what
    assert "reflectance" not in [output.name for output in unknown.outputs]
    four_bands = make_scene(light=[0.0, 0.8, 1.0, 0.9, 0.6])  # fewer than a derivative takes
    assert not [one.name for one in four_bands.outputs if "derivative" in one.name]
    assert len(choose_formats(["all"], [], four_bands, is_path=False)) > 10
    with pytest.raises(SpectrumError, match="the scene's light is unknown, so that it has no reflectance"):
        unknown.output("reflectance")
