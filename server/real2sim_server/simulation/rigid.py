"""Rigid motion, and the two handovers between it and deformation."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..geometry.rotation import Float


def rotation_of(vector: Float) -> Float:
    """Rotation matrix [3, 3] of a rotation vector [3] [rad] (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    k = cross_matrix(vector / angle)
    rotation: Float = np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * (k @ k)
    return rotation


def cross_matrix(vector: Float) -> Float:
    """[3, 3] matrix of the cross product with ``vector`` [3] from the left."""
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


@dataclass(frozen=True, eq=False)
class RigidMotion:
    """A body that keeps its shape.

    Attributes:
        rotation: [3, 3], object to world.
        centre: [3] centre of mass in the world [m].
        velocity: [3] of the centre of mass [m/s].
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
        """[3, 3] about the centre of mass, world axes [kg m^2]."""
        return self.rotation @ self.inertia @ self.rotation.T

    @property
    def momentum(self) -> Float:
        """[3] [kg m/s]."""
        return self.mass * self.velocity

    @property
    def angular_momentum(self) -> Float:
        """[3] about the centre of mass [kg m^2/s]."""
        return self.world_inertia @ self.angular_velocity

    @property
    def kinetic(self) -> float:
        """Energy of motion [J]."""
        turning = self.angular_velocity @ self.angular_momentum
        return float(self.mass * self.velocity @ self.velocity + turning) / 2

    def velocity_at(self, point: Float) -> Float:
        """[3] of the body at a point of the world [m/s]."""
        return self.velocity + np.cross(self.angular_velocity, point - self.centre)

    def with_impulse(self, impulse: Float, point: Float) -> RigidMotion:
        """After an impulse [3] [N s] at a point [3] of the world."""
        turn = np.cross(point - self.centre, impulse)
        return replace(
            self,
            velocity=self.velocity + impulse / self.mass,
            angular_velocity=self.angular_velocity + np.linalg.solve(self.world_inertia, turn),
        )

    def with_gravity(self, duration: float, gravity: Float) -> RigidMotion:
        """With the velocity that gravity [3] adds in ``duration`` [s], not yet moved."""
        return replace(self, velocity=self.velocity + duration * gravity)

    def advanced(self, duration: float) -> RigidMotion:
        """``duration`` [s] later at these velocities; angular momentum stays.

        After :meth:`with_gravity` this is symplectic Euler, like the solver's.
        """
        momentum = self.angular_momentum
        turned = rotation_of(duration * self.angular_velocity) @ self.rotation
        # Rounding must not add up to a skewed frame.
        left, _, right = np.linalg.svd(turned)
        moved = replace(self, rotation=left @ right, centre=self.centre + duration * self.velocity)
        turning = np.linalg.solve(moved.world_inertia, momentum).astype(np.float64, copy=False)
        return replace(moved, angular_velocity=turning)


def inertia_about(centre: Float, positions: Float, masses: Float, volumes: Float) -> Float:
    """[3, 3] inertia of particles about ``centre`` [kg m^2]; each counts as a small cube.

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
    """What the grid adds to the inertia of particles about any axis [kg m^2].

    A particle's velocity gradient carries angular momentum m dx^2/4 axial(C), which is m dx^2/2
    times its turning (Jiang et al. 2015, APIC), as if it were a ball that wide.

    Args:
        masses, volumes: [N] [kg], [m^3].
        cell: dx of the solver's grid [m].
    """
    return float(masses.sum()) * cell**2 / 2 - float(masses @ np.cbrt(volumes) ** 2) / 6


def best_rotation(rest: Float, now: Float, masses: Float) -> Float:
    """[3, 3] mass-weighted rotation that takes ``rest`` [N, 3] nearest to ``now`` (Kabsch 1976).

    Both about their own centres of mass.
    """
    a = rest - masses @ rest / masses.sum()
    b = now - masses @ now / masses.sum()
    left, _, right = np.linalg.svd(np.einsum("n,ni,nj->ij", masses, b, a))
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    rotation: Float = left @ flip @ right
    return rotation
