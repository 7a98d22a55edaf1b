"""A GPU for machines that have none: its tensors hold their numbers on the CPU and refuse what a real one refuses.

PyTorch's FakeTensorMode would do, but a CPU build can't make fake CUDA tensors, and without numbers nothing that looks
at them runs. So a device of PyTorch's kind for other backends is registered, named `standin`. A tensor on it wraps one
on the CPU. Arithmetic between it and a tensor on the CPU fails as on CUDA, as do `.numpy()` and random draws with a
generator of the other device. Warp kernels take tensors of it only, and run on the CPU.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map
from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

from unmix_plugin.operators import launching

NAME = "standin"
if not torch.cuda.is_available():  # a device registered beside CUDA would take the gradients from its tensors
    _setup_privateuseone_for_python_backend(NAME)
DEVICE = torch.device("privateuseone", 0)

_INDEXING = {"index", "index_put", "index_put_", "_unsafe_index_put"}
"""Operations that take indices on the CPU on CUDA too."""


class StandInTensor(torch.Tensor):
    """A tensor on the stand-in."""

    held: torch.Tensor
    """Its numbers, on the CPU."""

    @staticmethod
    def __new__(cls, held: torch.Tensor) -> StandInTensor:
        tensor = torch.Tensor._make_wrapper_subclass(
            cls,
            held.size(),
            strides=held.stride(),
            storage_offset=held.storage_offset(),
            dtype=held.dtype,
            layout=held.layout,
            device=DEVICE,
            requires_grad=held.requires_grad,
        )
        tensor.held = held
        return tensor

    def __repr__(self, **_: Any) -> str:
        return f"StandInTensor({self.held})"

    def tolist(self) -> Any:
        """As CUDA tensors can."""
        return self.held.tolist()

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _dispatch(func, args, kwargs or {})


class StandInGenerator(torch.Generator):
    """A generator that says it is on the stand-in."""

    @property
    def device(self) -> torch.device:  # pyright: ignore[reportIncompatibleVariableOverride]
        return DEVICE


class _Generators(type):
    """Of what stands for `torch.Generator` meanwhile: makes generators of either device."""

    def __call__(cls, device: Any = "cpu") -> torch.Generator:
        return StandInGenerator() if torch.device(device).type == NAME else _PLAIN_GENERATOR()

    def __instancecheck__(cls, value: Any) -> bool:
        return isinstance(value, _PLAIN_GENERATOR)


_PLAIN_GENERATOR = torch.Generator
_EitherGenerator = _Generators("Generator", (), {})


class _Mode(TorchDispatchMode):
    """Sends operations to the stand-in that have no tensor of it yet, such as `torch.zeros(..., device=...)`."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _dispatch(func, args, kwargs or {})


class _GeneratorCheck(TorchFunctionMode):
    """Refuses draws on one device with a generator of the other; below Python a generator has lost its class."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        generator = kwargs.get("generator")
        if generator is not None:
            drawn_into = next((arg for arg in args if isinstance(arg, torch.Tensor)), None)
            device = torch.device(
                kwargs.get("device") or (drawn_into.device if drawn_into is not None else "cpu")
            )
            if device.type != generator.device.type:
                raise RuntimeError(
                    f"{func.__name__}: the generator is on {generator.device}, the draw on {device}"
                )
        return func(*args, **kwargs)


@contextmanager
def stand_in_gpu(monkeypatch: pytest.MonkeyPatch) -> Iterator[torch.device]:
    """Context in which tensors can be on the stand-in and kernels take them; gives its device."""
    wp = launching.warp()
    from_torch = wp.from_torch

    def held_memory(tensor: torch.Tensor, **options: Any) -> Any:
        if not isinstance(tensor, StandInTensor):
            raise TypeError("a kernel got a tensor on the CPU beside others on the GPU")
        return from_torch(tensor.held, **options)

    monkeypatch.setattr(wp, "from_torch", held_memory)
    monkeypatch.setattr(torch, "Generator", _EitherGenerator)
    torch._C._set_only_lift_cpu_tensors(True)  # torch.tensor(..., device=...) then passes through the mode
    try:
        with _Mode(), _GeneratorCheck():
            yield DEVICE
    finally:
        torch._C._set_only_lift_cpu_tensors(False)


def _dispatch(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, torch.Tensor)]
    is_here = any(isinstance(tensor, StandInTensor) for tensor in tensors)
    wanted = kwargs.get("device")
    name = func.overloadpacket.__name__
    goes_here = is_here if wanted is None else torch.device(wanted).type == NAME
    if name not in {"_to_copy", "copy_"} | _INDEXING and is_here:
        _refuse_mixture(func, tensors)
    plain_kwargs = {key: torch.device("cpu") if key == "device" else _held(kwargs[key]) for key in kwargs}
    result = func(*tree_map(_held, args), **plain_kwargs)
    if name == "copy_":
        return args[0]
    known = {id(tensor.held): tensor for tensor in tensors if isinstance(tensor, StandInTensor)}

    def wrap(value: Any) -> Any:
        if not isinstance(value, torch.Tensor) or not goes_here:
            return value
        return known[id(value)] if id(value) in known else StandInTensor(value)

    return tree_map(wrap, result)


def _held(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return type(value)(_held(item) for item in value)
    return value.held if isinstance(value, StandInTensor) else value


def _refuse_mixture(func: Any, tensors: list[torch.Tensor]) -> None:
    if any(not isinstance(tensor, StandInTensor) and tensor.dim() > 0 for tensor in tensors):
        raise RuntimeError(f"{func}: expected all tensors on one device, found {NAME} and cpu")
