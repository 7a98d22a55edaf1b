"""Where a fit begins: the distance from the prior, its views, materials of a run, the plain material."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from tests.factories.ball_model import RADIUS, ball_scene
from tests.factories.objects import SIZE, pose, write_object
from tests.factories.surfaces import generator, unit
from unmix_plugin.errors import ConfigError
from unmix_plugin.neumatex.fit import data_manager
from unmix_plugin.neumatex.fit.data_manager import view_arrays
from unmix_plugin.neumatex.fit.model import prior_distance
from unmix_plugin.neumatex.fit.object_scene import load_object
from unmix_plugin.neumatex.fit.start import RunMaterials, start_plain, views_of
from unmix_plugin.neumatex.tracing.families import PbrFamily
from unmix_plugin.neumatex.tracing.neural import NeuralFamily
from unmix_plugin.neumatex.tracing.surface import Triplane, TriplaneSurface
from unmix_plugin.spectral.bands import Bands


def test_theprior_distance_counts_each_parameter_by_its_expected_error():
    drawn = generator(1)
    said = Triplane(5, 8, generator=drawn).requires_grad_(False)
    positions = 2 * torch.rand(7, 3, generator=drawn) - 1
    parameters = torch.rand(7, 5, generator=drawn, requires_grad=True)
    errors = (parameters - said.parameters_at(positions)) ** 2
    expected = (errors / said.log_variance(positions).exp()).sum() / 7
    found = prior_distance(said, parameters, positions)
    assert_close(found, expected)
    found.backward()
    assert float(prior_distance(said, said.parameters_at(positions).detach(), positions)) < 1e-9


def test_views_for_a_prior_are_the_training_views_thinned_out(tmp_path, monkeypatch):
    scene = load_object(write_object(tmp_path / "ball"))
    monkeypatch.setattr(data_manager, "LONGEST_EDGE_PX", 12)
    views = views_of(view_arrays(scene))
    assert len(views.pictures) == len(scene.split.train) == 5
    assert views.pictures[0].shape == (12, 12, 3)
    whole, thin = scene.pictures.cameras[list(scene.split.train)], views.cameras
    points = scene.mesh.vertices[:20]
    full_px, small_px = whole.project(points, 3)[0], thin.project(points, 3)[0]
    assert_close((full_px - 0.5) / 2 + 0.5, small_px, atol=1e-4, rtol=0)
    assert_close(views.pictures[2][6, 6], torch.tensor([0.5, 0.3, 0.1]))


def test_views_for_a_prior_are_of_frame_cameras_alone(tmp_path):
    path = write_object(tmp_path / "ball") / "transforms.json"
    content = json.loads(path.read_text())
    for index, left in ((1, 4), (None, 0)):  # one line camera that goes round the ball, then no other view
        for frame in content["frames"][index : index and index + 1]:
            keys = [{"row": row, "transform_matrix": pose(row / SIZE).tolist()} for row in (0, SIZE - 1)]
            frame |= {"transform_matrix": None, "key_poses": keys}
        path.write_text(json.dumps(content))
        arrays = view_arrays(load_object(path.parent))
        assert sum(name.endswith("_pose") for name in arrays) == left
    with pytest.raises(ConfigError, match=r"choose --pipeline\.model\.prior none"):
        views_of(arrays)


RUN = RunMaterials(Path("run"), ball_scene())
TURN = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
SCALE, SHIFT = 0.5, np.array([0.3, -0.1, 0.2])


def _corners(scale=SCALE):
    """Of a model space in which the run's space is turned, scaled and shifted."""
    of_mesh = np.concatenate([np.zeros((1, 3)), np.eye(3)])
    return RUN.scene.frame.to_world((of_mesh * scale) @ TURN + SHIFT)


def _points(count=200):
    """Points and normals of the run's ball, in that model space."""
    outwards = unit(torch.randn(count, 3, generator=generator()))
    of_run = RADIUS * outwards.double().numpy()
    positions = torch.from_numpy((of_run - SHIFT) @ TURN.T / SCALE).float()
    return positions, torch.from_numpy(outwards.double().numpy() @ TURN.T).float(), outwards


def test_abundances_are_those_of_the_runs_surface_at_the_same_place_in_the_world():
    positions, normals, outwards = _points()
    shares = RUN.abundances(positions, normals, _corners())
    clear = outwards[:, 2].abs() > 0.1
    assert_close(shares[clear, 0], (outwards[clear, 2] > 0).float(), atol=0.02, rtol=0)
    assert_close(shares.sum(dim=1), torch.ones(len(shares)))

    with pytest.raises(ConfigError, match="of the mesh's surface only"):
        RUN.abundances(positions, normals, _corners(scale=3.0))


def test_endmembers_become_reflectances_by_the_light_and_those_of_other_bands_or_numbers_are_refused():
    materials = RUN.scene.materials
    own, lamp = materials.bands, np.linspace(0.5, 1.0, len(materials.bands))
    light = torch.from_numpy(lamp).float() if materials.light is None else materials.light
    assert_close(RUN.reflectances(own, lamp, 3) * light, materials.endmembers.detach())
    for bands, count, said in ((Bands.of([400, 500]), 3, "must be the same"), (own, 4, "num-endmembers is")):
        with pytest.raises(ConfigError, match=said):
            RUN.reflectances(bands, np.ones(len(bands)), count)


@pytest.mark.parametrize("family", [NeuralFamily(), PbrFamily()])
def test_a_new_triplane_is_grey_and_reflects_as_what_is_no_metal(family):
    drawn = generator(2)
    triplane = Triplane(family.num_parameters, 16, generator=drawn)
    start_plain(triplane, family)
    positions = 2 * torch.rand(200, 3, generator=drawn) - 1
    parameters = TriplaneSurface(family, triplane).parameters(positions).detach()
    assert family.base_colour(parameters).sub(0.5).abs().mean() < 0.1
    up = torch.tensor([[0.0, 0.0, 1.0]]).expand(200, 3)
    side = unit(torch.tensor([[0.7, 0.0, 1.0]])).expand(200, 3)
    reflectance = family.evaluate(parameters, side, up)
    dark = torch.cat([torch.full((200, 3), 0.02), parameters[:, 3:]], dim=-1)
    # Nearly all of it is the base colour's: a metal's highlight would not go with it.
    assert family.evaluate(dark, side, up).mean() < 0.35 * reflectance.mean()
