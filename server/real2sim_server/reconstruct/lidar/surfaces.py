"""Gaussians seen by LiDARs: flat, learned from sweeps, each with a reflectivity."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from ...geometry import Float, apply_transform, invert_transform
from ...logs import DrivingLog, ObjectTrack, log_of_frames
from ...scene import GaussianCloud, Scene
from ..initialise.accumulate import (
    SHELL,
    PointSet,
    drive_path,
    near_box,
    on_recording_vehicle,
    path_distance,
    thin,
    thin_to,
    voxel_levels,
    well_supported,
)
from ..initialise.stage0 import initialise_scene
from ..initialise.surfels import Surfels, fit_surfels
from ..options import InitialiseOptions, OnProgress, ReconstructError, Stages
from .learn import SeenSweep, SurfaceTable, learn_surfaces
from .rays import RecordedRays, fit_rings, recorded_rays
from .reflectivity import fit_losses, fit_reflectivity, light_of

# Flat Gaussians on the measured points, separate for background and objects.

VOXEL, VOXEL_PER_METRE = 0.1, 0.006
"""Edge of voxels in the background [m], and its growth with the distance from the drive."""
OBJECT_VOXEL = 0.05
MAX_BACKGROUND, MAX_OBJECT = 300_000, 40_000
MAX_OBJECT_SURFEL = 0.15
"""Maximum scale along surfaces of objects [m]."""
MIN_SCALE = 0.004
"""Minimum scale along normals [m]; beams measure to millimetres."""
FLATTER = 0.3
"""Kept share of the thickness of neighbourhoods. The rest is beam noise."""
ROAD_BAND = 0.05
"""Maximum height of road points above the bottom of a box [m]."""
MOVES = 0.3
"""Extent of a trajectory above which its object counts as moving, with nearby points [m]."""
BOX_MARGIN = 0.12
GAP, GAP_PER_METRE = 0.3, 0.01
"""Scene surfaces are used where no point was measured within this distance [m], which grows with
the range."""
FAR = 120.0
"""Maximum range of returns used for surfaces [m]. Farther ones are too sparse."""
THIN_EVERY = 4_000_000
OPACITY = 0.95


class MeasuredPoints:
    """Points of sweeps by body, thinned as they are added."""

    def __init__(self, log: DrivingLog) -> None:
        self._log = log
        self._path = drive_path(log)
        self._parts: list[list[PointSet]] = [[] for _ in range(len(log.tracks) + 1)]
        self._pending = 0

    def add(self, frame: int, rays: RecordedRays) -> NDArray[np.int64]:
        """Add the points of the sweep of ``frame``; returns the body of each ray, see
        :func:`bodies_of`.
        """
        body, places = bodies_of(self._log, frame, rays)
        near = rays.range < FAR
        for number, parts in enumerate(self._parts):
            mine = (body == number) & near
            if mine.any():
                parts.append(PointSet.measured(places[mine], rays.intensity[mine]))
        self._pending += len(rays.range)
        if self._pending > THIN_EVERY:
            self._parts = [[self._thinned(number)] for number in range(len(self._parts))]
            self._pending = 0
        return body

    def clouds(self, surfaces: Scene) -> list[GaussianCloud]:
        """Gaussians of the background and of each object, filled up from ``surfaces``."""
        own = [surfaces.background, *(o.cloud for o in surfaces.objects.values())]
        return [self._cloud(number, cloud) for number, cloud in enumerate(own)]

    def _thinned(self, number: int) -> PointSet:
        points = PointSet.join(self._parts[number])
        if number or len(points) == 0:
            return thin(points, OBJECT_VOXEL)
        distance = path_distance(points.points, self._path)
        return thin(points, VOXEL, voxel_levels(distance, VOXEL, VOXEL_PER_METRE))

    def _cloud(self, number: int, completion: GaussianCloud) -> GaussianCloud:
        points = self._thinned(number)
        if number:
            points = thin_to(points, OBJECT_VOXEL, MAX_OBJECT)
            return _filled(
                points,
                fit_surfels(points.points, largest=MAX_OBJECT_SURFEL, smallest=MIN_SCALE),
                completion,
                np.zeros(len(completion), np.float32),
            )
        if len(points):
            distance = path_distance(points.points, self._path)
            points = points.select(well_supported(points.points, 0.1 + 0.02 * distance))
            levels = voxel_levels(path_distance(points.points, self._path), VOXEL, VOXEL_PER_METRE)
            points = thin_to(points, VOXEL, MAX_BACKGROUND, levels)
        distance = np.zeros(0, np.float32)
        if len(points):
            distance = path_distance(points.points, self._path)
        largest = (VOXEL + 0.03 + 0.008 * distance).astype(np.float32)
        surfels = fit_surfels(points.points, largest=largest, smallest=MIN_SCALE)
        away = path_distance(completion.means.numpy(), self._path)
        return _filled(points, surfels, completion, away)


def bodies_of(log: DrivingLog, frame: int, rays: RecordedRays) -> tuple[NDArray[np.int64], Float]:
    """Body of each ray of a sweep, and its points [R, 3] in that body's frame.

    0 is the background, -1 the recording vehicle itself, otherwise 1 + the track's index.
    """
    t_us, offset_us = int(log.frame_times_us[frame]), rays.lidar.beams.time_us
    world = np.asfortranarray(rays.points)
    body, places = np.zeros(len(world), np.int64), rays.points.copy()
    nearest = np.full(len(world), np.inf)
    for index, track in enumerate(log.tracks):
        if not track.trajectory.covers(t_us):
            continue
        chosen, in_box = near_box(world, offset_us, track, t_us)
        half = np.array(track.size) / 2
        outside = (np.abs(in_box) - half).max(axis=1)
        mine = (outside <= _margin(track)) & (in_box[:, 2] + half[2] > ROAD_BAND)
        mine &= outside < nearest[chosen]
        body[chosen[mine]], places[chosen[mine]] = index + 1, in_box[mine]
        nearest[chosen[mine]] = outside[mine]
    in_vehicle = apply_transform(invert_transform(log.ego.transform(t_us)), rays.points)
    body[on_recording_vehicle(in_vehicle, log.ego_size)] = -1
    return body, places


def _margin(track: ObjectTrack) -> float:
    moves = float(np.ptp(track.trajectory.positions, axis=0).max()) > MOVES
    return SHELL if moves else BOX_MARGIN


def _filled(
    points: PointSet, surfels: Surfels, completion: GaussianCloud, away: NDArray[np.float32]
) -> GaussianCloud:
    """Gaussians of surfels, and the Gaussians of a completion [M] without a point nearby."""
    from scipy.spatial import cKDTree

    means = completion.means.numpy()
    far = np.ones(len(means), np.bool_)
    if len(points) and len(means):
        distance, _ = cKDTree(points.points).query(means, workers=-1)
        far = distance > GAP + GAP_PER_METRE * away
    flat = np.array([1, 1, FLATTER], np.float32)
    scales = np.concatenate([surfels.scales, completion.scales.numpy()[far]]) * flat
    opacities = np.full(len(scales), OPACITY, np.float32)
    columns = (
        np.concatenate([surfels.points, means[far]]),
        np.concatenate([surfels.quats, completion.quats.numpy()[far]]),
        scales,
        opacities,
    )
    means_of, quats, scales_of, opacities_of = (
        torch.from_numpy(np.ascontiguousarray(column)) for column in columns
    )
    colours = torch.zeros(len(opacities), 1, 3)
    return GaussianCloud(means_of, quats, scales_of, opacities_of, colours)


# The complete set.
#
# Training on images leaves haze around surfaces that a beam would measure. LiDAR surfaces are
# therefore placed on the measured points, completed from the scene elsewhere, and learned from the
# rays. Reflectivity is fitted last.

MAX_SWEEPS = 40
"""Maximum number of sweeps for learning; every sweep provides points."""
STEPS = 60
"""Default number of steps; each uses a part of the rays of one sweep."""
WITHOUT_LOOKS = InitialiseOptions(
    max_background=120_000,
    max_object=8_000,
    voxel=0.1,
    object_voxel=0.05,
    ground_spacing=0.12,
    feature_images=0,
    stereo_images=0,
    max_colour_frames=8,
    samples=2,
    sky_resolution=32,
    lanes="none",
)
"""Default options of the completion: shapes without colours, because beams do not see colours."""
MIN_OPACITY = 0.02
"""Minimum opacity. Gaussians below it are removed at the end."""


@dataclass(frozen=True)
class SurfacesReport:
    """Result of building surfaces.

    Attributes:
        gaussians: number in background and objects.
        sweeps: number of sweeps for learning.
        held_out: frames that were not used.
        known: share of the Gaussians that a recorded beam hit.
        incidence: share of reflected light that is independent of the incidence.
        cost: mean over the last rays, 0 if all light stops at the measured return, 1 if none does.
        intensity_residual: root mean square of the unexplained intensities.
        timing_s: seconds by stage.
    """

    gaussians: int
    sweeps: int
    held_out: tuple[int, ...]
    known: float
    incidence: float
    cost: float
    intensity_residual: float
    timing_s: dict[str, float]


def fit_lidar_surfaces(
    scene: Scene,
    log: DrivingLog,
    *,
    surfaces: Scene | None = None,
    options: InitialiseOptions | None = None,
    steps: int = STEPS,
    on_progress: OnProgress | None = None,
) -> tuple[Scene, SurfacesReport]:
    """Add Gaussians for LiDARs to a scene, fitted to ``log`` without its held-out frames.

    Args:
        scene: scene made from ``log``.
        log: log with LiDAR sweeps.
        surfaces: fills regions that no beam measured: the result of ``initialise_scene`` on the
            same frames. Training saves it as ``initial.r2s`` in its folder. Built by default.
        options: options of ``surfaces``, see ``initialise_scene``; by default only shapes.
        steps: number of learning steps; each takes about a second of one core.
        on_progress: called with the stage, completed and total steps.

    Raises:
        ReconstructError: the log has no sweeps or other objects, or ``surfaces`` may come from
            held-out frames.
        LogError: a file of the log cannot be read.
    """
    timing_s: dict[str, float] = {}
    stages = Stages(on_progress, timing_s)
    held_out = held_out_of(scene)
    frames = [frame for frame in range(log.frame_count) if frame not in held_out]
    log = log_of_frames(log, frames)
    if surfaces is None:
        surfaces = initialise_scene(
            log, options=options or WITHOUT_LOOKS, on_progress=on_progress, timing_s=timing_s
        )
    elif not held_out <= held_out_of(surfaces):
        raise ReconstructError(
            f"the scene holds out {len(held_out)} frames, and the surfaces given do not say that "
            "they were made without them; leave the surfaces out to compute them again"
        )
    _check_objects(scene, surfaces)
    points, sweeps = MeasuredPoints(log), []
    chosen = set(np.linspace(0, log.frame_count - 1, MAX_SWEEPS).astype(int).tolist())
    with stages("sweeps") as report_step:
        for frame in range(log.frame_count):
            rays = recorded_rays(log, frame)
            if rays is not None:
                met = points.add(frame, rays) >= 0
                if frame in chosen:
                    sweeps.append(_seen(frame, rays, met))
            report_step(frame + 1, log.frame_count)
    if not sweeps:
        raise ReconstructError(f"log {log.name!r} has no LiDAR sweeps to make surfaces of")
    with stages("layout"):
        table = SurfaceTable.of(points.clouds(surfaces), tuple(surfaces.objects))
    with stages("learn") as report_step:
        cost = learn_surfaces(table, scene, log, sweeps, steps=steps, on_step=report_step)
    table = table.select(table.opacities > MIN_OPACITY)
    with stages("light") as report_step:
        lit = light_of(table, scene, log, sweeps, on_sweep=report_step)
    with stages("reflectivity"):
        fitted = fit_reflectivity(table, lit)
    with stages("losses") as report_step:
        fit_losses(table, scene, log, sweeps, lit=lit, on_sweep=report_step)
    made = table.placed(scene, fitted.incidence)
    assert made.lidar is not None
    report = SurfacesReport(
        gaussians=len(table),
        sweeps=len(sweeps),
        held_out=tuple(sorted(held_out)),
        known=fitted.known,
        incidence=fitted.incidence,
        cost=cost,
        intensity_residual=fitted.residual,
        timing_s=timing_s,
    )
    return replace(made, lidar=replace(made.lidar, response=fitted.response)), report


def has_sweeps(log: DrivingLog, scene: Scene) -> bool:
    """Whether the log has sweeps that ``scene`` does not hold out. Raises LogError if one cannot be
    read.
    """
    frames = set(range(log.frame_count)) - held_out_of(scene) - log.absent_sweeps
    return any(recorded_rays(log, frame) is not None for frame in sorted(frames))


def held_out_of(scene: Scene) -> set[int]:
    """Frames of the log that the scene was made without."""
    made = scene.provenance.get("reconstruction")
    listed = made.get("held_out_frames") if isinstance(made, dict) else None
    return set(listed) if isinstance(listed, list) else set()


def _check_objects(scene: Scene, surfaces: Scene) -> None:
    """Check that both scenes have the same objects, which are matched by number."""
    of_scene, of_log = tuple(scene.objects), tuple(surfaces.objects)
    if of_scene != of_log:
        differ = sorted(set(of_scene) ^ set(of_log))[:5]
        raise ReconstructError(
            f"the scene has {len(of_scene)} objects and its log {len(of_log)}, of which "
            f"{differ or 'the order'} differ; fit surfaces before objects are added or taken out"
        )


def _seen(frame: int, rays: RecordedRays, met: NDArray[np.bool_]) -> SeenSweep:
    """A sweep with the rays that hit something other than the recording vehicle."""
    rings = fit_rings(rays)
    if rings is None:
        none = np.full(int(met.sum()), -1, np.int32)
        return SeenSweep(frame, rays.select(met), none, np.zeros(0), ())
    missing = tuple(rings.missing(rays))
    return SeenSweep(frame, rays.select(met), rings.ring[met], rings.elevation, missing)
