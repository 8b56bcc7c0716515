"""The solver's kernels, compiled by NVRTC."""

from __future__ import annotations

from ...._nvrtc import ARCHITECTURES, KernelSource
from ....render._cuda.launcher import Usage, usage_of
from ...errors import SolverError
from .source import FOLDER, SOURCE, solver_source

__all__ = ["ARCHITECTURES", "compile_kernels", "compiled_kernels"]


def compiled_kernels(precision: str, architecture: str) -> bytes:
    """The cubin for ``single`` or ``double`` and an architecture (``sm_90``), kept on the disk.

    Raises:
        SolverError: it does not compile; the message has NVRTC's words.
    """
    return _source(precision).kept(architecture)


def compile_kernels(precision: str, architecture: str) -> tuple[bytes, dict[str, Usage]]:
    """Cubin, which is kept on the disk, and what each kernel takes.

    Raises:
        SolverError: see :func:`compiled_kernels`.
    """
    code, log = _source(precision).compiled(architecture)
    return code, usage_of(log)


def _source(precision: str) -> KernelSource:
    return KernelSource(
        name=SOURCE.name,
        kept_as=f"solver-{precision}",
        text=solver_source(precision),
        folder=FOLDER,
        fma=True,  # As the CPU's kernels do.
        diag_suppress=39,  # A law that is none divides by zero on purpose.
        error=SolverError,
    )
