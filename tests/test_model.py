"""The method's equations, its outputs and its settings."""

from typing import Any

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from tests.method_factory import CAMERA, NUM_BANDS, WAVELENGTHS_NM, initial_data, make_model, make_rays
from unmix_plugin.errors import ConfigError, SpectrumError
from unmix_plugin.model import UnmixModel, UnmixModelConfig
from unmix_plugin.renderer import _points
from unmix_plugin.rendering.compositing import volume_weights_twin


def naive_spectra(model: UnmixModel, rays) -> torch.Tensor:
    """The paper's sum: a spectrum of B bands at every sample, composited ray by ray."""
    samples = model.renderer._march(rays)
    positions, along = _points(samples, rays)
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
    from dataclasses import replace

    from tests.method_factory import CONFIG

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


def test_spectrum_is_diffuse_plus_specular_and_abundances_sum_to_accumulation():
    model = make_model()
    outputs = model.get_outputs_for_camera(
        CAMERA, ["spectral", "diffuse", "specular", "abundances", "accumulation"]
    )
    assert_close(outputs["spectral"], outputs["diffuse"] + outputs["specular"])
    assert_close(outputs["abundances"].sum(-1), outputs["accumulation"], rtol=1e-5, atol=1e-6)
    assert outputs["accumulation"].max() <= 1 + 1e-5
    assert outputs["accumulation"][0, 0] == 0 or outputs["accumulation"].min() < 1


def test_samples_without_weight_change_little_when_left_out():
    from dataclasses import replace

    from tests.method_factory import CONFIG

    model, rays = make_model(), make_rays(40)
    everything = model.get_outputs(rays)["spectral"]
    model.renderer.config = replace(CONFIG.renderer, smallest_weight=1e-3, open_smallest_weight=1e-3)
    assert_close(model.get_outputs(rays)["spectral"], everything, rtol=0, atol=0.04)


def test_a_ray_that_misses_the_box_sees_black_and_nothing():
    outputs = make_model().get_outputs(make_rays(5))
    assert outputs["spectral"][-1].abs().sum() == 0
    assert outputs["accumulation"][-1] == 0


def test_a_last_colour_background_closes_every_ray_that_meets_something():
    outputs = make_model(background="last").get_outputs(make_rays(20))
    assert_close(outputs["accumulation"][:-1], torch.ones(19))
    assert outputs["accumulation"][-1] == 0


@pytest.mark.parametrize("background", ["random", "black", "white"])
def test_a_perfect_prediction_has_no_loss_over_any_background(background):
    model = make_model(background=background, rgb_loss_weight=1.0, abundance_loss_weight=0.0)
    spectra, alpha = torch.rand(8, NUM_BANDS), torch.rand(8)
    losses = model.get_loss_dict(
        {"spectral": spectra, "accumulation": alpha}, {"spectra": spectra, "alpha": alpha}
    )
    assert set(losses) == {"spectral", "rgb"}
    assert all(float(loss) < 1e-12 for loss in losses.values())


def test_colours_count_by_default_where_alpha_tells_black_from_the_void():
    spectra, alpha = torch.rand(8, NUM_BANDS), torch.ones(8)
    outputs = {"spectral": spectra / 2, "accumulation": alpha, "haze": torch.zeros(())}
    losses = {
        has_alpha: make_model(has_alpha=has_alpha, abundance_loss_weight=0.0).get_loss_dict(
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
            make_model(background=b, abundance_loss_weight=0.0).get_loss_dict(outputs, batch)["spectral"]
        )
        for b in ("black", "white")
    }
    assert losses == {"black": 0.0, "white": 1.0}


def test_brighter_than_a_saturated_sensor_is_no_error_but_darker_is():
    model = make_model(background="black", abundance_loss_weight=0.0)
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


def test_depth_is_along_the_viewing_axis_and_normals_face_the_camera():
    model = make_model(light=None)
    with torch.no_grad():
        model.field.table.zero_()
        model.field.log_initial_density = 8.0
    outputs = model.get_outputs_for_camera(CAMERA, ["depth", "ray_distance", "accumulation", "normals"])
    seen = outputs["accumulation"] > 0.99
    assert seen.sum() > 20
    # The opaque box's front face lies at z = 1, three units before the camera.
    assert_close(outputs["depth"][seen], torch.full_like(outputs["depth"][seen], 3.0), atol=0.09, rtol=0)
    assert (outputs["ray_distance"][seen] >= outputs["depth"][seen]).all()
    lengths = outputs["normals"].norm(dim=-1)
    assert ((lengths - 1).abs() < 1e-4)[lengths > 0].all()
    assert (outputs["depth"][~(outputs["accumulation"] > 0)] == 0).all()


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
    assert_close(model.endmembers.detach(), expected)
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
        ({"initial_opacity": 1.0}, r"initial opacities in \(0, 1\)"),
        ({"rgb_loss_weight": -1.0}, "loss weights and the mixing-penalty of at least 0"),
        ({"mixing_penalty": -0.1}, "loss weights and the mixing-penalty of at least 0"),
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


def test_an_unknown_output_is_refused_with_the_known_ones():
    with pytest.raises(ConfigError, match=r"no output named bogus; known: .*abundances.*band:<nm>"):
        make_model().get_outputs_for_camera(CAMERA, ["bogus"])


def test_a_band_is_that_plane_of_the_spectrum():
    outputs = make_model().get_outputs_for_camera(
        CAMERA, ["spectral", "band:560nm", "false-colour:650,550,450"]
    )
    spectra = outputs["spectral"]
    assert torch.equal(outputs["band:560nm"], spectra[..., WAVELENGTHS_NM.index(550.0)])
    assert_close(outputs["false-colour:650,550,450"], spectra[..., [4, 2, 0]].clamp(0, 1))


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
    settings: dict[str, Any] = {
        "opacity_loss_weight": 0.2,
        "haze_loss_weight": 0.0,
        "abundance_loss_weight": 0.0,
    }
    closed = make_model(has_alpha=False, **settings).get_loss_dict(outputs, batch)
    assert float(closed["spectral"]) == 0
    assert_close(closed["opacity"], torch.tensor(0.2 * 0.25 / 3))
    assert "opacity" not in make_model(has_alpha=True, **settings).get_loss_dict(outputs, batch)


def test_the_automatic_background_is_black_without_alpha_and_random_with_it():
    batch = {"spectra": torch.zeros(50, NUM_BANDS), "alpha": torch.ones(50)}
    outputs = {"spectral": torch.zeros(50, NUM_BANDS), "accumulation": torch.zeros(50)}
    losses = [
        float(
            make_model(has_alpha=has, abundance_loss_weight=0.0, haze_loss_weight=0.0).get_loss_dict(
                outputs, batch
            )["spectral"]
        )
        for has in (False, True)
    ]
    assert losses[0] == 0
    assert 0.2 < losses[1] < 0.5  # the mean square of a grey drawn evenly from [0, 1]


def test_haze_is_penalised_early_and_only_where_no_alpha_says_what_is_empty():
    batch = {"spectra": torch.zeros(4, NUM_BANDS), "alpha": torch.ones(4)}
    outputs = {
        "spectral": torch.zeros(4, NUM_BANDS),
        "accumulation": torch.zeros(4),
        "haze": torch.tensor(3.0),
    }
    settings: dict[str, Any] = {"haze_loss_weight": 0.2, "haze_loss_until": 0.5, "abundance_loss_weight": 0.0}
    model = make_model(has_alpha=False, **settings)
    begin_step = model.get_training_callbacks()[0].func
    found = []
    for progress in (0.0, 0.25, 0.5, 1.0):
        begin_step(1, progress)
        found.append(float(model.get_loss_dict(outputs, batch).get("haze", 0.0)))
    assert found == pytest.approx([0.6, 0.15, 0.0, 0.0])
    assert "haze" not in make_model(has_alpha=True, **settings).get_loss_dict(outputs, batch)


def test_abundances_are_drawn_to_those_that_measured_spectra_show():
    model = make_model(abundance_loss_weight=0.5)
    shown = torch.tensor([0, 2, 1])
    spectra = 0.5 * model.mixture_guide.endmembers[shown]
    batch = {"spectra": spectra, "alpha": torch.ones(3)}
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
    model = make_model(abundance_loss_weight=0.5, abundance_loss_final_factor=0.01)
    begin_step = model.get_training_callbacks()[0].func
    batch = {"spectra": 0.5 * model.mixture_guide.endmembers, "alpha": torch.ones(3)}
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


def test_a_given_number_of_endmembers_reads_no_data():
    def unread():
        raise AssertionError

    config = UnmixModelConfig(num_endmembers=4)
    assert config.resolve_auto(unread, torch.Generator()) == (config, "")


def test_no_model_is_made_before_its_number_of_endmembers_is_resolved():
    with pytest.raises(ConfigError, match="num-endmembers is auto"):
        make_model(num_endmembers="auto")
