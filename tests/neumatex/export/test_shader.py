"""The exported decoder is the trained one: its numbers evaluated with NumPy, and its GLSL run by a browser."""

import json

import numpy as np
import pytest
import torch

from tests.commands.browser import CHROMIUM, FLAGS
from unmix_plugin.neumatex.export.shader import shader_paths, write_shader
from unmix_plugin.neumatex.tracing.neural import NeuralFamily


@pytest.fixture(scope="module")
def family():
    return NeuralFamily()


@pytest.fixture(scope="module")
def written(family, tmp_path_factory):
    folder = tmp_path_factory.mktemp("shader")
    assert write_shader(folder, family) == shader_paths(folder)
    return folder


def cases(family, count=64):
    """Materials of the whole range and directions above the surface, and the reflectance that torch gives."""
    g = torch.Generator().manual_seed(5)
    parameters = torch.rand(count, 9, generator=g)
    wi, wo = (torch.nn.functional.normalize(torch.randn(count, 3, generator=g), dim=-1) for _ in range(2))
    wi[:, 2], wo[:, 2] = wi[:, 2].abs(), wo[:, 2].abs()
    wi[::4] = wo[::4] * torch.tensor([-1.0, -1.0, 1.0])  # mirror directions
    wi[3] = -wi[3]
    with torch.no_grad():
        values = family.evaluate(parameters, wi, wo)
    return (one.double().numpy() for one in (parameters, wi, wo, values))


def decoded(c, latents):
    """The numbers of the layers, as the description says."""

    def layer(index, x):
        weight = np.array(c[f"WEIGHT_{index}"]).reshape(len(c[f"BIAS_{index}"]), -1)
        return x @ weight.T + np.array(c[f"BIAS_{index}"])

    x = 2 * latents - 1
    for index in (0, 1):
        x = layer(index, x)
        x = x / (1 + np.exp(-x))
    return (1 / (1 + np.exp(-layer(2, x)))).T


def looked_up(c, name, roughness, cosine):
    table = np.array(c[name]).reshape(c["ROWS"], c["COLUMNS"])
    row, column = roughness * (c["ROWS"] - 1), np.sqrt(cosine.clip(0, 1)) * (c["COLUMNS"] - 1)
    i, j = row.astype(int).clip(0, c["ROWS"] - 2), column.astype(int).clip(0, c["COLUMNS"] - 2)
    y, x = row - i, column - j
    upper = (1 - x) * table[i, j] + x * table[i, j + 1]
    return (1 - y) * upper + y * ((1 - x) * table[i + 1, j] + x * table[i + 1, j + 1])


def lobe(roughness, cosine, sine2, ni, no):
    """A GGX lobe with its masking, by the half vector's cosine and squared sine."""
    a2 = (0.002 + 0.998 * roughness**2) ** 2
    density = a2 / (np.pi * np.maximum(a2 * cosine**2 + sine2, 1e-9) ** 2)
    masks = ni * np.sqrt(no**2 + a2 * (1 - no**2)) + no * np.sqrt(ni**2 + a2 * (1 - ni**2))
    return density * 0.5 / masks


def dust_light(c, cover, light, eye):
    """What a cover of dust reflects, given the parts of light that pass it to the surface and to the eye."""
    places, weights = np.array(c["NODE_PLACES"]), np.array(c["NODE_WEIGHTS"])
    mean_held = 1 - (2 * weights * places * (1 - cover[:, None]) ** (1 / places)).sum(axis=1)
    return (1 - light) * (1 - eye) / mean_held * np.array(c["DUST_COLOUR"])[:, None] / np.pi


def reflectance(c, parameters, wi, wo):
    """The shader's arithmetic in NumPy, from the numbers in decoder.json alone."""
    n = decoded(c, parameters[:, 3:])
    cover, sheen_colour, sheen_rough, coat = (
        c["LARGEST_COVER"] * n[0],
        c["LARGEST_SHEEN"] * n[1:4],
        n[4],
        n[5],
    )
    rough = [c["LARGEST_COAT_ROUGHNESS"] * n[6], n[7], n[7] + (1 - n[7]) * n[8]]
    haze, metal, f0 = c["LARGEST_HAZE"] * n[9], n[10], c["LARGEST_DIELECTRIC_F0"] * n[14]
    below = []
    for cosine in (wi[:, 2], wo[:, 2]):
        a, b = ([looked_up(c, f"GGX_{letter}", one, cosine) for one in rough] for letter in ("A", "B"))
        held = [f0 * a[i] + b[i] for i in (1, 2)]
        below.append(
            (
                (1 - cover) ** (1 / cosine),
                1 - sheen_colour.max(axis=0) * looked_up(c, "SHEEN", sheen_rough, cosine),
                1 - coat * (0.04 * a[0] + b[0]),
                1 - (1 - haze) * held[0] - haze * held[1],
            )
        )
    light, eye = below
    dust = light[0] * eye[0]
    sheen = dust * light[1] * eye[1]
    coated = sheen * light[2] * eye[2]
    half = wi + wo
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    edge = (1 - (half * wo).sum(axis=1)) ** 5
    sine2, ni, no = half[:, 0] ** 2 + half[:, 1] ** 2, wi[:, 2], wo[:, 2]
    lobes = [lobe(one, half[:, 2], sine2, ni, no) for one in rough]
    width = 1 / (c["SMALLEST_SHEEN_WIDTH"] + (1 - c["SMALLEST_SHEEN_WIDTH"]) * sheen_rough)
    cloth = (2 + width) / (2 * np.pi) * np.maximum(sine2, 1e-12) ** (width / 2) / (4 * (ni + no - ni * no))
    dusty = dust_light(c, cover, light[0], eye[0])
    rows = np.linspace(0, 1, c["ROWS"])
    means = [
        f0 * np.interp(one, rows, c["GGX_MEAN_A"]) + np.interp(one, rows, c["GGX_MEAN_B"])
        for one in rough[1:]
    ]
    passed = coated * (1 - metal) * light[3] * eye[3] / (1 - (1 - haze) * means[0] - haze * means[1])
    normal = f0 + metal * (n[11:14] - f0)
    specular = (
        coated * ((1 - haze) * lobes[1] + haze * lobes[2]) * (normal + (1 - normal) * edge)
        + sheen * coat * (0.04 + 0.96 * edge) * lobes[0]
        + dust * cloth * sheen_colour
        + dusty
    )
    above = ((ni > 0) & (no > 0))[:, None]
    return np.where(above, (passed * parameters[:, :3].T / np.pi + specular).T, 0)


@pytest.mark.filterwarnings("ignore:invalid value", "ignore:overflow", "ignore:divide by zero")
def test_the_numbers_give_the_reflectance_of_the_family(family, written):
    constants = json.loads((written / "decoder.json").read_text())
    parameters, wi, wo, expected = cases(family)
    found = reflectance(constants, parameters, wi, wo)
    np.testing.assert_allclose(found, expected, rtol=2e-3, atol=1e-5)
    assert (found[3] == 0).all()  # light from below


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
    parameters, wi, wo, expected = cases(family, 24)
    parts = [parameters[:, :3], parameters[:, 3:6], parameters[:, 6:], wi, wo]
    inputs = np.stack([np.pad(one, ((0, 0), (0, 1))) for one in parts], axis=1)
    head = "#version 300 es\nprecision highp float;\nprecision highp int;\n"
    source = head + (written / "decoder.glsl").read_text() + MAIN
    with playwright.sync_playwright() as session:
        browser = session.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        found = browser.new_page().evaluate(PAGE, [source, inputs.reshape(-1).tolist(), 24])
        browser.close()
    if found is None:
        pytest.skip("the browser has no WebGL 2 with float targets")
    np.testing.assert_allclose(np.array(found).reshape(24, 4)[:, :3], expected, rtol=5e-3, atol=1e-4)
