"""Frames, units and image layouts, stated once and published by ``GET /v1/server``."""

from __future__ import annotations

from .semantics import SEMANTIC_CLASSES

CONVENTIONS: dict[str, str] = {
    "world_frame": "right-handed, x forward, y left, z up, metres, recentred near the drive",
    "vehicle_frame": "x forward, y left, z up; origin at the rear axle centre on the ground",
    "object_frame": "x forward, y left, z up; origin at the centre of the box",
    "camera_frame": "OpenCV: x right, y down, z forward; pixel centres at +0.5",
    "transform": "T_dst_src is 4x4 and maps src coordinates to dst",
    "quaternion": "wxyz, unit length",
    "angle": "radians",
    "time": "int64 microseconds, fields end in _us",
    "box_size": "(length, width, height) along the object's x, y, z, metres",
    "rgb": "uint8 [H, W, 3]",
    "depth": "float32 [H, W], metres along the camera z axis, 0 where nothing was hit",
    "depth_png": "16 bit, steps of 1/256 m, 0 where nothing was hit, 65535 from 255.99 m on",
    "instance": "uint16 [H, W], 0 is background",
    "median_depth": "as depth, of the Gaussian that takes half of the light; no mean over edges",
    "semantic": "uint8 [H, W], "
    + ", ".join(f"{number} {name}" for name, number in SEMANTIC_CLASSES.items()),
    "uncertainty": "float32 [H, W], expected absolute error of the colour, of 1, mean of the "
    "channels, as far as training rays tell; 0.25 for what none has met",
    "uncertainty_png": "16 bit, steps of 1/65535",
}
"""What each convention says, by its name."""
