"""Scene commands: render, film, ground and map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .._files import atomic_file
from ..console import CommandError, console, print_figures, staged_progress, write_json
from .common import (
    JsonFile,
    LogFormat,
    RenderBackend,
    RenderDevice,
    SceneBundle,
    SequenceName,
    changed_bundle,
    chosen_backend,
    command,
    opened_log,
)

if TYPE_CHECKING:
    from ..edit.state import ScenarioState
    from ..geometry import Float
    from ..logs import DrivingLog
    from ..render import Frame
    from ..scene import Ground, LaneGraph, Scene
    from ..scene.ground_fit import RoadPlane


# --- render ---------------------------------------------------------------------------------------

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
    """Render one recorded camera of a scene; with --log, print PSNR against the recorded image.

    With --lidar, cast a sweep of a LiDAR on the recording vehicle instead, and draw it next to the
    image.
    """
    from ..edit.compose import instances_at
    from ..render import render_cameras, warm_up
    from ..scene.io import open_scene

    if log is not None and (t_us is not None or delete):
        raise CommandError("--log compares whole recorded frames: use --frame, and no --delete")
    if lidar is not None:
        if log is not None:
            raise CommandError("--lidar is compared by `real2sim evaluate --lidar`, not by --log")
        _render_sweep(scene, out, lidar, _Moment(frame, t_us), delete or (), seed, json)
        return
    _check_output(out, modality)
    backend = chosen_backend(backend, device)
    warm_up(backend)  # Keeps warm-up out of the printed render time.
    loaded = open_scene(scene)
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
    """The instant selected by the options."""

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
    from ..scene.io import open_scene
    from ..scene.range_sensors import find_lidar

    if out.suffix.lower() not in SUFFIXES:
        raise CommandError(f"--out {out}: the name must end in {', '.join(SUFFIXES)}")
    sensor, loaded = find_lidar(lidar), open_scene(scene)
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
    from ..reconstruct.evaluation import evaluate_views

    log = opened_log(log_path, provenance=scene.provenance)
    console.print(
        f"comparing with {log.name}, frame {frame}, over all pixels and over those that LiDAR "
        "covers"
    )
    report = evaluate_views(scene, log, frames=[frame], cameras=[camera], backend=backend)
    return {"psnr_db": report.psnr, "psnr_lidar_db": report.psnr_lidar}


# --- film -----------------------------------------------------------------------------------------


@command("film")
def film(
    *,
    scene: SceneBundle,
    run: Annotated[Path, typer.Argument(help="Output folder of `real2sim simulate`.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Output folder; default: the same.")
    ] = None,
    view: Annotated[str, typer.Option(help="Camera: near, scene or both.")] = "both",
    width: Annotated[
        int | None, typer.Option(min=64, max=4096, help="Width of each view [px].")
    ] = None,
    slow: Annotated[
        float | None, typer.Option(min=0.1, max=100, help="Slow-motion factor.")
    ] = None,
    backend: RenderBackend = "auto",
    device: RenderDevice = None,
) -> None:
    """Render film.mp4 and strip.png of a finished simulation again."""
    from ..edit.state import ScenarioState
    from ..scene.io import open_scene
    from ..simulation.experiments import FilmPlan, views, write_film
    from ..simulation.result import PlacedObjects, Playback, SimulationResult
    from ..simulation.spawn import EGO, with_ego

    names = {"near": ["near"], "scene": ["scene"], "both": ["scene", "near"]}
    if view not in names:
        raise CommandError(f"--view {view!r}; allowed are {', '.join(names)}")
    backend = chosen_backend(backend, device)
    plan, result = FilmPlan.load(run), SimulationResult.load(run / "simulation")
    loaded = open_scene(scene)
    state: PlacedObjects = ScenarioState.of(loaded)
    if EGO in result.objects:
        loaded, state = with_ego(loaded, state)
    playback = Playback(loaded, state, result)
    folder = run if out is None else out
    folder.mkdir(parents=True, exist_ok=True)
    with staged_progress() as report:
        write_film(
            playback,
            [v for v in views(playback, plan, width=width) if v.camera.name in names[view]],
            folder,
            slow=plan.slow if slow is None else slow,
            backend=backend,
            on_progress=lambda done, total: report("film", done, total),
        )
    console.print(f"in {folder}: film.mp4, strip.png", highlight=False)


# --- ground ---------------------------------------------------------------------------------------

MAX_SWEEPS = 12
POINTS_DRAWN = 60_000
BOX_MARGIN = 0.3
"""Points closer to a box than this belong to its object, not to the ground [m]."""


@command("ground")
def ground(
    *,
    scene: SceneBundle,
    log: Annotated[
        Path | None, typer.Option(help="Driving log of the scene, for its LiDAR.")
    ] = None,
    frame: Annotated[
        int, typer.Option(min=0, help="Frame whose boxes are projected onto the ground.")
    ] = 0,
    picture: Annotated[Path | None, typer.Option(help="PNG to write, with inliers in red.")] = None,
    json: JsonFile = None,
) -> None:
    """Compare the ground below a scene's objects with RANSAC planes of LiDAR and Gaussians."""
    from ..scene.ground_fit import find_road_plane, ground_points
    from ..scene.io import open_scene

    loaded = open_scene(scene)
    if frame >= len(loaded.frame_times_us):
        raise CommandError(f"--frame {frame}; it has 0 to {len(loaded.frame_times_us) - 1}")
    t_us = int(loaded.frame_times_us[frame])
    there = {k: o for k, o in loaded.objects.items() if o.trajectory.covers(t_us)}
    boxes = [(o.trajectory.transform(t_us), o.size) for o in there.values()]
    sources = {"Gaussians": ground_points(loaded.background)}
    if log is not None:
        sources = {"LiDAR": _lidar_points(opened_log(log)), **sources}
    planes = {name: find_road_plane(points, boxes) for name, points in sources.items()}
    figures = (
        {"boxes": len(boxes)} | _plane_figures(planes) | _height_figures(loaded, t_us, sources)
    )
    print_figures(f"road of {scene.name}", figures)
    under = dict(zip(there, _under(loaded.ground, boxes).tolist(), strict=True))
    print_figures("ground under objects [m]", under)
    write_json(json, figures | {"ground under objects [m]": under})
    if picture is not None:
        _draw(sources, planes, loaded.ego.transform(t_us), picture)
        console.print(f"picture: {picture}", soft_wrap=True)


def _plane_figures(planes: dict[str, RoadPlane]) -> dict[str, object]:
    """RANSAC planes below the boxes, by source."""
    import numpy as np

    figures: dict[str, object] = {}
    for name, plane in planes.items():
        figures |= {
            f"{name}: points around boxes": len(plane.candidates),
            f"{name}: inliers": int(plane.inliers.sum()),
            f"{name}: inliers [share]": float(plane.inliers.mean()),
            f"{name}: distance from plane, rms [m]": plane.rms,
            f"{name}: lean [deg]": float(np.degrees(np.arccos(min(plane.normal[2], 1.0)))),
        }
    return figures


def _height_figures(scene: Scene, t_us: int, sources: dict[str, Float]) -> dict[str, object]:
    """Height differences below the boxes between each source's ground and the scene's ground."""
    import numpy as np

    from ..scene.ground_fit import DrivenPath, box_bottoms, fit_ground

    objects = list(scene.objects.values())
    path, bottoms = DrivenPath.of(scene.ego), box_bottoms(objects)
    boxes = [(o.trajectory.transform(t_us), o.size) for o in objects if o.trajectory.covers(t_us)]
    found = {
        name: _under(fit_ground(p, path, bottoms).ground, boxes) for name, p in sources.items()
    }
    own = _under(scene.ground, boxes)
    figures: dict[str, object] = {
        f"{name}: heights apart from the scene's ground under boxes, median [m]": float(
            np.median(np.abs(heights - own))
        )
        for name, heights in found.items()
    }
    if len(found) == 2:
        apart = np.abs(found["LiDAR"] - found["Gaussians"])
        figures["heights apart under boxes, median [m]"] = float(np.median(apart))
    return figures


def _under(ground: Ground, boxes: list[tuple[Float, tuple[float, float, float]]]) -> Float:
    import numpy as np

    return ground.height_at(np.array([pose[:2, 3] for pose, _ in boxes]))


def _lidar_points(log: DrivingLog) -> Float:
    """World points [N, 3] of some sweeps, without those in tracked boxes."""
    import numpy as np

    from ..geometry import apply_transform, invert_transform

    frames = np.unique(np.linspace(0, log.frame_count - 1, MAX_SWEEPS).astype(int))
    kept = []
    for frame in frames.tolist():
        t_us = int(log.frame_times_us[frame])
        sweep = log.lidar(frame).points.astype(np.float64)
        points = apply_transform(log.ego.transform(t_us), sweep)
        for track in log.tracks:
            pose = track.transform_near(t_us)
            if pose is not None:
                local = apply_transform(invert_transform(pose), points)
                inside = np.abs(local) < np.array(track.size) / 2 + [BOX_MARGIN, BOX_MARGIN, -0.1]
                points = points[~inside.all(axis=1)]
        kept.append(points)
    found = np.concatenate(kept)
    if len(found) == 0:
        raise CommandError(f"log {log.name!r} has no LiDAR points")
    return found


def _draw(
    sources: dict[str, Float], planes: dict[str, RoadPlane], T_world_vehicle: Float, picture: Path
) -> None:
    """One panel for each source, seen from behind and above the vehicle; inliers in red."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from ..geometry import apply_transform, invert_transform
    from ..simulation.experiments.film import look_at

    ahead = T_world_vehicle[:3, 0]
    here = T_world_vehicle[:3, 3]
    T_world_camera = look_at(here - 14 * ahead + [0, 0, 12], here + 16 * ahead)
    figure = Figure(figsize=(7 * len(planes), 4.6), dpi=110)
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, len(planes), squeeze=False)[0]
    for axes, (name, plane) in zip(panels, planes.items(), strict=True):
        points = sources[name]
        step = max(len(points) // POINTS_DRAWN, 1)
        own = points[plane.candidates[plane.inliers]]
        layers = ((points[::step], "0.55", 0.4), (own[:: max(len(own) // 20_000, 1)], "red", 1.2))
        for shown, colour, size in layers:
            local = apply_transform(invert_transform(T_world_camera), shown)
            local = local[(local[:, 2] > 1) & (local[:, 2] < 70)]
            u, v = local[:, 0] / local[:, 2], local[:, 1] / local[:, 2]
            axes.scatter(u, -v, s=size, c=colour, linewidths=0)
        axes.set_xlim(-0.9, 0.9)
        axes.set_ylim(-0.5, 0.6)
        axes.set_aspect("equal")
        axes.set_axis_off()
        axes.set_title(
            f"{name}: {int(plane.inliers.sum()):,} inliers, {plane.rms * 100:.1f} cm rms"
        )
    figure.tight_layout()
    picture.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(picture)


# --- map ------------------------------------------------------------------------------------------


@command("map")
def map_(
    *,
    scene: SceneBundle,
    source: Annotated[
        str | None,
        typer.Option(
            "--from",
            help="FILE.xodr, FILE.osm, lanes.json, a data set's map folder, or `log`.",
        ),
    ] = None,
    log: Annotated[
        Path | None, typer.Option(help="Driving log of the scene, for `--from log`.")
    ] = None,
    at: Annotated[
        str | None,
        typer.Option(help="Pose of the map's origin in the scene: yaw,x,y [rad, m]."),
    ] = None,
    as_it_is: Annotated[
        bool,
        typer.Option("--as-it-is", help="The map is already in the scene's frame: do not fit it."),
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Output bundle or lanes.json; default: the scene itself."),
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(help="PNG to write: lanes over a top view of the scene.")
    ] = None,
    log_format: LogFormat = None,
    sequence: SequenceName = None,
    json: JsonFile = None,
) -> None:
    """Show the lanes of a scene, or add lanes from a map or the log."""
    from dataclasses import replace

    from ..scene.io import open_scene, save_scene
    from ..scene.io.document import lane_document

    loaded = open_scene(scene)
    figures: dict[str, Any] = {"scene": str(scene)}
    lanes = loaded.lanes
    if source is not None:
        lanes, fitted = _lanes_of(loaded, source, log, _start(at), as_it_is, (log_format, sequence))
        figures |= fitted
    if lanes is None:
        raise CommandError(f"{scene}: has no lanes; give it some with --from FILE or --from log")
    figures |= _figures(lanes)
    if out is not None and out.suffix == ".json":
        out.write_text(lane_document(lanes).model_dump_json(), encoding="utf-8")
        figures["document"] = str(out)
    elif source is not None or out is not None:
        target = changed_bundle(scene, out)
        save_scene(replace(loaded, lanes=lanes), target, overwrite=out is None)
        figures["scene"] = str(target)
    print_figures(f"lanes of {scene.name}", figures)
    write_json(json, figures | {"notes": list(lanes.notes)})
    for note in lanes.notes:
        console.print(f"note: {note}", soft_wrap=True, markup=False)
    if picture is not None:
        from ..maps.picture import draw_lanes

        draw_lanes(lanes, loaded, picture)
        console.print(f"picture: {picture}", soft_wrap=True)


def _start(at: str | None) -> tuple[float, float, float] | None:
    if at is None:
        return None
    try:
        yaw, x, y = (float(v) for v in at.split(","))
    except ValueError:
        raise CommandError(f"--at {at!r}; give yaw,x,y, such as 0.1,20,-5") from None
    return yaw, x, y


def _lanes_of(
    scene: Scene,
    source: str,
    log: Path | None,
    start: tuple[float, float, float] | None,
    as_it_is: bool,
    reading: tuple[str | None, str | None],
) -> tuple[LaneGraph, dict[str, Any]]:
    """The lanes of a map in the scene's frame, or of its log, and figures of how well they fit."""
    from ..maps import align, driven_poses, laid_on, lanes_from_log, read_map

    if source == "log":
        if log is None:
            raise CommandError("--from log needs the driving log: --log LOG")
        return lanes_from_log(opened_log(log, *reading, provenance=scene.provenance)), {}
    graph = read_map(source)
    if as_it_is:
        return laid_on(graph, scene.ground), {}
    fit = align(graph, driven_poses(scene), start=start)
    figures = {
        "turned [rad]": fit.yaw,
        "moved, x [m]": fit.x,
        "moved, y [m]": fit.y,
        "driven poses from centre lines, median [m]": fit.residual,
        "driven poses inside a lane [share]": fit.within,
    }
    return fit.apply(graph, scene.ground), figures


def _figures(lanes: LaneGraph) -> dict[str, Any]:
    from collections import Counter

    kinds = Counter(lane.kind for lane in lanes.lanes.values())
    gaps = list(lanes.gaps.values())
    return {
        "source": lanes.source,
        "accuracy, estimated [m]": "not known" if lanes.accuracy is None else lanes.accuracy,
        "lanes": ", ".join(f"{n} {kind}" for kind, n in kinds.most_common()),
        "length of driving lanes [m]": sum(
            lane.length for lane in lanes.lanes.values() if lane.kind == "driving"
        ),
        "successors": len(gaps),
        "widest gap between successive lanes [m]": max(gaps, default=0.0),
        "areas": len(lanes.areas),
        "stop lines": len(lanes.stop_lines),
        "signals": len(lanes.signals),
        "roads": len(lanes.roads),
    }
