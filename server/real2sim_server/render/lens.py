"""Rays and projection of cameras with a lens or a rolling shutter, and the ground class.

Blending needs the ray of every pixel. Finding the pixels that a Gaussian may touch needs the
projection of any direction, even outside the lens. Both are tables, so renderers do not depend on
lens models.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from real2sim_proto.conventions import GROUND, STATIC

from ..geometry import Float, invert_transform, quaternion_to_matrix
from ..scene import Camera, Ground
from ..scene.camera import CameraMotion
from .types import weak_cache

CELLS = 96
"""Cells along the edge of a directory face."""
NODE = 8
"""Numbers per node of the directory."""
STEADY = 18 / CELLS
"""Distance on a face within which the ``bend`` of a node is valid."""
BEYOND = np.radians(5.0)
"""Angle outside the image beyond which positions are extrapolated linearly [rad]."""
STEP = 1e-4
"""Step of finite differences on a face."""


@dataclass(frozen=True, eq=False)
class LensView:
    """A camera with a lens or a rolling shutter, and its motion during a readout.

    Attributes:
        camera: the camera; its pose on the vehicle is ignored.
        motion: motion of the camera in the world.
    """

    camera: Camera
    motion: CameraMotion

    @property
    def seconds(self) -> float:
        """Readout time of an image [s]."""
        return self.camera.shutter.readout_us * 1e-6

    @property
    def viewmat(self) -> Float:
        """``T_camera_world`` [4, 4] at mid-readout."""
        return invert_transform(self.middle)

    @functools.cached_property
    def middle(self) -> Float:
        """``T_world_camera`` [4, 4] at mid-readout."""
        return self.motion.middle()

    @functools.cached_property
    def moves(self) -> bool:
        """Whether the pose of the camera changes during the readout."""
        return self.camera.shutter.rolls

    def lines(self) -> Float:
        """Time of each row (or column), -0.5 to 0.5 over the readout."""
        return self.camera.shutter.line_times(self.camera.width, self.camera.height) - 0.5

    @functools.cached_property
    def shift(self) -> Float:
        """[3] displacement of the camera over the readout, mid-readout camera frame [m]."""
        way: Float = self.motion.end[:3, 3] - self.motion.start[:3, 3]
        return way @ self.middle[:3, :3]

    @functools.cached_property
    def turn(self) -> Float:
        """[3] rotation vector of the camera over the readout, camera frame [rad]."""
        relative = self.motion.start[:3, :3].T @ self.motion.end[:3, :3]
        axis = np.array(
            [
                relative[2, 1] - relative[1, 2],
                relative[0, 2] - relative[2, 0],
                relative[1, 0] - relative[0, 1],
            ]
        )
        sine, cosine = np.linalg.norm(axis) / 2, (np.trace(relative) - 1) / 2
        angle = np.arctan2(sine, cosine)
        return axis / (2 * sine) * angle if sine > 1e-12 else axis / 2

    def rays(self) -> NDArray[np.float32]:
        """[H, W, 3] ray directions, mid-readout camera frame; unnormalised, 0 outside the lens."""
        table = tables_of(self.camera).rays
        turn = self.turn
        if not self.moves or not turn.any():
            return table
        angle = float(np.linalg.norm(turn))
        half = self.lines() * angle / 2
        quaternions = np.concatenate(
            [np.cos(half)[:, None], np.sin(half)[:, None] * (turn / angle)], axis=1
        )
        turns = quaternion_to_matrix(quaternions).astype(np.float32)
        if self.camera.shutter.by_row:
            return np.ascontiguousarray(np.einsum("hij,hwj->hwi", turns, table))
        return np.ascontiguousarray(np.einsum("wij,hwj->hwi", turns, table))


@dataclass(frozen=True, eq=False)
class LensTables:
    """Scene-independent tables of a camera.

    Attributes:
        rays: [H, W, 3] float32 unit directions of pixel centres; 0 outside the lens.
        blind: [H, W] bool, pixels outside the lens.
        directory: [6, CELLS + 1, CELLS + 1, NODE] float32, at the nodes of the faces of a cube of
            directions: position x, y [px], its derivatives x_u, x_v, y_u, y_v, their relative
            change nearby [per unit of u, v], and the maximum interpolation error [px]. Face
            2 k + (s < 0) has component k largest, with sign s; u, v are the next two components
            over its magnitude.
        slack, bend: maxima of the last two values over the image.
        reach: largest angle of a pixel from the axis [rad].
    """

    rays: NDArray[np.float32]
    blind: NDArray[np.bool_]
    directory: NDArray[np.float32]
    slack: float
    bend: float
    reach: float


@weak_cache
def tables_of(camera: Camera) -> LensTables:
    """Tables of a camera, cached; the first call takes 0.2 s."""
    width, height = camera.width, camera.height
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays, seen = camera.unproject(np.stack([x, y], -1))
    rays = np.where(seen[..., None], rays, 0.0)
    angles = np.arctan2(np.hypot(rays[..., 0], rays[..., 1]), rays[..., 2])
    reach = float(angles[seen].max(initial=0.0))
    position = continued(camera, reach)
    directory, slack, bend = _directory(camera, position)
    return LensTables(rays.astype(np.float32), ~seen, directory, slack, bend, reach)


def continued(camera: Camera, reach: float) -> Callable[[Float], Float]:
    """Image positions [..., 2] of any directions [..., 3].

    Outside the lens, or BEYOND the image, positions are extrapolated linearly from that edge.

    Args:
        camera: camera with its lens.
        reach: ``reach`` of LensTables [rad].
    """
    own = np.pi if camera.lens is None else camera.lens.reach
    if camera.lens is None or camera.lens.perspective:
        own = min(own, np.radians(89.0))
    last = min(reach + float(BEYOND), own - 1e-6)

    def at(angle: Float, across: Float) -> Float:
        sine = np.sin(angle)[..., None]
        return camera.project(np.concatenate([across * sine, np.cos(angle)[..., None]], -1))[0]

    def position(directions: Float) -> Float:
        length = np.hypot(directions[..., 0], directions[..., 1])
        angle = np.arctan2(length, directions[..., 2])
        across = directions[..., :2] / np.where(length > 0, length, 1.0)[..., None]
        # Straight behind the camera, the direction is arbitrary.
        across = np.where((length > 0)[..., None], across, [1.0, 0.0])
        found = at(np.minimum(angle, last), across)
        edge = np.full_like(angle, last)
        slope = (at(edge, across) - at(edge - 1e-3, across)) / 1e-3
        return found + np.maximum(angle - last, 0.0)[..., None] * slope

    return position


def _faces(u: Float, v: Float) -> Float:
    """Directions [6, ..., 3] of face coordinates."""
    faces = []
    for k in range(3):
        for sign in (1.0, -1.0):
            parts = {k: np.full_like(u, sign), (k + 1) % 3: u, (k + 2) % 3: v}
            faces.append(np.stack([parts[i] for i in range(3)], -1))
    return np.stack(faces)


def _directory(
    camera: Camera, position: Callable[[Float], Float]
) -> tuple[NDArray[np.float32], float, float]:
    """``directory``, ``slack`` and ``bend`` of LensTables."""
    edge = np.linspace(-1, 1, CELLS + 1)
    u, v = np.meshgrid(edge, edge, indexing="ij")
    by_u = (position(_faces(u + STEP, v)) - position(_faces(u - STEP, v))) / (2 * STEP)
    by_v = (position(_faces(u, v + STEP)) - position(_faces(u, v - STEP))) / (2 * STEP)
    slopes = np.stack([by_u[..., 0], by_v[..., 0], by_u[..., 1], by_v[..., 1]], -1)
    known = np.concatenate([position(_faces(u, v)), slopes], -1)
    bends, slacks = _precision(camera, position, known)
    around = [_largest_around(cells, reach) for cells, reach in ((bends, STEADY), (slacks, 0.0))]
    table = np.concatenate([known, np.stack(around, -1)], -1)
    return np.ascontiguousarray(table, np.float32), float(slacks.max()), float(bends.max())


def _precision(
    camera: Camera, position: Callable[[Float], Float], known: Float
) -> tuple[Float, Float]:
    """Relative slope change over each cell [6, CELLS, CELLS], and interpolation error [px].

    Estimated at cell centres; outside the image limited to the maximum inside.
    """
    middle = (np.arange(CELLS) + 0.5) * (2 / CELLS) - 1
    u, v = np.meshgrid(middle, middle, indexing="ij")
    corners = [known[:, i : i + CELLS, j : j + CELLS] for i in (0, 1) for j in (0, 1)]
    exact = position(_faces(u, v))
    on_image = ((exact > -32) & (exact < [camera.width + 32, camera.height + 32])).all(-1)
    off = np.abs(sum(corner[..., :2] for corner in corners) / 4 - exact).max(-1)
    slopes = [corner[..., 2:] for corner in corners]
    scale = np.maximum(np.linalg.norm(sum(slopes) / 4, axis=-1), 1e-9)
    change = [np.linalg.norm(one - slopes[0], axis=-1) / scale for one in slopes[1:]]
    bend = np.maximum.reduce(change) / (2 / CELLS)
    slack = 2 * off + 0.02
    return tuple(np.minimum(values, values[on_image].max(initial=0.0)) for values in (bend, slack))


def _largest_around(cells: Float, reach: float) -> Float:
    """Maximum over the cells within ``reach`` of each node, [6, CELLS + 1, CELLS + 1]."""
    size = 2 * (round(reach * CELLS / 2) + 1)
    padded = np.pad(cells, ((0, 0), *((size // 2, size // 2),) * 2), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (size, size), axis=(1, 2))
    largest: Float = windows.max((-2, -1))
    return largest


# Background pixels that show the ground

TOLERANCE = 0.15
"""Points nearer to the ground height than this count as ground [m]."""


def back_projected(
    depth: NDArray[np.float32], K: Float, T_world_camera: Float
) -> NDArray[np.float32]:
    """World points [H, W, 3] [m] of a depth image [H, W] along the camera z axis [m]."""
    height, width = depth.shape
    x = (np.arange(width) + 0.5 - K[0, 2]) / K[0, 0]
    y = (np.arange(height) + 0.5 - K[1, 2]) / K[1, 1]
    points = np.empty((height, width, 3), np.float32)
    for axis, (right, down, ahead, shift) in enumerate(T_world_camera[:3]):
        across, along = (x * right + ahead).astype(np.float32), (y * down).astype(np.float32)
        points[..., axis] = (across + along[:, None]) * depth + np.float32(shift)
    return points


def with_ground(
    semantic: NDArray[np.uint8],
    depth: NDArray[np.float32],
    camera: Camera,
    T_world_camera: Float,
    ground: Ground,
) -> NDArray[np.uint8]:
    """The semantic image [H, W] with a separate ground class, for any camera or lens.

    Args:
        semantic: [H, W], with the ground as ``static``.
        depth: [H, W] median depth of the same pass, as defined by the camera's lens [m].
        camera: the camera.
        T_world_camera: [4, 4] pose at mid-readout.
        ground: ground of the scene.
    """
    found = semantic.copy()
    rows, columns = np.nonzero((semantic == STATIC) & (depth > 0))
    points = _rays(camera, rows, columns) * depth[rows, columns, None]
    turn = T_world_camera[:3, :3].astype(np.float32)
    shown = points @ turn.T + T_world_camera[:3, 3].astype(np.float32)
    near = np.abs(shown[:, 2] - ground.height_at(shown[:, :2])) < TOLERANCE
    found[rows[near], columns[near]] = GROUND
    return found


def _rays(camera: Camera, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> NDArray[np.float32]:
    """Rays of pixels [P, 3], camera frame, scaled to unit depth."""
    if camera.is_pinhole:
        K = camera.K
        x, y = (columns + 0.5 - K[0, 2]) / K[0, 0], (rows + 0.5 - K[1, 2]) / K[1, 1]
        return np.stack([x, y, np.ones(len(x))], axis=-1).astype(np.float32)
    rays: NDArray[np.float32] = tables_of(camera).rays[rows, columns]
    if camera.lens is None or camera.lens.perspective:
        rays = (rays / np.maximum(rays[:, 2:], 1e-6)).astype(np.float32)
    return rays
