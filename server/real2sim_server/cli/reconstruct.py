"""``real2sim reconstruct``: from a driving log to a scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from ..console import (
    CommandError,
    console,
    print_figures,
    refuse_existing,
    staged_progress,
    write_json,
)
from .command import command
from .options import (
    JsonFile,
    LogCameras,
    LogEvery,
    LogFolder,
    LogFormat,
    LogFrames,
    Overwrite,
    RenderBackend,
    RenderDevice,
    Sequence,
    chosen_backend,
    log_selection,
)

if TYPE_CHECKING:
    from ..maps import LaneSource
    from ..reconstruct import InitialiseOptions
    from ..reconstruct.training.records import TrainingProgress


@command("reconstruct")
def reconstruct(
    *,
    log: LogFolder,
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
    sequence: Sequence = None,
    overwrite: Overwrite = False,
    json: JsonFile = None,
) -> None:
    """Turn a driving log into a scene of Gaussians."""
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
                backend=drawn_by,
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
    """Shows the figures of training in the progress bar of that stage."""

    def on_training(step: TrainingProgress) -> None:
        text = (
            f"training {step.rate:.1f}/s, loss {step.loss:.4f}, {step.psnr:.2f} dB, "
            f"{step.gaussians:,} Gaussians"
        )
        report("training", step.iteration, step.iterations, text)

    return on_training
