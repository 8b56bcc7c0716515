"""Observations as requests and files give them, against a scene."""

from __future__ import annotations

import base64
import binascii
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from real2sim_proto.jobs import Observations as Requested
from real2sim_proto.jobs import ObservedBox, ObservedImage, ObservedPoint

from ...geometry.rotation import Float
from ...physics.errors import PhysicsError
from ...scene import Scene
from ..playback import PlacedObject
from .observations import (
    BoxTrack,
    MarkedPoints,
    Observation,
    ObservedImages,
    recorded_track,
    small,
)

LONGEST = 30.0
"""Observations reach so far beyond the start of a simulation at most [s]."""


def observations_of(
    given: Requested, scene: Scene, subject: PlacedObject, start_us: int, end_us: int
) -> list[Observation]:
    """What was observed, in seconds from the start.

    Args:
        given: as a request has it.
        scene: whose cameras took images.
        subject: that was observed.
        start_us, end_us: of the simulation [us]; recorded boxes are taken up to the end.

    Raises:
        PhysicsError: for times before the start or far beyond it, and images that cannot be read.
    """
    found: list[Observation] = []
    if given.recorded:
        found.append(recorded_track(subject.trajectory, start_us, end_us))
    for turned in (False, True):
        for sized in (False, True):
            boxes = [
                b
                for b in given.boxes
                if (b.quaternion is not None) == turned and (b.size is not None) == sized
            ]
            if boxes:
                found.append(_boxes(given, boxes, start_us))
    if given.points:
        found.append(_points(given, given.points, start_us))
    if given.images:
        found.append(_images(given, given.images, scene, start_us))
    return found


def _times(times_us: Sequence[int], start_us: int) -> Float:
    times: Float = (np.array(times_us, dtype=np.float64) - start_us) * 1e-6
    if times.min() < 0 or times.max() > LONGEST:
        raise PhysicsError(
            f"observations reach from {min(times_us)} to {max(times_us)} us; the simulation begins "
            f"at {start_us} us: give what was seen from then on, for {LONGEST:g} s at most"
        )
    return times


def _boxes(given: Requested, boxes: Sequence[ObservedBox], start_us: int) -> BoxTrack:
    return BoxTrack(
        _times([b.t_us for b in boxes], start_us),
        np.array([b.position for b in boxes]),
        None if boxes[0].quaternion is None else np.array([b.quaternion for b in boxes]),
        None if boxes[0].size is None else np.array([b.size for b in boxes]),
        position_sigma=given.position_sigma,
        heading_sigma=given.heading_sigma,
        size_sigma=given.size_sigma,
    )


def _points(given: Requested, points: Sequence[ObservedPoint], start_us: int) -> MarkedPoints:
    times_us = sorted({s.t_us for p in points for s in p.seen})
    positions = np.full((len(times_us), len(points), 3), np.nan)
    for k, point in enumerate(points):
        for seen in point.seen:
            positions[times_us.index(seen.t_us), k] = seen.position
    places = np.array([p.place for p in points])
    return MarkedPoints(places, _times(times_us, start_us), positions, given.point_sigma)


def _images(
    given: Requested, images: Sequence[ObservedImage], scene: Scene, start_us: int
) -> ObservedImages:
    cameras = {c.name: c for c in scene.rig.cameras}
    taken = []
    for k, seen in enumerate(images):
        if seen.camera not in cameras:
            raise PhysicsError(
                f"image {k} is of camera {seen.camera!r}; the scene has {', '.join(cameras)}"
            )
        taken.append(small(cameras[seen.camera], _decoded(seen, k)))
    return ObservedImages(
        _times([i.t_us for i in images], start_us),
        [camera for camera, _ in taken],
        np.stack([scene.ego.transform(i.t_us) for i in images]),
        [image for _, image in taken],
        given.image_sigma,
    )


def _decoded(seen: ObservedImage, k: int) -> NDArray[np.uint8]:
    import cv2

    try:
        data = base64.b64decode(seen.image, validate=True)
    except (binascii.Error, ValueError) as problem:
        raise PhysicsError(f"image {k} is no base64: {problem}") from problem
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
    if image is None:
        raise PhysicsError(f"image {k} is neither PNG nor JPEG, or is damaged")
    return np.asarray(image[:, :, ::-1], dtype=np.uint8)
