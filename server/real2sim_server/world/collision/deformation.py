"""Deformation of objects after impacts, solved on demand by the MPM.

The motion depends on impulses only, which take microseconds, so an episode without cameras never
runs the MPM and all devices compute the same motion. The deformation is solved when an image shows
the object. It depends on the impact only, so it is the same in forks, recordings and after a
restart of the worker.
"""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol, Self, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from real2sim_proto.conventions import semantic_class

from ...edit import ObjectState
from ...edit.compose import cloud_of
from ...geometry import Float, transform_from, yaw_quaternion
from ...physics.colliders import Box
from ...physics.errors import PhysicsError
from ...render.types import Instance
from ...scene import GaussianCloud, Scene
from ...simulation import impact as crash
from ...simulation.breakage import Breakage, BreakageLog, Part, fragment_cloud
from ...simulation.damage import HANGS_STILL, DamagedVehicle
from ...simulation.particles import Deformed, Embedding, deform_cloud, replaced_rows, stretched
from ...simulation.structure import VEHICLES
from .bodies import BodyState, Impact, ImpactParticipant

# --- Damage --------------------------------------------------------------------------------------

# Broken and folded parts of a vehicle, over the frames of an impact.

HARD = 5.0
"""Approach speed per multiple of the breakage limit, for the speed of fragments [m/s]."""


@dataclass(frozen=True, eq=False)
class VehicleDamage:
    """Damage of a vehicle by impacts up to an instant.

    Attributes:
        most: [G, 3] largest shortening so far.
        broken: broken parts.
    """

    most: Float
    broken: tuple[Breakage, ...] = ()

    def hanging(self, t_us: int) -> int:
        """Time at which loose parts are drawn [us]; constant once they are at rest."""
        fell = [b.time_s for b in self.broken if b.kind == "bumper"]
        if not fell:
            return 0
        return min(t_us, math.ceil((max(fell) + HANGS_STILL) * 1e6))

    def cloud(self, vehicle: DamagedVehicle, displacements: Float, t_us: int) -> GaussianCloud:
        """The Gaussians for particle displacements [N, 3] [m]."""
        time_s = t_us * 1e-6
        ages = {b.part: max(time_s - b.time_s, 0.0) for b in self.broken}
        return vehicle.cloud(displacements, self.most, ages)


@dataclass(eq=False)
class DamageHistory:
    """The damage of one impact, frame by frame; deterministic.

    Attributes:
        object_id: id of the vehicle.
        vehicle: its drawable form.
        log: breakage log before the impact.
        before: damage before the impact.
    """

    object_id: str
    vehicle: DamagedVehicle
    log: BreakageLog
    before: VehicleDamage
    _frames: int = 0
    _now: VehicleDamage | None = None
    _log: BreakageLog | None = field(default=None)

    def after(self, frames: Sequence[Float], impact: Impact, role: int) -> VehicleDamage:
        """The damage after the first frames of an impact, with an interval of ``impact.FRAME_S``.

        Args:
            frames: displacements [N, 3] of the vehicle's particles, from first contact [m].
            impact: the impact, in which the vehicle was body ``role``.
        """
        if self._now is None or self._log is None or self._frames > len(frames):
            self._frames, self._now = 0, self.before
            self._log = self.log.copy()
        for k in range(self._frames, len(frames)):
            most = np.maximum(self._now.most, self.vehicle.shortening(frames[k]))
            new = [
                self._breakage(part, self._log.place(part, frames[k]), impact, role, k)
                for part in self._log.follow(frames[k])
            ]
            self._now = VehicleDamage(most, (*self._now.broken, *new))
        self._frames = len(frames)
        return self._now

    def final_log(self) -> BreakageLog:
        """The breakage log after the last requested frame."""
        return self.log if self._log is None else self._log

    def _breakage(
        self, part: Part, place: Float, impact: Impact, role: int, frame: int
    ) -> Breakage:
        """A part that broke in a frame; its velocity follows from the impulse."""
        assert impact.participants is not None
        own = impact.participants[role]
        assert own is not None
        body, age = own.body, (frame + 1) * crash.FRAME_S
        before = np.array([body.vx, body.vy])
        after = before + _pushed(impact, role) / own.properties.mass
        cos, sin = math.cos(body.yaw), math.sin(body.yaw)
        turn = np.array([[cos, -sin], [sin, cos]])
        origin = np.array([body.x, body.y]) + own.properties.box_ahead * turn[:, 0]
        at = origin + (before + after) / 2 * age + turn @ place[:2]
        outward = turn @ np.array(part.outward[:2])
        return Breakage(
            self.object_id,
            part.name,
            part.kind,
            impact.began_us * 1e-6 + age,
            (float(at[0]), float(at[1]), (own.low + own.high) / 2 + float(place[2])),
            (float(after[0]), float(after[1]), 0.0),
            (float(outward[0]), float(outward[1]), part.outward[2]),
            max(impact.approach_speed / HARD, 1.0),
        )


def _pushed(impact: Impact, role: int) -> Float:
    """[2] the whole impulse of an impact on one of its bodies [N s]."""
    exchanged = np.array(impact.impulse)
    strength = float(np.linalg.norm(exchanged))
    if impact.whole is not None and strength > 0:
        exchanged = exchanged * (impact.whole / strength)
    return exchanged if role == 0 else -exchanged


T = TypeVar("T")

_log = logging.getLogger(__name__)

MIN_APPROACH_SPEED = 1.1
"""Minimum approach speed for damage [m/s]: bumpers withstand 2.5 mph (49 CFR 581)."""

MAX_IMPACTS = 4
"""Maximum number of impacts that deform one object; further ones only move it."""

NEVER_DEFORMED = frozenset({"pedestrian", "person", "cyclist", "motorcyclist", "animal"})
"""Categories that are never shown deformed."""

FRICTION = 0.4
"""Friction coefficient of bodywork on bodywork."""

MIN_MOVED = 5e-3
"""Minimum displacement of particles that moves Gaussians [m]."""

REACH = 2.5
"""Maximum distance from particles to Gaussians that follow them [spacings]."""

PARTS = np.array([8, 1, 1])
"""Number of parts along the length, width and height; each follows its own particles."""

WALL = (1.0, 2.0, 2.0)
"""Size of the background part in an impact: depth, width, height [m]; narrower for a narrow
background, down to POLE."""
POLE = 0.25


FOR_GOOD = 2**62
"""Time after the end of every impact [us]."""


class Deformation(Protocol):
    """Deforms objects after impacts. Immutable: an impact returns a new one, so worlds can fork.

    The world moves impacted objects as rigid bodies. The deformation receives every impact and
    provides the Gaussians to draw instead of an object's own.
    """

    @property
    def has_impacts(self) -> bool:
        """Whether a deformation may have to be solved, now or later."""

    def with_impact(self, impact: Impact, subjects: Mapping[str, ObjectState]) -> Self:
        """After an impact; ``subjects``: all objects by id."""

    def solve(self, t_us: int) -> None:
        """Solve the missing shapes at an instant, before drawing."""

    def deformed_instance(self, object_id: str, instance: Instance, t_us: int) -> Instance:
        """The instance to draw; ``instance`` itself if the object is not deformed."""

    def fragments(self, t_us: int) -> list[Instance]:
        """Fragments of objects, with the ids of these objects."""


@dataclass(frozen=True, eq=False)
class DeformationTracker:
    """The shapes of all objects of a world, by the MPM.

    Attributes:
        scene: scene with their Gaussians.
        breakage: whether vehicles fold and lose lamps and glass; else they are only dented.
        deformed: objects with potentially deforming impacts, by id.
    """

    scene: Scene
    breakage: bool = False
    deformed: Mapping[str, _DeformedObject] = field(default_factory=dict)

    @property
    def has_impacts(self) -> bool:
        """Whether any object may be deformed."""
        return bool(self.deformed)

    def with_impact(self, impact: Impact, subjects: Mapping[str, ObjectState]) -> Self:
        """After an impact; slow ones do not deform."""
        if impact.participants is None or impact.approach_speed < MIN_APPROACH_SPEED:
            return self
        names = (impact.other_id, impact.object_id)
        before_impact = [self._before_impact(name, subjects, impact) for name in names]
        if not any(before_impact):
            return self
        collision = _ImpactSolution(impact, (before_impact[0], before_impact[1]))
        deformed = dict(self.deformed)
        for role, (name, old) in enumerate(zip(names, before_impact, strict=True)):
            if name is not None and old is not None and old.impacts < MAX_IMPACTS:
                deformed[name] = _DeformedObject(old.origin, old.impacts + 1, old, collision, role)
        return replace(self, deformed=deformed)

    def solve(self, t_us: int) -> None:
        """Solve all impacts up to an instant."""
        for deformed in self.deformed.values():
            deformed.displacements(t_us)

    def deformed_instance(self, object_id: str, instance: Instance, t_us: int) -> Instance:
        """The object at ``t_us``, in its colours before the first impact."""
        deformed = self.deformed.get(object_id)
        if deformed is None or deformed.origin.subject.scale != instance.scale:
            return instance
        cloud = deformed.cloud(t_us)
        if cloud is None:
            return instance
        return replace(instance, cloud=cloud, colour=None, scale=(1.0, 1.0, 1.0))

    def fragments(self, t_us: int) -> list[Instance]:
        """Fragments of vehicles at ``t_us``, one instance per vehicle, with its id."""
        found = []
        for deformed in self.deformed.values():
            damage = deformed.damage(t_us)
            if damage is None or not damage.broken:
                continue
            cloud = fragment_cloud(damage.broken, t_us * 1e-6, self.scene.ground.height_at)
            if cloud is not None:
                cloud = cloud.to(self.scene.background.device)
                subject = deformed.origin.subject
                semantic = semantic_class(subject.category)
                found.append(Instance(cloud, None, subject.instance_id, semantic=semantic))
        return found

    def _before_impact(
        self, name: str | None, subjects: Mapping[str, ObjectState], impact: Impact
    ) -> _DeformedObject | None:
        if name is None or name not in subjects:
            return None
        if name in self.deformed:
            return self.deformed[name]
        subject = subjects[name]
        if subject.category in NEVER_DEFORMED:
            return None
        assert impact.participants is not None
        participant = impact.participants[0 if name == impact.other_id else 1]
        assert participant is not None
        return _DeformedObject(
            _UndeformedObject(
                self.scene,
                subject,
                participant.properties.mass,
                impact.began_us,
                breakage=self.breakage and subject.category in VEHICLES,
            )
        )


class _UndeformedObject:
    """An object before its first impact.

    All properties are computed on demand and cached; thread-safe.
    """

    def __init__(
        self, scene: Scene, subject: ObjectState, mass: float, t_us: int, *, breakage: bool
    ) -> None:
        self.subject, self.breakage = subject, breakage
        self.lock = threading.RLock()
        self._scene, self._mass, self._t_us = scene, mass, t_us
        self._cloud: GaussianCloud | None = None
        self._body: crash.CrashBody | None = None
        self._pieces: list[_Piece] | None = None
        self._vehicle: DamagedVehicle | None = None

    @property
    def vehicle(self) -> DamagedVehicle:
        """The object as a breakable vehicle."""
        if self._vehicle is None:
            self._vehicle = DamagedVehicle(
                self.cloud,
                self.body.rest.positions,
                spacing=self.body.spacing,
                category=self.subject.category,
                size=self.subject.scaled_size,
                object_id=self.subject.object_id,
            )
        return self._vehicle

    def unbroken(self) -> BreakageLog:
        """The breakage log before any impact."""
        return BreakageLog(
            self.subject.category,
            self.subject.scaled_size,
            self.body.rest.positions,
            spacing=self.body.spacing,
        )

    @property
    def cloud(self) -> GaussianCloud:
        """Its Gaussians, scaled."""
        if self._cloud is None:
            own = cloud_of(self._scene, self.subject, self._t_us)
            self._cloud = stretched(own, self.subject.scale)
        return self._cloud

    @property
    def body(self) -> crash.CrashBody:
        """Its particles."""
        if self._body is None:
            self._body = crash.object_body(
                self.cloud,
                self.subject.scaled_size,
                category=self.subject.category,
                mass=self._mass,
                friction=FRICTION,
            )
        return self._body

    def deformed(self, displacements: Float) -> GaussianCloud:
        """Its Gaussians, moved by the displacements of nearby particles."""
        if self._pieces is None:
            means = self.cloud.means.detach().cpu().numpy().astype(np.float64)
            self._pieces = _pieces(means, self.body.rest.positions)
        moved = np.linalg.norm(displacements, axis=1) > MIN_MOVED
        near = [p for p in self._pieces if p.touches(self.body, moved)]
        if not near:
            return self.cloud
        followed = [p.follow(self.body, displacements) for p in near]
        rows = torch.from_numpy(np.concatenate([p.rows for p in near])).to(self.cloud.device)
        deformed = Deformed(
            np.concatenate([f.positions for f in followed]),
            np.concatenate([f.F for f in followed]),
            np.concatenate([f.rotations for f in followed]),
        )
        return replaced_rows(self.cloud, rows, deform_cloud(self.cloud.select(rows), deformed))


class _Piece:
    """Gaussians of one part of an object; parts are deformed independently of each other."""

    def __init__(self, rows: NDArray[np.int64], points: Float) -> None:
        self.rows = rows
        self._points = points
        self._low, self._high = points.min(axis=0), points.max(axis=0)
        self._embedding: Embedding | None = None

    def touches(self, body: crash.CrashBody, moved: NDArray[np.bool_]) -> bool:
        """Whether any moved particle ([N] bool) is nearby."""
        places, reach = body.rest.positions[moved], REACH * body.spacing
        return bool(((places > self._low - reach) & (places < self._high + reach)).all(1).any())

    def follow(self, body: crash.CrashBody, displacements: Float) -> Deformed:
        """The deformed Gaussians for particle displacements [N, 3] [m]."""
        if self._embedding is None:
            self._embedding = Embedding(body.rest.positions, self._points, spacing=body.spacing)
        return self._embedding.follow(displacements)


def _pieces(points: Float, rest: Float) -> list[_Piece]:
    """Split points [G, 3] of an object into even parts between the ends of its particles [N, 3]."""
    low, high = rest.min(axis=0), rest.max(axis=0)
    inner = np.clip((points - low) / np.maximum(high - low, 1e-6), 0, 1 - 1e-9)
    cells = (inner * PARTS).astype(np.int64) @ [PARTS[1] * PARTS[2], PARTS[2], 1]
    order = np.argsort(cells, kind="stable")
    bounds = np.flatnonzero(np.diff(cells[order])) + 1
    return [_Piece(rows, points[rows]) for rows in np.split(order, bounds) if len(rows)]


@dataclass(eq=False)
class _DeformedObject:
    """An object after its impacts; unchanged without impacts.

    Attributes:
        origin: the undeformed object.
        impacts: number of impacts.
        before: the object before the latest impact.
        collision, role: the latest impact, and the index of the object in it.
    """

    origin: _UndeformedObject
    impacts: int = 0
    before: _DeformedObject | None = None
    collision: _ImpactSolution | None = None
    role: int = 0
    _shown: tuple[Hashable, GaussianCloud] | None = None
    _history: DamageHistory | None = None

    @property
    def body(self) -> crash.CrashBody:
        """Its particles after all impacts."""
        outcome = self.outcome()
        if outcome is not None:
            return outcome.body
        with self.origin.lock:
            return self.before.body if self.before is not None else self.origin.body

    def outcome(self) -> crash.ImpactResult | None:
        """The final result of the latest impact; None without deformation."""
        return None if self.collision is None else self.collision.outcomes()[self.role]

    def displacements(self, t_us: int) -> list[Float]:
        """Particle displacements by the latest impact, frame by frame up to an instant.

        See :class:`~real2sim_server.simulation.impact.ImpactResult`.
        """
        if self.collision is None:
            return []
        age_s = (t_us - self.collision.impact.began_us) * 1e-6
        return self.collision.displacements(self.role, max(int(age_s / crash.FRAME_S), 0))

    def cloud(self, t_us: int) -> GaussianCloud | None:
        """Its Gaussians at an instant; None if unchanged."""
        frames = self.displacements(t_us)
        if not frames:
            return self.before.cloud(t_us) if self.before is not None else None
        damage = self.damage(t_us)
        # A loose bumper continues to sink for a while.
        key = (len(frames), 0 if damage is None else damage.hanging(t_us))
        with self.origin.lock:
            if self._shown is None or self._shown[0] != key:
                if damage is None:
                    shown = self.origin.deformed(frames[-1])
                else:
                    shown = damage.cloud(self.origin.vehicle, frames[-1], t_us)
                self._shown = key, shown
            return self._shown[1]

    def damage(self, t_us: int) -> VehicleDamage | None:
        """Damage up to an instant; None if the object cannot break."""
        if not self.origin.breakage:
            return None
        frames = self.displacements(t_us)
        if not frames:
            return self.before.damage(t_us) if self.before is not None else None
        assert self.collision is not None
        with self.origin.lock:
            history = self._begin_history()
            return history.after(frames, self.collision.impact, self.role)

    def _begin_history(self) -> DamageHistory:
        """The damage history of the latest impact, on top of all earlier ones."""
        if self._history is None:
            origin, before = self.origin, None
            log = origin.unbroken()
            if self.before is not None:
                before = self.before.damage(FOR_GOOD)
                if self.before._history is not None:
                    log = self.before._history.final_log().copy()
            if before is None:
                before = VehicleDamage(np.zeros((len(origin.cloud), 3)))
            name = origin.subject.object_id
            self._history = DamageHistory(name, origin.vehicle, log, before)
        return self._history


class _ImpactSolution:
    """The deformation of both bodies of an impact, solved on demand."""

    def __init__(
        self, impact: Impact, before_impact: tuple[_DeformedObject | None, _DeformedObject | None]
    ) -> None:
        self.impact = impact
        self._before_impact = before_impact
        self._lock = threading.Lock()
        self._simulation: crash.ImpactSimulation | None = None
        self._failed = False
        self._outcomes: tuple[crash.ImpactResult | None, crash.ImpactResult | None] | None = None

    def displacements(self, role: int, count: int) -> list[Float]:
        """The first ``count`` frames of one of its bodies; fewer if the impact ends earlier."""
        with self._lock:
            if self._before_impact[role] is None:
                return []
            return self._attempt(lambda simulation: simulation.displacements(role, count), [])

    def outcomes(self) -> tuple[crash.ImpactResult | None, crash.ImpactResult | None]:
        """Results of the ego or first object, and of the object."""
        with self._lock:
            if self._outcomes is None:
                results = self._attempt(lambda simulation: simulation.results(), None)
                found = results or (None, None)
                kept = [
                    outcome if old is not None else None
                    for outcome, old in zip(found, self._before_impact, strict=True)
                ]
                self._outcomes = kept[0], kept[1]
            return self._outcomes

    def _attempt(self, ask: Callable[[crash.ImpactSimulation], T], nothing: T) -> T:
        """Query the simulation; return ``nothing`` if the solver fails."""
        if self._failed:
            return nothing
        try:
            if self._simulation is None:
                self._simulation = self._begin()
            return ask(self._simulation)
        except PhysicsError as error:
            # An image without deformation is better than the end of the episode.
            self._failed = True
            _log.warning(
                "no deformation after the impact at %s us: %s", self.impact.began_us, error
            )
            return nothing

    def _begin(self) -> crash.ImpactSimulation:
        assert self.impact.participants is not None
        first, second = self.impact.participants
        floor = first.low if second is None else min(first.low, second.low)
        one = self._impact_body(first, self._before_impact[0], floor)
        other = (
            self._wall()
            if second is None
            else self._impact_body(second, self._before_impact[1], floor)
        )
        return crash.ImpactSimulation(one, other)

    def _impact_body(
        self, participant: ImpactParticipant, old: _DeformedObject | None, floor: float
    ) -> crash.ImpactBody:
        properties, body = participant.properties, participant.body
        height = participant.high - participant.low
        if old is not None:
            rest_shape = old.body
        else:
            size = (properties.length, properties.width, height)
            rest_shape = crash.vehicle_body(size, mass=properties.mass, friction=FRICTION)
        return crash.ImpactBody(
            rest_shape,
            self._pose(body, properties.box_ahead, participant.low - floor + height / 2),
            np.array([body.vx, body.vy, 0.0]),
            body.turn,
        )

    def _pose(self, body: BodyState, ahead: float, height: float) -> Float:
        """Pose relative to the place of the impact, to keep coordinates small."""
        x, y = self.impact.point
        centre = np.array([body.x - x, body.y - y, height])
        centre[:2] += ahead * np.array([np.cos(body.yaw), np.sin(body.yaw)])
        return transform_from(centre, yaw_quaternion(body.yaw))

    def _wall(self) -> Box:
        """The obstacle that the object hit, with the breadth of the background there."""
        nx, ny = self.impact.normal
        depth, width, height = WALL
        right, left = self.impact.breadth or (width / 2, width / 2)
        middle = (left - right) / 2
        pose = transform_from(
            np.array([-nx, -ny, 0.0]) * depth / 2
            + np.array([-ny, nx, 0.0]) * middle
            + [0.0, 0.0, height / 2],
            yaw_quaternion(float(np.arctan2(ny, nx))),
        )
        size = (depth, max(left + right, POLE), height)
        return Box(name="background", T_world_box=pose, size=size, friction=FRICTION)


__all__ = ["DeformationTracker"]
