"""From Gaussians to pictures: one rasterize() call, three backends."""

from .backends import Backend, BackendStatus, describe_backends, select_backend
from .rasterize import rasterize
from .types import Instance, RasterOptions, RenderError, RenderOutput

__all__ = [
    "Backend",
    "BackendStatus",
    "Instance",
    "RasterOptions",
    "RenderError",
    "RenderOutput",
    "describe_backends",
    "rasterize",
    "select_backend",
]
