"""The serving kernels on the CPU: the CUDA source, compiled as C++.

``cuda_on_cpu.h`` replaces CUDA, and fibers replace the threads of a block. The tests therefore run
the GPU source itself, including its barriers and warp sums. This requires g++. Tests skip without
it.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import shutil
import subprocess
import tempfile
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from real2sim_server.render._cuda.launcher import FOLDER

HERE = Path(__file__).parent
COMPILER = shutil.which("g++")
NEEDS_COMPILER = "the kernels run on the CPU by g++, which is not installed"
FLAGS = ("-std=c++17", "-O2", "-ffp-contract=off", "-fPIC", "-shared", "-U_FORTIFY_SOURCE")
WARNINGS = ("-Wall", "-Wextra", "-Werror", "-Wno-unknown-pragmas", "-Wno-unused-function")
FAULTS = {1: "no such kernel", 2: "threads of a block part ways at a barrier"}


def compiled_twin(
    name: str,
    main: Path,
    *,
    sources: Iterable[Path],
    flags: Sequence[str] = (),
    made: Mapping[str, str] | None = None,
) -> ctypes.CDLL:
    """Compile kernels for the CPU, cached by the content of their sources and flags.

    Args:
        name: prefix of the cached library.
        main: source file that includes all others, from the folders of ``sources``.
        sources: the kernels, and the headers in their folders.
        flags: additional compiler flags.
        made: text of generated headers by file name.
    """
    made = made or {}
    files = sorted({main, *sources, *HERE.glob("*.h")})
    flags = (*FLAGS, *WARNINGS, *flags)
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in files))
    digest.update(repr((sorted(made.items()), flags)).encode())
    folder = Path(tempfile.gettempdir()) / f"real2sim-kernel-twin-{os.getuid()}"
    library = folder / f"{name}-{digest.hexdigest()[:16]}.so"
    if not library.is_file():
        folder.mkdir(exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as making:
            for header, text in made.items():
                (Path(making) / header).write_text(text, encoding="ascii")
            target = Path(making) / library.name
            folders = [making, *sorted({str(path.parent) for path in files})]
            includes = [part for path in folders for part in ("-I", path)]
            command = [str(COMPILER), *flags, *includes, "-o", str(target), str(main)]
            subprocess.run(command, check=True)
            target.replace(library)
    loaded = ctypes.CDLL(str(library))
    arguments = [ctypes.c_char_p, ctypes.c_uint32, ctypes.c_void_p, ctypes.c_uint32, ctypes.c_int]
    loaded.run.argtypes = arguments
    return loaded


@functools.cache
def twin() -> ctypes.CDLL:
    """The compiled serving kernels."""
    loaded = compiled_twin("serving", HERE / "twin.cpp", sources=FOLDER.iterdir())
    for name in ("exponential", "logarithm"):
        function = getattr(loaded, name)
        function.argtypes, function.restype = [ctypes.c_float], ctypes.c_float
    return loaded


class KernelTwin:
    """Base class of launchers that run kernels on the CPU.

    Args:
        kernels: returns the compiled library.
        backwards: run blocks, and the threads of each, in the opposite order.

    Attributes:
        launches: number of launches of each kernel.
    """

    def __init__(self, kernels: Callable[[], ctypes.CDLL], *, backwards: bool) -> None:
        self.device = torch.device("cpu")
        self.launches: Counter[str] = Counter()
        self._kernels, self._backwards = kernels, backwards

    def launch(self, kernel: str, blocks: int, space: int, argument: int = 0) -> None:
        self.launches[kernel] += 1
        fault = self._kernels().run(kernel.encode(), blocks, space, argument, self._backwards)
        assert fault == 0, f"{kernel}: {FAULTS[fault]}"

    def pointer(self, tensor: Tensor) -> int:
        assert tensor.device == self.device
        assert tensor.is_contiguous()
        return int(tensor.data_ptr())

    def host_memory(self, nbytes: int) -> Tensor:
        return torch.empty(nbytes, dtype=torch.uint8)

    def wait(self) -> None:
        """Launches are synchronous."""


class TwinLauncher(KernelTwin):
    """A launcher of the renderer that runs the serving kernels on the CPU."""

    def __init__(self, *, backwards: bool = False) -> None:
        super().__init__(twin, backwards=backwards)

    def copy_out(self, source: Tensor, target: Tensor) -> Callable[[], object]:
        lock, copied = threading.Lock(), []

        def copy() -> None:
            """Copy once, as late as possible, to reveal readers that do not wait."""
            with lock:
                if not copied:
                    copied.append(target.copy_(source))

        return copy
