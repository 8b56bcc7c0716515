"""Curves, maps and films of episodes."""

from __future__ import annotations

import contextlib
import io
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.transform import quaternion_yaw
from ..render import RasterOptions, render_cameras, select_backend
from ..render.video import video_file
from ..scene import Scene
from ..world import World
from ..world.recording.recording import Recording
from ..world.recording.replay import Replayer
from .episodes import EpisodeResult

COLORS = ("#1f6feb", "#d1495b", "#2a9d5c", "#e08a00", "#7b4fc9", "#0e8f9e", "#8a5a2b", "#555e68")
TTC_SHOWN = 4.0
"""Times to collision above this are drawn there [s]."""
MARGIN = 14.0

Array = NDArray[np.float64]


def plot_curves(results: Sequence[EpisodeResult], policies: Sequence[str]) -> bytes:
    """Speed, time to collision, lateral error and progress over time, of one case.

    Args:
        results: episodes of the case; the first seed is drawn strong, the others faint.
        policies: all of them, in the order that gives them their colors.
    """
    plt = _pyplot()
    figure, axes = plt.subplots(2, 2, figsize=(13, 6.4), dpi=90, sharex=True)
    first = min(one.seed for one in results)
    for one in results:
        strong = one.seed == first
        color = COLORS[policies.index(one.policy) % len(COLORS)]
        times, series = _series(one.recording)
        for ax, values in zip(axes.flat, series, strict=True):
            ax.plot(
                times,
                values,
                color=color,
                lw=1.8 if strong else 0.7,
                alpha=0.95 if strong else 0.4,
                label=one.policy if strong else None,
            )
        if one.reason == "collision":
            for ax, values in zip(axes.flat, series, strict=True):
                ax.plot(times[-1], values[-1], "x", color=color, ms=8, mew=2)
    titles = (
        "speed [m/s]",
        f"time to collision, up to {TTC_SHOWN:g} [s]",
        "lateral error [m]",
        "progress [m]",
    )
    for ax, title in zip(axes.flat, titles, strict=True):
        ax.set_title(title, loc="left", fontsize=10)
        ax.grid(alpha=0.25)
    for ax in axes[1]:
        ax.set_xlabel("time [s]")
    axes[0, 1].set_ylim(-0.1, TTC_SHOWN + 0.2)
    axes[0, 0].legend(frameon=False, fontsize=8)
    return _png(figure)


def plot_paths(results: Sequence[EpisodeResult], policies: Sequence[str]) -> bytes:
    """Driven paths from above, two in a row, with every object where it ended."""
    plt = _pyplot()
    low, high = _extent([one.recording for one in results])
    rows = -(-len(results) // 2)
    height = 0.7 + 6.0 * (high[1] - low[1]) / max(high[0] - low[0], 1.0)
    figure, axes = plt.subplots(rows, 2, figsize=(13, height * rows), dpi=90, squeeze=False)
    for ax in axes.flat[len(results) :]:
        ax.set_visible(False)
    for ax, one in zip(axes.flat, results, strict=False):
        color = COLORS[policies.index(one.policy) % len(COLORS)]
        _draw_episode(ax, one.recording, color)
        ax.set_title(f"{one.policy}: {one.reason}", loc="left", fontsize=9)
        ax.set_xlim(low[0], high[0])
        ax.set_ylim(low[1], high[1])
        ax.set_aspect("equal")
    return _png(figure)


def _series(recording: Recording) -> tuple[Array, tuple[Array, Array, Array, Array]]:
    instants, accumulators = recording.instants, recording.accumulators()
    times = np.array([(i.t_us - instants[0].t_us) * 1e-6 for i in instants])
    ttc = np.array([min(accumulator.ttc, TTC_SHOWN) for accumulator in accumulators])
    return times, (
        np.array([i.ego.speed for i in instants]),
        ttc,
        np.array([i.ego.offset for i in instants]),
        np.array([accumulator.s - recording.context.start_s for accumulator in accumulators]),
    )


def _draw_episode(ax: Any, recording: Recording, color: str) -> None:
    context, last = recording.context, recording.instants[-1]
    ax.plot(context.route[:, 0], context.route[:, 1], color="black", lw=0.8, ls="--")
    for k, object_id in enumerate(last.others.ids):
        hit = any(object_id == c.object_id for i in recording.instants for c in i.contacts)
        box = rectangle_corners(
            last.others.centres[k, :2], last.others.yaws[k], last.others.sizes[k]
        )
        ax.fill(*box.T, color="#d1495b" if hit else "#8b949e", alpha=0.8 if hit else 0.45, lw=0)
        track = _track(recording, object_id)
        if np.ptp(track, axis=0).max() > 1.0:
            ax.plot(*track.T, color="#8b949e", lw=0.6)
    path = np.array([(i.ego.x, i.ego.y) for i in recording.instants])
    ax.plot(*path.T, color=color, lw=2)
    ahead = np.array([math.cos(last.ego.yaw), math.sin(last.ego.yaw)]) * context.centre_ahead
    box = rectangle_corners(path[-1] + ahead, last.ego.yaw, np.array(context.ego_size))
    ax.fill(*box.T, color=color, alpha=0.85, lw=0)


def _track(recording: Recording, object_id: str) -> Array:
    places = [
        i.others.centres[i.others.ids.index(object_id), :2]
        for i in recording.instants
        if object_id in i.others.ids
    ]
    return np.array(places)


def rectangle_corners(centre: Array, yaw: float, size: Array) -> Array:
    """[4, 2] corners, in order around, of a box of ``size`` seen from above [m]."""
    c, s = math.cos(yaw), math.sin(yaw)
    local = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * size[:2] / 2
    corners: Array = local @ np.array([[c, s], [-s, c]]) + centre
    return corners


def _extent(recordings: Sequence[Recording]) -> tuple[Array, Array]:
    places = [[(i.ego.x, i.ego.y) for i in r.instants] for r in recordings]
    places += [r.context.route.tolist() for r in recordings]
    points = np.concatenate([np.array(p) for p in places])
    low: Array = points.min(axis=0) - MARGIN
    high: Array = points.max(axis=0) + MARGIN
    return low, high


def _pyplot() -> Any:
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot

    return pyplot


def _png(figure: Any) -> bytes:
    figure.tight_layout()
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    _pyplot().close(figure)
    return buffer.getvalue()


# --- Films ---------------------------------------------------------------------------------------

Image = NDArray[np.uint8]


MAP_PIXELS, MAP_METRES = 160, 60.0
BACKGROUND, ROUTE, OBJECT, EGO = (40, 40, 40), (160, 160, 160), (255, 140, 60), (120, 220, 120)
"""Colors of the map."""


def film_episode(
    recording: Recording,
    replayer: Replayer,
    scene: Scene,
    path: Path,
    *,
    camera: str | None = None,
    width: int = 640,
) -> None:
    """Write an MP4 of an episode as it is replayed, an image a step.

    Args:
        recording: the episode.
        replayer: of it, before its first entry.
        scene: that it ran on.
        path: file to write.
        camera: name; None: the first one.
        width: of the film [px].
    """
    chosen = scene.rig[camera or scene.rig.names[0]].resized(width)
    backend = select_backend("auto")
    with contextlib.ExitStack() as stack:
        video = None
        for world in _instants(recording, replayer):
            (frame,) = render_cameras(
                world.instances(),
                [chosen],
                world.T_world_body,
                sky=scene.sky,
                options=RasterOptions(),
                backend=backend,
            )
            image = np.array(frame.rgb)
            _draw_caption(image, world)
            _draw_map(image, world)
            if video is None:
                rate = 1e6 / world.spec.dt_us
                video = stack.enter_context(video_file(path, frames_per_second=rate))
            video.add(image)


def _instants(recording: Recording, replayer: Replayer) -> Iterator[World]:
    for entry in recording.entries:
        world = replayer.apply(entry)
        if entry.kind in {"reset", "action", "restore"}:
            yield world


def _draw_caption(image: Image, world: World) -> None:
    metrics = world.metrics()
    lines = [
        f"{(world.t_us - world.scene.start_us) * 1e-6:5.1f} s  {world.motion.speed:4.1f} m/s",
        f"pdms {metrics['pdms']:.2f}  completed {100 * metrics['route_completion']:.0f} %",
        *(f"{e.type} {e.object_id or ''}" for e in world.observe().events),
    ]
    for k, line in enumerate(lines):
        for color, thickness in (((0, 0, 0), 3), ((255, 255, 255), 1)):
            cv2.putText(
                image, line, (8, 18 + 18 * k), cv2.FONT_HERSHEY_SIMPLEX, 0.5, color, thickness
            )


def _draw_map(image: Image, world: World) -> None:
    """Into the lower right corner: seen from above, the ego heading up."""
    size = min(MAP_PIXELS, image.shape[0] // 2, image.shape[1] // 2)
    scale, motion = size / MAP_METRES, world.motion
    drawn = np.full((size, size, 3), BACKGROUND, np.uint8)
    cos, sin = math.cos(motion.yaw), math.sin(motion.yaw)

    def to_pixels(points: Array) -> NDArray[np.int32]:
        d = points - [motion.x, motion.y]
        ahead, left = d @ [cos, sin], d @ [-sin, cos]
        return np.stack([size / 2 - scale * left, 0.75 * size - scale * ahead], 1).astype(np.int32)

    cv2.polylines(drawn, [to_pixels(world.context.route)], False, ROUTE, 1)
    agents = world.agents
    for k in range(len(agents.objects)):
        yaw = float(quaternion_yaw(agents.quaternions[k]))
        corners = rectangle_corners(agents.positions[k, :2], yaw, agents.sizes[k])
        cv2.fillPoly(drawn, [to_pixels(corners)], OBJECT)
    ahead = world.context.centre_ahead
    centre = np.array([motion.x + ahead * cos, motion.y + ahead * sin])
    corners = rectangle_corners(centre, motion.yaw, np.array(world.scene.ego_size))
    cv2.fillPoly(drawn, [to_pixels(corners)], EGO)
    image[-size:, -size:] = drawn
