"""Contacts of the ego at an instant where no momentum is exchanged: overlaps of boxes.

What begins and ends between two instants is found by :mod:`.sweep`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from real2sim_proto.episode import ResetSpec

from ..._records import made_quickly
from ...edit import ObjectState
from ...geometry.box_kernels import boxes_overlap
from ...geometry.rotation import quaternion_yaw
from ..agents import Agents
from ..boxes import REAR_OVERHANG, ego_box, within_reach
from ..ego.motion import Motion
from ..path import Float
from ..scoring.hazard import side_of_contact
from ..scoring.instant import ContactRecord
from .bodies import ego_body, ego_properties
from .obstacles import ObstacleGrid

BACKGROUND = "background"
"""Name and category of what is not an object."""


@dataclass(frozen=True)
class OverlapContact:
    """One object whose box began to overlap the ego box.

    Attributes:
        object_id: the object; None for the background.
        relative_speed: length of the difference of the two velocities [m/s].
        t_us: when it began [us]; None where only instants are looked at.
        place: where it began, x, y [m], where ``t_us`` says when.
    """

    object_id: str | None
    relative_speed: float
    t_us: float | None = None
    place: tuple[float, float] = (0.0, 0.0)

    def event_data(self) -> dict[str, float]:
        """Data of its event on the wire."""
        data = {"relative_speed": self.relative_speed}
        if self.t_us is not None:
            data |= {"contact_us": self.t_us, "x": self.place[0], "y": self.place[1]}
        return data


@made_quickly
@dataclass(frozen=True, eq=False)
class EgoContacts:
    """Contacts of the ego at an instant where no momentum is exchanged.

    Attributes:
        touching: ids of the objects whose boxes overlap the ego's, and ``background``.
        begun: contacts that were not there one step before.
        records: of those, for the scores.
    """

    touching: frozenset[str]
    begun: tuple[OverlapContact, ...]
    records: tuple[ContactRecord, ...]


def ego_contacts(
    T_world_vehicle: Float,
    motion: Motion,
    agents: Agents,
    *,
    spec: ResetSpec,
    ego_size: tuple[float, float, float],
    obstacles: ObstacleGrid | None,
    before: frozenset[str],
) -> EgoContacts:
    """Which objects the ego box overlaps, and which of those contacts are new.

    Objects that overlap the ego box when an episode starts count as being in contact already, so
    they are reported only after they have separated once: boxes of a recording often overlap
    slightly, and nobody drove into anybody then.
    """
    T_world_box = ego_box(T_world_vehicle, ego_size)
    rows = overlapping_rows(T_world_box, ego_size, agents)
    names = [agents.objects[k].object_id for k in rows]
    contacts, records = [], []
    for k, name in zip(rows, names, strict=True):
        if name in before:
            continue
        box = (*T_world_box[:2, 3].tolist(), motion.yaw, *ego_size[:2])
        velocity = T_world_vehicle[:3, :2] @ [motion.speed, motion.lateral_speed]
        relative = velocity - agents.velocities[k]
        speed = float(np.sqrt(relative @ relative))
        contacts.append(OverlapContact(name, speed))
        driven = math.hypot(motion.speed, motion.lateral_speed)
        records.append(
            _object_record(box, driven, agents, k, relative_speed=speed, reversing=motion.reversing)
        )
    if obstacles is not None:
        body, properties = ego_body(motion, spec.ego), ego_properties(spec.ego, ego_size)
        if obstacles.manifold(body, properties) is not None:
            names.append(BACKGROUND)
            if BACKGROUND not in before:
                speed = math.hypot(motion.speed, motion.lateral_speed)
                contacts.append(OverlapContact(None, speed))
                records.append(_background_record(speed))
    return EgoContacts(frozenset(names), tuple(contacts), tuple(records))


def overlapping_rows(
    T_world_box: Float, size: tuple[float, float, float], agents: Agents
) -> list[int]:
    """Rows of ``agents`` whose boxes overlap a box, T_world_box [4, 4] of ``size`` [m]."""
    if not agents.objects:
        return []
    transforms, sizes = agents.transforms, agents.sizes
    near = within_reach(T_world_box, size, transforms, sizes).tolist()
    return [k for k in near if boxes_overlap(T_world_box, size, transforms[k], sizes[k])]


def _object_record(
    box: tuple[float, float, float, float, float],
    ego_speed: float,
    agents: Agents,
    k: int,
    *,
    relative_speed: float,
    reversing: bool,
) -> ContactRecord:
    subject: ObjectState = agents.objects[k]
    x, y, _ = agents.positions[k].tolist()
    length, width, _ = agents.sizes[k].tolist()
    speed = float(np.hypot(*agents.velocities[k, :2]))
    other = (x, y, float(quaternion_yaw(agents.quaternions[k])), length, width)
    return ContactRecord(
        object_id=subject.object_id,
        category=subject.category,
        side=side_of_contact(
            *(box, ego_speed, other, speed),
            axle=box[3] / 2 - REAR_OVERHANG,
            reversing=reversing,
        ),
        relative_speed=relative_speed,
        ego_speed=ego_speed,
        object_speed=speed,
    )


def _background_record(speed: float) -> ContactRecord:
    return ContactRecord(None, BACKGROUND, "stopped_track", speed, speed, 0.0)
