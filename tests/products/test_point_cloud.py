"""Points of the surface: cleaned and thinned, with normals and scores, in a file."""

import sys
from dataclasses import replace
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from plyfile import PlyData
from scipy.spatial import KDTree

from tests.factories.ball_model import ALL_ROUND, RADIUS, ball_scene, seen_surface
from tests.factories.cameras import FRAME
from tests.factories.models import WAVELENGTHS_NM, make_model
from unmix_plugin.errors import ConfigError, RunError, SpectrumError
from unmix_plugin.products.point_cloud import (
    even_cover,
    export,
    point_scores,
    write_point_cloud,
)
from unmix_plugin.products.product import Job
from unmix_plugin.products.scene_products import PointCloud
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import linear_to_srgb, rgb_matrix
from unmix_plugin.spectral.library.spectra_csv import SpectraTable, write_spectra_csv
from unmix_plugin.trained.surface import SurfacePoints, property_names


def sphere(count: int, seed: int = 0) -> np.ndarray:
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def ends(positions: np.ndarray, towards: np.ndarray | None = None) -> SurfacePoints:
    """Ends of rays at some places, seen from where unit vectors point; from outside if none are given."""
    seen_from = torch.from_numpy(positions if towards is None else towards)
    one = torch.ones(len(positions), 1)
    return SurfacePoints(torch.from_numpy(positions).float(), -seen_from.float(), one, one)


def test_lone_points_are_told_from_a_surface():
    lone = np.array([[3.0, 0.0, 0.0], [0.0, -2.0, 0.0]])
    kept, _ = even_cover(ends(np.concatenate([sphere(2000), lone])), 5000)
    assert kept.positions.norm(dim=1).max() < 1.01
    assert len(kept) >= 1980
    for count in (1, 8):  # company enough
        assert len(even_cover(ends(sphere(count)), 10)[0]) == count


@given(st.integers(1, 400), st.integers(1, 500))
def test_thinning_gives_distinct_points_and_never_more_than_asked_for(count, wanted):
    points = ends(sphere(count, seed=count))
    kept, normals = even_cover(points, wanted)
    assert len(kept.positions.unique(dim=0)) == len(kept) == len(normals)
    assert 1 <= len(kept) <= wanted
    if count <= wanted:
        assert len(kept) >= 0.95 * count


def test_thinning_covers_evenly_what_was_seen_unevenly():
    dense = sphere(40_000)
    dense = dense[dense[:, 2] > 0.5]
    positions = np.concatenate([sphere(20_000, seed=1), dense])
    kept = even_cover(ends(positions), 1000)[0].positions.numpy()
    assert len(kept) > 900
    gaps, _ = KDTree(kept).query(positions)
    ideal = np.sqrt(4 * np.pi / 1000)
    assert gaps.max() < 1.6 * ideal
    upper = (kept[:, 2] > 0.5).mean()
    assert upper == pytest.approx(0.25, abs=0.03)
    assert len(even_cover(ends(np.zeros((50, 3)), sphere(50)), 10)[0]) == 1


def test_normals_of_a_sphere_are_its_radii_and_face_the_viewer():
    kept, outwards = even_cover(ends(sphere(5000)), 5000)
    positions = kept.positions.double().numpy()
    same, inwards = even_cover(ends(sphere(5000), -sphere(5000)), 5000)
    np.testing.assert_allclose(np.linalg.norm(outwards, axis=1), 1, atol=1e-9)
    assert (outwards * positions).sum(axis=1).min() > 0.98
    np.testing.assert_array_equal(same.positions, kept.positions)
    np.testing.assert_allclose(inwards, -outwards)
    towards = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])  # where there is no plane, the viewer's direction
    np.testing.assert_allclose(even_cover(ends(0 * towards, towards), 2)[1], towards)


BANDS = Bands.of(WAVELENGTHS_NM)
LIGHT = [0.2, 0.4, 0.6, 0.8, 1.0]
PAINT = torch.tensor([0.1, 0.2, 0.5, 0.7, 0.8])


@pytest.fixture
def paint(tmp_path):
    path = tmp_path / "my paint.csv"
    write_spectra_csv(path, SpectraTable(BANDS, ("gold",), PAINT[None].double().numpy()))
    return path


def test_named_indices_keep_their_names_and_the_rest_is_numbered(paint):
    outputs = ("index:r650/r450", "index:PRI", "index:iron-oxide", "index:1+r450", f"target:ace:{paint}")
    outputs += ("index: PRI", "index:r650/r450")  # asked for twice
    names = [score.property for score in point_scores(outputs, BANDS)]
    assert names == ["index_1", "index_pri", "index_iron_oxide", "index_2", "target_1"]


def test_a_target_is_judged_against_the_points_themselves(paint):
    (score,) = point_scores([f"target:mf:{paint}"], BANDS)
    others = 0.3 + 0.05 * torch.randn(400, 5, generator=torch.Generator().manual_seed(0))
    values = score.values(torch.cat([others, PAINT[None]]), None)
    assert values[-1] == pytest.approx(1.0, abs=1e-4)
    assert abs(values.mean()) < 1e-4  # scores are taken from the mean of the points


def test_a_comment_says_what_a_property_is_and_whether_the_light_was_known():
    formula, named = point_scores(["index:r650/r450", "index:pri"], BANDS)
    unknown, known = make_model().materials, make_model(light=LIGHT).materials
    [said] = formula.comments(known)
    assert said == "index_1: index:r650/r450, formula r650/r450, from the bands at 450, 650 nm"
    assert formula.comments(unknown) == [f"{said}; of radiance, since the scene's light is unknown"]
    assert named.comments(known)[0].startswith("index_pri: index:pri, photochemical reflectance index")


@pytest.mark.parametrize("output", ["rgb", "band:650nm", "index", "index:", "target:", "ndvi", ""])
def test_other_outputs_are_refused_with_what_points_take(output):
    with pytest.raises(ConfigError, match=f"--outputs {output}: points take spectral indices, index:NAME"):
        point_scores(["index:pri", output], BANDS)


def test_what_cannot_be_computed_or_shows_nothing_is_refused(points, tmp_path):
    for output, error, message in (
        ("index:prri", ConfigError, "there is no index 'prri'; nearest: pri"),
        ("index:ndvi", SpectrumError, "needs 800 nm"),
        ("target:none.csv", ConfigError, "none.csv"),
    ):
        with pytest.raises(error, match=message):
            point_scores([output], BANDS)
    for count in (0, -3, 10_000_001):
        with pytest.raises(ConfigError, match=f"--num-points is {count}; choose 1 to 10000000"):
            export(MagicMock(spec=Job, materials=SCENE.materials), PointCloud(num_points=count))
    nothing = points.select(torch.zeros(len(points), dtype=torch.bool))
    with pytest.raises(RunError, match="no ray of the run's cameras ends on a surface"):
        write_point_cloud([tmp_path / "points.ply"], nothing, 800, SCENE, FRAME)
    assert list(tmp_path.iterdir()) == []


SCENE = ball_scene()


@pytest.fixture(scope="module")
def points():
    return seen_surface(SCENE, ALL_ROUND, 12_000).points()


@pytest.fixture(scope="module")
def cloud(points, tmp_path_factory):
    path = tmp_path_factory.mktemp("cloud") / "points.ply"
    count = write_point_cloud([path], points, 800, SCENE, FRAME)
    return PlyData.read(path), count


def columns(cloud, names):
    known = {one.name.removeprefix("scalar_"): one.name for one in cloud["vertex"].properties}
    return np.stack([np.asarray(cloud["vertex"][known[name]]) for name in names], axis=1)


def test_points_are_in_the_world_of_the_scene_with_unit_normals_out_of_the_surface(cloud):
    ply, count = cloud
    assert 600 < count == ply["vertex"].count <= 800
    what, world, size, *materials, scalars = ply.comments
    assert what == "surface points of an unmix-nerf run"
    assert "coordinates: world of the given poses, or of transforms.json if they were estimated" in world
    assert size == "lengths are in units of the scene, of unknown size"
    assert materials == [f"material id {index}: {name}" for index, name in enumerate(SCENE.materials.names)]
    assert scalars == "properties scalar_NAME: the numbers that are called NAME here"
    outwards = columns(ply, "xyz") - FRAME.to_world(np.zeros(3))
    radii = np.linalg.norm(outwards, axis=1, keepdims=True)
    np.testing.assert_allclose(radii, RADIUS / FRAME.scale, atol=0.02 / FRAME.scale)
    normals = columns(ply, ("nx", "ny", "nz"))
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)
    assert (normals * outwards / radii).sum(axis=1).min() > 0.9


def test_each_point_has_material_abundances_and_the_colour_of_its_diffuse_spectrum(cloud):
    ply, _ = cloud
    names = property_names(SCENE.materials.names)
    shares = columns(ply, names)
    assert shares.dtype == np.float32
    np.testing.assert_allclose(shares.sum(axis=1), 1, atol=1e-5)
    height = FRAME.to_model(columns(ply, "xyz").astype(np.float64))[:, 2]
    material = np.asarray(ply["vertex"]["scalar_material"])
    assert (material[height > 0.05] == 0).all()
    assert (material[height < -0.05] == 1).all()
    top = np.flatnonzero(shares[:, 0] == 1)[0]
    spectrum = 0.8 * SCENE.materials.endmembers[0].detach().double()
    linear = (spectrum @ rgb_matrix(SCENE.bands, torch.float64)).clamp(0, 1)
    expected = 255 * linear_to_srgb(linear).numpy()
    np.testing.assert_allclose(columns(ply, ("red", "green", "blue"))[top], expected, atol=1)


def test_indices_targets_and_nearest_spectra_are_written_for_each_point(points, tmp_path):
    spectra = SCENE.materials.endmembers.detach().double().numpy()
    write_spectra_csv(tmp_path / "top.csv", SpectraTable(SCENE.bands, ("top",), spectra[:1]))
    write_spectra_csv(tmp_path / "two.csv", SpectraTable(SCENE.bands, ("moss", "red clay"), spectra[[1, 0]]))
    asked = ["index:r650/r500", "index:pri", f"target:{tmp_path / 'top.csv'}<0.1"]
    asked += [f"library:{tmp_path / 'two.csv'}<0.1"]
    scores = point_scores(asked, SCENE.bands)
    path = tmp_path / "points.ply"
    count = write_point_cloud([path], points, 300, SCENE, FRAME, scores)
    ply = PlyData.read(path)
    written = [one.name.removeprefix("scalar_") for one in ply["vertex"].properties[-4:]]
    assert written == ["index_1", "index_pri", "target_1", "library_1"]
    found = columns(ply, written)
    assert found.dtype == np.float32
    assert found.shape == (count, 4)
    shares = columns(ply, property_names(SCENE.materials.names))
    seen = shares @ spectra
    np.testing.assert_allclose(found[:, 0], seen[:, 4] / seen[:, 1], rtol=1e-4)
    material = np.asarray(ply["vertex"]["scalar_material"])
    pure = shares.max(axis=1) > 0.999
    np.testing.assert_array_equal(found[pure, 2], material[pure] == 0)
    known = pure & (material < 2)
    np.testing.assert_array_equal(found[known, 3], 1 - material[known])
    assert "index_1: index:r650/r500, formula r650/r500" in ply.comments[-7]
    assert ply.comments[-7].endswith("of radiance, since the scene's light is unknown")
    assert ply.comments[-3:-1] == ["library_1 0: moss", "library_1 1: red clay"]


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_las_has_the_numbers_of_ply_with_all_bands_and_abundances(suffix, points, tmp_path):
    laspy = pytest.importorskip("laspy")
    if suffix == "laz":
        pytest.importorskip("lazrs")
    paths = [tmp_path / "points.ply", tmp_path / f"points.{suffix}"]
    light = torch.linspace(0.5, 1, len(BANDS))
    lit = replace(SCENE, materials=replace(SCENE.materials, light=light))
    count = write_point_cloud(paths, points, 300, lit, FRAME, (), "reflectance")
    ply, las = PlyData.read(str(paths[0]))["vertex"].data, laspy.read(paths[1])
    assert len(las.points) == len(ply) == count
    position = np.stack([ply[axis] for axis in "xyz"], axis=1)
    np.testing.assert_allclose(las.xyz, position, atol=1e-6 * np.ptp(position))
    np.testing.assert_array_equal(np.asarray(las.red) // 257, ply["red"])
    names = {name for name in ply.dtype.names if name not in ("x", "y", "z", "red", "green", "blue")}
    # CloudCompare opens extra dimensions of LAS as they are, and of PLY what is called scalar_NAME, as NAME.
    numbers = {name for name in names if name not in ("nx", "ny", "nz")}
    assert all(name.startswith("scalar_") for name in numbers)
    assert set(las.point_format.extra_dimension_names) == {name.removeprefix("scalar_") for name in names}
    bands = [f"scalar_reflectance_{nm:g}nm" for nm in BANDS.centers_nm]
    assert set(bands) < names
    for name in names:
        np.testing.assert_array_equal(np.asarray(las[name.removeprefix("scalar_")]), ply[name])
    shares = np.stack([ply[name] for name in ply.dtype.names if name.startswith("scalar_abundance_")], axis=1)
    scene = lit.materials.endmembers.numpy() / light.numpy()
    found = np.stack([ply[name] for name in bands], axis=1)
    angles = (
        (found * (shares @ scene)).sum(1)
        / np.linalg.norm(found, axis=1)
        / np.linalg.norm(shares @ scene, axis=1)
    )
    assert angles.min() > 0.9999  # reflectance is the mixture, but for its shading


def test_reflectance_of_points_needs_a_light_and_formats_their_package(tmp_path, monkeypatch):
    job = MagicMock(spec=Job, materials=replace(SCENE.materials, light=None), folder=tmp_path)
    with pytest.raises(ConfigError, match="--spectra reflectance needs the light of the scene"):
        export(job, PointCloud(spectra="reflectance"))
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(ConfigError, match=r"isn't installed .* pip install"):
        export(job, PointCloud(formats=("las",)))
