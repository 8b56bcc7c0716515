"""The solver's kernels on the CPU: their own source, compiled as C++; see ``render.kernel_twin``.

What is compiled here is what NVRTC gets, line for line, the functions translated from Python
included. Needs g++, as CI's machines have it; tests skip where it is not.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import subprocess
import tempfile
from collections import Counter
from pathlib import Path

import torch
from torch import Tensor

from real2sim_server.physics.backends.cuda.launcher import Launch
from real2sim_server.physics.backends.cuda.source import FOLDER, KERNELS, solver_source

from ...render.kernel_twin import COMPILER, FAULTS, FLAGS, WARNINGS
from ...render.kernel_twin import HERE as SHARED

HERE = Path(__file__).parent
# Functions from Python have variables that one way through them leaves alone.
UNUSED = ("-Wno-unused-but-set-variable", "-Wno-unused-parameter", "-Wno-unused-variable")


@functools.cache
def twin(precision: str) -> ctypes.CDLL:
    """The compiled kernels; compiled once for each state of the sources."""
    text = solver_source(precision)
    names = ", ".join(f'{{"{name}", {name}}}' for name in KERNELS)
    named = "struct Named { const char* name; Kernel kernel; };\n"
    named += f"static const Named KERNELS[] = {{{names}}};\n"
    sources = sorted([*FOLDER.iterdir(), *SHARED.glob("*.h"), *HERE.glob("*.cpp")])
    flags = (*FLAGS, *WARNINGS, *UNUSED)
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sources))
    digest.update((text + named + repr(flags)).encode())
    folder = Path(tempfile.gettempdir()) / "real2sim-kernel-twin"
    library = folder / f"solver-{precision}-{digest.hexdigest()[:16]}.so"
    if not library.is_file():
        folder.mkdir(exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as made:
            (Path(made) / "solver_source.h").write_text(text, encoding="ascii")
            (Path(made) / "kernel_names.h").write_text(named, encoding="ascii")
            target = Path(made) / library.name
            includes = [part for path in (made, SHARED, FOLDER) for part in ("-I", str(path))]
            command = [str(COMPILER), *flags, *includes, "-o", str(target)]
            subprocess.run([*command, str(HERE / "twin.cpp")], check=True)
            target.replace(library)
    loaded = ctypes.CDLL(str(library))
    arguments = [ctypes.c_char_p, ctypes.c_uint32, ctypes.c_void_p, ctypes.c_uint32, ctypes.c_int]
    loaded.run.argtypes = arguments
    return loaded


class TwinLauncher:
    """A Launcher that runs the kernels on the CPU.

    Args:
        precision: ``single`` or ``double``.
        backwards: run blocks, and the threads of each, in the opposite order.

    Attributes:
        launches: number of launches of each kernel.
        sequences: what was asked for, sequence by sequence.
    """

    def __init__(self, precision: str, *, backwards: bool = False) -> None:
        self.device = torch.device("cpu")
        self.launches: Counter[str] = Counter()
        self.sequences: list[tuple[Launch, ...]] = []
        self._precision, self._backwards = precision, backwards

    def run(self, launches: tuple[Launch, ...], space: int) -> None:
        self.sequences.append(launches)
        loaded = twin(self._precision)
        for kernel, blocks, argument in launches:
            self.launches[kernel] += 1
            fault = loaded.run(kernel.encode(), blocks, space, argument, self._backwards)
            assert fault == 0, f"{kernel}: {FAULTS[fault]}"

    def pointer(self, tensor: Tensor) -> int:
        assert tensor.device == self.device
        assert tensor.is_contiguous()
        return int(tensor.data_ptr())

    def host_memory(self, nbytes: int) -> Tensor:
        return torch.empty(nbytes, dtype=torch.uint8)

    def wait(self) -> None:
        """Everything is done when it is launched."""
