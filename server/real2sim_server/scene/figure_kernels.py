"""The kernel that takes Gaussians along with the joints of a body."""

from __future__ import annotations

import numpy as np

from .._numba import kernel


@kernel(nogil=True)
def pose_gaussians(means, quats, joints, weights, turns, shifts):  # noqa: PLR0917
    """Means [N, 3] and quaternions [N, 4] float32 of Gaussians on a posed body.

    Args:
        means, quats: [N, 3] and [N, 4] float32, of the rest pose.
        joints, weights: [N, 4], which joints move a Gaussian, and by how much.
        turns, shifts: [J, 4] ``wxyz`` and [J, 3]; a joint takes x to turn x + shift.
    """
    rows = np.empty((len(turns), 16))
    for j in range(len(turns)):
        w, x, y, z = turns[j, 0], turns[j, 1], turns[j, 2], turns[j, 3]
        rows[j, 0] = 1 - 2 * (y * y + z * z)
        rows[j, 1], rows[j, 2] = 2 * (x * y - w * z), 2 * (x * z + w * y)
        rows[j, 3], rows[j, 4] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z)
        rows[j, 5], rows[j, 6] = 2 * (y * z - w * x), 2 * (x * z - w * y)
        rows[j, 7], rows[j, 8] = 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
        for axis in range(3):
            rows[j, 9 + axis] = shifts[j, axis]
        rows[j, 12], rows[j, 13], rows[j, 14], rows[j, 15] = w, x, y, z
    posed = np.empty((len(means), 3), np.float32)
    turned = np.empty((len(means), 4), np.float32)
    blend = np.empty(16)
    for i in range(len(means)):
        first, share = joints[i, 0], weights[i, 0]
        for c in range(16):
            blend[c] = share * rows[first, c]
        for k in range(1, 4):
            j, share = joints[i, k], weights[i, k]
            if share == 0:
                continue
            for c in range(12):
                blend[c] += share * rows[j, c]
            # Both signs of a quaternion are one rotation: those of the first joint's side add up.
            same = 0.0
            for c in range(12, 16):
                same += rows[j, c] * rows[first, c]
            if same < 0:
                share = -share
            for c in range(12, 16):
                blend[c] += share * rows[j, c]
        x, y, z = means[i, 0], means[i, 1], means[i, 2]
        for axis in range(3):
            at = 3 * axis
            posed[i, axis] = blend[at] * x + blend[at + 1] * y + blend[at + 2] * z + blend[9 + axis]
        a, b, c_, d = blend[12], blend[13], blend[14], blend[15]
        length = np.sqrt(a * a + b * b + c_ * c_ + d * d)
        a, b, c_, d = a / length, b / length, c_ / length, d / length
        w, x, y, z = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
        turned[i, 0] = a * w - b * x - c_ * y - d * z
        turned[i, 1] = a * x + b * w + c_ * z - d * y
        turned[i, 2] = a * y - b * z + c_ * w + d * x
        turned[i, 3] = a * z + b * y - c_ * x + d * w
    return posed, turned
