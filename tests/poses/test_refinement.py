from dataclasses import replace
from typing import Any

import pytest
import torch
from torch.testing import assert_close

from tests.factories.models import BOX, CONFIG, initial_data, make_model, make_rays
from tests.factories.refined_cameras import (
    HEIGHT,
    MIDDLE,
    box_around,
    cameras,
    corrections,
    refinement,
    some_pixels,
)
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import RayBundle
from unmix_plugin.engine.processes import Processes
from unmix_plugin.field import CoefficientField
from unmix_plugin.model import UnmixModel
from unmix_plugin.poses.knots import Knots, row_waves
from unmix_plugin.poses.refinement import LARGEST_RATIO, LARGEST_STEP, PoseRefinement, RobustWeights
from unmix_plugin.sensors.views import MeasuredPixels
from unmix_plugin.settings import PoseConfig


def test_a_line_camera_has_knots_a_few_rows_apart_and_a_frame_camera_one():
    knots = Knots.of(cameras())
    assert knots.rows == (0, HEIGHT, 0)
    assert knots.counts == [1, 11, 1]
    assert_close(knots.heights(1), torch.linspace(0, 40, 11))
    assert_close(knots.positions(cameras())[[0, 12]], cameras().camera_to_world[[0, 2], :, 3])


def test_nothing_changes_before_a_step_is_taken():
    views, coords = some_pixels(1)
    rays = cameras().generate_rays(views, coords)
    moved = refinement(size=0.0)(rays)
    assert torch.equal(moved.origins, rays.origins)
    assert torch.equal(moved.directions, rays.directions)


@pytest.mark.parametrize("lens", ["fixed", "focal", "radial"])
@pytest.mark.parametrize("view", [0, 1, 2])
@pytest.mark.parametrize("k1", [0.0, -0.3])
def test_corrected_cameras_send_the_rays_of_training(lens, view, k1):
    given = replace(cameras(), distortion=torch.tensor([[k1, 0.05, 0.01, -0.01]]).expand(3, 4) * (k1 != 0))
    views, coords = some_pixels(view)
    mine = refinement(lens)(given.generate_rays(views, coords), given)
    theirs = refinement(lens).refined(given).generate_rays(views, coords)
    # Key poses turn about one axis between knots, corrections add up: they differ by products of small angles.
    assert_close(mine.origins, theirs.origins, atol=2e-4, rtol=0)
    assert_close(mine.directions, theirs.directions, atol=4e-4, rtol=0)
    before = given.generate_rays(views, coords)
    assert (mine.directions - before.directions).norm(dim=1).mean() > 0.01


def test_gradients_of_moved_rays_are_those_of_finite_differences():
    found = refinement("radial").double()
    views = torch.tensor([0, 1, 1, 2])
    given, keys = cameras(), cameras().key_poses
    assert keys is not None
    given = replace(
        given,
        camera_to_world=given.camera_to_world.double(),
        focal_px=given.focal_px.double(),
        center_px=given.center_px.double(),
        distortion=torch.tensor([[-0.2, 0.05, 0.01, -0.01]]).double().expand(3, 4),
        key_poses=replace(keys, poses=keys.poses.double(), heights=keys.heights.double()),
    )
    coords = torch.tensor([[2.0, 3.0], [4.0, 11.0], [9.0, 39.0], [1.0, 30.0]]).double()
    rays = given.generate_rays(views, coords)

    def moved(steps: torch.Tensor, lens: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        out = torch.func.functional_call(found, {"steps": steps, "lens.steps": lens}, (rays, given))
        return out.origins, out.directions

    inputs = (found.steps.detach().requires_grad_(), found.lens.steps.detach().requires_grad_())
    assert torch.autograd.gradcheck(moved, inputs, eps=1e-6, atol=1e-5)


def steps_to(corrections: torch.Tensor, knots: Knots) -> torch.Tensor:
    """Steps that add up to these corrections at the knots."""
    parts = corrections.split(knots.counts)
    return torch.cat([p if len(p) == 1 else torch.linalg.solve(row_waves(len(p)), p) for p in parts])


@pytest.mark.parametrize("pixel_size", [0.1, 0.003])
def test_what_moves_all_views_alike_is_no_correction(pixel_size):
    """Turning, moving and scaling the world about its middle leaves nothing; the rest stays."""
    knots, own = Knots.of(cameras()), cameras()
    found, offsets = refinement(pixel_size=pixel_size), Knots.of(own).positions(own) - MIDDLE
    before = corrections(found)
    turn, shift, growth = torch.tensor([0.1, -0.2, 0.3]), torch.tensor([0.3, 0.1, -0.2]), 0.2
    moves = torch.linalg.cross(turn.expand_as(offsets), offsets) + shift + growth * offsets
    similar = torch.cat([turn.expand_as(offsets), moves / found.reach[:, None]], dim=1)
    with torch.no_grad():
        found.steps.add_(steps_to(similar / found.scale[:, None], knots))
    assert_close(corrections(found), before, atol=1e-6, rtol=0)
    assert before.norm() > 0.05 * float(found.scale.min())
    with torch.no_grad():
        found.steps.copy_(steps_to(before / found.scale[:, None], knots))
    assert_close(corrections(found), before, atol=1e-6, rtol=0)
    assert sum(knots.counts) == len(before)


@pytest.mark.parametrize(
    ("runaways", "is_final", "free"),
    [
        (1, True, [True, True, True, False]),
        (3, True, [False] * 4),  # when most views run away all are undone
        (1, False, [True] * 4),  # while the grid is coarse it may try again
    ],
)
def test_a_view_that_runs_away_gets_its_pose_back_and_keeps_it(runaways, is_final, free):
    found = PoseRefinement((0,) * 4)
    with torch.no_grad():
        found.steps.fill_(0.01)
        found.steps[4 - runaways :, 0] = 2 * LARGEST_STEP
    found.restore_best(is_final=is_final)
    assert found.is_free.tolist() == free
    assert torch.equal(corrections(found)[3], torch.zeros(6))
    assert bool((corrections(found)[0] != 0).all()) == (runaways == 1)
    with torch.no_grad():
        found.steps[3, 0] = 0.1
    assert float(corrections(found)[3, 0].detach()) == pytest.approx(0.0 if is_final else 0.1)


def test_steps_are_a_share_of_a_pixel_and_bounds_a_share_of_the_picture():
    """The cameras stand at 2, 4, 16 and 16 from a scene of half edge 1; at its middle a pixel is 0.0272 wide."""
    found = PoseRefinement((0,) * 4)
    directions = torch.eye(3)[[0, 1, 2, 0]]
    distances = torch.tensor([2.0, 4.0, 16.0, 16.0])
    found.begin(distances[:, None] * directions, box_around(torch.zeros(3), 1.0), 0.0272)
    found.gauge.zero_()
    with torch.no_grad():
        found.steps.fill_(0.1)
        found.steps[3] = 0.3  # 0.075 radians about each axis, where the scene spans 0.0625
    turns = corrections(found)[:3, :3].norm(dim=1)
    assert_close(turns / turns[0], torch.tensor([1.0, 1.0, 0.25]))
    found.restore_best()
    assert found.is_free.tolist() == [True, True, True, False]


def test_a_shift_counts_by_the_distance_to_the_middle_of_the_scene():
    found = PoseRefinement((0, 0))
    found.begin(torch.tensor([[4.0, 0.0, 0.0], [0.0, 2.0, 0.0]]), box_around(torch.zeros(3)), 0.1)
    found.gauge.zero_()
    rays = RayBundle(torch.zeros(2, 3), torch.eye(3)[:2], torch.arange(2))
    rays = replace(rays, axes=rays.directions, pixel_coords=torch.zeros(2, 2))
    with torch.no_grad():
        found.steps[:, 5] = 0.2
        moved = found(rays).origins.norm(dim=1)
    shift = found.figures(found.free_steps())["pose_shift"]
    assert_close(float(shift), float((moved / torch.tensor([4.0, 2.0])).mean()))
    assert float(moved[0]) > 0.1


def refining_model(refinement: PoseConfig | None = None) -> UnmixModel:
    torch.manual_seed(0)
    refinement = refinement or PoseConfig(start=0.0, coarse_until=0.5)
    config = replace(CONFIG, poses="refine", pose_refinement=refinement)
    model: UnmixModel = config.setup(scene_box=BOX, metadata=make_model().metadata)
    places = torch.tensor([[0.0, 0.0, 4.0], [4.0, 0.0, 0.0], [0.0, 4.0, 0.0]])
    with torch.no_grad():
        model.initialise({**initial_data(), "knots": places.numpy()}, torch.Generator().manual_seed(0))
        model.field.get_parameter("table").normal_(std=0.5)
    return model


def test_what_rays_meet_counts_as_probed_since_nothing_is_carved():
    model = refining_model().train()
    model.generator = torch.Generator().manual_seed(0)
    assert bool(model.grid.reachable.all())
    rays = make_rays(200)
    rays = replace(rays, axes=rays.directions, pixel_coords=torch.zeros(200, 2))
    batch = {"spectra": torch.rand(200, 5), "alpha": torch.ones(200), "pixels": torch.arange(200)}
    model.update(model.get_train_loss_dict(rays, batch)[0])
    nothing = torch.Generator().manual_seed(0)
    model.grid.update(lambda points: torch.zeros(len(points)), 0.1, 0.5, 0, nothing)
    assert 0.1 < model.grid.peak_densities.isfinite().float().mean() < 1


class Blob(CoefficientField):
    """A soft ball whose materials change smoothly; nothing of it reaches the box."""

    def encode(self, positions: torch.Tensor, known: torch.Tensor | None = None) -> torch.Tensor:
        return positions

    def density_of(self, encoded: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return 20 * (-12 * encoded.square().sum(dim=1)).exp(), encoded

    def abundances_of(self, features: torch.Tensor) -> torch.Tensor:
        return torch.softmax(3 * torch.sin(4 * features + torch.arange(3)), dim=-1)

    def get_outputs(self, positions, directions, features, light=None):
        shares, specular = self.abundances_of(features), 0.3 * (1 + directions[:, :1] * directions[:, 1:2])
        return {"abundances": shares, "scaled_abundances": 0.7 * shares, "specular_coefficients": specular}


def test_the_gradient_of_a_picture_by_a_pose_is_that_of_finite_differences():
    model: Any = refining_model().train()
    model.field, model.step = Blob(), 0.01
    model.config = replace(model.config, renderer=replace(model.config.renderer, coarse_samples=4096))
    model.poses.gauge.zero_()
    steps = model.poses.steps
    pose = torch.tensor([[[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4.0]]])
    camera = Cameras(pose, torch.full((1, 2), 40.0), torch.full((1, 2), 8.0), torch.zeros(1, 4), 16, 16)
    rays = camera.image_rays(0)
    weights = torch.randn(len(rays), 5, generator=torch.Generator().manual_seed(3))

    none = torch.zeros(len(rays))
    pixels = [MeasuredPixels(None, len(rays), torch.zeros(len(rays), 5), none, none.long())]

    def seen() -> torch.Tensor:
        model.generator = torch.Generator().manual_seed(0)
        step = model.training_batch(rays, pixels)
        return (step.compared[0].spectra * weights).sum() / len(rays)

    seen().backward()
    expected = []
    with torch.no_grad():
        for number in range(6):
            values = []
            for side in (-1, 1):
                steps[0, number] = side * 4e-3
                values.append(float(seen()))
            steps[0, number] = 0.0
            expected.append((values[1] - values[0]) / 8e-3)
    wanted = torch.tensor(expected)
    assert float((steps.grad[0] - wanted).norm() / wanted.norm()) < 0.02
    assert torch.equal(steps.grad[1:], torch.zeros(2, 6))


def test_levels_without_weight_change_nothing():
    model = refining_model()
    points = torch.rand(20, 3, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        whole = model.field.get_density(points)[1]
        model.get_training_callbacks()[0].func(1, 0.0)
        coarse = model.field.get_density(points)[1]
        field: Any = model.field
        field.table[int(field.layout.levels[1, 1]) :] += 1.0
        assert_close(model.field.get_density(points)[1], coarse)
    assert float((whole - coarse).abs().max()) > 1e-2


KNOTS = 10


def observed(errors: torch.Tensor, matter: torch.Tensor | None = None) -> RobustWeights:
    """After steps in which each knot had one pixel with this error."""
    robust = RobustWeights(len(errors))
    shown = torch.ones(len(errors), dtype=torch.bool) if matter is None else matter
    for _ in range(20):
        robust.update(torch.arange(len(errors)), errors, shown)
    robust.judge(Processes())
    return robust


@pytest.mark.parametrize(
    ("others", "bad", "matter", "weight"),
    [
        (torch.linspace(1.0, LARGEST_RATIO, KNOTS), None, True, 1.0),  # alike
        (torch.ones(KNOTS), 10 * LARGEST_RATIO, True, 0.01),  # by the square of what is too much
        (torch.ones(KNOTS), 1000.0, False, 1.0),  # pixels that show nothing
    ],
)
def test_what_is_far_worse_than_the_median_weighs_less_by_the_square(others, bad, matter, weight):
    errors, shown, expected = 1e-3 * others, torch.ones(KNOTS, dtype=torch.bool), torch.ones(KNOTS)
    if bad is not None:
        errors[3], shown[3], expected[3] = 1e-3 * bad, matter, weight
    assert_close(observed(errors, shown).weights, expected)


def test_a_pose_that_fits_again_is_an_inlier_again():
    errors = torch.full((KNOTS,), 1e-3)
    errors[3] = 1.0
    robust = observed(errors)
    assert robust.weights[3] < 0.01
    for _ in range(600):
        robust.update(torch.arange(KNOTS), torch.full((KNOTS,), 1e-3), torch.ones(KNOTS, dtype=torch.bool))
    robust.judge(Processes())
    assert_close(robust.weights, torch.ones(KNOTS))
    broken = observed(torch.cat([torch.ones(KNOTS - 1), torch.tensor([torch.nan])]))
    assert_close(broken.weights, torch.ones(KNOTS))
    unseen = RobustWeights(KNOTS)
    unseen.judge(Processes())
    assert_close(unseen.weights, torch.ones(KNOTS))


def gradients(weight: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Of the scene and of the poses, where the pixels of one view weigh this much."""
    model: Any = refining_model(PoseConfig(start=0.0, coarse_steps=0)).train()
    model.generator, poses = torch.Generator().manual_seed(0), model.poses
    poses.robust.weights.fill_(weight)
    model.get_training_callbacks()[0].func(1, 0.0)
    views, coords = some_pixels(0)
    pixels = [MeasuredPixels(None, 50, torch.zeros(50, 5), torch.ones(50), torch.arange(50))]
    step = model.training_batch(cameras().generate_rays(views, coords), pixels)
    step.compared[0].spectra.sum().backward()
    return model.field.get_parameter("table").grad, poses.steps.grad


def test_a_pose_that_is_an_outlier_still_feels_what_its_pixels_show():
    (table, steps), (hardly, still) = gradients(1.0), gradients(0.01)
    assert float(steps.abs().max()) > 0
    assert_close(hardly, 0.01 * table)
    assert_close(still, steps, rtol=1e-4, atol=1e-7)
