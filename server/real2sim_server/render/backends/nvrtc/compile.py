"""The serving kernels, compiled by NVRTC."""

from __future__ import annotations

from pathlib import Path

from ...._nvrtc import ARCHITECTURES, KernelSource
from ...types import RenderError
from .usage import Usage, usage_of

__all__ = [
    "ARCHITECTURES",
    "FOLDER",
    "KERNELS",
    "SOURCE",
    "compile_kernels",
    "compiled_kernels",
    "cubin_path",
]

FOLDER = Path(__file__).parent / "kernels"
SOURCE = FOLDER / "serving.cu"
KERNELS = (
    "find_seen",
    "project_seen",
    "count_digits",
    "scatter_digits",
    "count_pairs",
    "make_pairs",
    "find_ranges",
    "blend",
)


def compiled_kernels(architecture: str) -> bytes:
    """The cubin for an architecture (``sm_90``), from the disk where it was compiled before.

    Raises:
        RenderError: it does not compile; the message has NVRTC's words.
    """
    return _source().kept(architecture)


def compile_kernels(architecture: str) -> tuple[bytes, dict[str, Usage]]:
    """Cubin, which is kept on the disk, and what each kernel takes.

    Raises:
        RenderError: see :func:`compiled_kernels`.
    """
    code, log = _source().compiled(architecture)
    return code, usage_of(log)


def cubin_path(architecture: str) -> Path:
    """Where the cubin is kept."""
    return _source().path(architecture)


def _source() -> KernelSource:
    return KernelSource(
        name=SOURCE.name,
        kept_as="serving",
        text=SOURCE.read_text(encoding="ascii"),
        folder=FOLDER,
        # Sums and products are rounded one by one, as on the CPU; fmaf stands where it is wanted.
        fma=False,
        error=RenderError,
    )
