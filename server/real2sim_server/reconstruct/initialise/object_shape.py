"""Shape of objects where LiDAR says too little."""

from __future__ import annotations

import numpy as np

from ...geometry.transform import Float
from .accumulate import PointSet
from .surfels import Surfels
from .vehicle_body import VehicleBody

GAP = 0.25
"""The generic body fills where no measured point is this near [m]."""
WINDOW_LINE, LEAN = 0.58, 0.2
PROFILES = {
    "car": ((-0.5, 0.68), (-0.44, 0.75), (-0.3, 0.97), (0.0, 1.0), (0.1, 0.95), (0.25, 0.66),
            (0.45, 0.58), (0.5, 0.45)),
    "van": ((-0.5, 0.97), (0.0, 1.0), (0.25, 0.95), (0.38, 0.6), (0.5, 0.5)),
}  # fmt: skip
"""Side views: (position along the length from -0.5 to 0.5, height from 0 to 1), front last."""

VEHICLE_LENGTH = 2.5
"""Objects at least this long are taken for vehicles, with a dark underside [m]."""
UNDERSIDE_HEIGHT = 0.05
"""Height of the underside over the box bottom, so that the road does not show through [m]."""


def underside(size: tuple[float, float, float], *, spacing: float = 0.08) -> Surfels:
    """A flat plate under a vehicle, in the object frame; empty for other objects.

    What cameras see below a car is its dark underside and contact shadow. They belong to the car
    and leave with it; the road keeps its own colour.

    Args:
        size: (length, width, height) [m].
        spacing: distance between Gaussians [m].
    """
    half = np.array(size) / 2
    points = _face(half, 2, -1, spacing) if size[0] >= VEHICLE_LENGTH else np.zeros((0, 3))
    points[:, 2] += UNDERSIDE_HEIGHT
    axes = np.broadcast_to(np.eye(3, dtype=np.float32), (len(points), 3, 3)).copy()
    scales = np.tile(np.array([0.6, 0.6, 0.1], np.float32) * np.float32(spacing), (len(points), 1))
    return Surfels(points.astype(np.float32), axes, scales)


def complete_body(
    measured: PointSet,
    size: tuple[float, float, float],
    category: str,
    *,
    body: VehicleBody | None = None,
    spacing: float = 0.06,
) -> PointSet:
    """Measured points together with a generic body where nothing was measured.

    LiDAR sees neither the far side of a car, nor its windows, nor the top of a truck. The body is
    a box with rounded-off corners for most things, and has a bonnet and a cabin for cars and vans.
    Points of the body nearer than GAP to a measured point, or to its mirror image across y = 0,
    are left out, and mirrored points of vehicles are used instead.

    Args:
        measured: points in the object frame.
        size: (length, width, height) [m].
        category: class of the object.
        body: of a vehicle, taken instead of the generic one.
        spacing: distance between points of the body [m]; larger for large objects.
    """
    from scipy.spatial import cKDTree

    spacing = max(spacing, 0.012 * size[0])
    if body is not None:
        added = body.points
    else:
        added = _with_profile(_box_surface(np.array(size), spacing), np.array(size), category)
    typical = float(np.median(measured.intensity)) if len(measured) else 0.3
    if len(measured):
        distance, _ = cKDTree(measured.points).query(added, workers=-1)
        added = added[distance > GAP]
    generic = PointSet.measured(added, np.full(len(added), typical, dtype=np.float32))
    return PointSet.join([measured, generic])


def mirrored(measured: PointSet, *, voxel: float) -> PointSet:
    """Measured points and, where nothing was measured, their mirror images across y = 0."""
    from scipy.spatial import cKDTree

    if len(measured) == 0:
        return measured
    image = measured.points * np.array([1, -1, 1], dtype=np.float32)
    distance, _ = cKDTree(measured.points).query(image, workers=-1)
    lone = distance > 3 * voxel
    return PointSet.join(
        [measured, PointSet(image[lone], measured.intensity[lone], measured.weight[lone])]
    )


def _box_surface(size: Float, spacing: float) -> Float:
    """Points on four sides and the top of a box a little smaller than ``size``."""
    half = 0.97 * size / 2
    faces = [_face(half, axis, sign, spacing) for axis in (0, 1) for sign in (-1, 1)]
    return np.concatenate([*faces, _face(half, 2, 1, spacing)])


def _with_profile(points: Float, size: Float, category: str) -> Float:
    """Press points [N, 3] of a box surface down to the side view of a vehicle."""
    profile = PROFILES.get(category)
    points = points.copy()
    if profile is None:
        return points
    along, height = np.array(profile).T
    bottom = points[:, 2] / size[2] + 0.5
    roof = np.interp(points[:, 0] / size[0], along, height)
    points[:, 2] = (np.minimum(bottom, 1) * roof - 0.5) * size[2]
    # Sides lean inwards from the window line up.
    above = np.clip((points[:, 2] / size[2] + 0.5 - WINDOW_LINE) / (1 - WINDOW_LINE), 0, 1)
    points[:, 1] *= 1 - LEAN * above
    return points


def _face(half: Float, axis: int, sign: int, spacing: float) -> Float:
    others = [a for a in range(3) if a != axis]
    counts = [max(2, int(np.ceil(2 * half[a] / spacing))) for a in others]
    grids = np.meshgrid(
        *(((np.arange(n) + 0.5) / n * 2 - 1) * half[a] for n, a in zip(counts, others, strict=True))
    )
    points = np.zeros((grids[0].size, 3))
    points[:, axis] = sign * half[axis]
    for a, grid in zip(others, grids, strict=True):
        points[:, a] = grid.ravel()
    return points
