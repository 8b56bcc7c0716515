"""Sums and bounds over the particles of each home."""

from __future__ import annotations

import math
from typing import Any

from numba import prange

from ..laws.matrices import det
from ..laws.stress import LAMBDA, MU, SNOW, C
from .cpu_layout import BLOCK, CHUNKS
from .kernel import entry, inner

MASS, CENTRE, MOMENTUM, SPIN, KINETIC, ELASTIC = 0, 1, 4, 7, 10, 11
SPEED_SQUARE, WAVE_SQUARE, VOLUME_RATIO = 12, 13, 14
SUMS, COLUMNS = 12, 15
"""The first SUMS columns are added up over homes, the others are bounds."""


@entry(parallel=True)
def measure_homes(state: Any, layout: Any, rules: Any, out: Any) -> None:
    """Fill ``out`` [P, COLUMNS] float64, one row for each home."""
    for chunk in prange(CHUNKS):
        for home in range(layout.chunk_start[chunk], layout.chunk_start[chunk + 1]):
            row = out[home]
            row[:] = 0.0
            row[VOLUME_RATIO] = math.inf
            begin, end = layout.home_start[home], layout.home_start[home + 1]
            for p in range(begin, end):
                add_motion(p, layout.home_block[home], state, rules.dx, row)
                add_matter(p, state, rules.table[state.material[p]], row)


@inner()
def add_motion(p: Any, block: Any, state: Any, dx: Any, out: Any) -> None:
    """Mass, momentum, angular momentum and kinetic energy, with APIC's affine part."""
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
    # Comparisons that NaN fails keep NaN out of maxima, so it is added instead.
    out[SPEED_SQUARE] = max(out[SPEED_SQUARE], square) + (square - square)


@inner()
def add_matter(p: Any, state: Any, row: Any, out: Any) -> None:
    """Stored energy, wave speed in the present shape, volume ratio."""
    out[ELASTIC] += float(state.volume[p]) * float(state.energy[p])
    f = state.F[p]
    F = (f[0], f[1], f[2], f[3], f[4], f[5], f[6], f[7], f[8])
    ratio = float(det(F))
    out[VOLUME_RATIO] = min(out[VOLUME_RATIO], ratio) + (ratio - ratio)
    stretch = 0.0
    for c in range(9):
        stretch += float(F[c]) * float(F[c])
    stiffening = max(stretch / 3.0, 1.0 / max(ratio, 1e-2))
    if row[0] == SNOW:
        hardening = row[C] * (1.0 - math.exp(float(state.history[p])))
        stiffening *= math.exp(min(max(hardening, -3.0), 3.0))
    modulus = float(row[LAMBDA]) + 2.0 * float(row[MU])
    square = modulus * stiffening * float(state.volume[p]) / float(state.mass[p])
    out[WAVE_SQUARE] = max(out[WAVE_SQUARE], square) + (square - square)
