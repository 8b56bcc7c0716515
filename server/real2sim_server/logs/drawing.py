"""Drawings of logs: boxes and LiDAR points on images, and the drive from above."""

from __future__ import annotations

import colorsys
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry import Float, apply_transform, invert_transform
from ..scene import Camera
from .driving_log import DrivingLog, LidarSweep, ObjectTrack

NEAR = 0.3
"""Minimum distance of drawn items from the camera [m]."""

DEPTH_RANGE = (3.0, 70.0)
"""Depths [m] at the ends of the colour scale, which is logarithmic."""

CORNERS = np.array(
    [[x, y, z] for x in (0.5, -0.5) for y in (0.5, -0.5) for z in (-0.5, 0.5)], dtype=np.float64
)
EDGES = (
    (0, 1), (2, 3), (4, 5), (6, 7), (0, 2), (1, 3), (4, 6), (5, 7), (0, 4), (1, 5), (2, 6), (3, 7),
    (0, 3), (1, 2),
)  # fmt: skip
"""Edges between corners, and a cross on the front face."""


def draw_frame(log: DrivingLog, camera: str, frame: int) -> NDArray[np.uint8]:
    """The image of a camera with the sweep's points, coloured by depth, and all boxes.

    Points and boxes are drawn at their positions at the time of the image. Points of moving objects
    stay at their time of measurement.

    Returns:
        RGB uint8 [H, W, 3].

    Raises:
        LogError: the image or the sweep is broken.
    """
    lens, t_us = log.rig[camera], log.image_time_us(camera, frame)
    to_camera = lens.viewmat(log.ego.transform(t_us))
    picture = log.image(camera, frame).copy()
    to_world = log.ego.transform(int(log.frame_times_us[frame]))
    points = apply_transform(to_camera @ to_world, log.lidar(frame).points.astype(np.float64))
    _draw_points(picture, lens, points)
    for track in log.tracks:
        placed = track.transform_near(t_us)
        if placed is not None:
            corners = apply_transform(to_camera @ placed, CORNERS * np.array(track.size))
            _draw_box(picture, lens, corners, colour_of(track.object_id), track.object_id)
    return picture


def colour_of(object_id: str) -> tuple[int, int, int]:
    """A bright colour that depends only on the object id."""
    number = sum(ord(c) * (i + 7) for i, c in enumerate(object_id))
    red, green, blue = colorsys.hsv_to_rgb(number * 0.61803 % 1.0, 0.75, 1.0)
    return round(red * 255), round(green * 255), round(blue * 255)


def _draw_points(picture: NDArray[np.uint8], lens: Camera, points: Float) -> None:
    import cv2

    points = points[points[:, 2] > NEAR]
    pixels = _pixels(lens, points)
    inside = ((pixels >= 0) & (pixels < [lens.width, lens.height])).all(axis=1)
    if not inside.any():
        return
    pixels, depth = pixels[inside].astype(int), points[inside, 2]
    low, high = np.log(DEPTH_RANGE)
    fraction = np.clip((np.log(depth) - low) / (high - low), 0, 1)
    scale = np.round((1 - fraction) * 255).astype(np.uint8)
    colours = cv2.applyColorMap(scale[:, None], cv2.COLORMAP_TURBO)[:, 0, ::-1]
    radius = max(1, round(lens.width / 1000))
    for i in np.argsort(-depth):
        x, y = pixels[i]
        picture[max(y - radius + 1, 0) : y + radius, max(x - radius + 1, 0) : x + radius] = colours[
            i
        ]


def _draw_box(
    picture: NDArray[np.uint8],
    lens: Camera,
    corners: Float,
    colour: tuple[int, int, int],
    name: str,
) -> None:
    import cv2

    width = max(1, round(lens.width / 700))
    drawn = []
    for start, end in EDGES:
        line = _clip(corners[start], corners[end])
        if line is None:
            continue
        pixels = np.clip(np.round(_pixels(lens, line)), -10_000, 10_000).astype(int)
        visible, one, two = cv2.clipLine((0, 0, lens.width, lens.height), *pixels.tolist())
        if visible:
            cv2.line(picture, one, two, colour, width, cv2.LINE_AA)
            drawn += [one, two]
    if drawn:
        x, y = min(drawn, key=lambda p: p[1])
        size = max(0.35, lens.width / 2500)
        place = (min(x, lens.width - 60), max(y - 3, 10))
        cv2.putText(
            picture, name, place, cv2.FONT_HERSHEY_SIMPLEX, size, colour, width, cv2.LINE_AA
        )


def _clip(start: Float, end: Float) -> Float | None:
    """The part [2, 3] of a line in front of the camera."""
    if start[2] < NEAR and end[2] < NEAR:
        return None
    line = np.stack([start, end])
    for i in (0, 1):
        if line[i, 2] < NEAR:
            fraction = (NEAR - line[i, 2]) / (line[1 - i, 2] - line[i, 2])
            line[i] = line[i] + fraction * (line[1 - i] - line[i])
    return line


def _pixels(lens: Camera, points: Float) -> Float:
    projected = points @ lens.K.T
    pixels: Float = projected[:, :2] / projected[:, 2:]
    return pixels


def points_in_box(points: Float, pose: Float, size: tuple[float, float, float]) -> int:
    """Number of points [N, 3] in a box with ``pose`` [4, 4] in the same frame."""
    local = apply_transform(invert_transform(pose), points)
    return int((np.abs(local) <= np.array(size) / 2).all(axis=1).sum())


# --- From above ----------------------------------------------------------------------------------

HEIGHTS = (-0.3, 4.0)
REACH = 45.0
"""Drawn distance around the vehicle's path [m]."""

FOOTPRINT = np.array([[0.5, 0.5], [0.5, -0.5], [-0.5, -0.5], [-0.5, 0.5], [0.5, 0.5]])


def draw_top_view(log: DrivingLog, frame: int, sweep: LidarSweep) -> NDArray[np.uint8]:
    """RGB uint8 [H, W, 3]: a frame with its sweep and boxes, and the driven paths."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    t_us = int(log.frame_times_us[frame])
    figure = Figure(figsize=(12, 9), dpi=100, layout="constrained")
    canvas: Any = FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    _draw_points_above(figure, axes, log.ego.transform(t_us), sweep)
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


def _draw_points_above(figure: Any, axes: Any, T_world_vehicle: Float, sweep: LidarSweep) -> None:
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
    """Outline, and a line from the centre to the front; ``shift`` is the centre along x."""
    outline = FOOTPRINT * size[:2] + [shift, 0]
    outline = np.concatenate([outline, [[shift, 0], [shift + size[0] / 2, 0]]])
    placed = apply_transform(pose, np.pad(outline, ((0, 0), (0, 1))))
    axes.plot(placed[:5, 0], placed[:5, 1], color=colour, lw=1.4)
    axes.plot(placed[5:, 0], placed[5:, 1], color=colour, lw=1.4)
