"""Every kernel compiles for CUDA, also on machines without a GPU: Warp brings NVIDIA's compiler along."""

from __future__ import annotations

import pytest

from tests.factories.models import CAMERA, make_model
from unmix_plugin.operators import compositing, hash_encoding, marching, merging
from unmix_plugin.operators.launching import warp

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def _specialised() -> None:
    """Generic kernels exist for the types that they were launched with."""
    model = make_model()
    model.warm_up()
    field, bundle = model.field, CAMERA.image_rays(0)
    model.renderer.normals(field, bundle, bundle.origins.new_full((len(bundle),), 4.0))


@pytest.mark.parametrize("module", [marching, hash_encoding, compositing, merging])
@pytest.mark.usefixtures("_specialised")
def test_kernels_compile_to_code_for_a_gpu(module, tmp_path):
    warp().compile_aot_module(module, arch=80, module_dir=tmp_path, use_ptx=True)
    (compiled,) = tmp_path.glob("*.ptx")
    text = compiled.read_text()
    launched = [kernel for kernel in vars(module).values() if isinstance(kernel, warp().Kernel)]
    assert launched
    for kernel in launched:
        assert f".entry {kernel.key}" in text
