"""``real2sim evaluate``: how close a scene comes to its log."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..console import CommandError, console, print_figures, staged_progress, write_json
from .command import command
from .options import (
    JsonFile,
    LogFormat,
    RenderBackend,
    RenderDevice,
    SceneBundle,
    Sequence,
    chosen_backend,
)

if TYPE_CHECKING:
    from ..reconstruct.evaluation import Evaluation
    from ..reconstruct.evaluation.lidar import LidarScore


@command("evaluate")
def evaluate(
    *,
    scene: SceneBundle,
    log: Annotated[Path, typer.Argument(help="Folder of the scene's driving log.")],
    frames: Annotated[
        str, typer.Option(help="Frames: held-out, all, or numbers such as 3,7,11.")
    ] = "held-out",
    width: Annotated[int | None, typer.Option(min=16, max=8192, help="Image width [px].")] = None,
    shifts: Annotated[
        str, typer.Option(help="Metres beside the path, for images where truth is, or roads.")
    ] = "1,2,3",
    around: Annotated[
        bool, typer.Option("--around", help="Also view vehicles from all sides (synthetic logs).")
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
    sequence: Sequence = None,
    json: JsonFile = None,
) -> None:
    """Compare a scene with its log: images, moving objects, LiDAR depth, rendering speed."""
    from ..logs.open import open_log
    from ..reconstruct.evaluation import EvaluateOptions, evaluate_scene, write_report
    from ..scene.io import load_scene

    options = EvaluateOptions(
        frames=_parse_frames(frames),
        width=width,
        shifts=_parse_shifts(shifts),
        backend=chosen_backend(backend, device),
        around=around,
        lidar=lidar,
    )
    loaded, opened = load_scene(scene), open_log(log, format=log_format, sequence=sequence)
    with staged_progress() as on_progress:
        result = evaluate_scene(loaded, opened, options=options, on_progress=on_progress)
    print_figures(f"{scene.name} against {opened.name}", _table(result))
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
        figures[f"psnr from {shift.shift_m:g} m beside [dB]"] = shift.psnr
    for band in result.lane_band:
        figures[f"road from {band.shift_m:g} m beside [dB]"] = band.psnr
        figures["recorded images by the same, on the path [dB]"] = band.images_psnr
    if result.around is not None:
        figures |= {
            "vehicles' seen sides [dB]": result.around.psnr_seen,
            "vehicles' other sides [dB]": result.around.psnr_unseen,
            "of these covered": result.around.coverage_unseen,
        }
    if result.uncertainty is not None:
        figures |= {
            "uncertainty against error, Spearman by pixel": result.uncertainty.spearman,
            "of squares of 9 pixels": result.uncertainty.spearman_regions,
            "sparsification (0 best, 1 chance)": result.uncertainty.sparsification,
            "uncertainty, mean": result.uncertainty.uncertainty,
            "error, mean": result.uncertainty.error,
        }
    if result.lidar is not None:
        figures |= _lidar_figures(result.lidar)
    return figures


def _lidar_figures(score: LidarScore) -> dict[str, object]:
    mean = score.mean
    figures: dict[str, object] = {
        "lidar against": score.against,
        "lidar range error, median [m]": mean.median_m,
        "median squared [m2]": mean.median_squared_m2,
        "90th percentile [m]": mean.p90_m,
        "of the expected range, median [m]": mean.expected_m,
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
