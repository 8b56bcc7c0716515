"""Views shifted sideways from the recorded path: the next lane, and the road band without truth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...geometry import Float, apply_transform, invert_transform
from ...logs import DrivingLog
from ...scene import Camera, Ground, Scene
from ...synthetic import SyntheticLog
from ..logged_view import image_time, moving_tracks, points_in_camera, resized, tracks_mask
from .images import mean_psnr, psnr, ssim
from .lidar import FAR, NEAR, median_error, seen_points
from .rendering import render_view, shifted_pose

# Views from the next lane against the truth.

MIN_OBJECT_PIXELS = 50
"""Views in which moving objects cover fewer pixels are not scored for objects."""
CLEARANCE = 0.3
"""Views from within a box, or closer to one, are excluded [m]."""
DEPTH_STRIDE = 4
"""Depth is compared at every Nth pixel along each image axis."""


@dataclass(frozen=True)
class ShiftScore:
    """Views shifted from the recorded path against the truth.

    Attributes:
        shift_m: distance to the left and to the right [m].
        psnr: mean over views [dB].
        ssim: mean over views.
        psnr_objects: mean over the views with moving objects, within their boxes [dB].
        depth_error_m: median over pixels of all views, depth along z against the true one [m].
        views: number of compared views.
        views_in_objects: number of excluded views, with another vehicle at the camera's position.
    """

    shift_m: float
    psnr: float
    ssim: float
    psnr_objects: float
    depth_error_m: float
    views: int
    views_in_objects: int


def evaluate_shifts(
    scene: Scene,
    truth: SyntheticLog,
    cameras: Sequence[Camera],
    times_us: Sequence[int],
    shifts: Sequence[float],
    *,
    backend: str = "auto",
    on_view: Callable[[int, int], None] | None = None,
) -> tuple[ShiftScore, ...]:
    """Move the recording vehicle ``shifts`` [m] to its left and to its right and compare.

    Args:
        scene: its ego path and the path of ``truth`` both cover ``times_us``.
        cameras: at the compared size.
        on_view: called with the number of finished views and of all views.
    """
    total, scores = 2 * len(shifts) * len(cameras) * len(times_us), []
    done = 0
    for shift in shifts:
        compared: list[_Compared] = []
        for left, t_us, camera in _views(shift, times_us, cameras):
            found = _compare(scene, truth, camera, t_us=t_us, left=left, backend=backend)
            compared += [] if found is None else [found]
            done += 1
            if on_view is not None:
                on_view(done, total)
        scores.append(_score(shift, compared, total // len(shifts)))
    return tuple(scores)


def true_view(
    truth: SyntheticLog, camera: Camera, t_us: int, left: float
) -> tuple[NDArray[np.uint8], NDArray[np.float32], Float]:
    """RGB [H, W, 3], depth [H, W] [m], 0 in the sky, and ``T_world_camera`` of the truth."""
    vehicle = shifted_pose(truth.ego.transform(t_us), left)
    pose = camera.pose(vehicle)
    rgb, depth, _ = truth.render(pose, camera.K, camera.width, camera.height, t_us)
    return rgb, depth, pose


@dataclass(frozen=True, eq=False)
class _Compared:
    psnr: float
    ssim: float
    psnr_objects: float
    depth_errors: NDArray[np.float64]


def _views(
    shift: float, times_us: Sequence[int], cameras: Sequence[Camera]
) -> list[tuple[float, int, Camera]]:
    return [(left, t, c) for left in (shift, -shift) for t in times_us for c in cameras]


def _compare(
    scene: Scene, truth: SyntheticLog, camera: Camera, *, t_us: int, left: float, backend: str
) -> _Compared | None:
    vehicle = shifted_pose(truth.ego.transform(t_us), left)
    if within_an_object(truth, camera.pose(vehicle)[:3, 3], t_us):
        return None
    image, depth, pose = true_view(truth, camera, t_us, left)
    frame = render_view(scene, camera, t_us, left=left, backend=backend)
    assert frame.depth is not None
    mask = tracks_mask(moving_tracks(truth), camera, pose, t_us)
    enough = int(mask.sum()) >= MIN_OBJECT_PIXELS
    return _Compared(
        psnr(frame.rgb, image),
        ssim(frame.rgb, image),
        psnr(frame.rgb, image, mask) if enough else float("nan"),
        _depth_errors(frame.depth, depth),
    )


def within_an_object(log: DrivingLog, position: Float, t_us: int) -> bool:
    """Whether ``position`` [3] in the world [m] is in a box at ``t_us``, or within CLEARANCE."""
    for track in log.tracks:
        pose = track.transform_near(t_us)
        if pose is not None:
            local = apply_transform(invert_transform(pose), position[None])[0]
            if (np.abs(local) < np.array(track.size) / 2 + CLEARANCE).all():
                return True
    return False


def _depth_errors(
    depth: NDArray[np.float32], true_depth: NDArray[np.float32]
) -> NDArray[np.float64]:
    """Depth errors at every DEPTH_STRIDE-th pixel with a surface; infinite if none is rendered."""
    rendered = depth[::DEPTH_STRIDE, ::DEPTH_STRIDE].astype(np.float64)
    expected = true_depth[::DEPTH_STRIDE, ::DEPTH_STRIDE].astype(np.float64)
    errors = np.where(rendered > 0, np.abs(rendered - expected), np.inf)
    return np.asarray(errors[(expected > NEAR) & (expected < FAR)])


def _score(shift: float, compared: list[_Compared], total: int) -> ShiftScore:
    errors = [c.depth_errors for c in compared]
    return ShiftScore(
        shift_m=shift,
        psnr=mean_psnr(c.psnr for c in compared),
        ssim=float(np.mean([c.ssim for c in compared])) if compared else float("nan"),
        psnr_objects=mean_psnr(c.psnr_objects for c in compared),
        depth_error_m=median_error(np.concatenate(errors) if errors else np.zeros(0)),
        views=len(compared),
        views_in_objects=total - len(compared),
    )


# The road band, on logs without ground truth.
#
# Road points of the LiDAR take the colours of nearby images and are projected into views from the
# next lane. Only these pixels are compared.

COLOURED_WITHIN = (4.0, 12.0)
"""Depth range in which images provide the road's colours [m]."""
COMPARED_WITHIN = (5.0, 25.0)
"""Depth range in which the road is compared [m]."""
ON_ROAD = 0.1
"""Maximum distance of road points from the ground [m]."""
MAX_FRAMES = 60
MIN_PIXELS = 100
"""Minimum number of compared pixels for a view to count."""


@dataclass(frozen=True)
class LaneBandScore:
    """Views of the road shifted from the path.

    Attributes:
        shift_m: distance to the left and to the right [m].
        psnr: over the pixels with road that other images show at close range, mean over views
            [dB]; nan if no view shows enough of it.
        images_psnr: the same for the recorded images at their own poses [dB]. Moving shadows and
            inexact boxes make colours from other images wrong; scores above this value are
            meaningless.
        pixels: number of compared pixels in all views.
        views: number of compared views; views from within a box or close to one are excluded.
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
        camera: at the compared size.
        frames: their times are rendered.

    Raises:
        LogError: images or sweeps that cannot be read.
    """
    road = road_colours(log, camera, scene.ground)
    images_psnr = _score_of_images(log, camera, frames, road)
    scores = (
        _band_score(scene, log, camera, frames, shift, road=road, backend=backend)
        for shift in shifts
    )
    return tuple(replace(score, images_psnr=images_psnr) for score in scores)


def _score_of_images(
    log: DrivingLog, camera: Camera, frames: Sequence[int], road: RoadColours
) -> float:
    scores = []
    for frame in frames:
        if not log.has_image(camera.name, frame):
            continue
        place, colours = projected_road(road, log, camera, image_time(log, camera.name, frame), 0.0)
        if len(place) >= MIN_PIXELS:
            scores.append(_psnr(resized(log.image(camera.name, frame), camera), place, colours))
    return mean_psnr(scores)


def _band_score(
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
    """The road as seen at close range in the images of ``camera``, outside all boxes."""
    near, far = COLOURED_WITHIN
    points, colours = [np.zeros((0, 3))], [np.zeros((0, 3), np.float32)]
    seen = [frame for frame in range(log.frame_count) if log.has_image(camera.name, frame)]
    for frame in seen[:: max(1, -(-len(seen) // MAX_FRAMES))]:
        t_us = image_time(log, camera.name, frame)
        row, column, depth = seen_points(points_in_camera(log, camera, frame, t_us), camera)
        pose = camera.pose(log.ego.transform(t_us))
        boxed = tracks_mask(log.tracks, camera, pose, t_us)
        chosen = (depth > near) & (depth < far) & ~boxed[row, column]
        row, column, depth = row[chosen], column[chosen], depth[chosen]
        # Colours are sampled at pixel centres, which are projected onto the ground.
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
    """Row-major pixels [M] that show the road from a shifted pose, and its mean colours [M, 3]."""
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
