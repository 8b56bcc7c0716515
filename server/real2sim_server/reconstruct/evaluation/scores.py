"""All figures of a scene against its log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...logs import DrivingLog, same_part
from ...render import Frame
from ...scene import Camera, Scene
from ...synthetic import SyntheticLog
from ..logged_view import (
    image_time,
    moving_tracks,
    points_in_camera,
    resized,
    spread,
    tracks_mask,
)
from ..options import OnProgress, ReconstructError, ReportStep, Stages
from .edits import EditScore, evaluate_edits
from .images import PSNR_CAP, AroundScore, evaluate_around, find_truth, mean_psnr, psnr, ssim
from .lidar import LidarScore, depth_errors, error_p90, evaluate_sweeps, mean_error, median_error
from .rendering import measure_rate, render_view, select_cameras, select_frames
from .shifted import (
    MIN_OBJECT_PIXELS,
    LaneBandScore,
    ShiftScore,
    evaluate_lane_band,
    evaluate_shifts,
)
from .uncertainty import UncertaintyScore, evaluate_uncertainty

# Distance of a scene's objects from the boxes of its log.


def box_error(scene: Scene, log: DrivingLog) -> float:
    """Median distance between the centres of moving objects and of their boxes in ``log`` [m].

    On a synthetic log, with its exact boxes, this is the error of the scene's trajectories. Nan if
    the scene contains no moving object of the log.
    """
    distances = []
    for track in moving_tracks(log):
        item = scene.objects.get(track.object_id)
        if item is None:
            continue
        times = [t for t in track.trajectory.times_us if item.trajectory.covers(int(t))]
        distances += [
            np.linalg.norm(
                item.trajectory.transform(int(t))[:3, 3] - track.trajectory.transform(int(t))[:3, 3]
            )
            for t in times
        ]
    return float(np.median(distances)) if distances else float("nan")


# All figures.


@dataclass(frozen=True)
class EvaluateOptions:
    """Options of an evaluation.

    Attributes:
        frames: ``held-out``, ``all`` or indices; see :func:`.rendering.select_frames`.
        width: width of the compared images [px]; as logged by default.
        shifts: lateral distances from the recorded path [m]. Whole images are compared if truth
        exists. The road is compared on every log, by LiDAR and other images.
        shifted_frames: maximum number of frames rendered from shifted poses, evenly spread.
        repeats: timed renders.
        backend: backend of the renderer.
        around: whether to render vehicles from all sides; needs truth.
        edits: whether to edit vehicles and compare with the street that has the same edits; needs
            truth.
        lidar: whether to cast and compare LiDAR sweeps, if the log has any.

    Raises:
        ReconstructError: a value is out of range.
    """

    frames: str | tuple[int, ...] = "held-out"
    width: int | None = None
    shifts: tuple[float, ...] = (1.0, 2.0, 3.0)
    shifted_frames: int = 6
    repeats: int = 10
    backend: str = "auto"
    around: bool = False
    edits: bool = False
    lidar: bool = False

    def __post_init__(self) -> None:
        if self.width is not None and not 16 <= self.width <= 8192:
            raise ReconstructError(f"width must be from 16 to 8192 px, not {self.width!r}")
        for shift in self.shifts:
            if not 0 < shift <= 20:
                raise ReconstructError(f"shifts must be above 0 and at most 20 m, not {shift!r}")
        for name in ("shifted_frames", "repeats"):
            if getattr(self, name) < 1:
                raise ReconstructError(f"{name} must be at least 1, not {getattr(self, name)!r}")


@dataclass(frozen=True)
class LoggedViewScore:
    """One rendered view against its logged image.

    Attributes:
        camera, frame: camera and frame of the view.
        psnr: over all pixels [dB]; infinite for equal images.
        ssim: structural similarity, at most 1.
        psnr_objects: over the pixels within the boxes of moving objects [dB]; nan below 50 pixels.
        object_pixels: number of these pixels.
        depth_error_m: median absolute error of the rendered depth at the LiDAR points of the
            same sweep that the camera can see [m]; infinite if most hit nothing, nan without
            points.
        depth_error_p90_m: 90th percentile of the same errors [m].
        lidar_points: number of these points.
        lidar_missed: fraction of them without a rendered surface, 0 to 1.
    """

    camera: str
    frame: int
    psnr: float
    ssim: float
    psnr_objects: float
    object_pixels: int
    depth_error_m: float
    depth_error_p90_m: float
    lidar_points: int
    lidar_missed: float


@dataclass(frozen=True)
class CameraScore:
    """Means over the views of one camera, as in :class:`Evaluation`."""

    psnr: float
    ssim: float
    psnr_objects: float
    depth_error_m: float
    depth_error_p90_m: float
    depth_error_mean_m: float


@dataclass(frozen=True)
class Evaluation:
    """A scene against its log.

    Attributes:
        scene, log: names.
        frames: indices of the compared frames.
        frames_unseen: whether the scene lists all of them as unused in its training.
        gaussians: number in the scene.
        psnr, ssim: means over views, all pixels [dB], [1].
        psnr_objects: mean over the views that show moving objects, within their boxes [dB].
        depth_error_m: median over all compared LiDAR points of all views [m].
        depth_error_p90_m: 90th percentile over the same points [m].
        depth_error_mean_m: mean over the points with a rendered surface [m].
        box_error_m: median distance between the centres of moving objects and of the log's boxes
            over all their times [m]; nan if the log has none of the scene's objects.
        frames_per_second: camera images rendered per second, see :class:`.rendering.RenderRate`.
        width, height: size of the first camera's compared image [px].
        by_camera: the same per camera.
        views: one score per view, by frame, then by camera.
        shifted: views shifted from the path; empty without truth.
        no_shifted: the reason why it is empty; empty otherwise.
        lane_band: the road seen from shifted poses, against its appearance in other images.
        around: vehicles from all sides; None unless requested.
        edits: edited vehicles against the truth; None unless requested, empty if no compared frame
            shows one.
        lidar: sweeps against the measured or true ones; None unless requested, or without sweeps.
        uncertainty: rendered uncertainty against true errors; None if the scene has none.
    """

    scene: str
    log: str
    frames: tuple[int, ...]
    frames_unseen: bool
    gaussians: int
    psnr: float
    ssim: float
    psnr_objects: float
    depth_error_m: float
    depth_error_p90_m: float
    depth_error_mean_m: float
    box_error_m: float
    frames_per_second: float
    width: int
    height: int
    by_camera: dict[str, CameraScore]
    views: tuple[LoggedViewScore, ...]
    shifted: tuple[ShiftScore, ...] = ()
    no_shifted: str = ""
    lane_band: tuple[LaneBandScore, ...] = ()
    around: AroundScore | None = None
    edits: tuple[EditScore, ...] | None = None
    lidar: LidarScore | None = None
    uncertainty: UncertaintyScore | None = None
    timing_s: dict[str, float] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
        """JSON values; infinite ratios become PSNR_CAP, unknown values null.

        Without truth, ``shifted`` is missing and ``no_shifted`` gives the reason.
        """
        values = _plain(asdict(self))
        values.pop("no_shifted" if self.shifted else "shifted")
        for name in ("edits", "lidar", "uncertainty"):
            if values[name] is None:
                values.pop(name)
        return dict(values)


def evaluate_scene(
    scene: Scene,
    log: DrivingLog,
    *,
    options: EvaluateOptions | None = None,
    on_progress: OnProgress | None = None,
) -> Evaluation:
    """Render logged views, compare them with images and LiDAR, time it, render shifted views.

    Every view is rendered at the time of its image, with the scene's own calibration and object
    poses, which training may have refined. The positions of moving objects come from the log. For a
    scene made of a part of the log, only that part is used, and its frames count from 0.

    Raises:
        ReconstructError: the scene and the log do not belong together, no frame is left, or the
            log lacks the truth that ``around`` and ``edits`` need.
        LogError: images or sweeps that cannot be read.
    """
    options = options or EvaluateOptions()
    log = same_part(log, scene.provenance)
    timing_s: dict[str, float] = {}
    stages = Stages(on_progress, timing_s)
    chosen = select_frames(scene, log, options.frames)
    cameras = select_cameras(scene, log, options.width)
    pairs = [
        (camera, frame)
        for frame in chosen.frames
        for camera in cameras
        if log.has_image(camera.name, frame)
    ]
    if not pairs:
        raise ReconstructError(f"log {log.name!r} has no image at frames {list(chosen.frames)}")
    street = _required_truth(log) if options.around or options.edits else None
    views, errors = [], []
    with stages("views") as report_step:
        for done, (camera, frame) in enumerate(pairs):
            view, error = _score(scene, log, camera, frame, options.backend)
            views.append(view)
            errors.append(error)
            report_step(done + 1, len(pairs))
    times = [image_time(log, cameras[0].name, frame) for frame in chosen.frames]
    with stages("rate"):
        rate = measure_rate(scene, cameras, times, repeats=options.repeats, backend=options.backend)
    with stages("shifted") as report_step:
        shifted, missing = _shifted(
            scene, log, cameras, times, options=options, report_step=report_step
        )
    with stages("lane_band"):
        lane_band = _lane_band(scene, log, cameras[0], chosen.frames, options)
    around, edits = None, None
    if street is not None and options.around:
        with stages("around"):
            around = evaluate_around(scene, street)
    if street is not None and options.edits:
        with stages("edits") as report_step:
            edits = evaluate_edits(
                scene, log, street, pairs, backend=options.backend, on_edit=report_step
            )
    with stages("uncertainty"):
        uncertainty = evaluate_uncertainty(scene, log, pairs, backend=options.backend)
    with stages("lidar"):
        lidar = evaluate_sweeps(scene, log, chosen.frames) if options.lidar else None
    return Evaluation(
        scene=scene.name,
        log=log.name,
        frames=chosen.frames,
        frames_unseen=chosen.held_out,
        gaussians=scene.gaussian_count,
        box_error_m=box_error(scene, log),
        frames_per_second=rate.frames_per_second,
        width=cameras[0].width,
        height=cameras[0].height,
        by_camera=_by_camera(views, errors),
        views=tuple(views),
        shifted=shifted,
        no_shifted=missing,
        lane_band=lane_band,
        around=around,
        edits=edits,
        lidar=lidar,
        uncertainty=uncertainty,
        timing_s=timing_s,
        **asdict(_summary(views, errors)),
    )


def logged_pair(
    scene: Scene, log: DrivingLog, camera: Camera, frame: int, backend: str
) -> tuple[NDArray[np.uint8], Frame]:
    """The logged image at the size of ``camera``, and the rendered view.

    Raises:
        LogError: the image cannot be read.
    """
    image = resized(log.image(camera.name, frame), camera)
    t_us = image_time(log, camera.name, frame)
    return image, render_view(scene, camera, t_us, backend=backend)


def logged_mask(log: DrivingLog, camera: Camera, frame: int) -> NDArray[np.bool_]:
    """[H, W] bool, pixels within the boxes of moving objects."""
    t_us = image_time(log, camera.name, frame)
    pose = camera.pose(log.ego.transform(t_us))
    return tracks_mask(moving_tracks(log), camera, pose, t_us)


def _score(
    scene: Scene, log: DrivingLog, camera: Camera, frame: int, backend: str
) -> tuple[LoggedViewScore, NDArray[np.float64]]:
    image, rendered = logged_pair(scene, log, camera, frame, backend)
    assert rendered.depth is not None
    mask = logged_mask(log, camera, frame)
    points = points_in_camera(log, camera, frame, image_time(log, camera.name, frame))
    errors = depth_errors(rendered.depth, points, camera)
    enough = int(mask.sum()) >= MIN_OBJECT_PIXELS
    score = LoggedViewScore(
        camera=camera.name,
        frame=frame,
        psnr=psnr(rendered.rgb, image),
        ssim=ssim(rendered.rgb, image),
        psnr_objects=psnr(rendered.rgb, image, mask) if enough else float("nan"),
        object_pixels=int(mask.sum()),
        depth_error_m=median_error(errors),
        depth_error_p90_m=error_p90(errors),
        lidar_points=len(errors),
        lidar_missed=float(np.isinf(errors).mean()) if len(errors) else float("nan"),
    )
    return score, errors


def _shifted(
    scene: Scene,
    log: DrivingLog,
    cameras: Sequence[Camera],
    times_us: Sequence[int],
    *,
    options: EvaluateOptions,
    report_step: ReportStep,
) -> tuple[tuple[ShiftScore, ...], str]:
    if not options.shifts:
        return (), "no shifts were asked for"
    truth = find_truth(log)
    if truth.log is None:
        return (), f"no ground truth exists off the recorded path: {truth.missing}"
    scores = evaluate_shifts(
        scene,
        truth.log,
        cameras,
        spread(times_us, options.shifted_frames),
        options.shifts,
        backend=options.backend,
        on_view=report_step,
    )
    return scores, ""


def _lane_band(
    scene: Scene,
    log: DrivingLog,
    camera: Camera,
    frames: Sequence[int],
    options: EvaluateOptions,
) -> tuple[LaneBandScore, ...]:
    if not options.shifts:
        return ()
    chosen = spread(frames, options.shifted_frames)
    return evaluate_lane_band(scene, log, camera, chosen, options.shifts, backend=options.backend)


def _required_truth(log: DrivingLog) -> SyntheticLog:
    truth = find_truth(log)
    if truth.log is None:
        raise ReconstructError(
            "views from all around and edits are compared with a true street, which this log "
            f"lacks: {truth.missing}; evaluate without them"
        )
    return truth.log


def _by_camera(
    views: Sequence[LoggedViewScore], errors: Sequence[NDArray[np.float64]]
) -> dict[str, CameraScore]:
    names = dict.fromkeys(view.camera for view in views)
    places = {name: [i for i, view in enumerate(views) if view.camera == name] for name in names}
    return {
        name: _summary([views[i] for i in members], [errors[i] for i in members])
        for name, members in places.items()
    }


def _summary(
    views: Sequence[LoggedViewScore], errors: Sequence[NDArray[np.float64]]
) -> CameraScore:
    all_errors = np.concatenate(errors)
    return CameraScore(
        psnr=mean_psnr(view.psnr for view in views),
        ssim=float(np.mean([view.ssim for view in views])),
        psnr_objects=mean_psnr(view.psnr_objects for view in views),
        depth_error_m=median_error(all_errors),
        depth_error_p90_m=error_p90(all_errors),
        depth_error_mean_m=mean_error(all_errors),
    )


def _plain(value: Any, key: str = "") -> Any:
    if isinstance(value, dict):
        return {name: _plain(item, name) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item, key) for item in value]
    if isinstance(value, float) and not np.isfinite(value):
        return PSNR_CAP if key.startswith("psnr") and value > 0 else None
    return value
