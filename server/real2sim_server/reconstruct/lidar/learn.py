"""Surfaces learned from the rays that measured them: what is opaque, how large, and where."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...geometry.transform import Float, invert_transform
from ...logs import DrivingLog
from ...scene import Lidar, Scene
from .gaussians import SurfaceTable
from .meetings import MetBySweep, meet, part_of
from .ray_loss import LOGIT, SHIFT, SIZE, ray_gradients
from .rays import RecordedRays

RAYS = 30_000
"""Of one step, evenly spread over a sweep."""
BEYOND = 0.5
"""How far behind its return a ray is followed [m]."""
RATES = {LOGIT: 0.15, SIZE: 0.03, SHIFT: 0.0015}
BOUNDS = {LOGIT: (-6.0, 4.6), SIZE: (-1.5, 0.5), SHIFT: (-0.05, 0.05)}
INERTIA, SCATTER = 0.9, 0.99
"""Of Adam."""


@dataclass(frozen=True, eq=False)
class SeenSweep:
    """A sweep to learn from.

    Attributes:
        frame: of the log.
        rays: that returned.
        ring: [R] int32, of each ray; -1 for those of none.
        elevations: [B] of the rings [rad]; [0] where the scan is not by rings.
        missing: rays that were fired and did not return, where rings tell.
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
    """Learn opacity, size and shift of each Gaussian in place; the mean cost of the last rays.

    Each step takes a part of the rays of one sweep, in turns. The same input gives the same bits.
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
    """Gaussians that these rays meet, gradients [seen, 3] and the mean cost of a ray."""
    lidar, measured = part_of(sweep.rays.lidar, chosen), sweep.rays.range[chosen]
    reach = (measured + BEYOND).astype(np.float32)
    met = meet(table, table.placed(scene), log, frame=sweep.frame, lidar=lidar, reach=reach)
    found = met.meetings
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


def _directions(table: SurfaceTable, met: MetBySweep) -> NDArray[np.float32]:
    """[bodies, R, 3], unit, of the rays in the frame of each body; zeros of those not there."""
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
    """Adam for the Gaussians that a step sees."""

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
        # The youth of both sums.
        mean = mean / (1 - INERTIA ** self.steps[seen])
        square = square / (1 - SCATTER ** self.steps[seen])
        values[seen] -= (rate * mean / (np.sqrt(square) + 1e-8)).astype(np.float32)
