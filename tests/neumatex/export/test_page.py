"""What a page knows of an object: against closed forms on a ball, and opened in a browser."""

import numpy as np
import pytest
import torch
import trimesh

from tests.factories.commands import CHROMIUM, FLAGS, HAS_BROWSER, SOFTWARE_GL, done
from tests.factories.objects import trained_on, write_object, write_spectral_object
from tests.factories.surfaces import ball, mesh_from
from unmix_plugin.commands.export import export
from unmix_plugin.neumatex.export import page
from unmix_plugin.neumatex.tracing.environment import Environment
from unmix_plugin.neumatex.tracing.mesh import mesh_of


def test_a_ball_gets_light_as_a_cosine_lobe_and_a_white_sky_makes_it_white():
    mesh = ball(2)
    transfer = page._transfer(mesh, torch.ones(len(mesh.vertices)))
    harmonics = page._harmonics(mesh.normals)
    shares = [1.0] + [2 / 3] * 3 + [1 / 4] * 5 + [0.0] * 7  # Ramamoorthi and Hanrahan 2001
    torch.testing.assert_close(transfer, harmonics * torch.tensor(shares), atol=0.02, rtol=0)
    sky = page._projected(page._picture(Environment(torch.full((8, 16, 3), 0.7)), None))
    torch.testing.assert_close(transfer @ sky, torch.full((len(mesh.vertices), 3), 0.7), atol=0.01, rtol=0)


def test_what_an_object_hides_of_the_sky_comes_back_from_it_in_part():
    """Inside a hollow ball nothing of the sky arrives, and all of one reflection of nothing is nothing."""
    mesh = ball(3)
    hollow = mesh_of(mesh.vertices, mesh.faces.flip(1), -mesh.normals)
    assert page._transfer(hollow, torch.ones(len(mesh.vertices))).abs().max() == 0
    floor = trimesh.creation.box((2.0, 2.0, 0.02)).subdivide_to_size(0.2)
    wall = trimesh.creation.box((0.02, 2.0, 2.0), trimesh.transformations.translation_matrix([1.0, 0, 1.0]))
    corner = mesh_from(floor, wall.subdivide_to_size(0.2))
    near = ((corner.vertices - torch.tensor([0.9, 0.0, 0.01])).norm(dim=1)).argmin()
    dark, bright = (
        page._transfer(corner, torch.full((len(corner.vertices),), part))[near, 0] for part in (0.0, 0.8)
    )
    assert 0.282 * 0.4 < dark < 0.282 * 0.8
    assert dark * 1.1 < bright < 0.282


def test_blurred_lights_keep_an_even_sky_and_spread_a_sun_by_roughness():
    even = torch.full((1, *page._MAP, 3), 0.5)
    sun = torch.zeros(1, *page._MAP, 3)
    sun[0, 24, 48] = 1000.0
    found = torch.from_numpy(page._blurred(torch.cat([even, sun])).numpy().astype(np.float32))
    found = found.reshape(2, page._LEVELS, *page._MAP, 4)
    torch.testing.assert_close(found[0], torch.tensor([0.5, 0.5, 0.5, 1.0]).expand_as(found[0]))
    peaks = found[1, :, 24, 48, 0]
    assert (peaks.diff() < 0).all()
    assert peaks[0] == 1000


def test_large_triangles_are_split_and_millions_merged_with_normals_kept(monkeypatch):
    finer = page._resampled(ball(1), 0.1)
    assert len(finer.faces) > 16 * len(ball(1).faces)
    monkeypatch.setattr(page, "_MOST_TRIANGLES", 2000)
    fewer = page._resampled(ball(5), 0.2)
    assert 300 < len(fewer.faces) < 0.5 * len(ball(5).faces)
    assert (fewer.vertices.norm(dim=1) - 1).abs().max() < 0.03
    assert ((fewer.normals * fewer.vertices).sum(dim=1)).min() > 0.95


@pytest.mark.slow
@pytest.mark.skipif(not HAS_BROWSER, reason="needs the package playwright and the program chromium")
@pytest.mark.parametrize("kind", ["colours", "bands"])
def test_the_page_of_an_object_turns_its_light_and_shows_its_material(kind, tmp_path):
    from playwright.sync_api import sync_playwright

    folder = (write_object if kind == "colours" else write_spectral_object)(tmp_path / "ball")
    material = "pbr" if kind == "colours" else "spectral"
    run = trained_on(folder, f"--pipeline.model.material={material}", steps=2)
    place = ["--run", run, "--output", tmp_path]
    done(export, "page", *place, "--resolution", 24, "--title", "<i>ball</i>")
    with sync_playwright() as session:
        browser = session.chromium.launch(executable_path=CHROMIUM, args=[FLAGS[1], *SOFTWARE_GL])
        opened, said = browser.new_page(viewport={"width": 300, "height": 300}), []
        opened.on("console", lambda message: said.append(message.text))
        opened.on("pageerror", lambda error: said.append(str(error)))
        opened.goto((tmp_path / "page.html").as_uri())
        opened.wait_for_function("window.unmixPage")
        shown = {}
        for layer in opened.evaluate(
            "[...document.querySelectorAll('#layer option')].map((one) => one.value)"
        ):
            opened.evaluate(f"unmixPage.choose('{layer}')")
            shown[layer] = opened.evaluate("(unmixPage.draw(), document.querySelector('canvas').toDataURL())")
        opened.evaluate("unmixPage.choose('colour')")
        opened.evaluate(
            "(document.getElementById('light').value = 4, document.getElementById('light').onchange())"
        )
        relit = opened.evaluate("(unmixPage.draw(), document.querySelector('canvas').toDataURL())")
        found = opened.evaluate("unmixPage.pick(150, 100)")
        browser.close()
    own = ["band", "false", "abundance", "materials", "index"] if kind == "bands" else []
    assert list(shown) == ["colour", "base", "roughness", "metallicity", *own]
    assert len(set(shown.values())) >= 4 + len(own[:2])
    assert relit != shown["colour"]
    assert len(found["finish"]) == 5
    assert len(found["spectrum"]) == (0 if kind == "colours" else 5)
    assert said == []
