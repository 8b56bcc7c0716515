"""Stress and return mapping of one particle.

``stress_update`` is the entry point: it maps a trial elastic deformation gradient to the elastic
part after plastic flow, the Kirchhoff stress tau, the stored energy per rest volume and the history
variable. See the classes in :mod:`.materials` for references.
"""

from __future__ import annotations

import math
from typing import Any

from .numerics import (
    F32,
    HALF,
    ONE,
    THREE,
    TWO,
    ZERO,
    det,
    device_function,
    eigen_symmetric,
    multiply,
    polar_rotation,
    recompose,
    symmetric_times,
    times_transposed,
)

# A material in kernel form: one row of numbers.

COROTATED, NEO_HOOKEAN, VON_MISES, VISCOPLASTIC, DRUCKER_PRAGER, SNOW, CRUSH = range(7)
"""Codes of constitutive laws in column LAW; see ``materials.CONSTITUTIVE_LAWS``."""
LAW, MU, LAMBDA, VISCOSITY, A, B, C, PLASTIC = range(8)
"""Columns. The law determines the meaning of A, B and C. VISCOSITY > 0 damps; PLASTIC > 0 keeps
F_total."""
MATERIAL_ROW = 8


SQRT_TWO_THIRDS = F32(math.sqrt(2 / 3))
STRETCH_MIN = F32(0.05)
"""Minimum of principal stretches, which keeps logarithms finite."""
SLACK = F32(1e-5)
"""Strain at which crushed structure unfolds: above rounding errors, with negligible stress."""
UNFOLDED = F32(20.0)
"""Inverse of the shortening below which unfolded structure resists tension again."""
VOLUME_MIN = F32(1e-3)
"""Minimum volume ratio; a particle below it is inverted or about to be."""


@device_function
def stress_update(F: Any, history: Any, row: Any, dt: Any) -> Any:
    """(elastic F, tau, energy density, history) of a trial elastic deformation gradient.

    Args:
        F: trial deformation gradient, nine numbers.
        history: plastic memory; hardening [Pa], volume correction, or plastic volume ratio.
        row: material row with the columns above.
        dt: time since the last call [s]; 0 disables rate-dependent flow.
    """
    law = row[LAW]
    if law == COROTATED:
        tau, energy = corotated(F, row[MU], row[LAMBDA])
        return F, tau, energy, history
    if law == NEO_HOOKEAN:
        tau, energy = neo_hookean(F, row[MU], row[LAMBDA])
        return F, tau, energy, history
    squares, vectors = eigen_symmetric(times_transposed(F, F))
    stretch = (stretch_of(squares[0]), stretch_of(squares[1]), stretch_of(squares[2]))
    if SNOW <= law <= CRUSH:
        left, tau, energy, history = snow(stretch, history, row)
    else:
        left, tau, energy, history = hencky(stretch, history, row, dt)
    if left[0] != stretch[0] or left[1] != stretch[1] or left[2] != stretch[2]:
        ratio = (left[0] / stretch[0], left[1] / stretch[1], left[2] / stretch[2])
        F = symmetric_times(recompose(ratio, vectors), F)
    return F, recompose(tau, vectors), energy, history


@device_function
def stretch_of(square: Any) -> Any:
    """Principal stretch of an eigenvalue of F F^T."""
    return max(math.sqrt(max(square, ZERO)), STRETCH_MIN)


@device_function
def corotated(F: Any, mu: Any, lam: Any) -> Any:
    """Fixed corotated: tau = 2 mu (F - R) F^T + lambda J (J - 1) I (Stomakhin et al. 2012)."""
    volume = max(det(F), VOLUME_MIN)
    return corotated_about(F, polar_rotation(F, volume), volume, mu, lam)


@device_function
def corotated_about(F: Any, R: Any, volume: Any, mu: Any, lam: Any) -> Any:
    """Fixed corotated stress for known rotation R and volume ratio."""
    d = (
        F[0] - R[0], F[1] - R[1], F[2] - R[2],
        F[3] - R[3], F[4] - R[4], F[5] - R[5],
        F[6] - R[6], F[7] - R[7], F[8] - R[8],
    )  # fmt: skip
    two_mu = TWO * mu
    pressure = lam * volume * (volume - ONE)
    tau = (
        two_mu * (d[0] * F[0] + d[1] * F[1] + d[2] * F[2]) + pressure,
        two_mu * (d[3] * F[3] + d[4] * F[4] + d[5] * F[5]) + pressure,
        two_mu * (d[6] * F[6] + d[7] * F[7] + d[8] * F[8]) + pressure,
        two_mu * (d[0] * F[3] + d[1] * F[4] + d[2] * F[5]),
        two_mu * (d[0] * F[6] + d[1] * F[7] + d[2] * F[8]),
        two_mu * (d[3] * F[6] + d[4] * F[7] + d[5] * F[8]),
    )
    shear = (
        d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
        + d[3] * d[3] + d[4] * d[4] + d[5] * d[5]
        + d[6] * d[6] + d[7] * d[7] + d[8] * d[8]
    )  # fmt: skip
    return tau, mu * shear + HALF * lam * (volume - ONE) * (volume - ONE)


@device_function
def neo_hookean(F: Any, mu: Any, lam: Any) -> Any:
    """Compressible neo-Hookean: tau = mu (F F^T - I) + lambda ln J I (Bonet and Wood, 6.4)."""
    return neo_hookean_at(F, math.log(max(det(F), VOLUME_MIN)), mu, lam)


@device_function
def neo_hookean_at(F: Any, log_volume: Any, mu: Any, lam: Any) -> Any:
    """Neo-Hookean stress for known ln J."""
    b = times_transposed(F, F)
    pressure = lam * log_volume - mu
    tau = (
        mu * b[0] + pressure, mu * b[1] + pressure, mu * b[2] + pressure,
        mu * b[3], mu * b[4], mu * b[5],
    )  # fmt: skip
    trace = b[0] + b[1] + b[2] - THREE
    return tau, HALF * mu * trace - mu * log_volume + HALF * lam * log_volume * log_volume


@device_function
def hencky(stretch: Any, history: Any, row: Any, dt: Any) -> Any:
    """Hencky's law with the flow rule of the row's law, in principal stretches.

    tau = 2 mu e + lambda tr(e), e = ln(stretch). Unknown laws return NaN.
    """
    mu, lam = row[MU], row[LAMBDA]
    e = (math.log(stretch[0]), math.log(stretch[1]), math.log(stretch[2]))
    if row[LAW] == VON_MISES:
        flowed, history = von_mises(e, history, row)
    elif row[LAW] == VISCOPLASTIC:
        flowed = viscoplastic(e, stretch, row, dt)
    elif row[LAW] == DRUCKER_PRAGER:
        flowed, history = drucker_prager(e, history, row)
    else:
        nothing = ZERO * mu / ZERO
        flowed = (nothing, nothing, nothing)
    if flowed[0] != e[0] or flowed[1] != e[1] or flowed[2] != e[2]:
        stretch = (math.exp(flowed[0]), math.exp(flowed[1]), math.exp(flowed[2]))
    trace = flowed[0] + flowed[1] + flowed[2]
    tau = (
        TWO * mu * flowed[0] + lam * trace,
        TWO * mu * flowed[1] + lam * trace,
        TWO * mu * flowed[2] + lam * trace,
    )
    square = flowed[0] * flowed[0] + flowed[1] * flowed[1] + flowed[2] * flowed[2]
    return stretch, tau, mu * square + HALF * lam * trace * trace, history


@device_function
def deviator(e: Any) -> Any:
    """Deviatoric part of principal values, and its norm."""
    mean = (e[0] + e[1] + e[2]) / THREE
    d = (e[0] - mean, e[1] - mean, e[2] - mean)
    return d, math.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])


@device_function
def shrink(e: Any, d: Any, factor: Any) -> Any:
    """e minus ``factor`` times its deviator ``d``."""
    return e[0] - factor * d[0], e[1] - factor * d[1], e[2] - factor * d[2]


@device_function
def von_mises(e: Any, history: Any, row: Any) -> Any:
    """Radial return with linear hardening (Simo and Hughes 1998, box 3.2), in log strain.

    Columns: A yield stress [Pa], B hardening modulus [Pa]; history: increase of yield [Pa].
    """
    d, norm = deviator(e)
    two_mu = TWO * row[MU]
    excess = two_mu * norm - SQRT_TWO_THIRDS * (row[A] + history)
    if excess <= ZERO:
        return e, history
    flow = excess / (two_mu + TWO * row[B] / THREE)
    return shrink(e, d, flow / norm), history + SQRT_TWO_THIRDS * row[B] * flow


@device_function
def viscoplastic(e: Any, stretch: Any, row: Any, dt: Any) -> Any:
    """Rate-dependent von Mises flow (Yue et al. 2015; as in PhysGaussian's foam).

    Columns: A yield stress [Pa], B plastic viscosity [Pa s]; B = 0 flows instantly.
    """
    d, norm = deviator(e)
    mu = row[MU]
    excess = TWO * mu * norm - SQRT_TWO_THIRDS * row[A]
    if excess <= ZERO or dt <= ZERO:
        return e
    mean_square = (
        stretch[0] * stretch[0] + stretch[1] * stretch[1] + stretch[2] * stretch[2]
    ) / THREE
    fraction = dt / (dt + row[B] / (TWO * mu * mean_square))
    return shrink(e, d, fraction * excess / (TWO * mu * norm))


@device_function
def drucker_prager(e: Any, history: Any, row: Any) -> Any:
    """Frictional flow without cohesion (Klar et al. 2016), with volume correction (2017).

    Column A: alpha of the cone; history: volume gained in tension, removed again in compression.
    """
    mu, lam = row[MU], row[LAMBDA]
    fraction = history / THREE
    e = (e[0] + fraction, e[1] + fraction, e[2] + fraction)
    trace = e[0] + e[1] + e[2]
    d, norm = deviator(e)
    if trace >= ZERO:
        return (ZERO * trace, ZERO * trace, ZERO * trace), trace
    excess = norm + (THREE * lam + TWO * mu) / (TWO * mu) * trace * row[A]
    if excess <= ZERO:
        return e, ZERO * history
    return shrink(e, d, excess / norm), ZERO * history


@device_function
def snow(stretch: Any, history: Any, row: Any) -> Any:
    """Clamped stretches and hardening, fixed corotated stress (Stomakhin et al. 2013).

    Columns: A critical compression, B critical stretch, C hardening exponent; history: ln of the
    plastic volume ratio. Hardening is limited to exp(+-3), the range of loose to hard snow.
    Structure (CRUSH) unfolds at almost no stress, up to its original length.
    """
    low, high = snow_bounds(history, row)
    s = (
        min(max(stretch[0], low), high),
        min(max(stretch[1], low), high),
        min(max(stretch[2], low), high),
    )
    volume = s[0] * s[1] * s[2]
    before = stretch[0] * stretch[1] * stretch[2]
    if before != volume:
        history = history + math.log(before / volume)
    hard = snow_hardening(history, row)
    mu, lam = row[MU] * hard, row[LAMBDA] * hard
    pressure = lam * volume * (volume - ONE)
    d = (s[0] - ONE, s[1] - ONE, s[2] - ONE)
    tau = (
        TWO * mu * d[0] * s[0] + pressure,
        TWO * mu * d[1] * s[1] + pressure,
        TWO * mu * d[2] * s[2] + pressure,
    )
    square = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
    energy = mu * square + HALF * lam * (volume - ONE) * (volume - ONE)
    return s, tau, energy, history


@device_function
def snow_bounds(history: Any, row: Any) -> Any:
    """Elastic range of the principal stretches of snow and structure."""
    high = ONE + row[B]
    if row[LAW] == CRUSH and history < ZERO:
        high = ONE + max(SLACK, row[B] * (ONE + UNFOLDED * history))
    return ONE - row[A], high


@device_function
def snow_hardening(history: Any, row: Any) -> Any:
    """Hardening factor on the moduli of snow and structure, from the plastic volume ratio."""
    return math.exp(min(max(row[C] * (ONE - math.exp(history)), -THREE), THREE))


@device_function
def wave_hardening(history: Any, row: Any) -> Any:
    """Stiffening of a particle by plastic flow: the factor on its squared wave speed."""
    if not SNOW <= row[LAW] <= CRUSH:
        return 1.0
    hardening = row[C] * (1.0 - math.exp(float(history)))
    return math.exp(min(max(hardening, -3.0), 3.0))


@device_function
def advance_gradient(F: Any, L: Any, dt: Any) -> Any:
    """(I + dt L) F."""
    one = ONE
    step = (
        one + dt * L[0], dt * L[1], dt * L[2],
        dt * L[3], one + dt * L[4], dt * L[5],
        dt * L[6], dt * L[7], one + dt * L[8],
    )  # fmt: skip
    return multiply(step, F)


@device_function
def add_viscosity(tau: Any, L: Any, volume: Any, viscosity: Any) -> Any:
    """Kelvin-Voigt: tau + J eta (L + L^T); ``volume`` is J."""
    k = volume * viscosity
    return (
        tau[0] + TWO * k * L[0],
        tau[1] + TWO * k * L[4],
        tau[2] + TWO * k * L[8],
        tau[3] + k * (L[1] + L[3]),
        tau[4] + k * (L[2] + L[6]),
        tau[5] + k * (L[5] + L[7]),
    )
