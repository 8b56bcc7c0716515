"""Ways to rasterize, one module each, behind one Protocol."""

from .base import Backend, RasterRequest
from .select import BackendStatus, describe_backends, select_backend

__all__ = ["Backend", "BackendStatus", "RasterRequest", "describe_backends", "select_backend"]
