"""Compiled loops of training: activations, Adam, structural similarity, intersections."""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from ..._numba import PARALLEL_LOOPS, func, kernel

# Activations and their gradients. Rows are independent, so results do not depend on the number of
# threads.

# ruff: noqa: PLR0917 - compiled loops take their arrays one by one


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
    """Write the gradients with respect to the first four arguments of :func:`activate_rows`.

    Args:
        by_scales, by_opacities, by_colours: gradients with respect to its outputs.
        scales, opacities: its outputs.
        tones, starts: its inputs.
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


# One step of Adam over rows; rows without gradients stay as they are.

# ruff: noqa: PLR0917 - compiled loops take their arrays one by one


BETA1 = np.float32(0.9)
BETA2 = np.float32(0.999)


@kernel(nogil=True, parallel=True, fastmath={"contract"})
def adam_rows(values, gradient, first, second, seen, rates, correction, epsilon, joint):
    """Update ``values``, ``first`` and ``second`` [N, P] float32 in place.

    Args:
        joint: whether the columns of a row share the mean of their squares as second moment.
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
            squares = np.float32(0.0)
            if joint:
                for j in range(width):
                    squares += gradient[i, j] * gradient[i, j]
                squares /= np.float32(width)
            for j in range(width):
                g = gradient[i, j]
                square = squares if joint else g * g
                m = BETA1 * first[i, j] + (np.float32(1.0) - BETA1) * g
                v = BETA2 * second[i, j] + (np.float32(1.0) - BETA2) * square
                first[i, j] = m
                second[i, j] = v
                values[i, j] -= rates[j] * m / (np.sqrt(v) * correction + epsilon)


# Structural similarity and its gradient.
#
# Rows of interleaved RGB are blurred with a stride of three, so images never change their layout.
# Every kernel writes whole rows, so results do not depend on the number of threads.

# ruff: noqa: PLR0917 - compiled loops take their arrays one by one


TAPS = 11
REACH = TAPS // 2
SIGMA = 1.5
C1 = np.float32(0.01**2)
C2 = np.float32(0.03**2)


def gaussian_window() -> np.ndarray:
    """[11] float32 that sums to 1, standard deviation 1.5 px (Wang et al. 2004)."""
    x = np.arange(TAPS) - REACH
    window = np.exp(-(x**2) / (2 * SIGMA**2))
    return (window / window.sum()).astype(np.float32)


@kernel(nogil=True, parallel=True, fastmath={"contract"})
def blur_rows(image, truth, window, blurred):
    """Blur x, y, xx, yy and xy along rows.

    Args:
        image, truth: [H, 3 W] float32.
        window: [11] float32.
        blurred: [5, H, 3 W] float32, written.
    """
    height, width = image.shape
    pad = 3 * REACH
    for row in prange(height):
        padded = np.zeros((5, width + 2 * pad), np.float32)
        for i in range(width):
            x, y = image[row, i], truth[row, i]
            padded[0, pad + i] = x
            padded[1, pad + i] = y
            padded[2, pad + i] = x * x
            padded[3, pad + i] = y * y
            padded[4, pad + i] = x * y
        for m in range(5):
            out = blurred[m, row]
            source = padded[m]
            for i in range(width):
                out[i] = window[0] * source[i]
            for k in range(1, TAPS):
                weight = window[k]
                for i in range(width):
                    out[i] += weight * source[i + 3 * k]


@kernel(nogil=True, parallel=True, fastmath={"contract"})
def compare(blurred, window, sums, slopes):
    """Blur along columns, compare, and differentiate by the blurred x, xx and xy.

    Args:
        blurred: [5, H, 3 W] float32 from :func:`blur_rows`.
        window: [11] float32.
        sums: [H] float64, written: sum of the similarity over each row.
        slopes: [3, H, 3 W] float32, written: derivatives of the similarity.
    """
    height, width = blurred.shape[1], blurred.shape[2]
    for row in prange(height):
        local = np.zeros((5, width), np.float32)
        for m in range(5):
            mine = local[m]
            for k in range(TAPS):
                other = row + k - REACH
                if 0 <= other < height:
                    weight, source = window[k], blurred[m, other]
                    for i in range(width):
                        mine[i] += weight * source[i]
        total = 0.0
        for i in range(width):
            mx, my = local[0, i], local[1, i]
            sxx, syy = local[2, i] - mx * mx, local[3, i] - my * my
            sxy = local[4, i] - mx * my
            a, b = 2 * mx * my + C1, 2 * sxy + C2
            c, d = mx * mx + my * my + C1, sxx + syy + C2
            inverse = np.float32(1.0) / (c * d)
            value = a * b * inverse
            total += value
            by_xx = -value / d
            by_xy = 2 * a * inverse
            by_mean = 2 * my * b * inverse - 2 * mx * value / c
            # The variances also depend on the mean.
            slopes[0, row, i] = by_mean - 2 * mx * by_xx - my * by_xy
            slopes[1, row, i] = by_xx
            slopes[2, row, i] = by_xy
        sums[row] = total


@kernel(nogil=True, parallel=True, fastmath={"contract"})
def gather_slopes(image, truth, slopes, window, factor, gradient):
    """Carry derivatives back through the blur; the window is symmetric, so it is its own transpose.

    Args:
        image, truth: [H, 3 W] float32.
        slopes: [3, H, 3 W] float32 from :func:`compare`.
        window: [11] float32.
        factor: float32, multiplies the result.
        gradient: [H, 3 W] float32, written: ``factor`` times the derivative of the summed
            similarity by ``image``.
    """
    height, width = image.shape
    pad = 3 * REACH
    for row in prange(height):
        padded = np.zeros((3, width + 2 * pad), np.float32)
        for m in range(3):
            mine = padded[m, pad : pad + width]
            for k in range(TAPS):
                other = row + k - REACH
                if 0 <= other < height:
                    weight, source = window[k], slopes[m, other]
                    for i in range(width):
                        mine[i] += weight * source[i]
        blurred = np.zeros((3, width), np.float32)
        for m in range(3):
            mine, source = blurred[m], padded[m]
            for k in range(TAPS):
                weight = window[k]
                for i in range(width):
                    mine[i] += weight * source[i + 3 * k]
        for i in range(width):
            gradient[row, i] = factor * (
                blurred[0, i] + 2 * image[row, i] * blurred[1, i] + truth[row, i] * blurred[2, i]
            )


# Lines through followed vehicles, and the surfaces of their bodies.

HIT = 0.07
"""Maximum distance of a ray from a surface point that it hits [m]."""
LAYER = 0.15
"""Maximum depth behind the first hit point of points on the same surface [m]."""
EDGE_ON = 0.2
"""Gaussians follow the surface up to this cosine between normal and ray; beyond it they face the
ray.
"""
F32 = np.float32
ZERO = F32(0)
MISSED = F32(1e9)
"""Distance of lines that hit nothing [m]."""
NEAR_LINE, FACING = F32(HIT**2), F32(EDGE_ON / 4)
"""Maximum squared distance of a hit point [m2], and minimum cosine of its normal to the ray."""
SOFT = F32(0.01)
"""Distance from a ray at which points have half of the greatest weight [m]."""


@kernel(nogil=True, fastmath=True, parallel=PARALLEL_LOOPS)
def first_hits(origins, rays, points, normals, distances, at):
    """Intersect lines with a point surface, see ``closed_vehicles``.

    Args:
        origins, rays: [M, 3] float32, points on the lines and their unit directions.
        points, normals: [3, P] float32, of the surface.
        distances, at: [M] and [M, 3] float32, written: distance along the ray [m], and normal.
    """
    for k in prange(len(origins)):
        o, r = origins[k], rays[k]
        first = MISSED
        for p in range(points.shape[1]):
            along, aside, facing = _about_line(points, normals, p, o, r)
            hit = aside < NEAR_LINE and facing > FACING
            first = min(first, along if hit else MISSED)
        if first < MISSED:
            nx = ny = nz = px = py = pz = ZERO
            total, last = F32(1e-9), first + F32(LAYER)
            for p in range(points.shape[1]):
                along, aside, facing = _about_line(points, normals, p, o, r)
                hit = aside < NEAR_LINE and facing > FACING and along < last
                weight = ONE / (math.sqrt(max(aside, ZERO)) + SOFT) if hit else ZERO
                total += weight
                nx += weight * normals[0, p]
                ny += weight * normals[1, p]
                nz += weight * normals[2, p]
                px += weight * points[0, p]
                py += weight * points[1, p]
                pz += weight * points[2, p]
            length = max(math.sqrt(nx * nx + ny * ny + nz * nz), 1e-9)
            at[k, 0], at[k, 1], at[k, 2] = nx / length, ny / length, nz / length
            cosine, on_plane = 0.0, 0.0
            for axis, place in enumerate((px, py, pz)):
                cosine += at[k, axis] * r[axis]
                on_plane += (place / total - o[axis]) * at[k, axis]
            on_plane /= min(cosine, -EDGE_ON / 2)
            # At a bend, the plane through the points can be far from them along a grazing ray.
            distances[k] = min(max(on_plane, first - 2 * LAYER), first + 2 * LAYER)
        else:
            cosine, nearest = 0.0, MISSED
            for p in range(points.shape[1]):
                along, aside, facing = _about_line(points, normals, p, o, r)
                if facing > -EDGE_ON and aside < nearest:
                    nearest, distances[k] = aside, along
        if cosine > -EDGE_ON:
            at[k, 0], at[k, 1], at[k, 2] = -r[0], -r[1], -r[2]


@func(inline="always")
def _about_line(points, normals, p, o, r):
    """Distance of a point along a line, its squared distance from it, and the cosine of its normal
    against the line.
    """
    x, y, z = points[0, p] - o[0], points[1, p] - o[1], points[2, p] - o[2]
    along = x * r[0] + y * r[1] + z * r[2]
    facing = -(normals[0, p] * r[0] + normals[1, p] * r[1] + normals[2, p] * r[2])
    return along, x * x + y * y + z * z - along * along, facing
