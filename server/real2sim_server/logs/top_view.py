"""The drive from above: LiDAR, boxes, the ways of everything that moves."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.rotation import Float
from ..geometry.transform import apply_transform
from .driving_log import DrivingLog, LidarSweep, ObjectTrack
from .overlay import colour_of

HEIGHTS = (-0.3, 4.0)
REACH = 45.0
"""How far around the way of the vehicle is drawn [m]."""

FOOTPRINT = np.array([[0.5, 0.5], [0.5, -0.5], [-0.5, -0.5], [-0.5, 0.5], [0.5, 0.5]])


def draw_top_view(log: DrivingLog, frame: int, sweep: LidarSweep) -> NDArray[np.uint8]:
    """RGB uint8 [H, W, 3]: a frame with its sweep and boxes, and the ways that are driven."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    t_us = int(log.frame_times_us[frame])
    figure = Figure(figsize=(12, 9), dpi=100, layout="constrained")
    canvas: Any = FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    _draw_points(figure, axes, log.ego.transform(t_us), sweep)
    positions = np.array([log.ego.pose(int(t))[0] for t in log.frame_times_us])
    axes.plot(positions[:, 0], positions[:, 1], color="black", lw=1.5, label="ego")
    _draw_footprint(axes, log.ego.transform(t_us), log.ego_size, "black", shift=1.4)
    for track in log.tracks:
        _draw_track(axes, track, t_us)
    low, high = positions[:, :2].min(axis=0) - REACH, positions[:, :2].max(axis=0) + REACH
    axes.set(
        xlim=(low[0], high[0]),
        ylim=(low[1], high[1]),
        xlabel="x [m]",
        ylabel="y [m]",
        title=f"{log.name}: frame {frame}",
    )
    axes.set_aspect("equal")
    axes.grid(alpha=0.3)
    canvas.draw()
    return np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., :3])


def _draw_points(figure: Any, axes: Any, T_world_vehicle: Float, sweep: LidarSweep) -> None:
    points = apply_transform(T_world_vehicle, sweep.points.astype(np.float64))
    if not len(points):
        return
    x, y, z = points[np.argsort(points[:, 2])].T
    drawn = axes.scatter(x, y, c=z, s=0.4, cmap="viridis", vmin=HEIGHTS[0], vmax=HEIGHTS[1])
    figure.colorbar(drawn, ax=axes, label="z [m]", shrink=0.7)


def _draw_track(axes: Any, track: ObjectTrack, t_us: int) -> None:
    colour = np.array(colour_of(track.object_id)) / 255 * 0.8
    positions = track.trajectory.positions
    axes.plot(positions[:, 0], positions[:, 1], color=colour, lw=1, ls="--")
    if track.trajectory.covers(t_us):
        pose = track.trajectory.transform(t_us)
        _draw_footprint(axes, pose, track.size, colour)
        # Clipped to the axes, else far boxes would shrink the drawing.
        axes.annotate(track.object_id, pose[:2, 3], fontsize=7, color=colour, annotation_clip=True)


def _draw_footprint(
    axes: Any, pose: Float, size: tuple[float, float, float], colour: Any, *, shift: float = 0.0
) -> None:
    """Outline, and a line from the middle to the front; ``shift`` is where the middle is on x."""
    outline = FOOTPRINT * size[:2] + [shift, 0]
    outline = np.concatenate([outline, [[shift, 0], [shift + size[0] / 2, 0]]])
    placed = apply_transform(pose, np.pad(outline, ((0, 0), (0, 1))))
    axes.plot(placed[:5, 0], placed[:5, 1], color=colour, lw=1.4)
    axes.plot(placed[5:, 0], placed[5:, 1], color=colour, lw=1.4)
