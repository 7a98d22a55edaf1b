"""The method's equations, its outputs and its settings."""

from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

from tests.factories.models import CAMERA, CONFIG, NUM_BANDS, make_model, make_rays
from unmix_plugin.engine.geometry.space import RayBundle
from unmix_plugin.model import UnmixModel
from unmix_plugin.operators.compositing import volume_weights_twin
from unmix_plugin.rendering.renderer import points_of
from unmix_plugin.sensors.views import from_batch


def naive_spectra(model: UnmixModel, rays) -> torch.Tensor:
    """The paper's sum: a spectrum of B bands at every sample, composited ray by ray."""
    samples = model.renderer.march(rays.origins, rays.directions, torch.zeros(len(rays))).samples()
    positions, along = points_of(rays, samples.ray_indices, samples.t)
    densities, features = model.field.get_density(positions)
    outputs = model.field.get_outputs(positions, along, features)
    per_sample = torch.einsum("sk,kb->sb", outputs["scaled_abundances"], model.endmembers)
    specular = outputs["specular_coefficients"]
    if model.config.specular == "dictionary":
        per_sample = per_sample + torch.einsum("sj,jb->sb", specular, model.specular_spectra)
    elif model.config.specular == "full":
        per_sample = per_sample + specular
    weights = volume_weights_twin(densities * model.renderer.step, samples.packed_info)
    spectra = torch.zeros(len(rays), NUM_BANDS)
    return spectra.index_add(0, samples.ray_indices, weights[:, None] * per_sample)


@pytest.mark.parametrize("specular", ["none", "dictionary", "full"])
@pytest.mark.parametrize("scale", ["shared", "per-endmember"])
def test_deferred_composition_equals_compositing_a_spectrum_a_sample(specular, scale):
    model = make_model(specular=specular, num_specular_spectra=2, field=replace(CONFIG.field, scale=scale))
    rays = make_rays(40)
    with torch.no_grad():
        spectra = model.get_outputs(rays)["spectral"]
        assert spectra.std() > 1e-3
        assert_close(spectra, naive_spectra(model, rays), rtol=1e-5, atol=1e-6)


def test_highlights_have_the_lights_colour_and_where_no_alpha_is_known_those_of_all_materials():
    lamp = [0.2, 0.4, 0.6, 0.8, 1.0]
    alone, coloured = (make_model(has_alpha=has_alpha, light=lamp) for has_alpha in (True, False))
    assert_close(alone.specular_spectra.detach(), torch.tensor([lamp]))
    assert_close(coloured.specular_spectra[0].detach(), torch.tensor(lamp))
    assert_close(coloured.specular_spectra[1:].detach(), coloured.endmembers.detach())
    assert_close(make_model(light=None).specular_spectra[0].detach(), torch.ones(NUM_BANDS))
    bare = make_model(specular="none", train_endmembers=False)
    assert bare.get_param_groups()["spectra"] == []
    bare.warm_up()  # compiles kernels without spectra to learn


def test_a_ray_that_misses_the_box_sees_black_and_nothing():
    outputs = make_model().get_outputs(make_rays(5))
    assert outputs["spectral"][-1].abs().sum() == 0
    assert outputs["accumulation"][-1] == 0


def test_normals_point_out_of_a_density_that_grows_inwards():
    model = make_model()
    centre = torch.tensor([0.1, -0.2, 0.05])
    density = lambda positions: torch.exp(-4 * (positions - centre).square().sum(-1))  # noqa: E731
    model.field.get_density = lambda positions: (density(positions), positions)  # type: ignore[method-assign]
    rays = make_rays(12)[:11]
    normals = model.renderer.normals(model.field, rays, torch.full((11,), 2.5))
    outward = rays.origins + 2.5 * rays.directions - centre
    assert_close(normals, torch.nn.functional.normalize(outward, dim=-1), atol=1e-5, rtol=0)


def test_spectra_stay_physical_after_an_update():
    model = make_model()
    with torch.no_grad():
        model.endmembers[0] = -1
        model.specular_spectra[0] = 2
    for callback in model.get_training_callbacks():
        callback.func(1, 0.0)
    assert model.endmembers.min() >= 0
    assert model.specular_spectra.max() <= 1


def test_rays_adapt_to_the_budget_of_samples():
    model = make_model(samples_per_step=1000)
    rays = 400
    for _ in range(30):
        rays = model.next_num_rays(5 * rays, rays) or 0
    assert rays == pytest.approx(200, abs=2)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="compares the CPU with a CUDA GPU")
def test_the_same_weights_render_alike_on_cpu_and_gpu():
    model = make_model()
    on_cpu = model.get_outputs_for_camera(CAMERA, ["spectral"])["spectral"]
    on_gpu = model.to("cuda").get_outputs_for_camera(CAMERA, ["spectral"])["spectral"].cpu()
    assert_close(on_gpu, on_cpu, rtol=1e-3, atol=1e-4)


def occupied_after_training(has_alpha: bool = True, visible_weight: float | str = "auto") -> torch.Tensor:
    """Share of each layer of cells, from the cameras' side on, that is occupied in dense space seen from one side."""
    renderer = replace(CONFIG.renderer, smallest_weight="auto", visible_weight=visible_weight)
    model = make_model(has_alpha=has_alpha, renderer=renderer).train()
    with torch.no_grad():
        model.field.get_parameter("table").zero_()
    setattr(model.field, "log_initial_density", 4.7)  # noqa: B010
    g = torch.Generator().manual_seed(0)
    views = torch.arange(2000) % 2
    targets = torch.rand(2000, 3, generator=g) * 2 - 1
    origins = torch.tensor([[0.5, 0.0, 3.0], [-0.5, 0.0, 3.0]])[views]
    bundle = RayBundle(origins, torch.nn.functional.normalize(targets - origins, dim=-1), views)
    grey = torch.full((2000, NUM_BANDS), 0.3)
    batch = {"spectra": grey, "alpha": torch.ones(2000), "pixels": torch.arange(2000)}
    with torch.no_grad():
        step = model.training_batch(bundle, from_batch(batch, 2000, model.seen_by.num_channels))
        model.losses(step)
        assert int(model.grid.visibility.num_rays) == 0
        model.update({"batch": step})
        model.get_training_callbacks()[0].func(0, 0.0)
    return model.grid.occupied.float().mean(dim=(0, 1)).flip(0)


def test_what_no_training_ray_reaches_is_left_out():
    layers = occupied_after_training()
    assert layers[0] > 0.9
    assert not layers[3:].any()


def test_nothing_is_left_out_of_rooms_or_by_request():
    assert occupied_after_training(has_alpha=False).all()
    assert occupied_after_training(visible_weight=1.0).all()


def test_rendering_and_losses_change_nothing_in_the_model():
    model = make_model().train()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    rays = make_rays(16)
    spectra = torch.rand(16, NUM_BANDS)
    batch = {"spectra": spectra, "alpha": torch.ones(16), "pixels": torch.arange(16)}
    losses = model.losses(model.training_batch(rays, from_batch(batch, 16, model.seen_by.num_channels)))
    torch.stack(list(losses.values())).sum().backward()
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())


def samples_of(model: UnmixModel) -> int:
    batch = {"spectra": torch.rand(50, NUM_BANDS), "alpha": torch.ones(50), "pixels": torch.arange(50)}
    return model.num_samples(model.get_train_loss_dict(make_rays(50), batch)[0])


def test_images_of_many_pixels_are_sampled_coarsely_at_first():
    renderer = replace(CONFIG.renderer, coarse_samples=10)
    model = make_model(renderer=renderer).train()
    counts = []
    for progress in (0.0, 0.25, 0.5, 1.0):
        model.get_training_callbacks()[0].func(1, progress)
        counts.append(samples_of(model))
    assert 2.0 < counts[2] / counts[0] < 2.6  # 23 samples along an edge in the end
    assert counts[0] < counts[1] < counts[2] == counts[3]
    assert samples_of(model.eval()) == counts[3]
