"""Bundles of rays."""

import torch

from unmix_plugin.engine.geometry.space import RayBundle


def make_bundle(count: int) -> RayBundle:
    generator = torch.Generator().manual_seed(1)
    directions = torch.randn(count, 3, generator=generator)
    directions = directions / directions.norm(dim=-1, keepdim=True)
    return RayBundle(torch.randn(count, 3, generator=generator), directions, torch.arange(count))


def test_a_slice_keeps_origin_direction_and_camera_of_each_ray_together():
    bundle = make_bundle(7)
    part = bundle[2:5]
    assert len(part) == 3
    assert torch.equal(part.origins, bundle.origins[2:5])
    assert torch.equal(part.directions, bundle.directions[2:5])
    assert part.camera_indices.tolist() == [2, 3, 4]


def test_an_index_tensor_picks_rays_in_its_order_and_a_mask_keeps_theirs():
    bundle = make_bundle(5)
    assert bundle[torch.tensor([4, 0, 4])].camera_indices.tolist() == [4, 0, 4]
    assert bundle[torch.tensor([True, False, False, True, False])].camera_indices.tolist() == [0, 3]


def test_an_empty_bundle_has_length_zero():
    assert len(make_bundle(4)[:0]) == 0


def test_moving_to_a_device_keeps_the_values():
    bundle = make_bundle(3)
    moved = bundle.to("cpu")
    assert torch.equal(moved.origins, bundle.origins)
    assert moved.camera_indices.dtype == torch.int64


def test_joined_bundles_are_one_after_the_other():
    bundle = make_bundle(5)
    joined = RayBundle.join([bundle[:2], bundle[2:]])
    assert torch.equal(joined.origins, bundle.origins)
    assert torch.equal(joined.directions, bundle.directions)
    assert torch.equal(joined.camera_indices, bundle.camera_indices)
    assert joined.axes is None
