"""The road from beside the recorded path, on logs of which no truth exists there.

LiDAR points of the road take the colours of the images that show them from near by, and are
projected into views from the next lane: what a scene shows there is compared on these pixels alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...geometry.transform import Float, apply_transform, invert_transform
from ...logs import DrivingLog
from ...scene import Camera, Ground, Scene
from ..logged_view import image_time, points_in_camera, resized, tracks_mask
from .images import mean_psnr
from .lidar_depth import seen_points
from .rendering import render_view, shifted_pose
from .shifted import within_an_object

COLOURED_WITHIN = (4.0, 12.0)
"""Road takes its colour from images that show it at such depths [m]."""
COMPARED_WITHIN = (5.0, 25.0)
"""And is compared at these [m]."""
ON_ROAD = 0.1
"""Points so near to the ground are of the road [m]."""
MAX_FRAMES = 60
MIN_PIXELS = 100
"""Views with fewer pixels do not count."""


@dataclass(frozen=True)
class LaneBandScore:
    """Views of the road from beside the path.

    Attributes:
        shift_m: how far to the left and to the right [m].
        psnr: over the pixels whose road other images show from near by, mean over views [dB]; nan
            where no view shows enough of it.
        images_psnr: the same of the recorded images at their own places [dB]: where shadows move or
            boxes are off, colours from other images are wrong, and scores beyond this say nothing.
        pixels: how many are compared, in all views.
        views: how many views were compared; none from within a box or close to one.
    """

    shift_m: float
    psnr: float
    images_psnr: float
    pixels: int
    views: int


@dataclass(frozen=True, eq=False)
class RoadColours:
    """Points [N, 3] of the road in the world [m], and their colours [N, 3] from 0 to 255."""

    points: Float
    colours: NDArray[np.float32]


def evaluate_lane_band(
    scene: Scene,
    log: DrivingLog,
    camera: Camera,
    frames: Sequence[int],
    shifts: Sequence[float],
    *,
    backend: str = "auto",
) -> tuple[LaneBandScore, ...]:
    """Move the recording vehicle ``shifts`` [m] to its left and to its right; compare the road.

    Args:
        camera: at the size that is compared.
        frames: from whose times views are taken.

    Raises:
        LogError: images or sweeps that cannot be read.
    """
    road = road_colours(log, camera, scene.ground)
    images_psnr = _score_of_images(log, camera, frames, road)
    scores = (
        _score(scene, log, camera, frames, shift, road=road, backend=backend) for shift in shifts
    )
    return tuple(replace(score, images_psnr=images_psnr) for score in scores)


def _score_of_images(
    log: DrivingLog, camera: Camera, frames: Sequence[int], road: RoadColours
) -> float:
    scores = []
    for frame in frames:
        place, colours = projected_road(road, log, camera, image_time(log, camera.name, frame), 0.0)
        if len(place) >= MIN_PIXELS:
            scores.append(_psnr(resized(log.image(camera.name, frame), camera), place, colours))
    return mean_psnr(scores)


def _score(
    scene: Scene,
    log: DrivingLog,
    camera: Camera,
    frames: Sequence[int],
    shift: float,
    *,
    road: RoadColours,
    backend: str,
) -> LaneBandScore:
    scores, pixels = [], 0
    for frame in frames:
        t_us = image_time(log, camera.name, frame)
        for left in (shift, -shift):
            vehicle = shifted_pose(log.ego.transform(t_us), left)
            if within_an_object(log, camera.pose(vehicle)[:3, 3], t_us):
                continue
            place, colours = projected_road(road, log, camera, t_us, left)
            if len(place) < MIN_PIXELS:
                continue
            shown = render_view(scene, camera, t_us, left=left, backend=backend).rgb
            scores.append(_psnr(shown, place, colours))
            pixels += len(place)
    return LaneBandScore(shift, mean_psnr(scores), float("nan"), pixels, len(scores))


def _psnr(image: NDArray[np.uint8], place: NDArray[np.int64], colours: Float) -> float:
    error = image.reshape(-1, 3)[place].astype(np.float64) - colours
    return float(10 * np.log10(255**2 / max(np.square(error).mean(), 1e-6)))


def road_colours(log: DrivingLog, camera: Camera, ground: Ground) -> RoadColours:
    """The road as the images of ``camera`` show it from near by, outside of all boxes."""
    near, far = COLOURED_WITHIN
    points, colours = [np.zeros((0, 3))], [np.zeros((0, 3), np.float32)]
    for frame in range(0, log.frame_count, -(-log.frame_count // MAX_FRAMES)):
        t_us = image_time(log, camera.name, frame)
        row, column, depth = seen_points(points_in_camera(log, camera, frame, t_us), camera)
        pose = camera.pose(log.ego.transform(t_us))
        boxed = tracks_mask(log.tracks, camera, pose, t_us)
        chosen = (depth > near) & (depth < far) & ~boxed[row, column]
        row, column, depth = row[chosen], column[chosen], depth[chosen]
        # Colours are those of whole pixels: their middles are put onto the ground.
        pixel = np.stack([column + 0.5, row + 0.5, np.ones(len(row))], axis=1)
        local = depth[:, None] * (pixel @ np.linalg.inv(camera.K).T)
        world = apply_transform(pose, local)
        height = world[:, 2] - ground.height_at(np.ascontiguousarray(world[:, :2]))
        way = world - pose[:3, 3]
        falling = way[:, 2] < -0.1
        world += way * np.where(falling, height / np.where(falling, -way[:, 2], 1), 0)[:, None]
        on_road = falling & (np.abs(height) < ON_ROAD)
        image = resized(log.image(camera.name, frame), camera)
        points.append(world[on_road])
        colours.append(image[row[on_road], column[on_road]].astype(np.float32))
    return RoadColours(np.concatenate(points), np.concatenate(colours))


def projected_road(
    road: RoadColours, log: DrivingLog, camera: Camera, t_us: int, left: float
) -> tuple[NDArray[np.int64], Float]:
    """Row-major pixels [M] that show the road from beside, and its mean colours [M, 3] there."""
    near, far = COMPARED_WITHIN
    pose = camera.pose(shifted_pose(log.ego.transform(t_us), left))
    x, y, z = (apply_transform(invert_transform(pose), road.points) @ camera.K.T).T
    ahead = (z > near) & (z < far)
    column, row = (np.floor(v / np.where(ahead, z, 1)).astype(np.int64) for v in (x, y))
    inside = ahead & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    boxed = tracks_mask(log.tracks, camera, pose, t_us)
    inside[inside] = ~boxed[row[inside], column[inside]]
    flat = row[inside] * camera.width + column[inside]
    count = np.bincount(flat, minlength=camera.width * camera.height)
    sums = [np.bincount(flat, road.colours[inside, k], minlength=len(count)) for k in range(3)]
    place = np.flatnonzero(count)
    return place, np.stack(sums, axis=1)[place] / count[place, None]
