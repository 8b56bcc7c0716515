"""Rigid motion, conversion to and from deforming bodies, and distances to colliders."""

# Kernels take arrays by position: Numba has no keyword-only arguments.
# ruff: noqa: PLR0917

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .._numba import kernel
from ..geometry import Float
from ..physics.colliders import Box, Collider, HeightField, Plane, Solid
from ..physics.contact import collider_distance, collider_velocity
from ..physics.model import pack_colliders


def rotation_of(vector: Float) -> Float:
    """Rotation matrix [3, 3] of a rotation vector [3] [rad] (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    k = cross_matrix(vector / angle)
    rotation: Float = np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * (k @ k)
    return rotation


def cross_matrix(vector: Float) -> Float:
    """[3, 3] matrix of the cross product of ``vector`` [3] with a vector on its right."""
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


@dataclass(frozen=True, eq=False)
class RigidMotion:
    """A rigid body in motion.

    Attributes:
        rotation: [3, 3], object to world.
        centre: [3] centre of mass in the world [m].
        velocity: [3] velocity of the centre of mass [m/s].
        angular_velocity: [3] world axes [rad/s].
        mass: [kg].
        inertia: [3, 3] about the centre of mass, object axes [kg m^2].
    """

    rotation: Float
    centre: Float
    velocity: Float
    angular_velocity: Float
    mass: float
    inertia: Float

    @property
    def world_inertia(self) -> Float:
        """[3, 3] inertia about the centre of mass, world axes [kg m^2]."""
        return self.rotation @ self.inertia @ self.rotation.T

    @property
    def momentum(self) -> Float:
        """[3] linear momentum [kg m/s]."""
        return self.mass * self.velocity

    @property
    def angular_momentum(self) -> Float:
        """[3] angular momentum about the centre of mass [kg m^2/s]."""
        return self.world_inertia @ self.angular_velocity

    @property
    def kinetic(self) -> float:
        """Kinetic energy [J]."""
        turning = self.angular_velocity @ self.angular_momentum
        return float(self.mass * self.velocity @ self.velocity + turning) / 2

    def velocity_at(self, point: Float) -> Float:
        """[3] velocity of the body at a world point [m/s]."""
        return self.velocity + np.cross(self.angular_velocity, point - self.centre)

    def with_impulse(self, impulse: Float, point: Float) -> RigidMotion:
        """The motion after an impulse [3] [N s] at a world point [3]."""
        turn = np.cross(point - self.centre, impulse)
        return replace(
            self,
            velocity=self.velocity + impulse / self.mass,
            angular_velocity=self.angular_velocity + np.linalg.solve(self.world_inertia, turn),
        )

    def with_gravity(self, duration: float, gravity: Float) -> RigidMotion:
        """The motion with the velocity change by gravity [3] in ``duration`` [s], not yet moved."""
        return replace(self, velocity=self.velocity + duration * gravity)

    def advanced(self, duration: float) -> RigidMotion:
        """The motion ``duration`` [s] later; conserves angular momentum.

        After :meth:`with_gravity` this is symplectic Euler, like the solver.
        """
        momentum = self.angular_momentum
        turned = rotation_of(duration * self.angular_velocity) @ self.rotation
        # Keeps rounding errors from skewing the rotation.
        left, _, right = np.linalg.svd(turned)
        moved = replace(self, rotation=left @ right, centre=self.centre + duration * self.velocity)
        turning = np.linalg.solve(moved.world_inertia, momentum).astype(np.float64, copy=False)
        return replace(moved, angular_velocity=turning)


def inertia_about(centre: Float, positions: Float, masses: Float, volumes: Float) -> Float:
    """[3, 3] inertia of particles about ``centre`` [kg m^2]; each particle is a small cube.

    Args:
        centre: [3] [m].
        positions, masses, volumes: [N, 3] [m], [N] [kg], [N] [m^3].
    """
    r = positions - centre
    second = np.einsum("n,ni,nj->ij", masses, r, r)
    own = float(masses @ np.cbrt(volumes) ** 2) / 6
    inertia: Float = (np.trace(second) + own) * np.eye(3) - second
    return inertia


def added_inertia(masses: Float, volumes: Float, *, cell: float) -> float:
    """Inertia that the grid adds to particles about any axis [kg m^2].

    A particle's velocity gradient carries angular momentum m dx^2/4 axial(C), which is m dx^2/2
    times its angular velocity (Jiang et al. 2015, APIC).

    Args:
        masses, volumes: [N] [kg], [m^3].
        cell: cell size dx of the solver grid [m].
    """
    return float(masses.sum()) * cell**2 / 2 - float(masses @ np.cbrt(volumes) ** 2) / 6


def best_rotation(rest: Float, now: Float, masses: Float) -> Float:
    """[3, 3] mass-weighted best-fit rotation from ``rest`` [N, 3] to ``now`` (Kabsch 1976).

    Positions are relative to the centres of mass of each set.
    """
    a = rest - masses @ rest / masses.sum()
    b = now - masses @ now / masses.sum()
    left, _, right = np.linalg.svd(np.einsum("n,ni,nj->ij", masses, b, a))
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    rotation: Float = left @ flip @ right
    return rotation


# Distances from many points to colliders.


@functools.lru_cache(maxsize=64)
def packed(colliders: tuple[Collider, ...]) -> tuple[Float, Float]:
    """Rows and heights of colliders in kernel form, cached for the same colliders."""
    return pack_colliders(colliders, 0.0)


def closest(
    points: Float,
    motion: RigidMotion,
    colliders: Sequence[Collider],
    *,
    within: float,
    ahead: float,
) -> tuple[float, float, bool]:
    """Closest distances of a rigid body's points to colliders, which may move.

    Args:
        points: [N, 3] points of the body, world frame [m].
        motion: motion of the body.
        colliders: current colliders.
        within: [m].
        ahead: [s].

    Returns:
        Smallest distance [m], infinite without colliders; closing speed at that point [m/s]; and
        whether any approaching point will be ``within`` of a collider in the time ``ahead``.
    """
    if not colliders:
        return math.inf, 0.0, False
    rows, heights = packed(tuple(colliders))
    found: tuple[float, float, bool] = _closest(
        points,
        motion.centre,
        motion.velocity,
        motion.angular_velocity,
        rows,
        heights,
        within,
        ahead,
    )
    return found


@kernel
def _closest(
    points: Any, centre: Any, velocity: Any, spin: Any, rows: Any, heights: Any, within: Any,
    ahead: Any,
) -> Any:  # fmt: skip
    least, closing, meets = math.inf, 0.0, False
    for k in range(len(points)):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        ax, ay, az = x - centre[0], y - centre[1], z - centre[2]
        vx = velocity[0] + spin[1] * az - spin[2] * ay
        vy = velocity[1] + spin[2] * ax - spin[0] * az
        vz = velocity[2] + spin[0] * ay - spin[1] * ax
        for c in range(len(rows)):
            distance, n = collider_distance(rows[c], heights, x, y, z)
            u = collider_velocity(rows[c], x, y, z)
            approach = (u[0] - vx) * n[0] + (u[1] - vy) * n[1] + (u[2] - vz) * n[2]
            if distance < least:
                least, closing = distance, approach
            if approach > 0.0 and distance < within + approach * ahead:
                meets = True
    return least, closing, meets


def solid_gaps(pose: Float, size: Float, solids: Sequence[Solid]) -> tuple[Float, Float]:
    """Lower bounds of solids' distances to an oriented box, and upper bounds of their speeds.

    Args:
        pose: [4, 4] pose of the box.
        size: [3] size of the box [m].
        solids: K solids.

    Returns:
        [K] lower bounds of the distance along the face normals of the bounding boxes [m], negative
        for possible overlaps; and [K] upper bounds of the point speeds [m/s].
    """
    centres, turns, halves, speeds = _boxes_about(tuple(solids))
    between = np.abs((turns @ (pose[:3, 3] - centres)[:, :, None])[:, :, 0])
    reach = np.abs(turns @ pose[:3, :3]) @ (size / 2)
    gaps: Float = (between - halves - reach).max(axis=1)
    return gaps, speeds


@functools.lru_cache(maxsize=64)
def _boxes_about(solids: tuple[Solid, ...]) -> tuple[Float, Float, Float, Float]:
    """Centres [K, 3], rotations box from world [K, 3, 3], halves of sizes [K, 3], speeds [K]."""
    poses = np.array([s.pose for s in solids])
    bounds = np.array([s.bounds for s in solids])
    speeds = np.array([s.fastest_point for s in solids])
    halves = (bounds[:, 1] - bounds[:, 0]) / 2
    middles = (bounds[:, 0] + bounds[:, 1]) / 2
    centres = poses[:, :3, 3] + (poses[:, :3, :3] @ middles[:, :, None])[:, :, 0]
    return centres, poses[:, :3, :3].transpose(0, 2, 1), halves, speeds


def clearance(collider: Collider, points: Float) -> tuple[Float, Float]:
    """Signed distances [N] [m] of points [N, 3] to a collider, and unit normals [N, 3] out of it.

    A height field measures along the normal under the point, as the solver does.
    """
    if isinstance(collider, Plane):
        normal = np.asarray(collider.normal)
        return (points - np.asarray(collider.point)) @ normal, np.tile(normal, (len(points), 1))
    if isinstance(collider, Box):
        return _box(collider, points)
    if isinstance(collider, HeightField):
        return _heights(collider, points)
    if isinstance(collider, Solid):
        rows, data = packed((collider,))
        distances, normals = np.empty(len(points)), np.empty((len(points), 3))
        _clearances(rows[0], data, np.ascontiguousarray(points), distances, normals)
        return distances, normals
    raise TypeError(f"unknown collider {type(collider).__name__}")


@kernel
def _clearances(row: Any, data: Any, points: Any, distances: Any, normals: Any) -> None:
    for k in range(len(points)):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        distance, n = collider_distance(row, data, x, y, z)
        distances[k] = distance
        normals[k, 0], normals[k, 1], normals[k, 2] = n


def nearest(colliders: Sequence[Collider], points: Float) -> tuple[Float, Float]:
    """Like :func:`clearance`, for the nearest of several colliders; infinite without colliders."""
    best = np.full(len(points), np.inf)
    normals = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    for collider in colliders:
        distance, normal = clearance(collider, points)
        nearer = distance < best
        best = np.where(nearer, distance, best)
        normals = np.where(nearer[:, None], normal, normals)
    return best, normals


def _box(box: Box, points: Float) -> tuple[Float, Float]:
    pose = np.asarray(box.T_world_box)
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    over = np.abs(local) - np.asarray(box.size) / 2
    outside = np.maximum(over, 0)
    length = np.linalg.norm(outside, axis=1)
    deepest = over.argmax(axis=1)
    face = np.eye(3)[deepest]
    normal = np.where(length[:, None] > 0, outside / np.maximum(length, 1e-12)[:, None], face)
    normal = normal * np.where(local < 0, -1.0, 1.0)
    return np.where(length > 0, length, over.max(axis=1)), normal @ pose[:3, :3].T


def _heights(field: HeightField, points: Float) -> tuple[Float, Float]:
    h = field.heights
    last = np.array(h.shape) - 1
    place = (points[:, :2] - np.asarray(field.origin)) / field.spacing
    place = np.clip(place, 0, last)
    low = np.minimum(place.astype(np.int64), last - 1)
    a, b = (place - low).T
    i, j = low.T
    slope_x = ((h[i + 1, j] - h[i, j]) * (1 - b) + (h[i + 1, j + 1] - h[i, j + 1]) * b) / (
        field.spacing
    )
    slope_y = ((h[i, j + 1] - h[i, j]) * (1 - a) + (h[i + 1, j + 1] - h[i + 1, j]) * a) / (
        field.spacing
    )
    height = (h[i, j] * (1 - a) + h[i + 1, j] * a) * (1 - b)
    height += (h[i, j + 1] * (1 - a) + h[i + 1, j + 1] * a) * b
    up = 1 / np.sqrt(slope_x**2 + slope_y**2 + 1)
    normals = np.stack([-slope_x * up, -slope_y * up, up], axis=1)
    return (points[:, 2] - height) * up, normals
