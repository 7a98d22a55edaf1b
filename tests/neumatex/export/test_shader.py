"""The exported decoder is the trained one: its numbers, and its GLSL run by a browser."""

import json
import re

import numpy as np
import pytest
import torch

from tests.factories.commands import CHROMIUM, FLAGS
from tests.factories.surfaces import eye_directions, generator, numbers
from unmix_plugin.neumatex.export.shader import shader_paths, write_shader
from unmix_plugin.neumatex.tracing.layers import ggx_albedo, mean_ggx_albedo
from unmix_plugin.neumatex.tracing.neural import Decoder, NeuralFamily


@pytest.fixture(scope="module")
def family():
    return NeuralFamily()


@pytest.fixture(scope="module")
def written(family, tmp_path_factory):
    folder = tmp_path_factory.mktemp("shader")
    assert write_shader(folder, family) == shader_paths(folder)
    return folder


def test_the_numbers_are_those_of_the_decoder_and_of_the_tables(family, written):
    constants = json.loads((written / "decoder.json").read_text())
    decoder = Decoder()
    with torch.no_grad():
        for index, layer in enumerate([*decoder.hidden, decoder.last]):
            for name in ("weight", "bias"):
                parameter = getattr(layer, name)
                parameter.copy_(torch.tensor(constants[f"{name.upper()}_{index}"]).reshape(parameter.shape))
        latents = torch.rand(50, 6, generator=generator())
        torch.testing.assert_close(decoder.numbers(latents), family.decoder.numbers(latents), rtol=0, atol=0)
    rows, columns = constants["ROWS"], constants["COLUMNS"]
    tables = torch.tensor([constants[name] for name in ("GGX_A", "GGX_B", "SHEEN")]).reshape(3, rows, columns)
    roughness = torch.linspace(0, 1, rows)
    for column in (5, columns - 1):
        cosine = torch.full((rows,), (column / (columns - 1)) ** 2)
        torch.testing.assert_close(tables[:2, :, column], ggx_albedo(roughness[None], cosine)[:, 0])
    means = torch.tensor([constants["GGX_MEAN_A"], constants["GGX_MEAN_B"]])
    torch.testing.assert_close(means, mean_ggx_albedo(roughness[None])[:, 0])
    text = (written / "decoder.glsl").read_text()
    assert "diffuse_colour, latents_a and latents_b" in " ".join(text[:600].replace("//", "").split())
    declared = re.findall(r"^const \w+ ([A-Z0-9_]+)", text, re.MULTILINE)
    assert set(constants) - {"about"} <= set(declared)


PAGE = """async ([source, inputs, count]) => {
  const gl = document.createElement('canvas').getContext('webgl2');
  if (!gl || !gl.getExtension('EXT_color_buffer_float')) return null;
  const shader = (kind, text) => {
    const one = gl.createShader(kind);
    gl.shaderSource(one, text); gl.compileShader(one);
    if (!gl.getShaderParameter(one, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(one));
    return one;
  };
  const program = gl.createProgram();
  gl.attachShader(program, shader(gl.VERTEX_SHADER, `#version 300 es
    void main() { gl_Position = vec4(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0, 0.0, 1.0); }`));
  gl.attachShader(program, shader(gl.FRAGMENT_SHADER, source));
  gl.linkProgram(program); gl.useProgram(program);
  const texture = (data, width, height) => {
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, width, height, 0, gl.RGBA, gl.FLOAT, data);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    return gl.getParameter(gl.TEXTURE_BINDING_2D);
  };
  const target = texture(null, count, 1);
  gl.bindFramebuffer(gl.FRAMEBUFFER, gl.createFramebuffer());
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, target, 0);
  texture(new Float32Array(inputs), 5, count);
  gl.viewport(0, 0, count, 1);
  gl.drawArrays(gl.TRIANGLES, 0, 3);
  const out = new Float32Array(4 * count);
  gl.readPixels(0, 0, count, 1, gl.RGBA, gl.FLOAT, out);
  return Array.from(out);
}"""

MAIN = """
uniform sampler2D inputs;
out vec4 colour;
vec3 at(int i) { return texelFetch(inputs, ivec2(i, int(gl_FragCoord.x)), 0).rgb; }
void main() { colour = vec4(reflectance(at(0), at(1), at(2), at(3), at(4)), 1.0); }
"""


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
def test_the_shader_itself_gives_the_reflectance_of_the_family(family, written):
    playwright = pytest.importorskip("playwright.sync_api")
    parameters, wi, wo = numbers(24, 9), eye_directions(24, seed=3), eye_directions(24, seed=4)
    wi[::4] = wo[::4] * torch.tensor([-1.0, -1.0, 1.0])  # mirror directions
    wi[3] = -wi[3]  # light from below
    with torch.no_grad():
        expected = family.evaluate(parameters, wi, wo).numpy()
    parts = [*parameters.split(3, dim=1), wi, wo]
    inputs = torch.stack([torch.nn.functional.pad(one, (0, 1)) for one in parts], dim=1)
    head = "#version 300 es\nprecision highp float;\nprecision highp int;\n"
    source = head + (written / "decoder.glsl").read_text() + MAIN
    with playwright.sync_playwright() as session:
        browser = session.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        found = browser.new_page().evaluate(PAGE, [source, inputs.reshape(-1).tolist(), 24])
        browser.close()
    if found is None:
        pytest.skip("the browser has no WebGL 2 with float targets")
    np.testing.assert_allclose(np.array(found).reshape(24, 4)[:, :3], expected, rtol=5e-3, atol=1e-4)
