"""The reference backend: plain torch, float64, one thread's worth of speed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from ....geometry.rotation import Float
from ...colliders import Collider
from ...constitutive import material_row
from ..base import TOTALS, Measure, Model, ParticleArrays, SolverDiverged
from .step import NodeContact, TorchParameters, TorchState, substep, with_stress
from .stress import wave_hardening


class ReferenceSolverBackend:
    """Solver to compare others with, and to differentiate; see ``step.substep``."""

    name = "reference"

    def start(self, model: Model, colliders: Sequence[Collider]) -> ReferenceSimulation:
        """Load a model; it always works in float64."""
        return ReferenceSimulation(model, colliders)


def torch_model(model: Model) -> tuple[TorchState, TorchParameters]:
    """A model as tensors: where a differentiable rollout starts."""
    start = model.start
    table = torch.from_numpy(model.table)
    params = TorchParameters(
        mass=torch.from_numpy(model.masses),
        volume=torch.from_numpy(model.volumes),
        rows=table[torch.from_numpy(model.material)],
        body=torch.from_numpy(model.body),
        friction=torch.from_numpy(model.friction),
        dx=model.dx,
        gravity=torch.from_numpy(model.gravity),
    )
    n = len(start.positions)
    state = TorchState(
        x=torch.from_numpy(start.positions),
        v=torch.from_numpy(start.velocities),
        L=torch.from_numpy(start.gradients),
        F=torch.from_numpy(start.F_elastic),
        F_total=torch.from_numpy(start.F_total),
        tau=torch.zeros(n, 3, 3, dtype=torch.float64),
        energy=torch.zeros(n, dtype=torch.float64),
        history=torch.from_numpy(start.history),
    )
    return with_stress(state, params), params


class ReferenceSimulation:
    """A model in motion; every substep makes a new state."""

    def __init__(self, model: Model, colliders: Sequence[Collider]) -> None:
        self._model = model
        self._state, self._params = torch_model(model)
        bodies = model.bodies
        self._by_collider = np.zeros((bodies, len(colliders), TOTALS))
        self._by_body = np.zeros((bodies, bodies, TOTALS))

    def advance(self, steps: int, dt: float, colliders: Sequence[Collider]) -> None:
        """Make ``steps`` substeps."""
        with torch.no_grad():
            for step in range(steps):
                if not torch.isfinite(self._state.x).all():
                    raise SolverDiverged
                now = [c.after(step * dt) for c in colliders]
                self._state, contacts = substep(self._state, self._params, now, dt)
                for contact in contacts:
                    self._record(contact)

    def _record(self, contact: NodeContact) -> None:
        totals = self._by_body if contact.by_body else self._by_collider
        moment = torch.linalg.cross(contact.at, contact.impulse)
        fraction = 0.5 if contact.by_body else 1.0
        friction_work = -fraction * (contact.impulse * contact.slip).sum()
        work = (contact.impulse * contact.velocity).sum()
        row = torch.cat([contact.impulse.sum(0), moment.sum(0), torch.stack([friction_work, work])])
        totals[contact.body, contact.other] += row.numpy()

    def measure(self) -> Measure:
        """Sums over each body."""
        s, r = self._state, self._params
        D = self._model.dx**2 / 4
        axial = torch.stack(
            [
                s.L[:, 2, 1] - s.L[:, 1, 2],
                s.L[:, 0, 2] - s.L[:, 2, 0],
                s.L[:, 1, 0] - s.L[:, 0, 1],
            ],
            dim=1,
        )
        m = r.mass[:, None]
        kinetic = r.mass / 2 * (s.v.square().sum(1) + D * s.L.square().sum((1, 2)))
        mass = self._sum(r.mass)
        J = torch.linalg.det(s.F)
        stiffening = torch.maximum(s.F.square().sum((1, 2)) / 3, 1 / J.clamp(min=1e-2))
        modulus = (r.rows[:, material_row.LAMBDA] + 2 * r.rows[:, material_row.MU]) * stiffening
        modulus = modulus * wave_hardening(s.history, r.rows)
        return Measure(
            mass=mass,
            centre=self._sum(m * s.x) / mass[:, None],
            momentum=self._sum(m * s.v),
            angular_momentum=self._sum(m * (torch.linalg.cross(s.x, s.v) + D * axial)),
            kinetic=self._sum(kinetic),
            elastic=self._sum(r.volume * s.energy),
            max_speed=float(s.v.norm(dim=1).max()),
            max_wave_speed=float((modulus * r.volume / r.mass).max().sqrt()),
            min_volume_ratio=float(J.min()),
        )

    def _sum(self, values: torch.Tensor) -> Float:
        shape = (self._model.bodies, *values.shape[1:])
        total = torch.zeros(shape, dtype=torch.float64)
        return total.index_add(0, self._params.body, values).numpy()

    def particles(self) -> ParticleArrays:
        """A copy of the state."""
        s = self._state
        arrays = (s.x, s.v, s.L, s.F, s.F_total, s.history)
        return ParticleArrays(*(a.detach().numpy().copy() for a in arrays))

    def contacts(self) -> tuple[Float, Float]:
        """Totals since the start."""
        return self._by_collider.copy(), self._by_body.copy()

    def save(self) -> Any:
        """The state; it is never written to."""
        return self._state, self._by_collider.copy(), self._by_body.copy()

    def restore(self, saved: Any) -> None:
        """Go back."""
        self._state = saved[0]
        self._by_collider, self._by_body = saved[1].copy(), saved[2].copy()
