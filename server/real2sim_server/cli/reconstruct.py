"""Commands from a log to a scene: reconstruct, evaluate, fit-lidar and fit-uncertainty."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer
from rich.markup import escape
from rich.table import Table

from ..console import (
    CommandError,
    console,
    print_figures,
    refuse_existing,
    staged_progress,
    write_json,
)
from .common import (
    DrivingLogPath,
    JsonFile,
    LogCameras,
    LogEvery,
    LogFormat,
    LogFrames,
    Overwrite,
    RenderBackend,
    RenderDevice,
    SceneBundle,
    SequenceName,
    Strict,
    changed_bundle,
    chosen_backend,
    command,
    log_selection,
    opened_log,
    print_left_out,
)

if TYPE_CHECKING:
    from ..logs import DrivingLog
    from ..maps import LaneSource
    from ..reconstruct import InitialiseOptions
    from ..reconstruct.evaluation import Evaluation
    from ..reconstruct.evaluation.edits import EditScore
    from ..reconstruct.evaluation.lidar import LidarScore
    from ..reconstruct.training.records import TrainingProgress
    from ..scene import Scene


# --- reconstruct ----------------------------------------------------------------------------------


@command("reconstruct")
def reconstruct(
    *,
    log: DrivingLogPath,
    out: Annotated[Path, typer.Option("--out", help="Scene bundle to write.")],
    iterations: Annotated[
        int, typer.Option(min=0, help="Training steps; 0 builds from LiDAR without training.")
    ] = 0,
    preset: Annotated[
        str, typer.Option(help="Training preset: cpu-small, standard or paper.")
    ] = "cpu-small",
    width: Annotated[
        int | None, typer.Option(min=32, max=8192, help="Width of training images [px].")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Resume interrupted training.")] = False,
    box_noise: Annotated[
        float, typer.Option(min=0, max=1, help="Noise added to boxes, as a share of their size.")
    ] = 0.0,
    lidar_steps: Annotated[
        int, typer.Option(min=0, help="Steps of fitting LiDAR surfaces; 0 fits none.")
    ] = 60,
    lanes: Annotated[
        str,
        typer.Option(
            help="Source of lanes: map (of the log), log (from the drive if there is no map) "
            "or none."
        ),
    ] = "map",
    backend: RenderBackend = "auto",
    device: RenderDevice = None,
    frames: LogFrames = ":",
    cameras: LogCameras = None,
    every: LogEvery = 1,
    log_format: LogFormat = None,
    sequence: SequenceName = None,
    strict: Strict = False,
    overwrite: Overwrite = False,
    json: JsonFile = None,
) -> None:
    """Reconstruct a Gaussian scene from a driving log."""
    from ..logs import inspect_log, open_log, select_from_log
    from ..reconstruct import InitialiseOptions, ReconstructOptions, reconstruct
    from ..reconstruct.training.schedule import at_width
    from ..reconstruct.training.schedule import preset as training_preset

    refuse_existing(out, overwrite=overwrite)
    selection = log_selection(frames, cameras, every)
    drawn_by = chosen_backend(backend, device)
    training = training_preset(preset)
    training = replace(training, initialise=_with_lanes(training.initialise, lanes))
    if iterations:
        training = replace(training, iterations=iterations)
    opened = open_log(log, format=log_format, sequence=sequence)
    if not selection.is_whole:
        opened = select_from_log(opened, selection)
    if width is not None:
        logged = max((camera.width for camera in opened.rig), default=width)
        training = at_width(training, min(width, logged))
    print_left_out(opened)
    for question in inspect_log(opened).questions:
        console.print(f"question  {question}", highlight=False, markup=False, soft_wrap=True)
    with staged_progress() as report:
        result = reconstruct(
            opened,
            out,
            ReconstructOptions(
                initialise=None if iterations else _with_lanes(InitialiseOptions(), lanes),
                training=training if iterations else None,
                box_noise=box_noise,
                lidar_steps=lidar_steps,
                backend=drawn_by,
                strict=strict,
            ),
            resume=resume,
            overwrite=overwrite,
            on_progress=report,
            on_training=_training_bar(report),
        )
    figures = asdict(result)
    print_figures(f"scene {out}", {k: v for k, v in figures.items() if v is not None})
    console.print(f"next: real2sim render {out} --log {log} -o {out.name}.png")
    write_json(json, figures)


def _with_lanes(options: InitialiseOptions, lanes: str) -> InitialiseOptions:
    from ..maps import LANE_SOURCES

    if lanes not in LANE_SOURCES:
        raise CommandError(f"--lanes {lanes!r}; give one of {', '.join(LANE_SOURCES)}")
    return replace(options, lanes=cast("LaneSource", lanes))


def _training_bar(report: Callable[..., None]) -> Callable[[TrainingProgress], None]:
    """Shows training figures in the progress bar of that stage."""

    def on_training(step: TrainingProgress) -> None:
        text = (
            f"training {step.rate:.1f}/s, loss {step.loss:.4f}, {step.psnr:.2f} dB, "
            f"{step.gaussians:,} Gaussians"
        )
        report("training", step.iteration, step.iterations, text)

    return on_training


# --- evaluate -------------------------------------------------------------------------------------


@command("evaluate")
def evaluate(
    *,
    scene: SceneBundle,
    log: DrivingLogPath,
    frames: Annotated[
        str, typer.Option(help="Frames: held-out, all, or numbers such as 3,7,11.")
    ] = "held-out",
    width: Annotated[int | None, typer.Option(min=16, max=8192, help="Image width [px].")] = None,
    shifts: Annotated[
        str,
        typer.Option(
            help="Lateral offsets [m] of views to score against ground truth or the road."
        ),
    ] = "1,2,3",
    around: Annotated[
        bool, typer.Option("--around", help="Also view vehicles from all sides (synthetic logs).")
    ] = False,
    edits: Annotated[
        bool, typer.Option("--edits", help="Also score edited vehicles (synthetic logs).")
    ] = False,
    lidar: Annotated[
        bool, typer.Option("--lidar", help="Also simulate LiDAR sweeps and compare them.")
    ] = False,
    report: Annotated[
        Path | None, typer.Option(help="Folder for an HTML report with images.")
    ] = None,
    backend: RenderBackend = "auto",
    device: RenderDevice = None,
    log_format: LogFormat = None,
    sequence: SequenceName = None,
    json: JsonFile = None,
) -> None:
    """Compare a scene with its log: images, moving objects, LiDAR depth, rendering speed."""
    from ..reconstruct.evaluation import EvaluateOptions, evaluate_scene, write_report
    from ..scene.io import open_scene

    options = EvaluateOptions(
        frames=_parse_frames(frames),
        width=width,
        shifts=_parse_shifts(shifts),
        backend=chosen_backend(backend, device),
        around=around,
        edits=edits,
        lidar=lidar,
    )
    loaded = open_scene(scene)
    opened = opened_log(log, log_format, sequence, provenance=loaded.provenance)
    with staged_progress() as on_progress:
        result = evaluate_scene(loaded, opened, options=options, on_progress=on_progress)
    print_figures(f"{scene.name} against {opened.name}", _table(result))
    if result.edits is not None:
        _print_edits(result.edits)
    if not result.frames_unseen:
        console.print(
            "the scene names no held-out frames, so these may have been used to make it",
            soft_wrap=True,
        )
    if result.no_shifted:
        console.print(result.no_shifted, soft_wrap=True)
    write_json(json, result.as_json())
    if report is not None:
        page = write_report(loaded, opened, result, report, options=options)
        console.print(f"report: {page}", soft_wrap=True)


def _parse_frames(text: str) -> str | tuple[int, ...]:
    if text in ("held-out", "all"):
        return text
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise CommandError(
            f"--frames {text!r}; allowed are Frames: held-out, all, or numbers such as 3,7,11."
        ) from None


def _parse_shifts(text: str) -> tuple[float, ...]:
    if text == "none":
        return ()
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise CommandError(
            f"--shifts {text!r}; allowed are none, or distances in metres such as 1,2,3"
        ) from None


def _table(result: Evaluation) -> dict[str, object]:
    figures: dict[str, object] = {
        "frames": ", ".join(map(str, result.frames)),
        "psnr [dB]": result.psnr,
        "ssim": result.ssim,
        "psnr_objects [dB]": result.psnr_objects,
        "depth_error_m [m]": result.depth_error_m,
        "depth_error_p90_m [m]": result.depth_error_p90_m,
        "depth_error_mean_m [m]": result.depth_error_mean_m,
        "box_error_m [m]": result.box_error_m,
        "frames_per_second": result.frames_per_second,
    }
    for shift in result.shifted:
        figures[f"psnr at {shift.shift_m:g} m offset [dB]"] = shift.psnr
    for band in result.lane_band:
        figures[f"road at {band.shift_m:g} m offset [dB]"] = band.psnr
        figures["same measure, recorded images on the path [dB]"] = band.images_psnr
    if result.around is not None:
        figures |= {
            "vehicles' seen sides [dB]": result.around.psnr_seen,
            "vehicles' other sides [dB]": result.around.psnr_unseen,
            "share of other sides covered": result.around.coverage_unseen,
        }
    if result.uncertainty is not None:
        figures |= {
            "uncertainty against error, Spearman by pixel": result.uncertainty.spearman,
            "the same by 9x9 squares": result.uncertainty.spearman_regions,
            "sparsification (0 best, 1 chance)": result.uncertainty.sparsification,
            "uncertainty, mean": result.uncertainty.uncertainty,
            "error, mean": result.uncertainty.error,
        }
    if result.lidar is not None:
        figures |= _lidar_figures(result.lidar)
    return figures


def _print_edits(scores: Sequence[EditScore]) -> None:
    if not scores:
        console.print("no compared frame shows a vehicle of the scene that could be edited")
        return
    title = escape("edited vehicles: PSNR [dB] where edits change the street")
    table = Table(title=title, title_justify="left")
    table.add_column("vehicle", overflow="fold")
    table.add_column("edit", overflow="fold")
    for name in ("PSNR", "SSIM", "ground", "shadows", "unseen"):
        table.add_column(name, justify="right")
    for score in scores:
        ratios = (score.psnr_hidden_ground, score.psnr_shadows, score.psnr_unseen)
        table.add_row(
            escape(f"{score.object_id} ({score.vehicle})"),
            score.edit,
            f"{score.psnr:.2f}",
            f"{score.ssim:.3f}",
            *("–" if math.isnan(ratio) else f"{ratio:.2f}" for ratio in ratios),
        )
    console.print(table)


def _lidar_figures(score: LidarScore) -> dict[str, object]:
    mean = score.mean
    figures: dict[str, object] = {
        "lidar against": score.against,
        "lidar range error, median [m]": mean.median_m,
        "median squared error [m2]": mean.median_squared_m2,
        "90th percentile [m]": mean.p90_m,
        "expected range, median error [m]": mean.expected_m,
        "chamfer [m2]": mean.chamfer_m2,
        "chamfer is the": score.chamfer,
        "F score at 5 cm": mean.f_score,
        "hit or miss right": mean.hit_miss,
        "intensity RMSE": mean.intensity_rmse,
        "drop accuracy": mean.drop_accuracy,
    }
    if score.against != "ray-cast truth":
        figures["residual of the fitted rings [degrees]"] = score.ring_residual_deg
    return figures


# --- fit-lidar, fit-uncertainty -------------------------------------------------------------------

Fitted = tuple["Scene", dict[str, Any]]
"""The fitted scene, and the fit's figures."""


@dataclass(frozen=True)
class FitFiles:
    """Input and output files of a fit.

    Attributes:
        scene: bundle.
        log: the scene's driving log.
        out: bundle to write; None overwrites the scene.
        log_format, sequence: format and sequence of the log, if they cannot be detected.
        json: file for the figures.
    """

    scene: Path
    log: Path
    out: Path | None
    log_format: str | None
    sequence: str | None
    json: Path | None


def fit_scene(
    files: FitFiles, what: str, fit: Callable[[Scene, DrivingLog, Callable[..., None]], Fitted]
) -> None:
    """Fit ``what`` of a scene, write the bundle and print the figures."""
    from ..scene.io import open_scene, save_scene

    target = changed_bundle(files.scene, files.out)
    scene = open_scene(files.scene)
    log = opened_log(files.log, files.log_format, files.sequence, provenance=scene.provenance)
    with staged_progress() as on_progress:
        made, fitted = fit(scene, log, on_progress)
    save_scene(made, target, overwrite=files.out is None)
    figures = {"scene": str(target), **fitted}
    print_figures(f"{target.name}, {what}", figures)
    write_json(files.json, figures)


# --- fit-lidar ------------------------------------------------------------------------------------


@command("fit-lidar")
def fit_lidar(
    *,
    scene: SceneBundle,
    log: DrivingLogPath,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Output bundle; default: the scene itself.")
    ] = None,
    surfaces: Annotated[
        Path | None,
        typer.Option(help="initial.r2s of the training folder, to save time."),
    ] = None,
    steps: Annotated[
        int, typer.Option(min=0, help="Training steps, about one core second each.")
    ] = 60,
    log_format: LogFormat = None,
    sequence: SequenceName = None,
    json: JsonFile = None,
) -> None:
    """Fit LiDAR surfaces and reflectivity of a scene to the recorded sweeps."""
    from dataclasses import asdict

    from ..reconstruct.lidar import fit_lidar_surfaces
    from ..scene.io import open_scene

    def fit(loaded: Scene, opened: DrivingLog, on_progress: Callable[..., None]) -> Fitted:
        made, report = fit_lidar_surfaces(
            loaded,
            opened,
            surfaces=open_scene(surfaces) if surfaces else None,
            steps=steps,
            on_progress=on_progress,
        )
        figures = asdict(report)
        del figures["timing_s"]
        return made, figures

    fit_scene(FitFiles(scene, log, out, log_format, sequence, json), "surfaces for LiDARs", fit)


# --- fit-uncertainty ------------------------------------------------------------------------------


@command("fit-uncertainty")
def fit_uncertainty(
    *,
    scene: SceneBundle,
    log: DrivingLogPath,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Output bundle; default: the scene itself.")
    ] = None,
    views: Annotated[
        int, typer.Option(min=1, max=10_000, help="Number of images to compare.")
    ] = 48,
    backend: RenderBackend = "auto",
    device: RenderDevice = None,
    log_format: LogFormat = None,
    sequence: SequenceName = None,
    json: JsonFile = None,
) -> None:
    """Add uncertainty to a scene, as training does for new scenes."""
    from dataclasses import asdict

    from ..reconstruct.evaluation.uncertainty import fit_uncertainties

    def fit(loaded: Scene, opened: DrivingLog, on_progress: Callable[..., None]) -> Fitted:
        made, report = fit_uncertainties(
            loaded,
            opened,
            views=views,
            backend=chosen_backend(backend, device),
            on_view=lambda done, total: on_progress("views", done, total),
        )
        return made, asdict(report)

    fit_scene(FitFiles(scene, log, out, log_format, sequence, json), "uncertainty", fit)
