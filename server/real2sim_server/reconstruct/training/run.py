"""From a log to a trained scene: stage 0, training, and the score of what was held out."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...logs import DrivingLog, check_log
from ...logs.driving_log import SELECTION
from ...render.backend import Backend
from ...render.images import write_png
from ...scene import Scene
from ...scene.io import load_scene, save_scene
from ..initialise.stage0 import initialise_scene
from ..options import ReconstructError
from ..stages import OnProgress, Stages
from .boxes import smoothed_boxes
from .data import TrainingViews, held_out_frames, training_log
from .held_out import HeldOutScore, score_held_out
from .model import SceneModel
from .progress import OnTraining, TrainingProgress
from .schedule import TrainOptions
from .threads import one_torch_thread
from .trainer import CHECKPOINT, Trainer

INITIAL = "initial.r2s"
PREVIEWS = "previews"


@dataclass(frozen=True, eq=False)
class TrainResult:
    """What training made.

    Attributes:
        scene: trained, not written anywhere yet.
        score: over the held-out frames.
        seconds: of the steps taken in this run.
        steps: taken in this run; fewer than all where it was resumed.
        stage_s: seconds of these by stage.
    """

    scene: Scene
    score: HeldOutScore
    seconds: float
    steps: int
    stage_s: dict[str, float]


def train(
    log: DrivingLog,
    options: TrainOptions,
    folder: Path,
    *,
    resume: bool = False,
    backend: str | Backend = "auto",
    on_progress: OnProgress | None = None,
    on_training: OnTraining | None = None,
    timing_s: dict[str, float] | None = None,
) -> TrainResult:
    """Train a scene on ``log``.

    Held-out frames are kept from stage 0 as well: neither their images nor their sweeps are read
    before the end.

    Args:
        options: of stage 0 and of training.
        folder: for the first scene, checkpoints, metrics and preview pictures.
        resume: go on from the checkpoint in ``folder``; the result is the same, bit for bit on
            the CPU, as without a break.
        backend: of the renderer.
        on_progress: called with the stage, steps done and steps in all.
        on_training: called with figures every ``options.log_every`` steps.
        timing_s: filled with the seconds of each stage.

    Raises:
        ReconstructError: the log has nothing to train on, or there is nothing to resume.
        LogError: a file of the log is missing or broken; said before anything is built.
    """
    timing_s = {} if timing_s is None else timing_s
    stages = Stages(on_progress, timing_s)
    with stages("check") as report_step:
        check_log(log, on_progress=report_step).raise_for_problems()
    scene = _first_scene(
        log, options, folder, resume=resume, on_progress=on_progress, timing_s=timing_s
    )
    trainer = Trainer(log, scene, options, folder=folder, backend=backend)
    if resume:
        trainer.resume()
    elif trainer.metrics is not None:
        trainer.metrics.cut(-1)
    start, first = time.perf_counter(), trainer.iteration
    with one_torch_thread(), stages("train") as report_step:
        trainer.run(
            on_progress=_combined(on_training, report_step),
            on_preview=_previewer(log, options, folder / PREVIEWS),
        )
    seconds = time.perf_counter() - start
    trainer.views.close()
    with stages("score"):
        score = score_held_out(trainer.model, log, options)
    trained = trainer.model.export(
        stage=1,
        iterations=options.iterations,
        options=asdict(options),
        held_out_frames=held_out_frames(log.frame_count, options.hold_out),
    )
    steps = options.iterations - first
    return TrainResult(trained, score, seconds, steps, trainer.running.stages)


def _first_scene(
    log: DrivingLog,
    options: TrainOptions,
    folder: Path,
    *,
    resume: bool,
    on_progress: OnProgress | None,
    timing_s: dict[str, float],
) -> Scene:
    """The scene of stage 0: made now and written down, or the one a broken-off run began with."""
    if resume:
        if not (folder / CHECKPOINT).is_dir():
            raise ReconstructError(f"{folder}: holds no checkpoint to resume; start without resume")
        begun = load_scene(folder / INITIAL)
        if begun.provenance.get(SELECTION) != log.provenance.get(SELECTION):
            raise ReconstructError(
                f"{folder}: was begun on {_part(begun.provenance)}, not on "
                f"{_part(log.provenance)}; resume with the same frames and cameras"
            )
        return begun
    seen = training_log(log, options.hold_out)
    if options.refine_poses:
        seen = smoothed_boxes(seen)
    scene = initialise_scene(
        seen, options=options.initialise, on_progress=on_progress, timing_s=timing_s
    )
    # Whoever takes these surfaces can tell what they did not see.
    made = {**scene.provenance["reconstruction"]}
    made["held_out_frames"] = held_out_frames(log.frame_count, options.hold_out)
    provenance = {**scene.provenance, "reconstruction": made}
    scene = replace(scene, frame_times_us=log.frame_times_us, provenance=provenance)
    return save_scene(scene, folder / INITIAL, overwrite=True)


def _part(provenance: Mapping[str, Any]) -> str:
    part = provenance.get(SELECTION)
    if not isinstance(part, dict):
        return "the whole log"
    frames = ":".join(str(number) for number in part["frames"])
    cameras = part["cameras"]
    return f"frames {frames}" + ("" if cameras is None else f" of {', '.join(cameras)}")


def _combined(
    on_training: OnTraining | None, report_step: Callable[[int, int], None]
) -> OnTraining:
    def report(progress: TrainingProgress) -> None:
        report_step(progress.iteration, progress.iterations)
        if on_training is not None:
            on_training(progress)

    return report


def _previewer(
    log: DrivingLog, options: TrainOptions, folder: Path
) -> Callable[[SceneModel, int], None]:
    """Writes the image of a held-out frame above what the model shows, camera beside camera."""
    frames = held_out_frames(log.frame_count, options.hold_out) or [log.frame_count // 2]
    views = TrainingViews(log, [frames[len(frames) // 2]], options)

    def write(model: SceneModel, iteration: int) -> None:
        import torch

        columns = []
        for index in range(len(views)):
            view = views.view(index)
            with torch.no_grad():
                image = model.render(view.camera, view.t_us).rgb.clamp(0, 1)
            columns.append(np.concatenate([view.image.numpy(), image.cpu().numpy()]))
        height = max(column.shape[0] for column in columns)
        padded = [np.pad(c, ((0, height - c.shape[0]), (0, 0), (0, 0))) for c in columns]
        picture = (np.concatenate(padded, axis=1) * 255).round().astype(np.uint8)
        write_png(folder / f"{iteration:06d}.png", picture)

    return write
