"""The substep on the CPU: homes scatter to tiles, fields collect and meet, homes gather."""

# Kernels take arrays by position, and Numba knows no keyword-only arguments.
# ruff: noqa: PLR0917

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from ..laws.shared import F32, FOUR, HALF, ONE, ZERO
from ..laws.weights import spline_weights
from .cpu_contact import meet_bodies, meet_colliders
from .cpu_deform import deform_all
from .cpu_layout import BLOCK, CHUNKS, Layout
from .cpu_simd import LANES, SIDE, gather, scatter
from .kernel import entry, inner

TILE = SIDE**3
NODES = BLOCK**3
LOW, HIGH = F32(-0.5), F32(5.5)
"""Cells from the start of its block between which a particle's nodes stay on the tile."""


class State(NamedTuple):
    """Particles sorted by home, in one precision.

    Attributes:
        xi: [N, 3] position from the start of the block [cells].
        v: [N, 3] [m/s].
        L: [N, 9] velocity gradient [1/s].
        F: [N, 9] elastic deformation gradient.
        F_total: [N, 9], or [0, 9] where nothing is plastic and F says it all.
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


class Work(NamedTuple):
    """Space for one layout.

    Attributes:
        tiles: [P, 512, 4] momentum and mass, then velocities.
        moments: [Q, 512, 4] first moment of volume about the nodes [m^3 cells], and volume [m^3].
        velocity: [M, 64, 4] velocity and mass of the fields.
        offset: [M, 64, 4] first moments of the fields.
        scratch: [CHUNKS, SCRATCH], see ``cpu_deform``.
        strayed: [P] bool, whether a particle left its home's reach.
        by_collider: [T, TOTALS] float64, of each touch.
        by_body: [M, B, TOTALS] float64, on a field from each body; [0, B, TOTALS] for one body.
    """

    tiles: NDArray[Any]
    moments: NDArray[Any]
    velocity: NDArray[Any]
    offset: NDArray[Any]
    scratch: NDArray[Any]
    strayed: NDArray[np.bool_]
    by_collider: NDArray[np.float64]
    by_body: NDArray[np.float64]


class Rules(NamedTuple):
    """What holds for the whole run.

    Attributes:
        table: [K, ROW] materials, in the state's precision.
        dx: cell size [m], in the state's precision.
        gravity: [3] [m/s^2], in the state's precision.
        friction: [B] float64.
        obstacles: [C, COLLIDER_ROW] float64.
        heights: [H] float64.
    """

    table: NDArray[Any]
    dx: Any
    gravity: NDArray[Any]
    friction: NDArray[np.float64]
    obstacles: NDArray[np.float64]
    heights: NDArray[np.float64]


@entry()
def advance(steps: Any, dt: Any, state: Any, layout: Any, work: Any, rules: Any) -> Any:
    """Make up to ``steps`` substeps; returns how many, fewer when particles must be sorted.

    No steps at all find the stress and energy of the particles as they stand.
    """
    if steps == 0:
        gather_homes(dt, state, layout, work, rules, False)
    for done in range(steps):
        scatter_homes(dt, state, layout, work, rules)
        collect_fields(dt, layout, work, rules)
        gather_homes(dt, state, layout, work, rules, True)
        if work.strayed.any():
            return done + 1
    return steps


@inner(parallel=True)
def scatter_homes(dt: Any, state: Any, layout: Any, work: Any, rules: Any) -> None:
    """Particles to tiles: momentum with APIC and stress (MLS-MPM, Hu et al. 2018), mass."""
    for chunk in prange(CHUNKS):
        for home in range(layout.chunk_start[chunk], layout.chunk_start[chunk + 1]):
            tile = work.tiles[home]
            tile[:] = ZERO
            begin, end = layout.home_start[home], layout.home_start[home + 1]
            scatter_particles(begin, end, dt, rules.dx, state, tile.reshape(-1))
            slot = layout.home_moment[home]
            if slot >= 0:
                moments = work.moments[slot]
                moments[:] = ZERO
                scatter_moments(begin, end, state, moments.reshape(-1))


@inner()
def scatter_particles(begin: Any, end: Any, dt: Any, dx: Any, state: Any, tile: Any) -> None:
    """Add the particles of one home to its tile."""
    stress_scale = -dt * FOUR / dx
    for p in range(begin, end):
        first, fx, fy, fz = place(state.xi, p)
        m = state.mass[p]
        k = stress_scale * state.volume[p]
        md = m * dx
        L, t = state.L, state.tau
        qx = (k * t[p, 0] + md * L[p, 0], k * t[p, 3] + md * L[p, 3], k * t[p, 4] + md * L[p, 6])
        qy = (k * t[p, 3] + md * L[p, 1], k * t[p, 1] + md * L[p, 4], k * t[p, 5] + md * L[p, 7])
        qz = (k * t[p, 4] + md * L[p, 2], k * t[p, 5] + md * L[p, 5], k * t[p, 2] + md * L[p, 8])
        start = (
            m * state.v[p, 0] - qx[0] * fx - qy[0] * fy - qz[0] * fz,
            m * state.v[p, 1] - qx[1] * fx - qy[1] * fy - qz[1] * fz,
            m * state.v[p, 2] - qx[2] * fx - qy[2] * fy - qz[2] * fz,
            m,
        )
        wx, wy, wz = spline_weights(fx), spline_weights(fy), spline_weights(fz)
        scatter(tile, first, wx, wy, wz, start, qx, qy, qz)


@inner()
def scatter_moments(begin: Any, end: Any, state: Any, moments: Any) -> None:
    """Add w V (x_p - x_i) and w V of one home's particles to its moments; V at rest."""
    for p in range(begin, end):
        first, fx, fy, fz = place(state.xi, p)
        V = state.volume[p]
        zero = ZERO * V
        wx, wy, wz = spline_weights(fx), spline_weights(fy), spline_weights(fz)
        start = (V * fx, V * fy, V * fz, V)
        scatter(
            moments, first, wx, wy, wz, start, (-V, zero, zero), (zero, -V, zero), (zero, zero, -V)
        )


@inner()
def place(xi: Any, p: Any) -> Any:
    """First of a particle's nodes on the tile, and its distance from it [cells]."""
    i = math.floor(xi[p, 0] - HALF)
    j = math.floor(xi[p, 1] - HALF)
    k = math.floor(xi[p, 2] - HALF)
    # Tiles start one cell below the block.
    first = ((i + 1) * SIDE + j + 1) * SIDE + k + 1
    return first, xi[p, 0] - F32(i), xi[p, 1] - F32(j), xi[p, 2] - F32(k)


@inner(parallel=True)
def collect_fields(dt: Any, layout: Any, work: Any, rules: Any) -> None:
    """Tiles to fields: sums, gravity, contact. One group of fields is one task."""
    groups = len(layout.group_start) - 1
    for group in prange(groups):
        begin, end = layout.group_start[group], layout.group_start[group + 1]
        for field in range(begin, end):
            collect(field, layout.field_homes, work.tiles, work.velocity[field])
            to_velocity(work.velocity[field], dt, rules.gravity)
            if layout.near[field]:
                collect_moments(field, layout, work)
        if end - begin > 1:
            meet_bodies(begin, end, layout, work, rules)
        for field in range(begin, end):
            if layout.touch_start[field] < layout.touch_start[field + 1]:
                meet_colliders(field, layout, work, rules)


@inner()
def overlap(offset: Any) -> Any:
    """(first, end, shift): nodes of a block that lie on a tile ``offset`` blocks below; tile index
    is node + shift."""
    if offset < 0:
        return BLOCK - 1, BLOCK, 1 - BLOCK
    if offset > 0:
        return 0, SIDE - 1 - BLOCK, 1 + BLOCK
    return 0, BLOCK, 1


@inner()
def collect(field: Any, field_homes: Any, tiles: Any, out: Any) -> None:
    """Sum a field from the tiles of the homes around it, always in the same order."""
    out[:] = ZERO
    for o in range(27):
        home = field_homes[field, o]
        if home >= 0:
            add_tile(tiles[home], o, out)


@inner()
def add_tile(tile: Any, o: Any, out: Any) -> None:
    """Add what a tile says of a field; the tile's home lies at offset number ``o``."""
    i0, i1, si = overlap(1 - o // 9)
    j0, j1, sj = overlap(1 - o // 3 % 3)
    k0, k1, sk = overlap(1 - o % 3)
    for i in range(i0, i1):
        for j in range(j0, j1):
            row = (i * BLOCK + j) * BLOCK
            source = ((i + si) * SIDE + j + sj) * SIDE + sk
            for k in range(k0, k1):
                for lane in range(LANES):
                    out[row + k, lane] += tile[source + k, lane]


@inner()
def collect_moments(field: Any, layout: Any, work: Any) -> None:
    """Sum the first moments of a field; every home around a near field has some."""
    out = work.offset[field]
    out[:] = ZERO
    for o in range(27):
        home = layout.field_homes[field, o]
        if home >= 0:
            add_tile(work.moments[layout.home_moment[home]], o, out)


@inner()
def to_velocity(field: Any, dt: Any, gravity: Any) -> None:
    """Momentum to velocity, with gravity."""
    gx, gy, gz = dt * gravity[0], dt * gravity[1], dt * gravity[2]
    for node in range(NODES):
        m = field[node, 3]
        if m > ZERO:
            inverse = ONE / m
            field[node, 0] = field[node, 0] * inverse + gx
            field[node, 1] = field[node, 1] * inverse + gy
            field[node, 2] = field[node, 2] * inverse + gz


@inner(parallel=True)
def gather_homes(dt: Any, state: Any, layout: Any, work: Any, rules: Any, moving: Any) -> None:
    """Fields to particles when ``moving``, then stress for the next substep."""
    for chunk in prange(CHUNKS):
        for home in range(layout.chunk_start[chunk], layout.chunk_start[chunk + 1]):
            tile = work.tiles[home]
            for o in range(27):
                copy_field(work.velocity[layout.home_fields[home, o]], o, tile)
            begin, end = layout.home_start[home], layout.home_start[home + 1]
            gone = gather_particles(begin, end, dt, rules.dx, state, tile.reshape(-1), moving)
            deform_all(begin, end, dt, state, rules.table, work.scratch[chunk])
            note(work.strayed, home, gone)


@inner()
def note(flags: Any, index: Any, flag: Any) -> None:
    """Store a flag. As a plain assignment in the parallel loop Numba takes it for dead code."""
    flags[index] = flag


@inner()
def copy_field(field: Any, o: Any, tile: Any) -> None:
    """Copy to a tile the nodes of the field at offset number ``o`` from the home."""
    i0, i1, si = overlap(o // 9 - 1)
    j0, j1, sj = overlap(o // 3 % 3 - 1)
    k0, k1, sk = overlap(o % 3 - 1)
    for i in range(i0, i1):
        for j in range(j0, j1):
            row = (i * BLOCK + j) * BLOCK
            target = ((i + si) * SIDE + j + sj) * SIDE + sk
            for k in range(k0, k1):
                for lane in range(LANES):
                    tile[target + k, lane] = field[row + k, lane]


@inner()
def gather_particles(
    begin: Any, end: Any, dt: Any, dx: Any, state: Any, tile: Any, moving: Any
) -> Any:
    """Move the particles of one home; returns whether one strayed off its tile."""
    stride = dt / dx
    strayed = False
    if moving:
        for p in range(begin, end):
            v, L = pick_up(p, dx, state.xi, tile)
            for axis in range(3):
                state.v[p, axis] = v[axis]
                xi = state.xi[p, axis] + stride * v[axis]
                state.xi[p, axis] = xi
                # NaN fails both comparisons, so it counts as strayed.
                if xi >= LOW and xi < HIGH:
                    continue
                strayed = True
            for c in range(9):
                state.L[p, c] = L[c]
    return strayed


@inner()
def pick_up(p: Any, dx: Any, xi: Any, tile: Any) -> Any:
    """Velocity and velocity gradient of one particle from its nodes."""
    first, fx, fy, fz = place(xi, p)
    g = gather(tile, first, spline_weights(fx), spline_weights(fy), spline_weights(fz))
    scale = FOUR / dx
    return (g[0], g[1], g[2]), (
        scale * (g[3] - fx * g[0]), scale * (g[6] - fy * g[0]), scale * (g[9] - fz * g[0]),
        scale * (g[4] - fx * g[1]), scale * (g[7] - fy * g[1]), scale * (g[10] - fz * g[1]),
        scale * (g[5] - fx * g[2]), scale * (g[8] - fy * g[2]), scale * (g[11] - fz * g[2]),
    )  # fmt: skip


__all__ = ["Layout", "Rules", "State", "Work", "advance"]
