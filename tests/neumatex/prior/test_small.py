"""The small prior: what it looks at, planes, training steps, prediction from pictures, and its weights on disk."""

import math
from dataclasses import replace

import pytest
import torch
import trimesh
from torch.testing import assert_close

from tests.factories.surfaces import ball, generator, mesh_from, unit
from tools import prior_objects, train_prior
from unmix_plugin.errors import RunError, SceneError
from unmix_plugin.neumatex.demo.objects import viewpoints
from unmix_plugin.neumatex.prior import observations, small
from unmix_plugin.neumatex.prior.small import Estimates, SmallPrior
from unmix_plugin.neumatex.tracing.environment import Environment, directions_of_pixels
from unmix_plugin.neumatex.tracing.rays import RayMesh, SurfacePoints
from unmix_plugin.neumatex.tracing.surface import Readers, Triplane, plane_features


def test_of_a_ring_the_views_taken_are_evenly_spread():
    angles = torch.arange(12) * (2 * torch.pi / 12)
    positions = torch.stack([angles.cos(), angles.sin(), torch.zeros(12)], dim=-1) * 3
    assert observations.well_spread(positions, 4) == [0, 3, 6, 9]
    coinciding = observations.well_spread(torch.ones(5, 3), 4)
    assert coinciding == sorted(set(coinciding))
    assert observations.well_spread(torch.eye(3), 12) == [0, 1, 2]


far = torch.tensor([0.0, 0.0, -50.0])


def light_at(normals: torch.Tensor, eyes: torch.Tensor, light: Environment) -> observations.Observations:
    """What is known of the light at places that nothing hides, by the normals there."""
    points = SurfacePoints(torch.zeros(len(normals), 3), normals, normals, normals)
    return observations.known_light(points, eyes, RayMesh(ball(1).transformed(0.01, far)), light, generator())


def test_the_irradiance_of_a_bright_half_follows_the_cosine():
    image = (directions_of_pixels(64, 128)[..., 2:] > 0).float().expand(64, 128, 3)
    tilts = torch.tensor([0.0, 60.0, 90.0, 180.0]).deg2rad()
    normals = torch.stack([tilts.sin(), torch.zeros(4), tilts.cos()], dim=-1)
    known = light_at(normals, 10 * normals, Environment(image, exposure_stops=1.0))
    # The irradiance under a hemisphere of radiance 1 is pi (1 + cos tilt) / 2; its mean over the sphere is 0.5.
    assert_close(known.irradiance[:, 0], 1 + tilts.cos(), atol=0.02, rtol=0)


@pytest.mark.parametrize("turn", [0.0, 70.0])
def test_a_spot_is_widened_more_by_blunter_lobes_and_turns_with_the_light(turn):
    angle, image = math.radians(turn), torch.zeros(64, 128, 3)
    spot = torch.tensor([math.cos(angle), math.sin(angle), 0.0])
    image[31:33, 63:65] = 100.0  # the picture's centre is +x before the turn
    ways = torch.stack([spot, -spot])
    lobes = light_at(ways, 10 * ways, Environment(image, turn)).mirrored[..., 0]
    at_spot, opposite = lobes[0, 0], lobes[1, 1]  # each mirrored straight back to its own eye
    assert lobes.shape[-1] == observations.NUM_LOBES
    assert (at_spot[:-1] > 2 * at_spot[1:]).all()
    assert (opposite[:-1] < 1e-6 * at_spot[0]).all()


def sphere() -> RayMesh:
    return RayMesh(ball(4))


def even_light() -> Environment:
    return Environment(torch.full((32, 64, 3), 3.0))


def test_points_of_a_sphere_lie_on_it_evenly():
    points = observations.sample_surface(sphere().mesh, 4000, generator())
    assert_close(points.positions.norm(dim=-1), torch.ones(4000), atol=3e-3, rtol=0)
    assert_close(points.normals, points.positions, atol=0.01, rtol=0)
    assert points.positions.mean(dim=0).abs().max() < 0.04
    # Bands of a sphere of the same height have the same area.
    assert_close(points.positions[:, 2].histc(5, -1, 1), torch.full((5,), 800.0), atol=100, rtol=0)


def test_a_camera_sees_the_facing_half_of_a_sphere_which_nothing_shadows_and_light_is_in_units_of_its_mean():
    ray_mesh = sphere()
    points = observations.sample_surface(ray_mesh.mesh, 500, generator())
    eyes = torch.tensor([[50.0, 0.0, 0.0], [0.0, 0.0, -50.0]])
    known = observations.known_light(points, eyes, ray_mesh, even_light(), generator())
    along = torch.stack([points.positions[:, 0], -points.positions[:, 2]], dim=-1)
    assert known.visible[along > 0.15].all()
    assert not known.visible[along < 0.05].any()
    assert_close(known.cosines, along.clamp(0, 1), atol=0.03, rtol=0)
    assert_close(known.irradiance, torch.ones(500, 3), atol=1e-4, rtol=0)
    assert known.unshadowed.min() > 0.97
    mirrored = known.mirrored[known.visible]
    assert_close(mirrored, torch.ones_like(mirrored), atol=1e-4, rtol=0)
    assert (known.mirror_open[known.visible] == 1).all()


def test_a_wall_hides_points_behind_it_and_halves_the_light_at_its_foot():
    floor = trimesh.creation.box((2.0, 2.0, 0.02))
    wall = trimesh.creation.box((0.02, 2.0, 40.0))
    wall.apply_translation((-0.2, 0.0, 20.0))
    ray_mesh = RayMesh(mesh_from(floor, wall))
    points = observations.sample_surface(mesh_from(floor), 3000, generator())
    at_foot = (points.normals[:, 2] > 0.5) & (points.positions[:, 0].abs() < 0.19)
    at_foot &= (points.positions[:, 0] > -0.18) & (points.positions[:, 1].abs() < 0.3)
    points = points.select(at_foot)
    eyes = torch.tensor([[-9.0, 0.0, 5.0], [9.0, 0.0, 5.0]])
    known = observations.known_light(points, eyes, ray_mesh, even_light(), generator())
    assert len(points.positions) > 20
    assert not known.visible[:, 0].any()
    assert known.visible[:, 1].all()
    # A wall in front of half the sky takes nearly half of the irradiance.
    assert abs(float(known.unshadowed.mean()) - 0.55) < 0.06
    # Seen from the right, the mirrored direction runs into the wall.
    assert (known.mirror_open[:, 1] == 0).all()


def made_of(lobe: int):
    """Colours of 30 points in 12 views: an albedo times the light that reaches them, and a share of one lobe."""
    g = generator()
    mirrored = 2 * torch.rand(30, 12, observations.NUM_LOBES, 3, generator=g)
    reaching, albedo = 0.5 + torch.rand(30, 3, generator=g), torch.rand(30, 3, generator=g)
    share = 0.2 + 0.5 * torch.rand(30, 3, generator=g)
    colours = (albedo * (reaching + 0.02))[:, None] + share[:, None] * mirrored[:, :, lobe]
    return colours, mirrored, reaching, albedo, share


def lobe_fits(colours, mirrored, visible, reaching) -> torch.Tensor:
    """Of each point and lobe: shares and albedo of the three colours, and what is left of the variance."""
    none = torch.zeros(30, 3)
    o = observations.Observations(
        positions=none,
        colours=colours,
        visible=visible,
        cosines=torch.zeros(visible.shape),
        mirrored=mirrored,
        mirror_open=torch.ones(visible.shape),
        irradiance=reaching,
        unshadowed=none + 1,
    )
    return observations.point_features(o.alone())[0, :, -7 * observations.NUM_LOBES :].unflatten(-1, (-1, 7))


EVERY = torch.ones(30, 12, dtype=torch.bool)


def test_a_fit_finds_albedo_and_share_and_leaves_nothing_only_for_the_right_lobe():
    colours, mirrored, reaching, albedo, share = made_of(lobe=2)
    fits = lobe_fits(colours, mirrored, EVERY, reaching)
    found_share, found_albedo, left = fits[:, 2].split((3, 3, 1), dim=-1)
    # The ridge of the fit makes shares a little small, most where the light happens to vary little.
    assert_close(found_share, share, atol=0.15, rtol=0)
    assert_close(found_albedo, albedo, atol=0.2, rtol=0)
    assert left.max() < 0.05
    assert fits[:, [0, 1, 3], 6].mean() > 0.5


def estimates(log_variance: float = -6.0) -> Estimates:
    """A material that changes smoothly over a sphere."""
    positions = unit(torch.randn(1, 300, 3, generator=generator()))
    parameters = (0.5 + 0.3 * torch.sin(2 * positions)).repeat(1, 1, 2)[..., :5]
    return Estimates(positions, parameters, torch.full((1, 300, 5), log_variance))


def readers() -> Readers:
    return Readers(5, generator=generator(1))


def test_a_fit_moves_the_planes_to_what_is_said_and_leaves_the_readers():
    said, networks = estimates(), readers()
    before = [parameter.clone() for parameter in networks.parameters()]
    planes = small.fit_planes(networks, said, steps=120)
    assert planes.shape == (1, 3, 12, small.RESOLUTION, small.RESOLUTION)
    assert not planes.requires_grad
    features = plane_features(planes[0], said.positions[0])
    with torch.no_grad():
        assert (networks.material(features) - said.parameters[0]).square().mean().sqrt() < 0.05
        # From 1.5 and more; these readers were never trained.
        assert (networks.log_variance(features) + 6.0).abs().mean() < 1.2
    for parameter, old in zip(networks.parameters(), before, strict=True):
        assert torch.equal(parameter, old)


def test_points_that_are_sure_count_more():
    said, networks = estimates(), readers()
    planes = torch.zeros(1, 3, 12, small.RESOLUTION, small.RESOLUTION)
    moved, unsure = said.parameters.clone(), said.log_variance.clone()
    moved[:, 0] = unsure[:, 0] = 0.0
    sure_loss, unsure_loss = (
        small.fit_loss(networks, planes, Estimates(said.positions, moved, variance))
        - small.fit_loss(networks, planes, Estimates(said.positions, said.parameters, variance))
        for variance in (said.log_variance, unsure)
    )
    assert_close(unsure_loss, sure_loss * math.exp(-3), rtol=1e-3, atol=1e-7)


def test_objects_are_fitted_apart():
    said, networks = estimates(), readers()
    both = Estimates(*(torch.cat([part, part.flip(1) * 0.9]) for part in vars(said).values()))
    alone = small.fit_planes(networks, said, steps=10)
    together = small.fit_planes(networks, both, steps=10)
    assert_close(together[:1], alone, atol=2e-3, rtol=0)


def make_prior() -> SmallPrior:
    torch.manual_seed(0)
    return SmallPrior()


@pytest.fixture(scope="module")
def prior():
    """One that no test changes."""
    return make_prior()


@pytest.fixture(scope="module")
def objects(tmp_path_factory) -> prior_objects.TrainingObjects:
    """Read from two files, in half precision."""
    folder = tmp_path_factory.mktemp("objects")
    made = [prior_objects.training_object(seed, num_points=64, num_views=4, samples=4) for seed in range(4)]
    prior_objects.write_objects(folder / "first.safetensors", made[:2])
    prior_objects.write_objects(folder / "second.safetensors", made[2:])
    found = prior_objects.read_objects(sorted(folder.glob("*.safetensors")))
    assert_close(found.select([2]).materials, made[2].materials, atol=1e-3, rtol=0)
    return found


def test_training_ends_by_the_clock_and_changes_the_weights_that_are_asked_for(objects):
    truth: train_prior.Truth = {"pbr": train_prior.true_pbr(objects.materials.float())}
    settings = train_prior.PriorTraining(seconds=1e-6, batch=2, points=32, views=2)

    def changed_by(train_some) -> set[str]:
        prior = make_prior()
        before = {name: value.clone() for name, value in prior.state_dict().items()}
        assert train_some(prior) == 1
        return {name for name, value in prior.state_dict().items() if not torch.equal(value, before[name])}

    changed = changed_by(lambda prior: train_prior.train(prior, objects, truth, settings, lambda *_: None))
    assert any(name.startswith("heads.pbr") for name in changed)
    assert any(name.startswith("view_encoder") for name in changed)
    assert not any(name.startswith("heads.neural") or "readers" in name for name in changed)
    readers_alone = train_prior.ReaderTraining(seconds=1e-6, group=2, steps=2)
    changed = changed_by(
        lambda prior: train_prior.train_readers(prior, objects, truth, "pbr", readers_alone, lambda *_: None)
    )
    assert changed
    assert all(name.startswith("pbr_readers.") for name in changed)


@pytest.mark.parametrize("axis", [1, 2])
def test_the_order_of_points_and_of_views_changes_nothing(prior, objects, axis):
    given = objects.select([0, 1]).observations
    orders = [torch.arange(count) for count in given.visible.shape[1:]]
    orders[axis - 1] = torch.randperm(len(orders[axis - 1]), generator=generator())
    with torch.no_grad():
        expected, found = prior(given), prior(train_prior.selected(given, *orders))
    assert_close(found, expected[:, orders[0]], atol=1e-5, rtol=1e-4)


def test_a_view_that_sees_nothing_changes_nothing(prior, objects):
    given = objects.select([0]).observations
    hidden, spoiled = given.visible.clone(), given.colours.clone()
    hidden[:, :, 1], spoiled[:, :, 1] = False, 5.0
    with torch.no_grad():
        expected = prior(replace(given, visible=hidden))
        assert_close(prior(replace(given, visible=hidden, colours=spoiled)), expected)
        nothing = prior(replace(given, visible=torch.zeros_like(given.visible)))
    assert torch.isfinite(nothing).all()


def test_a_point_learns_from_those_that_are_seen_alone(prior, objects):
    given = objects.select([0]).observations
    hidden, brighter = given.visible.clone(), given.colours.clone()
    hidden[:, 1:3], hidden[:, 0] = False, True
    brighter[:, 2] *= 3
    with torch.no_grad():
        unseen, seen = (
            [prior(replace(given, visible=visible, colours=one))[:, 0] for one in (given.colours, brighter)]
            for visible in (hidden, hidden | True)
        )
    assert_close(unseen[1], unseen[0])
    assert (seen[1] - seen[0]).abs().max() > 1e-4


def posed_views(alpha: float = 1.0) -> observations.PosedViews:
    """In which pixels are coloured by where they are in the picture."""
    ramp = ((torch.arange(32) + 0.5) / 32).expand(32, 32)
    picture = torch.stack([ramp, ramp.T, torch.full((32, 32), 0.5)], dim=-1)
    return observations.PosedViews(viewpoints(5, 32, 1.0), [picture] * 5, [torch.full((32, 32), alpha)] * 5)


@pytest.fixture(scope="module")
def given() -> tuple[RayMesh, Environment]:
    return RayMesh(prior_objects.random_mesh(generator(3))), prior_objects.random_environment(generator(4))


def test_colours_are_read_where_a_point_is_seen():
    views = posed_views()
    positions = 0.3 * torch.randn(40, 3, generator=generator())
    colours, shown = views.at(positions)
    for index in range(5):
        pixels, _ = views.cameras.project(positions, index)
        inside = ((pixels > 1) & (pixels < 31)).all(dim=-1)
        assert shown[inside, index].all()
        assert_close(colours[inside, index, :2], pixels[inside] / 32, atol=1e-4, rtol=0)


@pytest.mark.parametrize("material", ["neural", "pbr"])
def test_a_prediction_is_a_triplane_of_the_resolution_asked_for(prior, given, material):
    options = {"resolution": 63, "generator": generator(), "prior": prior}
    ray_mesh, light = given
    triplane = small.predict(posed_views(), ray_mesh, light, material, **options)
    assert triplane.planes.shape == (3, 12, 63, 63)
    parameters = triplane.parameters_at(2 * torch.rand(50, 3, generator=generator()) - 1)
    assert parameters.shape == (50, small.NUM_PARAMETERS[material])
    assert torch.isfinite(parameters).all()


def test_planes_in_a_resolution_that_subdivides_theirs_are_the_same_material(prior):
    planes = torch.randn(3, 12, 32, 32, generator=generator())
    positions = 2 * torch.rand(50, 3, generator=generator()) - 1
    own, finer = (Triplane.filled(prior.readers_of("pbr"), planes, resolution) for resolution in (32, 63))
    assert_close(finer.parameters_at(positions), own.parameters_at(positions), atol=1e-4, rtol=0)


def test_views_beside_the_object_are_refused(prior, given):
    ray_mesh, light = given
    with pytest.raises(SceneError, match="none of 5 views shows the mesh"):
        small.predict(posed_views(0.0), ray_mesh, light, "pbr", generator=generator(), prior=prior)


def test_weights_come_back_and_latents_are_bound_to_their_decoder(tmp_path):
    prior = make_prior()
    train_prior.write_small_prior(tmp_path, prior, {"decoder_sha256": small.shipped_decoder_sha256()})
    found = small.read_small_prior("neural", tmp_path)
    for name, value in prior.state_dict().items():
        assert torch.equal(found.state_dict()[name], value)
    train_prior.write_small_prior(tmp_path, prior, {"decoder_sha256": "a" * 64})
    with pytest.raises(RunError, match=r"trained for the material decoder aaaaaaaaaaaa, but"):
        small.read_small_prior("neural", tmp_path)
    small.read_small_prior("pbr", tmp_path)
    path = tmp_path / "small.safetensors"
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(RunError, match=r"is not the file that small\.json describes"):
        small.read_small_prior("pbr", tmp_path)
    with pytest.raises(RunError, match=r"small\.json can't be read"):
        small.read_small_prior("pbr", tmp_path / "elsewhere")


def test_the_shipped_prior_belongs_to_the_shipped_decoder_and_is_small():
    small.read_small_prior("neural")
    assert (small.SHIPPED / "small.safetensors").stat().st_size < 10e6


def numbers(seed: int) -> torch.Tensor:
    return torch.randn(20, 3, dtype=torch.float64, generator=generator(seed))


def test_views_that_do_not_see_a_point_change_nothing():
    colours, mirrored, reaching, _, _ = made_of(lobe=0)
    visible = EVERY.clone()
    visible[:, 8:] = False
    spoiled = colours.clone()
    spoiled[:, 8:] = 7.0
    expected = lobe_fits(colours[:, :8], mirrored[:, :8], visible[:, :8], reaching)
    assert_close(lobe_fits(spoiled, mirrored, visible, reaching), expected)
    assert torch.isfinite(lobe_fits(colours, mirrored, ~EVERY, reaching)).all()


def test_with_beta_a_half_each_likelihood_counts_its_standard_deviation_and_that_has_no_gradient():
    predicted, log_variance, target = numbers(0).requires_grad_(), numbers(1).requires_grad_(), numbers(2)
    deviation = (0.5 * log_variance).exp().detach()
    expected = (deviation * 0.5 * ((predicted - target) ** 2 / log_variance.exp() + log_variance)).mean()
    actual = train_prior.beta_nll(predicted, log_variance, target)
    assert_close(actual, expected)
    gaussian = torch.distributions.Normal(predicted, (0.5 * log_variance).exp())
    likelihood = -(gaussian.log_prob(target) + 0.5 * math.log(2 * math.pi)).mean()
    assert_close(train_prior.beta_nll(predicted, log_variance, target, beta=0.0), likelihood)
    found = torch.autograd.grad(actual, [predicted, log_variance])
    assert_close(found, torch.autograd.grad(expected, [predicted, log_variance]))
