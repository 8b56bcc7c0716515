"""Kernels that only cameras with lenses need: compiled when the first of them comes."""

from __future__ import annotations

from collections.abc import Sequence

from real2sim_proto import ErrorCode

from ...render import Backend, RenderError
from ...render.frame import kernels_of_lenses_on_disk, refuse_lenses, warm_up_lenses
from ...scene import Camera
from ..engine import Engine
from ..http.problems import ServiceError
from .kernels_beside import KernelsBeside


class LensKernels:
    """Gets them ready beside the engine, see :class:`.KernelsBeside`."""

    def __init__(self, engine: Engine, backend: Backend) -> None:
        self._backend = backend
        self._kernels = KernelsBeside(
            engine,
            "lenses",
            warm_up_lenses,
            on_disk=kernels_of_lenses_on_disk,
            backend=backend,
        )

    async def ready(self, cameras: Sequence[Camera]) -> None:
        """Return once cameras can be drawn, some of which have lenses or rolling shutters.

        Raises:
            ServiceError: INVALID_REQUEST where the backend cannot draw them.
        """
        try:
            refuse_lenses(self._backend, cameras)
        except RenderError as error:
            raise ServiceError(ErrorCode.INVALID_REQUEST, str(error)) from error
        await self._kernels.ready()
