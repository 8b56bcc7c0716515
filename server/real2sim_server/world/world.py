"""The closed loop: one clock, one ego, the objects of a scenario."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import replace

from real2sim_proto import ErrorCode
from real2sim_proto.episode import ResetSpec, SensorSpec
from real2sim_proto.operations import Operation

from ..edit import EditError, EditOutcome, ScenarioState, apply_operations, compose
from ..render.types import Instance
from ..scene import Scene
from . import scoring
from .agents import Agents
from .collision.contacts import Contacts, Moved
from .collision.deformation import DeformationTracker
from .collision.model import Deformation, Impact
from .collision.obstacles import obstacles_of
from .collision.step_contacts import StepContacts, after_impacts, after_overlaps
from .ego.controller import EgoController, Plan, braking
from .ego.reference import PlannedTrajectory
from .ego.route import command_ahead, route_ahead
from .ego.vehicle import logged_motion
from .episode import plan_episode, takes_effect_us
from .errors import WorldError
from .evaluation import PendingStep, ego_sample, others_of, scoring_context
from .events import Event
from .ground import LoggedGround
from .observation import Observation
from .path import Float, LoggedPath, PathPoint
from .scoring import Instant, MetricAccumulator, Score
from .traffic import EgoSeen, Surroundings, Traffic

LEFT_LOG = 10.0
"""Beyond this distance from the recorded path an event says so [m]; images get poor there."""


class World:
    """A scene in which time passes, one step at a time.

    Same scene, state, spec, operations and plans: the same observations, bit for bit. A step
    replaces what it changes and never writes into it, so that :meth:`light_copy` is cheap.

    Attributes:
        scene: shared, immutable.
        state: objects after all edits.
        spec: how the episode runs.
        steps: clock steps done since the reset; ``step`` of the observation.
        revision: edits of this session so far.
        motion: planar state of the ego.
        T_world_vehicle: [4, 4] float64, the ego standing on the ground.
        traffic: who drives the other objects.
        ground: height of the ground, usable for edits too.
        tally: what the scores are made of.
        instant: the last committed one, as the scores see it.
        impacts: of the last step.
        deformation: dents struck objects; None where nothing can be.
        terminated, truncated, reason: how the episode ended: ``collision``, ``horizon``,
            ``deadline``, ``wall_clock``.
    """

    def __init__(
        self,
        scene: Scene,
        state: ScenarioState,
        spec: ResetSpec,
        *,
        revision: int = 0,
        deformation: Deformation | None = None,
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
        self.deformation = deformation
        self.terminated = False
        self.truncated = False
        self.reason: str | None = None
        self._clock = plan_episode(scene, spec)
        self._path = LoggedPath(scene.ego)
        self.ground = LoggedGround(self._path)
        self.motion = logged_motion(scene.ego, self.t_us, spec.ego)
        self._near: PathPoint = self._path.nearest(self.motion.x, self.motion.y)
        self.T_world_vehicle: Float = self._standing()
        self._pilot = EgoController(spec, scene.ego)
        obstacles = obstacles_of(scene, self._path) if spec.contact.background else None
        seen = self._seen(state.tracks.at(self.t_us))
        self.traffic = Traffic.begin(state, spec.agents, seen)
        self._left_log = self._off_road = False
        self._contacts = Contacts.begin(
            spec,
            scene.ego_size,
            obstacles=obstacles,
            T_world_vehicle=self.T_world_vehicle,
            motion=self.motion,
            agents=self.agents,
        )
        if deformation is None and self._contacts.physical and spec.contact.dents:
            self.deformation = DeformationTracker(scene)
        self.impacts: tuple[Impact, ...] = ()
        self._events: tuple[Event, ...] = ()
        self._edits: tuple[Event, ...] = ()
        self._moved: PendingStep | None = None
        self._context = scoring_context(scene, spec, self._clock, self._path, self._near.s)
        self.instant = self._instant(StepContacts())
        self.tally: MetricAccumulator = scoring.begin(self.instant, self._context)

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

    @property
    def agents(self) -> Agents:
        """Where all objects are now."""
        return self.traffic.placed

    @property
    def warming_up(self) -> bool:
        """Whether the ego still moves as recorded."""
        return self.t_us < self._clock.start_us + self.spec.warmup_us

    @property
    def context(self) -> scoring.ScoringContext:
        """What stays the same for the scores."""
        return self._context

    def step(
        self, plan: Plan | None = None, *, latency_us: int = 0, missed: bool = False
    ) -> list[Event]:
        """Move the clock by one ``dt_us`` as :meth:`move` does; what happened, also part of the
        next observation."""
        self.move(plan, latency_us=latency_us, missed=missed)
        return self.judge()

    def move(self, plan: Plan | None = None, *, latency_us: int = 0, missed: bool = False) -> None:
        """The first half of a step: all that images show. Let :meth:`judge` follow.

        Order: edits made since the last step are in effect, then ego, objects, contact.

        Args:
            plan: what the ego does. None keeps the last plan; before any, the ego follows the log.
            latency_us: measured time to make the plan; counts where the episode says so.
            missed: whether the planner was late, and the fallback of the episode holds.

        Raises:
            WorldError: EPISODE_OVER, or INVALID_ACTION for a plan of another kind than the reset
                named or with times that are over; the world is as before.
        """
        self._check_running()
        pilot = self._told(plan, latency_us)
        given = pilot.coming[-1].course if plan is not None else None
        late = [Event("deadline_missed", self.t_us)] if missed else []
        if missed and self.spec.on_timeout == "brake":
            fallback = braking(pilot, self.motion, self.spec.ego)
            pilot = replace(pilot, controller=fallback, since_us=self.t_us, coming=())
        reacted = self._reacted()
        before = self.agents
        impacts = self._move(pilot)
        self._near = self._path.nearest(self.motion.x, self.motion.y, near_s=self._near.s)
        self.T_world_vehicle = self._standing()
        left = None if impacts is None else self._struck(impacts, before)
        self.impacts = impacts or ()
        self._moved = PendingStep(given, (*self._edits, *late, *reacted), left)
        self._edits = ()

    def judge(self) -> list[Event]:
        """The second half, if it is still to come: scores, and what happened. All that images
        show stays as it is, so they may be drawn meanwhile."""
        if self._moved is not None:
            given, events, left = self._moved
            self._moved = None
            left = self._overlapped() if left is None else left
            self._contacts = replace(self._contacts, touching=left.touching)
            self.instant = self._instant(left, given)
            self.tally = scoring.after(self.tally, self.instant, self._context)
            self._events = (*events, *left.events, *self._strayed(), *self._ended())
        return list(self._events)

    def stop(self, reason: str) -> None:
        """End the episode where it is, without a step: ``deadline`` or ``wall_clock``. Raises
        WorldError: EPISODE_OVER."""
        self._check_running()
        self.truncated, self.reason = True, reason
        self._events = (*self._events, Event("stopped", self.t_us))

    def steer(
        self, object_id: str, times_us: Sequence[int], poses: Sequence[tuple[float, float, float]]
    ) -> None:
        """Give an externally driven object a plan, from the next step on.

        Args:
            object_id: whose driver is ``external``.
            times_us: [N] absolute, increasing, after now [us].
            poses: [N] x, y [m], yaw [rad] of its box, world.

        Raises:
            WorldError: EPISODE_OVER or INVALID_ACTION; nothing changed.
        """
        self._check_running()
        self.traffic = self.traffic.told(object_id, self.t_us, times_us, poses)

    def apply(
        self, operations: Sequence[Operation], *, base_revision: int | None = None
    ) -> EditOutcome:
        """Edit the objects at this instant, all operations or none; time does not move.

        An object put onto the ego is a collision of the next step. Objects whose trajectory is
        edited begin to follow it anew, also those that physics had taken over.

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
        self.traffic = self.traffic.edited(self.state, self._seen(self.state.tracks.at(self.t_us)))
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
            warming_up=self.warming_up,
        )

    def metrics(self) -> dict[str, float]:
        """Scores so far, see :func:`~.scoring.running`."""
        return scoring.running(self.tally, self._context)

    def scores(self) -> list[Score]:
        """All scores so far, with terms and versions."""
        return scoring.scores_of(self.tally, self._context)

    def instances(self) -> list[Instance]:
        """What the renderer draws at this instant; nothing is copied."""
        drawn = compose(self.scene, self.state, self.agents, self.t_us)
        if self.deformation is not None:
            # Background first, then the objects, then shadows.
            for k, subject in enumerate(self.agents.objects, start=1):
                drawn[k] = self.deformation.shown(subject.object_id, drawn[k], self.t_us)
        return drawn

    def due_sensors(self) -> list[SensorSpec]:
        """Sensors of the reset that deliver a frame at this step; all of them at step 0."""
        elapsed = self.steps * self._clock.dt_us
        return [s for s in self.spec.sensors if elapsed % (s.period_us or self._clock.dt_us) == 0]

    def light_copy(self) -> World:
        """A world that goes on from here on its own; it shares everything that never changes."""
        return copy.copy(self)

    # --- one step ---------------------------------------------------------------------------

    def _check_running(self) -> None:
        if self.over:
            raise WorldError(
                ErrorCode.EPISODE_OVER,
                f"the episode ended at step {self.steps}: {self.reason}",
                hint="reset the session to start another",
            )

    def _told(self, plan: Plan | None, latency_us: int) -> EgoController:
        if plan is None:
            return self._pilot
        from_us = takes_effect_us(self.spec, self._clock, self.t_us, latency_us)
        return self._pilot.told(plan, self.motion, self.t_us, from_us)

    def _move(self, pilot: EgoController) -> tuple[Impact, ...] | None:
        """Ego and objects one step on; impacts, or None where bodies pass through each other."""
        motion, t_us, before = self.motion, self.t_us, self.agents
        end_us = t_us + self._clock.dt_us
        traffic = self.traffic.advance(self.state, end_us, lambda: self._seen(before))
        self.steps += 1
        if self.t_us <= self._clock.start_us + self.spec.warmup_us:
            recorded = logged_motion(self.scene.ego, self.t_us, self.spec.ego)
            moved = Moved(pilot, recorded, traffic, self._contacts, None)
        else:
            moved = self._contacts.move(
                pilot, motion, before, traffic, t_us=t_us, height=self._height
            )
        self._pilot, after, self.traffic, self._contacts, impacts = moved
        acceleration = (after.speed - motion.speed) / (self._clock.dt_us * 1e-6)
        self.motion = after._replace(acceleration=acceleration)
        return impacts

    def _struck(self, impacts: tuple[Impact, ...], before: Agents) -> StepContacts:
        """What the impacts of the step leave, dents among it."""
        if self.deformation is not None:
            subjects = {o.object_id: o for o in self.agents.objects}
            for impact in impacts:
                self.deformation = self.deformation.struck(impact, subjects)
        return after_impacts(impacts, self.t_us, touched=self._contacts.touching, before=before)

    def _overlapped(self) -> StepContacts:
        """What overlaps leave where bodies pass through each other."""
        met = self._contacts.met(self.T_world_vehicle, self.motion, self.agents)
        left = after_overlaps(met, self.t_us)
        if left.events and self.spec.on_collision == "terminate":
            self.terminated, self.reason = True, "collision"
        return left

    def _reacted(self) -> list[Event]:
        """Objects stop repeating the log once the ego is too far from where it was recorded."""
        agents = self.spec.agents
        if agents.ego_off_log == "replay" or self.traffic.reacting:
            return []
        (x, y, _), _ = self.scene.ego.pose(self.t_us)
        distance = math.hypot(self.motion.x - x, self.motion.y - y)
        if distance <= agents.off_log_distance:
            return []
        self.traffic = self.traffic.react(self.state, self._seen(self.agents))
        return [Event("agents_react", self.t_us, data={"distance": distance})]

    def _strayed(self) -> list[Event]:
        events = []
        distance = math.dist(self._near.position[:2], (self.motion.x, self.motion.y))
        was_off, self._left_log = self._left_log, distance > LEFT_LOG
        if self._left_log and not was_off:
            events.append(Event("left_log", self.t_us, data={"distance": distance}))
        if self.tally.off_road and not self._off_road:
            events.append(Event("off_road", self.t_us, data={"distance": distance}))
        self._off_road = self.tally.off_road
        return events

    def _ended(self) -> list[Event]:
        if self.steps < self._clock.horizon:
            return []
        self.truncated = True
        self.reason = self.reason or "horizon"
        return [Event("horizon", self.t_us)]

    # --- views of the instant ---------------------------------------------------------------

    def _standing(self) -> Float:
        return self.ground.stand(self.motion.x, self.motion.y, self.motion.yaw, self._near)

    def _height(self, x: float, y: float) -> float:
        return self.ground.height(x, y, self._path.nearest(x, y, near_s=self._near.s))

    def _seen(self, others: Agents) -> Surroundings:
        ego = EgoSeen.of(self.motion, self._near, self.scene.ego_size)
        clock = self._clock
        return Surroundings(self.t_us, clock.start_us, clock.dt_us, ego, others, self._path)

    def _instant(self, left: StepContacts, plan: PlannedTrajectory | None = None) -> Instant:
        return Instant(
            step=self.steps,
            t_us=self.t_us,
            ego=ego_sample(self.motion, self._near, float(self.T_world_vehicle[2, 3])),
            others=others_of(self.agents),
            contacts=left.notes,
            secondary=left.secondary,
            plan=plan,
        )
