"""What auto, cpu and cuda mean."""

import pytest
import torch

from unmix_plugin.engine.machine import resolve_device
from unmix_plugin.errors import ConfigError


def test_auto_is_the_cpu_where_there_is_no_cuda(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert resolve_device("auto") == resolve_device("cpu") == torch.device("cpu")


def test_auto_is_cuda_where_there_is_one(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    assert resolve_device("auto") == resolve_device("cuda") == torch.device("cuda", 0)
    assert resolve_device("cpu") == torch.device("cpu")


@pytest.mark.parametrize(("built_for", "advice"), [(None, "install a CUDA build"), ("12.8", "nvidia-smi")])
def test_cuda_without_cuda_is_refused_with_what_to_do(monkeypatch, built_for: str | None, advice: str):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.version, "cuda", built_for)
    with pytest.raises(ConfigError, match=f"--device cuda, but .*{advice}.*leave --device at auto"):
        resolve_device("cuda")


def test_another_word_is_refused():
    with pytest.raises(ConfigError, match="must be auto, cpu or cuda; got 'tpu'"):
        resolve_device("tpu")
