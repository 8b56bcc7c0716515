"""Compilation of CUDA kernels by NVRTC, with a disk cache.

Requires cuda-core and NVRTC, available as wheels, but neither a driver nor a GPU.
"""

from __future__ import annotations

import functools
import hashlib
import io
import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ._files import atomic_file

ARCHITECTURES = ("sm_75", "sm_80", "sm_86", "sm_89", "sm_90", "sm_100", "sm_120")
"""Architectures that the tests compile kernels for; others are compiled on first use."""


@dataclass(frozen=True, kw_only=True)
class KernelSource:
    """Kernels that are compiled together.

    Attributes:
        name: name of the source for NVRTC.
        kept_as: prefix of the cubins' file names.
        text: the source.
        folder: include folder.
        fma: whether products are added without intermediate rounding.
        diag_suppress: number of a warning to suppress.
        error: exception to raise, with NVRTC's message, if compilation fails.
    """

    name: str
    kept_as: str
    text: str
    folder: Path
    fma: bool
    error: type[Exception]
    diag_suppress: int | None = None

    def kept(self, architecture: str) -> bytes:
        """The cubin for an architecture (``sm_90``), from the disk where it was compiled before."""
        path = self.path(architecture)
        return path.read_bytes() if path.is_file() else self.compiled(architecture)[0]

    def compiled(self, architecture: str) -> tuple[bytes, str]:
        """The cubin, cached on disk, and the output of ptxas."""
        code, log = self._compile(architecture)
        # Without a cache folder, every start compiles for a few seconds.
        with suppress(OSError), atomic_file(self.path(architecture)) as file:
            file.write(code)
        return code, log

    def path(self, architecture: str) -> Path:
        """Path of the cubin, keyed by source, options, architecture and NVRTC version."""
        options = f"{architecture} {nvrtc_version()} {self.fma} {self.diag_suppress}"
        digest = hashlib.sha256(options.encode() + self.text.encode())
        for path in sorted(self.folder.iterdir()):
            digest.update(path.name.encode() + path.read_bytes())
        digest.update(Path(__file__).read_bytes())  # All other options.
        name = f"{self.kept_as}-{architecture}-{digest.hexdigest()[:16]}.cubin"
        return kernels_folder() / name

    def _compile(self, architecture: str) -> tuple[bytes, str]:
        from cuda.core import Program, ProgramOptions

        log = io.StringIO()
        options = ProgramOptions(
            name=self.name,
            arch=architecture,
            std="c++17",
            include_path=[str(self.folder)],
            fma=self.fma,
            diag_suppress=self.diag_suppress,
            ptxas_options="-v",
        )
        try:
            program = Program(self.text, "c++", options)
            code: Any = program.compile("cubin", logs=log).code
        except Exception as error:
            raise self.error(
                f"NVRTC {nvrtc_version()} does not compile {self.name} for {architecture}: {error}"
            ) from error
        return bytes(code), log.getvalue()


@functools.cache
def nvrtc_version() -> str:
    """Version of the installed NVRTC. Raises the error that prevents loading it."""
    from cuda.bindings import nvrtc

    _, major, minor = nvrtc.nvrtcVersion()
    return f"{major}.{minor}"


def kernels_folder() -> Path:
    """Folder of the kernel cache: ``$TORCH_EXTENSIONS_DIR``, or below the user's cache folder."""
    given = os.environ.get("TORCH_EXTENSIONS_DIR")
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return Path(given) if given else cache / "real2sim"
