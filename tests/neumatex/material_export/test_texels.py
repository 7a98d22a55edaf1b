"""Laws of atlases and of what their texels show."""

import numpy as np
import pytest

from tests.neumatex.material_export.surfaces import ball
from unmix_plugin.errors import ConfigError
from unmix_plugin.neumatex.material_export.atlas import Atlas, unwrap
from unmix_plugin.neumatex.material_export.texels import texels_of


def flat_atlas(uv, faces):
    return Atlas(np.arange(len(uv)), np.array(faces), np.array(uv, dtype=np.float32))


def areas_of(atlas):
    a, b, c = atlas.uv[atlas.faces].astype(np.float64).swapaxes(0, 1)
    return np.abs(np.linalg.det(np.stack([b - a, c - a], axis=1))) / 2


def test_charts_keep_every_triangle_and_lie_in_the_unit_square():
    mesh = ball()
    atlas = unwrap(mesh, 256)
    assert len(atlas.faces) == len(mesh.faces)
    np.testing.assert_array_equal(atlas.vertices[atlas.faces], mesh.faces.numpy())
    assert atlas.uv.min() >= 0
    assert atlas.uv.max() <= 1
    areas = areas_of(atlas)
    assert 0.3 < areas.sum() < 1
    assert (areas > 0).all()


def test_no_texel_lies_in_two_charts():
    atlas = unwrap(ball(), 256)
    texels = texels_of(atlas, 256)
    assert len(np.unique(texels.places)) == len(texels.places)
    assert len(texels.places) == pytest.approx(areas_of(atlas).sum() * 256**2, rel=0.02)


def test_texels_show_the_points_of_the_surface_that_their_centres_map_to():
    mesh, size = ball(3), 128
    atlas = unwrap(mesh, size)
    texels = texels_of(atlas, size)
    centres = np.stack([texels.places % size + 0.5, texels.places // size + 0.5], axis=1) / size
    np.testing.assert_allclose(texels.of_corners(atlas.uv, atlas.faces), centres, atol=1e-6)
    positions = texels.of_corners(mesh.vertices.numpy(), atlas.vertices[atlas.faces])
    radii = np.linalg.norm(positions, axis=1)
    assert radii.min() > 0.985
    assert radii.max() < 1 + 1e-6


def test_two_triangles_that_fill_the_square_have_all_texels_once():
    atlas = flat_atlas([[0, 0], [1, 0], [1, 1], [0, 1]], [[0, 1, 2], [0, 2, 3]])
    texels = texels_of(atlas, 32)
    np.testing.assert_array_equal(texels.places, np.arange(32 * 32))
    assert set(texels.triangles.tolist()) == {0, 1}
    np.testing.assert_allclose(texels.weights.sum(axis=1), 1, atol=1e-12)


def test_triangles_without_area_in_the_texture_have_no_texels():
    atlas = flat_atlas([[0.1, 0.1], [0.6, 0.6], [0.35, 0.35]], [[0, 1, 2]])
    assert len(texels_of(atlas, 64).places) == 0


def test_a_texture_has_the_values_of_its_texels_and_beyond_them_those_of_the_nearest():
    atlas = flat_atlas([[0, 0], [0.5, 0], [0.5, 1], [0, 1]], [[0, 1, 2], [0, 2, 3]])
    texels = texels_of(atlas, 8)
    rows = (texels.places // 8)[:, None].astype(np.float32)
    picture = texels.texture(rows)
    np.testing.assert_array_equal(picture[..., 0], np.repeat(np.arange(8.0)[:, None], 8, axis=1))


def test_triangles_are_found_whatever_chunks_they_are_looked_at_in(monkeypatch):
    atlas = unwrap(ball(), 64)
    whole = texels_of(atlas, 64)
    monkeypatch.setattr("unmix_plugin.neumatex.material_export.texels._CHUNK", 37)
    parts = texels_of(atlas, 64)
    np.testing.assert_array_equal(parts.places, whole.places)
    np.testing.assert_array_equal(parts.triangles, whole.triangles)


def test_without_xatlas_one_message_names_it(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    with pytest.raises(ConfigError, match="pip install xatlas"):
        unwrap(ball(1), 64)


def test_a_texture_too_small_for_the_charts_is_refused():
    with pytest.raises(ConfigError, match="--texture-size"):
        unwrap(ball(5), 16)
