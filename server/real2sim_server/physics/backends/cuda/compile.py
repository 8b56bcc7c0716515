"""Compiling the solver's kernels by NVRTC, and keeping what was compiled.

Needs cuda-core and NVRTC, which come as wheels, and neither a driver nor a GPU.
"""

from __future__ import annotations

import hashlib
import io
from contextlib import suppress
from pathlib import Path
from typing import Any

from ...._files import atomic_file
from ....render.backends.cuda.gsplat_build import kernels_folder
from ....render.backends.nvrtc.compile import ARCHITECTURES, nvrtc_version
from ....render.backends.nvrtc.usage import Usage, usage_of
from ...errors import SolverError
from .source import FOLDER, SOURCE, solver_source

__all__ = ["ARCHITECTURES", "compile_kernels", "compiled_kernels"]


def compiled_kernels(precision: str, architecture: str) -> bytes:
    """The cubin for ``single`` or ``double`` and an architecture (``sm_90``), kept on the disk.

    Raises:
        SolverError: it does not compile; the message has NVRTC's words.
    """
    path = cubin_path(precision, architecture)
    if path.is_file():
        return path.read_bytes()
    return compile_kernels(precision, architecture)[0]


def compile_kernels(precision: str, architecture: str) -> tuple[bytes, dict[str, Usage]]:
    """Cubin, which is kept on the disk, and what each kernel takes.

    Raises:
        SolverError: see :func:`compiled_kernels`.
    """
    code, log = _compile(precision, architecture)
    # Without a place to keep it, it is compiled at every start: seconds.
    with suppress(OSError), atomic_file(cubin_path(precision, architecture)) as file:
        file.write(code)
    return code, usage_of(log)


def _compile(precision: str, architecture: str) -> tuple[bytes, str]:
    """Cubin, and what ptxas says about it."""
    from cuda.core import Program, ProgramOptions

    log = io.StringIO()
    options = ProgramOptions(
        name=SOURCE.name,
        arch=architecture,
        std="c++17",
        include_path=[str(FOLDER)],
        # Products are added without rounding in between, as the CPU's kernels do.
        fma=True,
        diag_suppress=39,  # A law that is none divides by zero on purpose.
        ptxas_options="-v",
    )
    try:
        program = Program(solver_source(precision), "c++", options)
        code: Any = program.compile("cubin", logs=log).code
    except Exception as error:
        raise SolverError(
            f"NVRTC {nvrtc_version()} does not compile the solver for {architecture}: {error}"
        ) from error
    return bytes(code), log.getvalue()


def cubin_path(precision: str, architecture: str) -> Path:
    """Where the cubin is kept: by all of its source, architecture and NVRTC."""
    digest = hashlib.sha256(f"{architecture} {nvrtc_version()}".encode())
    digest.update(solver_source(precision).encode())
    for path in sorted(FOLDER.iterdir()):
        digest.update(path.name.encode() + path.read_bytes())
    digest.update(Path(__file__).read_bytes())  # Its options.
    name = f"solver-{precision}-{architecture}-{digest.hexdigest()[:16]}.cubin"
    return kernels_folder() / name
