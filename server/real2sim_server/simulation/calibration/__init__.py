"""Materials and motion of an object of a scene, from what was seen of it."""

from .calibrate import PARAMETERS, ObjectCalibration, calibrate_object
from .observations import BoxTrack, MarkedPoints, Observation, ObservedImages, recorded_track

__all__ = [
    "PARAMETERS",
    "BoxTrack",
    "MarkedPoints",
    "ObjectCalibration",
    "Observation",
    "ObservedImages",
    "calibrate_object",
    "recorded_track",
]
