"""The distance from a prior's material, and the views that a prior gets."""

import torch

from tests.neumatex.object_factory import write_object
from unmix_plugin.neumatex import prior_anchor
from unmix_plugin.neumatex.prior_anchor import PriorAnchor, view_arrays, views_of
from unmix_plugin.neumatex.scene.load_object import load_object
from unmix_plugin.neumatex.triplane import Triplane


def test_the_distance_counts_each_parameter_by_its_expected_error():
    generator = torch.Generator().manual_seed(1)
    said, anchor = Triplane(5, 8, generator=generator), PriorAnchor(Triplane(5, 8, generator=generator))
    anchor.adopt(said)
    positions = 2 * torch.rand(7, 3, generator=generator) - 1
    parameters = torch.rand(7, 5, generator=generator, requires_grad=True)
    expected = torch.zeros(())
    for row in range(7):
        at = positions[row : row + 1]
        errors = (parameters[row] - said.parameters_at(at)[0]) ** 2
        expected = expected + (errors / said.log_variance(at)[0].exp()).sum() / 7
    found = anchor.distance(parameters, positions)
    torch.testing.assert_close(found, expected)
    found.backward()
    assert all(parameter.grad is None for parameter in anchor.parameters())
    assert float(anchor.distance(said.parameters_at(positions).detach(), positions)) < 1e-9


def test_views_for_a_prior_are_the_training_views_thinned_out(tmp_path, monkeypatch):
    scene = load_object(write_object(tmp_path / "ball"))
    monkeypatch.setattr(prior_anchor, "LONGEST_EDGE_PX", 12)
    views = views_of(view_arrays(scene))
    assert len(views.pictures) == len(scene.split.train) == 5
    assert views.pictures[0].shape == (12, 12, 3)
    whole, thin = scene.pictures.cameras[list(scene.split.train)], views.cameras
    points = scene.mesh.vertices[:20]
    full_px, small_px = whole.project(points, 3)[0], thin.project(points, 3)[0]
    torch.testing.assert_close((full_px - 0.5) / 2 + 0.5, small_px, atol=1e-4, rtol=0)
    middle = views.pictures[2][6, 6]
    torch.testing.assert_close(middle, torch.tensor([0.5, 0.3, 0.1]))
