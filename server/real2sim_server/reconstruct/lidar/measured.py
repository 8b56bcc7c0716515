"""Flat Gaussians on what the sweeps of a log measured, background and objects apart."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from ...geometry.transform import Float, apply_transform, invert_transform
from ...logs import DrivingLog, ObjectTrack
from ...scene import GaussianCloud, Scene
from ..initialise.accumulate import SHELL, drive_path, near_box, on_recording_vehicle
from ..initialise.points import (
    PointSet,
    path_distance,
    thin,
    thin_to,
    voxel_levels,
    well_supported,
)
from ..initialise.surfels import Surfels, fit_surfels
from .rays import RecordedRays

VOXEL, VOXEL_PER_METRE = 0.1, 0.006
"""Edge of voxels in the background [m], and its growth with the distance from the drive."""
OBJECT_VOXEL = 0.05
MAX_BACKGROUND, MAX_OBJECT = 300_000, 40_000
LARGEST_OBJECT = 0.15
"""Scale along surfaces of objects, at most [m]."""
SMALLEST = 0.004
"""Scale along normals, at least [m]; beams measure to millimetres."""
FLATTER = 0.3
"""Share of the thickness of neighbourhoods that is left: most of it is noise of single beams."""
ROAD_BAND = 0.05
"""Points in a box at most so high over its bottom are road [m]."""
MOVES = 0.3
"""An object whose path is longer moves, and what sticks out of its box moves along [m]."""
BOX_MARGIN = 0.12
GAP, GAP_PER_METRE = 0.3, 0.01
"""Surfaces of the scene count where nothing was measured so near [m], with distance more."""
FAR = 120.0
"""Returns from farther are too sparse for surfaces [m]."""
THIN_EVERY = 4_000_000
OPACITY = 0.95


class MeasuredPoints:
    """Points of sweeps by what they lie on, thinned as they come."""

    def __init__(self, log: DrivingLog) -> None:
        self._log = log
        self._path = drive_path(log)
        self._parts: list[list[PointSet]] = [[] for _ in range(len(log.tracks) + 1)]
        self._pending = 0

    def add(self, frame: int, rays: RecordedRays) -> NDArray[np.int64]:
        """Take the points of the sweep of ``frame`` of the log; what each ray met, as of
        :func:`bodies_of`."""
        body, places = bodies_of(self._log, frame, rays)
        near = rays.range < FAR
        for number, parts in enumerate(self._parts):
            mine = (body == number) & near
            if mine.any():
                parts.append(PointSet.measured(places[mine], rays.intensity[mine]))
        self._pending += len(rays.range)
        if self._pending > THIN_EVERY:
            self._parts = [[self._thinned(number)] for number in range(len(self._parts))]
            self._pending = 0
        return body

    def clouds(self, surfaces: Scene) -> list[GaussianCloud]:
        """Gaussians of the background and of each object, filled up from ``surfaces``."""
        own = [surfaces.background, *(o.cloud for o in surfaces.objects.values())]
        return [self._cloud(number, cloud) for number, cloud in enumerate(own)]

    def _thinned(self, number: int) -> PointSet:
        points = PointSet.join(self._parts[number])
        if number or len(points) == 0:
            return thin(points, OBJECT_VOXEL)
        distance = path_distance(points.points, self._path)
        return thin(points, VOXEL, voxel_levels(distance, VOXEL, VOXEL_PER_METRE))

    def _cloud(self, number: int, completion: GaussianCloud) -> GaussianCloud:
        points = self._thinned(number)
        if number:
            points = thin_to(points, OBJECT_VOXEL, MAX_OBJECT)
            return _filled(
                points,
                fit_surfels(points.points, largest=LARGEST_OBJECT, smallest=SMALLEST),
                completion,
                np.zeros(len(completion), np.float32),
            )
        if len(points):
            distance = path_distance(points.points, self._path)
            points = points.select(well_supported(points.points, 0.1 + 0.02 * distance))
            levels = voxel_levels(path_distance(points.points, self._path), VOXEL, VOXEL_PER_METRE)
            points = thin_to(points, VOXEL, MAX_BACKGROUND, levels)
        distance = np.zeros(0, np.float32)
        if len(points):
            distance = path_distance(points.points, self._path)
        largest = (VOXEL + 0.03 + 0.008 * distance).astype(np.float32)
        surfels = fit_surfels(points.points, largest=largest, smallest=SMALLEST)
        away = path_distance(completion.means.numpy(), self._path)
        return _filled(points, surfels, completion, away)


def bodies_of(log: DrivingLog, frame: int, rays: RecordedRays) -> tuple[NDArray[np.int64], Float]:
    """What each ray of a sweep met, 0 for the background, else 1 + the track's index, -1 for the
    recording vehicle itself; and where, in the frame of that [R, 3]."""
    t_us, offset_us = int(log.frame_times_us[frame]), rays.lidar.beams.time_us
    world = np.asfortranarray(rays.points)
    body, places = np.zeros(len(world), np.int64), rays.points.copy()
    nearest = np.full(len(world), np.inf)
    for index, track in enumerate(log.tracks):
        if not track.trajectory.covers(t_us):
            continue
        chosen, in_box = near_box(world, offset_us, track, t_us)
        half = np.array(track.size) / 2
        outside = (np.abs(in_box) - half).max(axis=1)
        mine = (outside <= _margin(track)) & (in_box[:, 2] + half[2] > ROAD_BAND)
        mine &= outside < nearest[chosen]
        body[chosen[mine]], places[chosen[mine]] = index + 1, in_box[mine]
        nearest[chosen[mine]] = outside[mine]
    in_vehicle = apply_transform(invert_transform(log.ego.transform(t_us)), rays.points)
    body[on_recording_vehicle(in_vehicle, log.ego_size)] = -1
    return body, places


def _margin(track: ObjectTrack) -> float:
    moves = float(np.ptp(track.trajectory.positions, axis=0).max()) > MOVES
    return SHELL if moves else BOX_MARGIN


def _filled(
    points: PointSet, surfels: Surfels, completion: GaussianCloud, away: NDArray[np.float32]
) -> GaussianCloud:
    """Gaussians of surfels, and those of a completion [M] that have no point near them."""
    from scipy.spatial import cKDTree

    means = completion.means.numpy()
    far = np.ones(len(means), np.bool_)
    if len(points) and len(means):
        distance, _ = cKDTree(points.points).query(means, workers=-1)
        far = distance > GAP + GAP_PER_METRE * away
    flat = np.array([1, 1, FLATTER], np.float32)
    scales = np.concatenate([surfels.scales, completion.scales.numpy()[far]]) * flat
    opacities = np.full(len(scales), OPACITY, np.float32)
    columns = (
        np.concatenate([surfels.points, means[far]]),
        np.concatenate([surfels.quats, completion.quats.numpy()[far]]),
        scales,
        opacities,
    )
    means_of, quats, scales_of, opacities_of = (
        torch.from_numpy(np.ascontiguousarray(column)) for column in columns
    )
    colours = torch.zeros(len(opacities), 1, 3)
    return GaussianCloud(means_of, quats, scales_of, opacities_of, colours)
