"""The set of Gaussians that LiDARs see: flat, opaque, made of sweeps, with a reflectivity each.

Images leave haze before and behind surfaces, which a beam measures. Surfaces of the sweeps
themselves do not, and need no training. Reflectivity is what the recorded sweeps brought back from
each Gaussian, by the share of light that it stopped (one pass of back-projection).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from ...logs import DrivingLog, log_of_frames
from ...render.cast.call import checked_request
from ...render.cast.cpu.backend import CpuCaster
from ...render.cast.recorded import recorded_scene, sensor_poses
from ...scene import GaussianCloud, LidarSurfaces, Reflector, Scene
from ..initialise.stage0 import initialise_scene
from ..options import InitialiseOptions, ReconstructError
from ..stages import OnProgress, Stages
from .rays import RecordedRays, recorded_rays

THINNED = 0.3
"""Share of the thickness of a surface of images that is left: a beam measures millimetres."""
MAX_SWEEPS = 40
PRIOR = 0.05
"""Light that the mean reflectivity of all counts for."""
UNKNOWN = 0.3
"""Reflectivity where no sweep met anything in a scene."""


@dataclass(frozen=True)
class SurfacesReport:
    """What was made.

    Attributes:
        gaussians: of background and objects.
        sweeps: back-projected ones.
        known: share of the Gaussians that a recorded beam met.
        timing_s: seconds by stage.
    """

    gaussians: int
    sweeps: int
    known: float
    timing_s: dict[str, float]


def fit_lidar_surfaces(
    scene: Scene,
    log: DrivingLog,
    *,
    surfaces: Scene | None = None,
    options: InitialiseOptions | None = None,
    on_progress: OnProgress | None = None,
) -> tuple[Scene, SurfacesReport]:
    """The scene with a set for LiDARs made of ``log``, frames that it holds out left aside.

    Args:
        scene: made of ``log``.
        log: with LiDAR sweeps.
        surfaces: what ``initialise_scene`` makes of the same frames, where it is at hand: training
            leaves it as ``initial.r2s`` in its folder. Made anew by default.
        options: of the surfaces, see ``initialise_scene``.
        on_progress: called with the stage, steps done and steps in all.

    Raises:
        ReconstructError: the log has no sweeps.
        LogError: a file of the log cannot be read.
    """
    timing_s: dict[str, float] = {}
    stages = Stages(on_progress, timing_s)
    held_out = set(_held_out(scene))
    frames = [frame for frame in range(log.frame_count) if frame not in held_out]
    if surfaces is None:
        surfaces = initialise_scene(
            log_of_frames(log, frames), options=options, on_progress=on_progress, timing_s=timing_s
        )
    bare = replace(surfaces, lidar=_reflectors(surfaces, None), content_hash="")
    chosen = sorted({frames[i] for i in np.linspace(0, len(frames) - 1, MAX_SWEEPS).astype(int)})
    sums: NDArray[np.float64] | None = None
    sweeps = 0
    with stages("reflectivity") as report_step:
        for done, frame in enumerate(chosen):
            rays = recorded_rays(log, frame)
            if rays is not None:
                found = _gather(bare, log, frame, rays)
                sums, sweeps = (found if sums is None else sums + found), sweeps + 1
            report_step(done + 1, len(chosen))
    if sums is None:
        raise ReconstructError(f"log {log.name!r} has no LiDAR sweeps to make surfaces of")
    lidar = _reflectors(surfaces, sums)
    known = float((sums[:, 0] > 0).mean())
    report = SurfacesReport(lidar.gaussian_count, sweeps, known, timing_s)
    return replace(scene, lidar=lidar, content_hash=""), report


def _held_out(scene: Scene) -> Sequence[int]:
    made = scene.provenance.get("reconstruction")
    listed = made.get("held_out_frames") if isinstance(made, dict) else None
    return listed if isinstance(listed, list) else []


def _gather(bare: Scene, log: DrivingLog, frame: int, rays: RecordedRays) -> NDArray[np.float64]:
    """Sums [N, 4] over background and all objects in the order of the scene."""
    t_us = int(log.frame_times_us[frame])
    met = recorded_scene(bare, rays.lidar, t_us)
    request = checked_request(
        met.instances,
        rays.lidar,
        sensor_poses(log.ego, rays.lidar, t_us),
        object_poses=met.poses,
        attributes=met.attributes,
    )
    known = np.full((len(rays.range), 2), -1.0, np.float32)
    known[:, 0] = np.clip(rays.intensity, 0, 1)
    found = CpuCaster().gather(request, known)
    sums = np.zeros((bare.gaussian_count, 4))
    firsts = np.cumsum([0, len(bare.background), *(len(o.cloud) for o in bare.objects.values())])
    first = 0
    for instance in met.instances:
        count = len(instance.cloud)
        # Ids count from 1 over the scene's objects; the background has 0.
        place = int(firsts[instance.instance_id])
        sums[place : place + count] += found[first : first + count]
        first += count
    return sums


def _reflectors(surfaces: Scene, sums: NDArray[np.float64] | None) -> LidarSurfaces:
    clouds = [surfaces.background, *(o.cloud for o in surfaces.objects.values())]
    total = sum(map(len, clouds))
    values = np.full(total, UNKNOWN, np.float32)
    if sums is not None:
        met = sums[:, 0] > 0
        mean = float(sums[:, 1].sum() / max(sums[:, 0].sum(), 1e-9))
        # What few rays met leans on the mean of all.
        values = ((sums[:, 1] + PRIOR * mean) / (sums[:, 0] + PRIOR)).astype(np.float32)
        values[~met] = mean
    attributes = np.stack([np.clip(values, 0, 1), np.zeros(total, np.float32)], axis=1)
    parts: list[Reflector] = []
    first = 0
    for cloud in clouds:
        own = torch.from_numpy(attributes[first : first + len(cloud)].copy())
        parts.append(Reflector(_thinned(cloud), own))
        first += len(cloud)
    return LidarSurfaces(parts[0], dict(zip(surfaces.objects, parts[1:], strict=True)))


def _thinned(cloud: GaussianCloud) -> GaussianCloud:
    """The cloud with its shortest axes shortened, without bands of colour."""
    thinnest = cloud.scales.argmin(1, keepdim=True)
    share = torch.ones_like(cloud.scales).scatter_(1, thinnest, THINNED)
    return replace(
        cloud,
        scales=cloud.scales * share,
        sh=torch.zeros(len(cloud), 1, 3),
    )
