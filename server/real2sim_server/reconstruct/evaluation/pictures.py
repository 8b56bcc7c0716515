"""Images that a person compares: errors and depth in colour, crops of moving objects."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...geometry.box import box_corners
from ...logs import DrivingLog
from ...render import encode_rgb
from ...scene import Camera
from ..logged_view import box_outline, image_time, moving_tracks

ERROR_FULL = 64.0
"""Error at which the colours of error images end, of 255."""
DEPTH_NEAR, DEPTH_FAR = 2.0, 80.0
"""Ends of the logarithmic colours of depth images [m]."""
CROP_MARGIN = 0.15
"""Crops reach so far beyond the outline of a box, as a fraction of its size."""
MIN_CROP = 12
"""Objects that are smaller on the image are not shown [px]."""

Image = NDArray[np.uint8]


def error_image(image: Image, truth: Image) -> Image:
    """[H, W, 3] mean absolute difference of the channels, from black (0) to yellow (ERROR_FULL)."""
    import cv2

    difference = np.abs(image.astype(np.float32) - truth).mean(axis=-1)
    return _coloured(difference / ERROR_FULL, cv2.COLORMAP_INFERNO)


def depth_image(depth: NDArray[np.float32]) -> Image:
    """[H, W, 3] of a depth image [H, W] [m]: near is red, far is blue, black where nothing is."""
    import cv2

    near, far = np.log(DEPTH_NEAR), np.log(DEPTH_FAR)
    fraction = (far - np.log(np.maximum(depth, DEPTH_NEAR))) / (far - near)
    return np.where((depth > 0)[..., None], _coloured(fraction, cv2.COLORMAP_TURBO), np.uint8(0))


def object_crops(
    log: DrivingLog, camera: Camera, frame: int, limit: int
) -> list[tuple[str, tuple[slice, slice]]]:
    """Id and rows and columns of at most ``limit`` moving objects, the largest on the image first.

    Only objects that lie on the image with at least half of their outline's box are taken, and
    not those whose middle is behind another one.
    """
    t_us = image_time(log, camera.name, frame)
    T_camera_world = camera.viewmat(log.ego.transform(t_us))
    found = []
    for track in moving_tracks(log):
        pose = track.transform_near(t_us)
        if pose is None:
            continue
        T_camera_box = T_camera_world @ pose
        outline = box_outline(box_corners(T_camera_box, track.size), camera.K)
        window = _window(outline, camera) if len(outline) else None
        if window is not None:
            found.append((float(T_camera_box[2, 3]), track.object_id, window))
    found.sort(key=lambda item: item[:2])
    windows = [window for _, _, window in found]
    shown = [
        (object_id, window)
        for place, (_, object_id, window) in enumerate(found)
        if not any(_holds_centre(nearer, window) for nearer in windows[:place])
    ]
    return sorted(shown, key=lambda item: -_area(item[1]))[:limit]


def jpeg(image: Image, *, width: int | None = None) -> bytes:
    """``image`` as jpeg, shrunk or enlarged to ``width`` [px]."""
    import cv2

    if width is not None and width != image.shape[1]:
        size = (width, max(1, round(image.shape[0] * width / image.shape[1])))
        smaller = width < image.shape[1]
        method = cv2.INTER_AREA if smaller else cv2.INTER_CUBIC
        image = np.asarray(cv2.resize(image, size, interpolation=method), dtype=np.uint8)
    return encode_rgb(image, "jpeg", quality=88)


def _coloured(fraction: NDArray[np.float32], colours: int) -> Image:
    import cv2

    levels = np.rint(np.clip(fraction, 0, 1) * 255).astype(np.uint8)
    return np.ascontiguousarray(cv2.applyColorMap(levels, colours)[..., ::-1])


def _window(outline: NDArray[np.float64], camera: Camera) -> tuple[slice, slice] | None:
    low, high = outline.min(axis=0), outline.max(axis=0)
    margin = CROP_MARGIN * (high - low)
    limit = np.array([camera.width, camera.height])
    inside = np.clip(high, 0, limit) - np.clip(low, 0, limit)
    if inside.min() < MIN_CROP or inside.prod() < 0.5 * (high - low).prod():
        return None
    first = np.floor(np.clip(low - margin, 0, limit)).astype(int)
    last = np.ceil(np.clip(high + margin, 0, limit)).astype(int)
    return slice(first[1], last[1]), slice(first[0], last[0])


def _holds_centre(nearer: tuple[slice, slice], window: tuple[slice, slice]) -> bool:
    return all(
        a.start <= (b.start + b.stop) / 2 < a.stop for a, b in zip(nearer, window, strict=True)
    )


def _area(window: tuple[slice, slice]) -> int:
    rows, columns = window
    return int((rows.stop - rows.start) * (columns.stop - columns.start))
