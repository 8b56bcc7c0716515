"""Classes of semantic images: the label numbers of Cityscapes, so that its tools read them."""

from __future__ import annotations

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
"""Number in the image by name. ``static`` is the background, ``ground`` the part of it that is
driven or walked on (what is within 15 cm of the fitted ground's height), ``dynamic`` an object of
another category, ``unlabeled`` where nothing is and the scene has no sky."""

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
    """Number of the class of objects of that category."""
    return SEMANTIC_CLASSES[CLASS_OF_CATEGORY.get(category, "dynamic")]
