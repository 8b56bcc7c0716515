"""What recorded rays meet of a set in the making."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...logs import DrivingLog
from ...render.cast.call import recorded_scene, sensor_poses
from ...render.cast.cpu import CpuCaster
from ...render.cast.types import CastRequest, Meetings
from ...scene import Beams, Lidar, Scene
from .gaussians import SurfaceTable


@dataclass(frozen=True, eq=False)
class MetBySweep:
    """Meetings of one sweep, its Gaussians numbered as in the table.

    Attributes:
        meetings: see there.
        request: of the cast.
        bodies: numbers of the bodies in the order of the request.
        of_request: [M] int32, the Gaussians numbered as in the request.
    """

    meetings: Meetings
    request: CastRequest
    bodies: NDArray[np.int64]
    of_request: NDArray[np.int32]


def meet(
    table: SurfaceTable,
    scene: Scene,
    log: DrivingLog,
    *,
    frame: int,
    lidar: Lidar,
    reach: NDArray[np.float32],
) -> MetBySweep:
    """Follow the rays of ``lidar`` about ``frame`` through ``scene``, which holds ``table``.

    Args:
        reach: [R], see ``CpuCaster.meetings``.
    """
    t_us = int(log.frame_times_us[frame])
    met = recorded_scene(scene, lidar, t_us)
    request = met.request(lidar, sensor_poses(log.ego, lidar, t_us))
    found = CpuCaster().meetings(request, reach)
    # Ids count from 1 over the scene's objects; the background has 0.
    bodies = np.array([instance.instance_id for instance in met.instances])
    counts = [len(instance.cloud) for instance in met.instances]
    shift = np.repeat(table.firsts[bodies] - (np.cumsum(counts) - counts), counts)
    members = (found.members + shift[found.members]).astype(np.int32)
    return MetBySweep(replace(found, members=members), request, bodies, found.members)


def part_of(lidar: Lidar, rays: NDArray[np.int64]) -> Lidar:
    """The LiDAR with these of its rays alone."""
    beams = lidar.beams
    chosen = Beams(beams.azimuth[rays], beams.elevation[rays], beams.time_us[rays])
    return replace(lidar, beams=chosen)
