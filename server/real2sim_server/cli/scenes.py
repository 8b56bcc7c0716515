"""Commands that make scenes, show them and judge them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .options import JsonFile, LogFormat, Overwrite, Sequence, app, run_command


@app.command()
def reconstruct(
    log: Annotated[Path, typer.Argument(help="Folder of a driving log.")],
    out: Annotated[Path, typer.Option("--out", help="Scene bundle to write.")],
    iterations: Annotated[
        int, typer.Option(min=0, help="0 builds from LiDAR without training.")
    ] = 0,
    preset: Annotated[
        str, typer.Option(help="Of training: cpu-small, standard or paper.")
    ] = "cpu-small",
    width: Annotated[
        int | None, typer.Option(min=32, max=8192, help="Of training images [px].")
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on where training was broken off.")
    ] = False,
    box_noise: Annotated[
        float, typer.Option(min=0, max=1, help="Scatter added to boxes, a share of their size.")
    ] = 0.0,
    log_format: LogFormat = None,
    sequence: Sequence = None,
    overwrite: Overwrite = False,
    json: JsonFile = None,
) -> None:
    """Turn a driving log into a scene of Gaussians."""
    from . import reconstruct as command

    run_command(
        command.run,
        log=log,
        out=out,
        iterations=iterations,
        training=command.Training(preset=preset, resume=resume, width=width, box_noise=box_noise),
        log_format=log_format,
        sequence=sequence,
        overwrite=overwrite,
        json_path=json,
    )


@app.command("import")
def import_(
    file: Annotated[
        Path,
        typer.Argument(
            help="Splats (.ply, .compressed.ply, .spz, .splat) or a checkpoint (.pth) of Street "
            "Gaussians or drivestudio."
        ),
    ],
    out: Annotated[Path, typer.Option("--out", help="Bundle to write.")],
    asset: Annotated[
        bool, typer.Option("--asset", help="An object to insert, not a scene.")
    ] = False,
    category: Annotated[str, typer.Option(help="Class of an asset.")] = "car",
    up_axis: Annotated[
        str, typer.Option(help="Axis that points up in the file: z, y or -y.")
    ] = "z",
    dataset: Annotated[
        Path | None, typer.Option(help="Folder that a checkpoint was trained on.")
    ] = None,
    frames: Annotated[
        tuple[int, int] | None, typer.Option(help="First and last frame of a checkpoint.")
    ] = None,
    overwrite: Overwrite = False,
    json: JsonFile = None,
) -> None:
    """Turn a splat file or a checkpoint of another system into a scene, or splats into an asset."""
    if file.suffix == ".pth":
        from . import import_checkpoint

        run_command(
            import_checkpoint.run,
            file=file,
            out=out,
            dataset=dataset,
            frames=frames,
            overwrite=overwrite,
            json_path=json,
        )
        return
    from . import import_splats

    run_command(
        import_splats.run,
        file=file,
        out=out,
        category=category if asset else None,
        up_axis=up_axis,
        overwrite=overwrite,
        json_path=json,
    )


@app.command()
def export(
    scene: Annotated[Path, typer.Argument(help="Scene bundle.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="File, or folder of one per object.")],
    file_format: Annotated[
        str, typer.Option("--format", help="ply, compressed.ply, spz, splat or gltf")
    ] = "ply",
    t_us: Annotated[
        int | None, typer.Option(help="Bake everything at this time into one file [us].")
    ] = None,
    objects: Annotated[
        list[str] | None, typer.Option("--object", help="Only these objects; repeat it.")
    ] = None,
    overwrite: Overwrite = False,
    json: JsonFile = None,
) -> None:
    """Write a scene for other programs: per object, baked at a time, or animated as glTF."""
    from . import export as command

    run_command(
        command.run,
        scene=scene,
        out=out,
        file_format=file_format,
        t_us=t_us,
        objects=objects,
        overwrite=overwrite,
        json_path=json,
    )


@app.command()
def render(
    scene: Annotated[Path, typer.Argument(help="Scene bundle.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Image to write: .png or .jpg")],
    camera: Annotated[str | None, typer.Option(help="Default: the first one.")] = None,
    frame: Annotated[int | None, typer.Option(min=0, help="Recorded frame; default 0.")] = None,
    t_us: Annotated[int | None, typer.Option(help="Or a time stamp [us].")] = None,
    width: Annotated[int | None, typer.Option(min=16, max=8192, help="[px]")] = None,
    modality: Annotated[str, typer.Option(help="rgb, depth or instance")] = "rgb",
    delete: Annotated[list[str] | None, typer.Option(help="Objects to leave out.")] = None,
    log: Annotated[Path | None, typer.Option(help="Compare with this log's image: PSNR.")] = None,
    backend: Annotated[str, typer.Option(help="auto, cpu, cuda or reference")] = "auto",
    json: JsonFile = None,
) -> None:
    """Draw one logged camera of a scene; with --log print PSNR against the recorded image."""
    from . import render as command

    run_command(
        command.run,
        scene=scene,
        out=out,
        view=command.View(camera=camera, frame=frame, t_us=t_us, width=width, modality=modality),
        delete=delete or [],
        log=log,
        backend=backend,
        json_path=json,
    )


@app.command()
def evaluate(
    scene: Annotated[Path, typer.Argument(help="Scene bundle.")],
    log: Annotated[Path, typer.Argument(help="Folder of the driving log it was made of.")],
    frames: Annotated[
        str, typer.Option(help="held-out, all, or numbers such as 3,7,11")
    ] = "held-out",
    width: Annotated[int | None, typer.Option(min=16, max=8192, help="Of images [px].")] = None,
    shifts: Annotated[
        str, typer.Option(help="Metres beside the path, for synthetic logs; or none.")
    ] = "1,2,3",
    around: Annotated[
        bool, typer.Option("--around", help="Also see vehicles from all sides (synthetic logs).")
    ] = False,
    report: Annotated[Path | None, typer.Option(help="Folder for a page with images.")] = None,
    backend: Annotated[str, typer.Option(help="auto, cpu, cuda or reference")] = "auto",
    log_format: Annotated[str | None, typer.Option("--format", help="Default: recognised.")] = None,
    sequence: Annotated[str | None, typer.Option(help="Where a dataset holds several.")] = None,
    json: JsonFile = None,
) -> None:
    """Compare a scene with its log: images, moving objects, LiDAR depth, speed of rendering."""
    from . import evaluate as command

    run_command(
        command.run,
        scene=scene,
        log=log,
        asked=command.Asked(
            frames=frames, shifts=shifts, width=width, backend=backend, around=around
        ),
        log_format=log_format,
        sequence=sequence,
        report=report,
        json_path=json,
    )
