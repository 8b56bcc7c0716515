"""``real2sim ground``: the road surface, from LiDAR and from Gaussians."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..console import CommandError, console, print_figures, write_json
from .command import command
from .options import JsonFile, SceneBundle

if TYPE_CHECKING:
    from ..geometry.rotation import Float
    from ..logs import DrivingLog
    from ..scene import Scene
    from ..simulation.ground import Road

SWEEPS_MAX = 12
POINTS_DRAWN = 60_000
BOX_MARGIN = 0.3
"""Points this near a box are its own, not the ground's [m]."""


@command("ground")
def ground(
    *,
    scene: SceneBundle,
    log: Annotated[Path | None, typer.Option(help="Its driving log, for LiDAR.")] = None,
    frame: Annotated[int, typer.Option(min=0, help="Whose boxes are projected down.")] = 0,
    picture: Annotated[Path | None, typer.Option(help="PNG with inliers in red.")] = None,
    json: JsonFile = None,
) -> None:
    """Find the road surface under a scene's objects, from LiDAR and from Gaussians."""
    import numpy as np

    from ..logs.open import open_log
    from ..scene.io import load_scene
    from ..simulation.ground import find_road

    loaded = load_scene(scene)
    if frame >= len(loaded.frame_times_us):
        raise CommandError(f"--frame {frame}; it has 0 to {len(loaded.frame_times_us) - 1}")
    t_us = int(loaded.frame_times_us[frame])
    boxes = [
        (o.trajectory.transform(t_us), o.size)
        for o in loaded.objects.values()
        if o.trajectory.covers(t_us)
    ]
    sources = {"Gaussians": _gaussian_points(loaded)}
    if log is not None:
        sources = {"LiDAR": _lidar_points(open_log(log)), **sources}
    roads = {name: find_road(points, boxes) for name, points in sources.items()}
    figures: dict[str, object] = {"boxes": len(boxes)}
    for name, road in roads.items():
        normal = np.asarray(road.plane.normal)
        figures |= {
            f"{name}: points around boxes": len(road.candidates),
            f"{name}: inliers": int(road.inliers.sum()),
            f"{name}: inliers [share]": float(road.inliers.mean()),
            f"{name}: distance from plane, rms [m]": road.rms,
            f"{name}: lean [deg]": float(np.degrees(np.arccos(min(normal[2], 1.0)))),
        }
    if len(roads) == 2:
        apart = _apart(roads["LiDAR"], roads["Gaussians"], boxes)
        figures["heights apart under boxes, median [m]"] = apart
    print_figures(f"road of {scene.name}", figures)
    write_json(json, figures)
    if picture is not None:
        _draw(sources, roads, loaded.ego.transform(t_us), picture)
        console.print(f"picture: {picture}", soft_wrap=True)


def _gaussian_points(scene: Scene) -> Float:
    import numpy as np

    solid = scene.background.opacities.detach().cpu().numpy() > 0.3
    means = scene.background.means.detach().cpu().numpy()
    return np.asarray(means[solid], dtype=np.float64)


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


def _apart(a: Road, b: Road, boxes: list[tuple[Float, tuple[float, float, float]]]) -> float:
    import numpy as np

    from ..simulation.surroundings import clearance

    places = np.array([pose[:3, 3] for pose, _ in boxes])
    difference = clearance(a.field, places)[0] - clearance(b.field, places)[0]
    return float(np.median(np.abs(difference)))


def _draw(
    sources: dict[str, Float], roads: dict[str, Road], T_world_vehicle: Float, picture: Path
) -> None:
    """One panel for each source, seen from behind and above the vehicle; inliers in red."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from ..geometry.transform import apply_transform, invert_transform
    from ..simulation.experiments.film import look_at

    ahead = T_world_vehicle[:3, 0]
    here = T_world_vehicle[:3, 3]
    T_world_camera = look_at(here - 14 * ahead + [0, 0, 12], here + 16 * ahead)
    figure = Figure(figsize=(7 * len(roads), 4.6), dpi=110)
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, len(roads), squeeze=False)[0]
    for axes, (name, road) in zip(panels, roads.items(), strict=True):
        points = sources[name]
        step = max(len(points) // POINTS_DRAWN, 1)
        own = points[road.candidates[road.inliers]]
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
        axes.set_title(f"{name}: {int(road.inliers.sum()):,} inliers, {road.rms * 100:.1f} cm rms")
    figure.tight_layout()
    picture.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(picture)
