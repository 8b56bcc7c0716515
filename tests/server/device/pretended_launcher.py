"""The serving kernels on the pretended device."""

from __future__ import annotations

from torch import Tensor

from ..render.kernel_twin import TwinLauncher
from . import pretended


class PretendedLauncher(TwinLauncher):
    """Runs kernels on what pretended tensors hold, and on no other memory; counts launches."""

    def __init__(self) -> None:
        super().__init__()
        self.device = pretended.DEVICE

    def launch(self, kernel: str, blocks: int, frame: int, argument: int = 0) -> None:
        pretended.counts.launches += 1
        super().launch(kernel, blocks, frame, argument)

    def pointer(self, tensor: Tensor) -> int:
        assert isinstance(tensor, pretended.Pretended), "the kernels were given memory of the host"
        assert tensor.is_contiguous()
        return int(tensor.held.data_ptr())
