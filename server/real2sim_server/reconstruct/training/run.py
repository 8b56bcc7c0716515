"""From a log to a trained scene: initialisation, training, and the held-out score."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...geometry import (
    Float,
    multiply_quaternions,
    quaternion_to_matrix,
    quaternion_yaw,
    yaw_quaternion,
)
from ...logs import DrivingLog, ObjectTrack
from ...logs.driving_log import SELECTION
from ...render.backend import Backend
from ...render.images import write_png
from ...scene import Scene, Trajectory
from ...scene.io import load_scene, save_scene
from ..initialise.stage0 import initialise_scene
from ..logged_view import objects_mask, spread
from ..options import OnProgress, ReconstructError, Stages
from . import losses
from .data import TrainingViews, held_out_frames, training_log
from .model import SceneModel
from .records import OnTraining, TrainingProgress
from .schedule import TrainOptions
from .trainer import CHECKPOINT, Trainer

# Torch threads.


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Run small torch operations on the calling thread; compiled loops still use all cores.

    A step has hundreds of operations of a few microseconds each. If other programs compete for the
    cores, torch's threads wait for each other at every operation: six times slower, measured with
    two cores and three busy programs.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


# Box noise: added for tests, and smoothed before initialisation.

ACCELERATION, YAW_ACCELERATION = 2.0, 0.6
"""Motion priors of vehicles: standard deviations [m/s^2] and [rad/s^2]."""
MIN_NOISE, MIN_YAW_NOISE = 0.02, 0.005
"""Noise below which boxes count as exact [m], [rad]."""
MIN_POSES = 5
STANDING = 1.5
"""Maximum scatter of the boxes of a standing object, relative to their noise."""


def with_box_noise(log: DrivingLog, fraction: float, *, seed: int = 0) -> DrivingLog:
    """``log`` with boxes that scatter independently from frame to frame.

    Args:
        fraction: standard deviation of positions as a fraction of the box's length, width and
            height along its own axes, and of headings [rad].
    """
    tracks = []
    for index, track in enumerate(log.tracks):
        rng = np.random.default_rng([seed, index])
        given = track.trajectory.sampled(log.frame_times_us)
        count = len(given.times_us)
        shift = rng.standard_normal((count, 3)) * (fraction * np.array(track.size))
        rotations = quaternion_to_matrix(given.quaternions)
        tracks.append(
            _with_poses(
                replace(track, trajectory=given),
                given.positions + np.einsum("tij,tj->ti", rotations, shift),
                rng.standard_normal(count) * fraction,
            )
        )
    return replace(log, tracks=tuple(tracks))


def smoothed_boxes(log: DrivingLog) -> DrivingLog:
    """``log`` with box noise smoothed to feasible vehicle motion.

    Second differences measure the noise. Objects whose boxes scatter little more than that stand
    still: they get their median pose. For others with more noise than normal driving explains,
    positions and headings are smoothed with the weight that follows from both (Whittaker 1923).
    Boxes of moving objects without noise stay bit-identical.
    """
    return replace(log, tracks=tuple(_smoothed(track) for track in log.tracks))


def _smoothed(track: ObjectTrack) -> ObjectTrack:
    given = track.trajectory
    if len(given.times_us) < MIN_POSES:
        return track
    step = float(np.median(np.diff(given.times_us))) * 1e-6
    heading = np.unwrap(quaternion_yaw(given.quaternions))
    if _stands(given.positions, MIN_NOISE) and _stands(heading[:, None], MIN_YAW_NOISE):
        usual = int(np.argmin(np.abs(heading - np.median(heading))))
        poses = np.median(given.positions, axis=0), given.quaternions[usual]
        ends = (np.tile(pose, (2, 1)) for pose in poses)
        return replace(track, trajectory=Trajectory(given.times_us[[0, -1]], *ends))
    smooth = _whittaker(given.positions, ACCELERATION * step**2, MIN_NOISE)
    turned = _whittaker(heading[:, None], YAW_ACCELERATION * step**2, MIN_YAW_NOISE)[:, 0]
    if smooth is given.positions and np.array_equal(turned, heading):
        return track
    return _with_poses(track, smooth, turned - heading)


def _stands(values: Float, least: float) -> bool:
    """Whether ``values`` [T, D] scatter little more than their noise, at least ``least``."""
    scatter = np.sqrt(values.var(axis=0).sum())
    return bool(scatter < STANDING * max(least, np.sqrt(_noise(values).sum())))


def _noise(values: Float) -> Float:
    """Variances [D] of the noise of ``values`` [T, D], from their second differences.

    Robust to the few steps with hard braking.
    """
    second = np.diff(values, n=2, axis=0)
    return np.asarray((1.4826 * np.median(np.abs(second), axis=0)) ** 2 / 6)


def _whittaker(values: Float, driving: float, least: float) -> Float:
    """``values`` [T, D] smoothed; unchanged if their noise is below ``least``.

    Args:
        driving: standard deviation of second differences without noise.
    """
    variance = max(0.0, float(_noise(values).mean()) - driving**2 / 6)
    if variance < least**2:
        return values
    difference: NDArray[np.float64] = np.diff(np.eye(len(values)), n=2, axis=0)
    weight = variance / driving**2
    system = np.eye(len(values)) + weight * difference.T @ difference
    return np.asarray(np.linalg.solve(system, values))


def _with_poses(track: ObjectTrack, positions: Float, yaws: Float) -> ObjectTrack:
    given = track.trajectory
    quaternions = multiply_quaternions(yaw_quaternion(yaws), given.quaternions)
    return replace(track, trajectory=Trajectory(given.times_us, positions, quaternions))


# Held-out score.

MIN_PIXELS = 50
"""Views in which moving objects cover fewer pixels are not scored for objects."""


@dataclass(frozen=True)
class HeldOutScore:
    """Means over held-out views; nan if there are none.

    Attributes:
        psnr: over all pixels [dB].
        ssim: mean structural similarity.
        psnr_objects: over the projected boxes of moving objects [dB].
        views: number of views.
    """

    psnr: float
    ssim: float
    psnr_objects: float
    views: int


@torch.no_grad()
def score_held_out(
    model: SceneModel, log: DrivingLog, options: TrainOptions, *, limit: int | None = None
) -> HeldOutScore:
    """Compare the held-out images of ``log`` with renderings of ``model``.

    Args:
        limit: maximum number of frames, evenly spread; all by default.

    Raises:
        LogError: an image cannot be read.
    """
    held_out = set(held_out_frames(log.frame_count, options.hold_out))
    frames = [frame for frame in log.seen_frames() if frame in held_out]
    if limit is not None:
        frames = spread(frames, limit)
    if not frames:
        return HeldOutScore(float("nan"), float("nan"), float("nan"), 0)
    views = TrainingViews(log, frames, options, device=model.device)
    moving = [k for k, o in model.scene.objects.items() if o.trajectory.moves]
    scores = []
    for index in range(len(views)):
        view = views.view(index)
        image = model.render(view.camera, view.t_us).rgb.clamp(0, 1)
        inside = objects_mask(model.scene, view.camera, view.t_us, only=moving)
        mask = torch.from_numpy(inside).to(image.device)
        scores.append(_score(image, view.image, mask))
    views.close()
    psnr, ssim, psnr_objects = np.array(scores).T
    known = psnr_objects[~np.isnan(psnr_objects)]
    return HeldOutScore(
        psnr=float(psnr.mean()),
        ssim=float(ssim.mean()),
        psnr_objects=float(known.mean()) if len(known) else float("nan"),
        views=len(views),
    )


def _score(image: Tensor, truth: Tensor, mask: Tensor) -> tuple[float, float, float]:
    squared = (image - truth).square().mean(-1)
    on_objects = float("nan")
    if int(mask.sum()) >= MIN_PIXELS:
        on_objects = losses.psnr_of(float(squared[mask].mean()))
    return losses.psnr_of(float(squared.mean())), losses.ssim(image, truth), on_objects


# The run.

INITIAL = "initial.r2s"
PREVIEWS = "previews"


@dataclass(frozen=True, eq=False)
class TrainResult:
    """Result of training.

    Attributes:
        scene: trained, not yet saved.
        first: scene of stage 0, with which training began.
        score: over the held-out frames.
        seconds: duration of the steps in this run.
        steps: number of steps in this run; fewer than in total if it was resumed.
        stage_s: seconds of these by stage.
    """

    scene: Scene
    first: Scene
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

    Neither stage 0 nor training reads images or sweeps of the held-out frames.

    Args:
        options: options of stage 0 and of training.
        folder: folder of the first scene, checkpoints, metrics and preview pictures.
        resume: continue from the checkpoint in ``folder``. On the CPU the result is bit for bit
            the same as without an interruption.
        backend: backend of the renderer.
        on_progress: called with the stage, completed and total steps.
        on_training: called with figures every ``options.log_every`` steps.
        timing_s: filled with the seconds of each stage.

    Raises:
        ReconstructError: the log has nothing to train on, or there is nothing to resume.
        LogError: an image or a sweep cannot be read; :func:`usable_log` leaves such ones out.
    """
    timing_s = {} if timing_s is None else timing_s
    stages = Stages(on_progress, timing_s)
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
    return TrainResult(trained, scene, score, seconds, steps, trainer.running.stages)


def _first_scene(
    log: DrivingLog,
    options: TrainOptions,
    folder: Path,
    *,
    resume: bool,
    on_progress: OnProgress | None,
    timing_s: dict[str, float],
) -> Scene:
    """The scene of stage 0: built and saved now, or loaded from the interrupted run."""
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
    # Users of these surfaces can look up the frames that were held out.
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
    """Writes the image of a held-out frame above the rendering of the model, camera by camera."""
    seen = log.seen_frames()
    held_out = set(held_out_frames(log.frame_count, options.hold_out))
    frames = [frame for frame in seen if frame in held_out] or seen
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
