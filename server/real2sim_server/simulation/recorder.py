"""Frames of a simulation as they are made."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..geometry.rotation import Float, matrix_to_quaternion
from ..physics.colliders import Collider
from .body import BodyMode, DeformableBody
from .contacts import energies
from .result import ObjectResult, SimulationResult
from .simulator import HybridSimulator


class TrajectoryRecorder:
    """Keeps trajectories, shapes, energies and contacts, frame by frame.

    Args:
        simulator: whose bodies are recorded; it is only read.
    """

    def __init__(self, simulator: HybridSimulator) -> None:
        self._simulator = simulator
        self._times: list[float] = []
        self._energies: list[list[float]] = []
        self._impulses: list[dict[tuple[str, str], Float]] = []
        self._rows: dict[str, list[tuple[Float, Float, Float, Float, int, int, Float]]] = {
            b.name: [] for b in simulator.bodies
        }
        self._shapes: dict[str, list[np.ndarray]] = {b.name: [] for b in simulator.bodies}
        self._start = 0.0

    def record(self, time: float) -> None:
        """Record the present state as the frame of ``time`` [s]."""
        s = self._simulator
        kinetic, elastic, potential = energies(s.bodies, s.gravity)
        total = kinetic + elastic + potential
        if not self._times:
            self._start = total
        log = s.contact_log
        dissipated = self._start + log.collider_work - log.friction_work - total
        self._energies.append(
            [kinetic, elastic, potential, log.friction_work, log.collider_work, dissipated]
        )
        self._times.append(time)
        self._impulses.append(s.contact_log.totals())
        for body in s.bodies:
            pose, m = body.T_world_object, body.motion
            self._rows[body.name].append(
                (
                    pose[:3, 3],
                    matrix_to_quaternion(pose[:3, :3]),
                    m.velocity,
                    m.angular_velocity,
                    body.mode,
                    self._shape(body),
                    _wheel_lifts(body, pose, s.road),
                )
            )

    def _shape(self, body: DeformableBody) -> int:
        """Row of the shape that the body has now; a new one only when it has changed."""
        rows = self._shapes[body.name]
        moved = (body.local_positions() - body.rest.positions).astype(np.float16)
        if not rows and not moved.any():
            return -1
        if not rows or (body.mode == BodyMode.DEFORMING or not np.array_equal(rows[-1], moved)):
            rows.append(moved)
        return len(rows) - 1

    def result(self, start_us: int, stopped: str, figures: Mapping[str, Any]) -> SimulationResult:
        """Everything recorded so far."""
        s = self._simulator
        objects = {b.name: self._object(b) for b in s.bodies}
        masses = {b.name: b.motion.mass for b in s.bodies}
        contacts = s.contact_log.records(masses, s.gravity)
        impulses = np.zeros((len(self._times), len(contacts), 3))
        for f, totals in enumerate(self._impulses):
            for c, contact in enumerate(contacts):
                impulses[f, c] = totals.get((contact.object_id, contact.other), np.zeros(3))
        return SimulationResult(
            objects,
            np.array(self._times),
            start_us,
            np.array(self._energies),
            contacts,
            impulses,
            stopped,
            figures,
        )

    def _object(self, body: DeformableBody) -> ObjectResult:
        positions, quaternions, velocities, spins, modes, index, lifts = zip(
            *self._rows[body.name], strict=True
        )
        n = len(body.rest)
        wheels = np.zeros((0, 3)) if body.tyres is None else body.tyres.patches
        return ObjectResult(
            object_id=body.name,
            mass=body.motion.mass,
            spacing=body.spacing,
            rest=body.rest.positions.astype(np.float32),
            positions=np.array(positions),
            quaternions=np.array(quaternions),
            velocities=np.array(velocities),
            angular_velocities=np.array(spins),
            modes=np.array(modes, dtype=np.uint8),
            shape_index=np.array(index, dtype=np.int32),
            shapes=np.array(self._shapes[body.name], dtype=np.float16).reshape(-1, n, 3),
            wheels=wheels.astype(np.float32),
            wheel_lifts=np.array(lifts, dtype=np.float32).reshape(len(positions), len(wheels)),
        )


def _wheel_lifts(body: DeformableBody, pose: Float, road: Sequence[Collider]) -> Float:
    return np.zeros(0) if body.tyres is None else body.tyres.lifts(pose, road)
