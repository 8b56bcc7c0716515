"""Contacts of the ego without collision response: at an instant, and swept over a step.

Within a step, boxes are swept from the previous to the current instant. The ego follows its
controller, sampled every 50 ms; position and yaw of other objects are interpolated linearly. Boxes
are compared in the plane; boxes whose height ranges do not overlap do not touch.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from real2sim_proto.episode import EgoSpec, ResetSpec

from ..._records import made_quickly
from ...edit import ObjectState
from ...geometry import boxes_overlap, quaternion_yaw
from ...scene.ground import OBSTACLE_CELL
from ..agents import Agents, rows_in
from ..boxes import REAR_OVERHANG, ego_box, first_contacts, first_occupied, holds_any, within_reach
from ..ego_motion import Motion
from ..path import Float
from ..scoring.instant import ContactRecord, side_of_contact
from .bodies import BodyProperties, BodyState, ego_body, ego_properties
from .contact import ObstacleGrid, contact_manifold, corners

# --- Overlaps at an instant ----------------------------------------------------------------------

BACKGROUND = "background"
"""Name and category of the background."""


@dataclass(frozen=True)
class OverlapContact:
    """A new overlap of an object with the ego box.

    Attributes:
        object_id: id of the object; None for the background.
        relative_speed: magnitude of the relative velocity [m/s].
        t_us: start time [us]; None if only instants are compared.
        place: contact position x, y [m] at ``t_us``.
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
    """Contacts of the ego at an instant, without collision response.

    Attributes:
        touching: ids of the objects whose boxes overlap the ego's, and ``background``.
        begun: contacts that are new in this step.
        records: score records of the new contacts.
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
    """Objects that overlap the ego box, and which of these contacts are new.

    Overlaps at the start of an episode are not reported until the objects have separated once:
    recorded boxes often overlap slightly without a collision.
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


Size = tuple[float, float, float]
Box = tuple[float, float, float, float, float]
"""Centre x, y [m], yaw [rad], length and width [m] in the plane."""

PIECE_US = 50_000
"""Sampling interval of the ego's path [us]; the linear interpolation error is 3 mm at 1 g."""

TOLERANCE = 1e-3
COARSE = 2e-2
"""Maximum motion between two checks of nearly touching bodies [m]."""


class StepStart(NamedTuple):
    """The world before a step, and the ego motion during it.

    Attributes:
        motion, T_world_vehicle: motion and pose of the ego.
        agents: the objects.
        t_us, dt_us: start and duration of the step [us].
        at: ``at(since_us)``, ego motion within the step; None if poses place the ego, whose path is
            then straight.
    """

    motion: Motion
    T_world_vehicle: Float
    agents: Agents
    t_us: int
    dt_us: int
    at: Callable[[int], Motion] | None


class _Contact(NamedTuple):
    """A new contact: fraction of the step, and row of the object.

    The row is None for the background, which has the contact position instead.
    """

    fraction: float
    row: int | None
    place: tuple[float, float] = (0.0, 0.0)


def swept_contacts(
    start: StepStart,
    motion: Motion,
    T_world_vehicle: Float,
    agents: Agents,
    *,
    spec: ResetSpec,
    ego_size: Size,
    obstacles: ObstacleGrid | None,
    before: frozenset[str],
) -> EgoContacts:
    """Contacts of the ego in a step; new ones in the order of their start.

    Args:
        start: the world before the step.
        motion, T_world_vehicle: motion and pose of the ego after the step.
        agents: the objects after the step.
        spec: options of the episode.
        ego_size: size of the ego's box [m].
        obstacles: obstacles of the background; None if they are ignored.
        before: names in contact before the step; their contacts are not new.
    """
    sweep = _Sweep(start, motion, T_world_vehicle, agents, ego=spec.ego, size=ego_size)
    begun, touching = sweep.objects(before)
    if obstacles is not None:
        hit, lies_on = sweep.background(obstacles)
        if hit is not None and BACKGROUND not in before:
            begun.append(hit)
        if lies_on:
            touching.append(BACKGROUND)
    # Simultaneous contacts in row order, the background last.
    begun.sort(key=lambda c: (c.fraction, math.inf if c.row is None else c.row))
    found = [sweep.described(contact) for contact in begun]
    return EgoContacts(
        frozenset(touching), tuple(c for c, _ in found), tuple(record for _, record in found)
    )


class _Sweep:
    """The boxes of one step."""

    def __init__(
        self,
        start: StepStart,
        motion: Motion,
        T_world_vehicle: Float,
        agents: Agents,
        *,
        ego: EgoSpec,
        size: Size,
    ) -> None:
        self._start, self._motion, self._agents = start, motion, agents
        self._size = size
        self._low = _height(start.T_world_vehicle, self._axle)
        self._low_after = _height(T_world_vehicle, self._axle)
        self._rows = rows_in(start.agents, agents)
        self._rough = self._motion_rows([start.motion, motion])
        self._exact: Float | None = self._rough
        self._slack = 0.0
        if start.at is not None and start.dt_us > PIECE_US:
            self._exact = None
            # A vehicle placed by poses may have moved arbitrarily.
            self._slack = _deviation(start, motion, ego, size)
            if ego.tracker == "perfect":
                self._rough, self._slack = self.way, 0.0

    def objects(self, before: frozenset[str]) -> tuple[list[_Contact], list[str]]:
        """New contacts with objects, and names of the objects in contact at the end."""
        objects = self._agents.objects
        if not objects:
            return [], []
        if self._slack > 0.0:
            near, _ = self._first(self._rough, self._slack, COARSE)
            if min(near.tolist()) == math.inf:
                return [], []
        first, touching = self._first(self.way, 0.0, TOLERANCE)
        if min(first.tolist()) == math.inf:
            return [], []
        names = [objects[k].object_id for k in np.flatnonzero(touching).tolist()]
        begun = [
            _Contact(float(first[k]), k)
            for k in np.flatnonzero(np.isfinite(first)).tolist()
            if objects[k].object_id not in before
        ]
        return begun, names

    def background(self, obstacles: ObstacleGrid) -> tuple[_Contact | None, bool]:
        """The first contact with the background, and whether there is one at the end."""
        grid = (obstacles.origin, OBSTACLE_CELL, obstacles.sums)
        reach = math.hypot(*self._size[:2]) / 2 + self._slack
        if not holds_any(self._rough, reach, *grid):
            return None, False
        first, x, y, touching = first_occupied(
            self.way,
            self._size,
            OBSTACLE_CELL / 2,
            obstacles.origin,
            OBSTACLE_CELL,
            obstacles.occupied,
            obstacles.sums,
        )
        return (_Contact(first, None, (x, y)) if math.isfinite(first) else None), touching

    def described(self, contact: _Contact) -> tuple[OverlapContact, ContactRecord]:
        """The contact for the event and for the scores."""
        motion, box = self._ego_at(contact.fraction)
        vx, vy = motion.velocity
        ego_speed = math.hypot(motion.speed, motion.lateral_speed)
        t_us = self._start.t_us + contact.fraction * self._start.dt_us
        if contact.row is None:
            record = ContactRecord(
                None, BACKGROUND, "stopped_track", ego_speed, ego_speed, 0.0, since=contact.fraction
            )
            return OverlapContact(None, ego_speed, t_us, contact.place), record
        subject = self._agents.objects[contact.row]
        other, (wx, wy) = self._object_at(contact.row, contact.fraction)
        relative, object_speed = math.hypot(vx - wx, vy - wy), math.hypot(wx, wy)
        record = ContactRecord(
            object_id=subject.object_id,
            category=subject.category,
            side=side_of_contact(
                *(box, ego_speed, other, object_speed),
                axle=self._axle,
                reversing=motion.reversing,
            ),
            relative_speed=relative,
            ego_speed=ego_speed,
            object_speed=object_speed,
            since=contact.fraction,
        )
        return OverlapContact(subject.object_id, relative, t_us, _place(box, other)), record

    @property
    def way(self) -> Float:
        """Motion of the ego's box, as accurately as known."""
        if self._exact is None:
            at, dt_us = self._start.at, self._start.dt_us
            assert at is not None
            pieces = -(-dt_us // PIECE_US)
            between = [at(dt_us * k // pieces) for k in range(1, pieces)]
            self._exact = self._motion_rows([self._start.motion, *between, self._motion])
        return self._exact

    @property
    def _axle(self) -> float:
        return self._size[0] / 2 - REAR_OVERHANG

    def _motion_rows(self, motions: list[Motion]) -> Float:
        """Rows for the kernels, evenly spaced over the step."""
        rows, yaw, axle, last = [], motions[0].yaw, self._axle, len(motions) - 1
        for k, motion in enumerate(motions):
            fraction = k / last
            yaw += math.remainder(motion.yaw - yaw, math.tau)
            x, y = motion.x + axle * math.cos(yaw), motion.y + axle * math.sin(yaw)
            low = self._low + (self._low_after - self._low) * fraction
            rows.append((fraction, x, y, yaw, low))
        return np.array(rows)

    def _first(self, way: Float, slack: float, tolerance: float) -> tuple[Float, Float]:
        before, after = self._start.agents, self._agents
        first, touching = first_contacts(
            way,
            self._size,
            self._rows,
            (before.positions, before.quaternions),
            (after.positions, after.quaternions),
            after.sizes,
            slack,
            tolerance,
        )
        return first, touching

    def _ego_at(self, fraction: float) -> tuple[Motion, Box]:
        """The ego at a fraction of the step: motion, and box in the plane."""
        way = self.way
        x, y, yaw = (float(np.interp(fraction, way[:, 0], way[:, c])) for c in (1, 2, 3))
        box = (x, y, yaw, *self._size[:2])
        at, since_us = self._start.at, round(fraction * self._start.dt_us)
        if at is None or since_us == self._start.dt_us:
            return self._motion._replace(yaw=yaw), box
        return (at(since_us) if since_us else self._start.motion), box

    def _object_at(self, row: int, fraction: float) -> tuple[Box, tuple[float, float]]:
        """An object at a fraction of the step: box in the plane, and velocity."""
        after, before, k = self._agents, self._start.agents, int(self._rows[row])
        x, y = after.positions[row, :2].tolist()
        vx, vy = after.velocities[row, :2].tolist()
        yaw = float(quaternion_yaw(after.quaternions[row]))
        if k >= 0:
            rest = 1 - fraction
            ax, ay = before.positions[k, :2].tolist()
            wx, wy = before.velocities[k, :2].tolist()
            a_yaw = float(quaternion_yaw(before.quaternions[k]))
            x, y = rest * ax + fraction * x, rest * ay + fraction * y
            vx, vy = rest * wx + fraction * vx, rest * wy + fraction * vy
            yaw = a_yaw + fraction * math.remainder(yaw - a_yaw, math.tau)
        length, width = after.sizes[row, :2].tolist()
        return (x, y, yaw, length, width), (vx, vy)


def _height(T_world_vehicle: Float, ahead: float) -> float:
    """Height of the vehicle's floor [m], ``ahead`` of the rear axle."""
    return T_world_vehicle.item(2, 3) + ahead * T_world_vehicle.item(2, 0)


def _deviation(start: StepStart, motion: Motion, ego: EgoSpec, size: Size) -> float:
    """Maximum deviation of the ego's box from linear interpolation within the step [m].

    Bounded because its path cannot be longer than the vehicle can drive.
    """
    before, seconds = start.motion, start.dt_us * 1e-6
    fastest = max(
        math.hypot(before.speed, before.lateral_speed),
        math.hypot(motion.speed, motion.lateral_speed),
    )
    fastest += max(ego.max_acceleration, ego.max_braking) * seconds / 2
    chord = math.hypot(motion.x - before.x, motion.y - before.y)
    aside = math.sqrt(max((fastest * seconds) ** 2 - chord * chord, 0.0)) / 2
    steering = max(abs(before.steering), abs(motion.steering)) + ego.max_steer_rate * seconds / 2
    curvature = math.tan(min(steering, ego.max_steer)) / ego.wheelbase
    rate = max(abs(before.yaw_rate), abs(motion.yaw_rate), curvature * fastest)
    return aside + math.hypot(*size[:2]) / 2 * min(rate * seconds, 2.0)


def _place(box: Box, other: Box) -> tuple[float, float]:
    """The centre of the contact of two boxes [m]."""
    shapes = []
    for x, y, yaw, length, width in (box, other):
        body = BodyState(x, y, yaw, 0.0, 0.0, 0.0)
        shapes.append(corners(body, BodyProperties(1.0, 1.0, length, width)))
    manifold = contact_manifold(shapes[0], shapes[1])
    return (manifold.x, manifold.y) if manifold is not None else (other[0], other[1])
