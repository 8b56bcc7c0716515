"""Kernels of serving and of LiDARs on the pretended device."""

from __future__ import annotations

from torch import Tensor

from ..render.cast.kernel_twin import CastTwinLauncher
from ..render.kernel_twin import KernelTwin, TwinLauncher
from . import pretended


class OnPretended(KernelTwin):
    """Runs kernels on what pretended tensors hold, and on no other memory; counts launches."""

    def launch(self, kernel: str, blocks: int, space: int, argument: int = 0) -> None:
        pretended.counts.launches += 1
        super().launch(kernel, blocks, space, argument)

    def pointer(self, tensor: Tensor) -> int:
        assert isinstance(tensor, pretended.Pretended), "the kernels were given memory of the host"
        assert tensor.is_contiguous()
        return int(tensor.held.data_ptr())


class PretendedLauncher(OnPretended, TwinLauncher):
    """Of serving."""

    def __init__(self) -> None:
        super().__init__()
        self.device = pretended.DEVICE


class PretendedCastLauncher(OnPretended, CastTwinLauncher):
    """Of LiDARs."""

    def __init__(self) -> None:
        super().__init__()
        self.device = pretended.DEVICE
