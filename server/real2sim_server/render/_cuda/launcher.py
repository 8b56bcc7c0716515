"""Serving kernels on a device: their data types, compilation by NVRTC, and launches.

The NumPy types mirror the structures of ``kernels/frame.h`` field by field.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from ..._nvrtc import ARCHITECTURES, KernelSource
from ..types import RenderError

THREADS = 256
PIECE = 1024
"""Gaussians or splats per block."""
WORDS = PIECE // 32
DIGITS = 256
TILE = 16
MAX_CAMERAS = 64
COUNTERS = 16
SEEN_WANTED, PAIRS_WANTED = 2, 3
"""Indices of counters in the report."""

SPLAT_BYTES = 48
"""Size of a splat: three float4, see ``store`` in ``kernels/seen.h``."""

_POINTER, _FLOAT, _COUNT = np.uint64, np.float32, np.uint32


def _structure(
    pointers: tuple[str, ...], rest: list[tuple[str, type, tuple[int, ...]]]
) -> np.dtype:
    return np.dtype([*((name, _POINTER, ()) for name in pointers), *rest])


def _counts(*names: str) -> list[tuple[str, type, tuple[int, ...]]]:
    return [(name, _COUNT, ()) for name in names]


OBJECT = _structure(
    ("means", "quats", "scales", "opacities", "sh", "covars", "colour", "tones"),
    [
        *_counts("count", "functions", "tone_count", "first_piece", "first_entry"),
        *_counts("first_placement", "first_camera", "cameras"),
        ("scale", _FLOAT, (3,)),
        ("instance", np.uint16, ()),
        ("semantic", np.uint16, ()),
    ],
)
PLACEMENT = _structure(
    (),
    [
        ("depth_row", np.float64, (4,)),
        ("linear", _FLOAT, (3, 3)),
        ("eye", _FLOAT, (3,)),
        ("eye_rest", _FLOAT, (3,)),
        ("unused", _FLOAT, ()),
    ],
)
CAMERA = _structure(
    ("sky",),
    [
        ("focal", _FLOAT, (2,)),
        ("centre", _FLOAT, (2,)),
        ("lowest", _FLOAT, (2,)),
        ("highest", _FLOAT, (2,)),
        ("directions", _FLOAT, (3, 3)),
        ("background", _FLOAT, (3,)),
        *_counts("sky_resolution", "width", "height", "tiles_x", "tiles_y"),
        *_counts("first_tile", "first_pixel", "behind"),
    ],
)
IMAGES: dict[str, tuple[type, tuple[int, ...]]] = {
    "rgb": (np.float32, (3,)),
    "alpha": (np.float32, ()),
    "depth": (np.float32, ()),
    "median": (np.float32, ()),
    "solid": (np.float32, ()),
    "instance": (np.uint16, ()),
    "semantic": (np.uint8, ()),
    "bytes": (np.uint8, (3,)),
}
"""Images that a pass can write: dtype and channels."""
FRAME = _structure(
    (
        *("objects", "placements", "cameras", "seen_masks", "entry_starts", "splats", "boxes"),
        *("depths_0", "depths_1", "order_0", "order_1", "tiles_0", "tiles_1"),
        *("members_0", "members_1", "pair_starts", "digit_counts", "digit_starts"),
        *("tile_ranges", "counters", "report", *IMAGES),
    ),
    [
        *_counts("object_count", "camera_count", "pieces", "entries", "tile_count"),
        *_counts("seen_capacity", "pair_capacity", "sort_blocks", "tile_passes", "antialiased"),
        ("near_plane", _FLOAT, ()),
        ("far_plane", _FLOAT, ()),
        ("eps2d", _FLOAT, ()),
        ("radius_clip", _FLOAT, ()),
    ],
)


# Resource usage of compiled kernels, as reported by ptxas

_PATTERN = re.compile(
    r"entry function '(?P<kernel>\w+)'.*?(?P<stack>\d+) bytes stack frame, "
    r"(?P<stores>\d+) bytes spill stores, (?P<loads>\d+) bytes spill loads.*?"
    r"Used (?P<registers>\d+) registers(?:[^\n]*?(?P<shared>\d+) bytes smem)?",
    re.DOTALL,
)
REGISTERS = 65_536
"""Registers of a multiprocessor, allocated to warps in units of REGISTER_STEP."""
REGISTER_STEP = 256
BLOCK_SHARED = 1024
"""Shared memory reserved per block by the system [bytes]."""
MULTIPROCESSORS = {
    "sm_75": (1024, 64 << 10),
    "sm_80": (2048, 164 << 10),
    "sm_86": (1536, 100 << 10),
    "sm_89": (1536, 100 << 10),
    "sm_90": (2048, 228 << 10),
    "sm_100": (2048, 228 << 10),
    "sm_120": (1536, 100 << 10),
}
"""Threads and shared memory [bytes] of a multiprocessor, from the CUDA programming guide."""


@dataclass(frozen=True)
class Usage:
    """Resource usage of a compiled kernel.

    Attributes:
        registers: registers per thread.
        shared: shared memory per block [bytes].
        stack: stack per thread [bytes].
        spilled: register spill stores and loads [bytes].
    """

    registers: int
    shared: int
    stack: int
    spilled: int

    def occupancy(self, architecture: str, of_block: int = THREADS) -> float:
        """Occupancy: fraction of a multiprocessor's threads active with blocks of this size.

        Raises:
            KeyError: the architecture is not in MULTIPROCESSORS.
        """
        threads, shared = MULTIPROCESSORS[architecture]
        of_warp = -(-self.registers * 32 // REGISTER_STEP) * REGISTER_STEP
        blocks = min(
            threads // of_block,
            REGISTERS // of_warp // (of_block // 32),
            shared // (self.shared + BLOCK_SHARED),
        )
        return blocks * of_block / threads


def usage_of(log: str) -> dict[str, Usage]:
    """Resource usage of each kernel, from the log of ptxas."""
    return {
        found["kernel"]: Usage(
            registers=int(found["registers"]),
            shared=int(found["shared"] or 0),
            stack=int(found["stack"]),
            spilled=int(found["stores"]) + int(found["loads"]),
        )
        for found in _PATTERN.finditer(log)
    }


# Compilation of the serving kernels

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
    """The cubin for an architecture (``sm_90``), cached on disk.

    Raises:
        RenderError: compilation failed; the message includes NVRTC's log.
    """
    return _source().kept(architecture)


def compile_kernels(architecture: str) -> tuple[bytes, dict[str, Usage]]:
    """The cubin, cached on disk, and the resource usage of each kernel.

    Raises:
        RenderError: see :func:`compiled_kernels`.
    """
    code, log = _source().compiled(architecture)
    return code, usage_of(log)


def cubin_path(architecture: str) -> Path:
    """Path of the cached cubin."""
    return _source().path(architecture)


def _source() -> KernelSource:
    return KernelSource(
        name=SOURCE.name,
        kept_as="serving",
        text=SOURCE.read_text(encoding="ascii"),
        folder=FOLDER,
        # Round each sum and product, as on the CPU. The sources call fmaf explicitly.
        fma=False,
        error=RenderError,
    )


# Launches


class Launcher(Protocol):
    """A device that runs the kernels in order.

    Attributes:
        device: torch device of its memory.
    """

    device: torch.device

    def launch(self, kernel: str, blocks: int, frame: int, argument: int = 0) -> None:
        """Queue a launch of ``kernel``.

        Args:
            kernel: name of a kernel.
            blocks: number of blocks, at least one.
            frame: device address of the kernel's input.
            argument: second argument, see the kernel.
        """
        ...

    def pointer(self, tensor: Tensor) -> int:
        """Address of the data of a contiguous tensor on the device."""
        ...

    def host_memory(self, nbytes: int) -> Tensor:
        """[nbytes] uint8 of pinned host memory."""
        ...

    def wait(self) -> None:
        """Wait for all queued launches and copies."""
        ...

    def copy_out(self, source: Tensor, target: Tensor) -> Callable[[], object]:
        """Copy a device tensor to host memory after all queued launches, concurrently with later
        ones.

        Returns:
            A function that waits for the copy; thread-safe.
        """
        ...


class CudaLauncher:
    """The current CUDA device of torch, on torch's current stream.

    Args:
        kernels: names of the kernels to launch.
        compiled: function that returns their cubin for an architecture; default: the serving
            kernels.

    Raises:
        RenderError: the kernels do not compile for the device.
    """

    def __init__(
        self,
        kernels: Sequence[str] = KERNELS,
        compiled: Callable[[str], bytes] | None = None,
    ) -> None:
        from cuda.core import Device, ObjectCode

        index = torch.cuda.current_device()
        self.device = torch.device("cuda", index)
        torch.cuda.synchronize(self.device)  # Makes torch create the shared context.
        Device(index).set_current()
        major, minor = torch.cuda.get_device_capability(index)
        code = ObjectCode.from_cubin((compiled or compiled_kernels)(f"sm_{major}{minor}"))
        self._kernels = {name: code.get_kernel(name) for name in kernels}
        self._streams: dict[int, Any] = {}
        self._copying = torch.cuda.Stream(self.device)
        self._threads = threading.local()

    def launch(self, kernel: str, blocks: int, frame: int, argument: int = 0) -> None:
        """See Launcher."""
        from cuda.core import Device, LaunchConfig, launch

        if not getattr(self._threads, "ready", False):
            # The driver's current context is per thread.
            Device(self.device.index).set_current()
            self._threads.ready = True
        config = LaunchConfig(grid=blocks, block=THREADS)
        try:
            launch(self._stream(), config, self._kernels[kernel], frame, np.uint32(argument))
        except Exception as error:
            # Worded like torch's errors, from which a worker detects a lost device.
            raise RuntimeError(f"CUDA error at the launch of {kernel}: {error}") from error

    def pointer(self, tensor: Tensor) -> int:
        """See Launcher."""
        assert tensor.device == self.device
        return int(tensor.data_ptr())

    def host_memory(self, nbytes: int) -> Tensor:
        """See Launcher. torch caches freed memory for the next frame."""
        return torch.empty(nbytes, dtype=torch.uint8, pin_memory=True)

    def wait(self) -> None:
        """See Launcher."""
        torch.cuda.current_stream(self.device).synchronize()

    def copy_out(self, source: Tensor, target: Tensor) -> Callable[[], object]:
        """See Launcher."""
        self._copying.wait_stream(torch.cuda.current_stream(self.device))
        with torch.cuda.stream(self._copying):
            target.copy_(source, non_blocking=True)
            # Waiting threads sleep: several threads may be encoding.
            copied = torch.cuda.Event(blocking=True)
            copied.record(self._copying)
        # Keeps the memory from being reused before the copy is done.
        source.record_stream(self._copying)
        return copied.synchronize

    def _stream(self) -> Any:
        from cuda.core import LEGACY_DEFAULT_STREAM, Stream

        handle = torch.cuda.current_stream(self.device).cuda_stream
        if handle not in self._streams:
            # torch's handle of the default stream is 0, which is not a valid handle here.
            known = Stream.from_handle(handle) if handle else LEGACY_DEFAULT_STREAM
            self._streams[handle] = known
        return self._streams[handle]
