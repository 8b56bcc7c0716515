"""All road users but the ego: who drives them, and where they are."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import assert_never

import numpy as np

from real2sim_proto import ErrorCode
from real2sim_proto.episode import (
    AgentDriver as DriverSpec,
)
from real2sim_proto.episode import (
    AgentsSpec,
    ConstantVelocityDriver,
    CutInDriver,
    ExternalDriver,
    HardBrakeDriver,
    IdmDriver,
    JunctionCrossingDriver,
    ReplayDriver,
)

from ...edit import ObjectState, ScenarioState
from ...geometry.transform import transform_from
from ..agents import Agents, rows_of
from ..errors import WorldError
from ..path import Float
from .adversarial import CutIn, HardBrake, JunctionCrossing
from .driver import AgentDriver, Surroundings
from .external import External
from .idm import Idm
from .replay import ConstantVelocity, Replay

MOVING = 2.0
"""Objects that cover less than this in the recording stand; nobody drives them [m]."""

DRIVEN = frozenset({"car", "vehicle", "van", "truck", "bus", "motorcycle", "cyclist"})
"""Categories that a default driver drives; pedestrians keep to the log."""


@dataclass(frozen=True, eq=False)
class Traffic:
    """Objects of an episode at one instant. Immutable; objects without a driver repeat the log.

    Attributes:
        spec: who drives whom.
        drivers: by object id; of objects that have appeared.
        placed: where all objects are.
        reacting: whether objects that repeated the log have begun to drive by IDM.
    """

    spec: AgentsSpec
    drivers: Mapping[str, AgentDriver]
    placed: Agents
    reacting: bool = False

    @classmethod
    def begin(cls, state: ScenarioState, spec: AgentsSpec, seen: Surroundings) -> Traffic:
        """Objects at the start of an episode.

        Args:
            state: all objects.
            spec: who drives them.
            seen: the start; its ``others`` are where the log has them.

        Raises:
            WorldError: UNKNOWN_OBJECT for a driver of an object that does not exist.
        """
        unknown = sorted(set(spec.drivers) - {o.object_id for o in state.visible})
        if unknown:
            raise WorldError(
                ErrorCode.UNKNOWN_OBJECT,
                f"agents.drivers names {unknown[0]!r}, which is no object of this world",
                hint="insert or duplicate it first; GET /v1/scenes/{scene} lists the objects",
            )
        none: Mapping[str, AgentDriver] = MappingProxyType({})
        return cls(spec, none, seen.others)._joined(state, seen.others, seen)

    def advance(self, state: ScenarioState, t_us: int, seen: Callable[[], Surroundings]) -> Traffic:
        """Objects one step later.

        Args:
            state: objects after all edits.
            t_us: the instant after the step [us].
            seen: tells of the instant before, whose ``others`` are those of ``placed``; only asked
                where somebody drives.
        """
        base = state.tracks.at(t_us)
        if not (self.drivers or self._drives):
            return Traffic(self.spec, self.drivers, base, self.reacting)
        before = seen()
        drivers = {i: d.advance(before) for i, d in self.drivers.items()}
        moved = replace(self, drivers=MappingProxyType(drivers))
        return moved._joined(state, base, replace(before, t_us=t_us))

    def edited(self, state: ScenarioState, seen: Surroundings) -> Traffic:
        """Objects after an edit: drivers of objects whose trajectory was edited begin anew."""
        kept = {
            i: d
            for i, d in self.drivers.items()
            if (now := state.objects.get(i)) is not None
            and not now.deleted
            and now.trajectory is d.subject.trajectory
            and now.scale == d.subject.scale
        }
        base = state.tracks.at(seen.t_us)
        return replace(self, drivers=MappingProxyType(kept))._joined(state, base, seen)

    def react(self, state: ScenarioState, seen: Surroundings) -> Traffic:
        """Objects that repeat the log drive by IDM from now on."""
        return replace(self, reacting=True)._joined(state, state.tracks.at(seen.t_us), seen)

    def told(
        self,
        object_id: str,
        t_us: int,
        times_us: Sequence[int],
        poses: Sequence[tuple[float, float, float]],
    ) -> Traffic:
        """Objects after an externally driven one got a plan.

        Raises:
            WorldError: INVALID_ACTION when nobody may drive it, or its plan is over already.
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
        return self.with_drivers({object_id: driver.told(t_us, times_us, poses)}, self.placed)

    def with_drivers(self, drivers: Mapping[str, AgentDriver], base: Agents) -> Traffic:
        """Objects with other drivers for some of them, placed anew on top of ``base``."""
        merged = MappingProxyType({**self.drivers, **drivers})
        return replace(self, drivers=merged, placed=_placed(base, merged))

    def _joined(self, state: ScenarioState, base: Agents, seen: Surroundings) -> Traffic:
        """With drivers for objects that have just appeared."""
        drivers = dict(self.drivers)
        if self._drives:
            for subject in base.objects:
                if subject.object_id not in drivers:
                    driver = self._driver_for(subject, seen)
                    if driver is not None:
                        drivers[subject.object_id] = driver
        frozen = MappingProxyType(drivers)
        return replace(self, drivers=frozen, placed=_placed(base, frozen))

    @property
    def _drives(self) -> bool:
        """Whether objects that appear may get a driver."""
        return bool(self.spec.drivers) or self.spec.default != "log" or self.reacting

    def _driver_for(self, subject: ObjectState, seen: Surroundings) -> AgentDriver | None:
        spec = self.spec.drivers.get(subject.object_id)
        if spec is None:
            spec = self._default_for(subject)
        if spec is None:
            return None
        return begin_driver(subject, spec, seen)

    def _default_for(self, subject: ObjectState) -> DriverSpec | None:
        kind = "idm" if self.reacting else self.spec.default
        if kind == "log" or subject.category not in DRIVEN or not _moves(subject):
            return None
        return IdmDriver() if kind == "idm" else ConstantVelocityDriver()


def begin_driver(subject: ObjectState, spec: DriverSpec, seen: Surroundings) -> AgentDriver:
    """The driver that a spec names, beginning at the instant ``seen``."""
    driver: AgentDriver
    match spec:
        case ReplayDriver():
            driver = Replay.begin(subject, seen.t_us)
        case ConstantVelocityDriver():
            driver = ConstantVelocity.begin(subject, seen.t_us)
        case IdmDriver():
            driver = Idm.begin(subject, seen.t_us, spec)
        case CutInDriver():
            driver = CutIn.begin(subject, spec, seen)
        case HardBrakeDriver():
            driver = HardBrake.begin(subject, seen.t_us, spec)
        case JunctionCrossingDriver():
            driver = JunctionCrossing.begin(subject, spec, seen)
        case ExternalDriver():
            driver = External.begin(subject, seen.t_us)
        case _:
            assert_never(spec)
    return driver


def _moves(subject: ObjectState) -> bool:
    return subject.trajectory.extent >= MOVING


def _placed(base: Agents, drivers: Mapping[str, AgentDriver]) -> Agents:
    """``base`` with the objects that have drivers where those have brought them."""
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
    positions = _with(positions[keep], [d.pose.position for d in late])
    quaternions = _with(quaternions[keep], [d.pose.quaternion for d in late])
    return Agents(
        objects=tuple(objects),
        sizes=_with(base.sizes[keep], [d.subject.scaled_size for d in late]),
        positions=positions,
        quaternions=quaternions,
        velocities=_with(velocities[keep], [d.pose.velocity for d in late]),
        transforms=transform_from(positions, quaternions),
    )


def _with(rows: Float, more: Sequence[Sequence[float]]) -> Float:
    return np.vstack([rows, np.asarray(more, dtype=np.float64)]) if more else rows
