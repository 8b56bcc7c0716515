"""The closed-loop world: one clock, one ego and the objects of a scenario."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from real2sim_proto import ErrorCode
from real2sim_proto.episode import ResetSpec, SensorSpec
from real2sim_proto.operations import Operation

from ..edit import EditError, EditOutcome, ObjectState, ScenarioState, apply_operations, compose
from ..edit.compose import lamps_on
from ..edit.tracks import PackedTracks
from ..render.types import Instance
from ..scene import Scene
from . import scoring
from .agents import Agents, Event, Lamps, Strides
from .boxes import ego_box
from .collision.bodies import Impact
from .collision.contact import obstacle_grid
from .collision.contact_state import (
    ContactState,
    StepContacts,
    StepMotion,
    contacts_of_impacts,
    contacts_of_overlaps,
)
from .collision.deformation import Deformation, DeformationTracker
from .collision.sweep import StepStart, overlapping_rows
from .common import Draws, WorldError, copy_with
from .controller import EgoController, Plan, emergency_brake
from .ego_motion import LEVEL, Motion, logged_motion, sprung, tilted
from .episode import (
    EpisodeRoute,
    RandomizedIdm,
    episode_clock,
    estimate_error,
    lanes_route,
    latency_jitter_us,
    placed,
    randomized_start,
    takes_effect_us,
)
from .observation import (
    LanePiece,
    Observation,
    PendingStep,
    ego_sample,
    lanes_around,
    object_samples,
    scoring_context,
)
from .path import Float, LoggedPath, LoopTransform, PathPoint, command_ahead, route_ahead
from .plan import PlannedTrajectory
from .ranging import MotionHistory, MotionSegment, Mounted, mounted_sensors
from .scoring import Instant, MetricAccumulator, Score
from .storyboard.program import ShownSignal
from .storyboard.run import StoryboardRun, begin_storyboard
from .traffic import ObservedEgo, Surroundings, Traffic
from .traffic.spawner import begin_spawner
from .traffic.traffic import lit_lamps

OFF_ROUTE_DISTANCE = 10.0
"""Distance from the recorded path that triggers an event [m]; image quality drops beyond it."""


class World:
    """A closed-loop simulation of one scene.

    The same scene, state, spec, operations and plans give the same observations, bit for bit. A
    step replaces objects instead of modifying them, so :meth:`fork` is cheap.

    Attributes:
        scene: the scene; shared, immutable.
        state: objects after all edits.
        spec: options of the episode.
        steps: clock steps since the reset; ``step`` in the observation.
        t_us: current simulation time [us].
        revision: number of edits in this session.
        motion: planar state of the ego.
        T_world_vehicle: [4, 4] float64, ego pose level on the ground; used for contact.
        T_world_body: [4, 4] float64, pose of the sprung body, which carries the cameras.
        traffic: drivers and poses of the other objects.
        ground: ground of the scene.
        accumulator: running inputs of the scores.
        instant: last committed instant, in the form that the scores take.
        impacts: impacts of the last step.
        deformation: objects deformed by impacts; None if there are none.
        terminated, truncated, reason: how the episode ended: ``collision``, ``horizon``,
            ``deadline`` or ``wall_clock``.
        lap: number of times the ego has been reset to the start of the route.
        sampled: values sampled for the start and the objects so far, by name.
        ranging: LiDARs and radars of the episode.
        motion_history: motion of the ego and the objects, long enough for one sweep.
        strides: walking motion of pedestrians that have left their trajectories.
        lamps: lit lamps of the objects.
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
        """Create the world at step 0, with the ego on the ground in its recorded state.

        Raises:
            WorldError: the spec is invalid for this scene; see :func:`~.episode.episode_clock`.
        """
        self.scene = scene
        self.state = state
        if spec.storyboard is None and state.storyboard is not None:
            spec = spec.model_copy(update={"storyboard": state.storyboard})
        self.spec = spec
        self.steps = 0
        self.revision = revision
        self.deformation = deformation
        self.terminated = False
        self.truncated = False
        self.reason: str | None = None
        self.lap = 0
        self._clock = episode_clock(scene, spec)
        self.ranging = mounted_sensors(spec.lidars, spec.radars, spec.dt_us)
        self.motion_history = MotionHistory.of(self.ranging.longest_us)
        self.strides = Strides()
        self.t_us = self._clock.at(self.steps)
        # The ego replays the recording until then.
        self._warm_up_end_us = self._clock.start_us + spec.warmup_us
        self._draws = Draws(spec.seed)
        self._episode_route = EpisodeRoute.of(scene, spec, self._clock)
        self._path = self._episode_route.route
        self._tracks = self._tracks_of(state)
        self.ground = scene.ground
        first = self._first_storyboard()
        self.motion, sampled = self._first_motion(first)
        self._path_point: PathPoint = self._path.nearest(self.motion.x, self.motion.y)
        self.T_world_vehicle: Float = self._ego_pose()
        self._attitude, self.T_world_body = LEVEL, self.T_world_vehicle
        self._estimate_error = estimate_error(spec.randomization.estimate, self._draws, 0)
        self._controller = EgoController(spec, scene.ego)
        self.traffic = self._first_traffic(first)
        self.lamps: Lamps = lit_lamps(self.traffic.drivers, {}, spec.dt_us * 1e-6)
        if first is not None:
            sampled |= dict(first.sampled)
        self._start_sampled = sampled
        self._step_sampled: Mapping[str, float] = sampled | dict(self.traffic.sampled)
        self._off_route = self._off_road = False
        self._contacts = self._initial_contacts()
        if deformation is None and self._contacts.exchanges_momentum and spec.contact.dents:
            self.deformation = DeformationTracker(scene, breakage=spec.contact.breakage)
        self.impacts: tuple[Impact, ...] = ()
        self._events: tuple[Event, ...] = ()
        self._edit_events: tuple[Event, ...] = ()
        self._pending: PendingStep | None = None
        self._context = scoring_context(scene, spec, self._clock, self._path, self._path_point.s)
        self._last_loop: LoopTransform | None = None
        self.instant = self._instant(StepContacts())
        self.accumulator: MetricAccumulator = scoring.begin_accumulator(self.instant, self._context)

    @property
    def horizon(self) -> int:
        """Number of steps after which the episode is truncated."""
        return self._clock.horizon

    @property
    def over(self) -> bool:
        """Whether the episode has ended."""
        return self.terminated or self.truncated

    @property
    def agents(self) -> Agents:
        """Current poses of all objects."""
        return self.traffic.agents

    @property
    def storyboard(self) -> StoryboardRun | None:
        """The running storyboard of the episode, or None."""
        found = self.traffic.storyboard
        return found if isinstance(found, StoryboardRun) else None

    @property
    def route(self) -> LoggedPath:
        """The reference path for route distances and offsets."""
        return self._path

    @property
    def path_point(self) -> PathPoint:
        """Position of the ego along the route."""
        return self._path_point

    @property
    def contacts(self) -> ContactState:
        """Current contacts."""
        return self._contacts

    @property
    def warming_up(self) -> bool:
        """Whether the ego is still replaying the recording."""
        return self.t_us < self._warm_up_end_us

    @property
    def sampled(self) -> dict[str, float]:
        """Values sampled for the start and for objects so far, by name."""
        return self._start_sampled | dict(self.traffic.sampled)

    @property
    def T_world_estimate(self) -> Float:
        """[4, 4] float64, body pose as estimated by the ego.

        Equals ``T_world_body`` if the estimate has no errors.
        """
        if self._estimate_error is None:
            return self.T_world_body
        estimate = self._estimate_error.applied(self.motion)
        standing = self.ground.pose_on(estimate.x, estimate.y, estimate.yaw)
        return tilted(standing, self._attitude, self.spec.ego)

    @property
    def context(self) -> scoring.ScoringContext:
        """Constants of the episode that the scores need."""
        return self._context

    def step(
        self, plan: Plan | None = None, *, latency_us: int = 0, missed: bool = False
    ) -> list[Event]:
        """Advance the clock by one ``dt_us``: :meth:`move`, then :meth:`evaluate`.

        Returns the events of the step, which are also part of the next observation.
        """
        self.move(plan, latency_us=latency_us, missed=missed)
        return self.evaluate()

    def move(self, plan: Plan | None = None, *, latency_us: int = 0, missed: bool = False) -> None:
        """Run the first half of a step, which updates everything visible in images.

        :meth:`evaluate` must follow. Edits made since the last step are already in effect. In a
        loop, an ego at the end of the route is reset to the start. Then the ego and the objects
        move, and contacts are resolved.

        Args:
            plan: plan of the ego. None keeps the last plan; before the first plan, the ego follows
                the log.
            latency_us: measured planning time; only used if the latency model of the episode is
                ``measured``.
            missed: whether the planner missed its deadline, so that the fallback applies.

        Raises:
            WorldError: EPISODE_OVER, or INVALID_ACTION for a plan whose kind differs from the
                reset's or whose times have passed. The world is unchanged.
        """
        self._check_running()
        sampled_before = self.traffic.sampled
        jitter_us = latency_jitter_us(
            self.spec.randomization.latency_us if plan is not None else 0, self._draws, self.steps
        )
        controller = self._with_plan(plan, latency_us, jitter_us)
        controller, loop_events = self._loop(controller)
        trajectory = controller.pending[-1].trajectory if plan is not None else None
        controller, late_events = self._with_fallback(controller, missed=missed)
        reaction_events = self._update_reactive_agents()
        start = self._step_start(controller)
        since_us, body, drivers = self.t_us, self.T_world_body, self.traffic.drivers
        moved = self._advance(controller)
        self._commit_motion(moved)
        self.strides = self.strides.after(
            self.scene, self.agents, since_us=since_us, t_us=self.t_us
        )
        self.lamps = lit_lamps(self.traffic.drivers, drivers, (self.t_us - since_us) * 1e-6)
        spans = (body, self.T_world_body), (start.agents, self.agents)
        self.motion_history = self.motion_history.after(MotionSegment(since_us, self.t_us, *spans))
        self._step_sampled = _newly_sampled(self.traffic.sampled, sampled_before, jitter_us)
        contacts = self._apply_impacts(moved.impacts, start.agents)
        storyboard_events = self._storyboard_events()
        events = (
            *self._edit_events,
            *loop_events,
            *late_events,
            *reaction_events,
            *storyboard_events,
        )
        self._pending = PendingStep(start, trajectory, events, contacts, self._last_loop)
        self._edit_events = ()

    def evaluate(self) -> list[Event]:
        """Run the second half of a pending step: contacts, scores and events.

        It changes nothing visible in images, so they can be rendered concurrently.
        """
        if self._pending is not None:
            start, plan, events, contacts, loop = self._pending
            self._pending = None
            contacts = self._overlap_contacts(start) if contacts is None else contacts
            if contacts.touching != self._contacts.touching:
                self._contacts = copy_with(self._contacts, touching=contacts.touching)
            self.instant = self._instant(contacts, plan, loop)
            self.accumulator = scoring.update_accumulator(
                self.accumulator, self.instant, self._context
            )
            departures, end = self._departure_events(), self._horizon_events()
            self._events = (*events, *contacts.events, *departures, *end)
        return list(self._events)

    def stop(self, reason: str) -> None:
        """End the episode without a step; ``reason`` is ``deadline`` or ``wall_clock``.

        Raises:
            WorldError: EPISODE_OVER.
        """
        self._check_running()
        self.truncated, self.reason = True, reason
        self._events = (*self._events, Event("stopped", self.t_us))

    def set_agent_plan(
        self, object_id: str, times_us: Sequence[int], poses: Sequence[tuple[float, float, float]]
    ) -> None:
        """Set the plan of an externally driven object, effective from the next step.

        Args:
            object_id: an object with an ``external`` driver.
            times_us: [N] absolute times, increasing, in the future [us].
            poses: [N] x, y [m], yaw [rad] of the box centre, world frame.

        Raises:
            WorldError: EPISODE_OVER or INVALID_ACTION; the world is unchanged.
        """
        self._check_running()
        self.traffic = self.traffic.with_plan(object_id, self.t_us, times_us, poses)

    def apply(
        self, operations: Sequence[Operation], *, base_revision: int | None = None
    ) -> EditOutcome:
        """Apply edits to the objects atomically at the current instant, without advancing time.

        An object placed on the ego causes a collision in the next step. A spawn without a time
        appears now; a route-relative spawn is placed relative to the ego's current position.
        Objects with an edited trajectory restart on it, including those under physics control.

        Args:
            operations: validated wire models.
            base_revision: session revision that the operations are based on; None for any.

        Raises:
            EditError: STALE_REVISION, UNKNOWN_OBJECT or INVALID_OPERATION; the world is unchanged.
        """
        if base_revision is not None and base_revision != self.revision:
            raise EditError(
                ErrorCode.STALE_REVISION,
                f"the edit was made for revision {base_revision}; the session is at "
                f"{self.revision}",
                hint="read the objects again and send the edit for the current revision",
            )
        s, t_us = self._path_point.s, self.t_us
        known = [placed(o, self._path, s, self.ground, t_us=t_us) for o in operations]
        outcome = apply_operations(self.state, known)
        self.state, self._tracks = outcome.state, self._tracks_of(outcome.state)
        self.traffic = self.traffic.edited(
            self._tracks, self._surroundings(self._tracks.at(self.t_us))
        )
        self.revision += 1
        edited = Event("edited", self.t_us, data={"revision": float(self.revision)})
        self._edit_events = (*self._edit_events, edited)
        return outcome

    def observe(self) -> Observation:
        """The current observation, without images."""
        motion, s, truth = self.motion, self._path_point.s, None
        if self._estimate_error is not None:
            truth = (motion, self.T_world_body) if self.spec.privileged else None
            motion = self._estimate_error.applied(motion)
            s = self._path.nearest(motion.x, motion.y, near_s=s).s
        return Observation(
            step=self.steps,
            t_us=self.t_us,
            revision=self.revision,
            motion=motion,
            T_world_vehicle=self.T_world_estimate,
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
            lap=self.lap,
            drawn=self._step_sampled,
            truth=truth,
            signals=self._signals(),
            lanes=self._lanes_around(motion),
            lamps=self.lamps,
        )

    def _signals(self) -> tuple[ShownSignal, ...]:
        return () if self.storyboard is None else self.storyboard.signals()

    def _lanes_around(self, motion: Motion) -> tuple[LanePiece, ...]:
        lanes = self.scene.lanes if self.spec.privileged else None
        return () if lanes is None else lanes_around(lanes, motion.x, motion.y)

    def metrics(self) -> dict[str, float]:
        """Running scores; see :func:`~.scoring.running_metrics`."""
        return scoring.running_metrics(self.accumulator, self._context)

    def scores(self) -> list[Score]:
        """All current scores, with terms and versions."""
        return scoring.scores_of(self.accumulator, self._context)

    def instances(self) -> list[Instance]:
        """The instances to render at this instant; nothing is copied."""
        return self._drawn(moving=False)

    def moving_instances(self) -> list[Instance]:
        """Like :meth:`instances`, with object velocities, for motion blur and rolling shutter."""
        return self._drawn(moving=True)

    def _drawn(self, *, moving: bool) -> list[Instance]:
        shown_us = min(self.t_us, self.scene.end_us)
        strides = self.strides.made
        drawn = compose(self.scene, self.state, self.agents, shown_us, strides=strides)
        if self.deformation is not None:
            # Background first, then the objects, then shadows.
            for k, subject in enumerate(self.agents.objects, start=1):
                drawn[k] = self.deformation.deformed_instance(
                    subject.object_id, drawn[k], self.t_us
                )
            drawn += self.deformation.fragments(self.t_us)
        if moving:
            for k, velocity in enumerate(self.agents.velocities, start=1):
                twist = np.zeros(6)
                twist[:3] = velocity
                drawn[k] = replace(drawn[k], twist=twist)
        if self.lamps:
            drawn += [
                lamps_on(self.scene, subject, drawn[k], lit)
                for k, subject in enumerate(self.agents.objects, start=1)
                if (lit := self.lamps.get(subject.object_id))
            ]
        return drawn

    @property
    def twist(self) -> Float:
        """[6] ego twist, world frame: velocity of the origin [m/s], angular velocity [rad/s]."""
        vx, vy = self.motion.velocity
        found: Float = np.array([vx, vy, 0.0, 0.0, 0.0, self.motion.yaw_rate])
        return found

    def due_sensors(self) -> list[SensorSpec]:
        """Sensors that deliver a frame at this step; all sensors at step 0."""
        elapsed = self.steps * self._clock.dt_us
        return [s for s in self.spec.sensors if elapsed % (s.period_us or self._clock.dt_us) == 0]

    def due_ranging(self) -> tuple[Mounted, ...]:
        """LiDARs and radars whose point cloud is complete at this step; all of them at step 0."""
        return self.ranging.due(self.steps * self._clock.dt_us)

    def fork(self) -> World:
        """An independent copy of the world that shares all immutable data."""
        return copy_with(self)

    # --- phases of a step -------------------------------------------------------------------

    def _check_running(self) -> None:
        if self.over:
            raise WorldError(
                ErrorCode.EPISODE_OVER,
                f"the episode ended at step {self.steps}: {self.reason}",
                hint="reset the session to start another",
            )

    def _with_plan(self, plan: Plan | None, latency_us: int, jitter_us: int) -> EgoController:
        """The controller with the policy's plan, which takes effect after the latency."""
        if plan is None:
            return self._controller
        from_us = takes_effect_us(
            self.spec, self._clock, self.t_us, latency_us, jitter_us=jitter_us
        )
        return self._controller.with_plan(plan, self.motion, self.t_us, from_us)

    def _with_fallback(
        self, controller: EgoController, *, missed: bool
    ) -> tuple[EgoController, list[Event]]:
        """The controller of a step whose planner was late."""
        if not missed:
            return controller, []
        if self.spec.on_timeout == "brake":
            brake = emergency_brake(controller, self.motion, self.spec.ego)
            controller = replace(controller, controller=brake, since_us=self.t_us, pending=())
        return controller, [Event("deadline_missed", self.t_us)]

    def _loop(self, controller: EgoController) -> tuple[EgoController, list[Event]]:
        """In a loop, reset an ego at the end of the recorded drive to its start."""
        put = self._episode_route.looped(self.motion, self._path_point)
        self._last_loop = put.loop if put is not None else None
        if put is None:
            return controller, []
        surroundings = self._surroundings(self.agents)
        self.motion, self._path_point = put.motion, put.point
        self.T_world_vehicle = self._ego_pose()
        self.T_world_body = tilted(self.T_world_vehicle, self._attitude, self.spec.ego)
        self.lap += put.laps
        self._tracks = self._tracks_of(self.state)
        self.traffic = self.traffic.looped(self._tracks, surroundings, put.way)
        data = {"lap": float(self.lap), **put.loop._asdict()}
        return controller.looped(put.loop), [Event("looped", self.t_us, data=data)]

    def _update_reactive_agents(self) -> list[Event]:
        """Switch objects from replay to reactive driving once the ego is too far off its log."""
        agents = self.spec.agents
        if agents.ego_off_log == "replay" or self.traffic.reacting:
            return []
        if self.t_us > self.scene.end_us:
            return []
        (x, y, _), _ = self.scene.ego.pose(self.t_us)
        distance = math.hypot(self.motion.x - x, self.motion.y - y)
        if distance <= agents.off_log_distance:
            return []
        surroundings = self._surroundings(self.agents)
        self.traffic = self.traffic.with_reacting_agents(self._tracks, surroundings)
        return [Event("agents_react", self.t_us, data={"distance": distance})]

    def _advance(self, controller: EgoController) -> StepMotion:
        """Advance the objects, then the ego, by one clock step."""
        t_us, before = self.t_us, self.agents
        end_us = t_us + self._clock.dt_us
        traffic = self.traffic.advance(self._tracks, end_us, lambda: self._surroundings(before))
        if end_us <= self._warm_up_end_us:
            recorded = logged_motion(self.scene.ego, end_us, self.spec.ego)
            return StepMotion(controller, recorded, traffic, self._contacts, None)
        run = traffic.storyboard
        if isinstance(run, StoryboardRun) and run.drives_ego:
            scripted = run.ego_motion(self.motion)
            return StepMotion(controller, scripted, traffic, self._contacts, None)
        return self._contacts.advance(
            controller, self.motion, before, traffic, t_us=t_us, height=self.ground.height
        )

    def _commit_motion(self, moved: StepMotion) -> None:
        """Commit the step: clock, ego, objects and contacts at its end."""
        seconds = self._clock.dt_us * 1e-6
        acceleration = (moved.motion.speed - self.motion.speed) / seconds
        self.steps += 1
        self.t_us = self._clock.at(self.steps)
        self._controller, self.traffic = moved.controller, moved.traffic
        self._contacts, self.impacts = moved.contacts, moved.impacts or ()
        before = self.motion
        self.motion = moved.motion._replace(acceleration=acceleration)
        self._path_point = self._path.nearest(
            self.motion.x, self.motion.y, near_s=self._path_point.s
        )
        self.T_world_vehicle = self._ego_pose()
        if self.spec.ego.suspension is not None and self.spec.action != "pose":
            recorded = self.t_us <= self._warm_up_end_us
            ego = self.spec.ego
            self._attitude = (
                LEVEL if recorded else sprung(self._attitude, before, self.motion, seconds, ego)
            )
        self.T_world_body = tilted(self.T_world_vehicle, self._attitude, self.spec.ego)
        if self._estimate_error is not None:
            self._estimate_error = estimate_error(
                self.spec.randomization.estimate,
                self._draws,
                self.steps,
                before=self._estimate_error,
                dt=seconds,
            )

    def _apply_impacts(
        self, impacts: tuple[Impact, ...] | None, before: Agents
    ) -> StepContacts | None:
        """Resolve impacts, which deform objects, and return their contacts.

        None if the episode has no collision response.
        """
        if impacts is None:
            return None
        if self.deformation is not None and impacts:
            subjects = {o.object_id: o for o in self.agents.objects}
            for impact in impacts:
                self.deformation = self.deformation.with_impact(impact, subjects)
        touching = self._contacts.touching
        return contacts_of_impacts(impacts, self.t_us, touching=touching, before=before)

    def _step_start(self, controller: EgoController) -> StepStart:
        """The world before a step, and the ego motion that its controller produces."""
        motion, t_us, at = self.motion, self.t_us, None
        if self.spec.action != "pose" and not self.warming_up:

            def at(since_us: int) -> Motion:
                return controller.advance(motion, t_us, since_us)[1]

        dt_us = self._clock.dt_us
        return StepStart(motion, self.T_world_vehicle, self.agents, t_us, dt_us, at)

    def _overlap_contacts(self, start: StepStart) -> StepContacts:
        """Contacts without collision response; the first may end the episode.

        No contacts are reported while the ego replays the recording.
        """
        found = self._contacts.ego_contacts(start, self.T_world_vehicle, self.motion, self.agents)
        if self.t_us <= self._warm_up_end_us:
            self._contacts = self._contacts.after_warm_up(found.touching)
            return StepContacts(touching=found.touching)
        contacts = contacts_of_overlaps(found, self.t_us)
        if contacts.events and self.spec.on_collision == "terminate":
            self.terminated, self.reason = True, "collision"
        return contacts

    def _departure_events(self) -> list[Event]:
        """Events of the ego leaving the road or the corridor of the recorded path."""
        events = []
        distance = math.dist(self._path_point.position[:2], (self.motion.x, self.motion.y))
        was_off_route, self._off_route = self._off_route, distance > OFF_ROUTE_DISTANCE
        if self._off_route and not was_off_route:
            events.append(Event("left_log", self.t_us, data={"distance": distance}))
        if self.accumulator.off_road and not self._off_road:
            events.append(Event("off_road", self.t_us, data={"distance": distance}))
        self._off_road = self.accumulator.off_road
        return events

    def _storyboard_events(self) -> list[Event]:
        """Events of storyboard elements that started or stopped in the step."""
        run = self.storyboard
        return [
            Event("storyboard", c.t_us, element=c.element, element_type=c.type, change=c.change)
            for c in (run.changes if run is not None else ())
        ]

    def _horizon_events(self) -> list[Event]:
        run = self.storyboard
        if run is not None and run.over and run.program.board.ends_episode and not self.over:
            self.truncated, self.reason = True, "storyboard"
            return [Event("stopped", self.t_us)]
        if self.steps < self._clock.horizon:
            return []
        self.truncated = True
        self.reason = self.reason or "horizon"
        return [Event("horizon", self.t_us)]

    # --- views of the current state ---------------------------------------------------------

    def _first_motion(self, storyboard: StoryboardRun | None) -> tuple[Motion, dict[str, float]]:
        """The ego at the start, and the values sampled for it by name."""
        recorded = logged_motion(self.scene.ego, self.t_us, self.spec.ego)
        if storyboard is not None and storyboard.ego_put:
            recorded = storyboard.ego_motion(recorded)
        others, size = self._tracks.at(self.t_us), self.scene.ego_size

        def touched(motion: Motion) -> set[int]:
            pose = self.ground.pose_on(motion.x, motion.y, motion.yaw)
            return set(overlapping_rows(ego_box(pose, size), size, others))

        # Recorded boxes may overlap slightly; a sampled start must not add further overlaps.
        return randomized_start(
            recorded,
            self._path,
            self.spec.randomization.start,
            self._draws,
            is_free=lambda motion: touched(motion) <= touched(recorded),
        )

    def _first_storyboard(self) -> StoryboardRun | None:
        """The storyboard at the start, with the ego as recorded."""
        if self.spec.storyboard is None:
            return None
        motion = logged_motion(self.scene.ego, self.t_us, self.spec.ego)
        ego = ObservedEgo.of(motion, self._path.nearest(motion.x, motion.y), self.scene.ego_size)
        clock, others = self._clock, self._tracks.at(self.t_us)
        around = Surroundings(
            self.t_us, clock.start_us, clock.dt_us, ego, others, self._path, self.ground
        )
        return begin_storyboard(self.spec, self.state, around, self.scene, self._draws)

    def _first_traffic(self, storyboard: StoryboardRun | None) -> Traffic:
        spec, scene = self.spec, self.scene
        randomized = RandomizedIdm(spec.randomization.traffic, self._draws)
        return Traffic.begin(
            self._tracks,
            spec.agents,
            self._surroundings(self._tracks.at(self.t_us)),
            spawner=begin_spawner(
                spec.agents,
                self.state,
                self._draws,
                route=lanes_route(self._path, scene, spec),
                ego=scene.ego,
            ),
            randomized=randomized if randomized.widths else None,
            storyboard=storyboard,
        )

    def _tracks_of(self, state: ScenarioState) -> PackedTracks[ObjectState]:
        """Object tracks from the recording and edits.

        Later laps omit objects that moved in the recording: their tracks have ended.
        """
        left = self.traffic.recorded_movers(state.visible) if self.lap else frozenset[str]()
        return self._episode_route.tracks(state, left=left)

    def _initial_contacts(self) -> ContactState:
        background = self.spec.contact.background
        return ContactState.begin(
            self.spec,
            self.scene.ego_size,
            obstacles=obstacle_grid(self.scene, LoggedPath(self.scene.ego)) if background else None,
            T_world_vehicle=self.T_world_vehicle,
            motion=self.motion,
            agents=self.agents,
        )

    def _ego_pose(self) -> Float:
        motion = self.motion
        return self.ground.pose_on(motion.x, motion.y, motion.yaw)

    def _surroundings(self, others: Agents) -> Surroundings:
        ego = ObservedEgo.of(self.motion, self._path_point, self.scene.ego_size)
        clock, lanes = self._clock, self.scene.lanes
        return Surroundings(
            self.t_us, clock.start_us, clock.dt_us, ego, others, self._path, self.ground, lanes
        )

    def _instant(
        self,
        contacts: StepContacts,
        plan: PlannedTrajectory | None = None,
        loop: LoopTransform | None = None,
    ) -> Instant:
        height = float(self.T_world_vehicle[2, 3])
        laps = self.lap * self._episode_route.lap_length if self.lap else 0.0
        return Instant(
            step=self.steps,
            t_us=self.t_us,
            ego=ego_sample(self.motion, self._path_point, height, laps=laps),
            others=object_samples(self.agents),
            contacts=contacts.records,
            secondary=contacts.secondary,
            plan=plan,
            loop=loop,
            signals=self._signals(),
        )


def _newly_sampled(
    now: Mapping[str, float], before: Mapping[str, float], jitter_us: int
) -> Mapping[str, float]:
    """Values sampled in a step, by name."""
    sampled = {} if now is before else {k: v for k, v in now.items() if k not in before}
    return sampled | {"latency_us": float(jitter_us)} if jitter_us else sampled
