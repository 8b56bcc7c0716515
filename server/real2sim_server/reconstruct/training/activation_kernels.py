"""From raw parameters of Gaussians to what is drawn, and gradients back, compiled.

Every row is its own, so results do not depend on the number of threads.
"""
# ruff: noqa: PLR0917 - compiled loops take their arrays one by one

from __future__ import annotations

import numpy as np
from numba import prange

from ..._numba import kernel

CHUNK = 2048
ONE = np.float32(1.0)


@kernel(nogil=True, parallel=True, fastmath={"contract"})
def activate_rows(log_scales, logits, sh, fourier, tones, starts, scales, opacities, colours):
    """Write ``scales`` [N, 3], ``opacities`` [N] and ``colours`` [N, K, 3] float32.

    Args:
        log_scales: [N, 3] float32.
        logits: [N] float32.
        sh: [N, J, 3] float32, J >= K.
        fourier: [N - starts[1], F, 3] float32, of all but the first owner.
        tones: [M, F] float32, by owner but the first; F may be 0.
        starts: [M + 2] int64, first row of every owner and N.
    """
    count, kept = colours.shape[:2]
    for chunk in prange((count + CHUNK - 1) // CHUNK):
        first, last = chunk * CHUNK, min(count, (chunk + 1) * CHUNK)
        owner = np.searchsorted(starts, first, side="right") - 1
        for i in range(first, last):
            while i >= starts[owner + 1]:
                owner += 1
            for j in range(3):
                scales[i, j] = np.exp(log_scales[i, j])
            opacities[i] = ONE / (ONE + np.exp(-logits[i]))
            for k in range(kept):
                for j in range(3):
                    colours[i, k, j] = sh[i, k, j]
            if owner > 0:
                for f in range(tones.shape[1]):
                    tone = tones[owner - 1, f]
                    for j in range(3):
                        colours[i, 0, j] += tone * fourier[i - starts[1], f, j]


@kernel(nogil=True, parallel=True, fastmath={"contract"})
def activate_backward(
    by_scales,
    by_opacities,
    by_colours,
    scales,
    opacities,
    tones,
    starts,
    by_log_scales,
    by_logits,
    by_sh,
    by_fourier,
):
    """Write the gradients by the first four arguments of :func:`activate_rows`.

    Args:
        by_scales, by_opacities, by_colours: gradients by what that wrote.
        scales, opacities: what it wrote.
        tones, starts: as given to it.
    """
    count, kept = by_colours.shape[:2]
    for chunk in prange((count + CHUNK - 1) // CHUNK):
        first, last = chunk * CHUNK, min(count, (chunk + 1) * CHUNK)
        owner = np.searchsorted(starts, first, side="right") - 1
        for i in range(first, last):
            while i >= starts[owner + 1]:
                owner += 1
            for j in range(3):
                by_log_scales[i, j] = by_scales[i, j] * scales[i, j]
            by_logits[i] = by_opacities[i] * opacities[i] * (ONE - opacities[i])
            for k in range(kept):
                for j in range(3):
                    by_sh[i, k, j] = by_colours[i, k, j]
            for k in range(kept, by_sh.shape[1]):
                for j in range(3):
                    by_sh[i, k, j] = 0
            if owner > 0:
                row = i - starts[1]
                for f in range(tones.shape[1]):
                    for j in range(3):
                        by_fourier[row, f, j] = tones[owner - 1, f] * by_colours[i, 0, j]
