"""Compiled loops over Gaussians in one camera image: projection, depth, visibility, samples.

Loops run over a range of Gaussians and write only to that range, so ranges can be distributed over
threads and the result does not depend on the number of threads. The kernels release the GIL.
"""
# ruff: noqa: PLR0917 - compiled loops take their arrays one by one

from __future__ import annotations

import math

import numpy as np

from ..._numba import func, kernel

NEAR = np.float32(0.3)
MAX_FOOTPRINT = 24
"""Half-width of the largest footprint in the depth image [px]."""
GRAZING = 0.15
"""Minimum cosine between ray and surface normal for colours of objects. At grazing angles, an error
of a few centimetres samples the adjacent side, for example a lamp instead of a wing.
"""


@kernel(nogil=True)
def to_camera(means, normals, instance, transforms, present, in_camera, turned):
    """Write positions and normals in the camera frame; z = 0 for instances that are absent.

    Args:
        means, normals: [N, 3] float32, in the frame of their instance.
        instance: [N] uint16.
        transforms: [I, 3, 4] float32 ``T_camera_instance``.
        present: [I] bool.
        in_camera, turned: [N, 3] float32, written.
    """
    for i in range(means.shape[0]):
        k = instance[i]
        if not present[k]:
            in_camera[i, 2] = np.float32(0.0)
            continue
        for row in range(3):
            t = transforms[k, row]
            in_camera[i, row] = t[0] * means[i, 0] + t[1] * means[i, 1] + t[2] * means[i, 2] + t[3]
            turned[i, row] = t[0] * normals[i, 0] + t[1] * normals[i, 1] + t[2] * normals[i, 2]


@kernel(nogil=True)
def splat_depth(in_camera, turned, radii, K, depth):
    """Lower ``depth`` [H, W] float32 [m] to the nearest disk in each pixel.

    Args:
        in_camera, turned: from :func:`to_camera`.
        radii: [N] float32, of the disks [m].
        K: [4] float32: fx, fy, cx, cy of the depth image [px].
        depth: written; inf for empty pixels.
    """
    fx, fy, cx, cy = K[0], K[1], K[2], K[3]
    height, width = depth.shape
    for i in range(in_camera.shape[0]):
        x, y, z = in_camera[i, 0], in_camera[i, 1], in_camera[i, 2]
        if z < NEAR:
            continue
        u, v = fx * x / z + cx, fy * y / z + cy
        r = min(fx * radii[i] / z, np.float32(MAX_FOOTPRINT))
        if u + r < 0 or v + r < 0 or u - r >= width or v - r >= height:
            continue
        nx, ny, nz = turned[i, 0], turned[i, 1], turned[i, 2]
        plane = nx * x + ny * y + nz * z
        column, row = math.floor(u), math.floor(v)
        reach = radii[i] * radii[i]
        for py in range(max(0, math.floor(v - r)), min(height, math.floor(v + r) + 1)):
            for px in range(max(0, math.floor(u - r)), min(width, math.floor(u + r) + 1)):
                rx, ry = (px + np.float32(0.5) - cx) / fx, (py + np.float32(0.5) - cy) / fy
                along = nx * rx + ny * ry + nz
                d = z
                if abs(along) > 1e-6:
                    d = min(max(plane / along, z - radii[i]), z + radii[i])
                dx, dy, dz = d * rx - x, d * ry - y, d - z
                centre = px == column and py == row
                if (centre or dx * dx + dy * dy + dz * dz <= reach) and d < depth[py, px]:
                    depth[py, px] = d


@func(nogil=True)
def visible_weight(x, y, z, nx, ny, nz, px, py, K, depth):
    """0 if the disk through (x, y, z) is hidden, 0.15 at its silhouette, else 1."""
    fx, fy, cx, cy = K[0], K[1], K[2], K[3]
    height, width = depth.shape
    plane = nx * x + ny * y + nz * z
    side = np.float32(-1.0) if plane > 0 else np.float32(1.0)
    tolerance = np.float32(0.08) + np.float32(0.004) * z
    weight = np.float32(1.0)
    for oy in range(-1, 2):
        for ox in range(-1, 2):
            qx, qy = px + ox, py + oy
            if qx < 0 or qy < 0 or qx >= width or qy >= height:
                continue
            d = depth[qy, qx]
            if d == np.inf:
                weight = np.float32(0.15)
                continue
            rx, ry = (qx + np.float32(0.5) - cx) / fx, (qy + np.float32(0.5) - cy) / fy
            above = side * (d * (nx * rx + ny * ry + nz) - plane)
            centre = ox == 0 and oy == 0
            if centre and above > tolerance and d < z - 2 * tolerance:
                return np.float32(0.0)
            if above > 3 * tolerance and d < z - np.float32(0.3) - np.float32(0.02) * z:
                return np.float32(0.0)
            if above < -3 * tolerance and d > z + np.float32(0.3) + np.float32(0.02) * z:
                weight = np.float32(0.15)
    return weight


@kernel(nogil=True)
def gather_samples(
    in_camera,
    turned,
    footprints,
    instance,
    K,
    shrink,
    depth,
    first,
    first_object,
    second,
    levels,
    colours,
    weights,
):
    """Update the best colours of each Gaussian that this view sees.

    Args:
        in_camera, turned: from :func:`to_camera`.
        footprints: [N] float32, tangent size of the Gaussians [m].
        instance: [N] uint16.
        K: [4] float32 of the image; the depth image is ``shrink`` times smaller.
        depth: from :func:`splat_depth`.
        first, second: [H, W] float32, depths of the nearest two objects, each rendered slightly
            enlarged [m]; inf for none.
        first_object: [H, W] int32, instance of the first; -1 for none.
        levels: tuple of [H, W, 3] uint8 images, each half the size of the previous one.
        colours: [N, S, 3] uint8 and weights: [N, S] float32, updated.
    """
    height, width = levels[0].shape[0], levels[0].shape[1]
    small = K / np.float32(shrink)
    for i in range(in_camera.shape[0]):
        x, y, z = in_camera[i, 0], in_camera[i, 1], in_camera[i, 2]
        if z < NEAR:
            continue
        u, v = K[0] * x / z + K[2], K[1] * y / z + K[3]
        if u < 1 or v < 1 or u >= width - 1 or v >= height - 1:
            continue
        px, py = int(u / shrink), int(v / shrink)
        if px >= depth.shape[1] or py >= depth.shape[0]:
            continue
        other = first[py, px] if first_object[py, px] != instance[i] else second[py, px]
        if other < z - np.float32(0.1):
            continue
        nx, ny, nz = turned[i, 0], turned[i, 1], turned[i, 2]
        weight = visible_weight(x, y, z, nx, ny, nz, px, py, small, depth)
        if weight == 0:
            continue
        cosine = abs(nx * x + ny * y + nz * z) / math.sqrt(x * x + y * y + z * z)
        if instance[i] > 0 and cosine < GRAZING:
            continue
        size = K[0] * footprints[i] / z
        weight *= (np.float32(0.05) + cosine) * size * size
        worst = 0
        for s in range(1, weights.shape[1]):
            if weights[i, s] < weights[i, worst]:
                worst = s
        if weight <= weights[i, worst]:
            continue
        level = 0
        while level + 1 < len(levels) and size >= 2:
            level += 1
            size *= np.float32(0.5)
        weights[i, worst] = weight
        scale = np.float32(1.0) / np.float32(1 << level)
        for c in range(3):
            colours[i, worst, c] = sample(levels[level], u * scale, v * scale, c)


@func(nogil=True)
def sample(image, u, v, channel):
    """Bilinear value of one channel at (u, v) [px], rounded; pixel centres are at +0.5."""
    height, width = image.shape[0], image.shape[1]
    u = min(max(u - 0.5, 0.0), width - 1.0)
    v = min(max(v - 0.5, 0.0), height - 1.0)
    x0, y0 = int(u), int(v)
    x1, y1 = min(x0 + 1, width - 1), min(y0 + 1, height - 1)
    fx, fy = u - x0, v - y0
    top = image[y0, x0, channel] * (1 - fx) + image[y0, x1, channel] * fx
    bottom = image[y1, x0, channel] * (1 - fx) + image[y1, x1, channel] * fx
    return np.uint8(top * (1 - fy) + bottom * fy + 0.5)


@kernel(nogil=True)
def robust_mean(colours, weights, result, known):
    """Weighted mean of the samples that agree with their weighted median, channel by channel.

    Args:
        colours: [N, S, 3] uint8; weights: [N, S] float32, 0 for empty slots.
        result: [N, 3] float32 in [0, 1], written for Gaussians with a sample.
        known: [N] bool, written.
    """
    slots = weights.shape[1]
    for i in range(weights.shape[0]):
        total = np.float32(0.0)
        for s in range(slots):
            total += weights[i, s]
        known[i] = total > 0
        if total <= 0:
            continue
        for c in range(3):
            median = weighted_median(colours[i, :, c], weights[i], total)
            value, fraction = np.float32(0.0), np.float32(0.0)
            for s in range(slots):
                if abs(np.float32(colours[i, s, c]) - median) <= 24:
                    value += weights[i, s] * np.float32(colours[i, s, c])
                    fraction += weights[i, s]
            # fraction is never 0, because the median is one of the samples.
            result[i, c] = value / (fraction * np.float32(255.0))


@func(nogil=True)
def weighted_median(values, weights, total):
    """Weighted median: half of the weight is below it, half above."""
    best = np.float32(0.0)
    for s in range(len(values)):
        if weights[s] <= 0:
            continue
        below, upto = np.float32(0.0), np.float32(0.0)
        for t in range(len(values)):
            if values[t] < values[s]:
                below += weights[t]
            if values[t] <= values[s]:
                upto += weights[t]
        # The sums run in different orders, hence the slack.
        if 2 * below <= total * 1.0001 and 2 * upto >= total * 0.9999:
            best = np.float32(values[s])
            break
    return best
