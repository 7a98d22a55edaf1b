"""The method's equations, its outputs and its settings."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from tests.method_factory import (
    CAMERA,
    CONFIG,
    NUM_BANDS,
    WAVELENGTHS_NM,
    initial_data,
    make_model,
    make_rays,
)
from unmix_plugin.engine.geometry.rays import RayBundle
from unmix_plugin.errors import ConfigError, SpectrumError
from unmix_plugin.lit_samples import points_of
from unmix_plugin.model import UnmixModel
from unmix_plugin.model_settings import UnmixModelConfig
from unmix_plugin.rendering.compositing import volume_weights_twin
from unmix_plugin.training_losses import LossConfig


def naive_spectra(model: UnmixModel, rays) -> torch.Tensor:
    """The paper's sum: a spectrum of B bands at every sample, composited ray by ray."""
    samples = model.renderer._march(rays, None)
    positions, along = points_of(samples, rays)
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


def test_where_no_alpha_is_known_highlights_may_have_the_colours_of_all_materials():
    lamp = [0.2, 0.4, 0.6, 0.8, 1.0]
    alone, coloured = (make_model(has_alpha=has_alpha, light=lamp) for has_alpha in (True, False))
    assert_close(alone.specular_spectra.detach(), torch.tensor([lamp]))
    assert_close(coloured.specular_spectra[0].detach(), torch.tensor(lamp))
    assert_close(coloured.specular_spectra[1:].detach(), coloured.endmembers.detach())


@pytest.mark.parametrize("trained", [True, False])
def test_endmembers_are_taught_or_held_by_request(trained):
    model = make_model(train_endmembers=trained)
    spectra = model.get_param_groups()["spectra"]
    assert any(value is model.endmembers for value in spectra) == trained
    model.get_outputs(make_rays(40))["spectral"].sum().backward()
    assert (model.endmembers.grad is not None) == trained
    assert model.specular_spectra.grad is not None


def test_a_model_without_spectra_to_learn_still_compiles_its_kernels():
    model = make_model(specular="none", train_endmembers=False)
    assert model.get_param_groups()["spectra"] == []
    model.warm_up()


def test_samples_without_weight_change_little_when_left_out():
    rays = make_rays(40)
    everything, most = (
        make_model(renderer=replace(CONFIG.renderer, smallest_weight=weight)) for weight in (0.0, 1e-3)
    )
    assert_close(
        most.get_outputs(rays)["spectral"], everything.get_outputs(rays)["spectral"], rtol=0, atol=0.04
    )


def test_a_ray_that_misses_the_box_sees_black_and_nothing():
    outputs = make_model().get_outputs(make_rays(5))
    assert outputs["spectral"][-1].abs().sum() == 0
    assert outputs["accumulation"][-1] == 0


def test_a_last_colour_background_closes_every_ray_that_meets_something():
    outputs = make_model(losses=LossConfig(background="last")).get_outputs(make_rays(20))
    assert_close(outputs["accumulation"][:-1], torch.ones(19))
    assert outputs["accumulation"][-1] == 0


@pytest.mark.parametrize("background", ["random", "black", "white"])
def test_a_perfect_prediction_has_no_loss_over_any_background(background):
    model = make_model(losses=LossConfig(background=background, rgb=1.0, abundances=0.0))
    spectra, alpha = torch.rand(8, NUM_BANDS), torch.rand(8)
    losses = model.get_loss_dict(
        {"spectral": spectra, "accumulation": alpha}, {"spectra": spectra, "alpha": alpha}
    )
    assert set(losses) == {"spectral", "rgb"}
    assert all(float(loss) < 1e-12 for loss in losses.values())


def test_colours_count_by_default_where_alpha_tells_black_from_the_void():
    spectra, alpha = torch.rand(8, NUM_BANDS), torch.ones(8)
    outputs = {"spectral": spectra / 2, "accumulation": alpha, "spread": torch.zeros(())}
    losses = {
        has_alpha: make_model(has_alpha=has_alpha, losses=LossConfig(abundances=0.0)).get_loss_dict(
            outputs, {"spectra": spectra, "alpha": alpha}
        )
        for has_alpha in (True, False)
    }
    assert float(losses[True]["rgb"]) > 0
    assert "rgb" not in losses[False]


def test_a_bright_background_penalises_missing_opacity():
    batch = {"spectra": torch.zeros(4, NUM_BANDS), "alpha": torch.ones(4)}
    outputs = {"spectral": torch.zeros(4, NUM_BANDS), "accumulation": torch.zeros(4)}
    losses = {
        b: float(
            make_model(losses=LossConfig(background=b, abundances=0.0)).get_loss_dict(outputs, batch)[
                "spectral"
            ]
        )
        for b in ("black", "white")
    }
    assert losses == {"black": 0.0, "white": 1.0}


def test_brighter_than_a_saturated_sensor_is_no_error_but_darker_is():
    model = make_model(losses=LossConfig(background="black", abundances=0.0))
    batch = {"spectra": torch.ones(1, NUM_BANDS), "alpha": torch.ones(1)}
    error = [
        float(
            model.get_loss_dict(
                {"spectral": torch.full((1, NUM_BANDS), v), "accumulation": torch.ones(1)}, batch
            )["spectral"]
        )
        for v in (1.5, 0.5)
    ]
    assert error == [0.0, 0.25]


def test_normals_point_out_of_a_density_that_grows_inwards():
    model = make_model()
    centre = torch.tensor([0.1, -0.2, 0.05])
    model.field.get_density = lambda positions: (  # type: ignore[method-assign]
        torch.exp(-4 * (positions - centre).square().sum(-1)),
        positions,
    )
    rays = make_rays(12)[:11]
    normals = model.renderer.normals(model.field, rays, torch.full((11,), 2.5))
    outward = rays.origins + 2.5 * rays.directions - centre
    assert_close(normals, torch.nn.functional.normalize(outward, dim=-1), atol=1e-5, rtol=0)


def test_the_first_specular_spectrum_is_the_light():
    light = [0.5, 0.6, 0.7, 0.8, 1.0]
    assert_close(make_model(light=light).specular_spectra[0].detach(), torch.tensor(light))
    assert_close(make_model(light=None).specular_spectra[0].detach(), torch.ones(NUM_BANDS))


def test_endmembers_start_at_the_materials_of_the_pixels():
    found = make_model().endmembers.detach()
    shapes = torch.nn.functional.normalize(torch.eye(3, NUM_BANDS) * 0.6 + 0.1, dim=-1)
    cosines = torch.nn.functional.normalize(found, dim=-1) @ shapes.T
    assert sorted(cosines.argmax(1).tolist()) == [0, 1, 2]
    assert (cosines.amax(1) > 0.999).all()


def test_endmembers_from_a_file_are_lit_by_the_scenes_light(tmp_path):
    path = tmp_path / "materials.csv"
    rows = [f"{nm:g},0.2,0.4,0.6" for nm in (440, 660)]
    path.write_text("wavelength,a,b,c\n" + "\n".join(rows) + "\n")
    light = [0.5, 0.6, 0.7, 0.8, 1.0]
    model = make_model(endmember_init="file", endmember_file=path, light=light)
    expected = torch.tensor([[0.2], [0.4], [0.6]]) * torch.tensor(light)
    factor = model.endmembers.detach() / expected
    assert_close(factor, factor.mean().expand(3, 5))
    with pytest.raises(ConfigError, match=r"materials.csv has 3 spectra but num-endmembers is 2"):
        make_model(endmember_init="file", endmember_file=path, num_endmembers=2)


def test_more_endmembers_than_bands_or_distinct_pixels_are_refused():
    with pytest.raises(ConfigError, match="num-endmembers is 6 but the scene has 5 bands; choose at most 5"):
        make_model(num_endmembers=6)
    model = make_model()
    data = {**initial_data(), "pixels": np.full((40, NUM_BANDS), 0.5, np.float32)}
    with pytest.raises(SpectrumError, match="distinct"), torch.no_grad():
        model.initialise(data, torch.Generator())


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_endmembers": 0}, "num-endmembers of 1 to 255"),
        ({"endmember_init": "file"}, "endmember-file exactly when endmember-init is file"),
        ({"initial_opacity": 1.0}, r"initial-opacity in \(0, 1\) or auto"),
    ],
)
def test_impossible_settings_are_refused(settings, message):
    with pytest.raises(ConfigError, match=message):
        make_model(**settings)


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
    rays, outputs = 400, {"num_samples": torch.tensor(0)}
    for _ in range(30):
        outputs["num_samples"] = torch.tensor(5 * rays)
        rays = model.next_num_rays(outputs, rays) or 0
    assert rays == pytest.approx(200, abs=2)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="compares the CPU with a CUDA GPU")
def test_the_same_weights_render_alike_on_cpu_and_gpu():
    model = make_model()
    on_cpu = model.get_outputs_for_camera(CAMERA, ["spectral"])["spectral"]
    on_gpu = model.to("cuda").get_outputs_for_camera(CAMERA, ["spectral"])["spectral"].cpu()
    assert_close(on_gpu, on_cpu, rtol=1e-3, atol=1e-4)


def test_transparency_is_penalised_only_where_no_alpha_says_what_is_solid():
    spectra = torch.tensor([0.5, 0.5, 0.0])[:, None].repeat(
        1, NUM_BANDS
    )  # the last pixel is black: it may be void
    batch = {"spectra": spectra, "alpha": torch.ones(3)}
    outputs = {"spectral": spectra, "accumulation": torch.tensor([1.0, 0.5, 0.0])}
    closed = make_model(
        has_alpha=False, losses=LossConfig(opacity=0.2, spread=0.0, abundances=0.0)
    ).get_loss_dict(outputs, batch)
    assert float(closed["spectral"]) == 0
    assert_close(closed["opacity"], torch.tensor(0.2 * 0.25 / 3))
    with_alpha = make_model(losses=LossConfig(abundances=0.0)).get_loss_dict(outputs, batch)
    assert "opacity" not in with_alpha


def test_the_automatic_background_is_black_without_alpha_and_random_with_it():
    batch = {"spectra": torch.zeros(50, NUM_BANDS), "alpha": torch.ones(50)}
    outputs = {"spectral": torch.zeros(50, NUM_BANDS), "accumulation": torch.zeros(50)}
    losses = [
        float(
            make_model(has_alpha=has, losses=LossConfig(abundances=0.0, spread=0.0)).get_loss_dict(
                outputs, batch
            )["spectral"]
        )
        for has in (False, True)
    ]
    assert losses[0] == 0
    assert 0.2 < losses[1] < 0.5  # the mean square of a grey drawn evenly from [0, 1]


def test_spread_density_is_penalised_early_and_only_where_no_alpha_says_what_is_empty():
    batch = {"spectra": torch.zeros(4, NUM_BANDS), "alpha": torch.ones(4)}
    outputs = {
        "spectral": torch.zeros(4, NUM_BANDS),
        "accumulation": torch.zeros(4),
        "spread": torch.tensor(3.0),
    }
    losses = LossConfig(spread=0.2, spread_until=0.5, abundances=0.0)
    model = make_model(has_alpha=False, losses=losses)
    begin_step = model.get_training_callbacks()[0].func
    found = []
    for progress in (0.0, 0.25, 0.5, 1.0):
        begin_step(1, progress)
        found.append(float(model.get_loss_dict(outputs, batch).get("spread", 0.0)))
    assert found == pytest.approx([0.6, 0.15, 0.0, 0.0])
    with_alpha = make_model(losses=replace(losses, spread="auto"))
    assert "spread" not in with_alpha.get_loss_dict(outputs, batch)


def test_abundances_are_drawn_to_those_that_measured_spectra_show():
    model = make_model(losses=LossConfig(abundances=0.5))
    shown = torch.tensor([0, 2, 1])
    spectra = 0.5 * model.guide.endmembers[shown]
    batch = {"spectra": spectra, "alpha": torch.ones(3), "pixels": torch.arange(3)}
    right = torch.eye(3)[shown]
    losses = [
        float(
            model.get_loss_dict(
                {"spectral": spectra, "accumulation": torch.ones(3), "abundances": abundances}, batch
            )["abundances"]
        )
        for abundances in (right, right.roll(1, dims=1))
    ]
    assert losses[0] < 1e-6
    assert_close(losses[1], 0.5 * 2.0, atol=1e-2, rtol=0)


def test_the_guide_of_abundances_lets_go_of_them_as_training_goes_on():
    model = make_model(losses=LossConfig(abundances=0.5, abundances_final_factor=0.01))
    begin_step = model.get_training_callbacks()[0].func
    batch = {
        "spectra": 0.5 * model.guide.endmembers,
        "alpha": torch.ones(3),
        "pixels": torch.arange(3),
    }
    outputs = {
        "spectral": batch["spectra"],
        "accumulation": torch.ones(3),
        "abundances": torch.eye(3).roll(1, dims=1),
    }
    found = []
    for progress in (0.0, 0.5, 1.0):
        begin_step(1, progress)
        found.append(float(model.get_loss_dict(outputs, batch)["abundances"]))
    assert found == pytest.approx([1.0, 0.1, 0.01], rel=0.01)


def test_an_automatic_number_of_endmembers_is_that_of_the_pixels_said_with_evidence():
    config, reasons = UnmixModelConfig(num_endmembers="auto").resolve_auto(initial_data, torch.Generator())
    assert config.num_endmembers == 3
    assert "proposed" in reasons


@pytest.mark.parametrize(("num_bands", "expected"), [(3, 3), (8, 6)])
def test_without_a_number_there_are_six_endmembers_or_as_many_as_bands(num_bands, expected):
    data = {**initial_data(), "pixels": np.random.default_rng(0).uniform(0.2, 0.8, (50, num_bands))}
    config, reasons = UnmixModelConfig().resolve_auto(lambda: data, torch.Generator())
    assert config.num_endmembers == expected
    assert ("num-endmembers is 3" in reasons) == (num_bands == 3)


def test_settings_without_auto_read_no_data():
    def unread():
        raise AssertionError

    config = UnmixModelConfig(
        num_endmembers=4, light="fixed", poses="fixed", losses=LossConfig(exposure=1.0, band_weights=())
    )
    assert config.resolve_auto(unread, torch.Generator()) == (config, "")


def test_no_model_is_made_before_its_number_of_endmembers_is_resolved():
    with pytest.raises(ConfigError, match="num-endmembers is auto"):
        make_model(num_endmembers="auto")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"rgb": -1.0}, "weights of at least 0"),
        ({"mixing_penalty": -0.1}, "weights of at least 0"),
        ({"spread_until": 0.0}, r"spread-until in \(0, 1\]"),
    ],
)
def test_impossible_losses_are_refused(settings, message):
    with pytest.raises(ConfigError, match=message):
        LossConfig(**settings)


def test_given_endmembers_get_the_brightness_of_the_scene(tmp_path):
    """The pixels are materials of the file at 1.9 times its brightness: amounts above 1 would be needed."""
    shapes = np.eye(3, NUM_BANDS, dtype=np.float32) * 0.6 + 0.1
    path = tmp_path / "materials.csv"
    rows = [
        ",".join(f"{value:g}" for value in (nm, *shapes[:, band])) for band, nm in enumerate(WAVELENGTHS_NM)
    ]
    path.write_text("wavelength,a,b,c\n" + "\n".join(rows) + "\n")
    model = make_model(endmember_init="file", endmember_file=path, train_endmembers=False)
    data = {**initial_data(), "pixels": np.repeat(1.4 * shapes, 40, axis=0) * 0.999}
    with torch.no_grad():
        model.initialise(data, torch.Generator().manual_seed(0))
    assert_close(model.endmembers.detach(), torch.from_numpy(1.4 / 0.75 * shapes), rtol=0.02, atol=0)
    for callback in model.get_training_callbacks():
        callback.func(1, 0.0)
    assert_close(model.endmembers.detach(), torch.from_numpy(1.4 / 0.75 * shapes), rtol=0.02, atol=0)


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
        outputs = model.get_outputs(bundle)
        seen_before = int(model.grid.visibility.num_rays)
        model.observe(outputs, batch)
        assert seen_before == 0
        model.get_training_callbacks()[0].func(0, 0.0)
    return model.grid.occupied.float().mean(dim=(0, 1)).flip(0)


def test_what_no_training_ray_reaches_is_left_out():
    layers = occupied_after_training()
    assert layers[0] > 0.9
    assert not layers[3:].any()


def test_nothing_is_left_out_of_rooms_or_by_request():
    assert occupied_after_training(has_alpha=False).all()
    assert occupied_after_training(visible_weight=1.0).all()


def test_outputs_and_losses_change_nothing_in_the_model():
    model = make_model().train()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    rays = make_rays(16)
    spectra = torch.rand(16, NUM_BANDS)
    batch = {"spectra": spectra, "alpha": torch.ones(16), "pixels": torch.arange(16)}
    losses = model.get_loss_dict(model.get_outputs(rays), batch)
    torch.stack(list(losses.values())).sum().backward()
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())


def test_the_light_and_the_exposure_follow_from_the_data():
    dark = {**initial_data(), "light": np.array("camera")}
    dark["pixels"] = dark["pixels"] / 20
    config, reasons = UnmixModelConfig(num_endmembers=3).resolve_auto(lambda: dark, torch.Generator())
    assert config.light == "camera"
    brightness = np.sqrt(np.square(dark["pixels"]).mean(axis=1))
    assert config.losses.exposure == pytest.approx(0.2 / np.median(brightness), rel=5e-3)
    assert "the scene is dark" in reasons
    assert "the light moves with the camera" in reasons


def test_a_bright_scene_in_a_fixed_light_is_left_as_it_is():
    config, reasons = UnmixModelConfig(num_endmembers=3).resolve_auto(initial_data, torch.Generator())
    assert (config.light, config.losses.exposure, reasons) == ("fixed", 1.0, "")


def test_where_alpha_is_not_trusted_missing_opacity_costs_nothing():
    spectra = torch.full((2, NUM_BANDS), 0.3)
    batch = {"spectra": spectra, "alpha": torch.tensor([1.0, 1.0]), "alpha_trust": torch.tensor([1.0, 0.0])}
    model = make_model(losses=LossConfig(background="white", abundances=0.0, rgb=0.0))
    outputs = {"spectral": spectra, "accumulation": torch.zeros(2)}
    assert float(model.get_loss_dict(outputs, batch)["spectral"]) == pytest.approx(0.5)


def test_images_of_many_pixels_are_sampled_coarsely_at_first():
    renderer = replace(CONFIG.renderer, coarse_samples=10, coarse_until=0.5)
    model = make_model(renderer=renderer).train()
    counts = []
    for progress in (0.0, 0.25, 0.5, 1.0):
        model._progress = progress
        counts.append(int(model.get_outputs(make_rays(50))["num_samples"]))
    assert 2.0 < counts[2] / counts[0] < 2.6  # 23 samples along an edge in the end
    assert counts[0] < counts[1] < counts[2] == counts[3]
    assert int(model.eval().get_outputs(make_rays(50))["num_samples"]) == counts[3]
