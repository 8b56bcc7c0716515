"""Functions of one particle for all devices: transfer, deformation and contributions to sums."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...contact import resolve_particle_collider
from ...numerics import F32, FOUR, HALF, ZERO, det, device_function
from ...stress import (
    LAMBDA,
    MU,
    PLASTIC,
    VISCOSITY,
    add_viscosity,
    advance_gradient,
    stress_update,
    wave_hardening,
)
from ..layout import BLOCK

# Kernels take arrays by position: Numba has no keyword-only arguments.
# ruff: noqa: PLR0917


SIDE = 8
"""Nodes along an edge of a tile: a block and two nodes below and above."""
TILE = SIDE**3
NODES = BLOCK**3
LOW, HIGH = F32(-0.5), F32(5.5)
"""Bounds of positions whose nodes are all on the tile, from the start of the block [cells]."""
MASS, CENTRE, MOMENTUM, SPIN, KINETIC, ELASTIC = 0, 1, 4, 7, 10, 11
SPEED_SQUARE, WAVE_SQUARE, VOLUME_RATIO = 12, 13, 14
SUMS, COLUMNS = 12, 15
"""Columns of a row of sums: the first SUMS are added up, the others are bounds."""


class ParticleState(NamedTuple):
    """Particles sorted by block, in one precision.

    Attributes:
        xi: [N, 3] position from the start of the block [cells].
        v: [N, 3] [m/s].
        L: [N, 9] velocity gradient [1/s].
        F: [N, 9] elastic deformation gradient.
        F_total: [N, 9], or [0, 9] if no material is plastic, so that F_total equals F.
        tau: [N, 6] Kirchhoff stress [Pa].
        energy: [N] stored energy per rest volume [J/m^3].
        history: [N].
        mass, volume: [N] [kg], [m^3].
        material: [N] int32.
    """

    xi: NDArray[Any]
    v: NDArray[Any]
    L: NDArray[Any]
    F: NDArray[Any]
    F_total: NDArray[Any]
    tau: NDArray[Any]
    energy: NDArray[Any]
    history: NDArray[Any]
    mass: NDArray[Any]
    volume: NDArray[Any]
    material: NDArray[Any]


class Workspace(NamedTuple):
    """Work space for one layout.

    Attributes:
        tiles: [P, 512, 4] momentum and mass, then velocities.
        moments: [Q, 512, 4] first moment of volume about the nodes [m^3 cells], and volume [m^3].
        velocity: [M, 64, 4] velocity and mass of the fields.
        offset: [M, 64, 4] first moments of the fields.
        scratch: [CHUNKS, SCRATCH], CPU only, see ``cpu.deform``.
        needs_resort: [P] bool, whether a particle left its block's reach.
        by_collider: [T, TOTALS] float64, for each near collider of each field.
        by_thin: [S, TOTALS] float64, for each near thin collider of each block.
        by_body: [M, B, TOTALS] float64, effect of each body on a field; [0, B, TOTALS] for one
            body.
    """

    tiles: NDArray[Any]
    moments: NDArray[Any]
    velocity: NDArray[Any]
    offset: NDArray[Any]
    scratch: NDArray[Any]
    needs_resort: NDArray[np.bool_]
    by_collider: NDArray[np.float64]
    by_thin: NDArray[np.float64]
    by_body: NDArray[np.float64]


class StepParameters(NamedTuple):
    """Constants of a run.

    Attributes:
        table: [K, MATERIAL_ROW] materials, in the state's precision.
        dx: cell size [m], in the state's precision.
        gravity: [3] [m/s^2], in the state's precision.
        friction: [B] float64.
        collider_rows: [C, COLLIDER_ROW] float64.
        heights: [H] float64, of height fields and meshes.
    """

    table: NDArray[Any]
    dx: Any
    gravity: NDArray[Any]
    friction: NDArray[np.float64]
    collider_rows: NDArray[np.float64]
    heights: NDArray[np.float64]


@device_function
def node_position(block: Any, node: Any, dx: Any) -> Any:
    """World position [m] of a node of a block."""
    x = (block[0] * BLOCK + node // (BLOCK * BLOCK)) * dx
    y = (block[1] * BLOCK + node // BLOCK % BLOCK) * dx
    z = (block[2] * BLOCK + node % BLOCK) * dx
    return x, y, z


@device_function
def particle_position(block: Any, p: Any, xi: Any, dx: Any) -> Any:
    """World position [m] of a particle of a block, in double precision."""
    x = (block[0] * BLOCK + float(xi[p, 0])) * dx
    y = (block[1] * BLOCK + float(xi[p, 1])) * dx
    z = (block[2] * BLOCK + float(xi[p, 2])) * dx
    return x, y, z


@device_function
def obstructed(
    p: Any, v: Any, block: Any, dt: Any, state: Any, layout: Any, params: Any, totals: Any
) -> Any:
    """Velocity of a particle of a block after contact with nearby thin colliders.

    Makes two passes for several colliders, because one may push the particle into another.

    Args:
        totals: [S, TOTALS] rows to add to.
    """
    x = particle_position(layout.block_coordinates[block], p, state.xi, params.dx)
    v = (float(v[0]), float(v[1]), float(v[2]))
    body = layout.field_body[layout.block_fields[block, 13]]
    m = float(state.mass[p])
    first, end = layout.thin_start[block], layout.thin_start[block + 1]
    for _ in range(min(end - first, 2)):
        for contact in range(first, end):
            row = params.collider_rows[layout.thin_collider[contact]]
            v = resolve_particle_collider(
                row, params.heights, dt, params.friction[body], state.volume[p], x, v, m,
                totals[contact],
            )  # fmt: skip
    return v


@device_function
def first_node(x: Any) -> Any:
    """First node within reach of a particle at ``x`` [cells] along one axis, and its distance."""
    # On a device, floor does not return an integer.
    node = int(math.floor(x - HALF))  # noqa: RUF046
    return node, x - F32(node)


@device_function
def tile_node(i: Any, j: Any, k: Any) -> Any:
    """Index in the tile of a node of the block; tiles start one cell below the block."""
    return ((i + 1) * SIDE + j + 1) * SIDE + k + 1


@device_function
def place(p: Any, xi: Any) -> Any:
    """First node of a particle in the tile, and the distance from it (3) [cells]."""
    i, fx = first_node(xi[p, 0])
    j, fy = first_node(xi[p, 1])
    k, fz = first_node(xi[p, 2])
    return tile_node(i, j, k), (fx, fy, fz)


@device_function
def momentum(p: Any, dt: Any, dx: Any, f: Any, state: Any) -> Any:
    """Momentum of a particle for its nodes: start (3) and slopes along x, y, z (3 each) [kg m/s].

    A node at offset (i, j, k) from the first gets its weight times start + i qx + j qy + k qz:
    m v + Q (x_i - x_p) with Q = m L - dt V 4 / dx^2 tau (MLS-MPM, Hu et al. 2018).
    """
    m = state.mass[p]
    k = -dt * FOUR / dx * state.volume[p]
    md = m * dx
    v, L, t = state.v, state.L, state.tau
    qx = (k * t[p, 0] + md * L[p, 0], k * t[p, 3] + md * L[p, 3], k * t[p, 4] + md * L[p, 6])
    qy = (k * t[p, 3] + md * L[p, 1], k * t[p, 1] + md * L[p, 4], k * t[p, 5] + md * L[p, 7])
    qz = (k * t[p, 4] + md * L[p, 2], k * t[p, 5] + md * L[p, 5], k * t[p, 2] + md * L[p, 8])
    start = (
        m * v[p, 0] - qx[0] * f[0] - qy[0] * f[1] - qz[0] * f[2],
        m * v[p, 1] - qx[1] * f[0] - qy[1] * f[1] - qz[1] * f[2],
        m * v[p, 2] - qx[2] * f[0] - qy[2] * f[1] - qz[2] * f[2],
    )
    return start, qx, qy, qz


@device_function
def velocity_gradient(g: Any, dx: Any, f: Any) -> Any:
    """Velocity gradient (9) [1/s] from the twelve sums over nodes.

    ``g``: sum w v (3), then the sums of w v times the offset i, j and k of each node (3 each).
    """
    s = FOUR / dx
    return (
        s * (g[3] - f[0] * g[0]), s * (g[6] - f[1] * g[0]), s * (g[9] - f[2] * g[0]),
        s * (g[4] - f[0] * g[1]), s * (g[7] - f[1] * g[1]), s * (g[10] - f[2] * g[1]),
        s * (g[5] - f[0] * g[2]), s * (g[8] - f[1] * g[2]), s * (g[11] - f[2] * g[2]),
    )  # fmt: skip


@device_function
def move(p: Any, dt: Any, dx: Any, v: Any, L: Any, state: Any) -> Any:
    """Set velocity and gradient of a particle and move it.

    Returns whether it left its block's reach; NaN counts as having left.
    """
    stride = dt / dx
    stays = True
    for axis in range(3):
        state.v[p, axis] = v[axis]
        xi = state.xi[p, axis] + stride * v[axis]
        state.xi[p, axis] = xi
        stays = stays and xi >= LOW and xi < HIGH
    for c in range(9):
        state.L[p, c] = L[c]
    return not stays


@device_function
def nine(a: Any, p: Any) -> Any:
    """Row p of a [N, 9] array as a tuple."""
    return (
        a[p, 0], a[p, 1], a[p, 2], a[p, 3], a[p, 4], a[p, 5], a[p, 6], a[p, 7], a[p, 8],
    )  # fmt: skip


@device_function
def deform(p: Any, dt: Any, state: Any, row: Any) -> None:
    """Advance one particle's deformation by its velocity gradient and compute its stress."""
    L = nine(state.L, p)
    trial = advance_gradient(nine(state.F, p), L, dt)
    F, tau, energy, history = stress_update(trial, state.history[p], row, dt)
    if row[VISCOSITY] > ZERO:
        tau = add_viscosity(tau, L, det(F), row[VISCOSITY])
    for c in range(9):
        state.F[p, c] = F[c]
    for c in range(6):
        state.tau[p, c] = tau[c]
    state.energy[p] = energy
    if row[PLASTIC] > ZERO:
        state.history[p] = history
        F = advance_gradient(nine(state.F_total, p), L, dt)
        for c in range(9):
            state.F_total[p, c] = F[c]


@device_function
def add_motion(p: Any, block: Any, state: Any, dx: Any, out: Any) -> None:
    """Add mass, momentum, angular momentum and kinetic energy, including APIC's affine part."""
    m = float(state.mass[p])
    x = (
        (block[0] * BLOCK + float(state.xi[p, 0])) * dx,
        (block[1] * BLOCK + float(state.xi[p, 1])) * dx,
        (block[2] * BLOCK + float(state.xi[p, 2])) * dx,
    )
    v = (float(state.v[p, 0]), float(state.v[p, 1]), float(state.v[p, 2]))
    affine = m * dx * dx / 4
    L = state.L[p]
    square = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    gradient_square = 0.0
    for c in range(9):
        gradient_square += float(L[c]) * float(L[c])
    out[MASS] += m
    for axis in range(3):
        out[CENTRE + axis] += m * x[axis]
        out[MOMENTUM + axis] += m * v[axis]
    out[SPIN] += m * (x[1] * v[2] - x[2] * v[1]) + affine * (L[7] - L[5])
    out[SPIN + 1] += m * (x[2] * v[0] - x[0] * v[2]) + affine * (L[2] - L[6])
    out[SPIN + 2] += m * (x[0] * v[1] - x[1] * v[0]) + affine * (L[3] - L[1])
    out[KINETIC] += 0.5 * (m * square + affine * gradient_square)
    # Maxima ignore NaN, so this adds it instead.
    out[SPEED_SQUARE] = max(out[SPEED_SQUARE], square) + (square - square)


@device_function
def add_material(p: Any, state: Any, row: Any, out: Any) -> None:
    """Add stored energy, wave speed in the deformed material, and volume ratio."""
    out[ELASTIC] += float(state.volume[p]) * float(state.energy[p])
    f = state.F[p]
    F = (f[0], f[1], f[2], f[3], f[4], f[5], f[6], f[7], f[8])
    ratio = float(det(F))
    out[VOLUME_RATIO] = min(out[VOLUME_RATIO], ratio) + (ratio - ratio)
    stretch = 0.0
    for c in range(9):
        stretch += float(F[c]) * float(F[c])
    stiffening = max(stretch / 3.0, 1.0 / max(ratio, 1e-2))
    stiffening *= wave_hardening(state.history[p], row)
    modulus = float(row[LAMBDA]) + 2.0 * float(row[MU])
    square = modulus * stiffening * float(state.volume[p]) / float(state.mass[p])
    out[WAVE_SQUARE] = max(out[WAVE_SQUARE], square) + (square - square)
