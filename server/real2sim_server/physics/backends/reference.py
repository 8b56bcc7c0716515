"""The reference backend: plain torch in float64, slow, simple and differentiable.

Other backends are tested against it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...geometry import Float
from .. import stress
from ..colliders import Collider, Solid
from ..contact import CRUSHED, FLAT_MOMENT, INSIDE, ON_FACE, OPPOSED, STICKS, SURFACE, THIN_MARGIN
from ..model import TOTALS, Measure, Model, ParticleArrays, SolverDiverged, is_thin
from .reference_laws import collider_distance, first_touch, stress_update, wave_hardening

# One substep as a pure function, with positional arguments as in the kernels.

# ruff: noqa: PLR0917


OFFSETS = torch.cartesian_prod(*[torch.arange(3)] * 3)
"""[27, 3] offsets of a particle's nodes from the first."""
SURFACE_TABLE = torch.from_numpy(SURFACE.astype(np.float64))
FLAT_TABLE = torch.from_numpy(FLAT_MOMENT.astype(np.float64))


@dataclass(frozen=True, eq=False)
class TorchState:
    """Particles; gradients flow through all of it.

    Attributes:
        x, v: [N, 3] float64 [m], [m/s].
        L: [N, 3, 3] velocity gradient [1/s].
        F, F_total: [N, 3, 3].
        tau: [N, 3, 3] Kirchhoff stress, viscosity included [Pa].
        energy: [N] stored energy per rest volume [J/m^3].
        history: [N].
    """

    x: Tensor
    v: Tensor
    L: Tensor
    F: Tensor
    F_total: Tensor
    tau: Tensor
    energy: Tensor
    history: Tensor


@dataclass(frozen=True, eq=False)
class TorchParameters:
    """Constants of a run; gradients flow to masses, rows, friction and gravity.

    Attributes:
        mass, volume: [N].
        rows: [N, MATERIAL_ROW] material row of each particle.
        body: [N] int64.
        friction: [B].
        dx: [m].
        gravity: [3].
    """

    mass: Tensor
    volume: Tensor
    rows: Tensor
    body: Tensor
    friction: Tensor
    dx: float
    gravity: Tensor


@dataclass(frozen=True, eq=False)
class NodeContact:
    """Effect of contact on a body's nodes in one substep.

    Attributes:
        body: index of the body.
        other: collider index, or body index if ``by_body``.
        at: [U, 3] nodes [m].
        impulse: [U, 3] [N s].
        slip: [U, 3] velocity relative to ``other`` after the contact [m/s].
        velocity: [U, 3] velocity of ``other`` [m/s].
    """

    body: int
    other: int
    by_body: bool
    at: Tensor
    impulse: Tensor
    slip: Tensor
    velocity: Tensor


def with_stress(state: TorchState, params: TorchParameters) -> TorchState:
    """The state with stress and energy computed from its deformation."""
    return _update_stress(state, params, state.x, state.v, state.L, state.F, state.F_total, 0.0)


def substep(
    state: TorchState, params: TorchParameters, colliders: Sequence[Collider], dt: float
) -> tuple[TorchState, list[NodeContact]]:
    """MLS-MPM with APIC (Hu et al. 2018), contact on separate velocity fields."""
    index, weights, arm, nodes = _stencil(state.x, params.dx)
    velocity, mass, moment = _to_grid(state, params, dt, index, weights, arm, len(nodes))
    velocity = velocity + dt * params.gravity
    contacts: list[NodeContact] = []
    velocity = _resolve_body_contact(velocity, mass, moment, nodes, params, contacts)
    velocity = _resolve_collider_contact(velocity, mass, moment, nodes, params, colliders, contacts)

    seen = velocity[params.body[:, None], index]
    v = (weights[:, :, None] * seen).sum(1)
    L = 4 / params.dx**2 * torch.einsum("nk,nki,nkj->nij", weights, seen, arm)
    v = _resolve_thin_colliders(state.x, v, params, colliders, dt, contacts)
    step = torch.eye(3, dtype=state.x.dtype) + dt * L
    moved = state.x + dt * v
    return (
        _update_stress(state, params, moved, v, L, step @ state.F, step @ state.F_total, dt),
        contacts,
    )


def _update_stress(
    state: TorchState,
    params: TorchParameters,
    x: Tensor,
    v: Tensor,
    L: Tensor,
    F: Tensor,
    F_total: Tensor,
    dt: float,
) -> TorchState:
    F, tau, energy, history = stress_update(F, state.history, params.rows, dt)
    eta = params.rows[:, stress.VISCOSITY] * torch.linalg.det(F)
    tau = tau + eta[:, None, None] * (L + L.mT)
    return TorchState(x, v, L, F, F_total, tau, energy, history)


def _stencil(x: Tensor, dx: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Node number [N, 27], weight [N, 27], arm x_i - x_p [N, 27, 3] and node positions [U, 3]."""
    base = torch.floor(x.detach() / dx - 0.5)
    f = x / dx - base
    w = torch.stack([0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2], dim=1)
    weights = torch.stack(
        [w[:, i, 0] * w[:, j, 1] * w[:, k, 2] for i, j, k in OFFSETS.tolist()], dim=1
    )
    cells = base.long()[:, None] + OFFSETS
    low = cells.amin((0, 1))
    span = cells.amax((0, 1)) - low + 1
    local = cells - low
    key = (local[..., 0] * span[1] + local[..., 1]) * span[2] + local[..., 2]
    keys, index = torch.unique(key, return_inverse=True)
    nodes = torch.stack(
        [keys // (span[1] * span[2]), keys // span[2] % span[1], keys % span[2]], dim=1
    )
    # Integers times a Python float would be single precision.
    arm = cells.to(x.dtype) * dx - x[:, None]
    return index, weights, arm, (nodes + low).to(x.dtype) * dx


def _to_grid(
    state: TorchState,
    params: TorchParameters,
    dt: float,
    index: Tensor,
    weights: Tensor,
    arm: Tensor,
    nodes: int,
) -> tuple[Tensor, Tensor, Tensor]:
    """Velocity [B, U, 3], mass [B, U], volume and its first moment [B, U, 4] of each body."""
    scale = (-dt * 4 / params.dx**2 * params.volume)[:, None, None]
    Q = scale * state.tau + params.mass[:, None, None] * state.L
    momentum = (params.mass[:, None] * state.v)[:, None] + torch.einsum("nij,nkj->nki", Q, arm)
    m = weights * params.mass[:, None]
    V = (weights * params.volume[:, None])[..., None]
    values = torch.cat([weights[..., None] * momentum, m[..., None], -V * arm / params.dx, V], -1)
    bodies = len(params.friction)
    flat = (params.body[:, None] * nodes + index).reshape(-1)
    grid = torch.zeros(bodies * nodes, 8, dtype=state.x.dtype)
    grid = grid.index_add(0, flat, values.reshape(-1, 8)).reshape(bodies, nodes, 8)
    mass = grid[..., 3]
    safe = torch.where(mass > 0, mass, torch.ones_like(mass))[..., None]
    return grid[..., :3] / safe, mass, grid[..., 4:]


def surface_offset(centroid: Tensor) -> Tensor:
    """Surface positions from centroid offsets [cells]; see :mod:`..contact`."""
    return _interpolate(SURFACE_TABLE, centroid / 1.5)


def _interpolate(table: Tensor, at: Tensor) -> Tensor:
    """Linear interpolation in a table over [0, 1]."""
    last = len(table) - 1
    scaled = at.clamp(0, 1) * last
    index = scaled.detach().floor().clamp(max=last - 1).long()
    low, high = table[index], table[index + 1]
    return low + (scaled - index) * (high - low)


def _depth(moment: Tensor, n: Tensor) -> Tensor:
    """Offset [U] [cells] along ``n`` of the centroid of the volume [U, 4] near each node."""
    volume = moment[:, 3]
    safe = torch.where(volume > 0, volume, torch.ones_like(volume))
    return (moment[:, :3] * n).sum(-1) / safe


def coulomb(v: Tensor, n: Tensor, friction: Tensor, separable: bool) -> Tensor:
    """Relative velocities [U, 3] after a contact; see :mod:`..contact`."""
    approach = (v * n).sum(-1, keepdim=True)
    t = v - approach * n
    square = t.square().sum(-1, keepdim=True)
    speed = torch.where(square > 0, square, torch.ones_like(square)).sqrt()
    keep = (1 - friction * approach.abs() / speed).clamp(min=0)
    slides = (square > 0) & (friction < float(STICKS))
    slid = torch.where(slides, keep, torch.zeros_like(keep)) * t
    return torch.where((approach >= 0) & separable, v, slid)


def _resolve_body_contact(
    velocity: Tensor,
    mass: Tensor,
    moment: Tensor,
    nodes: Tensor,
    params: TorchParameters,
    contacts: list[NodeContact],
) -> Tensor:
    """Contact of each pair of bodies, in a fixed order."""
    fields = list(velocity)
    for a in range(len(fields)):
        for b in range(a + 1, len(fields)):
            ma, mb = mass[a], mass[b]
            n, facing = _normal(moment[a] / params.dx**3, moment[b] / params.dx**3)
            gap = surface_offset(_depth(moment[a], -n)) + surface_offset(_depth(moment[b], n))
            closed = (ma > 0) & (mb > 0) & facing & (gap <= 0)
            relative = fields[b] - fields[a]
            friction = (params.friction[a] * params.friction[b]).sqrt()
            change = coulomb(relative, n, friction, separable=True) - relative
            change = torch.where(closed[:, None], change, torch.zeros_like(change))
            total = torch.where(closed, ma + mb, torch.ones_like(ma))
            new_a = fields[a] - (mb / total)[:, None] * change
            new_b = fields[b] + (ma / total)[:, None] * change
            slip = new_b - new_a
            on_a, on_b = ma[:, None] * (new_a - fields[a]), mb[:, None] * (new_b - fields[b])
            contacts.append(NodeContact(a, b, True, nodes, on_a, -slip, new_b))
            contacts.append(NodeContact(b, a, True, nodes, on_b, slip, new_a))
            fields[a], fields[b] = new_a, new_b
    return torch.stack(fields)


def _normal(moment_a: Tensor, moment_b: Tensor) -> tuple[Tensor, Tensor]:
    """Contact normals [U, 3] from a to b, and whether [U] the surfaces are in contact.

    Surfaces are in contact if they face each other, or one body surrounds the node.
    """
    size_a, size_b = moment_a[:, :3].norm(dim=-1), moment_b[:, :3].norm(dim=-1)
    out_of_a = -moment_a[:, :3] / size_a.clamp(min=1e-30)[:, None]
    into_b = moment_b[:, :3] / size_b.clamp(min=1e-30)[:, None]
    from_a = _face_score(size_a, moment_a[:, 3]) > _face_score(size_b, moment_b[:, 3])
    n = torch.where(from_a[:, None], out_of_a, into_b)
    inside_a, inside_b = (
        (size <= float(INSIDE) * moment[:, 3]) & (moment[:, 3] >= float(CRUSHED))
        for size, moment in ((size_a, moment_a), (size_b, moment_b))
    )
    return n, ((out_of_a * into_b).sum(-1) >= float(OPPOSED)) | inside_a | inside_b


def _face_score(size: Tensor, fraction: Tensor) -> Tensor:
    """Reliability of normals from first moments; see :mod:`..contact`."""
    flat = _interpolate(FLAT_TABLE, fraction).clamp(min=1e-3)
    return (size / flat).clamp(max=1) ** 2 * size


def _resolve_collider_contact(
    velocity: Tensor,
    mass: Tensor,
    moment: Tensor,
    nodes: Tensor,
    params: TorchParameters,
    colliders: Sequence[Collider],
    contacts: list[NodeContact],
) -> Tensor:
    fields = list(velocity)
    for b in range(len(fields)):
        for k, collider in enumerate(colliders):
            margin = 0.0
            if is_thin(collider, params.dx):
                distance, n = _distance_behind(collider, nodes, moment[b], params.dx)
                margin = THIN_MARGIN
            else:
                distance, n = collider_distance(collider, nodes)
            gap = distance / params.dx + surface_offset(_depth(moment[b], n))
            closed = (mass[b] > 0) & (distance <= 0) & (gap <= margin)
            friction = params.friction[b]
            if collider.friction is not None:
                friction = friction.new_tensor(min(collider.friction, float(STICKS)))
            u = _material_velocity(collider, nodes)
            after = u + coulomb(fields[b] - u, n, friction, collider.separable)
            new = torch.where(closed[:, None], after, fields[b])
            impulse = mass[b][:, None] * (new - fields[b])
            contacts.append(NodeContact(b, k, False, nodes, impulse, new - u, u))
            fields[b] = new
    return torch.stack(fields)


def _distance_behind(
    solid: Collider, nodes: Tensor, moment: Tensor, dx: float
) -> tuple[Tensor, Tensor]:
    """Distance [U] of nodes to the face on the body's side, as ``resolve_node_collider``."""
    volume = moment[:, 3:]
    out = dx * moment[:, :3] / torch.where(volume > 0, volume, torch.ones_like(volume))
    distance, n = collider_distance(solid, nodes + out)
    distance = distance - (out * n).sum(-1) - ON_FACE * dx
    across = collider_distance(solid, nodes - distance[:, None] * n)[0]
    return torch.where(across > (0.5 + ON_FACE) * dx, across, distance), n


def _resolve_thin_colliders(
    x: Tensor,
    v: Tensor,
    params: TorchParameters,
    colliders: Sequence[Collider],
    dt: float,
    contacts: list[NodeContact],
) -> Tensor:
    """Velocities [N, 3] of particles after contact with thin colliders, body after body.

    See ``contact.resolve_particle_collider``. The CPU backend only tests colliders near a
    particle's block, and makes two passes for several colliders; testing more colliders does not
    change the result.
    """
    thin = [(k, c) for k, c in enumerate(colliders) if is_thin(c, params.dx)]
    half = params.volume ** (1 / 3) / 2
    for _ in range(min(len(thin), 2)):
        for k, solid in thin:
            assert isinstance(solid, Solid)
            u = _material_velocity(solid, x)
            t, n = first_touch(solid, x, dt * (v - u), half)
            rest = (t * ((v - u) * n).sum(-1))[:, None] * n
            friction = params.friction[params.body][:, None]
            if solid.friction is not None:
                friction = torch.full_like(friction, min(solid.friction, float(STICKS)))
            after = u + rest + coulomb(v - u - rest, n, friction, solid.separable)
            after = torch.where((t <= 1)[:, None], after, v)
            impulse = params.mass[:, None] * (after - v)
            for body in range(len(params.friction)):
                own = params.body == body
                contacts.append(
                    NodeContact(body, k, False, x[own], impulse[own], (after - u)[own], u[own])
                )
            v = after
    return v


def _material_velocity(collider: Collider, points: Tensor) -> Tensor:
    if not isinstance(collider, Solid):
        return torch.zeros_like(points)
    arm = points - torch.as_tensor(collider.pose)[:3, 3]
    spin = torch.as_tensor(collider.angular_velocity).expand_as(arm)
    velocity: Tensor = torch.as_tensor(collider.velocity) + torch.linalg.cross(spin, arm)
    return velocity


class ReferenceSolverBackend:
    """Differentiable solver that other backends are compared with; see :func:`substep`."""

    name = "reference"

    def start(self, model: Model, colliders: Sequence[Collider]) -> ReferenceSimulation:
        """Load a model; it always works in float64."""
        return ReferenceSimulation(model, colliders)


def torch_model(model: Model) -> tuple[TorchState, TorchParameters]:
    """A model as tensors, the start of a differentiable rollout."""
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
    """A running simulation; every substep creates a new state."""

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
        modulus = (r.rows[:, stress.LAMBDA] + 2 * r.rows[:, stress.MU]) * stiffening
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
        """The current state; substeps never modify it."""
        return self._state, self._by_collider.copy(), self._by_body.copy()

    def restore(self, saved: Any) -> None:
        """Restore a saved state."""
        self._state = saved[0]
        self._by_collider, self._by_body = saved[1].copy(), saved[2].copy()
