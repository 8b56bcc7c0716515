"""The ego among other bodies: whether they meet in a step, and what comes of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from real2sim_proto.episode import ResetSpec

from ...edit import ObjectState
from ...geometry.rotation import quaternion_yaw
from ..agents import Agents
from ..driving import Command
from ..ego.controller import EgoController
from ..ego.vehicle import Motion
from ..path import Float
from ..scoring.boxes import side_of_contact
from ..scoring.instant import ContactNote
from .contact import Contact, ego_box, touching
from .contact_kernels import may_overlap
from .model import Impact, ImpactedObject, ego_body, ego_solid
from .obstacles import Obstacles
from .resolve import Bout, Outcome, resolve

BACKGROUND = "background"


def may_meet(
    motion: Motion,
    agents: Agents,
    *,
    ego_size: tuple[float, float, float],
    centre_ahead: float,
    dt: float,
) -> bool:
    """Whether the ego could touch an object within the step, by boxes along its heading.

    Args:
        motion: of the ego at the start of the step.
        agents: at its end.
        ego_size: of its box [m].
        centre_ahead: rear axle to the centre of the box [m].
        dt: the step [s].
    """
    if not agents.objects:
        return False
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


def run_bout(
    pilot: EgoController,
    motion: Motion,
    t_us: int,
    *,
    spec: ResetSpec,
    sliding: bool,
    ego_size: tuple[float, float, float],
    before: Agents,
    after: Agents,
    wrecks: Mapping[str, ImpactedObject],
    exempt: frozenset[frozenset[str]],
    obstacles: Obstacles | None,
    height: Callable[[float, float], float],
) -> tuple[EgoController, Outcome]:
    """The step with contact; see :func:`~.impact.resolve`."""
    pilots = [pilot]

    def roll(now: Motion, since_us: int, us: int) -> Motion:
        pilots[0], moved = pilots[0].advance(now, t_us + since_us, us)
        return moved

    def command(now: Motion, since_us: int) -> Command:
        pilots[0] = pilots[0].begun(now, t_us + since_us)
        controller = pilots[0].controller
        assert controller is not None
        return controller.command(now, (t_us + since_us - pilots[0].since_us) * 1e-6)

    outcome = resolve(
        Bout(
            t_us=t_us,
            dt_us=spec.dt_us,
            motion=motion,
            sliding=sliding,
            roll=roll,
            command=command,
            spec=spec.ego,
            ego_size=ego_size,
            contact=spec.contact,
            before=before,
            after=after,
            wrecks=wrecks,
            exempt=exempt,
            background=obstacles.touch if obstacles is not None else None,
            height=height,
        )
    )
    return pilots[0], outcome


@dataclass(frozen=True, eq=False)
class Met:
    """Contacts of the ego at an instant where no momentum is exchanged.

    Attributes:
        touching: ids of the objects whose boxes overlap the ego's, and ``background``.
        begun: contacts that were not there one step before.
        notes: of those, for the scores.
    """

    touching: frozenset[str]
    begun: tuple[Contact, ...]
    notes: tuple[ContactNote, ...]


def met(
    T_world_vehicle: Float,
    motion: Motion,
    agents: Agents,
    *,
    spec: ResetSpec,
    ego_size: tuple[float, float, float],
    obstacles: Obstacles | None,
    before: frozenset[str],
) -> Met:
    """Which objects the ego box overlaps, and which of those contacts are new.

    Objects that overlap the ego box when an episode starts count as being in contact already, so
    they are reported only after they have separated once: boxes of a recording often overlap
    slightly, and nobody drove into anybody then.
    """
    T_world_box = ego_box(T_world_vehicle, ego_size)
    rows = touching(T_world_box, ego_size, agents)
    names = [agents.objects[k].object_id for k in rows]
    contacts, notes = [], []
    for k, name in zip(rows, names, strict=True):
        if name in before:
            continue
        box = (*T_world_box[:2, 3].tolist(), motion.yaw, *ego_size[:2])
        velocity = T_world_vehicle[:3, :2] @ [motion.speed, motion.lateral_speed]
        relative = velocity - agents.velocities[k]
        speed = float(np.sqrt(relative @ relative))
        contacts.append(Contact(name, speed))
        notes.append(_note(box, motion.speed, agents, k, relative_speed=speed))
    if obstacles is not None:
        body, solid = ego_body(motion, spec.ego), ego_solid(spec.ego, ego_size)
        if obstacles.touch(body, solid) is not None:
            names.append(BACKGROUND)
            if BACKGROUND not in before:
                speed = math.hypot(motion.speed, motion.lateral_speed)
                contacts.append(Contact(None, speed))
                notes.append(_background_note(speed))
    return Met(frozenset(names), tuple(contacts), tuple(notes))


def notes_of(
    impacts: tuple[Impact, ...], *, touched: frozenset[str], agents: Agents
) -> tuple[ContactNote, ...]:
    """Impacts of the ego for the scores; ``touched``: what was in contact one step before."""
    categories = {o.object_id: o.category for o in agents.objects}
    return tuple(
        ContactNote(
            object_id=impact.object_id,
            category=categories.get(impact.object_id or "", BACKGROUND),
            side=impact.side,
            relative_speed=impact.relative_speed,
            ego_speed=impact.speeds[0],
            object_speed=impact.speeds[1],
            impulse=impact.impulse,
            begun=(impact.object_id or BACKGROUND) not in touched,
        )
        for impact in impacts
        if impact.other_id is None
    )


def _note(
    box: tuple[float, float, float, float, float],
    ego_speed: float,
    agents: Agents,
    k: int,
    *,
    relative_speed: float,
) -> ContactNote:
    subject: ObjectState = agents.objects[k]
    x, y, _ = agents.positions[k].tolist()
    length, width, _ = agents.sizes[k].tolist()
    speed = float(np.hypot(*agents.velocities[k, :2]))
    other = (x, y, float(quaternion_yaw(agents.quaternions[k])), length, width)
    return ContactNote(
        object_id=subject.object_id,
        category=subject.category,
        side=side_of_contact(box, ego_speed, other, speed),
        relative_speed=relative_speed,
        ego_speed=ego_speed,
        object_speed=speed,
    )


def _background_note(speed: float) -> ContactNote:
    return ContactNote(None, BACKGROUND, "stopped_track", speed, speed, 0.0)
