"""Serving and LiDAR kernels on the pretended device."""

from __future__ import annotations

from torch import Tensor

from ..render.cast.kernel_twin import CastTwinLauncher
from ..render.kernel_twin import KernelTwin, TwinLauncher
from . import pretended


class OnPretended(KernelTwin):
    """Runs kernels on the values of pretended tensors only. Counts launches."""

    def launch(self, kernel: str, blocks: int, space: int, argument: int = 0) -> None:
        pretended.counts.launches += 1
        super().launch(kernel, blocks, space, argument)

    def pointer(self, tensor: Tensor) -> int:
        assert isinstance(tensor, pretended.Pretended), "the kernels were given memory of the host"
        assert tensor.is_contiguous()
        return int(tensor.held.data_ptr())


class PretendedLauncher(OnPretended, TwinLauncher):
    """Launcher for serving kernels."""

    def __init__(self) -> None:
        super().__init__()
        self.device = pretended.DEVICE


class PretendedCastLauncher(OnPretended, CastTwinLauncher):
    """Launcher for LiDAR kernels."""

    def __init__(self) -> None:
        super().__init__()
        self.device = pretended.DEVICE
