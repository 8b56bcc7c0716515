"""``real2sim ground``: the scene's ground, beside what LiDAR and Gaussians say of it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..console import CommandError, console, print_figures, write_json
from .command import command
from .options import JsonFile, SceneBundle

if TYPE_CHECKING:
    from ..geometry.transform import Float
    from ..logs import DrivingLog
    from ..scene import Ground, Scene
    from ..scene.ground_fit import RoadPlane

SWEEPS_MAX = 12
POINTS_DRAWN = 60_000
BOX_MARGIN = 0.3
"""Points this near a box are its own, not the ground's [m]."""


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
    from ..logs.open import open_log
    from ..scene.ground_fit import find_road_plane, ground_points
    from ..scene.io import load_scene

    loaded = load_scene(scene)
    if frame >= len(loaded.frame_times_us):
        raise CommandError(f"--frame {frame}; it has 0 to {len(loaded.frame_times_us) - 1}")
    t_us = int(loaded.frame_times_us[frame])
    there = {k: o for k, o in loaded.objects.items() if o.trajectory.covers(t_us)}
    boxes = [(o.trajectory.transform(t_us), o.size) for o in there.values()]
    sources = {"Gaussians": ground_points(loaded.background)}
    if log is not None:
        sources = {"LiDAR": _lidar_points(open_log(log)), **sources}
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
    """What RANSAC found below the boxes in each source."""
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
    """How far the ground fitted to each source is from the scene's, under the boxes."""
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
    """Points [N, 3] of some sweeps in the world, without what lies in tracked boxes."""
    import numpy as np

    from ..geometry.transform import apply_transform, invert_transform

    frames = np.unique(np.linspace(0, log.frame_count - 1, SWEEPS_MAX).astype(int))
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

    from ..geometry.transform import apply_transform, invert_transform
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
