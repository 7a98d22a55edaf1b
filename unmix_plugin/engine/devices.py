"""Which device to compute on."""

import torch

from unmix_plugin.errors import ConfigError


def resolve_device(name: str) -> torch.device:
    """The device that `auto`, `cpu` or `cuda` means on this machine.

    Raises:
        ConfigError: CUDA was asked for and there is none, or the word is none of the three.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise ConfigError(f"--device must be auto, cpu or cuda; got {name!r}")
    if name == "cpu" or (name == "auto" and not torch.cuda.is_available()):
        return torch.device("cpu")
    if torch.cuda.is_available():
        return torch.device("cuda", torch.cuda.current_device())
    cause = (
        "this PyTorch is built without CUDA: install a CUDA build (https://pytorch.org/get-started)"
        if torch.version.cuda is None
        else "PyTorch finds no usable GPU: check nvidia-smi and the driver"
    )
    raise ConfigError(f"--device cuda, but {cause}; or leave --device at auto, which takes the CPU here")
