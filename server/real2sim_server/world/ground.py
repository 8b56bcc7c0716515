"""The ground as the recorded vehicle felt it: a plane under each point of its path."""

from __future__ import annotations

import math

import numpy as np

from .path import Float, LoggedPath, PathPoint

REACH = 10.0
"""The plane under the path is trusted this far to the side [m]; beyond, its rim's height holds."""

MIN_UPRIGHT = 0.5
"""Normals leaning more than 60 degrees are no ground; the ground counts as level there."""


class LoggedGround:
    """Height and tilt of the ground from the logged ego path; callable as edit's ground."""

    def __init__(self, path: LoggedPath) -> None:
        self._path = path

    def __call__(self, points: Float) -> Float:
        """Ground height [S] [m] below points [S, 2] [m] of the world."""
        at = (self.height(x, y, self._path.nearest(x, y)) for x, y in points.tolist())
        return np.fromiter(at, dtype=np.float64, count=len(points))

    def height(self, x: float, y: float, near: PathPoint) -> float:
        """Ground height [m] at (x, y) [m], where ``near`` is the path's nearest point."""
        px, py, pz = near.position
        a, b, c = _upright(near.up)
        dx, dy = x - px, y - py
        distance = math.hypot(dx, dy)
        share = 1.0 if distance <= REACH else REACH / distance
        return pz - share * (a * dx + b * dy) / c

    def stand(self, x: float, y: float, yaw: float, near: PathPoint) -> Float:
        """``T_world_vehicle`` [4, 4] of a vehicle with that heading standing at (x, y).

        Its x axis seen from above has heading ``yaw``; its z axis is the ground's normal.
        """
        a, b, c = _upright(near.up)
        forward_x, forward_y = math.cos(yaw), math.sin(yaw)
        rise = -(a * forward_x + b * forward_y) / c
        length = math.sqrt(1.0 + rise * rise)
        fx, fy, fz = forward_x / length, forward_y / length, rise / length
        z = self.height(x, y, near)
        return np.array(
            [
                [fx, b * fz - c * fy, a, x],
                [fy, c * fx - a * fz, b, y],
                [fz, a * fy - b * fx, c, z],
                [0.0, 0.0, 0.0, 1.0],
            ]
        )


def _upright(up: tuple[float, float, float]) -> tuple[float, float, float]:
    return up if up[2] > MIN_UPRIGHT else (0.0, 0.0, 1.0)
