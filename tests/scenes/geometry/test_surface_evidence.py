import numpy as np
import pytest
import torch

from tests.factories.ball_views import make_cameras
from tests.factories.demo_parts import one_ray_a_pixel
from tests.factories.files import present
from tests.factories.scenes import look_at
from unmix_plugin.engine.geometry.space import SceneBox, UnitSpace
from unmix_plugin.scenes.demo.scene import PLACES, make_demo_scene
from unmix_plugin.scenes.demo.shapes import first_hits
from unmix_plugin.scenes.geometry import surface_evidence
from unmix_plugin.scenes.geometry.carving import carve
from unmix_plugin.scenes.geometry.surface_evidence import SurfaceEvidence, sweep_depths, sweep_scene
from unmix_plugin.scenes.geometry.views import Views
from unmix_plugin.scenes.pixel_table import PixelTable
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.settings import SceneOptions

BOX = SceneBox(torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]))
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Objects on a ground under a sky."""
    folder = tmp_path_factory.mktemp("world") / "scene"
    with one_ray_a_pixel():
        make_demo_scene(folder, 64, 3, 24, place=PLACES["world"])
    return folder


@pytest.fixture(scope="module")
def scene(folder):
    return load_scene(folder, SceneOptions(world="unbounded"))


@pytest.fixture(scope="module")
def evidence(scene):
    return SurfaceEvidence(scene, sweep_scene(scene), CPU)


def true_distances(scene, rays):
    """To the first surface, model units; inf where there is the sky."""
    origins = scene.normalisation.to_world(rays.origins.double().numpy()).astype(np.float32)
    directions = (rays.directions.numpy() @ scene.normalisation.rotation).astype(np.float32)
    found, _ = first_hits([thing.placement for thing in PLACES["world"].things], origins, directions)
    return torch.from_numpy(found) * scene.normalisation.scale


def test_drawn_pixels_are_shown_where_their_true_surfaces_are(scene, evidence):
    table = PixelTable(scene, CPU, scene.train_indices, None)
    (pixels,) = table.draw(4000, torch.Generator().manual_seed(0), 0)
    points = evidence.points(pixels)
    known = ~points.isnan().any(dim=-1)
    assert 0.2 < known.float().mean() < 0.9
    rays = scene.cameras[list(scene.train_indices)].generate_rays(pixels.cameras, pixels.corners + 0.5)
    distances = true_distances(scene, rays).clamp(max=1e4)
    space = UnitSpace(scene.scene_box, is_unbounded=True)
    true = space.to_unit(rays.origins + distances[:, None] * rays.directions)
    cells_off = 64 * (space.to_unit(points) - true).norm(dim=-1)[known]
    assert (cells_off < 3).float().mean() > 0.85


def share_right(scene, cameras, views, depths):
    """Pixels whose distance is known, and of these the share with at most 3 cells of error."""
    space, right, known = UnitSpace(scene.scene_box, is_unbounded=True), [], []
    for view, found in zip(views, depths.distances[views], strict=True):
        at = [(torch.arange(side) + 0.5) * depths.stride for side in found.shape]
        coords = torch.stack(torch.meshgrid(at[1], at[0], indexing="xy"), dim=-1).flatten(0, 1)
        rays = cameras.generate_rays(torch.full((len(coords),), view), coords)
        is_known = torch.isfinite(found).flatten()
        one, other = (
            space.to_unit(rays.origins + t[:, None] * rays.directions)[is_known]
            for t in (found.flatten().nan_to_num(posinf=0.0), true_distances(scene, rays).clamp(max=1e4))
        )
        right.append(64 * (one - other).norm(dim=-1) < 3)
        known.append(is_known)
    return float(torch.cat(known).float().mean()), float(torch.cat(right).float().mean())


@pytest.mark.parametrize(("edge", "spread"), [(1, 0.2), pytest.param(5, 0.0, marks=pytest.mark.slow)])
def test_views_of_differing_exposure_and_large_noisy_views_are_swept_too(scene, edge, spread):
    """`edge`: by how many times larger the pictures are, with noise in each pixel that means over pixels remove."""
    train = list(scene.train_indices[:12])
    cameras = scene.cameras[train]
    gains = np.exp(np.random.default_rng(0).uniform(-spread, spread, len(train))).astype(np.float32)

    def read(view, part):
        cube = scene.cube(train[view]).repeat(edge, axis=0).repeat(edge, axis=1)
        noise = 0.15 * (edge > 1) * np.random.default_rng(view).standard_normal(cube.shape, np.float32)
        return (gains[view] * cube + noise)[part]

    views = Views(cameras.resized(edge * cameras.width, edge * cameras.height), read)
    depths = present(sweep_depths(views, scene.scene_box))
    assert depths.stride == 2 * (1 if edge == 1 else 3)
    share, right = share_right(scene, views.cameras, [0, 5, 10], depths)
    assert share > 0.3
    assert right > 0.85


def test_the_distances_of_what_masks_leave_out_stay_unknown(scene):
    train = list(scene.train_indices[:6])
    cameras = scene.cameras[train]
    valid = np.ones((cameras.height, cameras.width), bool)
    valid[:, : cameras.width // 2] = False

    def swept(read_valid):
        views = Views(cameras, lambda view, part: scene.cube(train[view], part), read_valid)
        depths = present(sweep_depths(views, scene.scene_box))
        return depths.distances

    found, everything = swept(lambda _: valid), swept(None)
    middle = found.shape[2] // 2
    assert torch.isfinite(everything[..., :middle]).any()
    assert torch.isinf(found[..., :middle]).all()
    assert torch.equal(found[..., middle + 1 :], everything[..., middle + 1 :])


def test_cells_that_views_look_through_are_carved_and_those_with_surfaces_are_not(scene, evidence):
    before = carve(scene, 64)
    after = evidence.carved(before)
    assert (after <= before).all()
    assert after.sum() < 0.97 * before.sum()
    rays = scene.cameras.image_rays(scene.eval_indices[0])
    distances = true_distances(scene, rays)
    hit = torch.isfinite(distances)
    points = (rays.origins + distances[:, None] * rays.directions)[hit]
    cells = (UnitSpace(scene.scene_box, is_unbounded=True).to_unit(points) * 64).long().clamp(0, 63)
    kept = [grid[tuple(cells.T.numpy())].mean() for grid in (before, after)]
    assert kept[1] > kept[0] - 0.02


def test_a_bounded_scene_has_no_evidence_of_surfaces(folder):
    scene = load_scene(folder, SceneOptions(world="bounded"))
    evidence = SurfaceEvidence(scene, sweep_scene(scene), CPU)
    reachable = carve(scene, 16)
    assert evidence.carved(reachable) is reachable


def test_nothing_is_known_of_views_that_show_one_colour_or_are_too_few():
    cameras = make_cameras([look_at(np.array([3.0, y, 0.3]), np.zeros(3)) for y in (-1.0, -0.4, 0.4, 1.0)])
    size = (cameras.height, cameras.width, 3)

    def plain(_, part):
        return np.full(size, 0.5, np.float32)[part]

    def noisy(view, part):
        return np.random.default_rng(view).random(size, np.float32)[part]

    assert sweep_depths(Views(cameras, plain), BOX) is None
    assert sweep_depths(Views(cameras[[0, 1, 2]], noisy), BOX) is None
    unrelated = present(sweep_depths(Views(cameras, noisy), BOX))
    assert torch.isfinite(unrelated.distances).float().mean() < 0.05


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (1, 1000)])
def test_views_of_a_pixel_or_a_row_are_too_small_to_be_swept(scene, size):
    small = scene.cameras[list(scene.train_indices)].resized(size[1], size[0])
    pixels = np.random.default_rng(0).random((*size, 3), np.float32)
    assert sweep_depths(Views(small, lambda view, part: (pixels + 0.01 * view)[part]), BOX) is None


@pytest.mark.parametrize("num_views", [2, 3])
def test_three_views_must_look_through_a_cell(num_views):
    positions = [np.array([2.5, side, 0.3]) for side in (-0.4, 0.0, 0.4)]
    cameras = make_cameras([look_at(position, np.array([-20.0, 0.0, 0.0])) for position in positions])
    shape = (num_views, cameras.height, cameras.width)
    depths = surface_evidence.SweptDepths(tuple(range(num_views)), torch.full(shape, 3.0), 1)
    empty = surface_evidence.seen_through(depths, cameras, BOX, 32)
    # Before the surface, on it, behind it, and behind the cameras.
    points = torch.tensor([[0.5, 0.0, 0.3], [-0.5, 0.0, 0.3], [-1.5, 0.0, 0.3], [4.0, 0.0, 0.3]])
    cells = (UnitSpace(BOX, is_unbounded=True).to_unit(points) * 32).long()
    assert empty[tuple(cells.T.numpy())].tolist() == [num_views == 3, False, False, False]
