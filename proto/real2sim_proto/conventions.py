"""Frames, units, image layouts, semantic classes and protocol versions.

``GET /v1/server`` publishes them.
"""

from __future__ import annotations

# Classes of semantic images: Cityscapes label numbers, for compatibility with its tools.

SEMANTIC_CLASSES: dict[str, int] = {
    "unlabeled": 0,
    "static": 4,
    "dynamic": 5,
    "ground": 6,
    "pole": 17,
    "traffic light": 19,
    "traffic sign": 20,
    "sky": 23,
    "person": 24,
    "rider": 25,
    "car": 26,
    "truck": 27,
    "bus": 28,
    "trailer": 30,
    "train": 31,
    "motorcycle": 32,
    "bicycle": 33,
}
"""Number in the image by class name. ``static`` is the background. ``ground`` is its drivable or
walkable part, within 15 cm of the fitted ground's height. ``dynamic`` is an object of another
category, and ``unlabeled`` an empty pixel in a scene without sky."""

CLASS_OF_CATEGORY = {
    "car": "car",
    "van": "car",
    "truck": "truck",
    "bus": "bus",
    "trailer": "trailer",
    "tram": "train",
    "train": "train",
    "pedestrian": "person",
    "cyclist": "rider",
    "motorcyclist": "rider",
    "motorcycle": "motorcycle",
    "bicycle": "bicycle",
    "pole": "pole",
    "sign": "traffic sign",
    "traffic_sign": "traffic sign",
    "traffic_light": "traffic light",
}
"""Class of objects by their category; all others are ``dynamic``."""

UNLABELED = SEMANTIC_CLASSES["unlabeled"]
STATIC = SEMANTIC_CLASSES["static"]
GROUND = SEMANTIC_CLASSES["ground"]
SKY = SEMANTIC_CLASSES["sky"]


def semantic_class(category: str) -> int:
    """Class number of objects of a category."""
    return SEMANTIC_CLASSES[CLASS_OF_CATEGORY.get(category, "dynamic")]


# Versions of the protocol.

PROTOCOL_VERSION = 1
"""Major version of REST paths (``/v1``) and of the drive socket (field ``v`` of every message)."""

DRIVE_SUBPROTOCOL = "real2sim.v1.msgpack"
"""WebSocket subprotocol of the drive socket."""

SUPPORTED_SUBPROTOCOLS = (DRIVE_SUBPROTOCOL,)


def protocol_mismatch(offered: list[str]) -> str:
    """Error message with the versions of both sides and the remedy.

    Examples:
        >>> protocol_mismatch(["real2sim.v9.msgpack"]).partition(";")[0]
        'the client offers drive protocol real2sim.v9.msgpack'
    """
    given = ", ".join(offered) if offered else "none"
    spoken = ", ".join(SUPPORTED_SUBPROTOCOLS)
    return (
        f"the client offers drive protocol {given}; this worker speaks {spoken}. "
        "Install a client and a worker of the same major version."
    )


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
    "channels, estimated from the training rays; 0.25 where there are none",
    "uncertainty_png": "16 bit, steps of 1/65535",
}
"""Text of each convention by name."""
