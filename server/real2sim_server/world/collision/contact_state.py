"""Contact state across steps, and the motion of ego and objects in a step with contact."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from real2sim_proto.episode import EgoSpec, ResetSpec

from ..agents import Agents, Event, rows_in
from ..boxes import REAR_OVERHANG, may_meet_any, may_overlap
from ..controller import EgoController
from ..driving import Command
from ..ego_motion import Motion
from ..path import Float
from ..scoring.instant import ContactRecord
from ..traffic import Traffic
from .bodies import Impact, ImpactedObject
from .contact import ObstacleGrid, Pulse
from .solver import solve_collisions
from .solver_state import CollisionStep
from .sweep import BACKGROUND, EgoContacts, StepStart, ego_contacts, swept_contacts

WIDEN = 0.3
"""Margin around the positions that the ego may reach [m]."""

HeightAt = Callable[[float, float], float]
"""Height of the ground [m] at x, y [m]."""


class StepMotion(NamedTuple):
    """Ego and objects after a step.

    Attributes:
        controller, motion: controller and motion of the ego.
        traffic: the objects, including impacted ones.
        contacts: contact state after the step.
        impacts: impacts of the step; None without collision response.
    """

    controller: EgoController
    motion: Motion
    traffic: Traffic
    contacts: ContactState
    impacts: tuple[Impact, ...] | None


@dataclass(frozen=True, eq=False)
class ContactState:
    """Contacts at one instant of an episode.

    Attributes:
        spec: options of the episode.
        ego_size: size of the ego's box [m].
        obstacles: obstacles of the background; None if they are ignored.
        touching: names of all bodies in contact.
        ignored_pairs: pairs that overlapped at the start; they do not collide until they separate.
        sliding: whether the ego slides after an impact and does not follow its steering.
        pulses: ongoing impacts, by pair of names.
        ego_crush: permanent shortening of the ego's front and rear [m].
    """

    spec: ResetSpec
    ego_size: tuple[float, float, float]
    obstacles: ObstacleGrid | None
    touching: frozenset[str] = frozenset()
    ignored_pairs: frozenset[frozenset[str]] = frozenset()
    sliding: bool = False
    pulses: Mapping[tuple[str, str], Pulse] = field(default_factory=dict)
    ego_crush: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def begin(
        cls,
        spec: ResetSpec,
        ego_size: tuple[float, float, float],
        *,
        obstacles: ObstacleGrid | None,
        T_world_vehicle: Float,
        motion: Motion,
        agents: Agents,
    ) -> ContactState:
        """At the start of an episode."""
        contacts = cls(spec, ego_size, obstacles)
        instant = StepStart(motion, T_world_vehicle, agents, t_us=0, dt_us=spec.dt_us, at=None)
        touching = contacts.ego_contacts(instant, T_world_vehicle, motion, agents).touching
        ignored = frozenset(frozenset(("", name)) for name in touching)
        return replace(contacts, touching=touching, ignored_pairs=ignored)

    @property
    def exchanges_momentum(self) -> bool:
        """Whether there is collision response; not if poses place the ego."""
        return self.spec.on_collision == "continue" and self.spec.action != "pose"

    def ego_contacts(
        self, start: StepStart, T_world_vehicle: Float, motion: Motion, agents: Agents
    ) -> EgoContacts:
        """Contacts of the ego after a step, and which of them are new."""
        if self.spec.contact.swept:
            return swept_contacts(
                start,
                motion,
                T_world_vehicle,
                agents,
                spec=self.spec,
                ego_size=self.ego_size,
                obstacles=self.obstacles,
                before=self.touching,
            )
        return ego_contacts(
            T_world_vehicle,
            motion,
            agents,
            spec=self.spec,
            ego_size=self.ego_size,
            obstacles=self.obstacles,
            before=self.touching,
        )

    def advance(
        self,
        controller: EgoController,
        motion: Motion,
        before: Agents,
        traffic: Traffic,
        *,
        t_us: int,
        height: HeightAt,
    ) -> StepMotion:
        """Advance the ego by one step, with all impacts.

        Args:
            controller, motion: controller and motion of the ego at the start.
            before: objects at the start.
            traffic: objects at the end without impacts.
            t_us: start time [us].
            height: ground height at x, y [m].
        """
        if not self.exchanges_momentum or not self._may_collide(motion, before, traffic):
            controller, motion = controller.advance(motion, t_us, self.spec.dt_us)
            impacts = () if self.exchanges_momentum else None
            contacts = replace(self, pulses={}) if self.pulses else self
            return StepMotion(controller, motion, traffic, contacts, impacts)
        steered = _SteppedController(controller, t_us)
        result = solve_collisions(
            CollisionStep(
                t_us=t_us,
                dt_us=self.spec.dt_us,
                motion=motion,
                sliding=self.sliding,
                advance=steered.advance,
                command=steered.command,
                spec=self.spec.ego,
                ego_size=self.ego_size,
                contact=self.spec.contact,
                before=before,
                after=traffic.agents,
                impacted=_impacted_objects(traffic),
                ignored_pairs=self.ignored_pairs,
                background=self.obstacles,
                pulses=self.pulses,
                ego_crush=self.ego_crush,
                height=height,
            )
        )
        contacts = replace(
            self,
            sliding=result.sliding,
            ignored_pairs=result.ignored_pairs,
            pulses=result.pulses,
            ego_crush=result.ego_crush,
        )
        collided = traffic.with_drivers(result.impacted, traffic.agents)
        return StepMotion(steered.controller, result.motion, collided, contacts, result.impacts)

    def after_warm_up(self, touching: frozenset[str]) -> ContactState:
        """The state after a warm-up step; its contacts are ignored like those at the start."""
        ignored = frozenset(frozenset(("", name)) for name in touching)
        return replace(self, touching=touching, ignored_pairs=ignored)

    def _may_collide(self, motion: Motion, before: Agents, traffic: Traffic) -> bool:
        """Conservative test whether any two bodies could touch within the step."""
        if self.sliding or self.obstacles is not None:
            return True
        if any(isinstance(driver, ImpactedObject) for driver in traffic.drivers.values()):
            return True
        dt = self.spec.dt_us * 1e-6
        if self.spec.contact.swept:
            ego = self.spec.ego
            return may_meet(motion, before, traffic.agents, ego, ego_size=self.ego_size, dt=dt)
        return may_collide(motion, traffic.agents, ego_size=self.ego_size, dt=dt)


def may_meet(
    motion: Motion,
    before: Agents,
    after: Agents,
    spec: EgoSpec,
    *,
    ego_size: tuple[float, float, float],
    dt: float,
) -> bool:
    """Conservative test whether the ego could touch an object, for any motion within its limits.

    Args:
        motion: ego motion at the start of the step.
        before, after: objects at the start and the end of the step.
        spec: limits of the vehicle.
        ego_size: size of its box [m].
        dt: time step [s].
    """
    if not after.objects:
        return False
    fastest = math.hypot(motion.speed, motion.lateral_speed)
    fastest += max(spec.max_acceleration, spec.max_braking) * dt
    steering = min(abs(motion.steering) + spec.max_steer_rate * dt, spec.max_steer)
    rate = max(abs(motion.yaw_rate), math.tan(steering) / spec.wheelbase * fastest)
    turn = min(rate * dt, math.pi / 2)
    centre_ahead = ego_size[0] / 2 - REAR_OVERHANG
    cos, sin = math.cos(motion.yaw), math.sin(motion.yaw)
    place = (motion.x + centre_ahead * cos, motion.y + centre_ahead * sin, motion.yaw)
    aside = (fastest * dt + ego_size[0]) * math.sin(turn) + abs(motion.lateral_speed) * dt
    return bool(
        may_meet_any(
            (*place, fastest * dt + WIDEN, aside + WIDEN),
            ego_size[:2],
            rows_in(before, after),
            (before.positions, before.quaternions),
            (after.positions, after.quaternions),
            after.sizes,
        )
    )


def may_collide(
    motion: Motion, agents: Agents, *, ego_size: tuple[float, float, float], dt: float
) -> bool:
    """Conservative test whether the ego could touch an object, by bounds along its heading.

    Args:
        motion: ego motion at the start of the step.
        agents: objects at its end.
        ego_size: size of the ego's box [m].
        dt: time step [s].
    """
    if not agents.objects:
        return False
    centre_ahead = ego_size[0] / 2 - REAR_OVERHANG
    cos, sin = math.cos(motion.yaw), math.sin(motion.yaw)
    ego = (
        motion.x + centre_ahead * cos,
        motion.y + centre_ahead * sin,
        motion.yaw,
        motion.speed,
        motion.lateral_speed,
        motion.yaw_rate,
    )
    boxes = (agents.positions, agents.quaternions, agents.velocities, agents.sizes)
    return bool(may_overlap(ego, ego_size[:2], dt, *boxes))


class _SteppedController:
    """The controller of the ego in the substeps of a step that starts at ``t_us``."""

    def __init__(self, controller: EgoController, t_us: int) -> None:
        self.controller = controller
        self._t_us = t_us

    def advance(self, motion: Motion, since_us: int, us: int) -> Motion:
        self.controller, moved = self.controller.advance(motion, self._t_us + since_us, us)
        return moved

    def command(self, motion: Motion, since_us: int) -> Command:
        t_us = self._t_us + since_us
        self.controller = self.controller.activated(motion, t_us)
        return self.controller.command(motion, t_us)


def _impacted_objects(traffic: Traffic) -> dict[str, ImpactedObject]:
    return {i: d for i, d in traffic.drivers.items() if isinstance(d, ImpactedObject)}


# --- Contacts of a step --------------------------------------------------------------------------

# Events for the policy, records for the scores.


class StepContacts(NamedTuple):
    """Contacts of one step.

    Attributes:
        events: new collisions.
        records: contacts of the ego.
        touching: names of all bodies in contact.
        secondary: new contacts between objects.
    """

    events: tuple[Event, ...] = ()
    records: tuple[ContactRecord, ...] = ()
    touching: frozenset[str] = frozenset()
    secondary: int = 0


def contacts_of_overlaps(found: EgoContacts, t_us: int) -> StepContacts:
    """Contacts of a step without collision response."""
    events = (Event("collision", t_us, c.object_id, data=c.event_data()) for c in found.begun)
    return StepContacts(tuple(events), found.records, found.touching)


def contacts_of_impacts(
    impacts: tuple[Impact, ...], t_us: int, *, touching: frozenset[str], before: Agents
) -> StepContacts:
    """Contacts of a step with collision response.

    Args:
        impacts: impacts of the step.
        t_us: time at its end [us].
        touching: names of all bodies in contact before the step.
        before: objects at its start.
    """
    begun = [i for i in impacts if _pair_name(i) not in touching]
    return StepContacts(
        tuple(Event("collision", t_us, i.object_id, i.other_id, i.event_data()) for i in begun),
        _ego_records(impacts, touching=touching, agents=before),
        frozenset(_pair_name(i) for i in impacts),
        sum(i.other_id is not None for i in begun),
    )


def _ego_records(
    impacts: tuple[Impact, ...], *, touching: frozenset[str], agents: Agents
) -> tuple[ContactRecord, ...]:
    """Score records of the ego's impacts."""
    categories = {o.object_id: o.category for o in agents.objects}
    return tuple(
        ContactRecord(
            object_id=impact.object_id,
            category=categories.get(impact.object_id or "", BACKGROUND),
            side=impact.side,
            relative_speed=impact.relative_speed,
            ego_speed=impact.speeds[0],
            object_speed=impact.speeds[1],
            impulse=impact.impulse,
            begun=(impact.object_id or BACKGROUND) not in touching,
            since=impact.since,
        )
        for impact in impacts
        if impact.other_id is None
    )


def _pair_name(impact: Impact) -> str:
    """Name of a pair in contact; for the ego's contacts the name of the object."""
    name = impact.object_id or BACKGROUND
    return name if impact.other_id is None else f"{name}\n{impact.other_id}"
