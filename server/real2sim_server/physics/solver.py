"""The solver: time integration with an adaptive time step and rollback of diverged substeps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..geometry import Float
from . import stress
from .backends import Measure, Model, ParticleArrays, Simulation, select_backend
from .body import Body
from .colliders import Collider
from .errors import PhysicsError, SolverError, UnstableError
from .model import SolverDiverged, build_model

CHECK_INTERVAL = 16
"""Substeps between two checks for energy and finite numbers."""
VISCOUS_STEP = 0.2
"""dt <= VISCOUS_STEP rho dx^2 / eta keeps explicit viscosity stable."""
ENERGY_SLACK = 0.01
"""Maximum relative increase of kinetic plus stored energy before a rollback."""
DT_SCALE_MIN = 2.0**-12
"""Minimum fraction of the stable substep before the solver gives up."""


@dataclass(frozen=True)
class SolverOptions:
    """Options of a solver.

    Attributes:
        dx: cell size [m]; None for twice the particle spacing of the coarsest body.
        gravity: [3] [m/s^2].
        backend: ``cpu``, ``cuda``, ``reference``, or ``auto``, which is ``cpu``.
        precision: ``single`` or ``double`` state; the reference is always double.
        cfl: fraction of a cell that the fastest wave may cross in a substep, in (0, 0.9].
        dt_max: longest substep [s].
        substeps_max: maximum number of substeps of a single ``step``; raises beyond.
    """

    dx: float | None = None
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    backend: str = "auto"
    precision: str = "single"
    cfl: float = 0.4
    dt_max: float = 0.02
    substeps_max: int = 2_000_000

    def __post_init__(self) -> None:
        if not 0 < self.cfl <= 0.9:
            raise SolverError(f"cfl must be in (0, 0.9], beyond which steps blow up: {self.cfl!r}")
        if not (math.isfinite(self.dt_max) and self.dt_max > 0):
            raise SolverError(f"dt_max must be positive [s], not {self.dt_max!r}")


@dataclass(frozen=True, eq=False)
class BodyState:
    """The current state of one body; world frame, float64, particles in the body's order.

    Attributes:
        positions, velocities: [N, 3] [m], [m/s].
        gradients: [N, 3, 3] velocity gradient [1/s].
        F_elastic: [N, 3, 3], determines stress.
        F_total: [N, 3, 3], total deformation since the start: covariances become F S F^T.
        history: [N] plastic memory.
        mass: [kg].
        centre: [3] centre of mass [m].
        momentum: [3] [kg m/s].
        angular_momentum: [3] about the centre of mass [kg m^2/s].
        kinetic, elastic: energies [J].
    """

    positions: Float
    velocities: Float
    gradients: Float
    F_elastic: Float
    F_total: Float
    history: Float
    mass: float
    centre: Float
    momentum: Float
    angular_momentum: Float
    kinetic: float
    elastic: float

    @property
    def velocity(self) -> Float:
        """[3] of the centre of mass [m/s]."""
        return self.momentum / self.mass


@dataclass(frozen=True, eq=False)
class ContactTotals:
    """Total effect of a collider or another body on one body since the start.

    Attributes:
        body, other: names.
        impulse: [3] impulse on ``body`` [N s]; divide by its mass for its delta-v.
        moment: [3] moment of the impulse about the world origin [N m s].
        friction_work: energy dissipated by friction [J]; between bodies each side counts half.
        work: work of ``other`` on ``body`` [J]; negative if it brakes ``body``.
    """

    body: str
    other: str
    impulse: Float
    moment: Float
    friction_work: float
    work: float


@dataclass(frozen=True)
class Energies:
    """Sums over all bodies [J].

    Attributes:
        kinetic, elastic, gravity: current energies; gravity is 0 at the world origin.
        friction_heat: energy dissipated by friction since the start.
        collider_work: work of moving colliders on bodies since the start.
        dissipated: energy lost since the start by viscous and plastic flow, inelastic contact and
            transfers between particles and grid.
    """

    kinetic: float
    elastic: float
    gravity: float
    friction_heat: float
    collider_work: float
    dissipated: float

    @property
    def total(self) -> float:
        """Kinetic, elastic and gravity together [J]."""
        return self.kinetic + self.elastic + self.gravity


@dataclass(eq=False)
class StepReport:
    """Report of a step.

    Attributes:
        substeps: number of accepted substeps.
        dt: last substep [s].
        rollbacks: number of rolled back blocks of substeps.
        reasons: reason of each rollback.
    """

    substeps: int = 0
    dt: float = 0.0
    rollbacks: int = 0
    reasons: list[str] = field(default_factory=list)


class Solver:
    """Solver for bodies and colliders: MLS-MPM with APIC on a sparse grid.

    Args:
        bodies: at least one body, with unique names.
        colliders: colliders with unique names.
        options: solver options.

    Raises:
        SolverError, ParticleError: if the input cannot be simulated, with the reason.
    """

    def __init__(
        self,
        bodies: Sequence[Body],
        colliders: Sequence[Collider] = (),
        options: SolverOptions | None = None,
    ) -> None:
        self.options = options or SolverOptions()
        self.bodies = tuple(bodies)
        self._colliders = list(colliders)
        names = [c.name for c in colliders]
        if len(set(names)) < len(names):
            raise SolverError(f"names of colliders must be unique, not {names}")
        o = self.options
        self.model: Model = build_model(bodies, dx=o.dx, gravity=o.gravity, precision=o.precision)
        backend = select_backend(o.backend)
        # Public for benchmarks and tests of single substeps. Only the solver updates time and time
        # step.
        self.simulation: Simulation = backend.start(self.model, self._colliders)
        self._viscous_dt = _viscous_limit(self.model)
        self._dt_scale = 1.0
        self.time = 0.0
        self._measure = self.simulation.measure()
        self._start_energy = self._mechanical(self._measure)

    @property
    def dx(self) -> float:
        """Cell size [m]."""
        return self.model.dx

    @property
    def colliders(self) -> tuple[Collider, ...]:
        """Colliders in their current poses."""
        return tuple(self._colliders)

    def step(self, duration: float) -> StepReport:
        """Advance by ``duration`` [s], in as many substeps as needed.

        After any error, the solver is at its last valid state.

        Raises:
            SolverError: if the duration is not positive or needs too many substeps.
            ParticleError: if particles leave the reach of the grid.
            UnstableError: if it diverges and smaller substeps do not help.
        """
        if not (math.isfinite(duration) and duration > 0):
            raise SolverError(f"duration of a step must be positive [s], not {duration!r}")
        wanted = duration / self.time_step()
        if wanted > self.options.substeps_max:
            raise SolverError(
                f"{duration} s would take {wanted:.3g} substeps of {self.time_step():.3g} s, more "
                f"than substeps_max {self.options.substeps_max}; the fastest particle moves at "
                f"{self._measure.max_speed:.3g} m/s and the fastest wave at "
                f"{self._measure.max_wave_speed:.3g} m/s: take larger cells or softer material"
            )
        report = StepReport()
        remaining = duration
        while remaining > 1e-9 * duration:
            left = math.ceil(remaining / self.time_step() - 1e-9)
            report.dt = remaining / left
            count = min(left, CHECK_INTERVAL)
            if self._attempt(count, report):
                remaining -= count * report.dt
                report.substeps += count
        return report

    def time_step(self) -> float:
        """Current longest stable substep [s], from waves, motion, viscosity and ``dt_scale``.

        The CFL limit also applies to motion relative to colliders.
        """
        m, o = self._measure, self.options
        speed = m.max_wave_speed + m.max_speed
        speed += max((c.fastest_point for c in self._colliders), default=0.0)
        return self._dt_scale * min(o.cfl * self.dx / speed, self._viscous_dt, o.dt_max)

    def state(self, name: str) -> BodyState:
        """State of the body with this name.

        Raises:
            SolverError: for an unknown name.
        """
        return self.states()[self._index(name)]

    def states(self) -> list[BodyState]:
        """All bodies, in order."""
        arrays, m = self.simulation.particles(), self._measure
        states = []
        for b in range(len(self.bodies)):
            own = self.model.body == b
            spin = m.angular_momentum[b] - np.cross(m.centre[b], m.momentum[b])
            states.append(
                BodyState(
                    arrays.positions[own],
                    arrays.velocities[own],
                    arrays.gradients[own],
                    arrays.F_elastic[own],
                    arrays.F_total[own],
                    arrays.history[own],
                    float(m.mass[b]),
                    m.centre[b],
                    m.momentum[b],
                    spin,
                    float(m.kinetic[b]),
                    float(m.elastic[b]),
                )
            )
        return states

    @property
    def measure(self) -> Measure:
        """Sums and bounds of the current state."""
        return self._measure

    def particles(self) -> ParticleArrays:
        """All particles, body after body."""
        return self.simulation.particles()

    @property
    def contacts(self) -> list[ContactTotals]:
        """Contact totals since the start, one entry per body and other."""
        by_collider, by_body = self.simulation.contacts()
        names = [b.name for b in self.bodies]
        found = []
        others = [c.name for c in self._colliders]
        for totals, labels in ((by_collider, others), (by_body, names)):
            for b, k in zip(*np.nonzero(totals.any(axis=2)), strict=True):
                row = totals[b, k]
                found.append(
                    ContactTotals(names[b], labels[k], row[:3], row[3:6], *row[6:].tolist())
                )
        return found

    def energies(self) -> Energies:
        """The energy balance: current energies and losses since the start."""
        m = self._measure
        heat, work = self._contact_energies()
        now = self._mechanical(m)
        return Energies(
            kinetic=float(m.kinetic.sum()),
            elastic=float(m.elastic.sum()),
            gravity=self._gravity_energy(m),
            friction_heat=heat,
            collider_work=work,
            dissipated=self._start_energy + work - heat - now,
        )

    def snapshot(self) -> Any:
        """The complete current state; for :meth:`restore` of this solver only."""
        return (
            self.simulation.save(),
            list(self._colliders),
            self.time,
            self._dt_scale,
            self._measure,
        )

    def restore(self, snapshot: Any) -> None:
        """Restore a snapshot; the simulation continues bitwise identically from there."""
        saved, colliders, self.time, self._dt_scale, self._measure = snapshot
        self._colliders = list(colliders)
        self.simulation.restore(saved)

    def _attempt(self, count: int, report: StepReport) -> bool:
        """Make ``count`` substeps; on instability, roll them back and halve the step."""
        before, saved = self._measure, self.simulation.save()
        work_before = self._contact_energies()[1]
        try:
            reason = self._advance(count, report.dt)
        except PhysicsError:
            self.simulation.restore(saved)
            self._measure = before
            raise
        if not reason:
            reason = self._instability(before, self._contact_energies()[1] - work_before)
        if not reason:
            self._colliders = [c.after(count * report.dt) for c in self._colliders]
            self.time += count * report.dt
            self._dt_scale = min(1.0, self._dt_scale * 1.1)
            return True
        self.simulation.restore(saved)
        self._measure = before
        self._dt_scale *= 0.5
        report.rollbacks += 1
        report.reasons.append(reason)
        if self._dt_scale < DT_SCALE_MIN:
            self._dt_scale = 1.0
            raise UnstableError(
                f"unstable at {self.time:.6f} s although substeps went down to {report.dt:.3g} s: "
                f"{reason}"
            )
        return False

    def _advance(self, count: int, dt: float) -> str:
        try:
            self.simulation.advance(count, dt, self._colliders)
            self._measure = self.simulation.measure()
        except SolverDiverged:
            return "particles left the grid"
        return ""

    def _instability(self, before: Measure, work: float) -> str:
        """Description of the instability of the current state; empty if stable."""
        m = self._measure
        if not m.finite:
            return "positions, velocities or stresses are not finite"
        rise = self._mechanical(m) - self._mechanical(before) - max(work, 0.0)
        live = float((before.kinetic + before.elastic).sum()) + abs(work)
        g = float(np.linalg.norm(self.model.gravity))
        # Rounding noise of single-precision sums when there is hardly any motion.
        noise = float(m.mass.sum()) * (1e-4 * g * self.dx + 1e-8)
        if rise > ENERGY_SLACK * live + noise:
            return f"energy rose by {rise:.3g} J from {live:.3g} J without cause"
        return ""

    def _mechanical(self, m: Measure) -> float:
        return float((m.kinetic + m.elastic).sum()) + self._gravity_energy(m)

    def _gravity_energy(self, m: Measure) -> float:
        return -float(m.mass @ (m.centre @ self.model.gravity))

    def _contact_energies(self) -> tuple[float, float]:
        """Friction heat, and work of moving colliders, since the start [J]."""
        by_collider, by_body = self.simulation.contacts()
        heat = by_collider[:, :, 6].sum() + by_body[:, :, 6].sum()
        return float(heat), float(by_collider[:, :, 7].sum())

    def _index(self, name: str) -> int:
        names = [b.name for b in self.bodies]
        if name not in names:
            raise SolverError(f"no body {name!r}; there are {names}")
        return names.index(name)


def _viscous_limit(model: Model) -> float:
    """Longest substep that Kelvin-Voigt damping allows [s]."""
    eta = model.table[model.material, stress.VISCOSITY]
    density = model.masses / model.volumes
    rate = float((eta / density).max()) / model.dx**2
    return VISCOUS_STEP / rate if rate > 0 else math.inf
