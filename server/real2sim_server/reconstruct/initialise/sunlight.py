"""Direction of the sun and darkness of shadows, from the shadows of moving vehicles in a log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...geometry import Float, apply_transform, invert_transform
from ...logs import DrivingLog
from ...scene import Camera, Ground, Sunlight
from ...scene.ground_fit import Size
from ...scene.sunlight import boxes_hit
from ..logged_view import image_time, moving_tracks, spread
from .vehicle_body import VEHICLE_LENGTH

# Ground that a vehicle passes is darker while its shadow is there. Each candidate direction
# predicts which points are in the shadow of the vehicle. The best one explains most of the variance
# of the brightness of each place over time, so what does not move has no influence: road markings,
# pavements, and the shadows of houses. A vehicle is a stack of boxes here: the shadow of its whole
# box is longer than that of its body, so the sun would come out too high.

MAX_VIEWS = 64
"""Maximum number of images, evenly spread."""
MAX_DISTANCE = 25.0
"""Maximum distance of places from the camera [m]."""
CELL = 0.3
"""Distance between places [m]."""
REACH = 5.0
"""Places are within this distance of a moving vehicle in some image [m]."""
BOX_MARGIN = 0.25
"""Points nearer to a box do not count: they are dark without sun [m]."""
MAX_SAMPLES = 30_000
"""Maximum number of samples: a place in an image."""
MIN_CELLS = 30
"""Minimum number of places that were in the shadow and in the light."""
AZIMUTHS = np.deg2rad(np.arange(0.0, 360.0, 15.0))
ELEVATIONS = np.deg2rad(np.arange(16.0, 80.0, 12.0))
FINER = tuple(np.deg2rad(np.arange(-2, 3) * step) for step in (3.0, 1.0))
"""Offsets of the two finer searches [rad]."""
SLICES = 4
"""Number of boxes, one above the other, that a vehicle consists of."""
EDGE = 0.05
"""Part of a vehicle's points beyond each side of its boxes."""
MIN_EXPLAINED = 0.05
"""Minimum explained share of the variance; otherwise the sky counts as overcast."""
MAX_SHADE = 0.85
"""Maximum brightness of shadows relative to sunlit ground; otherwise the sky counts as overcast."""


@dataclass(frozen=True, eq=False)
class _View:
    """Visible ground in one image.

    Attributes:
        cells: [N] int64, number of the place.
        points: [N, 3], world [m].
        brightness: [N, 3] logarithms of their colours.
        near: [N] bool, within REACH of a moving vehicle; the others are in no shadow.
        boxes: ``T_box_world`` [B, 4, 4] of the moving vehicles' boxes.
        halves: [B, 3] half of their sizes [m].
    """

    cells: NDArray[np.int64]
    points: Float
    brightness: Float
    near: NDArray[np.bool_]
    boxes: Float
    halves: Float

    def select(self, kept: NDArray[np.bool_]) -> _View:
        """The places of a mask."""
        return replace(
            self,
            cells=self.cells[kept],
            points=self.points[kept],
            brightness=self.brightness[kept],
            near=self.near[kept],
        )


def fit_sunlight(
    log: DrivingLog, ground: Ground, shapes: Sequence[NDArray[np.float32]]
) -> Sunlight | None:
    """The sunlight of a log; None if moving vehicles cast no shadows or too few are visible.

    Args:
        log: a drive.
        ground: its ground.
        shapes: by track, points [N, 3] on the object, in the frame of its box [m].

    Raises:
        LogError: an image cannot be read.
    """
    images = [
        (camera, frame)
        for frame in log.seen_frames()
        for camera in log.rig
        if log.has_image(camera.name, frame)
    ]
    moving = {track.object_id for track in moving_tracks(log)}
    stacks = {
        track.object_id: _stack(points, track.size)
        for track, points in zip(log.tracks, shapes, strict=True)
        if track.object_id in moving and track.size[0] >= VEHICLE_LENGTH
    }
    views = [_view(log, ground, stacks, *image) for image in spread(images, MAX_VIEWS)]
    views = _chosen(views)
    if not views:
        return None
    _, cells = np.unique(np.concatenate([v.cells for v in views]), return_inverse=True)
    counts = np.bincount(cells)
    colours = np.concatenate([v.brightness for v in views])
    grey = _without_means(colours.mean(axis=1), cells, counts)

    def explained(towards: Float) -> float:
        """Sum of squares that darker shadows explain; negative for brighter ones."""
        shadow = _without_means(_shadows(views, towards), cells, counts)
        total = float(shadow @ shadow)
        slope = -float(shadow @ grey)
        return slope * abs(slope) / total if total > 0 else 0.0

    towards = max((_direction(a, e) for a in AZIMUTHS for e in ELEVATIONS), key=explained)
    for offsets in FINER:
        azimuth, elevation = np.arctan2(towards[1], towards[0]), np.arcsin(towards[2])
        around = [_direction(azimuth + a, elevation + e) for a in offsets for e in offsets]
        towards = max(around, key=explained)
    shade = _shade(colours, _shadows(views, towards), cells, counts)
    share = explained(towards) / max(float(grey @ grey), 1e-9)
    if share < MIN_EXPLAINED or shade is None or shade.mean() > MAX_SHADE:
        return None
    return Sunlight(towards, shade.clip(0.01, 0.99))


def _direction(azimuth: float, elevation: float) -> Float:
    """Unit vector [3] towards the sun, in the world."""
    flat = np.cos(elevation)
    return np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])


def _stack(points: NDArray[np.float32], size: Size) -> tuple[Float, Float]:
    """Centres and half sizes [B, 3] of the boxes that a vehicle consists of, in its frame [m].

    Each has the extent of the points in the middle of its height.
    """
    thick = size[2] / SLICES
    centres, halves = [], []
    for z in -size[2] / 2 + thick * (np.arange(SLICES) + 0.5):
        level = points[np.abs(points[:, 2] - z) < thick / 4]
        if len(level):
            low, high = np.quantile(level[:, :2], (EDGE, 1 - EDGE), axis=0)
            centres.append([*(low + high) / 2, z])
            halves.append([*(high - low) / 2, thick / 2])
    return np.reshape(centres, (-1, 3)), np.reshape(halves, (-1, 3))


def _view(
    log: DrivingLog,
    ground: Ground,
    stacks: Mapping[str, tuple[Float, Float]],
    camera: Camera,
    frame: int,
) -> _View:
    t_us = image_time(log, camera.name, frame)
    pose = camera.pose(log.ego.transform(t_us))
    first = np.floor((pose[:2, 3] - MAX_DISTANCE) / CELL).astype(np.int64)
    offsets = np.arange(round(2 * MAX_DISTANCE / CELL))
    places = first + np.stack(np.meshgrid(offsets, offsets, indexing="ij"), -1).reshape(-1, 2)
    xy = np.asarray((places + 0.5) * CELL, np.float64)
    kept = ground.covers(xy) & (np.hypot(*(xy - pose[:2, 3]).T) < MAX_DISTANCE)
    places, xy = places[kept], xy[kept]
    points = np.column_stack([xy, ground.height_at(xy)])
    pixels, valid = camera.project(apply_transform(invert_transform(pose), points))
    u, v = np.floor(np.where(valid[:, None], pixels, -1)).astype(np.int64).T
    kept = valid & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    places, points, u, v = places[kept], points[kept], u[kept], v[kept]
    there = [(track, track.transform_near(t_us)) for track in log.tracks]
    placed = [(track, T) for track, T in there if T is not None]
    boxes = np.array([invert_transform(T) for _, T in placed]).reshape(-1, 4, 4)
    halves = np.array([track.size for track, _ in placed]).reshape(-1, 3) / 2
    kept = ~boxes_hit(points, pose[:3, 3] - points, boxes, halves + BOX_MARGIN)
    near = np.zeros(len(points), np.bool_)
    cast, sizes = [np.zeros((0, 4, 4))], [np.zeros((0, 3))]
    for (track, _), T_box_world, half in zip(placed, boxes, halves, strict=True):
        if track.object_id not in stacks:
            continue
        beyond = np.abs(apply_transform(T_box_world, points)[:, :2]) - half[:2]
        distance = np.linalg.norm(beyond.clip(0), axis=1)
        kept &= distance > BOX_MARGIN
        near |= distance < REACH
        centres, stack = stacks[track.object_id]
        pieces = np.repeat(T_box_world[None], len(centres), axis=0)
        pieces[:, :3, 3] -= centres
        cast.append(pieces)
        sizes.append(stack)
    image = np.log(log.image(camera.name, frame).clip(4) / 255.0)
    cells = (places[:, 0] << 32) + places[:, 1]
    view = _View(cells, points, image[v, u], near, np.concatenate(cast), np.concatenate(sizes))
    return view.select(kept)


def _chosen(views: list[_View]) -> list[_View]:
    """Places that are near a moving vehicle in some image, thinned to about MAX_SAMPLES samples."""
    near = np.unique(np.concatenate([np.zeros(0, np.int64), *(v.cells[v.near] for v in views)]))
    views = [v.select(np.isin(v.cells, near)) for v in views]
    total = sum(len(v.cells) for v in views)
    step = -(-total // MAX_SAMPLES)
    # Every place keeps all of its samples.
    few = near[:: max(step, 1)]
    views = [v.select(np.isin(v.cells, few)) for v in views]
    return [v for v in views if len(v.cells)]


def _shadows(views: list[_View], towards: Float) -> Float:
    """[N] 1 for samples in the shadow of a moving vehicle, else 0."""
    found = [np.zeros(len(v.cells)) for v in views]
    for dark, view in zip(found, views, strict=True):
        dark[view.near] = boxes_hit(view.points[view.near], towards, view.boxes, view.halves)
    return np.concatenate(found)


def _without_means(values: Float, cells: NDArray[np.int64], counts: NDArray[np.int64]) -> Float:
    """``values`` [N] without the mean of their cell."""
    mean: Float = np.bincount(cells, values) / counts
    return values - mean[cells]


def _shade(
    colours: Float, shadow: Float, cells: NDArray[np.int64], counts: NDArray[np.int64]
) -> Float | None:
    """Colour [3] of shadows relative to sunlit ground; None with too few places.

    From the half of the places with the higher contrast: the others are in the shade of houses.
    """
    dark = np.bincount(cells, shadow)
    both = (dark > 0) & (dark < counts)
    if both.sum() < MIN_CELLS:
        return None
    contrast = np.empty((int(both.sum()), 3))
    for c in range(3):
        shaded = np.bincount(cells, colours[:, c] * shadow)
        lit = np.bincount(cells, colours[:, c]) - shaded
        contrast[:, c] = (shaded[both] / dark[both]) - lit[both] / (counts - dark)[both]
    kept = contrast[contrast.mean(axis=1).argsort()[: len(contrast) // 2]]
    return np.asarray(np.exp(np.median(kept, axis=0)))
