"""From the folder of a log to a scene bundle with a report."""

from __future__ import annotations

from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path

import numpy as np

from ..logs import DrivingLog, open_log
from ..scene import Scene
from ..scene.io import save_scene
from .evaluation import evaluate_views, render_logged_view
from .initialise import initialise_scene
from .options import InitialiseOptions, ReconstructError
from .stages import OnProgress, Stages
from .views import chosen_frames

EVALUATED_FRAMES = 4


@dataclass(frozen=True)
class ReconstructReport:
    """What came out of a reconstruction.

    Attributes:
        scene: folder of the bundle.
        preview: PNG of a logged image above its rendered view.
        frames, cameras: of the log.
        objects: number of objects.
        gaussians: in background and objects.
        background_gaussians: in the background.
        gaussians_by_object: by object id.
        psnr_db: mean over the evaluated views, all pixels [dB].
        psnr_lidar_db: likewise over the pixels that LiDAR covers [dB].
        evaluated_frames: indices of the frames behind these figures.
        total_s: seconds for everything.
        timing_s: seconds by stage.
    """

    scene: str
    preview: str
    frames: int
    cameras: int
    objects: int
    gaussians: int
    background_gaussians: int
    gaussians_by_object: dict[str, int]
    psnr_db: float
    psnr_lidar_db: float
    evaluated_frames: list[int]
    total_s: float
    timing_s: dict[str, float] = field(default_factory=dict)


def reconstruct(
    log_path: str | PathLike[str],
    out: str | PathLike[str],
    *,
    iterations: int = 0,
    options: InitialiseOptions | None = None,
    log_format: str | None = None,
    sequence: str | None = None,
    overwrite: bool = False,
    on_progress: OnProgress | None = None,
) -> ReconstructReport:
    """Build a scene from the log in a folder and write it as a bundle.

    Besides the bundle ``out`` a preview ``<out name>.preview.png`` is left next to it.

    Args:
        log_path: folder of the log.
        out: folder of the bundle, by custom ``<name>.r2s``.
        iterations: of training; only 0 is possible so far.
        options: of stage 0.
        log_format, sequence: passed to ``open_log``.
        overwrite: replace an existing bundle.
        on_progress: told the stage and how far it is.

    Raises:
        ReconstructError: training was asked for, or the log has nothing to build from.
        LogError: the log cannot be read.
        BundleError: ``out`` exists and may not be replaced.
    """
    if iterations != 0:
        raise ReconstructError(
            f"iterations={iterations!r}: training does not exist yet; "
            "ask for 0 to build the scene from LiDAR and images alone"
        )
    timing_s: dict[str, float] = {}
    stages = Stages(on_progress, timing_s)
    with stages("open"):
        log = open_log(Path(log_path), format=log_format, sequence=sequence)
    scene = initialise_scene(log, options=options, on_progress=on_progress, timing_s=timing_s)
    with stages("write"):
        scene = save_scene(scene, out, overwrite=overwrite)
    with stages("evaluate"):
        frames = chosen_frames(log, EVALUATED_FRAMES)
        scores = evaluate_views(scene, log, frames=frames)
        preview = _write_preview(scene, log, Path(out), frames[len(frames) // 2])
    return ReconstructReport(
        scene=str(out),
        preview=str(preview),
        frames=log.frame_count,
        cameras=len(log.rig),
        objects=len(scene.objects),
        gaussians=scene.gaussian_count,
        background_gaussians=len(scene.background),
        gaussians_by_object={k: len(o.cloud) for k, o in scene.objects.items()},
        psnr_db=scores.psnr,
        psnr_lidar_db=scores.psnr_lidar,
        evaluated_frames=frames,
        total_s=sum(timing_s.values()),
        timing_s=timing_s,
    )


def _write_preview(scene: Scene, log: DrivingLog, out: Path, frame: int) -> Path:
    """The logged image of the first camera above the rendered one."""
    import cv2

    camera = log.rig.cameras[0]
    rendered = render_logged_view(scene, camera, int(log.frame_times_us[frame]))
    pair = np.concatenate([log.image(camera.name, frame), rendered])
    path = out.parent / f"{out.name}.preview.png"
    done, data = cv2.imencode(".png", np.ascontiguousarray(pair[..., ::-1]))
    if not done:
        raise ReconstructError(f"{path}: the preview could not be encoded")
    temporary = path.with_name(f".{path.name}.tmp")
    temporary.write_bytes(data.tobytes())
    temporary.replace(path)
    return path
