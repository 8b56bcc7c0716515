"""The solver's kernels on the CPU, compiled from their source as C++; see ``render.kernel_twin``.

The source is what NVRTC gets, line for line, including the functions translated from Python.
Needs g++, which CI machines have; tests are skipped without it.
"""

from __future__ import annotations

import ctypes
import functools
from pathlib import Path

from real2sim_server.physics.backends.cuda.launcher import Launch
from real2sim_server.physics.backends.cuda.source import FOLDER, KERNELS, solver_source

from ...render.kernel_twin import KernelTwin, compiled_twin

HERE = Path(__file__).parent
# Functions translated from Python have variables that some paths leave unset.
UNUSED = ("-Wno-unused-but-set-variable", "-Wno-unused-parameter", "-Wno-unused-variable")


@functools.cache
def twin(precision: str) -> ctypes.CDLL:
    """The compiled kernels."""
    named = ", ".join(f'{{"{name}", {name}}}' for name in KERNELS)
    struct = "struct Named { const char* name; Kernel kernel; };\n"
    return compiled_twin(
        f"solver-{precision}",
        HERE / "twin.cpp",
        sources=FOLDER.iterdir(),
        flags=UNUSED,
        made={
            "solver_source.h": solver_source(precision),
            "kernel_names.h": f"{struct}static const Named KERNELS[] = {{{named}}};\n",
        },
    )


class TwinLauncher(KernelTwin):
    """A Launcher of the solver that runs its kernels on the CPU.

    Args:
        precision: ``single`` or ``double``.
        backwards: run blocks, and the threads of each, in reverse order.

    Attributes:
        sequences: what was requested, sequence by sequence.
    """

    def __init__(self, precision: str, *, backwards: bool = False) -> None:
        super().__init__(functools.partial(twin, precision), backwards=backwards)
        self.sequences: list[tuple[Launch, ...]] = []

    def run(self, launches: tuple[Launch, ...], space: int) -> None:
        self.sequences.append(launches)
        for kernel, blocks, argument in launches:
            self.launch(kernel, blocks, space, argument)
