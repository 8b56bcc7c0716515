"""Kinds of images that a camera gives: each one module with its registration."""

from . import rgb, depth, instance, median_depth, semantic, uncertainty  # noqa: F401, I001, registered in this order
from .base import (
    SensorModality,
    encode_image,
    modalities_drawn,
    modality_names,
    modality_of,
    options_for,
    register,
    unregister,
)

__all__ = [
    "SensorModality",
    "encode_image",
    "modalities_drawn",
    "modality_names",
    "modality_of",
    "options_for",
    "register",
    "unregister",
]
