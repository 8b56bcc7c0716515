"""The closed loop: one clock, one ego, the objects of a scenario."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import assert_never

import numpy as np

from real2sim_proto import ErrorCode
from real2sim_proto.drive import Control, PoseCommand, ResetSpec, SensorSpec, TrajectoryPlan
from real2sim_proto.operations import Operation

from ..edit import EditError, EditOutcome, ScenarioState, apply_operations, compose
from ..edit.tracks import sample
from ..render.types import Instance
from ..scene import Scene
from .agents import Agents
from .contact import begun, ego_box, touching
from .ego import Command, drive, logged_motion, placed
from .episode import plan_episode
from .errors import WorldError
from .events import Event
from .ground import LoggedGround
from .observation import Observation
from .path import Float, LoggedPath, PathPoint
from .reference import Pose, Reference
from .route import command_ahead, route_ahead
from .tracker import Tracker, to_world

Plan = TrajectoryPlan | Control | PoseCommand

METRICS = {
    "distance": "way driven since the start [m]",
    "route_progress": "way made along the recorded path since the start [m]",
    "lateral_offset": "distance from the recorded path, positive on its left [m]",
    "collisions": "contacts begun since the start",
}
"""Metrics of every observation, and what they say."""

LOG_SPACING_US = 100_000
"""Where there is no plan, the log is followed by poses this far apart at most [us]."""

LEFT_LOG = 10.0
"""Beyond this distance from the recorded path an event says so [m]; images get poor there."""


class World:
    """A scene in which time passes, one step at a time.

    Same scene, state, spec, operations and plans: the same observations, bit for bit.

    Attributes:
        scene: shared, immutable.
        state: objects after all edits.
        spec: how the episode runs.
        steps: clock steps done since the reset; ``step`` of the observation.
        revision: edits of this session so far.
        motion: planar state of the ego.
        T_world_vehicle: [4, 4] float64, the ego standing on the ground.
        agents: where all objects are now.
        ground: height of the ground, usable for edits too.
        terminated, truncated, reason: how the episode ended: ``collision`` or ``horizon``.
    """

    def __init__(
        self, scene: Scene, state: ScenarioState, spec: ResetSpec, *, revision: int = 0
    ) -> None:
        """The world at step 0: the ego as it was recorded at the start time, on the ground.

        Raises:
            WorldError: the episode cannot run as asked; see :func:`~.episode.plan_episode`.
        """
        self.scene = scene
        self.state = state
        self.spec = spec
        self.steps = 0
        self.revision = revision
        self.terminated = False
        self.truncated = False
        self.reason: str | None = None
        self._clock = plan_episode(scene, spec)
        self._path = LoggedPath(scene.ego)
        self.ground = LoggedGround(self._path)
        self.motion = logged_motion(scene.ego, self.t_us, spec.ego)
        self._near: PathPoint = self._path.nearest(self.motion.x, self.motion.y)
        self.T_world_vehicle: Float = self._standing()
        self.agents: Agents = state.tracks.at(self.t_us)
        self._plan: Tracker | Command | PoseCommand | None = None
        self._start_s = self._near.s
        self._distance = 0.0
        self._collisions = 0
        self._left_log = False
        self._in_contact = self._names(self._touching())
        self._events: tuple[Event, ...] = ()
        self._edits: tuple[Event, ...] = ()

    @property
    def t_us(self) -> int:
        """Simulation time of this instant [us]."""
        return self._clock.at(self.steps)

    @property
    def horizon(self) -> int:
        """Number of steps after which the episode is cut off."""
        return self._clock.horizon

    @property
    def over(self) -> bool:
        """Whether the episode has ended."""
        return self.terminated or self.truncated

    def step(self, plan: Plan | None = None) -> list[Event]:
        """Move the clock by one ``dt_us``; what happened, also part of the next observation.

        Order: edits made since the last step are in effect, then ego, objects, contact, commit.

        Args:
            plan: what the ego does. None keeps the last plan; before any, the ego follows the log.

        Raises:
            WorldError: EPISODE_OVER, or INVALID_ACTION for a plan of another kind than the reset
                named or with times that are over; the world is as before.
        """
        if self.over:
            raise WorldError(
                ErrorCode.EPISODE_OVER,
                f"the episode ended at step {self.steps}: {self.reason}",
                hint="reset the session to start another",
            )
        self._plan = self._accepted(plan)
        self._move_ego(self._plan)
        self.steps += 1
        self.agents = self.state.tracks.at(self.t_us)
        events = [*self._edits, *self._met(), *self._strayed(), *self._ended()]
        self._edits = ()
        self._events = tuple(events)
        return events

    def apply(
        self, operations: Sequence[Operation], *, base_revision: int | None = None
    ) -> EditOutcome:
        """Edit the objects at this instant, all operations or none; time does not move.

        An object put onto the ego is a collision of the next step.

        Args:
            operations: validated wire models.
            base_revision: revision of the session they were made for; None for any.

        Raises:
            EditError: STALE_REVISION, UNKNOWN_OBJECT or INVALID_OPERATION; nothing changed.
        """
        if base_revision is not None and base_revision != self.revision:
            raise EditError(
                ErrorCode.STALE_REVISION,
                f"made for revision {base_revision}; the session is at {self.revision}",
                hint="look at the objects again and send the edit for the present revision",
            )
        outcome = apply_operations(self.state, operations, ground=self.ground)
        self.state = outcome.state
        self.agents = self.state.tracks.at(self.t_us)
        self.revision += 1
        edited = Event("edited", self.t_us, data={"revision": float(self.revision)})
        self._edits = (*self._edits, edited)
        return outcome

    def observe(self) -> Observation:
        """What the policy gets at this instant, apart from images."""
        motion, s = self.motion, self._near.s
        return Observation(
            step=self.steps,
            t_us=self.t_us,
            revision=self.revision,
            motion=motion,
            T_world_vehicle=self.T_world_vehicle,
            ego_size=self.scene.ego_size,
            command=command_ahead(self._path, s),
            route=route_ahead(self._path, s, motion.x, motion.y, motion.yaw),
            agents=self.agents if self.spec.privileged else None,
            events=self._events,
            metrics=self.metrics(),
            terminated=self.terminated,
            truncated=self.truncated,
            reason=self.reason,
        )

    def metrics(self) -> dict[str, float]:
        """See ``METRICS``."""
        return {
            "distance": self._distance,
            "route_progress": self._near.s - self._start_s,
            "lateral_offset": self._near.offset,
            "collisions": float(self._collisions),
        }

    def instances(self) -> list[Instance]:
        """What the renderer draws at this instant; nothing is copied."""
        return compose(self.scene, self.agents, self.t_us, erased=self.state.erased)

    def due_sensors(self) -> list[SensorSpec]:
        """Sensors of the reset that deliver a frame at this step; all of them at step 0."""
        elapsed = self.steps * self._clock.dt_us
        return [s for s in self.spec.sensors if elapsed % (s.period_us or self._clock.dt_us) == 0]

    def light_copy(self) -> World:
        """A world that goes on from here on its own; it shares everything that never changes."""
        # A step replaces what it changes and never writes into it.
        return copy.copy(self)

    def _accepted(self, plan: Plan | None) -> Tracker | Command | PoseCommand:
        if plan is None:
            return self._plan if self._plan is not None else self._follow_log()
        if plan.kind != self.spec.action:
            raise WorldError(
                ErrorCode.INVALID_ACTION,
                f"a plan of kind {plan.kind!r} in an episode that was reset for "
                f"{self.spec.action!r}",
                hint=f"send {self.spec.action!r} plans, or reset with action {plan.kind!r}",
            )
        match plan:
            case TrajectoryPlan():
                return self._track(plan)
            case Control():
                return Command(plan.acceleration, plan.steering)
            case PoseCommand():
                return plan
            case _:
                assert_never(plan)

    def _track(self, plan: TrajectoryPlan) -> Tracker:
        if plan.times_us[0] <= self.t_us:
            raise WorldError(
                ErrorCode.INVALID_ACTION,
                f"the plan begins at {plan.times_us[0]} us; it is {self.t_us} us already",
                hint="times_us are absolute simulation times after t_us of the observation",
            )
        poses = plan.poses if plan.frame == "world" else to_world(plan.poses, self.motion)
        return self._tracker(plan.times_us, poses)

    def _follow_log(self) -> Tracker:
        # Even spacing: some logs have poses milliseconds apart, whose differences are noise.
        count = -(-(self.scene.end_us - self.t_us) // LOG_SPACING_US)
        times = np.linspace(self.t_us, self.scene.end_us, count + 1).astype(np.int64)[1:]
        transforms, _ = sample(self.scene.ego, times)
        yaws = np.arctan2(transforms[:, 1, 0], transforms[:, 0, 0])
        poses = np.column_stack([transforms[:, :2, 3], yaws])
        return self._tracker(times.tolist(), [(x, y, yaw) for x, y, yaw in poses.tolist()])

    def _tracker(self, times_us: Sequence[int], poses: Sequence[Pose]) -> Tracker:
        reference = Reference(
            self.motion, start_us=self.t_us, times_us=times_us, poses=poses, spec=self.spec.ego
        )
        return Tracker(reference, self.spec.ego.wheelbase)

    def _move_ego(self, plan: Tracker | Command | PoseCommand) -> None:
        old, spec, dt_us = self.motion, self.spec.ego, self._clock.dt_us
        match plan:
            case Tracker():
                since = (self.t_us - plan.reference.start_us) * 1e-6
                self.motion = drive(old, lambda m, t: plan.command(m, since + t), spec, dt_us)
            case Command():
                self.motion = drive(old, lambda _m, _t: plan, spec, dt_us)
            case PoseCommand():
                self.motion = placed(old, (plan.x, plan.y, plan.yaw), spec, dt_us)
            case _:
                assert_never(plan)
        self._distance += math.hypot(self.motion.x - old.x, self.motion.y - old.y)
        self._near = self._path.nearest(self.motion.x, self.motion.y, near_s=self._near.s)
        self.T_world_vehicle = self._standing()

    def _standing(self) -> Float:
        return self.ground.stand(self.motion.x, self.motion.y, self.motion.yaw, self._near)

    def _touching(self) -> list[int]:
        box = ego_box(self.T_world_vehicle, self.scene.ego_size)
        return touching(box, self.scene.ego_size, self.agents)

    def _names(self, indices: list[int]) -> frozenset[str]:
        return frozenset(self.agents.objects[i].object_id for i in indices)

    def _met(self) -> list[Event]:
        now = self._touching()
        velocity = self.motion.speed * self.T_world_vehicle[:3, 0]
        contacts = begun(now, self._in_contact, self.agents, velocity)
        self._in_contact = self._names(now)
        self._collisions += len(contacts)
        if contacts and self.spec.on_collision == "terminate":
            self.terminated, self.reason = True, "collision"
        return [
            Event("collision", self.t_us, c.object_id, {"relative_speed": c.relative_speed})
            for c in contacts
        ]

    def _strayed(self) -> list[Event]:
        distance = abs(self._near.offset)
        was_off, self._left_log = self._left_log, distance > LEFT_LOG
        if self._left_log and not was_off:
            return [Event("left_log", self.t_us, data={"distance": distance})]
        return []

    def _ended(self) -> list[Event]:
        if self.steps < self._clock.horizon:
            return []
        self.truncated = True
        self.reason = self.reason or "horizon"
        return [Event("horizon", self.t_us)]
