"""Frames of a simulation as they are made."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..geometry.rotation import Float, matrix_to_quaternion
from ..physics.colliders import Collider
from .body import DEFORMING, DeformableBody
from .contacts import energies
from .result import ObjectResult, SimulationResult
from .simulator import HybridSimulator


class TrajectoryRecorder:
    """Frames as they are made."""

    def __init__(self, stage: HybridSimulator) -> None:
        self._stage = stage
        self._times: list[float] = []
        self._energies: list[list[float]] = []
        self._impulses: list[dict[tuple[str, str], Float]] = []
        self._rows: dict[str, list[tuple[Float, Float, Float, Float, int, int, Float]]] = {
            a.name: [] for a in stage.actors
        }
        self._shapes: dict[str, list[np.ndarray]] = {a.name: [] for a in stage.actors}
        self._start = 0.0

    def keep(self, time: float) -> None:
        """Keep the present state as the frame of ``time`` [s]."""
        s = self._stage
        kinetic, elastic, potential = energies(s.actors, s.gravity)
        total = kinetic + elastic + potential
        if not self._times:
            self._start = total
        gone = self._start + s.ledger.collider_work - s.ledger.heat - total
        self._energies.append(
            [kinetic, elastic, potential, s.ledger.heat, s.ledger.collider_work, gone]
        )
        self._times.append(time)
        self._impulses.append(s.ledger.totals())
        for actor in s.actors:
            pose, m = actor.T_world_object, actor.motion
            self._rows[actor.name].append(
                (
                    pose[:3, 3],
                    matrix_to_quaternion(pose[:3, :3]),
                    m.velocity,
                    m.angular_velocity,
                    actor.mode,
                    self._shape(actor),
                    _lifts(actor, pose, s.road),
                )
            )

    def _shape(self, actor: DeformableBody) -> int:
        """Row of the shape that the actor has now; a new one only when it has changed."""
        rows = self._shapes[actor.name]
        moved = (actor.local_positions() - actor.rest.positions).astype(np.float16)
        if not rows and not moved.any():
            return -1
        if not rows or (actor.mode == DEFORMING or not np.array_equal(rows[-1], moved)):
            rows.append(moved)
        return len(rows) - 1

    def result(self, start_us: int, stopped: str, figures: Mapping[str, Any]) -> SimulationResult:
        """Everything kept so far."""
        s = self._stage
        objects = {a.name: self._object(a) for a in s.actors}
        contacts = s.ledger.records({a.name: a.motion.mass for a in s.actors})
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

    def _object(self, actor: DeformableBody) -> ObjectResult:
        places, turns, speeds, spins, modes, index, lifts = zip(
            *self._rows[actor.name], strict=True
        )
        n = len(actor.rest)
        wheels = np.zeros((0, 3)) if actor.tyres is None else actor.tyres.patches
        return ObjectResult(
            object_id=actor.name,
            mass=actor.motion.mass,
            spacing=actor.spacing,
            rest=actor.rest.positions.astype(np.float32),
            positions=np.array(places),
            quaternions=np.array(turns),
            velocities=np.array(speeds),
            angular_velocities=np.array(spins),
            modes=np.array(modes, dtype=np.uint8),
            shape_index=np.array(index, dtype=np.int32),
            shapes=np.array(self._shapes[actor.name], dtype=np.float16).reshape(-1, n, 3),
            wheels=wheels.astype(np.float32),
            wheel_lifts=np.array(lifts, dtype=np.float32).reshape(len(places), len(wheels)),
        )


def _lifts(actor: DeformableBody, pose: Float, road: Sequence[Collider]) -> Float:
    return np.zeros(0) if actor.tyres is None else actor.tyres.lifts(pose, road)
