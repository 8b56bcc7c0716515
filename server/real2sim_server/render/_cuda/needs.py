"""Requirements of the CUDA backends, their state on this machine, and how to meet missing ones.

The checks neither load gsplat nor compile anything, so they are fast enough for every start.
:func:`try_without_device` tests everything that needs no GPU.
"""

from __future__ import annotations

import importlib.metadata
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from .gsplat_build import (
    CUDA_TORCH,
    INSTALL,
    BuiltKernels,
    built_kernels,
    cuda_folders,
    gsplat_package,
    load_kernels,
)

DRIVER = (
    "install an NVIDIA driver that is new enough for this CUDA (nvidia-smi shows both); start a "
    "container with --gpus all, or with docker/compose.gpu.yml"
)
BUILD = "real2sim doctor --build-gpu"
GSPLAT = ((1, 5), (1, 6))
"""Supported gsplat versions, end-exclusive: 1.6 changes the call of spherical_harmonics."""


@dataclass(frozen=True)
class Need:
    """A requirement of a backend.

    Attributes:
        name: name of the requirement.
        met: whether it is met.
        found: the version or device found, or the problem.
        remedy: how to meet it; empty if it is met.
        of_device: whether it requires a GPU.
    """

    name: str
    met: bool
    found: str
    remedy: str = ""
    of_device: bool = False


def cuda_needs() -> list[Need]:
    """All requirements of the gsplat backend, in the order in which to fix them."""
    return [torch_need(), device_need(), _gsplat(), _numba_cuda(), _nvvm(), _kernels()]


def unmet_gsplat_need(*, without_device: bool = False) -> Need | None:
    """The first requirement that is not met, or None if the backend is usable.

    Args:
        without_device: ignore requirements that need a GPU.
    """
    for need in cuda_needs():
        if not need.met and not (without_device and need.of_device):
            return need
    return None


def kernels_for_device() -> BuiltKernels | None:
    """Compiled kernels for the GPU of this machine; without a GPU, the latest ones."""
    built = built_kernels()
    if torch.cuda.is_available():
        capability = torch.cuda.get_device_capability()
        built = [kernels for kernels in built if kernels.serves(capability)]
    return built[-1] if built else None


def try_without_device() -> None:
    """Load gsplat's kernels and compile the instance kernel; neither requires a driver.

    Raises:
        RenderError: the kernels cannot be loaded.
        Exception: any error of Numba's compiler.
    """
    from numba import cuda

    kernels = kernels_for_device()
    if kernels is not None:
        load_kernels(kernels)
    from .gsplat_images import find_instances, instance_signature

    compile_ptx: Any = cuda.compile_ptx  # type: ignore[attr-defined]
    compile_ptx(find_instances.py_func, instance_signature(), cc=(9, 0))


def torch_need() -> Need:
    """A torch build with CUDA."""
    version = torch.version.cuda
    if version is None:
        return Need("torch", False, f"torch {torch.__version__} is built for CPU only", CUDA_TORCH)
    return Need("torch", True, f"torch {torch.__version__} for CUDA {version}")


def device_need() -> Need:
    """A GPU that torch can use."""
    if not torch.cuda.is_available():
        return Need("device", False, "torch sees no CUDA device", DRIVER, of_device=True)
    major, minor = torch.cuda.get_device_capability()
    return Need(
        "device", True, f"{torch.cuda.get_device_name()}, sm_{major}{minor}", of_device=True
    )


def _gsplat() -> Need:
    version = installed_version("gsplat")
    if version is None:
        return Need("gsplat", False, "gsplat is not installed", INSTALL)
    lowest, above = GSPLAT
    if not lowest <= tuple(int(part) for part in version.split(".")[:2]) < above:
        return Need("gsplat", False, f"gsplat {version} has other functions than 1.5", INSTALL)
    return Need("gsplat", True, f"gsplat {version}")


def _kernels() -> Need:
    package = gsplat_package()
    if package is not None and any(package.glob("csrc*.so")):
        return Need("kernels", True, "gsplat brings its kernels compiled")
    kernels = kernels_for_device()
    if kernels is None:
        built = sorted({name for kernels in built_kernels() for name in kernels.architectures})
        found = (
            f"gsplat's kernels are compiled for {', '.join(built)} only"
            if built
            else ("gsplat's kernels are not compiled for this torch")
        )
        return Need("kernels", False, found, BUILD)
    names = ", ".join(kernels.architectures)
    return Need("kernels", True, f"{kernels.library} for {names}")


def _numba_cuda() -> Need:
    version = installed_version("numba-cuda")
    if version is None:
        return Need("numba-cuda", False, "numba-cuda is not installed", INSTALL)
    return Need("numba-cuda", True, f"numba-cuda {version}")


def _nvvm() -> Need:
    """NVVM, with which Numba compiles instance images and physics."""
    library = next(_nvvm_libraries(), None)
    if library is None:
        return Need("libnvvm", False, "libnvvm is not installed", INSTALL)
    return Need("libnvvm", True, str(library))


def _nvvm_libraries() -> Iterator[Path]:
    for root in cuda_folders():
        for folder in ("nvvm/lib64", "lib", "lib64"):
            yield from sorted((root / folder).glob("libnvvm.so*"))


def installed_version(distribution: str) -> str | None:
    """Version of a distribution, or None if it is not installed."""
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


# Requirements of NVRTC


def nvrtc_needs() -> list[Need]:
    """All requirements of the NVRTC backend, in the order in which to fix them."""
    return [torch_need(), device_need(), *compiler_needs()]


def compiler_needs() -> list[Need]:
    """Requirements for compiling the kernels, with or without a GPU."""
    return [_cuda_core(), _nvrtc()]


def unmet_nvrtc_need() -> Need | None:
    """The first requirement that is not met, or None if the backend is usable."""
    return next((need for need in nvrtc_needs() if not need.met), None)


def _cuda_core() -> Need:
    version = installed_version("cuda-core")
    if version is None:
        return Need("cuda-core", False, "cuda-core is not installed", INSTALL)
    return Need("cuda-core", True, f"cuda-core {version}")


def _nvrtc() -> Need:
    if installed_version("cuda-core") is None:
        return Need("NVRTC", False, "NVRTC is called through cuda-core", INSTALL)
    from ..._nvrtc import nvrtc_version
    from .launcher import ARCHITECTURES, cubin_path

    try:
        version = nvrtc_version()
    except Exception as error:
        return Need("NVRTC", False, f"NVRTC cannot be loaded: {error}", INSTALL)
    kept = [name for name in ARCHITECTURES if cubin_path(name).is_file()]
    state = f"compiled for {', '.join(kept)}" if kept else "not compiled yet, which takes a second"
    return Need("NVRTC", True, f"NVRTC {version}; serving kernels {state}")
