"""Compiling the kernels by NVRTC, and keeping what was compiled.

Needs cuda-core and NVRTC, which come as wheels, and neither a driver nor a GPU.
"""

from __future__ import annotations

import functools
import hashlib
import io
from contextlib import suppress
from pathlib import Path
from typing import Any

from ...._files import atomic_file
from ...types import RenderError
from ..cuda.gsplat_build import kernels_folder
from .usage import Usage, usage_of

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
ARCHITECTURES = ("sm_75", "sm_80", "sm_86", "sm_89", "sm_90", "sm_100", "sm_120")
"""Those that the kernels are compiled for in the tests; others are compiled when they are met."""


def compiled_kernels(architecture: str) -> bytes:
    """The cubin for an architecture (``sm_90``), from the disk where it was compiled before.

    Raises:
        RenderError: it does not compile; the message has NVRTC's words.
    """
    path = cubin_path(architecture)
    return path.read_bytes() if path.is_file() else compile_kernels(architecture)[0]


def compile_kernels(architecture: str) -> tuple[bytes, dict[str, Usage]]:
    """Cubin, which is kept on the disk, and what each kernel takes.

    Raises:
        RenderError: see :func:`compiled_kernels`.
    """
    code, log = _compile(architecture)
    # Without a place to keep it, it is compiled at every start: a second.
    with suppress(OSError), atomic_file(cubin_path(architecture)) as file:
        file.write(code)
    return code, usage_of(log)


def _compile(architecture: str) -> tuple[bytes, str]:
    """Cubin, and what ptxas says about it."""
    from cuda.core import Program, ProgramOptions

    log = io.StringIO()
    options = ProgramOptions(
        name=SOURCE.name,
        arch=architecture,
        std="c++17",
        include_path=[str(FOLDER)],
        # Sums and products are rounded one by one, as on the CPU; fmaf stands where it is wanted.
        fma=False,
        ptxas_options="-v",
    )
    try:
        program = Program(SOURCE.read_text(encoding="ascii"), "c++", options)
        code: Any = program.compile("cubin", logs=log).code
    except Exception as error:
        raise RenderError(
            f"NVRTC {nvrtc_version()} does not compile the kernels for {architecture}: {error}"
        ) from error
    return bytes(code), log.getvalue()


def cubin_path(architecture: str) -> Path:
    """Where the cubin is kept: by source, architecture and NVRTC."""
    digest = hashlib.sha256(f"{architecture} {nvrtc_version()}".encode())
    for path in sorted(FOLDER.iterdir()):
        digest.update(path.name.encode() + path.read_bytes())
    digest.update(Path(__file__).read_bytes())  # Its options.
    return kernels_folder() / f"serving-{architecture}-{digest.hexdigest()[:16]}.cubin"


@functools.cache
def nvrtc_version() -> str:
    """Of the NVRTC that compiles here. Raises whatever keeps it from being loaded."""
    from cuda.bindings import nvrtc

    _, major, minor = nvrtc.nvrtcVersion()
    return f"{major}.{minor}"
