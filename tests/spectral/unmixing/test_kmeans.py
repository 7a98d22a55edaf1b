import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from tests.factories.mixtures import seeded, smooth_endmembers
from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.metrics import spectral_angle
from unmix_plugin.spectral.unmixing.kmeans_normalised import normalised_kmeans, scale_to_lit_pixels


def shaded_clusters(num_clusters, per_cluster=60, seed=0, noise=0.01):
    """Pixels of each material under random shading, cluster after cluster, and the materials."""
    materials = smooth_endmembers(num_clusters)
    ids = torch.arange(num_clusters).repeat_interleave(per_cluster)
    shading = 0.05 + 0.95 * torch.rand(len(ids), 1, dtype=torch.float64, generator=seeded(seed))
    pixels = materials[ids]
    pixels += noise * torch.randn(pixels.shape, dtype=torch.float64, generator=seeded(seed + 1))
    return pixels.clamp(min=1e-3) * shading, ids, materials


def same_partition(a, b):
    return len({*zip(a.tolist(), b.tolist(), strict=True)}) == len(a.unique()) == len(b.unique())


@given(st.integers(1, 7), st.integers(0, 500))
def test_materials_are_told_apart_under_any_shading(num_clusters, seed):
    pixels, ids, materials = shaded_clusters(num_clusters, seed=seed)
    found, clusters = normalised_kmeans(pixels, num_clusters, seeded(seed))
    assert same_partition(clusters, ids)
    angles = spectral_angle(found[:, None], materials[None]).amin(1)
    assert float(angles.max()) < 0.01


@given(st.integers(0, 500))
def test_gains_change_neither_clusters_nor_shapes(seed):
    pixels, _, _ = shaded_clusters(4, seed=seed, noise=0.1)
    gains = 10 ** (4 * torch.rand(len(pixels), 1, dtype=torch.float64, generator=seeded(seed)) - 2)
    plain, scaled = (normalised_kmeans(p, 4, seeded(seed)) for p in (pixels, gains * pixels))
    assert torch.equal(plain[1], scaled[1])
    assert float(spectral_angle(plain[0], scaled[0]).max()) < 1e-6


def test_every_pixel_is_with_its_nearest_centre_and_centres_are_mean_shapes():
    pixels = torch.rand(400, 6, dtype=torch.float64, generator=seeded(3)) + 0.01
    found, clusters = normalised_kmeans(pixels, 5, seeded(3))
    shapes = torch.nn.functional.normalize(pixels, dim=1)
    centres = torch.stack([shapes[clusters == k].mean(0) for k in range(5)])
    centres = torch.nn.functional.normalize(centres, dim=1)
    assert_close(torch.nn.functional.normalize(found, dim=1), centres)
    assert torch.equal((shapes @ centres.T).argmax(1), clusters)


@pytest.mark.parametrize(
    ("spectra", "pixels", "expected"),
    [
        ([[0.6, 0.8]], [[3.0, 4.0]], [[0.75, 1.0]]),  # stops where a band would pass 1
        ([[0.1, 0.2], [0.3, 0.1]], [[0.2, 0.4]], [[0.2, 0.4], [0.3, 0.1]]),  # one has no pixels
    ],
)
def test_spectra_are_scaled_to_lit_pixels_and_keep_their_shape(spectra, pixels, expected):
    shapes, lit, scaled = (torch.tensor(x, dtype=torch.float64) for x in (spectra, pixels, expected))
    assert_close(scale_to_lit_pixels(shapes, lit, torch.tensor([0])), scaled)
    shape = torch.tensor([0.6, 0.8, 0.0], dtype=torch.float64)
    pixels = torch.linspace(0.01, 0.81, 101, dtype=torch.float64)[:, None] * shape
    assert_close(normalised_kmeans(pixels, 1, seeded())[0][0], 0.77 * shape)


def test_every_cluster_has_a_pixel_even_when_there_are_as_many_as_shapes_and_the_largest_comes_first():
    pixels = torch.eye(5) * torch.tensor([0.1, 0.2, 0.3, 0.4, 0.5])[:, None]
    counts = torch.tensor([3, 3, 5, 4, 3])
    _, clusters = normalised_kmeans(pixels.repeat_interleave(counts, 0), 5, seeded())
    assert torch.bincount(clusters).tolist() == [5, 4, 3, 3, 3]
    assert same_partition(clusters, torch.arange(5).repeat_interleave(counts))


def test_shapes_that_differ_only_in_brightness_are_one_and_zero_spectra_refused():
    pixels = torch.linspace(0.1, 0.9, 30)[:, None] * torch.tensor([0.3, 0.7, 0.2])
    with pytest.raises(SpectrumError, match="only 1 distinct spectral shapes among 30 pixels: 2 endmembers"):
        normalised_kmeans(pixels, 2, seeded())
    with pytest.raises(SpectrumError, match="non-zero length; found 1 that are zero"):
        normalised_kmeans(torch.tensor([[0.0, 0.0], [0.1, 0.2]]), 1, seeded())
