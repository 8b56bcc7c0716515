"""Reconstruction of a log folder into a scene bundle with a report."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path

import numpy as np

from ..logs import DrivingLog, open_log, usable_log
from ..render.images import write_png
from ..render.select import select_backend
from ..scene import Scene
from ..scene.io import save_scene
from .evaluation import evaluate_views, render_logged_view
from .evaluation.uncertainty import VIEWS, fit_uncertainties
from .initialise.stage0 import initialise_scene
from .initialise.views import chosen_frames
from .lidar import STEPS, fit_lidar_surfaces, has_sweeps
from .options import InitialiseOptions, OnProgress, ReconstructError, Stages
from .training import OnTraining, TrainOptions, held_out_frames, train, with_box_noise

EVALUATED_FRAMES = 4
MIN_VIEWS, STEPS_A_VIEW = 4, 30
"""Minimum number of views for uncertainty after training, and training steps per further view. A
view costs about as much as a step.
"""


@dataclass(frozen=True)
class TrainingFigures:
    """Results of training.

    Attributes:
        iterations: total number of iterations, including those before a resume.
        steps: iterations in this run.
        seconds: duration of ``steps``.
        rate: steps per second.
        psnr, ssim: means over all held-out views at training size; PSNR in [dB].
        psnr_objects: PSNR over the boxes of moving objects in these views [dB].
        held_out_frames: frames used neither in stage 0 nor in training.
        stage_ms: time per step by stage [ms].
        folder: folder with checkpoint, metrics and preview pictures.
    """

    iterations: int
    steps: int
    seconds: float
    rate: float
    psnr: float
    ssim: float
    psnr_objects: float
    held_out_frames: list[int]
    stage_ms: dict[str, float]
    folder: str


@dataclass(frozen=True)
class ReconstructReport:
    """Results of a reconstruction.

    Attributes:
        scene: folder of the bundle.
        preview: PNG of a logged image above its rendered view.
        frames, cameras: numbers of frames and cameras of the log.
        left_out: number of records of the log that were not used, by kind.
        objects: number of objects.
        gaussians: number in background and objects.
        background_gaussians: number in the background.
        gaussians_by_object: by object id.
        psnr_db: mean over the evaluated views, all pixels [dB].
        psnr_lidar_db: the same over the pixels that LiDAR covers [dB].
        evaluated_frames: indices of the frames behind these figures.
        total_s: total duration [s].
        timing_s: seconds by stage.
        training: figures of training; None without training.
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
    left_out: dict[str, int] = field(default_factory=dict)
    training: TrainingFigures | None = None


@dataclass(frozen=True)
class ReconstructOptions:
    """Options for making a scene from a log.

    Attributes:
        initialise: options of stage 0; None uses those of ``training``.
        training: None builds from LiDAR without training.
        box_noise: noise added to the boxes of the log, for measuring its correction by training;
        see ``with_box_noise``.
        lidar_steps: steps of fitting LiDAR surfaces, see :func:`fit_lidar_surfaces`; 0 fits none.
        backend: backend of the renderer; training runs on its device.
        strict: refuse a log of which anything is left out.
    """

    initialise: InitialiseOptions | None = None
    training: TrainOptions | None = None
    box_noise: float = 0.0
    lidar_steps: int = STEPS
    backend: str = "auto"
    strict: bool = False


def reconstruct(
    log: DrivingLog | str | PathLike[str],
    out: str | PathLike[str],
    options: ReconstructOptions | None = None,
    *,
    resume: bool = False,
    overwrite: bool = False,
    on_progress: OnProgress | None = None,
    on_training: OnTraining | None = None,
) -> ReconstructReport:
    """Build a scene from a log and write it as a bundle.

    Also writes a preview ``<out name>.preview.png`` next to ``out``. Training adds the folder
    ``<out name>.training`` with checkpoint, metrics and preview pictures.

    Args:
        log: opened, or its folder.
        out: folder of the bundle, by convention ``<name>.r2s``.
        options: how to build the scene; by default stage 0 with its default options.
        resume: continue from the checkpoint of an interrupted run with the same arguments.
        overwrite: replace an existing bundle.
        on_progress: called with the stage, completed and total steps.
        on_training: called with figures of training during the run.

    Raises:
        ReconstructError: the log has nothing to build from, or there is nothing to resume.
        LogError: the log cannot be read, or too much of it is left out; see :func:`usable_log`.
        BundleError: ``out`` exists and ``overwrite`` is false.
        RenderError: the renderer is not usable here; raised before anything is read.
    """
    options = options or ReconstructOptions()
    select_backend(options.backend)
    if resume and options.training is None:
        raise ReconstructError("there is nothing to resume without training: give its options")
    timing_s: dict[str, float] = {}
    stages = Stages(on_progress, timing_s)
    with stages("open"):
        log = log if isinstance(log, DrivingLog) else open_log(Path(log))
    with stages("check") as report_step:
        log = usable_log(log, strict=options.strict, on_progress=report_step)
        if options.box_noise > 0:
            log = with_box_noise(log, options.box_noise)
    figures = None
    if options.training is None:
        scene = first = initialise_scene(
            log, options=options.initialise, on_progress=on_progress, timing_s=timing_s
        )
    else:
        scene, first, figures = _train(
            log,
            _training_options(options.training, options.initialise),
            Path(out),
            resume=resume,
            stages=_Callbacks(on_progress, on_training, timing_s),
            backend=options.backend,
        )
        with stages("uncertainty") as report_step:
            views = max(MIN_VIEWS, min(VIEWS, figures.iterations // STEPS_A_VIEW))
            scene, _ = fit_uncertainties(
                scene, log, views=views, backend=options.backend, on_view=report_step
            )
    if options.lidar_steps and has_sweeps(log, scene):
        scene, fitted = fit_lidar_surfaces(
            scene, log, surfaces=first, steps=options.lidar_steps, on_progress=on_progress
        )
        timing_s |= {f"lidar {stage}": spent for stage, spent in fitted.timing_s.items()}
    with stages("write"):
        scene = save_scene(scene, out, overwrite=overwrite)
    with stages("evaluate"):
        frames = _evaluated_frames(log, figures)
        scores = evaluate_views(scene, log, frames=frames, backend=options.backend)
        middle = frames[len(frames) // 2]
        preview = _write_preview(scene, log, Path(out), middle, backend=options.backend)
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
        left_out={kind: len(sentences) for kind, sentences in log.left_out.items()},
        training=figures,
    )


@dataclass(frozen=True)
class _Callbacks:
    """Progress callbacks and collected times."""

    on_progress: OnProgress | None
    on_training: OnTraining | None
    timing_s: dict[str, float]


def _training_options(training: TrainOptions, initialise: InitialiseOptions | None) -> TrainOptions:
    return training if initialise is None else replace(training, initialise=initialise)


def _train(
    log: DrivingLog,
    options: TrainOptions,
    out: Path,
    *,
    resume: bool,
    stages: _Callbacks,
    backend: str,
) -> tuple[Scene, Scene, TrainingFigures]:
    """The trained scene, that of stage 0, and figures."""
    folder = out.parent / f"{out.name}.training"
    result = train(
        log,
        options,
        folder,
        resume=resume,
        backend=backend,
        on_progress=stages.on_progress,
        on_training=stages.on_training,
        timing_s=stages.timing_s,
    )
    steps = max(result.steps, 1)
    figures = TrainingFigures(
        iterations=options.iterations,
        steps=result.steps,
        seconds=result.seconds,
        rate=result.steps / max(result.seconds, 1e-9),
        psnr=result.score.psnr,
        ssim=result.score.ssim,
        psnr_objects=result.score.psnr_objects,
        held_out_frames=held_out_frames(log.frame_count, options.hold_out),
        stage_ms={name: 1e3 * spent / steps for name, spent in result.stage_s.items()},
        folder=str(folder),
    )
    return result.scene, result.first, figures


def _evaluated_frames(log: DrivingLog, figures: TrainingFigures | None) -> list[int]:
    """A few frames spread over the log, held-out ones if available."""
    seen = set(log.seen_frames())
    held_out = [frame for frame in figures.held_out_frames if frame in seen] if figures else []
    if not held_out:
        return chosen_frames(log, EVALUATED_FRAMES)
    return held_out[:: -(-len(held_out) // EVALUATED_FRAMES)]


def _write_preview(scene: Scene, log: DrivingLog, out: Path, frame: int, *, backend: str) -> Path:
    """The logged image of the first camera above the rendered one."""
    camera = next(camera for camera in log.rig if log.has_image(camera.name, frame))
    t_us = int(log.frame_times_us[frame])
    rendered = render_logged_view(scene, camera, t_us, backend=backend)
    path = out.parent / f"{out.name}.preview.png"
    write_png(path, np.concatenate([log.image(camera.name, frame), rendered]))
    return path
