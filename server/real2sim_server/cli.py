"""The worker's part of the ``real2sim`` command.

This module is imported by every ``real2sim --help``, so it loads nothing heavy: each command
checks that its extra is installed and only then imports its room.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

app = typer.Typer(no_args_is_help=True)
bench = typer.Typer(no_args_is_help=True, help="Measure this machine; ratios to a reference.")
app.add_typer(bench, name="bench")

JsonFile = Annotated[
    Path | None, typer.Option("--json", help="Also write the figures to this file.", dir_okay=False)
]
LogFormat = Annotated[str | None, typer.Option("--format", help="Default: recognised.")]
Sequence = Annotated[str | None, typer.Option(help="Where a dataset holds several.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace what is there.")]


@app.command()
def synth(
    out: Annotated[Path, typer.Option("--out", help="Folder of the log to write.")],
    frames: Annotated[int, typer.Option(min=2, max=10_000)] = 60,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    width: Annotated[int, typer.Option(min=32, max=4096, help="Image width [px].")] = 480,
    height: Annotated[int, typer.Option(min=32, max=4096, help="Image height [px].")] = 320,
    moving_cars: Annotated[int, typer.Option(min=0, max=40)] = 4,
    parked_cars: Annotated[int, typer.Option(min=0, max=80)] = 14,
    json: JsonFile = None,
) -> None:
    """Generate a driving log of a procedural street: cameras, LiDAR, exact poses and boxes."""
    from .commands import synth as command

    _run(
        command.run,
        out=out,
        sizes={"frames": frames, "seed": seed, "width": width, "height": height},
        cars={"moving_cars": moving_cars, "parked_cars": parked_cars},
        json_path=json,
    )


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
    from .commands import reconstruct as command

    _run(
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


@app.command("log-info")
def log_info(
    log: Annotated[Path, typer.Argument(help="Folder of a driving log.")],
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for pictures with boxes and LiDAR.")
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Look at every file, as training does first.")
    ] = False,
    log_format: LogFormat = None,
    sequence: Sequence = None,
    json: JsonFile = None,
) -> None:
    """Say what a log holds, and draw its boxes and LiDAR on its images."""
    from .commands import log_info as command

    _run(
        command.run,
        log=log,
        out=out,
        log_format=log_format,
        sequence=sequence,
        check=check,
        json_path=json,
    )


@app.command()
def track(
    log: Annotated[Path, typer.Argument(help="Folder of a driving log with LiDAR.")],
    out: Annotated[Path, typer.Option("--out", help="Folder of the log to write, with boxes.")],
    keep: Annotated[
        bool, typer.Option("--keep", help="Keep the log's own boxes and add what they lack.")
    ] = False,
    reach: Annotated[
        float, typer.Option(min=5, max=200, help="How far from the vehicle to look [m].")
    ] = 55.0,
    least_distance: Annotated[
        float, typer.Option(min=0.1, help="How far an object must go [m].")
    ] = 1.5,
    least_frames: Annotated[int, typer.Option(min=2, help="In how many frames it is seen.")] = 6,
    images: Annotated[str, typer.Option(help="png (exact) or jpg (smaller).")] = "jpg",
    log_format: LogFormat = None,
    sequence: Sequence = None,
    json: JsonFile = None,
) -> None:
    """Find what moves in the LiDAR of a log without boxes, and write the log with them."""
    from .commands import track as command

    _run(
        command.run,
        log=log,
        out=out,
        options={"reach": reach, "least_distance": least_distance, "least_frames": least_frames},
        keep=keep,
        image_format=images,
        log_format=log_format,
        sequence=sequence,
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
        from .commands import import_checkpoint

        _run(
            import_checkpoint.run,
            file=file,
            out=out,
            dataset=dataset,
            frames=frames,
            overwrite=overwrite,
            json_path=json,
        )
        return
    from .commands import import_splats

    _run(
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
    from .commands import export as command

    _run(
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
    from .commands import render as command

    _run(
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
    from .commands import evaluate as command

    _run(
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


@app.command("evaluate-policy")
def evaluate_policy(
    out: Annotated[Path, typer.Option("--out", help="Folder for report and recordings.")],
    policies: Annotated[
        list[str],
        typer.Option(
            "--policy", help="follow_route, pid, idm, depth_sampling, learned=FILE, module:Class."
        ),
    ],
    scenes: Annotated[
        list[str] | None, typer.Option("--scene", help="To drive as recorded; repeat it.")
    ] = None,
    scenarios: Annotated[
        list[str] | None, typer.Option("--scenario", help="Id, to drive as it is; repeat it.")
    ] = None,
    suite: Annotated[
        Path | None,
        typer.Option(help="JSON file of cases instead. With none: the demo's street, three ways."),
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, max=1000, help="How many, from 0 on.")] = 3,
    url: Annotated[
        str | None, typer.Option(help="Of a running worker; default: one is started.")
    ] = None,
    token: Annotated[str | None, typer.Option(envvar="REAL2SIM_TOKEN", show_default=False)] = None,
    scenes_dir: Annotated[
        Path | None, typer.Option("--scenes", help="Bundles for the worker that is started.")
    ] = None,
    sessions: Annotated[int, typer.Option(min=1, max=64, help="Episodes at a time.")] = 2,
) -> None:
    """Drive cases with planners; leave scores, recordings and a page that compares them."""
    from .policies import evaluate as command

    _run(
        command.run,
        out=out,
        options=command.Options(
            policies=tuple(policies),
            scenes=tuple(scenes or ()),
            scenarios=tuple(scenarios or ()),
            suite=suite,
            seeds=seeds,
            url=url,
            token=token,
            scenes_dir=scenes_dir,
            sessions=sessions,
        ),
    )


@app.command("train-policy")
def train_policy(
    source: Annotated[Path, typer.Argument(help="Scene bundle, or folder of a driving log.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="File of weights (.safetensors).")],
    camera: Annotated[
        str | None, typer.Option(help="Default: the one that looks most nearly ahead.")
    ] = None,
    epochs: Annotated[int, typer.Option(min=1, max=100_000)] = 60,
    shifted: Annotated[
        int, typer.Option(min=0, max=100, help="Views beside the path per frame, of a scene.")
    ] = 5,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    log_format: LogFormat = None,
    sequence: Sequence = None,
    json: JsonFile = None,
) -> None:
    """Teach a small network to drive as the recording vehicle did; for planner learned=FILE."""
    from .policies import train as command

    _run(
        command.run,
        source=source,
        out=out,
        asked=command.Asked(camera=camera, epochs=epochs, shifted=shifted, seed=seed),
        log_format=log_format,
        sequence=sequence,
        json_path=json,
    )


@app.command()
def validate(
    backend: Annotated[str, typer.Option(help="cpu or reference")] = "cpu",
    cases: Annotated[
        str | None, typer.Option(help="Names with commas between them; all by default.")
    ] = None,
    page: Annotated[
        Path | None, typer.Option(help="HTML page to write; default: beside the figures.")
    ] = None,
    json: JsonFile = None,
) -> None:
    """Hold the physics to cases with known answers; exit code 1 when a line fails."""
    from .commands import validate as command

    _run(command.run, backend=backend, cases=cases, page=page, json_path=json)


@app.command()
def simulate(
    scene: Annotated[Path, typer.Argument(help="Scene bundle.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for film, curves, result.")],
    experiment: Annotated[
        str | None, typer.Option(help="Of the paper: wall, pair or drop.")
    ] = None,
    preset: Annotated[
        str | None, typer.Option(help="paper (soft) or vehicle (kilograms, crush, tyres).")
    ] = None,
    speed: Annotated[
        float | None, typer.Option(min=0.01, max=100, help="Of an experiment [m/s].")
    ] = None,
    objects: Annotated[
        list[str] | None, typer.Option("--object", help="What takes part; repeat it.")
    ] = None,
    duration: Annotated[float | None, typer.Option(min=0.01, max=600, help="[s]")] = None,
    frame: Annotated[int, typer.Option(min=0, help="Recorded frame to start at.")] = 0,
    backend: Annotated[str, typer.Option(help="Of the solver.")] = "auto",
    max_particles: Annotated[
        int | None, typer.Option(min=100, help="Of all bodies; fewer are coarser and faster.")
    ] = None,
    film: Annotated[bool, typer.Option(help="Draw film and stills.")] = True,
    json: JsonFile = None,
) -> None:
    """Let objects of a scene collide, deform and come to rest; leave film and curves."""
    from .commands import simulate as command

    _run(
        command.run,
        scene=scene,
        out=out,
        asked=command.Asked(
            experiment=experiment,
            preset=preset,
            speed=speed,
            objects=tuple(objects or ()),
            duration=duration,
            frame=frame,
            backend=backend,
            film=film,
            max_particles=max_particles,
        ),
        json_path=json,
    )


@app.command()
def ground(
    scene: Annotated[Path, typer.Argument(help="Scene bundle.")],
    log: Annotated[Path | None, typer.Option(help="Its driving log, for LiDAR.")] = None,
    frame: Annotated[int, typer.Option(min=0, help="Whose boxes are projected down.")] = 0,
    picture: Annotated[Path | None, typer.Option(help="PNG with inliers in red.")] = None,
    json: JsonFile = None,
) -> None:
    """Find the road surface under a scene's objects, from LiDAR and from Gaussians."""
    from .commands import ground as command

    _run(command.run, scene=scene, log=log, frame=frame, picture=picture, json_path=json)


@app.command()
def replay(
    episode: Annotated[Path, typer.Argument(help="Recording of an episode (.r2e).")],
    scene: Annotated[
        Path | None, typer.Option("--scene", help="Its scene bundle: live through it again.")
    ] = None,
    assets: Annotated[
        Path | None, typer.Option("--assets", help="Asset library, for scenarios that use it.")
    ] = None,
    mcap: Annotated[
        Path | None, typer.Option("--mcap", help="Also write it for Foxglove and others.")
    ] = None,
    video: Annotated[Path | None, typer.Option("--video", help="MP4 to draw.")] = None,
    camera: Annotated[str | None, typer.Option(help="Of the video; default: the first.")] = None,
    width: Annotated[int, typer.Option(min=64, max=4096, help="Of the video [px].")] = 640,
    json: JsonFile = None,
) -> None:
    """Score a recorded episode; with its scene, check that it comes out the same, and film it."""
    from .commands import replay as command

    _run(
        command.run,
        episode=episode,
        scene=scene,
        assets=assets,
        mcap=mcap,
        video=video,
        camera=camera,
        width=width,
        json_path=json,
    )


@app.command()
def serve(
    host: Annotated[
        str | None, typer.Option(help="Default 127.0.0.1; others need a token.")
    ] = None,
    port: Annotated[int | None, typer.Option(min=0, max=65535, help="0 picks a free one.")] = None,
    scenes: Annotated[Path | None, typer.Option(help="Folder of scene bundles.")] = None,
    data: Annotated[Path | None, typer.Option(help="Folder for scenarios and sessions.")] = None,
    token: Annotated[str | None, typer.Option(envvar="REAL2SIM_TOKEN", show_default=False)] = None,
    backend: Annotated[str | None, typer.Option(help="auto, cpu, cuda or reference")] = None,
) -> None:
    """Start a worker. Settings not given here come from REAL2SIM_* variables."""
    from .commands import serve as command

    _run(
        command.run,
        overrides={
            "host": host,
            "port": port,
            "scenes_dir": scenes,
            "data_dir": data,
            "token": token,
            "backend": backend,
        },
    )


@app.command()
def demo(
    out: Annotated[Path, typer.Option("--out", help="Where results go.")] = Path("out/demo"),
    steps: Annotated[int, typer.Option(min=1, max=10_000)] = 100,
    from_log: Annotated[
        bool, typer.Option("--from-log", help="Record and reconstruct the street first.")
    ] = False,
    serve: Annotated[bool, typer.Option("--serve", help="Leave the worker up afterwards.")] = False,
) -> None:
    """Serve a street, edit it over REST, drive it over WebSocket, leave video and figures."""
    from .demo import run as command

    _run(command.run, out=out, steps=steps, from_log=from_log, leave_serving=serve)


@app.command()
def doctor(
    warm: Annotated[
        bool, typer.Option("--warm", help="Compile all kernels into the cache.")
    ] = False,
    json: JsonFile = None,
) -> None:
    """Say what this machine can do, what is missing, and how to mend it."""
    from .commands import doctor as command

    command.run(warm=warm, json_path=json)


@bench.command("render")
def bench_render(
    splat: Annotated[Path | None, typer.Option(help="Splat file for the first case.")] = None,
    json: JsonFile = None,
) -> None:
    """Milliseconds by stage and Gaussians per second, as ratio to the plain reference."""
    from .commands import bench_render as command

    _run(command.run, splat=splat, json_path=json)


@bench.command("reconstruct")
def bench_reconstruct(json: JsonFile = None) -> None:
    """Training iterations per second by stage, at 76,000 Gaussians and 621x188."""
    from .commands import bench_reconstruct as command

    _run(command.run, json_path=json)


@bench.command("physics")
def bench_physics(
    peers: Annotated[
        bool, typer.Option("--peers", help="Also measure Taichi and Warp, where installed.")
    ] = False,
    json: JsonFile = None,
) -> None:
    """Particle-substeps per second, and what they depend on."""
    from .commands import bench_physics as command

    _run(command.run, peers=peers, json_path=json)


@bench.command("serve")
def bench_serve(json: JsonFile = None) -> None:
    """Latency of a drive step, share of rendering, lag of the event loop, memory per session."""
    from .commands import bench_serve as command

    _run(command.run, json_path=json)


@bench.command("soak")
def bench_soak(
    sessions: Annotated[int, typer.Option(min=1, max=32)] = 16,
    minutes: Annotated[float, typer.Option(min=0.1, max=1440)] = 10.0,
    rate: Annotated[float, typer.Option(min=0.1, max=1000, help="Steps/s of a session.")] = 10.0,
    json: JsonFile = None,
) -> None:
    """Many sessions side by side, misbehaving planners among them; every answer, and memory."""
    from .commands import bench_soak as command

    _run(command.run, sessions=sessions, minutes=minutes, rate=rate, json_path=json)


@bench.command("edit")
def bench_edit(
    operations: Annotated[int, typer.Option(min=1, max=100_000)] = 1000, json: JsonFile = None
) -> None:
    """Time of an edit, and of opening a scenario that has had many."""
    from .commands import bench_edit as command

    _run(command.run, operations=operations, json_path=json)


def _run(command: Any, **arguments: Any) -> None:
    from .commands.console import run_command

    run_command(command, **arguments)
