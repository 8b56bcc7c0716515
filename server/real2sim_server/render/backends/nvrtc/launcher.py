"""What the backend asks of a device, and the device that is a GPU."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from .compile import KERNELS, compiled_kernels
from .records import THREADS


class Launcher(Protocol):
    """A device that runs the kernels, one after the other.

    Attributes:
        device: on which its memory lies.
    """

    device: torch.device

    def launch(self, kernel: str, blocks: int, frame: int, argument: int = 0) -> None:
        """Queue ``kernel`` for that many blocks.

        Args:
            kernel: one of its kernels.
            blocks: at least one.
            frame: address of what the kernel is given, on the device.
            argument: see the kernel.
        """
        ...

    def pointer(self, tensor: Tensor) -> int:
        """Address of what a contiguous tensor on the device holds."""
        ...

    def host_memory(self, nbytes: int) -> Tensor:
        """[nbytes] uint8 that the device can copy from and to without help."""
        ...

    def wait(self) -> None:
        """Return when all launches, and copies queued with them, are done."""
        ...

    def copy_out(self, source: Tensor, target: Tensor) -> Callable[[], object]:
        """Copy a tensor of the device to host memory once all launches up to now are done, beside
        those to come.

        Returns:
            Waits for the copy, on any thread.
        """
        ...


class CudaLauncher:
    """The current CUDA device of torch, on torch's current stream.

    Args:
        kernels: names of those to be launched.
        compiled: gives the cubin that has them for an architecture; that of serving if None.

    Raises:
        RenderError: the kernels do not compile for it.
    """

    def __init__(
        self,
        kernels: Sequence[str] = KERNELS,
        compiled: Callable[[str], bytes] | None = None,
    ) -> None:
        from cuda.core import Device, ObjectCode

        index = torch.cuda.current_device()
        self.device = torch.device("cuda", index)
        torch.cuda.synchronize(self.device)  # torch makes the context that all share.
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
            # A driver's context is one of a thread.
            Device(self.device.index).set_current()
            self._threads.ready = True
        config = LaunchConfig(grid=blocks, block=THREADS)
        try:
            launch(self._stream(), config, self._kernels[kernel], frame, np.uint32(argument))
        except Exception as error:
            # In the words of torch, by which a worker knows that its device is lost.
            raise RuntimeError(f"CUDA error at the launch of {kernel}: {error}") from error

    def pointer(self, tensor: Tensor) -> int:
        """See Launcher."""
        assert tensor.device == self.device
        return int(tensor.data_ptr())

    def host_memory(self, nbytes: int) -> Tensor:
        """See Launcher; torch keeps what is given back for the next frame."""
        return torch.empty(nbytes, dtype=torch.uint8, pin_memory=True)

    def wait(self) -> None:
        """See Launcher."""
        torch.cuda.current_stream(self.device).synchronize()

    def copy_out(self, source: Tensor, target: Tensor) -> Callable[[], object]:
        """See Launcher."""
        self._copying.wait_stream(torch.cuda.current_stream(self.device))
        with torch.cuda.stream(self._copying):
            target.copy_(source, non_blocking=True)
            # Who waits for it sleeps; it may be one of several threads that encode.
            copied = torch.cuda.Event(blocking=True)
            copied.record(self._copying)
        # Its memory is not given to the next frame before.
        source.record_stream(self._copying)
        return copied.synchronize

    def _stream(self) -> Any:
        from cuda.core import LEGACY_DEFAULT_STREAM, Stream

        handle = torch.cuda.current_stream(self.device).cuda_stream
        if handle not in self._streams:
            # torch calls the default stream 0, which is no handle.
            known = Stream.from_handle(handle) if handle else LEGACY_DEFAULT_STREAM
            self._streams[handle] = known
        return self._streams[handle]
