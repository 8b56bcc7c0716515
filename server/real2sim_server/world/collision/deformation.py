"""Dents in what is drawn: the impacts of rigid bodies, told to deforming matter.

The sudden exchange of momentum stays the authority for motion: it costs microseconds, so an
episode without cameras never waits for matter, and every device computes the same. What matter
does is looked up when a picture needs it, from the impact alone, and so is the same after a crash
of the worker, in a fork, and in a recording.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from ...edit import ObjectState
from ...edit.compose import cloud_of
from ...geometry.rotation import Float, yaw_quaternion
from ...geometry.transform import transform_from
from ...physics.colliders import Box
from ...physics.errors import PhysicsError
from ...render.types import Instance
from ...scene import GaussianCloud, Scene
from ...simulation import impact as crash
from ...simulation.embedding import Embedding, deform_cloud, stretched
from .body import Body
from .model import Impact, Party

_log = logging.getLogger(__name__)

LEAST_APPROACH = 1.1
"""Bumpers take impacts up to this speed without damage (2.5 mph, 49 CFR 581) [m/s]."""

MOST = 4
"""Impacts that dent one object; further ones move it only."""

LIVING = frozenset({"pedestrian", "person", "cyclist", "motorcyclist", "animal"})
"""Categories that are never shown deformed."""

FRICTION = 0.4
"""Of bodywork on bodywork."""

WALL = (1.0, 2.0, 2.0)
"""Size of the part of the background that an object runs into: depth, width, height [m]."""


@dataclass(frozen=True, eq=False)
class DeformationTracker:
    """The shapes of all objects of a world; see :class:`~.model.Deformation`.

    Attributes:
        scene: holds their Gaussians.
        dented: objects that were struck, by id.
    """

    scene: Scene
    dented: Mapping[str, _Dented] = field(default_factory=dict)

    def struck(self, impact: Impact, subjects: Mapping[str, ObjectState]) -> Self:
        """After an impact; slow ones leave no trace."""
        if impact.parties is None or impact.approach_speed < LEAST_APPROACH:
            return self
        names = (impact.other_id, impact.object_id)
        olds = [self._before(name, subjects, impact) for name in names]
        if not any(olds):
            return self
        collision = _Collision(impact, (olds[0], olds[1]))
        dented = dict(self.dented)
        for role, (name, old) in enumerate(zip(names, olds, strict=True)):
            if name is not None and old is not None and old.impacts < MOST:
                dented[name] = _Dented(old.origin, old.impacts + 1, old, collision, role)
        return replace(self, dented=dented)

    def work_out(self) -> None:
        """Let all impacts that are not worked out yet deform what they struck."""
        for dented in self.dented.values():
            dented.outcome()

    def shown(self, object_id: str, instance: Instance, t_us: int) -> Instance:
        """The object as it is at ``t_us``, in the colours that it had when it was struck first."""
        dented = self.dented.get(object_id)
        if dented is None or dented.origin.subject.scale != instance.scale:
            return instance
        cloud = dented.cloud(t_us)
        if cloud is None:
            return instance
        return replace(instance, cloud=cloud, colour=None, scale=(1.0, 1.0, 1.0))

    def _before(
        self, name: str | None, subjects: Mapping[str, ObjectState], impact: Impact
    ) -> _Dented | None:
        if name is None or name not in subjects:
            return None
        if name in self.dented:
            return self.dented[name]
        subject = subjects[name]
        if subject.category in LIVING:
            return None
        assert impact.parties is not None
        party = impact.parties[0 if name == impact.other_id else 1]
        assert party is not None
        return _Dented(_Origin(self.scene, subject, party.solid.mass, impact.began_us))


class _Origin:
    """An object as it was before it was struck for the first time.

    Everything is found on demand and kept; a lock lets sessions on several threads share it.
    """

    def __init__(self, scene: Scene, subject: ObjectState, mass: float, t_us: int) -> None:
        self.subject = subject
        self.lock = threading.RLock()
        self._scene, self._mass, self._t_us = scene, mass, t_us
        self._cloud: GaussianCloud | None = None
        self._body: crash.CrashBody | None = None
        self._embedding: Embedding | None = None

    @property
    def cloud(self) -> GaussianCloud:
        """Its Gaussians, scaled."""
        if self._cloud is None:
            own = cloud_of(self._scene, self.subject, self._t_us)
            self._cloud = stretched(own, self.subject.scale)
        return self._cloud

    @property
    def body(self) -> crash.CrashBody:
        """Its matter."""
        if self._body is None:
            self._body = crash.object_body(
                self.cloud,
                self.subject.scaled_size,
                category=self.subject.category,
                mass=self._mass,
                friction=FRICTION,
            )
        return self._body

    def deformed(self, displacements: Float, *, last: bool) -> GaussianCloud:
        """Its Gaussians where the matter around them is; ``last``: nothing is asked soon again."""
        if self._embedding is None:
            means = self.cloud.means.detach().cpu().numpy().astype(np.float64)
            rest = self.body.rest.positions
            self._embedding = Embedding(rest, means, spacing=self.body.spacing)
        cloud = deform_cloud(self.cloud, self._embedding.follow(displacements))
        if last:
            self._embedding = None
        return cloud


@dataclass(eq=False)
class _Dented:
    """An object after some impacts; without any it is as it was.

    Attributes:
        origin: the object.
        impacts: number of them.
        before: the same object before the latest.
        collision, role: the latest, and which of its two bodies the object was.
    """

    origin: _Origin
    impacts: int = 0
    before: _Dented | None = None
    collision: _Collision | None = None
    role: int = 0
    _shown: tuple[int, GaussianCloud] | None = None

    @property
    def body(self) -> crash.CrashBody:
        """Its matter as it is after all of them."""
        outcome = self.outcome()
        if outcome is not None:
            return outcome.body
        with self.origin.lock:
            return self.before.body if self.before is not None else self.origin.body

    def outcome(self) -> crash.Dent | None:
        """What the latest impact did; None where it left no trace."""
        return None if self.collision is None else self.collision.dents()[self.role]

    def cloud(self, t_us: int) -> GaussianCloud | None:
        """Its Gaussians at an instant; None while they are as they were."""
        if self.collision is None:
            return None
        outcome = self.outcome()
        age_s = (t_us - self.collision.impact.began_us) * 1e-6
        frame = -1
        if outcome is not None:
            frame = min(int(age_s / crash.FRAME_S), len(outcome.displacements)) - 1
        if outcome is None or frame < 0:
            return self.before.cloud(t_us) if self.before is not None else None
        with self.origin.lock:
            if self._shown is None or self._shown[0] != frame:
                moved = outcome.displacements[frame].astype(np.float64)
                last = frame == len(outcome.displacements) - 1
                self._shown = frame, self.origin.deformed(moved, last=last)
            return self._shown[1]


class _Collision:
    """An impact, and what matter makes of it once somebody asks."""

    def __init__(self, impact: Impact, olds: tuple[_Dented | None, _Dented | None]) -> None:
        self.impact = impact
        self._olds = olds
        self._lock = threading.Lock()
        self._dents: tuple[crash.Dent | None, crash.Dent | None] | None = None

    def dents(self) -> tuple[crash.Dent | None, crash.Dent | None]:
        """Of the ego or first object, and of the object."""
        with self._lock:
            if self._dents is None:
                found = self._crash()
                kept = [
                    dent if old is not None else None
                    for dent, old in zip(found, self._olds, strict=True)
                ]
                self._dents = kept[0], kept[1]
            return self._dents

    def _crash(self) -> tuple[crash.Dent | None, crash.Dent | None]:
        assert self.impact.parties is not None
        first, second = self.impact.parties
        floor = first.low if second is None else min(first.low, second.low)
        try:
            one = self._crasher(first, self._olds[0], floor)
            other = self._wall() if second is None else self._crasher(second, self._olds[1], floor)
            return crash.crash(one, other) or (None, None)
        except PhysicsError as error:
            # A picture without a dent serves an episode better than its end.
            _log.warning("no dents after the impact at %s us: %s", self.impact.began_us, error)
            return None, None

    def _crasher(self, party: Party, old: _Dented | None, floor: float) -> crash.ImpactBody:
        solid, body = party.solid, party.body
        height = party.high - party.low
        if old is not None:
            matter = old.body
        else:
            size = (solid.length, solid.width, height)
            matter = crash.vehicle_body(size, mass=solid.mass, friction=FRICTION)
        return crash.ImpactBody(
            matter,
            self._pose(body, solid.box_ahead, party.low - floor + height / 2),
            np.array([body.vx, body.vy, 0.0]),
            body.turn,
        )

    def _pose(self, body: Body, ahead: float, height: float) -> Float:
        """About the place of the impact, so that numbers stay small wherever a street lies."""
        x, y = self.impact.point
        centre = np.array([body.x - x, body.y - y, height])
        centre[:2] += ahead * np.array([np.cos(body.yaw), np.sin(body.yaw)])
        return transform_from(centre, yaw_quaternion(body.yaw))

    def _wall(self) -> Box:
        nx, ny = self.impact.normal
        pose = transform_from(
            np.array([-nx, -ny, 0.0]) * WALL[0] / 2 + [0.0, 0.0, WALL[2] / 2],
            yaw_quaternion(float(np.arctan2(ny, nx))),
        )
        return Box(name="background", T_world_box=pose, size=WALL, friction=FRICTION)


__all__ = ["DeformationTracker"]
