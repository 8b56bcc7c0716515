"""Deformation and stress of a block's particles, several at a time where they are elastic.

Stress is written for one particle. Elastic laws have no branches worth the name, so a batch of
particles is laid out component by component and the function called in a loop of fixed length,
which LLVM turns into vector code. What does not converge there, and all that flows, goes one by
one.
"""

# Kernels take arrays by position, and Numba knows no keyword-only arguments.
# ruff: noqa: PLR0917
# Numba types intrinsics without their typing context.
# mypy: disable-error-code="call-arg, unreachable, var-annotated"

from __future__ import annotations

import math
from typing import Any

from ...constitutive.material_row import COROTATED, LAMBDA, LAW, MU, NEO_HOOKEAN, VISCOSITY
from ...constitutive.stress import (
    VOLUME_MIN,
    add_viscosity,
    advance_gradient,
    corotated_about,
    neo_hookean_at,
)
from ...numerics.device import ONE, ZERO
from ...numerics.matrices import det, rotation_step
from ..kernel import inner
from ..particle import deform
from .columns import BATCH, bring_back_nine, bring_back_six, lay_out

_F, _L, _TAU, _ENERGY, _VOLUME, _MU, _LAMBDA, _ETA, _OFF = 0, 9, 18, 24, 25, 26, 27, 28, 29
"""Rows of the scratch space, BATCH numbers each; _OFF tells lanes that did not converge."""
SCRATCH = 30 * BATCH


@inner()
def deform_all(begin: Any, end: Any, dt: Any, state: Any, table: Any, scratch: Any) -> None:
    """Advance the deformation of sorted particles by their velocity gradients; find stress."""
    for first in range(begin, end, BATCH):
        count = min(end - first, BATCH)
        law = common_law(first, count, state.material, table)
        if law == COROTATED:
            load(first, count, state, table, scratch)
            corotated_batch(dt, scratch)
            store(first, count, dt, state, table, scratch)
        elif law == NEO_HOOKEAN:
            load(first, count, state, table, scratch)
            neo_hookean_batch(dt, scratch)
            store(first, count, dt, state, table, scratch)
        else:
            for p in range(first, first + count):
                deform(p, dt, state, table[state.material[p]])


@inner()
def common_law(first: Any, count: Any, material: Any, table: Any) -> Any:
    """Code of the law that all particles of a batch follow, or -1."""
    law = int(table[material[first], LAW])
    for p in range(first + 1, first + count):
        if int(table[material[p], LAW]) != law:
            return -1
    return law


@inner()
def load(first: Any, count: Any, state: Any, table: Any, s: Any) -> None:
    """Lay particles out by component; lanes without one repeat the last."""
    if count == BATCH:
        lay_out(state.F, first, s, _F)
        lay_out(state.L, first, s, _L)
    else:
        for lane in range(BATCH):
            p = first + min(lane, count - 1)
            for c in range(9):
                s[(_F + c) * BATCH + lane] = state.F[p, c]
                s[(_L + c) * BATCH + lane] = state.L[p, c]
    for lane in range(BATCH):
        row = table[state.material[first + min(lane, count - 1)]]
        s[_MU * BATCH + lane] = row[MU]
        s[_LAMBDA * BATCH + lane] = row[LAMBDA]
        s[_ETA * BATCH + lane] = row[VISCOSITY]


@inner()
def store(first: Any, count: Any, dt: Any, state: Any, table: Any, s: Any) -> None:
    """Bring results back; lanes that are off are done again, one by one."""
    if count == BATCH and all_converged(s):
        bring_back_nine(s, _F, state.F, first)
        bring_back_six(s, _TAU, state.tau, first)
        for lane in range(BATCH):
            state.energy[first + lane] = s[_ENERGY * BATCH + lane]
        return
    for lane in range(count):
        p = first + lane
        if s[_OFF * BATCH + lane] != ZERO:
            deform(p, dt, state, table[state.material[p]])
            continue
        for c in range(9):
            state.F[p, c] = s[(_F + c) * BATCH + lane]
        for c in range(6):
            state.tau[p, c] = s[(_TAU + c) * BATCH + lane]
        state.energy[p] = s[_ENERGY * BATCH + lane]


@inner()
def all_converged(s: Any) -> Any:
    """Whether no lane of a full batch is off."""
    off = ZERO
    for lane in range(BATCH):
        off = max(off, s[_OFF * BATCH + lane])
    return off == ZERO


@inner()
def corotated_batch(dt: Any, s: Any) -> None:
    """Fixed corotated stress of all lanes; three steps find rotations at strains up to 20 %."""
    for lane in range(BATCH):
        L = lane_matrix(s, _L, lane)
        F = advance_gradient(lane_matrix(s, _F, lane), L, dt)
        full = det(F)
        volume = max(full, VOLUME_MIN)
        R, _ = rotation_step(F, volume)
        R, _ = rotation_step(R, det(R))
        R, change = rotation_step(R, det(R))
        tau, energy = corotated_about(
            F, R, volume, s[_MU * BATCH + lane], s[_LAMBDA * BATCH + lane]
        )
        tau = add_viscosity(tau, L, full, s[_ETA * BATCH + lane])
        put(s, lane, F, tau, energy)
        s[_OFF * BATCH + lane] = (ONE + change * change) - ONE


@inner()
def neo_hookean_batch(dt: Any, s: Any) -> None:
    """Neo-Hookean stress of all lanes; logarithms one by one, as they are no vector code."""
    for lane in range(BATCH):
        F = advance_gradient(lane_matrix(s, _F, lane), lane_matrix(s, _L, lane), dt)
        for c in range(9):
            s[(_F + c) * BATCH + lane] = F[c]
        s[_VOLUME * BATCH + lane] = det(F)
    for lane in range(BATCH):
        s[_OFF * BATCH + lane] = math.log(max(s[_VOLUME * BATCH + lane], VOLUME_MIN))
    for lane in range(BATCH):
        F = lane_matrix(s, _F, lane)
        tau, energy = neo_hookean_at(
            F, s[_OFF * BATCH + lane], s[_MU * BATCH + lane], s[_LAMBDA * BATCH + lane]
        )
        L = lane_matrix(s, _L, lane)
        tau = add_viscosity(tau, L, s[_VOLUME * BATCH + lane], s[_ETA * BATCH + lane])
        put(s, lane, F, tau, energy)
        s[_OFF * BATCH + lane] = ZERO


@inner()
def lane_matrix(s: Any, row: Any, lane: Any) -> Any:
    """Nine numbers of one lane, from consecutive rows."""
    at = row * BATCH + lane
    return (
        s[at], s[at + BATCH], s[at + 2 * BATCH],
        s[at + 3 * BATCH], s[at + 4 * BATCH], s[at + 5 * BATCH],
        s[at + 6 * BATCH], s[at + 7 * BATCH], s[at + 8 * BATCH],
    )  # fmt: skip


@inner()
def put(s: Any, lane: Any, F: Any, tau: Any, energy: Any) -> None:
    """Results of one lane."""
    for c in range(9):
        s[(_F + c) * BATCH + lane] = F[c]
    for c in range(6):
        s[(_TAU + c) * BATCH + lane] = tau[c]
    s[_ENERGY * BATCH + lane] = energy
