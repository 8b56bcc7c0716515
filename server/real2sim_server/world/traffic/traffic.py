"""All road users except the ego: their drivers and poses."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np

from real2sim_proto import ErrorCode
from real2sim_proto.drive import Lamp
from real2sim_proto.episode import AgentDriver as DriverSpec
from real2sim_proto.episode import (
    AgentsSpec,
    ConstantVelocityDriver,
    CutInDriver,
    ExternalDriver,
    HardBrakeDriver,
    IdmDriver,
    JunctionCrossingDriver,
    LaneDriver,
    ReplayDriver,
)

from ...edit import ObjectState
from ...edit.tracks import PackedTracks
from ...geometry import transform_from
from ..agents import Agents, Lamps, rows_of
from ..common import WorldError, copy_with
from ..path import Float
from .driver import (
    AgentDriver,
    ConstantVelocity,
    External,
    Idm,
    Replay,
    Script,
    ScriptedEntity,
    Surroundings,
)
from .idm_drivers import CutIn, HardBrake, JunctionCrossing, LaneChanger
from .spawner import PREFIX as SPAWNED
from .spawner import Spawner

BeginDriver = Callable[[ObjectState, Any, Surroundings], AgentDriver]
"""``begin(subject, spec, surroundings)``: creates the driver of an object at the instant of the
surroundings. ``spec`` has the type for which the function is registered."""

DRIVERS: dict[type[Any], BeginDriver] = {
    ReplayDriver: Replay.begin,
    ConstantVelocityDriver: ConstantVelocity.begin,
    IdmDriver: Idm.begin,
    LaneDriver: LaneChanger.begin,
    CutInDriver: CutIn.begin,
    HardBrakeDriver: HardBrake.begin,
    JunctionCrossingDriver: JunctionCrossing.begin,
    ExternalDriver: External.begin,
}
"""Drivers by the wire model that selects them and holds their parameters."""


def begin_driver(subject: ObjectState, spec: DriverSpec, surroundings: Surroundings) -> AgentDriver:
    """The driver of a spec, starting at the instant of ``surroundings``."""
    return DRIVERS[type(spec)](subject, spec, surroundings)


MOVING = 2.0
"""Minimum distance in the recording of objects that get a driver [m]."""

DRIVEN = frozenset({"car", "vehicle", "van", "truck", "bus", "motorcycle", "cyclist"})
"""Categories for default drivers; pedestrians replay the log."""

SCRIPTED = (Replay, ConstantVelocity, Idm, LaneChanger, CutIn, HardBrake, JunctionCrossing)
"""Drivers that need no external input."""

USING_LAMPS = (ConstantVelocity, Idm, LaneChanger, CutIn, HardBrake, JunctionCrossing, External)
"""Drivers that show lamps by their motion."""

LAMPED = DRIVEN - {"cyclist"}
"""Categories whose drivers use lamps."""

BRAKING = 1.0
"""Deceleration above which the brake lamps of a driven vehicle are lit [m/s^2]."""

STANDING = 0.1
"""Speed below which they are lit too [m/s]."""

FLASH_US = 500_000
"""Time for which the indicators of a driven vehicle are lit, and then dark [us]."""

NOTHING_SAMPLED: Mapping[str, float] = MappingProxyType({})


class RandomizedDrivers(Protocol):
    """Samples parameters of IDM drivers."""

    def driver_of(
        self, subject: ObjectState, spec: IdmDriver
    ) -> tuple[IdmDriver, dict[str, float]]:
        """The driver parameters of an object, and the sampled values by name."""


@dataclass(frozen=True, eq=False)
class Traffic:
    """Objects of an episode at one instant. Immutable; objects without a driver replay the log.

    Attributes:
        spec: driver specifications.
        drivers: drivers of the objects that have appeared, by object id.
        agents: poses of all objects.
        reacting: whether replayed objects have switched to IDM.
        spawner: spawns and removes objects; or None.
        randomized: samples parameters of drivers; or None.
        sampled: values sampled for objects so far, by name.
        edits_drive: whether an edit has assigned a driver.
        storyboard: moves its entities; or None.
    """

    spec: AgentsSpec
    drivers: Mapping[str, AgentDriver]
    agents: Agents
    reacting: bool = False
    spawner: Spawner | None = None
    randomized: RandomizedDrivers | None = None
    sampled: Mapping[str, float] = field(default_factory=lambda: NOTHING_SAMPLED)
    edits_drive: bool = False
    storyboard: Script | None = None

    @classmethod
    def begin(
        cls,
        tracks: PackedTracks[ObjectState],
        spec: AgentsSpec,
        surroundings: Surroundings,
        *,
        spawner: Spawner | None = None,
        randomized: RandomizedDrivers | None = None,
        storyboard: Script | None = None,
    ) -> Traffic:
        """Objects at the start of an episode.

        Args:
            tracks: all objects.
            spec: their drivers.
            surroundings: the start instant, with ``others`` as recorded.
            spawner: spawns and removes objects.
            randomized: samples parameters of drivers.
            storyboard: moves its entities from the start.

        Raises:
            WorldError: UNKNOWN_OBJECT for a driver of an object that does not exist;
                INVALID_REQUEST for lane-following drivers in a scene without lanes.
        """
        unknown = sorted(set(spec.drivers) - {o.object_id for o in tracks.objects})
        if unknown:
            raise WorldError(
                ErrorCode.UNKNOWN_OBJECT,
                f"agents.drivers names {unknown[0]!r}, which is not an object of this world",
                hint="insert or duplicate it first; GET /v1/scenes/{scene} lists the objects",
            )
        _check_lanes(spec, surroundings)
        scripted: Mapping[str, AgentDriver] = storyboard.drivers if storyboard is not None else {}
        begun = cls(
            spec,
            MappingProxyType(dict(scripted)),
            surroundings.others,
            spawner=spawner,
            randomized=randomized,
            edits_drive=_edits_drive(tracks),
            storyboard=storyboard,
        )
        begun = begun._with_new_drivers(surroundings.others, surroundings)
        if spawner is None:
            return begun
        spawner, added = spawner.filled(begun.agents, surroundings)
        return replace(begun, spawner=spawner)._with_spawned(added, surroundings.others)

    def advance(
        self,
        tracks: PackedTracks[ObjectState],
        t_us: int,
        surroundings: Callable[[], Surroundings],
    ) -> Traffic:
        """Objects one step later.

        Args:
            tracks: objects after all edits.
            t_us: time after the step [us].
            surroundings: returns the previous instant, with ``agents`` as ``others``; only called
                if an object has a driver.
        """
        base = tracks.at(t_us)
        if not (self.drivers or self.spawner or self.storyboard or self._assigns_drivers):
            return copy_with(self, agents=base)
        before = surroundings()
        if aims := self._aims:
            before = replace(before, aims=aims)
        drivers = {i: d.advance(before) for i, d in self.drivers.items()}
        storyboard = self.storyboard and self.storyboard.advance(before)
        if storyboard is not None:
            # Objects taken over by an impact are moved by the physics.
            drivers |= {
                i: d
                for i, d in storyboard.drivers.items()
                if isinstance(drivers.get(i), ScriptedEntity)
            }
        moved = replace(self, drivers=MappingProxyType(drivers), storyboard=storyboard)
        moved = moved._with_new_drivers(base, replace(before, t_us=t_us))
        return moved._with_comers_and_goers(base, before) if self.spawner else moved

    @property
    def _aims(self) -> dict[str, tuple[float, float]]:
        """``aims`` of lane-changing objects, see :class:`~.driver.Surroundings`."""
        return {
            i: d.aim
            for i, d in self.drivers.items()
            if isinstance(d, LaneChanger) and d.changing is not None
        }

    def edited(self, tracks: PackedTracks[ObjectState], surroundings: Surroundings) -> Traffic:
        """Objects after an edit; drivers of objects with edited trajectories restart."""
        objects = {o.object_id: o for o in tracks.objects}
        kept = {
            i: d
            for i, d in self.drivers.items()
            if i.startswith(SPAWNED)
            or isinstance(d, ScriptedEntity)
            or (
                (edited := objects.get(i)) is not None
                and edited.trajectory is d.subject.trajectory
                and edited.scale == d.subject.scale
            )
        }
        base = tracks.at(surroundings.t_us)
        anew = replace(self, drivers=MappingProxyType(kept), edits_drive=_edits_drive(tracks))
        return anew._with_new_drivers(base, surroundings)

    def with_reacting_agents(
        self, tracks: PackedTracks[ObjectState], surroundings: Surroundings
    ) -> Traffic:
        """Switch objects that replay the log to IDM."""
        return replace(self, reacting=True)._with_new_drivers(
            tracks.at(surroundings.t_us), surroundings
        )

    def recorded_movers(self, objects: Iterable[ObjectState]) -> frozenset[str]:
        """Ids of moving objects that replay the recording or have a driver of the episode.

        Excludes objects placed by edits, driven by clients or under physics control.
        """
        return frozenset(
            o.object_id
            for o in objects
            if not o.edited
            and _moves(o)
            and isinstance(self.drivers.get(o.object_id), (*SCRIPTED, type(None)))
        )

    def looped(
        self, tracks: PackedTracks[ObjectState], surroundings: Surroundings, way: float
    ) -> Traffic:
        """Objects after a loop reset of the ego by ``way`` metres along its route.

        Objects that drive along the route move with the ego. Drivers of recorded objects restart.

        Args:
            tracks: tracks of the remaining objects.
            surroundings: instant before the reset.
            way: distance along the route [m].
        """
        here = {o.object_id for o in tracks.objects}
        route, ground = surroundings.route, surroundings.ground
        drivers = {
            i: d.looped(route, way, ground) if isinstance(d, Idm) and d.along_route else d
            for i, d in self.drivers.items()
            if i.startswith(SPAWNED)
            or (i in here and (d.subject.edited or not isinstance(d, SCRIPTED)))
        }
        return replace(self, drivers=MappingProxyType({})).with_drivers(
            drivers, tracks.at(surroundings.t_us)
        )

    def with_plan(
        self,
        object_id: str,
        t_us: int,
        times_us: Sequence[int],
        poses: Sequence[tuple[float, float, float]],
    ) -> Traffic:
        """Objects with a new plan for an externally driven object.

        Raises:
            WorldError: INVALID_ACTION if the object is not driven externally or the plan has ended.
        """
        driver = self.drivers.get(object_id)
        if not isinstance(driver, External):
            named = sorted(i for i, d in self.drivers.items() if isinstance(d, External))
            raise WorldError(
                ErrorCode.INVALID_ACTION,
                f"object {object_id!r} is not driven externally in this episode",
                hint="reset with agents.drivers={id: {kind: 'external'}}; external now: "
                f"{', '.join(named) or 'none'}",
            )
        if times_us[0] <= t_us:
            raise WorldError(
                ErrorCode.INVALID_ACTION,
                f"the plan of {object_id!r} begins at {times_us[0]} us; it is {t_us} us already",
                hint="times_us are absolute simulation times after the newest observation",
            )
        return self.with_drivers({object_id: driver.with_plan(t_us, times_us, poses)}, self.agents)

    def with_drivers(self, drivers: Mapping[str, AgentDriver], base: Agents) -> Traffic:
        """Objects with replaced drivers, whose poses override those of ``base``."""
        merged = MappingProxyType({**self.drivers, **drivers})
        return replace(self, drivers=merged, agents=_with_driver_poses(base, merged))

    def _with_new_drivers(self, base: Agents, surroundings: Surroundings) -> Traffic:
        """Objects with drivers for those that have just appeared."""
        drivers, sampled = dict(self.drivers), dict[str, float]()
        if self._assigns_drivers:
            for subject in base.objects:
                if subject.object_id not in drivers:
                    driver = self._driver_for(subject, surroundings, sampled)
                    if driver is not None:
                        drivers[subject.object_id] = driver
        frozen = MappingProxyType(drivers)
        placed = replace(self, drivers=frozen, agents=_with_driver_poses(base, frozen))
        return placed._with_sampled(sampled)

    def _with_comers_and_goers(self, base: Agents, before: Surroundings) -> Traffic:
        """Remove and spawn objects; ``before``: surroundings before the step."""
        assert self.spawner is not None
        gone = self.spawner.gone(self.drivers, before)
        kept = {i: d for i, d in self.drivers.items() if i not in gone}
        traffic = self if not gone else replace(self, drivers=MappingProxyType({}))
        traffic = traffic if not gone else traffic.with_drivers(kept, base)
        spawner, added = self.spawner.advance(kept, traffic.agents, before)
        return replace(traffic, spawner=spawner)._with_spawned(added, base)

    def _with_spawned(self, added: Sequence[Idm], base: Agents) -> Traffic:
        """Objects with additional spawned ones."""
        if not added:
            return self
        assert self.spawner is not None
        drivers, sampled = dict[str, AgentDriver](), dict[str, float]()
        for driver in added:
            drivers[driver.subject.object_id] = driver
            sampled |= self.spawner.sampled(driver)
        return self.with_drivers(drivers, base)._with_sampled(sampled)

    def _with_sampled(self, sampled: Mapping[str, float]) -> Traffic:
        if not sampled:
            return self
        return replace(self, sampled=MappingProxyType({**self.sampled, **sampled}))

    @property
    def _assigns_drivers(self) -> bool:
        """Whether objects that appear may get a driver."""
        named = bool(self.spec.drivers) or self.edits_drive
        return named or self.spec.default != "log" or self.reacting

    def _driver_for(
        self, subject: ObjectState, surroundings: Surroundings, sampled: dict[str, float]
    ) -> AgentDriver | None:
        """The driver of a new object; adds its sampled values to ``sampled``."""
        spec = self.spec.drivers.get(subject.object_id, subject.driver)
        if spec is None:
            spec = self._default_for(subject)
        if spec is None:
            return None
        if isinstance(spec, IdmDriver) and self.randomized is not None:
            spec, named = self.randomized.driver_of(subject, spec)
            sampled |= named
        return begin_driver(subject, spec, surroundings)

    def _default_for(self, subject: ObjectState) -> DriverSpec | None:
        kind = "idm" if self.reacting else self.spec.default
        if kind == "log" or subject.category not in DRIVEN or not _moves(subject):
            return None
        if kind == "lanes":
            return LaneDriver()
        return IdmDriver() if kind == "idm" else ConstantVelocityDriver()


def lit_lamps(
    drivers: Mapping[str, AgentDriver], before: Mapping[str, AgentDriver], dt: float
) -> Lamps:
    """Lit lamps of all objects with drivers.

    Objects that repeat the recording or have been hit have none.

    Args:
        drivers: current drivers by id.
        before: drivers one step earlier; empty at the start.
        dt: the time step [s].
    """
    found = dict[str, tuple[Lamp, ...]]()
    for object_id, driver in drivers.items():
        if isinstance(driver, ScriptedEntity):
            lit = driver.lamps
        elif isinstance(driver, USING_LAMPS) and driver.subject.category in LAMPED:
            lit = _lamps_of(driver, before.get(object_id), dt)
        else:
            continue
        if lit:
            found[object_id] = lit
    return found


def _lamps_of(driver: AgentDriver, before: AgentDriver | None, dt: float) -> tuple[Lamp, ...]:
    lit = list[Lamp]()
    speed = math.hypot(*driver.pose.velocity)
    fell = 0.0 if before is None else math.hypot(*before.pose.velocity) - speed
    if speed < STANDING or fell / dt > BRAKING:
        lit.append("brake")
    turning = driver.turning if isinstance(driver, LaneChanger | CutIn) else None
    if turning is not None and round(turning[1] * 1e6) % (2 * FLASH_US) < FLASH_US:
        lit.append("indicator_right" if turning[0] > 0 else "indicator_left")
    return tuple(lit)


def _check_lanes(spec: AgentsSpec, surroundings: Surroundings) -> None:
    asked = [i for i, d in spec.drivers.items() if isinstance(d, LaneDriver)]
    if surroundings.lanes is None and (asked or spec.default == "lanes"):
        where = f"agents.drivers.{asked[0]}" if asked else "agents.default"
        raise WorldError(
            ErrorCode.INVALID_REQUEST,
            f"{where} is 'lanes', and the scene has no map",
            hint="`real2sim map SCENE --from MAP` gives it one; 'idm' drives along recorded paths",
        )


def _edits_drive(tracks: PackedTracks[ObjectState]) -> bool:
    return any(subject.driver is not None for subject in tracks.objects)


def _moves(subject: ObjectState) -> bool:
    return subject.trajectory.extent >= MOVING


def _with_driver_poses(base: Agents, drivers: Mapping[str, AgentDriver]) -> Agents:
    """``base`` with the poses of driven objects replaced by those of their drivers."""
    if not drivers:
        return base
    rows = rows_of(base)
    keep = [k for i, k in rows.items() if i not in drivers or drivers[i].present]
    late = [d for i, d in drivers.items() if i not in rows and d.present]
    poses = {rows[i]: d.pose for i, d in drivers.items() if i in rows and d.present}
    positions, quaternions = base.positions.copy(), base.quaternions.copy()
    velocities = base.velocities.copy()
    for k, pose in poses.items():
        positions[k], quaternions[k], velocities[k] = pose.position, pose.quaternion, pose.velocity
    objects = [base.objects[k] for k in keep] + [d.subject for d in late]
    positions = _stacked(positions[keep], [d.pose.position for d in late])
    quaternions = _stacked(quaternions[keep], [d.pose.quaternion for d in late])
    return Agents(
        objects=tuple(objects),
        sizes=_stacked(base.sizes[keep], [d.subject.scaled_size for d in late]),
        positions=positions,
        quaternions=quaternions,
        velocities=_stacked(velocities[keep], [d.pose.velocity for d in late]),
        transforms=transform_from(positions, quaternions),
    )


def _stacked(rows: Float, more: Sequence[Sequence[float]]) -> Float:
    return np.vstack([rows, np.asarray(more, dtype=np.float64)]) if more else rows
