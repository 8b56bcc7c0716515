"""The synthetic drive as a DrivingLog, with ground truth from any pose."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry import Float, apply_transform, invert_transform
from ..logs.driving_log import DrivingLog, LidarSweep, ObjectTrack
from ..logs.readers.native import write_native_log
from ..scene import Camera, CameraMotion, CameraRig, Lidar, Trajectory
from .casting import Instances, build_geometry
from .people_casting import (
    PeopleCast,
    PeopleTruth,
    add_people,
    people_truth,
    trace_flow,
    trace_parts,
)
from .sensors import RaycastWorld, shoot_image, shoot_lidar, shoot_rays
from .street import SyntheticConfig, street_lanes
from .surroundings import build_surroundings
from .traffic import DrivePlan, PlannedPerson, PlannedVehicle, plan_drive, poses_at
from .vehicles import SHAPES, build_vehicle, roof_heights, shape_row

SWEEP_STEP_US = 4000.0
"""Time step of people's body poses within a sweep; their positions move on [us]."""
SHUTTER_STEP_US = 2000
"""The same within a rolling shutter [us]."""
LIDAR_POSITION = (0.9, 0.0, 1.73)
LIDAR_ELEVATION = (np.radians(-25.0), np.radians(3.0))


@dataclass(frozen=True, eq=False)
class SyntheticLog(DrivingLog):
    """A synthetic drive; images and sweeps are ray-cast on demand."""

    def render(
        self, T_world_camera: ArrayLike, k: ArrayLike, width: int, height: int, t_us: int
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.uint16]]:
        """Ground truth from any pose at any time of the drive.

        Args:
            T_world_camera: [4, 4], OpenCV camera frame.
            k: [3, 3] intrinsics [px], pixel centres at +0.5.
            width, height: image size [px].
            t_us: time [us]; outside the drive, vehicles continue straight ahead.

        Returns:
            RGB uint8 [H, W, 3]; depth float32 [H, W] along the camera's z [m], 0 in the sky;
            instance uint16 [H, W], 0 for the static world, else 1 + index into ``tracks``.
        """
        source = self.source
        assert isinstance(source, SyntheticSource)
        return source.render(np.asarray(T_world_camera), np.asarray(k), width, height, t_us)

    def render_placed(
        self,
        T_world_camera: ArrayLike,
        k: ArrayLike,
        size: tuple[int, int],
        vehicles: Sequence[int],
        T_world_objects: ArrayLike,
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.uint16]]:
        """Ground truth of an edited street: with only these vehicles, at these poses.

        Args:
            T_world_camera, k: as in :meth:`render`.
            size: width and height [px].
            vehicles: [N] indices into ``tracks``, may repeat.
            T_world_objects: [N, 4, 4] poses of their boxes.

        Returns:
            As :meth:`render`; instances are 1 + index into ``vehicles``.

        Raises:
            ValueError: an index of a person on foot or on a bicycle.
        """
        source = self.source
        assert isinstance(source, SyntheticSource)
        if len(vehicles) and max(vehicles) >= len(source.drive.vehicles):
            raise ValueError(
                f"only vehicles can be placed, tracks 0 to {len(source.drive.vehicles) - 1}; "
                f"{max(vehicles)} is a pedestrian or cyclist"
            )
        return shoot_image(
            source.world,
            source.placed(vehicles, np.asarray(T_world_objects, dtype=np.float64)),
            np.ascontiguousarray(T_world_camera, dtype=np.float64),
            np.ascontiguousarray(k, dtype=np.float64),
            *size,
            source.config.samples,
        )

    def with_vehicles(self, changed: Mapping[str, Trajectory | None]) -> SyntheticLog:
        """The drive on the same street with other traffic; people keep their ways.

        No config describes it, so its provenance has none. For a single view without people, see
        :meth:`render_placed`.

        Args:
            changed: new trajectories of vehicles by id, None to remove one.

        Raises:
            ValueError: an id that is not of a vehicle.
        """
        source = self.source
        assert isinstance(source, SyntheticSource)
        drive = source.drive
        ids = [track.object_id for track in self.tracks[: len(drive.vehicles)]]
        if unknown := sorted(changed.keys() - set(ids)):
            raise ValueError(f"no vehicles: {', '.join(unknown)}; vehicles are {', '.join(ids)}")
        paths = [changed.get(name, drive.vehicles[i].trajectory) for i, name in enumerate(ids)]
        kept = {i: path for i, path in enumerate(paths) if path is not None}
        vehicles = [dataclasses.replace(drive.vehicles[i], trajectory=p) for i, p in kept.items()]
        tracks = [dataclasses.replace(self.tracks[i], trajectory=p) for i, p in kept.items()]
        return dataclasses.replace(
            self,
            source=dataclasses.replace(
                source,
                drive=dataclasses.replace(drive, vehicles=tuple(vehicles)),
                body_paints=source.body_paints[list(kept)],
            ),
            tracks=(*tracks, *self.tracks[len(ids) :]),
            provenance={k: v for k, v in self.provenance.items() if k != "config"},
        )

    def render_through(
        self, camera: Camera, motion: CameraMotion, t_us: int, *, samples: int = 3
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Ground truth through any lens and shutter, with vehicles posed at each row's time.

        Args:
            camera: lens, shutter, K and size.
            motion: motion of the camera over the read-out.
            t_us: time of the middle of the read-out [us].
            samples: rays per pixel along each image axis.

        Returns:
            RGB uint8 [H, W, 3]; distance from the camera float32 [H, W] [m], mean over a pixel's
            rays, 0 where any of them hits the sky. Both are 0 outside the lens's field of view.
        """
        source = self.source
        assert isinstance(source, SyntheticSource)
        return source.render_through(camera, motion, t_us, samples)

    def people(self, t_us: int) -> PeopleTruth:
        """Joints, keypoints and tracks of all pedestrians and cyclists at ``t_us`` [us]."""
        source = self.source
        assert isinstance(source, SyntheticSource)
        return people_truth(source.drive.people, len(source.drive.vehicles), t_us)

    def render_parts(
        self, T_world_camera: ArrayLike, k: ArrayLike, width: int, height: int, t_us: int
    ) -> NDArray[np.uint8]:
        """Parts of people uint8 [H, W]: 1 + index into ``people_casting.part_names``, else 0.

        Arguments are those of :meth:`render`.
        """
        source = self.source
        assert isinstance(source, SyntheticSource)
        return source.parts(np.asarray(T_world_camera), np.asarray(k), (width, height), t_us)

    def flow(  # noqa: PLR0917 - two views of one camera
        self,
        T_world_camera: ArrayLike,
        T_world_next: ArrayLike,
        k: ArrayLike,
        width: int,
        height: int,
        times_us: tuple[int, int],
    ) -> NDArray[np.float32]:
        """The true optical flow from one picture to the next.

        Args:
            T_world_camera, T_world_next: [4, 4], camera poses in both.
            k, width, height: as in :meth:`render`.
            times_us: times of both [us].

        Returns:
            [H, W, 2] float32, motion of the surface at a pixel's centre [px], even if it is then
            occluded; NaN in the sky and for surfaces that move behind the camera.
        """
        source = self.source
        assert isinstance(source, SyntheticSource)
        poses = np.asarray(T_world_camera), np.asarray(T_world_next)
        return source.flow(poses, np.asarray(k), (width, height), times_us)

    def sweep(self, lidar: Lidar, t_us: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """The true sweep of a LiDAR on the vehicle about ``t_us`` [us], without noise or losses.

        Args:
            lidar: LiDAR with [B, C] rays and one time per column.
            t_us: time stamp of the sweep.

        Returns:
            Ranges [B, C] [m], 0 without a hit; reflectivity [B, C] in [0, 1].
        """
        source = self.source
        assert isinstance(source, SyntheticSource)
        return source.sweep(lidar, t_us)


@dataclass(frozen=True, eq=False)
class SyntheticSource:
    """Ray caster of a synthetic drive.

    Attributes:
        config: configuration of the drive.
        world: surroundings and vehicle shapes.
        drive: vehicles, then people, in the order of the log's tracks.
        roots: node [S] of each vehicle shape's mesh.
        body_paints: row [I] of each vehicle's body in the paint table.
        rig: as in the log.
        people: in the world's arrays; None without people.
    """

    config: SyntheticConfig
    world: RaycastWorld
    drive: DrivePlan
    roots: NDArray[np.int64]
    body_paints: NDArray[np.int64]
    rig: CameraRig
    people: PeopleCast | None = None

    def image(self, camera: str, frame: int) -> NDArray[np.uint8]:
        """RGB uint8 [H, W, 3] of a camera."""
        lens = self.rig[camera]
        t_us = int(self.drive.frame_times_us[frame])
        pose = lens.pose(self.drive.ego.transform(t_us))
        return self.render(pose, lens.K, lens.width, lens.height, t_us)[0]

    def render(
        self, T_world_camera: Float, k: Float, width: int, height: int, t_us: int
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.uint16]]:
        """See :meth:`SyntheticLog.render`."""
        with self.world_at(t_us) as world:
            return shoot_image(
                world,
                self.instances(t_us),
                np.ascontiguousarray(T_world_camera, dtype=np.float64),
                np.ascontiguousarray(k, dtype=np.float64),
                width,
                height,
                self.config.samples,
            )

    @contextmanager
    def world_at(self, t_us: float) -> Iterator[RaycastWorld]:
        """The world for rays, with people posed at an instant [us]."""
        if self.people is None:
            yield self.world
            return
        with self.people.at(t_us) as world:
            yield world

    def parts(
        self, T_world_camera: Float, k: Float, size: tuple[int, int], t_us: int
    ) -> NDArray[np.uint8]:
        """See :meth:`SyntheticLog.render_parts`."""
        if self.people is None:
            return np.zeros(size[::-1], np.uint8)
        with self.world_at(t_us) as world:
            return trace_parts(
                world, self.instances(t_us), self.people.meshes, T_world_camera, k, size
            )

    def flow(
        self, poses: tuple[Float, Float], k: Float, size: tuple[int, int], times_us: tuple[int, int]
    ) -> NDArray[np.float32]:
        """See :meth:`SyntheticLog.flow`."""
        places = self.instances(times_us[0]), self.instances(times_us[1])
        meshes = () if self.people is None else self.people.meshes
        with self.world_at(times_us[0]) as world:
            return trace_flow(world, places, meshes, poses, k, size, times_us[1] * 1e-6)

    def render_through(
        self, camera: Camera, motion: CameraMotion, t_us: int, samples: int
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """See :meth:`SyntheticLog.render_through`."""
        rgb = np.zeros((camera.height, camera.width, 3), np.uint8)
        ranges = np.zeros((camera.height, camera.width), np.float32)
        shutter = camera.shutter
        times = (
            shutter.line_times(camera.width, camera.height) if shutter.rolls else np.full(1, 0.5)
        )
        for line, time in enumerate(times):
            part: tuple[Any, ...] = (slice(None), slice(None))
            if shutter.rolls:
                part = (line,) if shutter.by_row else (slice(None), line)
            now_us = t_us + round((time - 0.5) * shutter.readout_us)
            rgb[part], ranges[part] = self._part(camera, motion, float(time), now_us, part, samples)
        return rgb, ranges

    def _part(  # noqa: PLR0917 - all of it together says which rays
        self,
        camera: Camera,
        motion: CameraMotion,
        time: float,
        t_us: int,
        part: tuple[Any, ...],
        samples: int,
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """A part of an image with one exposure time."""
        x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        corners = np.stack([x, y], -1)[part].reshape(-1, 2)
        step = (np.arange(samples) + 0.5) / samples
        inside = np.stack(np.meshgrid(step, step), -1).reshape(-1, 2)
        rays, seen = camera.unproject(corners[:, None] + inside)
        beside = camera.unproject(corners[:, None] + inside + [1e-3, 0.0])[0]
        turn, place = motion.at(np.array(time))
        size = np.linalg.norm(beside - rays, axis=-1) / 1e-3 / samples
        directions = (rays @ turn.T).reshape(-1, 3)
        seen = np.asarray(seen.all(-1))
        with self.world_at(t_us // SHUTTER_STEP_US * SHUTTER_STEP_US) as world:
            colours, ranges = shoot_rays(
                world,
                self.instances(t_us),
                np.broadcast_to(place, directions.shape).copy(),
                np.where(np.repeat(seen, samples**2)[:, None], directions, [0.0, 0.0, 1.0]),
                size.reshape(-1),
            )
        colours = colours.reshape(len(corners), -1, 3).mean(1) * seen[:, None]
        ranges = ranges.reshape(len(corners), -1)
        solid = seen & (ranges > 0).all(1)
        shape = np.empty((camera.height, camera.width))[part].shape
        rgb = (colours * 255 + 0.5).astype(np.uint8).reshape(*shape, 3)
        return rgb, (ranges.mean(1) * solid).astype(np.float32).reshape(shape)

    def instances(self, t_us: int) -> Instances:
        """Poses of all vehicles and people at ``t_us``."""
        sweeps = self._instances_over(np.array([float(t_us)]))
        return sweeps._replace(to_object=sweeps.to_object[0], to_world=sweeps.to_world[0])

    def _instances_over(self, times_us: Float) -> Instances:
        to_world = np.zeros((len(times_us), len(self.drive.vehicles), 4, 4))
        for i, vehicle in enumerate(self.drive.vehicles):
            to_world[:, i] = poses_at(vehicle.trajectory, times_us)
        vehicles = self.placed(range(len(self.drive.vehicles)), to_world)
        if self.people is None:
            return vehicles
        return _joined(vehicles, self._people_over(self.people, times_us))

    def _people_over(self, people: PeopleCast, times_us: Float) -> Instances:
        every = self.drive.people
        to_world = np.stack([poses_at(p.trajectory, times_us) for p in every], axis=1)
        half = np.array([p.size for p in every]) / 2
        return Instances(
            to_object=np.ascontiguousarray(invert_transform(to_world)[..., :3, :]),
            to_world=np.ascontiguousarray(to_world[..., :3, :]),
            radius=np.linalg.norm(half, axis=1) + 0.05,
            root=people.roots(),
            shape=np.zeros(len(every), np.int64),
            paint=np.zeros(len(every), np.int64),
            # Their feet darken the ground around them, not their box.
            half_size=np.column_stack([np.full((len(every), 2), 0.1), half[:, 2]]),
        )

    def placed(self, vehicles: Sequence[int], to_world: Float) -> Instances:
        """Vehicles [N] at poses [..., N, 4, 4]."""
        shapes = np.array([self.drive.vehicles[v].shape for v in vehicles], dtype=np.int64)
        half = np.array([SHAPES[s].size for s in shapes]).reshape(-1, 3) / 2
        return Instances(
            to_object=np.ascontiguousarray(invert_transform(to_world)[..., :3, :]),
            to_world=np.ascontiguousarray(to_world[..., :3, :]),
            radius=np.linalg.norm(half, axis=1) + 0.05,
            root=self.roots[shapes],
            shape=shapes,
            paint=self.body_paints[list(vehicles)],
            half_size=half,
        )

    def sweep(self, lidar: Lidar, t_us: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """See :meth:`SyntheticLog.sweep`."""
        times_us = t_us + lidar.beams.time_us[0]
        poses = poses_at(self.drive.ego, times_us) @ lidar.T_vehicle_lidar
        local = lidar.beams.directions.swapaxes(0, 1)
        ranges, reflected = self._shoot(
            times_us,
            np.ascontiguousarray(poses[:, :3, 3]),
            np.ascontiguousarray(np.einsum("cij,cbj->cbi", poses[:, :3, :3], local)),
            lidar.max_range,
        )
        return np.ascontiguousarray(ranges.T), np.ascontiguousarray(reflected.T)

    def _shoot(
        self, times_us: Float, origins: Float, directions: Float, limit: float
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Ranges and reflectivity [C, B] of columns at instants [C]."""
        every = self._instances_over(times_us)
        if self.people is None:
            ranges, reflected = shoot_lidar(self.world, every, origins, directions, limit)
            return ranges, reflected
        ranges = np.zeros(directions.shape[:2], np.float32)
        reflected = np.zeros_like(ranges)
        slots, of_slot = np.unique(np.floor(times_us / SWEEP_STEP_US), return_inverse=True)
        for slot, world in enumerate(self.people.over((slots + 0.5) * SWEEP_STEP_US)):
            own = np.flatnonzero(of_slot == slot)
            moved = every._replace(to_object=every.to_object[own], to_world=every.to_world[own])
            ranges[own], reflected[own] = shoot_lidar(
                world, moved, origins[own], directions[own], limit
            )
        return ranges, reflected

    def lidar(self, frame: int) -> LidarSweep:
        """One turn of the LiDAR, clockwise, looking ahead at the frame's time stamp.

        Every column is cast with the vehicles and the sensor at its own time. The sensor's motion
        is then compensated exactly; the vehicles' motion is not.
        """
        config, t_us = self.config, int(self.drive.frame_times_us[frame])
        if config.lidar_beams == 0:
            return _sweep(np.zeros((0, 3)), np.zeros(0), np.zeros(0))
        step = (np.arange(config.lidar_columns) + 0.5) / config.lidar_columns
        offsets_us = np.round((step - 0.5) * config.frame_period_us)
        poses = poses_at(self.drive.ego, t_us + offsets_us)
        local = _beam_directions(np.pi - 2 * np.pi * step, config.lidar_beams)
        directions = np.einsum("cij,cbj->cbi", poses[:, :3, :3], local)
        origins = apply_transform(poses, np.array([LIDAR_POSITION]))[:, 0]
        ranges, reflected = self._shoot(
            t_us + offsets_us,
            np.ascontiguousarray(origins),
            np.ascontiguousarray(directions),
            config.lidar_range,
        )
        rng = np.random.default_rng([config.seed, frame, 77])
        measured = ranges + config.lidar_noise * rng.standard_normal(ranges.shape)
        kept = (ranges > 0) & ~_lost(ranges, reflected, config.lidar_range, rng)
        column, beam = np.nonzero(kept)
        points = origins[column] + directions[column, beam] * measured[kept][:, None]
        in_vehicle = apply_transform(invert_transform(self.drive.ego.transform(t_us)), points)
        return _sweep(in_vehicle, reflected[kept], offsets_us[column])


def _joined(vehicles: Instances, people: Instances) -> Instances:
    """Concatenate instances; poses have a leading time axis."""
    return Instances(
        *(
            np.concatenate(
                [getattr(vehicles, n), getattr(people, n)], axis=int(n.startswith("to_"))
            )
            for n in Instances._fields
        )
    )


def _beam_directions(azimuth: Float, beams: int) -> Float:
    """Unit directions [C, B, 3] in the vehicle frame."""
    elevation = np.linspace(*LIDAR_ELEVATION, beams)[None]
    azimuth = azimuth[:, None]
    x, y = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth)
    return np.stack([x, y, np.broadcast_to(np.sin(elevation), x.shape)], axis=-1)


def _lost(
    ranges: NDArray[np.float32],
    reflected: NDArray[np.float32],
    limit: float,
    rng: np.random.Generator,
) -> NDArray[np.bool_]:
    """Mask of lost returns: one in a hundred, and dark surfaces far away."""
    dim = 1 - np.minimum(reflected / 0.08, 1.0)
    lost: NDArray[np.bool_] = rng.random(ranges.shape) < 0.01 + 0.8 * dim * (ranges / limit)
    return lost


def _sweep(points: Float, intensity: ArrayLike, offsets_us: ArrayLike) -> LidarSweep:
    return LidarSweep(
        points=points.astype(np.float32),
        intensity=np.asarray(intensity, dtype=np.float32),
        offset_us=np.asarray(offsets_us).astype(np.int32),
        origin=np.array(LIDAR_POSITION, dtype=np.float32),
    )


def generate_log(config: SyntheticConfig) -> SyntheticLog:
    """The drive of ``config``. Builds the world immediately, casts images on demand."""
    drive = plan_drive(config)
    paints: list[tuple[float, ...]] = []
    house_rng = np.random.default_rng([config.seed, 2])
    meshes = [build_surroundings(drive.street, paints, house_rng)]
    meshes += [build_vehicle(shape, paints) for shape in SHAPES]
    body_paints = len(paints) + np.arange(len(drive.vehicles), dtype=np.int64)
    paints += [(*v.colour, 0.0, 0.0, 0.0, 0.0, 0.0) for v in drive.vehicles]
    geometry, roots = build_geometry(meshes)
    geometry, people = add_people(geometry, drive.people, paints)
    world = RaycastWorld(
        *geometry,
        np.array(paints),
        np.array([shape_row(shape) for shape in SHAPES]),
        np.array([roof_heights(shape) for shape in SHAPES]),
        config.seed % 1_000_003 * 131,
    )
    cast = PeopleCast(world, people) if people else None
    source = SyntheticSource(config, world, drive, roots[1:], body_paints, config.rig(), cast)
    return SyntheticLog(
        name=f"synthetic_{config.seed}",
        rig=source.rig,
        frame_times_us=drive.frame_times_us,
        ego=drive.ego,
        tracks=_tracks(drive.vehicles, drive.people),
        source=source,
        lanes=street_lanes(drive.street),
        provenance={
            "dataset": "synthetic street",
            "licence": "free to use",
            "reader": "synthetic",
            "config": dataclasses.asdict(config),
        },
    )


def _tracks(
    vehicles: tuple[PlannedVehicle, ...], people: tuple[PlannedPerson, ...]
) -> tuple[ObjectTrack, ...]:
    seen: Counter[str] = Counter()
    tracks = []
    for vehicle in vehicles:
        shape = SHAPES[vehicle.shape]
        object_id = f"{shape.category}_{seen[shape.category]}"
        seen[shape.category] += 1
        tracks.append(ObjectTrack(object_id, shape.category, shape.size, vehicle.trajectory))
    for person in people:
        object_id = f"{person.category}_{seen[person.category]}"
        seen[person.category] += 1
        tracks.append(ObjectTrack(object_id, person.category, person.size, person.trajectory))
    return tuple(tracks)


def synthesize(
    config: SyntheticConfig,
    out: str | Path,
    *,
    on_progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Generate a drive and write it in the native layout to the new folder ``out``.

    Args:
        config: configuration of the drive.
        out: a folder that is new or empty.
        on_progress: called with (done, total) after each image and each sweep.

    Returns:
        ``out``.

    Raises:
        LogError: the folder is not empty.
    """
    return write_native_log(generate_log(config), out, on_progress=on_progress)
