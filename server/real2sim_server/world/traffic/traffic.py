"""All road users but the ego: their drivers and their poses."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from real2sim_proto import ErrorCode
from real2sim_proto.episode import AgentDriver as DriverSpec
from real2sim_proto.episode import AgentsSpec, ConstantVelocityDriver, IdmDriver

from ...edit import ObjectState, ScenarioState
from ...geometry.transform import transform_from
from ..agents import Agents, rows_of
from ..errors import WorldError
from ..path import Float
from .driver import AgentDriver, Surroundings
from .drivers import begin_driver
from .external import External

MOVING = 2.0
"""Objects that cover less than this in the recording stand and get no driver [m]."""

DRIVEN = frozenset({"car", "vehicle", "van", "truck", "bus", "motorcycle", "cyclist"})
"""Categories that a default driver drives; pedestrians keep to the log."""


@dataclass(frozen=True, eq=False)
class Traffic:
    """Objects of an episode at one instant. Immutable; objects without a driver repeat the log.

    Attributes:
        spec: driver by object.
        drivers: by object id; of objects that have appeared.
        agents: poses of all objects.
        reacting: whether objects that repeated the log have begun to drive by IDM.
    """

    spec: AgentsSpec
    drivers: Mapping[str, AgentDriver]
    agents: Agents
    reacting: bool = False

    @classmethod
    def begin(cls, state: ScenarioState, spec: AgentsSpec, surroundings: Surroundings) -> Traffic:
        """Objects at the start of an episode.

        Args:
            state: all objects.
            spec: their drivers.
            surroundings: the start; its ``others`` are where the log has them.

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
        return cls(spec, none, surroundings.others)._with_new_drivers(
            state, surroundings.others, surroundings
        )

    def advance(
        self, state: ScenarioState, t_us: int, surroundings: Callable[[], Surroundings]
    ) -> Traffic:
        """Objects one step later.

        Args:
            state: objects after all edits.
            t_us: the instant after the step [us].
            surroundings: of the instant before, whose ``others`` are ``agents``; only called
                where an object has a driver.
        """
        base = state.tracks.at(t_us)
        if not (self.drivers or self._assigns_drivers):
            return Traffic(self.spec, self.drivers, base, self.reacting)
        before = surroundings()
        drivers = {i: d.advance(before) for i, d in self.drivers.items()}
        moved = replace(self, drivers=MappingProxyType(drivers))
        return moved._with_new_drivers(state, base, replace(before, t_us=t_us))

    def edited(self, state: ScenarioState, surroundings: Surroundings) -> Traffic:
        """Objects after an edit: drivers of objects whose trajectory was edited begin anew."""
        kept = {
            i: d
            for i, d in self.drivers.items()
            if (edited := state.objects.get(i)) is not None
            and not edited.deleted
            and edited.trajectory is d.subject.trajectory
            and edited.scale == d.subject.scale
        }
        base = state.tracks.at(surroundings.t_us)
        return replace(self, drivers=MappingProxyType(kept))._with_new_drivers(
            state, base, surroundings
        )

    def with_reacting_agents(self, state: ScenarioState, surroundings: Surroundings) -> Traffic:
        """Objects that repeat the log drive by IDM from now on."""
        return replace(self, reacting=True)._with_new_drivers(
            state, state.tracks.at(surroundings.t_us), surroundings
        )

    def with_plan(
        self,
        object_id: str,
        t_us: int,
        times_us: Sequence[int],
        poses: Sequence[tuple[float, float, float]],
    ) -> Traffic:
        """Objects after an externally driven one got a plan.

        Raises:
            WorldError: INVALID_ACTION when it is not driven externally, or its plan is over.
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
        """Objects with other drivers for some of them, placed anew on top of ``base``."""
        merged = MappingProxyType({**self.drivers, **drivers})
        return replace(self, drivers=merged, agents=_with_driver_poses(base, merged))

    def _with_new_drivers(
        self, state: ScenarioState, base: Agents, surroundings: Surroundings
    ) -> Traffic:
        """With drivers for objects that have just appeared."""
        drivers = dict(self.drivers)
        if self._assigns_drivers:
            for subject in base.objects:
                if subject.object_id not in drivers:
                    driver = self._driver_for(subject, surroundings)
                    if driver is not None:
                        drivers[subject.object_id] = driver
        frozen = MappingProxyType(drivers)
        return replace(self, drivers=frozen, agents=_with_driver_poses(base, frozen))

    @property
    def _assigns_drivers(self) -> bool:
        """Whether objects that appear may get a driver."""
        return bool(self.spec.drivers) or self.spec.default != "log" or self.reacting

    def _driver_for(self, subject: ObjectState, surroundings: Surroundings) -> AgentDriver | None:
        spec = self.spec.drivers.get(subject.object_id)
        if spec is None:
            spec = self._default_for(subject)
        if spec is None:
            return None
        return begin_driver(subject, spec, surroundings)

    def _default_for(self, subject: ObjectState) -> DriverSpec | None:
        kind = "idm" if self.reacting else self.spec.default
        if kind == "log" or subject.category not in DRIVEN or not _moves(subject):
            return None
        return IdmDriver() if kind == "idm" else ConstantVelocityDriver()


def _moves(subject: ObjectState) -> bool:
    return subject.trajectory.extent >= MOVING


def _with_driver_poses(base: Agents, drivers: Mapping[str, AgentDriver]) -> Agents:
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
