"""How work items are handed out to threads."""

import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from typing import no_type_check

import pytest
import torch
import warp as wp
from torch.testing import assert_close

from unmix_plugin.operators.compositing import accumulate, volume_weights
from unmix_plugin.operators.hash_encoding import HashGridLayout, hash_encode
from unmix_plugin.operators.launching import as_warp, launch, vector_type, warp
from unmix_plugin.operators.marching import rays_in_box
from unmix_plugin.operators.occupancy import skip_distances


@wp.kernel(enable_backward=False)
@no_type_check
def visit_kernel(first: int, end: int, stride: int, amount: float, visits: wp.array(dtype=float)):
    item = first + wp.tid()
    while item < end:
        visits[item] = visits[item] + amount
        item += stride


@wp.kernel(enable_backward=False)
@no_type_check
def first_of_part_kernel(first: int, end: int, stride: int, starts: wp.array(dtype=int)):
    item = first + wp.tid()
    while item < end:
        starts[item] = first
        item += stride


@pytest.fixture
def threads():
    """Sets torch's number of threads; puts the old one back."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.mark.slow
def test_where_kernels_cannot_be_kept_they_are_compiled_in_a_temporary_folder(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    code = (
        "from unmix_plugin.operators.launching import warp\n"
        "from pathlib import Path\n"
        "print(Path(warp().config.kernel_cache_dir, 'x').write_bytes(b'x'), warp().config.kernel_cache_dir)"
    )
    environment = {**os.environ, "WARP_CACHE_PATH": str(tmp_path / "file" / "cache"), "TMPDIR": str(tmp_path)}
    ended = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert ended.stdout.startswith(f"1 {tmp_path}/unmix-kernels-")
    assert ended.stderr.count("compiled anew for this command") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("size", [0, 1, 511, 1025, 10_000])
@pytest.mark.parametrize("cpu_part", [None, 1000])
@pytest.mark.parametrize("num_threads", [1, 2, 5])
def test_each_work_item_is_done_once(size, cpu_part, num_threads, threads, device):
    threads(num_threads)
    visits = torch.zeros(size, device=device)
    launch(visit_kernel, size, [1.0, as_warp(visits)], visits.device, cpu_part)
    assert torch.equal(visits, torch.ones_like(visits))


def test_a_part_holds_as_many_items_as_were_asked_for(threads):
    threads(3)
    starts = torch.empty(2500, dtype=torch.int32)
    launch(first_of_part_kernel, len(starts), [as_warp(starts)], starts.device, cpu_part=1000)
    assert torch.equal(starts, (torch.arange(2500) // 1000 * 1000).int())


def test_vectors_share_the_memory_of_the_tensor_they_are_made_from():
    tensor = torch.zeros(4, 3, 2, requires_grad=True)
    array = as_warp(tensor, vector_type(2, torch.float32))
    assert array.descriptor.data == tensor.data_ptr()
    assert array.annotation.ndim == 2
    assert not array.descriptor.grad


def test_values_and_gradients_are_the_same_to_the_bit_for_any_number_of_threads(threads):
    """What lets a resumed run be the straight one."""
    found = []
    for num_threads in (1, 2, 3):
        threads(num_threads)
        found.append(everything_from(torch.Generator().manual_seed(4)))
    for other in found[1:]:
        for one, same in zip(found[0], other, strict=True):
            assert torch.equal(one, same)


def everything_from(generator: torch.Generator) -> tuple[torch.Tensor, ...]:
    """Samples, encodings and totals of random rays, and the gradients back to table, depths and values."""
    layout = HashGridLayout(3, 4, 4, 40, 8)
    num_rays = 1500
    origins = torch.rand(num_rays, 3, generator=generator)
    directions = torch.rand(num_rays, 3, generator=generator) - origins
    skips = skip_distances(torch.rand(8, 8, 8, generator=generator) < 0.5)
    zeros, ones = torch.zeros(num_rays), torch.ones(num_rays)
    samples = rays_in_box(origins, directions, zeros, ones, 0.5 * ones, skips, 0.05).samples()
    positions = origins[samples.ray_indices] + samples.t[:, None] * directions[samples.ray_indices]
    table = torch.randn(layout.num_rows, 4, generator=generator).requires_grad_()
    encoded = hash_encode(positions, table, layout)
    depths = (0.3 * encoded[:, 0].detach().exp()).requires_grad_()
    totals = accumulate(volume_weights(depths, samples.packed_info), encoded, samples.packed_info)
    cotangent = torch.randn(totals.shape, generator=generator)
    gradients = torch.autograd.grad(totals, (table, depths), cotangent)
    assert_close(samples.packed_info[:, 1].sum().item(), len(samples))
    return samples.t, samples.packed_info, encoded.detach(), totals.detach(), *gradients


def test_threads_that_need_warp_first_at_once_leave_the_process_its_standard_error(monkeypatch):
    monkeypatch.setattr(wp, "init", lambda: time.sleep(0.05))  # as long as a real one
    before = os.fstat(2)

    def first(turn: int) -> None:
        time.sleep(0.01 * turn)
        warp.__wrapped__()

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(first, range(4)))
    after = os.fstat(2)
    assert (after.st_dev, after.st_ino) == (before.st_dev, before.st_ino)
