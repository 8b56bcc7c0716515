"""Stage 0: builds a scene of Gaussians from a log without training."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ...geometry import Float
from ...logs import DrivingLog, ObjectTrack
from ...logs.driving_log import NAMED
from ...maps import laid_on, lanes_of_log
from ...scene import GaussianCloud, Ground, Scene, SceneObject, Sky
from ...scene.cloud import SH_C0
from ...scene.ground_fit import DrivenPath, GroundFit, box_bottoms, fit_ground
from ...scene.sunlight import LightMap, Sunlight, lasting_shadows
from ..logged_view import sky_mask
from ..options import InitialiseOptions, OnProgress, ReconstructError, Stages
from .accumulate import (
    Accumulation,
    PointSet,
    accumulate,
    continue_walls,
    drive_path,
    path_distance,
    real_walls,
    thin_to,
    voxel_levels,
    well_supported,
)
from .sunlight import fit_sunlight
from .surfels import (
    ColourPrior,
    Surfels,
    body_color,
    fill_from_mirror,
    fill_from_neighbours,
    fill_ground,
    fit_surfels,
    round_surfels,
    spread_ground,
)
from .triangulate import TriangulatedPoints, sweep_planes, triangulate
from .vehicle_body import (
    VEHICLE_LENGTH,
    VehicleBody,
    VehicleSurface,
    complete_body,
    faced,
    fill_vehicles,
    fitted_body,
    mirrored,
    underside,
)
from .vehicle_parts import LIGHT, PARTS, Light
from .views import PlacedSurfels, ProjectedView, SkySamples, chosen_frames, gather_views

OPACITY = 0.95
ABOVE_GROUND = 0.1
"""Points within this distance of the ground surface are replaced by it [m]."""
LIDAR_REACH = 0.5
"""Minimum distance of points from images to the nearest LiDAR point [m]."""
FEATURE_HEIGHT = 0.3
"""Minimum height of these points above the ground [m]: LiDAR covers the road, and reflections are
below it.
"""
STEREO_VOXEL, STEREO_PER_METRE = 0.15, 0.01
"""Voxel edge for points from images [m], and its growth with the distance."""
STEREO_WEIGHT = 3
"""Minimum number of points per voxel."""
UNDERSIDE_COLOUR = 0.06
SKY_FRAMES = 15
FACED_FRAMES = 20
"""Number of frames used to find the vehicle sides that cameras faced."""
WALL_FRAMES = 16
BACKGROUND_HEIGHTS = (0.3, 1.0, 3.0)
OBJECT_HEIGHTS = (-0.35, 0.0, 0.3)
BODY_COLOR_REACH = 0.2
"""Reach of the colours of a vehicle's seen parts into unseen ones [m]."""


@dataclass(frozen=True, eq=False)
class _SurfelSet:
    """All Gaussians of the scene under construction.

    Order: ground, structure, continued walls, then object by object.
    """

    surfels: Surfels
    intensity: NDArray[np.float32]
    instance: NDArray[np.uint16]
    is_underside: NDArray[np.bool_]
    ground_count: int
    walls: slice
    bodies: tuple[VehicleBody | None, ...] = ()

    def objects(self, count: int) -> list[NDArray[np.int64]]:
        """Indices [N] of the Gaussians of each of the ``count`` objects, without its underside."""
        bodies = ~self.is_underside
        return [np.flatnonzero((self.instance == i + 1) & bodies) for i in range(count)]

    def without(self, dropped: NDArray[np.int64]) -> _SurfelSet:
        """Remove the walls at these indices."""
        kept = np.ones(len(self.surfels), dtype=np.bool_)
        kept[dropped] = False
        return _SurfelSet(
            self.surfels.select(kept),
            self.intensity[kept],
            self.instance[kept],
            self.is_underside[kept],
            self.ground_count,
            slice(self.walls.start, self.walls.stop - len(dropped)),
            self.bodies,
        )


@dataclass(frozen=True, eq=False)
class _Seen:
    """Points from images alone: matched features, and [N, 3] points from plane sweeps."""

    features: TriangulatedPoints
    swept: NDArray[np.float32]


def initialise_scene(
    log: DrivingLog,
    *,
    options: InitialiseOptions | None = None,
    on_progress: OnProgress | None = None,
    timing_s: dict[str, float] | None = None,
) -> Scene:
    """Build a scene from a log in seconds, without training.

    LiDAR is accumulated in the world and in each tracked box, thinned, turned into flat Gaussians
    and coloured from the cameras. Where LiDAR has no returns, points are triangulated from image
    features. The road becomes a closed surface, also under cars, and pixels without a surface
    become the sky. The same log gives the same bits.

    Args:
        log: a drive with at least one camera; boxes may be missing. Without LiDAR the scene is
            made of triangulated points, the driven path and the boxes.
        options: see InitialiseOptions.
        on_progress: called with the stage, completed and total steps.
        timing_s: filled with the seconds of each stage.

    Returns:
        The scene in the log's world frame, objects under their track's id, SH of degree 0.

    Raises:
        ReconstructError: the log has no camera or no frame, or neither a usable LiDAR point nor
            features with a depth.
        LogError: a file of the log cannot be read.
        MapError: the log's map cannot be read.
    """
    options = options or InitialiseOptions()
    stages = Stages(on_progress, timing_s)
    if len(log.rig) == 0 or log.frame_count == 0:
        raise ReconstructError(f"log {log.name!r} has no camera images; colours come from them")
    with stages("accumulate") as report_step:
        measured = accumulate(log, options, lambda f: report_step(f + 1, log.frame_count))
    with stages("features") as report_step:
        features = triangulate(log, max_images=options.feature_images, on_image=report_step)
    with stages("stereo") as report_step:
        swept = sweep_planes(log, max_images=options.stereo_images, on_image=report_step)
    if len(measured.background) + len(features) + len(swept) == 0:
        raise ReconstructError(
            f"log {log.name!r} has no usable LiDAR points, and its images have no features in "
            "common that tell a depth; stage 0 builds everything from these"
        )
    with stages("shape"):
        fitted = _fit_ground(log, measured.background.points, features.points)
        parts = _shape(log, measured, _Seen(features, swept), fitted, options)
    with stages("walls") as report_step:
        parts = _keep_real_walls(log, parts, options, report_step)
    with stages("colour") as report_step:
        colours, known, sky_samples = _sample_colours(log, parts, options, report_step)
    with stages("sunlight"):
        shapes = [parts.surfels.points[mine] for mine in parts.objects(len(log.tracks))]
        sunlight = fit_sunlight(log, fitted.ground, shapes)
    with stages("fill"):
        colours, look = _inpaint(log, parts, fitted.surface, colours, known, sunlight=sunlight)
        sky = sky_samples.finish(_median_colour(colours[: parts.ground_count]))
    scene = _assemble(log, parts, colours, sky, {**look, "options": asdict(options)})
    lanes = lanes_of_log(log, source=options.lanes)
    if lanes is not None:
        lanes = laid_on(lanes, fitted.ground)
    return replace(scene, stored_ground=fitted.ground, lanes=lanes, sunlight=sunlight)


def _fit_ground(
    log: DrivingLog, measured: NDArray[np.float32], features: NDArray[np.float32]
) -> GroundFit:
    """Fit the ground to LiDAR points, or to points from images if a log has no LiDAR."""
    boxes = box_bottoms(log.tracks, log.frame_times_us)
    points = measured if len(measured) else features
    return fit_ground(points.astype(np.float64), DrivenPath.of(log.ego), boxes)


def _shape(
    log: DrivingLog,
    measured: Accumulation,
    from_images: _Seen,
    fitted: GroundFit,
    options: InitialiseOptions,
) -> _SurfelSet:
    """Gaussians without colour: the ground, structure above it, and the objects."""
    path = drive_path(log)
    ground = _ground_surfels(fitted, options)
    above = _above_ground(measured.background, fitted.surface)
    distance = path_distance(above.points, path)
    supported = well_supported(above.points, 0.1 + 0.015 * distance)
    above, distance = above.select(supported), distance[supported]
    levels = voxel_levels(distance, options.voxel, options.voxel_per_metre)
    limit = max(1, options.max_background - len(ground) - options.max_background // 5)
    above = thin_to(above, options.voxel, limit, levels)
    largest = 0.03 + 0.006 * path_distance(above.points, path)
    structure = fit_surfels(above.points, largest=largest)
    seen = _surfels_of_images(from_images, measured.background, fitted.surface, path, options)
    structure = Surfels.join([structure, seen])
    walls = continue_walls(structure, measured.limit, max_count=options.max_background // 5)
    surfels = [ground, structure, walls]
    standing = len(ground) + len(structure)
    intensity = [np.zeros(len(ground), np.float32), above.intensity]
    intensity.append(np.zeros(len(seen), np.float32))
    intensity.append(np.zeros(len(walls), np.float32))
    instance = [np.zeros(standing + len(walls), np.uint16)]
    is_underside = [np.zeros(standing + len(walls), np.bool_)]
    bodies = []
    for index, track in enumerate(log.tracks):
        returns = measured.objects[track.object_id]
        bodies.append(fitted_body(returns.points, track.size, track.category))
        points = _object_points(returns, track, bodies[-1], options)
        body = fit_surfels(points.points, largest=0.1, smallest=0.004)
        plate = underside(track.size)
        surfels += [body, plate]
        intensity += [points.intensity, np.zeros(len(plate), np.float32)]
        instance.append(np.full(len(body) + len(plate), index + 1, np.uint16))
        is_underside.append(np.repeat([False, True], [len(body), len(plate)]))
    return _SurfelSet(
        Surfels.join(surfels),
        np.concatenate(intensity),
        np.concatenate(instance),
        np.concatenate(is_underside),
        len(ground),
        slice(standing, standing + len(walls)),
        tuple(bodies),
    )


def _ground_surfels(fitted: GroundFit, options: InitialiseOptions) -> Surfels:
    ground = spread_ground(fitted, options.ground_spacing, options.max_background // 2)
    normal = ground.normals
    forward = np.cross([0.0, 1.0, 0.0], normal)
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    axes = np.stack([forward, np.cross(normal, forward), normal], axis=2)
    scales = ground.spacing[:, None] * np.array([0.6, 0.6, 0.1], dtype=np.float32)
    return Surfels(ground.points, axes.astype(np.float32), scales.astype(np.float32))


def _above_ground(background: PointSet, surface: Ground) -> PointSet:
    xy = background.points[:, :2].astype(np.float64)
    height = background.points[:, 2] - surface.height_at(xy)
    return background.select(~surface.covers(xy) | (height > ABOVE_GROUND))


def _surfels_of_images(
    seen: _Seen, background: PointSet, surface: Ground, path: Float, options: InitialiseOptions
) -> Surfels:
    """Points from images, above the ground and away from the background's LiDAR points."""
    swept = seen.swept[_beyond_lidar(seen.swept, background, surface)]
    distance = path_distance(swept, path)
    held = well_supported(swept, 0.1 + 0.015 * distance)
    places = swept[held].astype(np.float64)
    cloud = PointSet.measured(places, np.zeros(len(places), np.float32))
    levels = voxel_levels(distance[held], STEREO_VOXEL, STEREO_PER_METRE)
    cloud = thin_to(cloud, STEREO_VOXEL, options.max_background // 4, levels)
    cloud = cloud.select(cloud.weight >= STEREO_WEIGHT)
    distance = path_distance(cloud.points, path)
    dense = fit_surfels(cloud.points, largest=0.03 + 0.012 * distance)
    single = seen.features.points
    single = single[_beyond_lidar(single, background, surface)]
    return Surfels.join([dense, round_surfels(single, path_distance(single, path))])


def _beyond_lidar(
    points: NDArray[np.float32], background: PointSet, surface: Ground
) -> NDArray[np.bool_]:
    """Mask of points above the ground without a LiDAR point nearby."""
    from scipy.spatial import cKDTree

    distance = np.full(len(points), np.inf)
    if len(background) and len(points):
        distance, _ = cKDTree(background.points).query(points, workers=-1)
    xy = points[:, :2].astype(np.float64)
    above = points[:, 2] - surface.height_at(xy) > FEATURE_HEIGHT
    return np.asarray((distance > LIDAR_REACH) & above)


def _object_points(
    points: PointSet, track: ObjectTrack, body: VehicleBody | None, options: InitialiseOptions
) -> PointSet:
    """Thinned points of an object, with its unobserved parts completed."""
    thinned = thin_to(points, options.object_voxel, options.max_object // 2)
    if track.size[0] >= VEHICLE_LENGTH:
        thinned = mirrored(thinned, voxel=options.object_voxel)
    completed = complete_body(thinned, track.size, track.category, body=body)
    return thin_to(completed, options.object_voxel, options.max_object)


def _keep_real_walls(
    log: DrivingLog,
    parts: _SurfelSet,
    options: InitialiseOptions,
    report_step: Callable[[int, int], None],
) -> _SurfelSet:
    """Drop continued walls coloured like the sky, or differently in every view."""
    if parts.walls.start == parts.walls.stop:
        return parts
    frames = chosen_frames(log, WALL_FRAMES)
    done = 0

    def on_view(view: ProjectedView) -> None:
        nonlocal done
        done += 1
        report_step(done, len(frames) * len(log.rig))

    placed = PlacedSurfels(parts.surfels, parts.instance)
    samples = gather_views(log, placed, frames=frames, slots=options.samples, on_view=on_view)
    colours, known = samples.mean()
    real = real_walls(colours[parts.walls], known[parts.walls], samples.deviation()[parts.walls])
    return parts.without(parts.walls.start + np.flatnonzero(~real))


def _sample_colours(
    log: DrivingLog,
    parts: _SurfelSet,
    options: InitialiseOptions,
    report_step: Callable[[int, int], None],
) -> tuple[NDArray[np.float32], NDArray[np.bool_], SkySamples]:
    frames = chosen_frames(log, options.max_colour_frames)
    sky_frames = set(frames[:: -(-len(frames) // SKY_FRAMES)])
    sky = SkySamples(options.sky_resolution)
    done = 0

    def on_view(view: ProjectedView) -> None:
        nonlocal done
        done += 1
        if view.frame in sky_frames:
            sky.add(view, sky_mask(log, view.camera, view.frame, view.image))
        report_step(done, len(frames) * len(log.rig))

    samples = gather_views(
        log,
        PlacedSurfels(parts.surfels, parts.instance),
        frames=frames,
        slots=options.samples,
        on_view=on_view,
    )
    return *samples.mean(), sky


def _inpaint(
    log: DrivingLog,
    parts: _SurfelSet,
    surface: Ground,
    colours: NDArray[np.float32],
    known: NDArray[np.bool_],
    *,
    sunlight: Sunlight | None,
) -> tuple[NDArray[np.float32], dict[str, Any]]:
    """Colours [N, 3] of all Gaussians, and shared values of vehicles: light, part colours."""
    points, filled = parts.surfels.points, colours.copy()
    ground = slice(0, parts.ground_count)
    filled[ground] = fill_ground(surface, points[ground], colours[ground], known[ground])
    structure = np.flatnonzero(parts.instance == 0)[parts.ground_count :]
    xy = points[structure, :2].astype(np.float64)
    height = points[structure, 2] - surface.height_at(xy)
    intensity = parts.intensity[structure]
    prior = ColourPrior(height, intensity, colours[structure], known[structure], BACKGROUND_HEIGHTS)
    filled[structure] = fill_from_neighbours(
        points[structure], colours[structure], known[structure], prior.colour(height, intensity)
    )
    light_map = None
    if sunlight is not None:
        places, shown = points[ground].astype(np.float64), known[ground]
        shown = shown & ~lasting_shadows(log.tracks, places, sunlight)
        light_map = LightMap(sunlight, places[shown, :2], colours[ground][shown])
    return _inpaint_objects(log, parts, filled, known, light_map)


def _inpaint_objects(
    log: DrivingLog,
    parts: _SurfelSet,
    colours: NDArray[np.float32],
    known: NDArray[np.bool_],
    light_map: LightMap | None,
) -> tuple[NDArray[np.float32], dict[str, Any]]:
    """Fill the unseen body of each object from its seen part, then its underside, in place.

    Returns the shared values of vehicles.
    """
    members = parts.objects(len(log.tracks))
    if not members:
        return colours, {}
    relative = np.zeros(len(colours), dtype=np.float32)
    for track, mine in zip(log.tracks, members, strict=True):
        relative[mine] = parts.surfels.points[mine, 2] / track.size[2]
    every = np.concatenate(members)
    prior = ColourPrior(
        relative[every], parts.intensity[every], colours[every], known[every], OBJECT_HEIGHTS
    )
    frames = chosen_frames(log, FACED_FRAMES)
    closed: list[int] = []
    surfaces: list[VehicleSurface] = []
    lights: list[Light] = []
    for k, (track, mine, body) in enumerate(zip(log.tracks, members, parts.bodies, strict=True)):
        if body is not None:
            closed.append(k)
            places = parts.surfels.points[mine].astype(np.float64)
            nearest = body.nearest(places)
            # A side seen edge-on shows the colours of the background next to its outline.
            seen = known[mine] & faced(log, track, places, body.normals[nearest], frames)
            normals = body.unit_normals()[nearest] @ track.trajectory.middle[:3, :3].T
            surfaces.append(
                VehicleSurface(parts.surfels.points[mine], normals, colours[mine], seen, body)
            )
            if light_map is not None:
                lights.append(light_map.light_along(track.trajectory))
    filled, light, palette = fill_vehicles(surfaces, lights or None)
    for k, found in zip(closed, filled, strict=True):
        colours[members[k]] = found
    for mine, body in zip(members, parts.bodies, strict=True):
        if body is not None:
            continue
        points = parts.surfels.points[mine]
        mirrored, now_known = fill_from_mirror(points, colours[mine], known[mine])
        likely = prior.colour(relative[mine], parts.intensity[mine])
        plain = body_color(relative[mine], mirrored, now_known, likely, OBJECT_HEIGHTS)
        colours[mine] = fill_from_neighbours(
            points, mirrored, now_known, plain, trust_reach=BODY_COLOR_REACH
        )
    colours[parts.is_underside & ~known] = UNDERSIDE_COLOUR
    return colours, {LIGHT: light.tolist(), PARTS: palette.tolist()}


def _median_colour(colours: NDArray[np.float32]) -> NDArray[np.float32]:
    if len(colours) == 0:
        return np.full(3, 0.4, dtype=np.float32)
    return np.median(colours, axis=0).astype(np.float32)


def _assemble(
    log: DrivingLog,
    parts: _SurfelSet,
    colours: NDArray[np.float32],
    sky: Sky,
    made: dict[str, Any],
) -> Scene:
    clouds = [
        _cloud(parts, colours, np.flatnonzero(parts.instance == i))
        for i in range(len(log.tracks) + 1)
    ]
    objects = {
        t.object_id: SceneObject(t.object_id, t.category, t.size, cloud, t.trajectory)
        for t, cloud in zip(log.tracks, clouds[1:], strict=True)
    }
    return Scene(
        name=log.name,
        background=clouds[0],
        objects=objects,
        sky=sky,
        rig=log.rig,
        ego=log.ego,
        frame_times_us=log.frame_times_us,
        ego_size=log.ego_size,
        provenance={
            **log.provenance,
            **({"left_out": _left_out(log)} if log.left_out else {}),
            "reconstruction": {"stage": 0, "iterations": 0, **made},
        },
    )


def _left_out(log: DrivingLog) -> dict[str, Any]:
    """For each kind of record that the log does not use, the number and the first reasons."""
    return {
        kind: {"count": len(sentences), "first": list(sentences[:NAMED])}
        for kind, sentences in log.left_out.items()
    }


def _cloud(
    parts: _SurfelSet, colours: NDArray[np.float32], members: NDArray[np.int64]
) -> GaussianCloud:
    surfels = parts.surfels.select(members)
    dc = (colours[members] - 0.5) / SH_C0
    return GaussianCloud(
        means=torch.from_numpy(surfels.points.copy()),
        quats=torch.from_numpy(surfels.quats),
        scales=torch.from_numpy(surfels.scales.copy()),
        opacities=torch.full((len(members),), OPACITY),
        sh=torch.from_numpy(dc[:, None].astype(np.float32)),
    )
