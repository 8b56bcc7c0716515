"""Surfaces learned from LiDAR rays: their table, ray hits and optimisation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numba import prange
from numpy.typing import NDArray

from ..._numba import kernel
from ...geometry import Float, invert_transform, quaternion_to_matrix
from ...logs import DrivingLog
from ...render.cast.call import recorded_scene, sensor_poses
from ...render.cast.cpu import CpuCaster
from ...render.cast.types import CastRequest, RayHits
from ...scene import Beams, GaussianCloud, Lidar, LidarSurfaces, Reflector, Scene
from ...scene.cloud import UNSEEN
from .rays import RecordedRays

# --- Loss of rays ---------------------------------------------------------------------------------

# The cost of a ray is 0 at the measured return, grows with the error up to REACH, and is 1 if the
# ray does not stop. As a result, Gaussians in front of a return become transparent (line of sight),
# and those at the return become opaque and move along their normals.
# Kernels take arrays by position: Numba supports neither dataclasses nor keyword-only arguments.
#
# ruff: noqa: PLR0917


REACH = 0.3
"""Range error from which the cost is 1 [m]."""
LOGIT, SIZE, SHIFT = 0, 1, 2
"""Columns of gradients: of the opacity's logit, of the logarithm of the scales along the surface,
of a shift along the normal [1/m]."""


@kernel(nogil=True, parallel=True)
def ray_gradients(
    begins, members, alpha, tau, measured, directions, body_of, axes, scales, opacities, out, costs
):
    """Gradients of the cost of each ray with respect to its hits.

    Args:
        begins, members, alpha, tau: fields of RayHits.
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
        # Remaining cost behind an entry: the cost if the light had passed it.
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


# Background and object Gaussians as one table.

Array = NDArray[np.float32]
MAX_OPAQUE = 0.99


@dataclass(eq=False)
class SurfaceTable:
    """Flat Gaussians of all bodies; the last axis of each is its normal.

    Attributes:
        object_ids: ids of the bodies after the background.
        firsts: [bodies + 1] int64, first Gaussian of each body.
        means, quats, axes, scales: [N, 3], [N, 4], [N, 3, 3] and [N, 3] float32, initial values.
        logit, size, shift: [N] float32, learnt: logit of the opacity, logarithm of the factor of
            the scales along the surface, shift along the normal [m].
        attributes: [N, 2] float32, see ``Reflector``.
        uncertainties: [N] float32, see ``Reflector``.
    """

    object_ids: tuple[str, ...]
    firsts: NDArray[np.int64]
    means: Array
    quats: Array
    axes: Array
    scales: Array
    logit: Array
    size: Array = field(init=False)
    shift: Array = field(init=False)
    attributes: Array = field(init=False)
    uncertainties: Array = field(init=False)

    def __post_init__(self) -> None:
        count = len(self.means)
        self.size, self.shift = np.zeros((2, count), np.float32)
        self.attributes = np.zeros((count, 2), np.float32)
        self.uncertainties = np.full(count, UNSEEN, np.float32)

    @classmethod
    def of(cls, clouds: list[GaussianCloud], object_ids: tuple[str, ...]) -> SurfaceTable:
        """The table of clouds, background first."""
        means, quats, scales, opacities = (
            np.concatenate([getattr(cloud, name).numpy() for cloud in clouds])
            for name in ("means", "quats", "scales", "opacities")
        )
        axes = quaternion_to_matrix(quats).astype(np.float32)
        opacities = np.clip(opacities, 0.01, MAX_OPAQUE)
        firsts = np.cumsum([0, *map(len, clouds)]).astype(np.int64)
        return cls(
            object_ids, firsts, means, quats, axes, scales, np.log(opacities / (1 - opacities))
        )

    def __len__(self) -> int:
        return len(self.means)

    @property
    def opacities(self) -> Array:
        """[N], the learned opacities."""
        return np.minimum(1 / (1 + np.exp(-self.logit)), MAX_OPAQUE).astype(np.float32)

    @property
    def body_of(self) -> NDArray[np.int32]:
        """[N], body of each Gaussian."""
        bodies = np.arange(len(self.firsts) - 1, dtype=np.int32)
        return np.repeat(bodies, np.diff(self.firsts))

    def placed(self, scene: Scene, incidence: float = 1.0) -> Scene:
        """The scene with these surfaces for LiDARs."""
        wide = np.exp(self.size)[:, None]
        scales = np.concatenate([self.scales[:, :2] * wide, self.scales[:, 2:]], axis=1)
        means = self.means + self.axes[:, :, 2] * self.shift[:, None]
        columns = (means, self.quats, scales, self.opacities, self.uncertainties)
        parts = []
        for body in range(len(self.firsts) - 1):
            part = slice(self.firsts[body], self.firsts[body + 1])
            own = (torch.from_numpy(np.ascontiguousarray(column[part])) for column in columns)
            means_of, quats, scales_of, opacities, uncertainties = own
            sh = torch.zeros(len(means_of), 1, 3)
            cloud = GaussianCloud(means_of, quats, scales_of, opacities, sh, uncertainties)
            attributes = torch.from_numpy(self.attributes[part].copy())
            parts.append(Reflector(cloud, attributes))
        objects = dict(zip(self.object_ids, parts[1:], strict=True))
        return replace(scene, lidar=LidarSurfaces(parts[0], objects, incidence), content_hash="")

    def select(self, kept: NDArray[np.bool_]) -> SurfaceTable:
        """The Gaussians of a mask, with their learnt values."""
        counts = np.bincount(self.body_of[kept], minlength=len(self.firsts) - 1)
        laid_out = (
            getattr(self, name)[kept] for name in ("means", "quats", "axes", "scales", "logit")
        )
        made = SurfaceTable(self.object_ids, np.cumsum([0, *counts]).astype(np.int64), *laid_out)
        for name in ("size", "shift", "attributes", "uncertainties"):
            setattr(made, name, getattr(self, name)[kept])
        return made


# Hits of recorded rays.


@dataclass(frozen=True, eq=False)
class SweepHits:
    """Ray hits of one sweep, with the Gaussians numbered as in the table.

    Attributes:
        hits: see :class:`RayHits`.
        request: request of the cast.
        bodies: numbers of the bodies in the order of the request.
        of_request: [M] int32, the Gaussians numbered as in the request.
    """

    hits: RayHits
    request: CastRequest
    bodies: NDArray[np.int64]
    of_request: NDArray[np.int32]


def trace(
    table: SurfaceTable,
    scene: Scene,
    log: DrivingLog,
    *,
    frame: int,
    lidar: Lidar,
    reach: NDArray[np.float32],
) -> SweepHits:
    """Trace the rays of ``lidar`` about ``frame`` through ``scene``, which contains ``table``.

    Args:
        reach: [R], see ``CpuCaster.trace``.
    """
    t_us = int(log.frame_times_us[frame])
    targets = recorded_scene(scene, lidar, t_us)
    request = targets.request(lidar, sensor_poses(log.ego, lidar, t_us))
    found = CpuCaster().trace(request, reach)
    # Ids count from 1 over the scene's objects; the background is 0.
    bodies = np.array([instance.instance_id for instance in targets.instances])
    counts = [len(instance.cloud) for instance in targets.instances]
    shift = np.repeat(table.firsts[bodies] - (np.cumsum(counts) - counts), counts)
    members = (found.members + shift[found.members]).astype(np.int32)
    return SweepHits(replace(found, members=members), request, bodies, found.members)


def part_of(lidar: Lidar, rays: NDArray[np.int64]) -> Lidar:
    """The LiDAR reduced to the selected rays."""
    beams = lidar.beams
    chosen = Beams(beams.azimuth[rays], beams.elevation[rays], beams.time_us[rays])
    return replace(lidar, beams=chosen)


# Optimisation: opacity, size and position from the measuring rays.

RAYS = 30_000
"""Rays per step, evenly spread over a sweep."""
BEYOND = 0.5
"""Distance behind its return up to which a ray is traced [m]."""
RATES = {LOGIT: 0.15, SIZE: 0.03, SHIFT: 0.0015}
BOUNDS = {LOGIT: (-6.0, 4.6), SIZE: (-1.5, 0.5), SHIFT: (-0.05, 0.05)}
INERTIA, SCATTER = 0.9, 0.99
"""Adam's decay rates."""


@dataclass(frozen=True, eq=False)
class SeenSweep:
    """A sweep to learn from.

    Attributes:
        frame: frame of the log.
        rays: rays with a return.
        ring: [R] int32, of each ray; -1 for rays without a ring.
        elevations: [B] of the rings [rad]; [0] if the scan has no rings.
        missing: rays that were fired but did not return, if the scan has rings.
    """

    frame: int
    rays: RecordedRays
    ring: NDArray[np.int32]
    elevations: Float
    missing: tuple[Lidar, ...]


def learn_surfaces(
    table: SurfaceTable,
    scene: Scene,
    log: DrivingLog,
    sweeps: list[SeenSweep],
    *,
    steps: int,
    on_step: Callable[[int, int], None],
) -> float:
    """Learn opacity, size and shift of each Gaussian in place; return the mean cost of the last
    rays.

    Each step uses a part of the rays of one sweep, in turn. The result is deterministic, bit for
    bit.
    """
    moments = {column: _Moments.of(len(table)) for column in RATES}
    order = np.random.default_rng(0).permutation(len(sweeps))
    cost = 0.0
    for step in range(steps):
        sweep = sweeps[order[step % len(sweeps)]]
        count = len(sweep.rays.range)
        every = max(1, count // RAYS)
        chosen = np.arange(step // len(sweeps) % every, count, every)
        seen, gradients, cost = _gradients(table, scene, log, sweep, chosen)
        for column, values in enumerate((table.logit, table.size, table.shift)):
            moments[column].step(values, gradients[:, column], seen, RATES[column])
            np.clip(values, *BOUNDS[column], out=values)
        on_step(step + 1, steps)
    return cost


def _gradients(
    table: SurfaceTable,
    scene: Scene,
    log: DrivingLog,
    sweep: SeenSweep,
    chosen: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.float32], float]:
    """Gaussians that these rays hit, gradients [seen, 3] and the mean cost of a ray."""
    lidar, measured = part_of(sweep.rays.lidar, chosen), sweep.rays.range[chosen]
    reach = (measured + BEYOND).astype(np.float32)
    met = trace(table, table.placed(scene), log, frame=sweep.frame, lidar=lidar, reach=reach)
    found = met.hits
    out, costs = np.empty((len(found.members), 3), np.float32), np.empty(len(measured))
    wide = np.exp(table.size)[:, None]
    ray_gradients(
        found.begins,
        found.members,
        found.alpha,
        found.tau,
        measured,
        _directions(table, met),
        table.body_of,
        table.axes,
        np.concatenate([table.scales[:, :2] * wide, table.scales[:, 2:]], axis=1),
        table.opacities,
        out,
        costs,
    )
    seen = np.flatnonzero(np.bincount(found.members, minlength=len(table)))
    sums = [np.bincount(found.members, out[:, k], len(table))[seen] for k in range(3)]
    return seen, np.stack(sums, axis=1).astype(np.float32), float(costs.mean())


def _directions(table: SurfaceTable, met: SweepHits) -> NDArray[np.float32]:
    """[bodies, R, 3], unit, of the rays in the frame of each body; zeros for absent bodies."""
    request = met.request
    beams = request.lidar.beams
    slots, turns = beams.slots[1], request.T_world_lidar[:, :3, :3]
    world = np.einsum("rij,rj->ri", turns[slots], beams.directions)
    directions = np.zeros((len(table.firsts) - 1, beams.count, 3), np.float32)
    for index, body in enumerate(met.bodies):
        poses = request.object_poses[index]
        if poses is None:
            directions[body] = world
        else:
            to_body = invert_transform(poses)[:, :3, :3]
            directions[body] = np.einsum("rij,rj->ri", to_body[slots], world)
    return directions


@dataclass(frozen=True, eq=False)
class _Moments:
    """Adam for the Gaussians hit in a step."""

    mean: NDArray[np.float32]
    square: NDArray[np.float32]
    steps: NDArray[np.int32]

    @classmethod
    def of(cls, count: int) -> _Moments:
        return cls(
            np.zeros(count, np.float32), np.zeros(count, np.float32), np.zeros(count, np.int32)
        )

    def step(
        self,
        values: NDArray[np.float32],
        gradient: NDArray[np.float32],
        seen: NDArray[np.int64],
        rate: float,
    ) -> None:
        self.steps[seen] += 1
        mean = INERTIA * self.mean[seen] + (1 - INERTIA) * gradient
        square = SCATTER * self.square[seen] + (1 - SCATTER) * gradient**2
        self.mean[seen], self.square[seen] = mean, square
        # Bias correction of both moments.
        mean = mean / (1 - INERTIA ** self.steps[seen])
        square = square / (1 - SCATTER ** self.steps[seen])
        values[seen] -= (rate * mean / (np.sqrt(square) + 1e-8)).astype(np.float32)
