"""Lanes over a scene seen from above."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry import Float
from ..scene import GaussianCloud, LaneGraph, Scene

REACH_M = 25.0
ABOVE_M = (-1.0, 0.7)
"""Range of heights above the ground of drawn Gaussians [m]: the road, without trees."""
PIXEL_M = 0.1
COLOURS = {"driving": "#ffb454", "bus": "#ff7b72", "bicycle": "#7ee787", "sidewalk": "#79c0ff"}


def draw_lanes(lanes: LaneGraph, scene: Scene, path: Path) -> None:
    """A PNG of lanes over the Gaussians near the ground, around the ego path."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    way = scene.ego.positions[:, :2]
    low, high = way.min(axis=0) - REACH_M, way.max(axis=0) + REACH_M
    size = (high - low) / max(high - low)
    figure = Figure(figsize=(13 * size[0] + 0.4, 13 * size[1] + 0.6), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    image = top_view(scene.background, scene, low, high)
    axes.imshow(image, origin="lower", extent=(low[0], high[0], low[1], high[1]), zorder=0)
    for area in lanes.areas.values():
        axes.fill(area.outline[:, 0], area.outline[:, 1], color="#d2a8ff", alpha=0.25, zorder=1)
    for lane in lanes.lanes.values():
        _draw_lane(axes, lane, COLOURS.get(lane.kind, "#8b949e"))
    for line in lanes.stop_lines.values():
        axes.plot(line.points[:, 0], line.points[:, 1], color="red", lw=2.5)
    for signal in lanes.signals.values():
        axes.plot(*signal.position[:2], "r^", ms=6)
    axes.plot(way[:, 0], way[:, 1], color="#3fb950", lw=1.2)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x [m]", ylabel="y [m]")
    axes.set_aspect("equal")
    axes.set_title(f"{lanes.source}: {len(lanes.lanes)} lanes", fontsize=10)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


def _draw_lane(axes: Any, lane: Any, colour: str) -> None:
    left, right = lane.rims
    for rim in (left, right):
        axes.plot(rim[:, 0], rim[:, 1], color=colour, lw=0.9, alpha=0.9)
    axes.plot(lane.centre[:, 0], lane.centre[:, 1], color=colour, lw=0.7, ls=(0, (5, 4)))
    x, y, _, heading = lane.at(lane.length / 2)
    axes.annotate(
        "",
        (x + 1.5 * np.cos(heading), y + 1.5 * np.sin(heading)),
        (x, y),
        arrowprops={"arrowstyle": "->", "color": colour, "lw": 1.4},
    )


def top_view(
    cloud: GaussianCloud, scene: Scene, low: Float, high: Float, *, pixel: float = PIXEL_M
) -> NDArray[np.uint8]:
    """RGB uint8 [H, W, 3] of the Gaussians near the ground, rows along y; grey if empty."""
    means = cloud.means.detach().cpu().numpy().astype(np.float64)
    inside = ((means[:, :2] > low) & (means[:, :2] < high)).all(axis=1)
    inside &= cloud.opacities.detach().cpu().numpy() > 0.3
    above = means[:, 2] - scene.ground.height_at(means[:, :2])
    inside &= (above > ABOVE_M[0]) & (above < ABOVE_M[1])
    colours = np.clip(cloud.sh[:, 0].detach().cpu().numpy() * 0.28209479 + 0.5, 0, 1)[inside]
    columns, rows = (int(n) for n in np.ceil((high - low) / pixel))
    i, j = ((means[inside, :2] - low) / pixel).astype(int).T
    sums = np.zeros((rows, columns, 3))
    counts = np.zeros((rows, columns))
    np.add.at(sums, (j, i), colours)
    np.add.at(counts, (j, i), 1)
    image = np.where(counts[..., None] > 0, sums / np.maximum(counts, 1)[..., None], 0.12)
    return (image * 255).astype(np.uint8)
