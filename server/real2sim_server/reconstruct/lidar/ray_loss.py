"""What a set of Gaussians costs along recorded rays, and which way it would cost less.

A ray whose light stops where the sensor measured something costs nothing. Light that stops
elsewhere costs by how far it is off, up to REACH; light that does not stop costs in full. So what
stands in a beam's way before its return grows transparent (line of sight), what it hit grows opaque
and moves along its normal to where it was measured, and rims draw back.
"""

# Kernels take arrays by position, and Numba knows neither dataclasses nor keyword-only ones.
# ruff: noqa: PLR0917

from __future__ import annotations

import numpy as np
from numba import prange

from ..._numba import kernel

REACH = 0.3
"""Light that stops farther off costs in full [m]."""
LOGIT, SIZE, SHIFT = 0, 1, 2
"""Columns of gradients: of the opacity's logit, of the logarithm of the scales along the surface,
of a shift along the normal [1/m]."""


@kernel(nogil=True, parallel=True)
def ray_gradients(
    begins, members, alpha, tau, measured, directions, body_of, axes, scales, opacities, out, costs
):
    """Gradients of the cost of each ray with respect to its hits.

    Args:
        begins, members, alpha, tau: of RayHits.
        measured: [R] float64, range of each ray [m].
        directions: [bodies, R, 3] float32, unit, in the frame of each body.
        body_of: [N] int32, body of each Gaussian.
        axes, scales, opacities: [N, 3, 3], [N, 3] and [N] float32; the last axis is the normal.
        out: [M, 3] float32, written.
        costs: [R] float64, written, 0 to 1.
    """
    for ray in prange(len(measured)):
        light, cost = 1.0, 0.0
        for entry in range(begins[ray], begins[ray + 1]):
            weight = alpha[entry] * light
            cost += weight * min(abs(tau[entry] - measured[ray]) / REACH, 1.0)
            light *= 1.0 - alpha[entry]
        cost += light
        costs[ray] = cost
        # What is left of the cost behind an entry is what its light would have cost instead.
        left, light = cost, 1.0
        for entry in range(begins[ray], begins[ray + 1]):
            share, member = alpha[entry], members[entry]
            off = tau[entry] - measured[ray]
            own = min(abs(off) / REACH, 1.0)
            left -= share * light * own
            by_alpha = light * own - left / max(1.0 - share, 1e-6)
            opacity = opacities[member]
            exponent = -2.0 * np.log(min(share / max(opacity, 1e-9), 1.0))
            out[entry, LOGIT] = by_alpha * share * (1.0 - opacity)
            out[entry, SIZE] = by_alpha * share * exponent
            out[entry, SHIFT] = 0.0
            if abs(off) < REACH:
                body, total, normal = body_of[member], 0.0, 0.0
                for k in range(3):
                    along = 0.0
                    for j in range(3):
                        along += directions[body, ray, j] * axes[member, j, k]
                    normal = along / scales[member, k] ** 2
                    total += along * normal
                out[entry, SHIFT] = share * light * np.sign(off) / REACH * normal / total
            light *= 1.0 - share
