"""A pretended torch device. Every operation runs on the CPU.

Its tensors report ``pretended:0``. As with CUDA, an operation on tensors of two devices and a
conversion to NumPy raise errors. Kernel launches, copies and waits are counted. This tests the code
of a GPU worker on a machine without a GPU. It applies to all threads.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch.utils._pytree import tree_leaves, tree_map
from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

aten = torch.ops.aten

# Before the first backward pass of this process: torch then fixes its set of devices.
_setup_privateuseone_for_python_backend("pretended")
DEVICE = torch.device("pretended:0")

TAKES_BOTH = {aten.copy_.default, aten._to_copy.default}
"""Operations that accept tensors of two devices."""
INDEXED = {aten.index.Tensor, aten.index_put.default, aten.index_put_.default}
"""CPU indices are allowed for tensors on the device."""
WAITING = {aten.nonzero.default, aten._unique2.default, aten.masked_select.default}
VIEWS = ("view", "slice", "select", "transpose", "t.default", "permute", "squeeze", "expand")
VIEWS += ("detach", "alias", "as_strided", "split", "unbind", "diagonal", "lift_fresh", "unfold")


FACTORIES = ("tensor", "as_tensor", "eye", "arange", "linspace")
"""torch creates these tensors without a visible operation."""


@dataclass
class Counts:
    """Operations on the device."""

    launches: int = 0
    to_device: int = 0
    to_host: int = 0
    waits: int = 0


counts = Counts()


class MixedDevicesError(RuntimeError):
    """An operation received tensors of two devices."""


class Pretended(torch.Tensor):
    """A tensor that reports the pretended device. ``held`` contains its values."""

    held: torch.Tensor

    @staticmethod
    def __new__(cls, held: torch.Tensor) -> Pretended:
        made = torch.Tensor._make_wrapper_subclass(
            cls,
            held.size(),
            strides=held.stride(),
            storage_offset=held.storage_offset(),
            dtype=held.dtype,
            device=torch.device("pretended:0"),
        )
        made.held = held
        return made

    def __repr__(self) -> str:
        return f"Pretended({self.held})"

    def numpy(self, **_: Any) -> Any:
        raise TypeError("a tensor on the pretended device is not a NumPy array; copy it by cpu()")

    def __array__(self, *_: Any, **__: Any) -> Any:
        raise TypeError("a tensor on the pretended device is not a NumPy array; copy it by cpu()")

    def new_tensor(self, data: Any, **options: Any) -> torch.Tensor:
        return torch.tensor(data, **{"dtype": self.dtype, "device": self.device, **options})

    def tolist(self) -> Any:
        return self.cpu().tolist()

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):  # type: ignore[no-untyped-def]
        return run(func, args, kwargs or {})


def held(value: Any) -> Any:
    """The CPU tensor of a pretended tensor. Other values are returned unchanged."""
    return value.held if isinstance(value, Pretended) else value


def run(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """Run an operation on the CPU after checking the devices of its tensors."""
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, torch.Tensor)]
    here = [tensor for tensor in tensors if isinstance(tensor, Pretended)]
    _check(func, args, tensors, here)
    device = kwargs.get("device")
    to_device = device is not None and torch.device(device).type == "pretended"
    to_host = device is not None and not to_device
    given = tree_map(held, dict(kwargs))
    if device is not None:
        given["device"] = torch.device("cpu")
    given.pop("pin_memory", None)
    out = func(*tree_map(held, args), **given)
    _count(func, args, here, to_host=to_host)
    if to_host or (not here and not to_device):
        return out
    if func._schema.name.endswith("_") and isinstance(args[0], Pretended):
        return args[0]
    return tree_map(lambda t: Pretended(t) if isinstance(t, torch.Tensor) else t, out)


def _check(func: Any, args: Any, tensors: list[Any], here: list[Any]) -> None:
    elsewhere = [t for t in tensors if not isinstance(t, Pretended)]
    if not here or not elsewhere or func in TAKES_BOTH:
        return
    if func in INDEXED and isinstance(args[0], Pretended):
        values = args[2] if len(args) > 2 else None
        elsewhere = [t for t in (values,) if t is not None and not isinstance(t, Pretended)]
    if func in INDEXED and not isinstance(args[0], Pretended):
        raise MixedDevicesError(f"{func}: a tensor on cpu is indexed by one on pretended:0")
    shapes = [tuple(t.shape) for t in elsewhere if t.dim() > 0]
    if shapes or (func._schema.name.endswith("_") and not isinstance(args[0], Pretended)):
        raise MixedDevicesError(
            f"{func}: expected all tensors on one device, found pretended:0 and cpu {shapes}"
        )


def _count(func: Any, args: Any, here: list[Any], *, to_host: bool) -> None:
    name = str(func)
    if to_host and here:
        counts.to_host += 1
        counts.waits += 1
        on_copy(args[0].shape)
        return
    if func is aten._local_scalar_dense.default or func in WAITING:
        counts.waits += bool(here)
    elif func is aten.index.Tensor and here:
        counts.waits += any(i is not None and i.dtype == torch.bool for i in args[1])
    if func is aten.copy_.default:
        target, source = (isinstance(a, Pretended) for a in args[:2])
        counts.to_device += target and not source
        counts.to_host += source and not target
        counts.waits += source and not target
        if target != source:
            on_copy(args[1].shape)
    elif here and not any(view in name for view in VIEWS):
        counts.launches += 1


def on_copy(shape: torch.Size) -> None:
    """Hook for tests, called with the shape of each copy to or from the device."""


@contextmanager
def pretending() -> Iterator[Counts]:
    """Activate the device inside the block, with counts reset to zero."""
    plain = {name: getattr(torch, name) for name in FACTORIES}
    for name, make in plain.items():
        setattr(torch, name, functools.partial(_made, make))
    counts.__init__()  # type: ignore[misc]
    try:
        yield counts
    finally:
        for name, make in plain.items():
            setattr(torch, name, make)


def _made(make: Any, *args: Any, device: Any = None, **options: Any) -> torch.Tensor:
    if device is None or torch.device(device).type != "pretended":
        return make(*args, **options) if device is None else make(*args, device=device, **options)
    return make(*args, **options).to(device)


_library = torch.library.Library("_", "IMPL")
_library.fallback(lambda func, *args, **kwargs: run(func, args, kwargs), "PrivateUse1")
