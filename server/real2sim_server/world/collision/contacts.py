"""Who touches whom, from step to step, and how ego and objects move where they meet."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

from real2sim_proto.episode import ResetSpec

from ..agents import Agents
from ..ego.controller import EgoController
from ..ego.vehicle import Motion
from ..path import Float
from ..traffic import Traffic
from .contact import REAR_OVERHANG
from .meeting import Met, may_meet, met, run_bout
from .model import Impact, ImpactedObject
from .obstacles import Obstacles


class Moved(NamedTuple):
    """Ego and objects after a step.

    Attributes:
        pilot, motion: of the ego.
        traffic: the objects, those that were struck among them.
        contacts: to go on with.
        impacts: of the step; None where bodies pass through each other.
    """

    pilot: EgoController
    motion: Motion
    traffic: Traffic
    contacts: Contacts
    impacts: tuple[Impact, ...] | None


@dataclass(frozen=True, eq=False)
class Contacts:
    """Of one instant of an episode.

    Attributes:
        spec: of the episode.
        ego_size: of the ego's box [m].
        obstacles: of the background; None where it does not count.
        touching: names of what is in contact.
        exempt: pairs that overlapped when the episode began; they pass through each other until
            they have parted.
        sliding: whether the ego has been pushed and no longer rolls as it is steered.
    """

    spec: ResetSpec
    ego_size: tuple[float, float, float]
    obstacles: Obstacles | None
    touching: frozenset[str] = frozenset()
    exempt: frozenset[frozenset[str]] = frozenset()
    sliding: bool = False

    @classmethod
    def begin(
        cls,
        spec: ResetSpec,
        ego_size: tuple[float, float, float],
        *,
        obstacles: Obstacles | None,
        T_world_vehicle: Float,
        motion: Motion,
        agents: Agents,
    ) -> Contacts:
        """At the start of an episode."""
        contacts = cls(spec, ego_size, obstacles)
        touching = contacts.met(T_world_vehicle, motion, agents).touching
        exempt = frozenset(frozenset(("", name)) for name in touching)
        return replace(contacts, touching=touching, exempt=exempt)

    @property
    def physical(self) -> bool:
        """Whether bodies push each other; one that is put somewhere by poses cannot be pushed."""
        return self.spec.on_collision == "continue" and self.spec.action != "pose"

    def met(self, T_world_vehicle: Float, motion: Motion, agents: Agents) -> Met:
        """Contacts of the ego that stands so, and which of them were not there before."""
        return met(
            T_world_vehicle,
            motion,
            agents,
            spec=self.spec,
            ego_size=self.ego_size,
            obstacles=self.obstacles,
            before=self.touching,
        )

    def move(
        self,
        pilot: EgoController,
        motion: Motion,
        before: Agents,
        traffic: Traffic,
        *,
        t_us: int,
        height: Callable[[float, float], float],
    ) -> Moved:
        """One step of the ego, with what comes of those it meets.

        Args:
            pilot, motion: of the ego at the start.
            before: objects at the start.
            traffic: objects at the end, were nothing in their way.
            t_us: at the start [us].
            height: of the ground at x, y [m].
        """
        if not self.physical or not self._may_meet(motion, traffic):
            pilot, motion = pilot.advance(motion, t_us, self.spec.dt_us)
            return Moved(pilot, motion, traffic, self, () if self.physical else None)
        pilot, outcome = run_bout(
            pilot,
            motion,
            t_us,
            spec=self.spec,
            sliding=self.sliding,
            ego_size=self.ego_size,
            before=before,
            after=traffic.placed,
            wrecks={i: d for i, d in traffic.drivers.items() if isinstance(d, ImpactedObject)},
            exempt=self.exempt,
            obstacles=self.obstacles,
            height=height,
        )
        contacts = replace(self, sliding=outcome.sliding, exempt=outcome.exempt)
        struck = traffic.with_drivers(outcome.wrecks, traffic.placed)
        return Moved(pilot, outcome.motion, struck, contacts, outcome.impacts)

    def _may_meet(self, motion: Motion, traffic: Traffic) -> bool:
        """Whether anything could touch anything within the step."""
        if self.sliding or self.obstacles is not None:
            return True
        if any(isinstance(driver, ImpactedObject) for driver in traffic.drivers.values()):
            return True
        return may_meet(
            motion,
            traffic.placed,
            ego_size=self.ego_size,
            centre_ahead=self.ego_size[0] / 2 - REAR_OVERHANG,
            dt=self.spec.dt_us * 1e-6,
        )
