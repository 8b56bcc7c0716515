"""The solver's interface to a device: compiled kernels, their records, and launches on a GPU."""

from __future__ import annotations

import functools
import threading
from collections import OrderedDict
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from ...._nvrtc import KernelSource
from ....render._cuda.launcher import Usage, usage_of
from ...errors import SolverError
from .source import FOLDER, KERNELS, SOURCE, solver_source

# The kernels' structures as NumPy types: ``kernels/space.h``, field by field.

THREADS = 128
PIECE = 1024
NODES, TILE, AROUND = 64, 512, 27
COLUMNS, REACH = 16, 15
DIGITS = 256
DIVERGED, TOO_FAR, OVERFLOW = 1, 2, 4
XI, VELOCITY, GRADIENT, ELASTIC_F, STRESS, ENERGY = 0, 3, 6, 15, 24, 30
HISTORY, MASS, VOLUME, TOTAL_F = 31, 32, 33, 34
"""Index of the first number of a particle for each quantity."""
MOVES, DEFORMS, SCATTERS = 1 << 16, 1 << 17, 1 << 18
BY_LAW, FLIPPED = 15, 16
BLOCKS, FIELDS, LISTS = range(3)

LAYOUT = (
    *("block_key", "field_key", "block_start", "block_fields", "block_near", "field_blocks"),
    *("field_near", "group_start", "contact_start", "contact_collider", "contact_field"),
    *("pair_start", "pair_field", "thin_start", "thin_collider", "thin_block"),
    *("tiles", "moments", "velocity", "offset"),
    *("by_collider", "by_pair", "by_thin", "touched", "rows"),
)
"""Arrays whose size depends on the number of occupied blocks."""
CAPACITIES = ("blocks", "fields", "contacts", "pairs", "thins")
_COUNTS = (
    *("particles", "pitch", "plastic", "bodies", "colliders", "sort_blocks"),
    *("block_capacity", "field_capacity", "contact_capacity", "pair_capacity", "thin_capacity"),
    "unused",
)
SPACE = np.dtype(
    [
        ("sets", np.uint64, (2,)),
        ("keys", np.uint64, (2,)),
        ("order", np.uint64, (2,)),
        *((name, np.uint64) for name in ("digit_counts", "counts", "sums")),
        *((name, np.uint64) for name in LAYOUT),
        *((name, np.uint64) for name in ("table", "friction", "heights", "step", "held")),
        *((name, np.uint64) for name in ("measured", "collider_totals", "body_totals")),
        ("dx", np.float64),
        ("gravity", np.float64, (3,)),
        *((name, np.uint32) for name in _COUNTS),
    ]
)
STEP = np.dtype([("dt", np.float64), ("moving", np.uint32), ("unused", np.uint32)])
HELD = np.dtype(
    [
        *((name, np.uint32) for name in ("current", "stop_after", "fault", "done")),
        *((name, np.uint32) for name in ("blocks", "fields", "groups", "contacts", "pairs")),
        ("thins", np.uint32),
        ("unused", np.uint32, (6,)),
    ]
)


def compiled_kernels(precision: str, architecture: str) -> bytes:
    """The cubin for ``single`` or ``double`` and an architecture (``sm_90``), cached on disk.

    Raises:
        SolverError: compilation failed; the message includes NVRTC's log.
    """
    return _source(precision).kept(architecture)


def compile_kernels(precision: str, architecture: str) -> tuple[bytes, dict[str, Usage]]:
    """The cubin, cached on disk, and the resource usage of each kernel.

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
        fma=True,  # As in the CPU's kernels.
        diag_suppress=39,  # The code for an unknown law divides by zero on purpose.
        error=SolverError,
    )


GRAPHS = 32
"""Maximum number of launch sequences kept as graphs, per simulation."""


class Launch(NamedTuple):
    """One launch.

    Attributes:
        kernel: one of KERNELS.
        blocks: number of blocks of THREADS threads, at least one.
        argument: see the kernel.
    """

    kernel: str
    blocks: int
    argument: int = 0


class Launcher(Protocol):
    """A device that runs kernels, one after the other, for one precision.

    Attributes:
        device: device of its memory.
    """

    device: torch.device

    def run(self, launches: tuple[Launch, ...], space: int) -> None:
        """Queue a sequence of launches.

        Args:
            launches: the launches; repeating a sequence costs the host almost nothing.
            space: address of a Space on the device.
        """
        ...

    def pointer(self, tensor: Tensor) -> int:
        """Address of the data of a contiguous tensor on the device."""
        ...

    def host_memory(self, nbytes: int) -> Tensor:
        """[nbytes] uint8 of pinned host memory."""
        ...

    def wait(self) -> None:
        """Wait for all queued work."""
        ...


@functools.cache
def _loaded_kernels(precision: str, index: int) -> dict[str, Any]:
    """Kernels on a device, which must be the current one."""
    from cuda.core import ObjectCode

    major, minor = torch.cuda.get_device_capability(index)
    code = ObjectCode.from_cubin(compiled_kernels(precision, f"sm_{major}{minor}"))
    return {name: code.get_kernel(name) for name in KERNELS}


class CudaLauncher:
    """The current CUDA device of torch, on torch's current stream.

    A new sequence is launched kernel by kernel; a repeated one is captured into a CUDA graph. The
    launches between two checks of a solver are always the same.

    Args:
        precision: ``single`` or ``double``.

    Raises:
        SolverError: the kernels do not compile for it.
    """

    def __init__(self, precision: str) -> None:
        from cuda.core import Device

        index = torch.cuda.current_device()
        self.device = torch.device("cuda", index)
        torch.cuda.synchronize(self.device)  # Makes torch create the context that both share.
        Device(index).set_current()
        self._kernels = _loaded_kernels(precision, index)
        self._graphs: OrderedDict[tuple[Any, ...], Any] = OrderedDict()
        self._threads = threading.local()

    def run(self, launches: tuple[Launch, ...], space: int) -> None:
        """See Launcher."""
        device, stream, key = self._ready(), self._stream(), (launches, space)
        try:
            if key not in self._graphs:
                self._graphs[key] = None
                self._queue(stream, launches, space)
            else:
                if self._graphs[key] is None:
                    self._graphs[key] = self._captured(device, launches, space)
                self._graphs[key].launch(stream)
        except Exception as error:
            # Torch's wording, which lets a worker detect a lost device.
            raise RuntimeError(f"CUDA error at the solver's launches: {error}") from error
        self._graphs.move_to_end(key)
        if len(self._graphs) > GRAPHS:
            self._graphs.popitem(last=False)

    def _queue(self, stream: Any, launches: tuple[Launch, ...], space: int) -> None:
        from cuda.core import LaunchConfig, launch

        for kernel, blocks, argument in launches:
            config = LaunchConfig(grid=blocks, block=THREADS)
            launch(stream, config, self._kernels[kernel], space, np.uint32(argument))

    def _captured(self, device: Any, launches: tuple[Launch, ...], space: int) -> Any:
        builder = device.create_graph_builder().begin_building()
        self._queue(builder, launches, space)
        return builder.end_building().complete()

    def pointer(self, tensor: Tensor) -> int:
        """See Launcher."""
        assert tensor.device == self.device
        return int(tensor.data_ptr())

    def host_memory(self, nbytes: int) -> Tensor:
        """See Launcher."""
        return torch.empty(nbytes, dtype=torch.uint8, pin_memory=True)

    def wait(self) -> None:
        """See Launcher."""
        torch.cuda.current_stream(self.device).synchronize()

    def _ready(self) -> Any:
        from cuda.core import Device

        device = Device(self.device.index)
        if not getattr(self._threads, "ready", False):
            # A driver context belongs to one thread.
            device.set_current()
            self._threads.ready = True
        return device

    def _stream(self) -> Any:
        from cuda.core import LEGACY_DEFAULT_STREAM, Stream

        handle = torch.cuda.current_stream(self.device).cuda_stream
        # torch calls the default stream 0, and this is not a valid handle.
        return Stream.from_handle(handle) if handle else LEGACY_DEFAULT_STREAM
