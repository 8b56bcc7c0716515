"""Rendering of Gaussians to images: one rasterize() call with several backends."""

from .backend import Backend
from .frame import Frame, RigView, draws_together, render_cameras, render_rigs, warm_up
from .images import EncodedImage, encode_depth, encode_instance, encode_rgb
from .modalities import encode_image
from .rasterize import View, rasterize, rasterize_batch, rasterize_worlds
from .select import (
    BackendStatus,
    describe_backends,
    kernels_of_small_images_on_disk,
    levels_bytes,
    levels_estimate,
    make_levels,
    scene_levels_bytes,
    select_backend,
    uses_levels,
    warm_up_small_images,
    without_levels,
)
from .types import Instance, RasterOptions, RenderError, RenderOutput, ScreenStatistics, WorldViews

__all__ = [
    "Backend",
    "BackendStatus",
    "EncodedImage",
    "Frame",
    "Instance",
    "RasterOptions",
    "RenderError",
    "RenderOutput",
    "RigView",
    "ScreenStatistics",
    "View",
    "WorldViews",
    "describe_backends",
    "draws_together",
    "encode_depth",
    "encode_image",
    "encode_instance",
    "encode_rgb",
    "kernels_of_small_images_on_disk",
    "levels_bytes",
    "levels_estimate",
    "make_levels",
    "rasterize",
    "rasterize_batch",
    "rasterize_worlds",
    "render_cameras",
    "render_rigs",
    "scene_levels_bytes",
    "select_backend",
    "uses_levels",
    "warm_up",
    "warm_up_small_images",
    "without_levels",
]
