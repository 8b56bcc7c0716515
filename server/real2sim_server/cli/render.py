"""``real2sim render``: draw one logged camera of a scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .._files import atomic_file
from ..console import CommandError, console, print_figures, write_json
from .command import command
from .options import JsonFile, RenderBackend, RenderDevice, SceneBundle, chosen_backend

if TYPE_CHECKING:
    from ..edit.state import ScenarioState
    from ..render import Frame
    from ..scene import Scene

CODEC_BY_SUFFIX = {".png": "png", ".jpg": "jpeg", ".jpeg": "jpeg"}
MODALITIES = ("rgb", "depth", "instance", "median_depth", "semantic", "uncertainty")


@command("render")
def render(
    *,
    scene: SceneBundle,
    out: Annotated[
        Path,
        typer.Option("--out", "-o", help="Output image (.png, .jpg) or sweep (.ply, .npz, .png)."),
    ],
    camera: Annotated[str | None, typer.Option(help="Camera; default: the first.")] = None,
    frame: Annotated[int | None, typer.Option(min=0, help="Frame number; default: 0.")] = None,
    t_us: Annotated[int | None, typer.Option(help="Time [us] instead of a frame.")] = None,
    width: Annotated[int | None, typer.Option(min=16, max=8192, help="Image width [px].")] = None,
    modality: Annotated[
        str, typer.Option(help="Kind: rgb, depth, instance, median_depth, semantic or uncertainty.")
    ] = "rgb",
    lidar: Annotated[
        str | None, typer.Option(help="Simulate a LiDAR sweep instead: model name or JSON file.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the sweep's noise.")] = 0,
    delete: Annotated[list[str] | None, typer.Option(help="Object to remove; repeatable.")] = None,
    log: Annotated[Path | None, typer.Option(help="Print PSNR against this log's image.")] = None,
    backend: RenderBackend = "auto",
    device: RenderDevice = None,
    json: JsonFile = None,
) -> None:
    """Draw one logged camera of a scene; with --log print PSNR against the recorded image.

    With --lidar cast a sweep of a LiDAR on the recording vehicle instead, and draw it beside.
    """
    from ..edit.compose import instances_at
    from ..render import render_cameras, warm_up
    from ..scene.io import load_scene

    if log is not None and (t_us is not None or delete):
        raise CommandError("--log compares whole recorded frames: use --frame, and no --delete")
    if lidar is not None:
        if log is not None:
            raise CommandError("--lidar is compared by `real2sim evaluate --lidar`, not by --log")
        _render_sweep(scene, out, lidar, _Moment(frame, t_us), delete or (), seed, json)
        return
    _check_output(out, modality)
    backend = chosen_backend(backend, device)
    warm_up(backend)  # Not part of the time that is printed for the picture.
    loaded = load_scene(scene)
    time_us = _frame_time(loaded, frame or 0) if t_us is None else t_us
    chosen = loaded.rig[camera] if camera else loaded.rig.cameras[0]
    [picture] = render_cameras(
        instances_at(loaded, _without(loaded, delete or ()), time_us),
        [chosen if width is None else chosen.resized(width)],
        loaded.ego.transform(time_us),
        sky=loaded.sky,
        modalities=[modality],
        backend=backend,
    )
    _write_image(picture, modality, out)
    figures: dict[str, object] = {
        "image": str(out),
        "camera": picture.camera,
        "t_us": time_us,
        "gaussians": loaded.gaussian_count,
    }
    figures |= {f"{stage}_ms": ms for stage, ms in picture.timing_ms.items()}
    if log is not None:
        figures |= _compare(loaded, log, frame or 0, picture.camera, backend=backend)
    print_figures(f"{scene.name}, camera {picture.camera}", figures)
    write_json(json, figures)


@dataclass(frozen=True)
class _Moment:
    """What the options say of the time."""

    frame: int | None
    t_us: int | None


def _render_sweep(
    scene: Path,
    out: Path,
    lidar: str,
    moment: _Moment,
    delete: Sequence[str],
    seed: int,
    json: Path | None,
) -> None:
    from ..edit.compose import sweep_of
    from ..render.cast import detect, sensor_poses
    from ..render.cast.call import select_caster
    from ..render.cast.files import SUFFIXES, write_sweep
    from ..scene.io import load_scene
    from ..scene.range_sensors import find_lidar

    if out.suffix.lower() not in SUFFIXES:
        raise CommandError(f"--out {out}: the name must end in {', '.join(SUFFIXES)}")
    sensor, loaded = find_lidar(lidar), load_scene(scene)
    time_us = _frame_time(loaded, moment.frame or 0) if moment.t_us is None else moment.t_us
    loaded.ego.pose(time_us)
    met = sweep_of(loaded, _without(loaded, delete), sensor, time_us)
    request = met.request(sensor, sensor_poses(loaded.ego, sensor, time_us))
    echo = select_caster().cast(request)
    sweep = detect(echo, sensor, seed=seed, request=request)
    picture = out.with_suffix(".png")
    for path in dict.fromkeys((out, picture)):
        write_sweep(sweep, sensor, path)
    figures: dict[str, object] = {
        "sweep": str(out),
        "picture": str(picture),
        "lidar": sensor.name,
        "t_us": time_us,
        "rays": sensor.beams.count,
        "returns": int(sweep.hit.sum()),
        "surfaces for LiDARs": loaded.lidar is not None,
    }
    figures |= {f"{stage}_ms": ms for stage, ms in echo.timing_ms.items()}
    print_figures(f"{scene.name}, LiDAR {sensor.name}", figures)
    write_json(json, figures)


def _check_output(out: Path, modality: str) -> None:
    suffix = out.suffix.lower()
    if suffix not in CODEC_BY_SUFFIX:
        raise CommandError(f"--out {out}: the name must end in {', '.join(CODEC_BY_SUFFIX)}")
    if modality not in MODALITIES:
        raise CommandError(f"--modality {modality!r}; allowed are {', '.join(MODALITIES)}")
    if modality != "rgb" and CODEC_BY_SUFFIX[suffix] != "png":
        raise CommandError(f"{modality} images are written as .png, not {out.suffix}")


def _frame_time(scene: Scene, frame: int) -> int:
    if frame >= len(scene.frame_times_us):
        raise CommandError(
            f"--frame {frame}; scene {scene.name!r} has frames 0 to {len(scene.frame_times_us) - 1}"
        )
    return int(scene.frame_times_us[frame])


def _without(scene: Scene, deleted: Sequence[str]) -> ScenarioState:
    from real2sim_proto.operations import Delete

    from ..edit.apply import apply_operations
    from ..edit.state import ScenarioState

    state = ScenarioState.of(scene)
    if not deleted:
        return state
    return apply_operations(state, [Delete(object_id=name) for name in deleted]).state


def _write_image(frame: Frame, modality: str, out: Path) -> None:
    from ..render import encode_image

    image = frame.images[modality]
    with atomic_file(out) as file:
        file.write(encode_image(image, modality, CODEC_BY_SUFFIX[out.suffix.lower()]).data)


def _compare(
    scene: Scene, log_path: Path, frame: int, camera: str, *, backend: str
) -> dict[str, float]:
    from ..logs import open_log, same_part
    from ..reconstruct.evaluation import evaluate_views

    log = same_part(open_log(log_path), scene.provenance)
    console.print(
        f"comparing with {log.name}, frame {frame}, over all pixels and over those that LiDAR "
        "covers"
    )
    report = evaluate_views(scene, log, frames=[frame], cameras=[camera], backend=backend)
    return {"psnr_db": report.psnr, "psnr_lidar_db": report.psnr_lidar}
