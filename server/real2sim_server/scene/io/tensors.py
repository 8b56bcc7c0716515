"""Tensor files of a bundle: safetensors, hashed tensor by tensor."""

from __future__ import annotations

import hashlib
from collections.abc import Container, Mapping
from pathlib import Path
from types import MappingProxyType

import torch
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file
from torch import Tensor

from ..cloud import GaussianCloud
from ..errors import BundleError
from ..figure import Figure
from ..lidar_surfaces import Reflector
from .document import UNCERTAINTIES


def cloud_tensors(cloud: GaussianCloud) -> dict[str, Tensor]:
    """Tensors of a cloud by field name, on the CPU and contiguous."""
    return {name: tensor.detach().cpu().contiguous() for name, tensor in cloud.tensors().items()}


def cloud_shapes(
    gaussians: int, sh_degree: int, *, known: Container[str] = ()
) -> dict[str, tuple[int, ...]]:
    """Shapes of a cloud's tensors by field name; of those that may be missing if ``known``."""
    n = gaussians
    shapes: dict[str, tuple[int, ...]] = {
        "means": (n, 3),
        "quats": (n, 4),
        "scales": (n, 3),
        "opacities": (n,),
        "sh": (n, (sh_degree + 1) ** 2, 3),
    }
    if UNCERTAINTIES in known:
        shapes[UNCERTAINTIES] = (n,)
    return shapes


def figure_tensors(figure: Figure) -> dict[str, Tensor]:
    """Tensors of a figure by field name, contiguous."""
    return {"joints": figure.joints.contiguous(), "weights": figure.weights.contiguous()}


def figure_shapes(gaussians: int) -> dict[str, tuple[int, ...]]:
    """Shapes of :func:`figure_tensors`."""
    return {"joints": (gaussians, 4), "weights": (gaussians, 4)}


def reflector_tensors(reflector: Reflector) -> dict[str, Tensor]:
    """Tensors of what LiDARs see by name, on the CPU and contiguous;
    colours and what is known of them are not kept."""
    tensors = cloud_tensors(reflector.cloud)
    for name in ("sh", UNCERTAINTIES):
        tensors.pop(name, None)
    return tensors | {"attributes": reflector.attributes.detach().cpu().contiguous()}


def reflector_shapes(gaussians: int) -> dict[str, tuple[int, ...]]:
    """Shapes of :func:`reflector_tensors`."""
    shapes = cloud_shapes(gaussians, 0)
    del shapes["sh"]
    return shapes | {"attributes": (gaussians, 2)}


def tensor_hash(tensor: Tensor) -> str:
    """SHA-256 of the bytes of a contiguous CPU tensor, little-endian, row-major."""
    return hashlib.sha256(tensor.numpy().data).hexdigest()


def tensor_hashes(tensors: Mapping[str, Tensor]) -> dict[str, str]:
    """:func:`tensor_hash` of each."""
    return {name: tensor_hash(tensor) for name, tensor in tensors.items()}


def write_tensors(tensors: Mapping[str, Tensor], path: Path) -> int:
    """Write a new safetensors file; its length in bytes."""
    save_file({name: tensor.numpy() for name, tensor in tensors.items()}, path)
    # The library writes for the owner alone; a service often runs as somebody else.
    path.chmod(path.parent.stat().st_mode & 0o666)
    return path.stat().st_size


class TensorFile:
    """A safetensors file of a bundle, memory-mapped.

    Args:
        path: the file.
        nbytes: how long it must be.
        verify: compare the hash of every tensor taken.

    Raises:
        BundleError: missing, a link, of another length, or no safetensors file.
    """

    def __init__(self, path: Path, *, nbytes: int, verify: bool) -> None:
        self.path = path
        self.verify = verify
        check_file(path, nbytes)
        try:
            with safe_open(path, framework="pt", device="cpu") as file:
                keys = file.keys()
                self._tensors: dict[str, Tensor] = {key: file.get_tensor(key) for key in keys}
        except (SafetensorError, OSError) as error:
            raise BundleError(f"{path}: no readable safetensors file: {error}") from error

    def take(
        self,
        prefix: str,
        *,
        shapes: Mapping[str, tuple[int, ...]],
        hashes: Mapping[str, str],
        dtypes: Mapping[str, torch.dtype] = MappingProxyType({}),
    ) -> dict[str, Tensor]:
        """The tensors stored under ``prefix`` + name for each name in ``shapes``; float32 where
        ``dtypes`` names no other type.

        Raises:
            BundleError: one is missing, has another shape or type or, when verifying, another
                hash than in ``hashes``.
        """
        if set(hashes) != set(shapes):
            raise BundleError(
                f"{self.path}: scene.json gives hashes of {sorted(hashes)}, not of {list(shapes)}"
            )
        return {
            name: self._one(prefix + name, shape, dtypes.get(name, torch.float32), hashes[name])
            for name, shape in shapes.items()
        }

    def _one(self, key: str, shape: tuple[int, ...], dtype: torch.dtype, expected: str) -> Tensor:
        tensor = self._tensors.get(key)
        if tensor is None:
            raise BundleError(f"{self.path}: has no tensor {key!r}")
        if tuple(tensor.shape) != shape or tensor.dtype != dtype:
            raise BundleError(
                f"{self.path}: tensor {key!r} is {tensor.dtype} {list(tensor.shape)}, "
                f"scene.json asks for {dtype} {list(shape)}"
            )
        if self.verify and tensor_hash(tensor) != expected:
            raise BundleError(
                f"{self.path}: tensor {key!r} does not have the SHA-256 that scene.json gives; "
                "the bundle was changed or damaged, copy or save it again"
            )
        return tensor


def check_file(path: Path, nbytes: int) -> None:
    """Raise BundleError unless ``path`` is a plain file of ``nbytes`` bytes."""
    if path.is_symlink() or not path.is_file():
        raise BundleError(f"{path}: missing or no plain file; the bundle is incomplete")
    actual = path.stat().st_size
    if actual != nbytes:
        raise BundleError(
            f"{path}: has {actual} bytes where scene.json says {nbytes}; "
            "the bundle is cut short or damaged, copy or save it again"
        )
