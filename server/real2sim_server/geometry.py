"""Rigid transforms, rotations and oriented boxes in float64 NumPy.

``T_dst_src`` is [4, 4] and maps src coordinates to dst; quaternions are (w, x, y, z).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ._numba import kernel

# --- Rotations -----------------------------------------------------------------------------------

Float = NDArray[np.float64]


def quaternion_to_matrix(quaternion: ArrayLike) -> Float:
    """Rotation matrices [..., 3, 3] of quaternions [..., 4] wxyz; they are normalised first."""
    q = np.asarray(quaternion, dtype=np.float64)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def matrix_to_quaternion(matrix: ArrayLike) -> Float:
    """Unit quaternions [..., 4] wxyz with w >= 0 of rotation matrices [..., 3, 3].

    Takes the largest of the four candidate components as pivot, so that no rotation is
    ill-conditioned (Shepperd's method).
    """
    m = np.asarray(matrix, dtype=np.float64)
    trace = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    squares = np.stack(
        [
            1 + trace,
            1 + 2 * m[..., 0, 0] - trace,
            1 + 2 * m[..., 1, 1] - trace,
            1 + 2 * m[..., 2, 2] - trace,
        ],
        axis=-1,
    )
    yz, zx, xy = (
        (m[..., 2, 1], m[..., 1, 2]),
        (m[..., 0, 2], m[..., 2, 0]),
        (m[..., 1, 0], m[..., 0, 1]),
    )
    (dx, sx), (dy, sy), (dz, sz) = ((a - b, a + b) for a, b in (yz, zx, xy))
    candidates = np.stack(
        [
            np.stack([squares[..., 0], dx, dy, dz], axis=-1),
            np.stack([dx, squares[..., 1], sz, sy], axis=-1),
            np.stack([dy, sz, squares[..., 2], sx], axis=-1),
            np.stack([dz, sy, sx, squares[..., 3]], axis=-1),
        ],
        axis=-2,
    )
    pivot = np.argmax(squares, axis=-1)[..., None, None]
    q: Float = np.take_along_axis(
        candidates, np.broadcast_to(pivot, (*pivot.shape[:-1], 4)), axis=-2
    )
    q = q[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., :1] < 0, -q, q)


def multiply_quaternions(left: ArrayLike, right: ArrayLike) -> Float:
    """Hamilton product [..., 4] of two wxyz quaternions: first ``right``, then ``left`` rotates."""
    aw, ax, ay, az = np.moveaxis(np.asarray(left, dtype=np.float64), -1, 0)
    bw, bx, by, bz = np.moveaxis(np.asarray(right, dtype=np.float64), -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def slerp(start: ArrayLike, end: ArrayLike, fraction: ArrayLike) -> Float:
    """Shortest-arc interpolation [..., 4] of unit quaternions, ``fraction`` [...] in [0, 1]."""
    a = np.asarray(start, dtype=np.float64)
    b = np.asarray(end, dtype=np.float64)
    t = np.asarray(fraction, dtype=np.float64)[..., None]
    dot = np.sum(a * b, axis=-1, keepdims=True)
    b = np.where(dot < 0, -b, b)
    angle = np.arccos(np.clip(np.abs(dot), -1.0, 1.0))
    sine = np.sin(angle)
    nearly_equal = sine < 1e-6
    safe = np.where(nearly_equal, 1.0, sine)
    weight_a = np.where(nearly_equal, 1 - t, np.sin((1 - t) * angle) / safe)
    weight_b = np.where(nearly_equal, t, np.sin(t * angle) / safe)
    q = weight_a * a + weight_b * b
    between: Float = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return between


def yaw_quaternion(yaw: ArrayLike) -> Float:
    """Quaternions [..., 4] of rotations by ``yaw`` [...] [rad] about z."""
    half = np.asarray(yaw, dtype=np.float64) / 2
    zero = np.zeros_like(half)
    return np.stack([np.cos(half), zero, zero, np.sin(half)], axis=-1)


def quaternion_yaw(quaternion: ArrayLike) -> Float:
    """Heading [...] [rad] in (-pi, pi] of the rotated x axis, seen from above."""
    q = np.asarray(quaternion, dtype=np.float64)
    w, x, y, z = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    return np.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)


def wrapped(angle: ArrayLike) -> Float:
    """Angles [rad] wrapped to [-pi, pi)."""
    turned: Float = (np.asarray(angle, dtype=np.float64) + np.pi) % (2 * np.pi) - np.pi
    return turned


def is_rotation(matrix: ArrayLike, *, tolerance: float = 1e-3) -> bool:
    """Whether a [3, 3] matrix is finite, orthonormal and right-handed within ``tolerance``."""
    m = np.asarray(matrix, dtype=np.float64)
    return m.shape == (3, 3) and bool(are_rotations(m, tolerance=tolerance))


def are_rotations(matrices: ArrayLike, *, tolerance: float = 1e-3) -> NDArray[np.bool_]:
    """Which of [..., 3, 3] matrices are rotations, [...] bool; like :func:`is_rotation`."""
    m = np.asarray(matrices, dtype=np.float64)
    # By elements: products of many small matrices are calls of a library each.
    x, y, z = ([m[..., i, j] for j in range(3)] for i in range(3))
    with np.errstate(over="ignore", invalid="ignore"):
        found = np.isfinite(_dot(x, x) + _dot(y, y) + _dot(z, z))
        for row, other in ((x, y), (y, z), (z, x)):
            found = found & (np.abs(_dot(row, row) - 1) < tolerance)
            found = found & (np.abs(_dot(row, other)) < tolerance)
        cross = [y[i] * z[j] - y[j] * z[i] for i, j in ((1, 2), (2, 0), (0, 1))]
        return np.asarray(found & (_dot(x, cross) > 0))


def _dot(one: Sequence[Float], other: Sequence[Float]) -> Float:
    """Dot product of vectors given by their three components."""
    product: Float = one[0] * other[0] + one[1] * other[1] + one[2] * other[2]
    return product


def transform_from(position: ArrayLike, quaternion: ArrayLike) -> Float:
    """``T_dst_src`` [..., 4, 4] of a position [..., 3] [m] and a quaternion [..., 4] wxyz."""
    p = np.asarray(position, dtype=np.float64)
    matrix = np.zeros((*p.shape[:-1], 4, 4))
    matrix[..., :3, :3] = quaternion_to_matrix(quaternion)
    matrix[..., :3, 3] = p
    matrix[..., 3, 3] = 1
    return matrix


def invert_transform(transform: ArrayLike) -> Float:
    """``T_src_dst`` [..., 4, 4] of a rigid ``T_dst_src``."""
    t = np.asarray(transform, dtype=np.float64)
    inverse = np.zeros_like(t)
    rotation = np.swapaxes(t[..., :3, :3], -1, -2)
    inverse[..., :3, :3] = rotation
    inverse[..., :3, 3] = -np.einsum("...ij,...j->...i", rotation, t[..., :3, 3])
    inverse[..., 3, 3] = 1
    return inverse


def apply_transform(transform: ArrayLike, points: ArrayLike) -> Float:
    """Points [..., N, 3] of src in dst, by ``T_dst_src`` [..., 4, 4]."""
    t = np.asarray(transform, dtype=np.float64)
    p = np.asarray(points, dtype=np.float64)
    return p @ np.swapaxes(t[..., :3, :3], -1, -2) + t[..., None, :3, 3]


def is_rigid(matrix: ArrayLike, *, tolerance: float = 1e-3) -> bool:
    """Whether a [4, 4] matrix is a finite rigid transform: rotation, shift, row [0, 0, 0, 1]."""
    m = np.asarray(matrix, dtype=np.float64)
    return m.shape == (4, 4) and bool(are_rigid(m, tolerance=tolerance))


def are_rigid(matrices: ArrayLike, *, tolerance: float = 1e-3) -> NDArray[np.bool_]:
    """Which of [..., 4, 4] matrices are rigid transforms, [...] bool; like :func:`is_rigid`."""
    m = np.asarray(matrices, dtype=np.float64)
    last_row = np.abs(m[..., 3, :] - [0, 0, 0, 1]).max(axis=-1) < tolerance
    shift = np.isfinite(m[..., :3, 3]).all(axis=-1)
    return np.asarray(last_row & shift & are_rotations(m[..., :3, :3], tolerance=tolerance))


# --- Oriented boxes ------------------------------------------------------------------------------

UNIT_CORNERS = np.array(
    [[x, y, z] for z in (-0.5, 0.5) for y in (-0.5, 0.5) for x in (-0.5, 0.5)], dtype=np.float64
)
"""[8, 3] corners of the unit box: x changes fastest, bottom four first."""

NEXT, SECOND = [1, 2, 0], [2, 0, 1]
"""The coordinates after each, in their cycle."""

MIN_OVERLAP = 1e-9
"""Maximum overlap of boxes that only touch [m]."""

PARALLEL = 1e-6
"""Sine of the angle below which two edges span no axis."""


def box_corners(T_world_box: ArrayLike, size: ArrayLike) -> Float:
    """Corners [..., 8, 3] [m] in the world of boxes centred on their own origin.

    Args:
        T_world_box: [..., 4, 4] rigid transform.
        size: [..., 3] (length, width, height) along the box's x, y, z [m].

    Order: x changes fastest, then y, then z, from minus to plus.
    """
    local = UNIT_CORNERS * np.asarray(size, dtype=np.float64)[..., None, :]
    return apply_transform(T_world_box, local)


def bottom_centres(T_world_box: Float, size: ArrayLike) -> Float:
    """Centres [N, 3] [m] of the four lowest corners of boxes at ``T_world_box`` [N, 4, 4]."""
    corners = box_corners(T_world_box, size)
    lowest = np.argsort(corners[..., 2], axis=1, kind="stable")[:, :4]
    chosen: Float = np.take_along_axis(corners, lowest[..., None], axis=1)
    centres: Float = chosen.mean(axis=1)
    return centres


def box_penetration(
    T_world_a: ArrayLike, size_a: ArrayLike, T_world_b: ArrayLike, size_b: ArrayLike
) -> Float:
    """Minimum distance [...] [m] to shift one box so that the two no longer overlap.

    For separate boxes it is negative, and its magnitude is a lower bound of their distance.
    Separating-axis test over the 15 candidate axes (Gottschalk et al. 1996, OBBTree). Leading
    dimensions broadcast, so one box can be tested against many.

    Args:
        T_world_a, T_world_b: [..., 4, 4] rigid transforms to the world; origin at the box centre.
        size_a, size_b: [..., 3] (length, width, height) [m].
    """
    turn, centre, half_a, half_b = _relative(T_world_a, size_a, T_world_b, size_b)
    faces = _face_overlaps(turn, centre, half_a, half_b)
    edges = _edge_overlaps(turn, centre, half_a, half_b)
    return np.minimum(faces, edges)


def _relative(
    T_world_a: ArrayLike, size_a: ArrayLike, T_world_b: ArrayLike, size_b: ArrayLike
) -> tuple[Float, Float, Float, Float]:
    """``R_a_b`` [..., 3, 3], centre of b in the frame of a [..., 3, 1], halves of both sizes."""
    a, b = np.asarray(T_world_a, dtype=np.float64), np.asarray(T_world_b, dtype=np.float64)
    half_a = np.asarray(size_a, dtype=np.float64)[..., :, None] / 2
    half_b = np.asarray(size_b, dtype=np.float64)[..., None, :] / 2
    to_a = np.swapaxes(a[..., :3, :3], -1, -2)
    turn = to_a @ b[..., :3, :3]
    centre = to_a @ (b[..., :3, 3:] - a[..., :3, 3:])
    return turn, centre, half_a, half_b


def _face_overlaps(turn: Float, centre: Float, half_a: Float, half_b: Float) -> Float:
    """Least overlap [...] along the face normals of both boxes.

    Args:
        turn: [..., 3, 3] ``R_a_b``.
        centre: [..., 3, 1] of b in the frame of a.
        half_a, half_b: [..., 3, 1] and [..., 1, 3].
    """
    size = np.abs(turn)
    along_a = half_a + (size * half_b).sum(-1, keepdims=True) - np.abs(centre)
    along_b = half_b + (size * half_a).sum(-2, keepdims=True)
    along_b = along_b - np.abs((turn * centre).sum(-2, keepdims=True))
    least: Float = np.minimum(along_a.min((-2, -1)), along_b.min((-2, -1)))
    return least


def _edge_overlaps(turn: Float, centre: Float, half_a: Float, half_b: Float) -> Float:
    """Minimum overlap [...] along the products of an edge of a and one of b; see above.

    Entry [i, j] belongs to the product of a's axis i and b's axis j. In the frame of a it is
    (-turn[i + 2, j], turn[i + 1, j]) in the coordinates i + 1 and i + 2. So the extent of a needs
    these two rows of ``turn``, and the extent of b, seen from b, two columns.
    """
    size = np.abs(turn)
    next_row, second_row = turn[..., NEXT, :], turn[..., SECOND, :]
    gap = np.abs(centre[..., SECOND, :] * next_row - centre[..., NEXT, :] * second_row)
    reach_a = (
        half_a[..., NEXT, :] * size[..., SECOND, :] + half_a[..., SECOND, :] * size[..., NEXT, :]
    )
    reach_b = half_b[..., NEXT] * size[..., SECOND] + half_b[..., SECOND] * size[..., NEXT]
    length = np.sqrt(next_row * next_row + second_row * second_row)
    # Parallel edges span no axis; the face normals cover that case.
    valid = length > PARALLEL
    overlaps = np.where(valid, reach_a + reach_b - gap, np.inf) / np.where(valid, length, 1.0)
    least: Float = overlaps.min((-2, -1))
    return least


@kernel
def boxes_overlap(T_world_a: Any, size_a: Any, T_world_b: Any, size_b: Any) -> Any:
    """Whether two boxes share volume; touching boxes do not.

    Separating-axis test over the same axes as :func:`~.box.box_penetration`.

    Args:
        T_world_a, T_world_b: [4, 4] float64, origin at the box centre [m].
        size_a, size_b: (length, width, height), three float64 each [m].
    """
    turn, centre = np.empty((3, 3)), np.empty(3)
    half_a, half_b = np.empty(3), np.empty(3)
    for i in range(3):
        half_a[i], half_b[i] = size_a[i] / 2, size_b[i] / 2
        centre[i] = 0.0
        for c in range(3):
            centre[i] += T_world_a[c, i] * (T_world_b[c, 3] - T_world_a[c, 3])
        for j in range(3):
            turn[i, j] = 0.0
            for c in range(3):
                turn[i, j] += T_world_a[c, i] * T_world_b[c, j]
    return _faces_overlap(turn, centre, half_a, half_b) and _edges_overlap(
        turn, centre, half_a, half_b
    )


@kernel
def first_overlap(ways: Any, sizes: Any, covered: Any, reach: Any, standing: Any) -> Any:
    """Index of the first of S samples at which two moving boxes share volume; S for none.

    Args:
        ways: of both boxes, two [S, 4, 4] float64, ``T_world_box`` at the same times.
        sizes: of both, (length, width, height) each [m].
        covered: [S] bool, samples at which both exist.
        reach: boxes with a larger distance of centres cannot overlap [m].
        standing: whether both are stationary, so that one sample is enough.
    """
    one, other = ways
    for s in range(len(one)):
        if not covered[s]:
            continue
        squares = 0.0
        for c in range(3):
            between = one[s, c, 3] - other[s, c, 3]
            squares += between * between
        if squares <= reach * reach and boxes_overlap(one[s], sizes[0], other[s], sizes[1]):
            return s
        if standing:
            break
    return len(one)


@kernel
def _faces_overlap(turn: Any, centre: Any, half_a: Any, half_b: Any) -> bool:
    """Whether two boxes overlap along the normals of the faces of both.

    Args:
        turn: [3, 3] ``R_a_b``.
        centre: [3] of b in the frame of a [m].
        half_a, half_b: [3] half sizes [m].
    """
    for i in range(3):
        reach_a, reach_b = half_a[i], half_b[i]
        apart = 0.0
        for j in range(3):
            reach_a += abs(turn[i, j]) * half_b[j]
            reach_b += abs(turn[j, i]) * half_a[j]
            apart += turn[j, i] * centre[j]
        if reach_a - abs(centre[i]) <= MIN_OVERLAP or reach_b - abs(apart) <= MIN_OVERLAP:
            return False
    return True


@kernel
def _edges_overlap(turn: Any, centre: Any, half_a: Any, half_b: Any) -> bool:
    """Whether two boxes overlap along the products of an edge of each; see above.

    The product of a's axis i and b's axis j is (-turn[i + 2, j], turn[i + 1, j]) in a's
    coordinates i + 1 and i + 2.
    """
    for i in range(3):
        i1, i2 = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            j1, j2 = (j + 1) % 3, (j + 2) % 3
            length = math.sqrt(turn[i1, j] * turn[i1, j] + turn[i2, j] * turn[i2, j])
            if length <= PARALLEL:
                continue
            gap = abs(centre[i2] * turn[i1, j] - centre[i1] * turn[i2, j])
            reach = half_a[i1] * abs(turn[i2, j]) + half_a[i2] * abs(turn[i1, j])
            reach += half_b[j1] * abs(turn[i, j2]) + half_b[j2] * abs(turn[i, j1])
            if (reach - gap) / length <= MIN_OVERLAP:
                return False
    return True
