"""What the backend needs, what of it is here, and what to do about the rest."""

from __future__ import annotations

from ..cuda.gsplat_build import INSTALL
from ..cuda.needs import Need, device_need, installed_version, torch_need


def nvrtc_needs() -> list[Need]:
    """All needs, in the order in which they are to be mended."""
    return [torch_need(), device_need(), *compiler_needs()]


def compiler_needs() -> list[Need]:
    """What compiling the kernels needs, with a GPU or without."""
    return [_cuda_core(), _nvrtc()]


def unmet_need() -> Need | None:
    """The first that is not met, or None where the backend can draw."""
    return next((need for need in nvrtc_needs() if not need.met), None)


def _cuda_core() -> Need:
    version = installed_version("cuda-core")
    if version is None:
        return Need("cuda-core", False, "cuda-core is not installed", INSTALL)
    return Need("cuda-core", True, f"cuda-core {version}")


def _nvrtc() -> Need:
    if installed_version("cuda-core") is None:
        return Need("NVRTC", False, "NVRTC is called through cuda-core", INSTALL)
    from ...._nvrtc import nvrtc_version
    from .compile import ARCHITECTURES, cubin_path

    try:
        version = nvrtc_version()
    except Exception as error:
        return Need("NVRTC", False, f"NVRTC cannot be loaded: {error}", INSTALL)
    kept = [name for name in ARCHITECTURES if cubin_path(name).is_file()]
    state = f"compiled for {', '.join(kept)}" if kept else "not compiled yet, which takes a second"
    return Need("NVRTC", True, f"NVRTC {version}; serving kernels {state}")
