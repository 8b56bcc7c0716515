"""Reflectivity of each Gaussian and loss of beams, fitted to recorded intensities."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...logs import DrivingLog
from ...render.cast.call import facing_of_request
from ...scene import Scene
from ...scene.cloud import UNSEEN
from ...scene.lidar_surfaces import MAX_REFLECTIVITY, RANGE_STEPS, RingResponse
from .learn import SeenSweep, SurfaceTable, part_of, trace

# Reflectivity from recorded intensities.
#
# A recorded intensity is the light returned by the surfaces along a ray, weighted by the share that
# each one stops, times the sensor's response. Part of the reflection is independent of the
# incidence, the rest follows its cosine; a scene has one value for this share. The response of a
# laser depends on the range: each ring has a gain and an offset per range step.

RAYS = 60_000
"""Rays per sweep, evenly spread."""
LITTLE = 0.01
"""Smaller shares of a ray's light are ignored."""
INCIDENCES = (1.0, 0.8, 0.6, 0.4, 0.25, 0.15)
"""Candidate shares of light that is independent of the incidence; the best one is used."""
PRIOR = 0.5
"""Weight of the mean reflectivity as a prior, in units of light."""
TRUST = 20.0
"""Weight of the prior that all rings respond alike, in rays."""
ROUNDS, INNER = 5, 4
DARKEST = 1e-3
"""Minimum reflectivity: every surface with a return reflects some light."""
UNKNOWN = 0.3
"""Reflectivity of a scene in which no sweep hit anything."""


@dataclass(frozen=True, eq=False)
class FittedReflectivity:
    """Result of the fit.

    Attributes:
        incidence: see ``LidarSurfaces``.
        response: response of the rings; None if sweeps have no rings.
        known: share of the Gaussians that a ray hit.
        residual: root mean square of recorded minus explained intensities.
    """

    incidence: float
    response: RingResponse | None
    known: float
    residual: float


@dataclass(frozen=True, eq=False)
class LitRays:
    """Rays of all sweeps with a return, and the Gaussians they hit.

    Attributes:
        ray, member: [M], ray and Gaussian of each hit.
        share: [M] of the light that the ray loses.
        facing: [M] cosine of the incidence.
        intensity: [R] float64, as recorded.
        cell: [R] int64, ring and range step of a response.
        rings: [B] elevations of the rings [rad]; [0] if scans have no rings.
        every: [sweeps], stride of the used rays in each sweep.
    """

    ray: NDArray[np.int32]
    member: NDArray[np.int32]
    share: NDArray[np.float32]
    facing: NDArray[np.float32]
    intensity: NDArray[np.float64]
    cell: NDArray[np.int64]
    rings: NDArray[np.float64]
    every: tuple[int, ...]


def light_of(
    table: SurfaceTable,
    scene: Scene,
    log: DrivingLog,
    sweeps: list[SeenSweep],
    *,
    on_sweep: Callable[[int, int], None],
) -> LitRays:
    """Trace the rays of all sweeps until their light is exhausted."""
    placed = table.placed(scene)
    rings = sweeps[0].elevations
    columns: list[tuple[NDArray[Any], ...]] = []
    every: list[int] = []
    rays_so_far = 0
    for done, sweep in enumerate(sweeps):
        rays = sweep.rays
        every.append(max(1, -(-len(rays.range) // RAYS)))
        chosen = np.arange(0, len(rays.range), every[-1])
        lidar = part_of(rays.lidar, chosen)
        met = trace(
            table, placed, log, frame=sweep.frame, lidar=lidar,
            reach=np.zeros(len(chosen), np.float32),
        )  # fmt: skip
        found = met.hits
        row = np.zeros(len(chosen), np.int64)
        if len(rings) and len(sweep.elevations):
            row = RingResponse.rows(rings, sweep.elevations, sweep.ring[chosen])
        ray = np.repeat(np.arange(len(chosen)), np.diff(found.begins))
        share = stopped_shares(found.alpha, found.begins, ray)
        # The facing of a Gaussian is evaluated at its centre, as in a cast.
        facing = np.concatenate(facing_of_request(met.request))
        kept = share > LITTLE
        columns.append(
            (
                (ray[kept] + rays_so_far).astype(np.int32),
                found.members[kept],
                share[kept],
                facing[met.of_request[kept]],
                rays.intensity[chosen].astype(np.float64),
                row * (len(RANGE_STEPS) - 1) + RingResponse.step_of(rays.range[chosen]),
            )
        )
        rays_so_far += len(chosen)
        on_sweep(done + 1, len(sweeps))
    ray_of, member, share_of, facing_of, intensity, cell = (
        np.concatenate(parts) for parts in zip(*columns, strict=True)
    )
    return LitRays(
        ray_of, member, share_of, facing_of, intensity, cell, rings=rings, every=tuple(every)
    )


def fit_reflectivity(table: SurfaceTable, lit: LitRays) -> FittedReflectivity:
    """Fit the reflectivity of each Gaussian, in place, and the common parameters; also writes the
    uncertainties.
    """
    cells = max(len(lit.rings), 1) * (len(RANGE_STEPS) - 1)
    gain, offset = np.ones(cells), np.zeros(cells)
    incidence = min(INCIDENCES, key=lambda given: _misfit(lit, given, len(table)))
    lambert = lit.share * (incidence + (1 - incidence) * lit.facing)
    values = np.full(len(table), lit.intensity.mean() if len(lit.intensity) else UNKNOWN)
    for _ in range(ROUNDS):
        values = _reflectivities(lit, lambert, values, gain, offset)
        light = lambert * values[lit.member]
        explained = np.bincount(lit.ray, light, len(lit.intensity)).astype(np.float64)
        if len(lit.rings):
            gain, offset = _responses(lit, explained, cells)
    stopped = np.bincount(lit.member, lit.share, len(table))
    table.uncertainties[:] = UNSEEN / (1 + stopped)
    hit = stopped > 0
    off = lit.intensity - explained * gain[lit.cell] - offset[lit.cell]
    table.attributes[:, 0] = np.clip(values, DARKEST, MAX_REFLECTIVITY)
    if hit.any():
        table.attributes[~hit, 0] = np.median(table.attributes[hit, 0])
    response = None
    if len(lit.rings):
        shape = (len(lit.rings), len(RANGE_STEPS) - 1)
        response = RingResponse(
            lit.rings.astype(np.float32),
            gain.reshape(shape).astype(np.float32),
            offset.reshape(shape).astype(np.float32),
        )
    residual = float(np.sqrt(np.mean(off**2))) if len(off) else float("nan")
    return FittedReflectivity(incidence, response, float(hit.mean()), residual)


def stopped_shares(
    alpha: NDArray[np.float32], begins: NDArray[np.int64], ray: NDArray[np.int64]
) -> NDArray[np.float32]:
    """Share [M] of a ray's lost light that it loses at each of its hits."""
    passed = np.log1p(-np.minimum(alpha, 0.9999).astype(np.float64))
    total = np.cumsum(passed)
    before = total - passed - np.concatenate([[0.0], total])[begins[:-1]][ray]
    weight = alpha * np.exp(before)
    stopped = np.bincount(ray, weight, len(begins) - 1)
    share: NDArray[np.float32] = (weight / np.maximum(stopped, 1e-9)[ray]).astype(np.float32)
    return share


def _misfit(lit: LitRays, incidence: float, count: int) -> float:
    """Mean squared residual after one pass of back-projection."""
    lambert = lit.share * (incidence + (1 - incidence) * lit.facing)
    start = np.full(count, lit.intensity.mean() if len(lit.intensity) else UNKNOWN)
    one = np.ones(1)
    values = _reflectivities(lit, lambert, start, one, 0 * one)
    off = lit.intensity - np.bincount(lit.ray, lambert * values[lit.member], len(lit.intensity))
    return float(np.mean(off**2)) if len(off) else 0.0


def _reflectivities(
    lit: LitRays,
    lambert: NDArray[np.float32],
    values: NDArray[np.float64],
    gain: NDArray[np.float64],
    offset: NDArray[np.float64],
) -> NDArray[np.float64]:
    """A few rounds of simultaneous iterative reconstruction (SIRT), starting at ``values`` [N]."""
    one = len(gain) == 1
    factor = lambert if one else lambert * gain[lit.cell][lit.ray]
    wanted = lit.intensity if one else lit.intensity - offset[lit.cell]
    # Each hit is weighted by its share, the light on the Gaussian.
    light = np.bincount(lit.member, factor * factor / np.maximum(lit.share, 1e-6), len(values))
    mean = float(np.average(values, weights=light)) if light.sum() > 0 else UNKNOWN
    rays = _matrix(lit.ray, lit.member, factor, (len(wanted), len(values)))
    for _ in range(INNER):
        pull = rays.T @ (wanted - rays @ values)
        values = values + (pull + PRIOR * (mean - values)) / (light + PRIOR)
    return values


def _matrix(
    ray: NDArray[Any], member: NDArray[np.int32], weight: NDArray[Any], shape: tuple[int, int]
) -> Any:
    """Sparse matrix of hits [R, N], from hits [M] by increasing ray."""
    from scipy.sparse import csr_array

    begins = np.concatenate([[0], np.cumsum(np.bincount(ray, minlength=shape[0]))])
    return csr_array((weight.astype(np.float64), member, begins), shape=shape)


def _responses(
    lit: LitRays, explained: NDArray[np.float64], cells: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Gain and offset of each cell by least squares, regularised towards its ring; rings are
    regularised towards 1 and 0.
    """
    steps = len(RANGE_STEPS) - 1
    mean_square = float(np.mean(explained**2))
    moments = np.stack(
        [
            np.bincount(lit.cell, values, cells).astype(np.float64)
            for values in (
                explained**2,
                explained,
                np.ones(len(explained)),
                explained * lit.intensity,
                lit.intensity,
            )
        ]
    )
    of_ring = moments.reshape(5, -1, steps).sum(2)
    one = np.ones(of_ring.shape[1])
    gain, offset = _line(of_ring, one, 0 * one, mean_square)
    return _line(moments, np.repeat(gain, steps), np.repeat(offset, steps), mean_square)


def _line(
    moments: NDArray[np.float64],
    gain: NDArray[np.float64],
    offset: NDArray[np.float64],
    mean_square: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Line fits from sums of xx, x, 1, xy and y, regularised towards other lines by TRUST."""
    xx, x, one, xy, y = moments
    xx, xy = xx + TRUST * mean_square, xy + TRUST * mean_square * gain
    one, y = one + TRUST, y + TRUST * offset
    determinant = xx * one - x**2
    return (one * xy - x * y) / determinant, (xx * y - x * xy) / determinant


# Beam loss: on glass, on dark or wet surfaces, and on mirrors.
#
# The loss probability of a Gaussian is learned from the rays that would stop there, returned or
# not, where the rings of a scan reveal the fired rays.

LOSS_PRIOR = 0.5
"""Weight of the mean loss as a prior, in units of light."""
LOSS_ROUNDS = 8


def fit_losses(
    table: SurfaceTable,
    scene: Scene,
    log: DrivingLog,
    sweeps: list[SeenSweep],
    *,
    lit: LitRays,
    on_sweep: Callable[[int, int], None],
) -> None:
    """Fit the share of lost rays of each Gaussian, in place; 0 if no sweep provides evidence.

    Args:
        lit: the rays of ``sweeps`` with a return.
    """
    returned = len(lit.intensity)
    rays, members, shares = [lit.ray.astype(np.int64)], [lit.member], [lit.share]
    placed, before = table.placed(scene), returned
    for done, (sweep, every) in enumerate(zip(sweeps, lit.every, strict=True)):
        for lidar in sweep.missing:
            # The same stride as for returned rays, so that the shares are unbiased.
            chosen = np.arange(0, lidar.beams.count, every)
            met = trace(
                table, placed, log, frame=sweep.frame, lidar=part_of(lidar, chosen),
                reach=np.zeros(len(chosen), np.float32),
            ).hits  # fmt: skip
            ray = np.repeat(np.arange(len(chosen)), np.diff(met.begins))
            share = stopped_shares(met.alpha, met.begins, ray)
            kept = share > LITTLE
            rays.append(ray[kept] + before)
            members.append(met.members[kept])
            shares.append(share[kept])
            before += len(chosen)
        on_sweep(done + 1, len(sweeps))
    if before > returned:
        table.attributes[:, 1] = _solved(
            np.concatenate(rays),
            np.concatenate(members),
            np.concatenate(shares),
            np.repeat([0.0, 1.0], [returned, before - returned]),
            len(table),
        )


def _solved(
    ray: NDArray[np.int64],
    member: NDArray[np.int32],
    share: NDArray[np.float32],
    lost: NDArray[np.float64],
    count: int,
) -> NDArray[np.float32]:
    """Shares of lost rays [N], 0 to 1, that explain the lost rays by least squares."""
    light = np.bincount(member, share, count)
    mean = float(lost.mean())
    values = np.full(count, mean)
    rays = _matrix(ray, member, share, (len(lost), count))
    for _ in range(LOSS_ROUNDS):
        pull = rays.T @ (lost - rays @ values)
        values = np.clip(
            values + (pull + LOSS_PRIOR * (mean - values)) / (light + LOSS_PRIOR), 0, 1
        )
    values[light == 0] = 0
    return values.astype(np.float32)
