"""A self-contained HTML page with figures and images side by side."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..._files import atomic_file
from ...geometry import box_corners
from ...logs import DrivingLog, same_part
from ...render import Frame, encode_rgb
from ...render.frame import uncertainty_picture
from ...scene import Camera, Scene
from ..logged_view import box_outline, image_time, moving_tracks, spread
from .edits import EditScore, apply_edit, compare_edit, edits_of
from .images import Truth, find_truth
from .rendering import render_uncertainty, render_view, select_cameras
from .scores import CameraScore, EvaluateOptions, Evaluation, logged_pair
from .shifted import true_view

# Images for visual comparison: errors and depth in colour, crops of moving objects.

ERROR_FULL = 64.0
"""Maximum of the colour scale of error images, in 8-bit levels."""
DEPTH_NEAR, DEPTH_FAR = 2.0, 80.0
"""Range of the logarithmic colour scale of depth images [m]."""
CROP_MARGIN = 0.15
"""Margin of crops around the outline of a box, as a fraction of its size."""
MIN_CROP = 12
"""Minimum size on the image of the objects shown [px]."""

Image = NDArray[np.uint8]


def error_image(image: Image, truth: Image) -> Image:
    """[H, W, 3] mean absolute difference of the channels, from black (0) to yellow (ERROR_FULL)."""
    import cv2

    difference = np.abs(image.astype(np.float32) - truth).mean(axis=-1)
    return _coloured(difference / ERROR_FULL, cv2.COLORMAP_INFERNO)


def depth_image(depth: NDArray[np.float32]) -> Image:
    """[H, W, 3] of a depth image [H, W] [m]: near is red, far is blue, empty is black."""
    import cv2

    near, far = np.log(DEPTH_NEAR), np.log(DEPTH_FAR)
    fraction = (far - np.log(np.maximum(depth, DEPTH_NEAR))) / (far - near)
    return np.where((depth > 0)[..., None], _coloured(fraction, cv2.COLORMAP_TURBO), np.uint8(0))


def object_crops(
    log: DrivingLog, camera: Camera, frame: int, limit: int
) -> list[tuple[str, tuple[slice, slice]]]:
    """Id and rows and columns of at most ``limit`` moving objects, the largest on the image first.

    At least half of the outline's bounding box must be on the image, and no other object may
    occlude the centre.
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


# The HTML page; all images and styles are inlined.

PAGE = "report.html"
SHOWN_FRAMES, SHOWN_OBJECTS, SHOWN_SHIFT = 3, 3, 2.0
IMAGE_WIDTH, CROP_WIDTH = 640, 320
STYLE = """
body{font:15px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:1500px;padding:0 1rem;
color:#1a1d21;background:#fff}
h1{font-size:1.5rem;margin-bottom:.2rem}h2{font-size:1.15rem;margin-top:2.2rem}
h3{font-size:1rem;margin:1.2rem 0 .3rem}p{margin:.3rem 0 .8rem;color:#4a525c;max-width:60rem}
table{border-collapse:collapse;margin:.6rem 0}
th,td{padding:.25rem .9rem;text-align:right;border-bottom:1px solid #dfe3e8}
th:first-child,td:first-child{text-align:left}th{font-weight:600;background:#f4f6f8}
td{font-variant-numeric:tabular-nums}
.row{display:grid;grid-auto-flow:column;grid-auto-columns:1fr;gap:8px;margin-bottom:8px}
.crops{grid-auto-columns:minmax(0,320px);justify-content:start}
figure{margin:0}img{width:100%;display:block;border-radius:3px}
figcaption{font-size:.8rem;color:#4a525c}
"""


@dataclass(frozen=True, eq=False)
class _ReportContext:
    """Subject of the page."""

    scene: Scene
    log: DrivingLog
    evaluation: Evaluation
    truth: Truth
    backend: str


@dataclass(frozen=True, eq=False)
class _Figure:
    """A picture with its caption."""

    image: Image
    caption: str


def write_report(
    scene: Scene,
    log: DrivingLog,
    evaluation: Evaluation,
    folder: str | PathLike[str],
    *,
    options: EvaluateOptions | None = None,
) -> Path:
    """Write ``report.html`` into ``folder``, which is created if needed.

    Args:
        scene, log, options: as passed to ``evaluate_scene``.
        evaluation: its result.

    Returns:
        The page.

    Raises:
        LogError: images that cannot be read.
    """
    options = options or EvaluateOptions()
    log = same_part(log, scene.provenance)
    cameras = select_cameras(scene, log, options.width)
    subject = _ReportContext(scene, log, evaluation, find_truth(log), options.backend)
    frames = spread(evaluation.frames, SHOWN_FRAMES)
    parts = [
        _heading(evaluation),
        _figures(evaluation),
        _shift_figures(evaluation) + _around_figures(evaluation) + _edit_figures(evaluation),
        _uncertainty_figures(evaluation),
    ]
    parts.append("<h2>Recorded and rendered</h2>")
    parts.append(
        f"<p>Errors from black (none) to yellow ({ERROR_FULL:.0f} of 255 and more); depth from red "
        f"({DEPTH_NEAR:.0f} m) to blue ({DEPTH_FAR:.0f} m), black without depth.</p>"
    )
    for frame in frames:
        parts += [_view(subject, camera, frame) for camera in cameras]
    parts.append(_beside(subject, cameras[0], frames[len(frames) // 2]))
    if evaluation.edits:
        parts.append("<h2>Edited vehicles</h2>")
        parts += [_edited(subject, cameras, score) for score in evaluation.edits]
    parts.append(_view_figures(evaluation))
    page = Path(folder) / PAGE
    page.parent.mkdir(parents=True, exist_ok=True)
    title = escape(f"{evaluation.scene}: evaluation")
    with atomic_file(page) as file:
        file.write(
            f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
            f"<style>{STYLE}</style></head><body>{''.join(parts)}</body></html>\n".encode()
        )
    return page


def _heading(evaluation: Evaluation) -> str:
    count = len(evaluation.frames)
    seen = (
        "none of which was used for training"
        if evaluation.frames_unseen
        else "which may have been used to make it: figures on new images are lower"
    )
    return (
        f"<h1>{escape(evaluation.scene)}</h1><p>{evaluation.gaussians:,} Gaussians against log "
        f"{escape(evaluation.log)} at {evaluation.width}x{evaluation.height}, {count} frames, "
        f"{seen}.</p>"
    )


def _figures(evaluation: Evaluation) -> str:
    head = ("camera", "PSNR [dB]", "SSIM", "PSNR of moving objects [dB]",
            "LiDAR depth error, median [m]", "90th percentile [m]")  # fmt: skip
    scores: list[tuple[str, CameraScore | Evaluation]] = list(evaluation.by_camera.items())
    rows = [
        (name, _number(s.psnr), _number(s.ssim, 3), _number(s.psnr_objects),
         _number(s.depth_error_m, 3), _number(s.depth_error_p90_m, 3))
        for name, s in (*scores, ("all", evaluation))
    ]  # fmt: skip
    rate = f"<p>Rendered at {evaluation.frames_per_second:.1f} images per second.</p>"
    return "<h2>Figures</h2>" + _table(head, rows) + rate


def _shift_figures(evaluation: Evaluation) -> str:
    if not evaluation.shifted:
        return f"<h2>Off the recorded path</h2><p>{escape(evaluation.no_shifted)}</p>"
    head = ("offset to both sides [m]", "PSNR [dB]", "SSIM", "PSNR of moving objects [dB]",
            "depth error [m]", "views", "left out, inside a vehicle")  # fmt: skip
    rows = [
        (f"{s.shift_m:g}", _number(s.psnr), _number(s.ssim, 3), _number(s.psnr_objects),
         _number(s.depth_error_m, 3), str(s.views), str(s.views_in_objects))
        for s in evaluation.shifted
    ]  # fmt: skip
    return "<h2>Off the recorded path</h2>" + _table(head, rows)


def _around_figures(evaluation: Evaluation) -> str:
    around = evaluation.around
    if around is None:
        return ""
    head = ("sides of vehicles", "PSNR [dB]", "covered [%]", "views")
    seen = sum(side.seen for side in around.sides)
    rows = [
        ("seen by a camera", _number(around.psnr_seen), _number(100 * around.coverage_seen),
         str(seen)),
        ("never seen", _number(around.psnr_unseen), _number(100 * around.coverage_unseen),
         str(len(around.sides) - seen)),
    ]  # fmt: skip
    return "<h2>Vehicles from all around</h2>" + _table(head, rows)


def _edit_figures(evaluation: Evaluation) -> str:
    if not evaluation.edits:
        return ""
    head = ("vehicle, edit", "PSNR [dB]", "SSIM", "pixels", "views",
            "PSNR of revealed ground [dB]", "of shadows [dB]", "of unseen sides [dB]")  # fmt: skip
    rows = [
        (f"{s.object_id} ({s.vehicle}), {s.edit}", _number(s.psnr), _number(s.ssim, 3),
         str(s.pixels), str(len(s.views)), _number(s.psnr_hidden_ground), _number(s.psnr_shadows),
         _number(s.psnr_unseen))
        for s in evaluation.edits
    ]  # fmt: skip
    return "<h2>Edited vehicles, where edits change the street</h2>" + _table(head, rows)


def _uncertainty_figures(evaluation: Evaluation) -> str:
    score = evaluation.uncertainty
    if score is None:
        return ""
    head = ("views", "Spearman by pixel", "Spearman by 9x9 squares",
            "sparsification (0 best, 1 chance)", "mean", "mean error")  # fmt: skip
    figures = (score.spearman, score.spearman_regions, score.sparsification)
    means = (_number(100 * value) + " %" for value in (score.uncertainty, score.error))
    row = (str(score.views), *map(_number, figures), *means)
    return "<h2>Uncertainty against error</h2>" + _table(head, [row])


def _view_figures(evaluation: Evaluation) -> str:
    head = ("view", "PSNR [dB]", "SSIM", "PSNR of moving objects [dB]",
            "LiDAR depth error, median [m]", "90th percentile [m]", "LiDAR points",
            "LiDAR points missed [%]")  # fmt: skip
    rows = [
        (f"frame {v.frame}, {v.camera}", _number(v.psnr), _number(v.ssim, 3),
         _number(v.psnr_objects), _number(v.depth_error_m, 3), _number(v.depth_error_p90_m, 3),
         str(v.lidar_points), _number(100 * v.lidar_missed, 1))
        for v in evaluation.views
    ]  # fmt: skip
    return "<h2>All views</h2>" + _table(head, rows)


def _view(subject: _ReportContext, camera: Camera, frame: int) -> str:
    log, evaluation = subject.log, subject.evaluation
    image, rendered = logged_pair(subject.scene, log, camera, frame, subject.backend)
    assert rendered.depth is not None
    score = next(v for v in evaluation.views if (v.camera, v.frame) == (camera.name, frame))
    title = f"<h3>Frame {frame}, {escape(camera.name)}: {_number(score.psnr)} dB</h3>"
    shown = [
        _Figure(image, "recorded"),
        _Figure(rendered.rgb, "rendered"),
        _Figure(error_image(rendered.rgb, image), "error"),
        _Figure(depth_image(rendered.depth), "rendered depth"),
    ]
    if subject.scene.has_uncertainties:
        t_us = image_time(log, camera.name, frame)
        drawn = render_uncertainty(subject.scene, camera, t_us, backend=subject.backend)
        uncertain = _Figure(uncertainty_picture(drawn), "uncertainty, in the colours of errors")
        shown.insert(3, uncertain)
    return title + _row(shown) + _objects(log, camera, frame, image, rendered)


def _objects(log: DrivingLog, camera: Camera, frame: int, image: Image, rendered: Frame) -> str:
    crops = []
    for object_id, window in object_crops(log, camera, frame, SHOWN_OBJECTS):
        crops.append(_Figure(image[window], f"{object_id}, recorded"))
        crops.append(_Figure(rendered.rgb[window], f"{object_id}, rendered"))
    return _row(crops, crops=True) if crops else ""


def _beside(subject: _ReportContext, camera: Camera, frame: int) -> str:
    truth, t_us = subject.truth, image_time(subject.log, camera.name, frame)
    parts = [f"<h2>Frame {frame} at {SHOWN_SHIFT:g} m to the side of the path</h2>"]
    for left, side in ((SHOWN_SHIFT, "left"), (-SHOWN_SHIFT, "right")):
        view = render_view(subject.scene, camera, t_us, left=left, backend=subject.backend)
        shown = [_Figure(view.rgb, f"rendered, {side}")]
        if truth.log is not None:
            image, _, _ = true_view(truth.log, camera, t_us, left)
            error = error_image(view.rgb, image)
            shown = [_Figure(image, f"truth, {side}"), *shown, _Figure(error, "error")]
        parts.append(_row(shown))
    return "".join(parts)


def _edited(subject: _ReportContext, cameras: Sequence[Camera], score: EditScore) -> str:
    """The view of an edit with the largest changed region, cut out."""
    street = subject.truth.log
    assert street is not None
    shown = max(score.views, key=lambda view: view.pixels)
    camera = next(camera for camera in cameras if camera.name == shown.camera)
    edit = apply_edit(subject.scene, street, score.object_id, edits_of(score.object_id)[score.edit])
    t_us = image_time(subject.log, camera.name, shown.frame)
    view = compare_edit(subject.scene, edit, camera, t_us, backend=subject.backend)
    rows, columns = (np.flatnonzero(view.region.any(axis=axis)) for axis in (1, 0))
    window = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    title = f"{score.object_id}, {score.edit}, frame {shown.frame}, {camera.name}"
    return f"<h3>{escape(title)}: {_number(shown.psnr)} dB</h3>" + _row(
        [
            _Figure(view.before[window], "truth before the edit"),
            _Figure(view.after[window], "truth after the edit"),
            _Figure(view.rendered[window], "rendered"),
            _Figure(error_image(view.rendered, view.after)[window], "error"),
        ],
        crops=True,
    )


def _row(shown: Sequence[_Figure], *, crops: bool = False) -> str:
    figures = []
    for item in shown:
        width = CROP_WIDTH if crops else min(IMAGE_WIDTH, item.image.shape[1])
        data = base64.b64encode(jpeg(np.ascontiguousarray(item.image), width=width)).decode()
        caption = escape(item.caption)
        figures.append(
            f'<figure><img alt="{caption}" src="data:image/jpeg;base64,{data}">'
            f"<figcaption>{caption}</figcaption></figure>"
        )
    return f'<div class="row{" crops" if crops else ""}">{"".join(figures)}</div>'


def _table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    top = "".join(f"<th>{escape(cell)}</th>" for cell in head)
    body = "".join(
        "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows
    )
    return f"<table><tr>{top}</tr>{body}</table>"


def _number(value: float, digits: int = 2) -> str:
    if np.isnan(value):
        return "none"
    return f"{value:.{digits}f}" if np.isfinite(value) else "infinite"
