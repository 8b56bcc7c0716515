"""The exported drive, as states over time."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from ..edit import AssetLookup, ObjectState, PlacedObjects, ScenarioState, instances_at
from ..edit.compose import NO_STRIDES, sweep_of, targets_at
from ..geometry import Float, matrix_to_quaternion
from ..render.cast.call import (
    Attributes,
    SweepScene,
    incidence_of,
    sensor_poses,
    transforms_at,
)
from ..render.types import Instance
from ..scene import Lidar, Scene, Stride, Trajectory
from ..world import World
from ..world.recording import Recording
from ..world.sensing import ray_targets

# --- Errors --------------------------------------------------------------------------------------


class DatasetError(ValueError):
    """An export that cannot be made; the message gives the value and the allowed ones."""


@dataclass(frozen=True, eq=False)
class Moment:
    """State of a drive at one time.

    Attributes:
        t_us: time [us].
        instances: instances to render.
        placed: all present objects.
        T_world_ego: [4, 4] pose of the ego (rear axle centre on the ground).
        strides: walking states of people without a trajectory, by object id.
        surfaces: the same world as LiDARs see it, with attributes of fitted surfaces, see
            ``targets_at``; empty if the scene has no LiDAR surfaces.
    """

    t_us: int
    instances: Sequence[Instance]
    placed: PlacedObjects[ObjectState]
    T_world_ego: Float
    strides: Mapping[str, Stride] = field(default_factory=lambda: NO_STRIDES)
    surfaces: Sequence[tuple[Instance, Attributes | None]] = ()


@dataclass(frozen=True, eq=False)
class SweepTargets:
    """Targets of a LiDAR during one sweep.

    Attributes:
        scene: background first, then the objects, see :class:`~..render.cast.SweepScene`.
        T_world_lidar: [S, 4, 4] at the pose times of the sweep.
    """

    scene: SweepScene
    T_world_lidar: Float


class Drive(Protocol):
    """A drive, from its first to its last instant."""

    @property
    def scene(self) -> Scene:
        """The scene with cameras, sky and ground."""
        ...

    @property
    def span(self) -> tuple[int, int]:
        """First and last instant [us]."""
        ...

    def at(self, t_us: int) -> Moment:
        """The state to render at a time in the span."""
        ...

    def placed_at(self, t_us: int) -> PlacedObjects[ObjectState]:
        """Poses of the objects at a time in the span."""
        ...

    def sweep_at(self, lidar: Lidar, t_us: int) -> SweepTargets:
        """Targets of a LiDAR of the ego in the sweep about a time, with moving objects."""
        ...

    def ego_at(self, t_us: int) -> Float:
        """``T_world_ego`` [4, 4] at an instant of the span."""
        ...

    def ego_speed_at(self, t_us: int) -> float:
        """Speed of the ego at an instant of the span [m/s]."""
        ...


@dataclass(frozen=True, eq=False)
class ScenarioDrive:
    """A scenario as recorded and edited; the ego drives its recorded path."""

    scene: Scene
    state: ScenarioState

    @property
    def span(self) -> tuple[int, int]:
        """See :class:`Drive`."""
        return self.state.clock

    def at(self, t_us: int) -> Moment:
        """See :class:`Drive`."""
        scene, state, placed = self.scene, self.state, self.placed_at(t_us)
        surfaces = () if scene.lidar is None else targets_at(scene, state, placed, t_us)
        instances = instances_at(scene, state, t_us)
        return Moment(t_us, instances, placed, self.ego_at(t_us), surfaces=surfaces)

    def placed_at(self, t_us: int) -> PlacedObjects[ObjectState]:
        """See :class:`Drive`."""
        return self.state.tracks.at(t_us)

    def sweep_at(self, lidar: Lidar, t_us: int) -> SweepTargets:
        """See :class:`Drive`."""
        poses = sensor_poses(self.scene.ego, lidar, t_us)
        return SweepTargets(sweep_of(self.scene, self.state, lidar, t_us), poses)

    def ego_at(self, t_us: int) -> Float:
        """See :class:`Drive`."""
        return self.scene.ego.transform(t_us)

    def ego_speed_at(self, t_us: int) -> float:
        """See :class:`Drive`."""
        return float(np.linalg.norm(self.scene.ego.velocity(t_us)[:2]))


@dataclass(frozen=True, eq=False)
class EpisodeDrive:
    """A recorded episode. Its times are those of its steps.

    Attributes:
        scene: scene of the episode.
        worlds: after each step, by time.
    """

    scene: Scene
    worlds: tuple[World, ...]

    @classmethod
    def of(
        cls, recording: Recording, scene: Scene, *, assets: AssetLookup | None = None
    ) -> EpisodeDrive:
        """The episode, replayed.

        Raises:
            DatasetError: it ran on another scene, or has no steps.
            EditError, RecordingError: as :meth:`Recording.replayer`.
        """
        if recording.scene_hash != scene.content_hash:
            raise DatasetError(
                f"the episode ran on a scene with hash {recording.scene_hash[:12]}, not "
                f"{scene.content_hash[:12] or 'one without'}; give the scene bundle it ran on"
            )
        by_time = {world.t_us: world for world in _instants(recording, scene, assets)}
        if not by_time:
            raise DatasetError("the episode holds no step to export")
        return cls(scene, tuple(by_time[t] for t in sorted(by_time)))

    @property
    def span(self) -> tuple[int, int]:
        """See :class:`Drive`."""
        return self.worlds[0].t_us, self.worlds[-1].t_us

    def at(self, t_us: int) -> Moment:
        """See :class:`Drive`."""
        world = self._world(t_us)
        ego, strides = np.array(world.T_world_body), world.strides.made
        surfaces: Sequence[tuple[Instance, Attributes | None]] = ()
        if self.scene.lidar is not None:
            targets = ray_targets(world)
            surfaces = list(zip(targets.instances, targets.attributes, strict=True))
        return Moment(t_us, world.instances(), world.agents, ego, strides, surfaces)

    def placed_at(self, t_us: int) -> PlacedObjects[ObjectState]:
        """See :class:`Drive`."""
        return self._world(t_us).agents

    def ego_at(self, t_us: int) -> Float:
        """See :class:`Drive`."""
        return np.array(self._world(t_us).T_world_body)

    def ego_speed_at(self, t_us: int) -> float:
        """See :class:`Drive`."""
        return math.hypot(*self._world(t_us).motion.velocity)

    def _world(self, t_us: int) -> World:
        """The world after the last step up to ``t_us``."""
        return self.worlds[self._place(t_us)]

    def _place(self, t_us: int) -> int:
        times = [world.t_us for world in self.worlds]
        return max(bisect_right(times, t_us) - 1, 0)

    def sweep_at(self, lidar: Lidar, t_us: int) -> SweepTargets:
        """See :class:`Drive`; between steps all motion is linear."""
        place = self._place(t_us)
        near = self.worlds[max(place - 1, 0) : place + 2]
        targets, times = ray_targets(self.worlds[place]), t_us + lidar.beams.slots[0]
        # Background and fragments stay in place.
        moved: list[Float | None] = [None] * len(targets.instances)
        for k, object_id in enumerate(targets.object_ids, start=1):
            moved[k] = transforms_at(_way(near, object_id), times)
        ego = _trajectory([(w.t_us, np.array(w.T_world_body)) for w in near])
        poses = transforms_at(ego, times) @ lidar.T_vehicle_lidar
        shared = targets.instances, tuple(moved), targets.attributes
        return SweepTargets(SweepScene(*shared, incidence_of(self.scene)), poses)


def _way(worlds: Sequence[World], object_id: str) -> Trajectory:
    """Trajectory of an object over those of a few steps at which it exists."""
    rows = []
    for world in worlds:
        for subject, transform in zip(world.agents.objects, world.agents.transforms, strict=True):
            if subject.object_id == object_id:
                rows.append((world.t_us, transform))
    return _trajectory(rows)


def _trajectory(rows: Sequence[tuple[int, Float]]) -> Trajectory:
    poses = np.stack([pose for _, pose in rows])
    times = np.array([t_us for t_us, _ in rows])
    return Trajectory(times, poses[:, :3, 3], matrix_to_quaternion(poses[:, :3, :3]))


def _instants(recording: Recording, scene: Scene, assets: AssetLookup | None) -> Iterator[World]:
    replayer = recording.replayer(scene, assets)
    for entry in recording.entries:
        world = replayer.apply(entry)
        if entry.kind in {"reset", "action", "restore"}:
            yield world
