"""Ways to rasterize, one module each, behind one Protocol."""

from .base import Backend, RasterRequest, device_of
from .select import (
    BackendStatus,
    RegisteredBackend,
    describe_backends,
    register_backend,
    select_backend,
)

__all__ = [
    "Backend",
    "BackendStatus",
    "RasterRequest",
    "RegisteredBackend",
    "describe_backends",
    "device_of",
    "register_backend",
    "select_backend",
]
