"""What a page knows of an object: against closed forms on a ball, and opened in a browser."""

from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from tests.factories.commands import CHROMIUM, FLAGS, HAS_BROWSER, SOFTWARE_GL, done
from tests.factories.objects import trained_on, write_object, write_spectral_object
from tests.factories.surfaces import Uniform, ball, mesh_from
from unmix_plugin.commands.export import export
from unmix_plugin.neumatex.export import page
from unmix_plugin.neumatex.fit.tone import tone_curve
from unmix_plugin.neumatex.tracing.environment import Environment, directions_of_pixels
from unmix_plugin.neumatex.tracing.families import PbrFamily
from unmix_plugin.neumatex.tracing.mesh import mesh_of
from unmix_plugin.scenes.scene import Normalisation

WORLD = Normalisation(np.eye(3), np.zeros(3), 1.0)


def content_of(mesh, albedo=0.5, resolution=8, **lights):
    """What a page has of an object of one matt material."""
    surface: Any = Uniform(PbrFamily(), [albedo] * 3 + [1.0, 0.0])
    lights = lights or {"white": Environment(torch.ones(8, 16, 3))}
    return page.page_content(
        page.ObjectForPage(mesh, surface, None, tone_curve("srgb"), WORLD, lights, {}), resolution
    )


def matt_light(content) -> np.ndarray:
    """What a white matt surface at each vertex sends back of the first light, as the page works it out."""
    return content.arrays["transfer"] @ np.array(content.facts["lights"][0]["harmonics"])


def test_a_ball_gets_light_as_a_cosine_lobe_and_a_white_sky_makes_it_white():
    white = content_of(ball(2), sky=Environment(torch.full((8, 16, 3), 0.7)))
    np.testing.assert_allclose(matt_light(white), 0.7, atol=0.01)
    z = directions_of_pixels(64, 128)[..., 2:]
    uneven = content_of(ball(2), sky=Environment((1 + z + z**2 + z**3).clamp(min=0).expand(-1, -1, 3)))
    z = uneven.arrays["normals"][:, 2]
    # Shares of degrees 0 to 3: 1, 2/3, 1/4, 0 (Ramamoorthi and Hanrahan 2001), of z^3 = 3/5 z + 2/5 P3.
    expected = 1 + (2 / 3 + 2 / 5) * z + 1 / 3 + (3 * z**2 - 1) / 12
    np.testing.assert_allclose(matt_light(uneven), expected[:, None].repeat(3, axis=1), atol=0.03)


def test_what_an_object_hides_of_the_sky_comes_back_from_it_in_part():
    """Inside a hollow ball nothing of the sky arrives, and all of one reflection of nothing is nothing."""
    mesh = ball(3)
    hollow = mesh_of(mesh.vertices, mesh.faces.flip(1), -mesh.normals)
    assert np.abs(content_of(hollow, 1.0).arrays["transfer"]).max() == 0
    floor = trimesh.creation.box((2.0, 2.0, 0.02)).subdivide_to_size(0.2)
    wall = trimesh.creation.box((0.02, 2.0, 2.0), trimesh.transformations.translation_matrix([1.0, 0, 1.0]))
    corner = mesh_from(floor, wall.subdivide_to_size(0.2))
    near = ((corner.vertices - torch.tensor([0.9, 0.0, 0.01])).norm(dim=1)).argmin()
    dark, bright = (content_of(corner, albedo).arrays["transfer"][near, 0] for albedo in (0.0, 0.8))
    assert 0.282 * 0.4 < dark < 0.282 * 0.8
    assert dark * 1.1 < bright < 0.282


def test_blurred_lights_keep_an_even_sky_and_spread_a_sun_by_roughness():
    sun = torch.zeros(48, 96, 3)
    sun[24, 48] = 1000.0
    content = content_of(ball(1), even=Environment(torch.full((48, 96, 3), 0.5)), sun=Environment(sun))
    columns, rows, levels = content.facts["relit"]["map"]
    found = content.arrays["mirrored"].view("<f2").reshape(2, levels, rows, columns, 4).astype(np.float32)
    np.testing.assert_allclose(found[0], np.broadcast_to([0.5, 0.5, 0.5, 1.0], found[0].shape), rtol=1e-3)
    peaks = found[1, ..., 0].max(axis=(1, 2))
    assert (np.diff(peaks) < 0).all()
    assert 300 < peaks[0] <= 1000


def test_large_triangles_are_split_and_millions_merged_with_normals_kept(monkeypatch):
    finer = content_of(ball(1), resolution=20).arrays
    assert len(finer["faces"]) > 16 * len(ball(1).faces)
    monkeypatch.setattr(page, "_MOST_TRIANGLES", 2000)
    fewer = content_of(ball(5), resolution=10)
    positions, normals = fewer.arrays["positions"], fewer.arrays["normals"]
    assert 300 < len(fewer.arrays["faces"]) < 0.5 * len(ball(5).faces)
    assert any("is reduced to" in note for note in fewer.facts["notes"])
    assert np.abs(np.linalg.norm(positions, axis=1) - 1).max() < 0.03
    assert (normals * positions).sum(axis=1).min() > 0.95


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
