"""From Gaussians to pictures: one rasterize() call, three backends."""

from .backends import Backend, BackendStatus, describe_backends, select_backend
from .encode import EncodedImage, encode_depth, encode_instance, encode_rgb
from .frame import Frame, render_cameras, warm_up
from .modalities import encode_image
from .rasterize import View, rasterize, rasterize_batch, rasterize_worlds
from .types import (
    Instance,
    RasterOptions,
    RenderError,
    RenderOutput,
    ScreenStatistics,
    WorldViews,
)

__all__ = [
    "Backend",
    "BackendStatus",
    "EncodedImage",
    "Frame",
    "Instance",
    "RasterOptions",
    "RenderError",
    "RenderOutput",
    "ScreenStatistics",
    "View",
    "WorldViews",
    "describe_backends",
    "encode_depth",
    "encode_image",
    "encode_instance",
    "encode_rgb",
    "rasterize",
    "rasterize_batch",
    "rasterize_worlds",
    "render_cameras",
    "select_backend",
    "warm_up",
]
