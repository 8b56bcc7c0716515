"""Labels of a time step: boxes, masks, visibility, depth, flow, tracks and futures.

All labels come from one pass per camera, passes of single objects, and the poses of the drive;
:data:`HOW` describes the source of each label.
"""

from .boxes import ObjectBox, boxes_at, ego_future, ego_state, futures_at, projected_box
from .images import CameraImages, draw_moment, flow_between
from .points import SeenPoints, lidar_points, points_in_boxes, seen_points
from .views import HOW, CameraView, ObjectView, views_of

__all__ = [
    "HOW",
    "CameraImages",
    "CameraView",
    "ObjectBox",
    "ObjectView",
    "SeenPoints",
    "boxes_at",
    "draw_moment",
    "ego_future",
    "ego_state",
    "flow_between",
    "futures_at",
    "lidar_points",
    "points_in_boxes",
    "projected_box",
    "seen_points",
    "views_of",
]
