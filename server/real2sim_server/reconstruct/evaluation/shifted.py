"""How well a scene shows what the recording vehicle would have seen from the next lane."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...geometry.transform import Float, apply_transform, invert_transform
from ...logs import DrivingLog
from ...scene import Camera, Scene
from ...synthetic import SyntheticLog
from ..logged_view import moving_tracks, tracks_mask
from .images import mean_psnr, psnr, ssim
from .lidar_depth import FAR, NEAR, median_error
from .rendering import render_view, shifted_pose

MIN_OBJECT_PIXELS = 50
"""Views in which moving objects cover fewer pixels do not count for them."""
CLEARANCE = 0.3
"""Views from within a box, or closer to one, are left out [m]."""
DEPTH_STRIDE = 4
"""Depth is compared at every so many pixels along each image axis."""


@dataclass(frozen=True)
class ShiftScore:
    """Views from beside the recorded path against the truth.

    Attributes:
        shift_m: how far to the left and to the right [m].
        psnr: mean over views [dB].
        ssim: mean over views.
        psnr_objects: mean over the views with moving objects, within their boxes [dB].
        depth_error_m: median over pixels of all views, depth along z against the true one [m].
        views: how many views were compared.
        views_in_objects: how many were left out as another vehicle stands where the camera is.
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
        scene: its ego path and that of ``truth`` both cover ``times_us``.
        cameras: at the size that is compared.
        on_view: called with views done and views in all.
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
    """Whether ``position`` [3] in the world [m] lies in a box at ``t_us``, or within CLEARANCE."""
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
    """At every DEPTH_STRIDE-th pixel that shows something; infinite where nothing is rendered."""
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
