"""The kernels of cast(), compiled by NVRTC."""

from __future__ import annotations

from pathlib import Path

from ...._nvrtc import KernelSource
from ...backends.nvrtc.usage import Usage, usage_of
from ...types import RenderError

FOLDER = Path(__file__).parent / "kernels"
SOURCE = FOLDER / "cast.cu"
KERNELS = ("prepare", "list_tiles", "follow")


def compiled_kernels(architecture: str) -> bytes:
    """The cubin for an architecture (``sm_90``), from the disk where it was compiled before.

    Raises:
        RenderError: it does not compile; the message has NVRTC's words.
    """
    return _source().kept(architecture)


def compile_kernels(architecture: str) -> tuple[bytes, dict[str, Usage]]:
    """Cubin, which is kept on the disk, and what each kernel takes. Raises like the other."""
    code, log = _source().compiled(architecture)
    return code, usage_of(log)


def _source() -> KernelSource:
    return KernelSource(
        name=SOURCE.name,
        kept_as="cast",
        text=SOURCE.read_text(encoding="ascii"),
        folder=FOLDER,
        fma=False,
        error=RenderError,
    )
