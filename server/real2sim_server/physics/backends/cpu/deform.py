"""Deformation and stress of a block's particles, in batches.

The laws are written for one particle. A batch of particles is stored component by component, and a
loop of fixed length calls the law, so LLVM can vectorise it. This needs laws that are almost free
of branches. Snow and structure are fixed corotated until they yield, so they use the same path; a
test without principal stretches detects yielding. Particles that yield are processed by principal
stretches, as a batch if there are several. The rest, and those that do not converge, are processed
one by one.
"""

# Kernels take arrays by position: Numba has no keyword-only arguments.
# ruff: noqa: PLR0917
# Numba types intrinsics without their typing context.
# mypy: disable-error-code="call-arg, unreachable, var-annotated"

from __future__ import annotations

import math
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from ...numerics import (
    ONE,
    TWO,
    ZERO,
    det,
    inner,
    is_diagonal,
    jacobi_sweep,
    least_minor,
    recompose,
    rotation_step,
    symmetric_times,
    times_transposed,
)
from ...stress import (
    COROTATED,
    CRUSH,
    LAMBDA,
    LAW,
    MU,
    NEO_HOOKEAN,
    SNOW,
    STRETCH_MIN,
    VISCOSITY,
    VOLUME_MIN,
    add_viscosity,
    advance_gradient,
    corotated_about,
    neo_hookean_at,
    snow,
    snow_bounds,
    snow_hardening,
    stress_update,
    stretch_of,
)
from .particle import deform

# Conversion between rows of particles and columns of lanes, as explicit vector code. Three rounds
# of shuffles transpose eight rows at a time; moving single numbers would cost as much as the
# computation.


EIGHT = 8
BATCH = 2 * EIGHT
"""Particles per batch."""
I32, I64 = ir.IntType(32), ir.IntType(64)


class _ColumnEmitter:
    """Moves vectors between an array [N, width] and scratch space of the same precision."""

    def __init__(self, context: Any, builder: ir.IRBuilder, kinds: Any, values: Any) -> None:
        self.builder = builder
        self.scalar = context.get_value_type(kinds[0].dtype)
        self.rows, self.scratch = (
            context.make_array(kind)(context, builder, value).data
            for kind, value in zip(kinds, values, strict=True)
        )

    def load(self, data: Any, index: Any, count: int) -> Any:
        pointer, kind = self._at(data, index, count)
        return self.builder.load(pointer, typ=kind, align=4)

    def store(self, value: Any, data: Any, index: Any, count: int) -> None:
        self.builder.store(value, self._at(data, index, count)[0], align=4)

    def _at(self, data: Any, index: Any, count: int) -> tuple[Any, Any]:
        kind = ir.VectorType(self.scalar, count)
        place = self.builder.gep(data, [index], source_etype=self.scalar)
        return self.builder.bitcast(place, kind.as_pointer()), kind

    def row(self, first: Any, lane: int, width: int) -> Any:
        """Index of the row of particle ``first + lane``."""
        particle = self.builder.add(first, I64(lane))
        return self.builder.mul(particle, I64(width))

    def column(self, plane: Any, number: int, half: int) -> Any:
        """Index of eight lanes of the plane ``plane + number``."""
        index = self.builder.mul(self.builder.add(plane, I64(number)), I64(BATCH))
        return self.builder.add(index, I64(half))

    def columns(self, plane: Any, half: int, count: int) -> list[Any]:
        """Eight lanes of each of ``count`` planes from ``plane`` on."""
        places = [self.column(plane, number, half) for number in range(count)]
        return [self.load(self.scratch, place, EIGHT) for place in places]

    def pick(self, first: Any, second: Any, lanes: list[int]) -> Any:
        """A vector of the given lanes of two vectors, numbered consecutively."""
        mask = ir.Constant(ir.VectorType(I32, len(lanes)), lanes)
        return self.builder.shuffle_vector(first, second, mask)

    def turned(self, vectors: list[Any]) -> list[Any]:
        """Transpose eight vectors of eight numbers."""
        for distance in (4, 2, 1):
            turned = list(vectors)
            for i in range(EIGHT):
                if not i & distance:
                    pair = vectors[i], vectors[i | distance]
                    low = [n + 8 - distance if n & distance else n for n in range(EIGHT)]
                    high = [n + 8 if n & distance else n + distance for n in range(EIGHT)]
                    turned[i] = self.pick(*pair, low)
                    turned[i | distance] = self.pick(*pair, high)
            vectors = turned
        return vectors


@intrinsic
def lay_out(typingctx, rows, first, scratch, plane):
    """Copy nine numbers of BATCH particles from ``first`` on to planes from ``plane`` on."""

    def generate(context, builder, signature, arguments):
        data, first, space, plane = arguments
        kinds = signature.args[0], signature.args[2]
        e = _ColumnEmitter(context, builder, kinds, (data, space))
        for half in range(0, BATCH, EIGHT):
            places = [e.row(first, half + lane, 9) for lane in range(EIGHT)]
            columns = e.turned([e.load(e.rows, place, EIGHT) for place in places])
            last = ir.Constant(ir.VectorType(e.scalar, EIGHT), ir.Undefined)
            for lane, place in enumerate(places):
                single = e.load(e.rows, builder.add(place, I64(EIGHT)), 1)
                number = builder.extract_element(single, I32(0))
                last = builder.insert_element(last, number, I32(lane))
            for number, column in enumerate([*columns, last]):
                e.store(column, e.scratch, e.column(plane, number, half), EIGHT)
        return context.get_dummy_value()

    return types.void(rows, types.int64, scratch, types.int64), generate


@intrinsic
def bring_back_nine(typingctx, scratch, plane, rows, first):
    """Copy nine planes from ``plane`` on to the rows of BATCH particles from ``first`` on."""

    def generate(context, builder, signature, arguments):
        e, plane, first = _way_back(context, builder, signature, arguments)
        for half in range(0, BATCH, EIGHT):
            columns = e.columns(plane, half, EIGHT + 1)
            for lane, row in enumerate(e.turned(columns[:EIGHT])):
                place = e.row(first, half + lane, 9)
                e.store(row, e.rows, place, EIGHT)
                last = e.pick(columns[EIGHT], columns[EIGHT], [lane])
                e.store(last, e.rows, builder.add(place, I64(EIGHT)), 1)
        return context.get_dummy_value()

    return types.void(scratch, types.int64, rows, types.int64), generate


@intrinsic
def bring_back_six(typingctx, scratch, plane, rows, first):
    """Copy six planes from ``plane`` on to the rows of BATCH particles from ``first`` on."""

    def generate(context, builder, signature, arguments):
        e, plane, first = _way_back(context, builder, signature, arguments)
        for half in range(0, BATCH, EIGHT):
            columns = e.columns(plane, half, 6)
            for lane, row in enumerate(e.turned([*columns, *columns[:2]])):
                place = e.row(first, half + lane, 6)
                e.store(e.pick(row, row, [0, 1, 2, 3]), e.rows, place, 4)
                e.store(e.pick(row, row, [4, 5]), e.rows, builder.add(place, I64(4)), 2)
        return context.get_dummy_value()

    return types.void(scratch, types.int64, rows, types.int64), generate


def _way_back(context: Any, builder: Any, signature: Any, arguments: Any) -> tuple[Any, Any, Any]:
    scratch, plane, rows, first = arguments
    kinds = signature.args[2], signature.args[0]
    return _ColumnEmitter(context, builder, kinds, (rows, scratch)), plane, first


_F, _L, _TAU, _ENERGY, _VOLUME, _MU, _LAMBDA, _ETA, _OFF = 0, 9, 18, 24, 25, 26, 27, 28, 29
"""Rows of the scratch space, BATCH numbers each. _OFF marks lanes that yield or did not converge.
"""
_LOW, _HIGH, _TOTAL = 30, 31, 32
"""Plastic laws: bounds of the principal stretches, and the total deformation."""
_SYMMETRIC, _VECTORS = 41, 47
"""Lanes that yield: F F^T and its eigenvectors; ``_RATIO`` and ``_PULL`` overwrite F F^T later."""
_RATIO, _PULL = 41, 44
"""Ratios of the principal stretches after and before yielding, and principal stresses."""
SCRATCH = 56 * BATCH
SWEEPS = 4
"""Jacobi sweeps of a batch; lanes that have not converged are then processed one by one."""
FLOWN = TWO
"""Marks lanes in _OFF whose plastic flow has been computed."""
FEW = 2
"""Minimum number of yielding lanes in a batch to process them together."""

# Force inlining, because calls prevent vectorisation.
sweep: Any = inner(forceinline=True)(jacobi_sweep)


@inner()
def deform_all(begin: Any, end: Any, dt: Any, state: Any, table: Any, scratch: Any) -> None:
    """Advance the deformation of sorted particles by their velocity gradients; compute stress."""
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
        elif law == SNOW:
            load(first, count, state, table, scratch)
            load_bounds(first, count, state, table, scratch)
            snow_batch(dt, scratch)
            if lanes_off(count, scratch) >= FEW:
                flow_batch(first, count, state, table, scratch)
            store(first, count, dt, state, table, scratch)
            store_total(first, count, state, scratch)
        else:
            for p in range(first, first + count):
                deform(p, dt, state, table[state.material[p]])


@inner()
def common_law(first: Any, count: Any, material: Any, table: Any) -> Any:
    """Code of the law of all particles of a batch, or -1 if they differ.

    Structure (CRUSH) counts as SNOW, because only the yield bounds differ.
    """
    law = int(table[material[first], LAW])
    if law == CRUSH:
        law = SNOW
    for p in range(first + 1, first + count):
        other = int(table[material[p], LAW])
        if other != law and not (law == SNOW and other == CRUSH):
            return -1
    return law


@inner()
def load(first: Any, count: Any, state: Any, table: Any, s: Any) -> None:
    """Copy particles to the scratch space; unused lanes repeat the last particle."""
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
def load_bounds(first: Any, count: Any, state: Any, table: Any, s: Any) -> None:
    """Load total deformation; derive yield bounds and hardened moduli from the plastic memory."""
    if count == BATCH:
        lay_out(state.F_total, first, s, _TOTAL)
    else:
        for lane in range(BATCH):
            p = first + min(lane, count - 1)
            for c in range(9):
                s[(_TOTAL + c) * BATCH + lane] = state.F_total[p, c]
    for lane in range(BATCH):
        p = first + min(lane, count - 1)
        row, history = table[state.material[p]], state.history[p]
        low, high = snow_bounds(history, row)
        s[_LOW * BATCH + lane] = max(low, STRETCH_MIN)
        s[_HIGH * BATCH + lane] = high
        if history != ZERO:
            hard = snow_hardening(history, row)
            s[_MU * BATCH + lane] *= hard
            s[_LAMBDA * BATCH + lane] *= hard


@inner()
def store(first: Any, count: Any, dt: Any, state: Any, table: Any, s: Any) -> None:
    """Copy results back; lanes marked in _OFF are first computed one by one."""
    if lanes_off(count, s) > 0:
        for lane in range(count):
            if s[_OFF * BATCH + lane] != ZERO:
                p = first + lane
                do_again(p, lane, dt, state, table[state.material[p]], s)
    if count == BATCH:
        bring_back_nine(s, _F, state.F, first)
        bring_back_six(s, _TAU, state.tau, first)
        for lane in range(BATCH):
            state.energy[first + lane] = s[_ENERGY * BATCH + lane]
        return
    for lane in range(count):
        p = first + lane
        for c in range(9):
            state.F[p, c] = s[(_F + c) * BATCH + lane]
        for c in range(6):
            state.tau[p, c] = s[(_TAU + c) * BATCH + lane]
        state.energy[p] = s[_ENERGY * BATCH + lane]


@inner()
def do_again(p: Any, lane: Any, dt: Any, state: Any, row: Any, s: Any) -> None:
    """Apply the complete law to one lane, starting from its deformation in the scratch space."""
    F, tau, energy, history = stress_update(lane_matrix(s, _F, lane), state.history[p], row, dt)
    if row[VISCOSITY] > ZERO:
        tau = add_viscosity(tau, lane_matrix(s, _L, lane), det(F), row[VISCOSITY])
    put(s, lane, F, tau, energy)
    state.history[p] = history


@inner()
def store_total(first: Any, count: Any, state: Any, s: Any) -> None:
    """Copy the total deformation back."""
    if count == BATCH:
        bring_back_nine(s, _TOTAL, state.F_total, first)
        return
    for lane in range(count):
        for c in range(9):
            state.F_total[first + lane, c] = s[(_TOTAL + c) * BATCH + lane]


@inner()
def lanes_off(count: Any, s: Any) -> Any:
    """Number of lanes marked in _OFF, of the first ``count``."""
    off = 0
    for lane in range(count):
        if s[_OFF * BATCH + lane] != ZERO:
            off += 1
    return off


@inner()
def corotated_batch(dt: Any, s: Any) -> None:
    """Fixed corotated stress of all lanes; three Newton steps suffice at strains up to 20 %."""
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
def snow_batch(dt: Any, s: Any) -> None:
    """Elastic stress of all lanes of snow and structure; marks lanes that yield in _OFF.

    With the left stretch V = F R^T, all stretches are within bounds if neither V - low nor high - V
    has a negative eigenvalue (Sylvester's criterion). NaN fails the test.
    """
    for lane in range(BATCH):
        L = lane_matrix(s, _L, lane)
        F = advance_gradient(lane_matrix(s, _F, lane), L, dt)
        total = advance_gradient(lane_matrix(s, _TOTAL, lane), L, dt)
        for c in range(9):
            s[(_TOTAL + c) * BATCH + lane] = total[c]
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
        V = times_transposed(F, R)
        least = min(
            least_minor(V, s[_LOW * BATCH + lane], ONE),
            least_minor(V, s[_HIGH * BATCH + lane], -ONE),
            full - VOLUME_MIN,
        )
        converged = (ONE + change * change) == ONE
        s[_OFF * BATCH + lane] = ZERO if least >= ZERO and converged else ONE


@inner()
def flow_batch(first: Any, count: Any, state: Any, table: Any, s: Any) -> None:
    """Return mapping of the marked lanes of snow and structure, by principal stretches."""
    for lane in range(BATCH):
        F = lane_matrix(s, _F, lane)
        b = times_transposed(F, F)
        for c in range(6):
            s[(_SYMMETRIC + c) * BATCH + lane] = b[c]
        for c in range(9):
            s[(_VECTORS + c) * BATCH + lane] = ONE if c % 4 == 0 else ZERO
    for _ in range(SWEEPS):
        for lane in range(BATCH):
            b, v = sweep(lane_symmetric(s, lane), lane_matrix(s, _VECTORS, lane))
            for c in range(6):
                s[(_SYMMETRIC + c) * BATCH + lane] = b[c]
            for c in range(9):
                s[(_VECTORS + c) * BATCH + lane] = v[c]
    flow(first, count, state, table, s)
    compose(s)


@inner()
def flow(first: Any, count: Any, state: Any, table: Any, s: Any) -> None:
    """Plastic flow of the marked lanes, one by one; lanes that did not converge stay marked."""
    for lane in range(count):
        b = lane_symmetric(s, lane)
        if s[_OFF * BATCH + lane] != ZERO and is_diagonal(b):
            p = first + lane
            stretch = (stretch_of(b[0]), stretch_of(b[1]), stretch_of(b[2]))
            row = table[state.material[p]]
            left, pull, energy, history = snow(stretch, state.history[p], row)
            for c in range(3):
                s[(_RATIO + c) * BATCH + lane] = left[c] / stretch[c]
                s[(_PULL + c) * BATCH + lane] = pull[c]
            s[_ENERGY * BATCH + lane] = energy
            s[_OFF * BATCH + lane] = FLOWN
            state.history[p] = history


@inner()
def compose(s: Any) -> None:
    """Deformation and stress after plastic flow; unmarks these lanes."""
    for lane in range(BATCH):
        at = _RATIO * BATCH + lane
        F, v = lane_matrix(s, _F, lane), lane_matrix(s, _VECTORS, lane)
        left = symmetric_times(recompose((s[at], s[at + BATCH], s[at + 2 * BATCH]), v), F)
        at = _PULL * BATCH + lane
        tau = recompose((s[at], s[at + BATCH], s[at + 2 * BATCH]), v)
        tau = add_viscosity(tau, lane_matrix(s, _L, lane), det(left), s[_ETA * BATCH + lane])
        flown = s[_OFF * BATCH + lane] == FLOWN
        for c in range(9):
            s[(_F + c) * BATCH + lane] = left[c] if flown else F[c]
        for c in range(6):
            old = s[(_TAU + c) * BATCH + lane]
            s[(_TAU + c) * BATCH + lane] = tau[c] if flown else old
        off = s[_OFF * BATCH + lane]
        s[_OFF * BATCH + lane] = ZERO if flown else off


@inner()
def lane_symmetric(s: Any, lane: Any) -> Any:
    """The six numbers of a lane's symmetric matrix."""
    at = _SYMMETRIC * BATCH + lane
    return (
        s[at], s[at + BATCH], s[at + 2 * BATCH],
        s[at + 3 * BATCH], s[at + 4 * BATCH], s[at + 5 * BATCH],
    )  # fmt: skip


@inner()
def neo_hookean_batch(dt: Any, s: Any) -> None:
    """Neo-Hookean stress of all lanes. Logarithms do not vectorise and have a separate loop."""
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
    """The nine numbers of a lane's matrix, from consecutive rows."""
    at = row * BATCH + lane
    return (
        s[at], s[at + BATCH], s[at + 2 * BATCH],
        s[at + 3 * BATCH], s[at + 4 * BATCH], s[at + 5 * BATCH],
        s[at + 6 * BATCH], s[at + 7 * BATCH], s[at + 8 * BATCH],
    )  # fmt: skip


@inner()
def put(s: Any, lane: Any, F: Any, tau: Any, energy: Any) -> None:
    """Store the results of one lane."""
    for c in range(9):
        s[(_F + c) * BATCH + lane] = F[c]
    for c in range(6):
        s[(_TAU + c) * BATCH + lane] = tau[c]
    s[_ENERGY * BATCH + lane] = energy
