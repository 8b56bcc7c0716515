"""Where beams are lost: on glass, on what is dark or wet, on what mirrors them away.

A Gaussian's share of lost rays is learned from the rays that would have stopped there: those that
returned and those that did not, where the rings of a scan tell which were fired.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ...logs import DrivingLog
from ...scene import Scene
from .learn import SeenSweep, SurfaceTable, meet, part_of
from .reflectivity import LITTLE, LitRays, stopped_shares

PRIOR = 0.5
"""Light that the mean share of all counts for."""
ROUNDS = 8


def fit_losses(
    table: SurfaceTable,
    scene: Scene,
    log: DrivingLog,
    sweeps: list[SeenSweep],
    *,
    lit: LitRays,
    on_sweep: Callable[[int, int], None],
) -> None:
    """Fit the share of lost rays of each Gaussian, in place; none where no sweep tells.

    Args:
        lit: the rays of ``sweeps`` that returned.
    """
    returned = len(lit.intensity)
    rays, members, shares = [lit.ray.astype(np.int64)], [lit.member], [lit.share]
    placed, before = table.placed(scene), returned
    for done, (sweep, every) in enumerate(zip(sweeps, lit.every, strict=True)):
        for lidar in sweep.missing:
            # As many as of those that returned, or shares would be wrong.
            chosen = np.arange(0, lidar.beams.count, every)
            met = meet(
                table, placed, log, frame=sweep.frame, lidar=part_of(lidar, chosen),
                reach=np.zeros(len(chosen), np.float32),
            ).meetings  # fmt: skip
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
    """Shares of lost rays [N], 0 to 1, that explain which rays were lost, by least squares."""
    light = np.bincount(member, share, count)
    mean = float(lost.mean())
    values = np.full(count, mean)
    for _ in range(ROUNDS):
        off = lost - np.bincount(ray, share * values[member], len(lost))
        pull = np.bincount(member, share * off[ray], count)
        values = np.clip(values + (pull + PRIOR * (mean - values)) / (light + PRIOR), 0, 1)
    values[light == 0] = 0
    return values.astype(np.float32)
