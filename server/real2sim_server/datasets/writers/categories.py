"""Categories of objects in each format: one table for all exports.

Ids and classes do not depend on the objects in an export, so that exports can be merged.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple


class Classes(NamedTuple):
    """Classes of one category; None for a format without such a class.

    Attributes:
        coco: id and name; ids up to 90 are COCO's own.
        kitti: type.
        nuscenes: category.
        argoverse2: category; None is written as the category in capitals.
        waymo: type of boxes.
    """

    coco: tuple[int, str]
    kitti: str | None = None
    nuscenes: str | None = None
    argoverse2: str | None = None
    waymo: int | None = None


CATEGORIES = {
    "car": Classes((3, "car"), "Car", "vehicle.car", "REGULAR_VEHICLE", 1),
    "van": Classes((91, "van"), "Van", "vehicle.car", "REGULAR_VEHICLE", 1),
    "truck": Classes((8, "truck"), "Truck", "vehicle.truck", "BOX_TRUCK", 1),
    "bus": Classes((6, "bus"), "Truck", "vehicle.bus.rigid", "BUS", 1),
    "trailer": Classes((92, "trailer"), None, "vehicle.trailer", "VEHICULAR_TRAILER", 1),
    "tram": Classes((93, "tram"), "Tram"),
    "train": Classes((7, "train")),
    "pedestrian": Classes((1, "person"), "Pedestrian", "human.pedestrian.adult", "PEDESTRIAN", 2),
    "cyclist": Classes((94, "cyclist"), "Cyclist", "vehicle.bicycle", "BICYCLIST", 4),
    "motorcyclist": Classes((95, "motorcyclist"), None, "vehicle.motorcycle", "MOTORCYCLIST", 1),
    "motorcycle": Classes((4, "motorcycle"), None, "vehicle.motorcycle", "MOTORCYCLE", 1),
    "bicycle": Classes((2, "bicycle"), None, "vehicle.bicycle", "BICYCLE", 4),
    "animal": Classes((96, "animal"), None, "animal"),
    "barrier": Classes((97, "barrier"), None, "movable_object.barrier"),
    "cone": Classes((98, "cone"), None, "movable_object.trafficcone"),
    "trafficcone": Classes((98, "cone"), None, "movable_object.trafficcone"),
    "debris": Classes((99, "debris"), None, "movable_object.debris"),
    "pole": Classes((100, "pole")),
    "sign": Classes((101, "sign"), None, None, "SIGN", 3),
    "traffic_sign": Classes((102, "traffic_sign"), None, None, None, 3),
    "traffic_light": Classes((10, "traffic light")),
    "obstacle": Classes((103, "obstacle")),
    "pushable_pullable": Classes(
        (104, "pushable_pullable"), None, "movable_object.pushable_pullable"
    ),
    "bicycle_rack": Classes((105, "bicycle_rack"), None, "static_object.bicycle_rack"),
    "other": Classes((106, "other")),
}
"""Classes by category. Categories outside the table are written like ``other``."""

OTHER = CATEGORIES["other"]

CLASS_FIELDS = {
    "coco": "coco",
    "kitti": "kitti",
    "kitti_raw": "kitti",
    "nuscenes": "nuscenes",
    "waymo": "waymo",
}
"""Field of :class:`Classes` by format. All other formats store the category itself."""


def classes_of(category: str) -> Classes:
    """Row of a category in the table."""
    return CATEGORIES.get(category, OTHER)


def written_as_other(format_name: str, boxes: Mapping[str, int]) -> dict[str, int]:
    """Of the numbers of boxes by category, those for which the format has no class of its own."""
    name = CLASS_FIELDS.get(format_name)
    if name is None:
        return {}
    other = getattr(OTHER, name)
    return {
        category: count
        for category, count in boxes.items()
        if category != "other" and getattr(classes_of(category), name) == other
    }
