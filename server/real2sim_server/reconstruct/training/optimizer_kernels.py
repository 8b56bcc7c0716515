"""One step of Adam over rows, compiled; rows that were not seen are left alone."""
# ruff: noqa: PLR0917 - compiled loops take their arrays one by one

from __future__ import annotations

import numpy as np
from numba import prange

from ..._numba import kernel

CHUNK = 2048
BETA1 = np.float32(0.9)
BETA2 = np.float32(0.999)


@kernel(nogil=True, parallel=True, fastmath={"contract"})
def adam_rows(values, gradient, first, second, seen, rates, correction, epsilon):
    """Update ``values``, ``first`` and ``second`` [N, P] float32 in place.

    Args:
        gradient: [N, P] float32.
        seen: [N] bool, rows that take part.
        rates: [P] float32, learning rate of each column.
        correction: float32, 1 / sqrt(1 - beta2^t); that of the first moment is in ``rates``.
        epsilon: float32.
    """
    count, width = values.shape
    for chunk in prange((count + CHUNK - 1) // CHUNK):
        for i in range(chunk * CHUNK, min(count, (chunk + 1) * CHUNK)):
            if not seen[i]:
                continue
            for j in range(width):
                g = gradient[i, j]
                m = BETA1 * first[i, j] + (np.float32(1.0) - BETA1) * g
                v = BETA2 * second[i, j] + (np.float32(1.0) - BETA2) * g * g
                first[i, j] = m
                second[i, j] = v
                values[i, j] -= rates[j] * m / (np.sqrt(v) * correction + epsilon)
