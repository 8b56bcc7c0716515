"""Batched worlds of one scene, stepped together as a structure of arrays, for learning.

A step costs microseconds. Each world of a :class:`BatchWorld` behaves like a
:class:`.world.World`: the same plans lead to the same motions, contacts and terminations. Only the
options that :func:`check_batchable` accepts are supported.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from real2sim_proto import ErrorCode
from real2sim_proto.episode import AgentsSpec, IdmDriver, ResetSpec
from real2sim_proto.plans import Control, TrajectoryPlan

from ..edit import ObjectState, ScenarioState, compose, instances_of
from ..edit.compose import lamps_on
from ..geometry import transform_from
from ..render.types import Instance
from ..scene import Ground, Scene
from .agents import Agents
from .batch_kernels import (
    BEYOND,
    DRIVES,
    LEFT,
    MOVED,
    OFFSET,
    PATH_X,
    PATH_YAW,
    PLACES,
    STANDS,
    STATE,
    S,
    routes_ahead,
    step_worlds,
)
from .collision.contact_state import ContactState
from .collision.sweep import EgoContacts, StepStart
from .common import WorldError
from .controller import EgoController
from .driving import HOLD, KINDS, PLANNING_AHEAD, vehicle_parameters
from .ego_motion import LEVEL, BodyAttitude, Motion, sprung_side_by_side, tilted
from .path import WAYPOINT_SPACING, WAYPOINTS, Float, LoggedPath
from .plan import SinglePose, can_reverse, may_lead_backwards
from .scoring import ScoringContext
from .scoring.instant import ego_at_fault
from .traffic.driver import Idm, desired_speed
from .traffic.traffic import BRAKING, DRIVEN, LAMPED, MOVING, STANDING
from .world import World

# --- Supported episodes --------------------------------------------------------------------------

TRACKERS = tuple(name for name, kind in KINDS.items() if kind not in PLANNING_AHEAD)
FREE = frozenset({"seed", "start_us", "dt_us", "horizon", "sensors", "privileged", "scoring"})
"""Fields of a reset that batches support in full; the caller renders cameras."""
CHECKED = frozenset({"ego", "action", "agents", "contact"})
"""Fields of a reset that batches support in part."""


def check_batchable(spec: ResetSpec) -> None:
    """Check that a batch supports all options of ``spec``.

    Raises:
        WorldError: INVALID_REQUEST, with every unsupported option and its allowed values.
    """
    outside = [
        f"{name}={getattr(spec, name)!r}"
        for name, field in type(spec).model_fields.items()
        if name not in FREE | CHECKED
        and getattr(spec, name) != field.get_default(call_default_factory=True)
    ]
    allowed = {
        "action": spec.action in {"control", "trajectory"},
        "ego.tracker": spec.action == "control" or spec.ego.tracker in TRACKERS,
        "ego.actuators.*_delay_us": not (
            spec.ego.actuators.steering_delay_us or spec.ego.actuators.drive_delay_us
        ),
        "agents.default": spec.agents.default in {"log", "idm"},
        "agents (but default)": spec.agents == AgentsSpec(default=spec.agents.default),
        "contact.background": not spec.contact.background,
        "contact.swept": spec.contact.swept,
    }
    outside += [name for name, fine in allowed.items() if not fine]
    if outside:
        raise WorldError(
            ErrorCode.INVALID_REQUEST,
            f"worlds in batches do not know {', '.join(outside)}",
            hint="they know actions 'control' and 'trajectory' by the trackers "
            f"{', '.join(TRACKERS)}, commands without delay, objects that repeat the log or drive "
            "by IDM, and episodes that end at the first contact with an object; take single "
            "worlds for the rest",
        )


# --- Tables --------------------------------------------------------------------------------------

# Compiled code takes them as plain arrays: parallel loops do not support nested tuples.

Longs = NDArray[np.int64]


class Tracks(NamedTuple):
    """The N objects of the scenario.

    Attributes:
        ends, times, knots: trajectories, see ``edit.track_kernels.poses_at``.
        sizes: [N, 3] float64 [m].
        driven: [N] bool, objects with an IDM driver.
        path_ends: [N + 1] int64, start of each object's path in ``paths``.
        paths: [P, KNOT] float64, see :mod:`.path`.
        desired: [N] float64 [m/s].
        idm: [5] float64: headway [s], gap [m], acceleration, braking, lateral acceleration
            [m/s^2].
    """

    ends: Longs
    times: Longs
    knots: Float
    sizes: Float
    driven: NDArray[np.bool_]
    path_ends: Longs
    paths: Float
    desired: Float
    idm: Float


class Road(NamedTuple):
    """Ground and roads.

    Attributes:
        heights, frame: ground grid, see ``scene.ground``.
        route: knots of the recorded path, see :mod:`.path`.
        line_points, line_ends, lane_points, lane_ends: route and other lanes, see
            ``scoring.road``.
        half_widths: [2] float64, along the route and along other lanes [m].
        ego_size: [3] float64, (length, width, height) [m].
    """

    heights: NDArray[np.float32]
    frame: Float
    route: Float
    line_points: Float
    line_ends: Longs
    lane_points: Float
    lane_ends: Longs
    half_widths: Float
    ego_size: Float


def tracks_of(state: ScenarioState, spec: ResetSpec) -> tuple[tuple[ObjectState, ...], Tracks]:
    """The visible objects and their tables."""
    packed = state.tracks
    objects = packed.objects
    ends, times, knots = packed.arrays
    driven = np.array([spec.agents.default == "idm" and _is_driven(o) for o in objects], np.bool_)
    paths = [
        LoggedPath(o.trajectory).knots for o, is_driven in zip(objects, driven, strict=True)
        if is_driven
    ]  # fmt: skip
    lengths = np.zeros(len(objects), np.int64)
    lengths[driven] = [len(path) for path in paths]
    idm = IdmDriver()
    desired = [
        desired_speed(o, idm) if is_driven else 0.0
        for o, is_driven in zip(objects, driven, strict=True)
    ]
    return objects, Tracks(
        ends=ends,
        times=times,
        knots=knots,
        sizes=np.ascontiguousarray(packed.sizes, np.float64),
        driven=driven,
        path_ends=np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
        paths=np.concatenate([np.zeros((0, 11)), *paths]),
        desired=np.array(desired, np.float64),
        idm=np.array([idm.headway, idm.gap, idm.acceleration, idm.braking, idm.lateral]),
    )


def road_of(ground: Ground, path: LoggedPath, context: ScoringContext) -> Road:
    """Ground and roads of an episode."""
    lines, lanes = context.road_lines
    return Road(
        *ground.grid,
        route=path.knots,
        line_points=lines[0],
        line_ends=lines[1],
        lane_points=lanes[0],
        lane_ends=lanes[1],
        half_widths=np.array([context.corridor, context.lane], np.float64),
        ego_size=np.array(context.ego_size, np.float64),
    )


def _is_driven(subject: ObjectState) -> bool:
    return subject.category in DRIVEN and subject.trajectory.extent >= MOVING


Flags = NDArray[np.bool_]


@dataclass(eq=False)
class _Instant:
    """All worlds at one instant: the arguments of step_worlds, then the engaged gears."""

    motions: Float
    poses: Float
    places: Float
    objects: Float
    present: Flags
    drivers: NDArray[np.int8]
    driving: Float
    reversing: Flags

    @classmethod
    def of(cls, worlds: int, objects: int) -> _Instant:
        return cls(
            motions=np.zeros((worlds, STATE)),
            poses=np.tile(np.eye(4), (worlds, 1, 1)),
            places=np.zeros((worlds, PLACES)),
            objects=np.zeros((worlds, objects, 10)),
            present=np.zeros((worlds, objects), np.bool_),
            drivers=np.zeros((worlds, objects), np.int8),
            driving=np.zeros((worlds, objects, 3)),
            reversing=np.zeros(worlds, np.bool_),
        )

    @property
    def arrays(self) -> tuple[NDArray[np.generic], ...]:
        return tuple(value for name, value in vars(self).items() if name != "reversing")

    def motion(self, w: int) -> Motion:
        return Motion._make((*self.motions[w].tolist(), (), bool(self.reversing[w])))


@dataclass(frozen=True, eq=False)
class WorldInstances:
    """Render instances of W worlds.

    Attributes:
        things: the background, N objects and the light of the B that may brake; ignore their own
            poses and times.
        poses: [W, 1 + N + B, 4, 4] float64, ``T_world_object``.
        there: [W, 1 + N + B] bool, whether each instance exists at the current time.
        times_us: [W] int64, time for colours that change over time [us].
    """

    things: tuple[Instance, ...]
    poses: Float
    there: Flags
    times_us: Longs


@dataclass(frozen=True, eq=False)
class BatchStep:
    """Results of a step, by world.

    Attributes:
        progress: [W] float64, distance along the route in this step [m].
        at_fault: [W] int64, new contacts for which the ego is at fault.
        contacts: [W] int64, new contacts.
    """

    progress: Float
    at_fault: Longs
    contacts: Longs


class BatchWorld:
    """W independent episodes of one scene and one reset.

    Each episode behaves like a :class:`.world.World` with the same options: same motions, objects,
    contacts and terminations. Results do not depend on the number of threads.

    Attributes:
        scene: the scene; shared, immutable.
        state: objects of all worlds.
        spec: options of all episodes, except their start times.
        worlds: W.
        start_us, steps: [W] int64, start time [us] and steps since then.
        horizons: [W] int64, number of steps after which each episode is truncated.
        terminated, truncated: [W] bool, how each episode ended.
        off_road: [W] bool, whether each ego has been off the road in its episode.
        touching: names of the objects each ego is in contact with.
    """

    def __init__(
        self, scene: Scene, spec: ResetSpec, worlds: int, *, state: ScenarioState | None = None
    ) -> None:
        """Start an episode in every world.

        Args:
            scene: the scene to drive in.
            spec: options of the episodes.
            worlds: number of worlds, at least 1.
            state: objects; those of the scene by default.

        Raises:
            WorldError: INVALID_REQUEST for options that batches do not support; errors of
                ``World``.
            ValueError: fewer than one world.
        """
        if worlds < 1:
            raise ValueError(f"a batch needs at least one world, not {worlds}")
        check_batchable(spec)
        self.scene, self.spec, self.worlds = scene, spec, worlds
        self.state = ScenarioState.of(scene) if state is None else state
        self._begun: dict[int, World] = {}
        first = self._begin(spec.start_us)
        self.objects, self._tracks = tracks_of(self.state, spec)
        self._rows = {o.object_id: k for k, o in enumerate(self.objects)}
        self._instances = instances_of(scene, self.state, self.objects)
        self._lamped = self._tracks.driven & np.array(
            [o.category in LAMPED for o in self.objects], np.bool_
        )
        self._braking = np.zeros((worlds, len(self.objects)), np.bool_)
        if self._instances is not None:
            self._instances += tuple(
                lamps_on(scene, self.objects[k], self._instances[1 + k], ("brake",))
                for k in np.flatnonzero(self._lamped).tolist()
            )
        self._road = road_of(scene.ground, first.route, first.context)
        self._vehicle = tuple(vehicle_parameters(spec.ego))
        ego = spec.ego
        hardest = max(ego.max_acceleration, ego.max_braking)
        self._limits = (hardest, ego.max_steer_rate, ego.max_steer, ego.wheelbase)
        self._law = HOLD if spec.action == "control" else KINDS[ego.tracker]
        self._now = _Instant.of(worlds, len(self.objects))
        self._next = _Instant.of(worlds, len(self.objects))
        self.start_us, self.steps, self.horizons = (np.zeros(worlds, np.int64) for _ in range(3))
        self.terminated, self.truncated, self.off_road = (
            np.zeros(worlds, np.bool_) for _ in range(3)
        )
        self.touching: list[frozenset[str]] = [frozenset()] * worlds
        self._attitudes = np.tile(np.array(LEVEL), (worlds, 1))
        self._near = np.zeros(worlds, np.bool_)
        self._single: list[SinglePose | None] = [None] * worlds
        self.reset()

    @property
    def times_us(self) -> Longs:
        """[W] current times [us]."""
        return self.start_us + self.steps * self.spec.dt_us

    @property
    def over(self) -> Flags:
        """[W] whether each episode has ended; ended worlds do not move until they are reset."""
        return self.terminated | self.truncated

    @property
    def motions(self) -> Float:
        """[W, 9] float64, states of the egos in the order of ``driving.PlanarState``; a view."""
        return self._now.motions

    @property
    def poses(self) -> Float:
        """[W, 4, 4] float64, ``T_world_vehicle``; a view."""
        return self._now.poses

    def body_pose(self, w: int) -> Float:
        """``T_world_body`` [4, 4] float64 of one ego: its sprung body, which carries cameras."""
        attitude = BodyAttitude(*self._attitudes[w].tolist())
        return tilted(self._now.poses[w], attitude, self.spec.ego)

    @property
    def route_s(self) -> Float:
        """[W] float64, ego positions along the route [m]; a view."""
        return self._now.places[:, S]

    @property
    def route_offset(self) -> Float:
        """[W] float64, lateral offsets from the route, positive left [m]; a view."""
        return self._now.places[:, OFFSET]

    def reset(
        self, where: ArrayLike | None = None, *, start_us: Sequence[int | None] | None = None
    ) -> None:
        """Start new episodes.

        Args:
            where: [W] bool or indices of worlds; all worlds by default.
            start_us: start time of each selected world [us]; None for that of the spec.

        Raises:
            WorldError: TIME_OUT_OF_RANGE for a start outside the log; nothing is changed.
        """
        chosen = np.arange(self.worlds)[slice(None) if where is None else np.asarray(where)]
        starts = [self.spec.start_us] * len(chosen) if start_us is None else list(start_us)
        begun = [self._begin(start) for start in starts]
        for w, world in zip(chosen.tolist(), begun, strict=True):
            self._place(w, world)

    def step(self, actions: ArrayLike, *, plan_us: ArrayLike | None = None) -> BatchStep:
        """Advance every running world by one clock step.

        Args:
            actions: [W, 2] acceleration [m/s^2] and road-wheel angle [rad] if the action of the
                spec is ``control``; else [W, N, 3] poses x, y [m], yaw [rad], vehicle frame.
            plan_us: [N] times of these poses relative to now, increasing [us].

        Raises:
            ValueError: wrong shape, values that are not finite, or times that do not increase.
        """
        given, after_us = self._checked(actions, plan_us)
        going, before, after = ~self.over, self._now, self._next
        times_us = self.times_us
        kinds = going.astype(np.int8)
        single = self._move_one_by_one(kinds, times_us, given, after_us)
        step_worlds(
            *(kinds, times_us, self.spec.dt_us, self._law, given, after_us, True),
            *(self._vehicle, self._limits, self._tracks, self._road),
            *before.arrays,
            *after.arrays,
            self._near,
        )
        self._now, self._next = after, before
        self._brake(going)
        self.steps[going] += 1
        if self.spec.ego.suspension is not None:
            seconds = self.spec.dt_us * 1e-6
            self._attitudes[going] = sprung_side_by_side(
                self._attitudes[going],
                before.motions[going],
                after.motions[going],
                seconds,
                self.spec.ego,
            )
        self.off_road |= going & (after.places[:, BEYOND] > 0)
        at_fault, contacts = (np.zeros(self.worlds, np.int64) for _ in range(2))
        for w in np.flatnonzero(going).tolist():
            if self._near[w]:
                at_fault[w], contacts[w] = self._meet(w, int(times_us[w]), given[w], after_us)
            elif self.touching[w]:
                self.touching[w] = frozenset()
        self._single = single
        self.terminated |= contacts > 0
        self.truncated |= going & (self.steps >= self.horizons)
        progress = np.where(going, after.places[:, S] - before.places[:, S], 0.0)
        return BatchStep(progress, at_fault, contacts)

    def routes(self) -> NDArray[np.float32]:
        """Waypoints [W, 20, 2] float32 along the route ahead, vehicle frame [m]."""
        found = np.empty((self.worlds, WAYPOINTS, 2), np.float32)
        routes_ahead(self._road.route, self._now.motions, self._now.places, WAYPOINT_SPACING, found)
        return found

    def agents(self, w: int) -> Agents:
        """Current objects of one world."""
        return self._agents(self._now, w)

    def instances(self, w: int) -> list[Instance]:
        """Current render instances of one world; nothing is copied."""
        shown_us = min(int(self.times_us[w]), self.scene.end_us)
        agents = self.agents(w)
        drawn = compose(self.scene, self.state, agents, shown_us)
        return drawn + [
            lamps_on(self.scene, subject, drawn[k], ("brake",))
            for k, subject in enumerate(agents.objects, start=1)
            if self._braking[w, self._rows[subject.object_id]]
        ]

    def shown(self, worlds: Sequence[int]) -> WorldInstances | None:
        """The :meth:`instances` of some worlds as arrays.

        None if edits make background or shadows differ between worlds.
        """
        if self._instances is None:
            return None
        chosen = np.asarray(worlds, np.int64)
        rows = self._now.objects[chosen]
        present = self._now.present[chosen]
        poses = np.empty((len(chosen), len(self._instances), 4, 4))
        poses[:, 0] = np.eye(4)
        count = 1 + len(self.objects)
        quaternions = np.where(present[..., None], rows[..., 3:7], (1.0, 0.0, 0.0, 0.0))
        poses[:, 1:count] = transform_from(rows[..., :3], quaternions)
        poses[:, count:] = poses[:, 1:count][:, self._lamped]
        braking = self._braking[chosen][:, self._lamped]
        return WorldInstances(
            things=self._instances,
            poses=poses,
            there=np.concatenate([np.ones((len(chosen), 1), np.bool_), present, braking], axis=1),
            times_us=np.minimum(self.times_us[chosen], self.scene.end_us),
        )

    def _brake(self, going: Flags) -> None:
        """Update which driven vehicles show their brake lamps after a step."""
        if not self._lamped.any():
            return
        now, last = self._now, self._next
        speeds, before = (np.linalg.norm(i.objects[..., 7:], axis=2) for i in (now, last))
        fell = np.where(last.drivers == DRIVES, before - speeds, 0.0)
        slows = (speeds < STANDING) | (fell / (self.spec.dt_us * 1e-6) > BRAKING)
        lit = slows & now.present & (now.drivers == DRIVES) & self._lamped
        self._braking[going] = lit[going]

    def _begin(self, start_us: int | None) -> World:
        """The world at the start of an episode, cached by start time."""
        start = self.scene.start_us if start_us is None else int(start_us)
        if start not in self._begun:
            spec = self.spec.model_copy(update={"start_us": start, "sensors": []})
            self._begun[start] = World(self.scene, self.state, spec)
        return self._begun[start]

    def _place(self, w: int, world: World) -> None:
        now, near = self._now, world.path_point
        now.motions[w] = world.motion.numbers
        now.poses[w] = world.T_world_vehicle
        now.places[w, S], now.places[w, OFFSET], now.places[w, PATH_YAW] = (
            near[0],
            near[1],
            near.yaw,
        )
        now.places[w, PATH_X : PATH_X + 3] = near.position
        now.present[w], now.drivers[w] = False, 0
        agents = world.agents
        for i, subject in enumerate(agents.objects):
            k = self._rows[subject.object_id]
            now.present[w, k] = True
            now.objects[w, k, :3] = agents.positions[i]
            now.objects[w, k, 3:7] = agents.quaternions[i]
            now.objects[w, k, 7:] = agents.velocities[i]
        for object_id, driver in world.traffic.drivers.items():
            k, idm = self._rows[object_id], cast(Idm, driver)
            now.drivers[w, k] = DRIVES if idm.present else LEFT
            now.driving[w, k] = idm.s, idm.offset, idm.speed
        self._braking[w] = [o.object_id in world.lamps for o in self.objects]
        self.start_us[w], self.steps[w], self.horizons[w] = world.t_us, 0, world.horizon
        self.terminated[w] = self.truncated[w] = self.off_road[w] = False
        self.touching[w] = world.contacts.touching
        now.reversing[w], self._attitudes[w] = world.motion.reversing, LEVEL
        self._single[w] = None

    def _move_one_by_one(
        self, kinds: NDArray[np.int8], times_us: Longs, given: Float, after_us: Longs
    ) -> list[SinglePose | None]:
        """Move the egos that the batch kernel does not support, one by one.

        These are egos in or about to enter reverse gear, and egos with single-pose plans. Returns
        the start of the next single-pose plan.
        """
        now, after = self._now, self._next
        after.reversing[:] = now.reversing
        single: list[SinglePose | None] = [None] * self.worlds
        alone = len(after_us) == 1 and self.spec.ego.tracker_version > 1
        if not (alone or can_reverse(self.spec.ego)):
            return single
        apart = now.reversing | (now.motions[:, 3] < 0) | alone
        if self._law != HOLD:
            apart |= may_lead_backwards(given)
        for w in np.flatnonzero(apart & (kinds != STANDS)).tolist():
            motion, t_us = now.motion(w), int(times_us[w])
            controller = self._controller(w, motion, t_us, given[w], after_us)
            active, moved = controller.advance(motion, t_us, self.spec.dt_us)
            after.motions[w], after.reversing[w] = moved.numbers, moved.reversing
            single[w] = active.single
            kinds[w] = MOVED
        return single

    def _checked(self, actions: ArrayLike, plan_us: ArrayLike | None) -> tuple[Float, Longs]:
        given = np.ascontiguousarray(actions, dtype=np.float64)
        if self._law == HOLD:
            if given.shape != (self.worlds, 2) or plan_us is not None:
                raise ValueError(
                    f"actions of {self.worlds} worlds that take commands must be "
                    f"[{self.worlds}, 2] without plan_us, not {list(given.shape)}"
                )
            given = np.concatenate([given, np.zeros((self.worlds, 1))], axis=1)[:, None]
            after_us = np.zeros(0, np.int64)
        else:
            after_us = np.ascontiguousarray([] if plan_us is None else plan_us, np.int64)
            if after_us.ndim != 1 or given.shape != (self.worlds, len(after_us), 3):
                raise ValueError(
                    f"actions of {self.worlds} worlds that take trajectories must be "
                    f"[{self.worlds}, N, 3] with N plan_us, not {list(given.shape)} with "
                    f"{list(after_us.shape)}"
                )
            if not len(after_us) or (np.diff(after_us, prepend=0) <= 0).any():
                raise ValueError(f"plan_us must increase from above 0, not {after_us.tolist()}")
        if not np.isfinite(given).all():
            raise ValueError("actions hold values that are not finite")
        return given, after_us

    def _meet(self, w: int, t_us: int, action: Float, plan_us: Longs) -> tuple[int, int]:
        """New contacts of one world in a step with a possible contact: at-fault ones, and all."""
        found = self._contacts(w, t_us, action, plan_us)
        self.touching[w] = found.touching
        place = self._now.places[w]
        aside = abs(place[OFFSET]) + self._road.ego_size[1] / 2 > self._road.half_widths[1]
        off_lane = bool(place[BEYOND] > 0 or aside)
        at_fault = sum(ego_at_fault(record, off_lane) for record in found.records)
        return at_fault, len(found.begun)

    def _contacts(self, w: int, t_us: int, action: Float, plan_us: Longs) -> EgoContacts:
        """Contacts of one world, by the same functions as a single :class:`.world.World`."""
        before, after = self._next, self._now
        motion = before.motion(w)
        controller = self._controller(w, motion, t_us, action, plan_us)
        start = StepStart(
            motion,
            before.poses[w],
            self._agents(before, w),
            t_us,
            self.spec.dt_us,
            lambda since_us: controller.advance(motion, t_us, since_us)[1],
        )
        contacts = ContactState(self.spec, self.scene.ego_size, None, self.touching[w])
        return contacts.ego_contacts(start, after.poses[w], after.motion(w), self._agents(after, w))

    def _controller(
        self, w: int, motion: Motion, t_us: int, action: Float, plan_us: Longs
    ) -> EgoController:
        plan = self._plan(t_us, action, plan_us)
        before = EgoController(self.spec, self.scene.ego, single=self._single[w])
        return before.with_plan(plan, motion, t_us, t_us)

    def _plan(self, t_us: int, action: Float, plan_us: Longs) -> Control | TrajectoryPlan:
        if self._law == HOLD:
            return Control(acceleration=action[0, 0], steering=action[0, 1])
        times = (t_us + plan_us).tolist()
        poses = [tuple(pose) for pose in action.tolist()]
        return TrajectoryPlan(times_us=times, poses=poses, frame="vehicle")

    def _agents(self, instant: _Instant, w: int) -> Agents:
        there = np.flatnonzero(instant.present[w])
        rows = instant.objects[w, there]
        objects: tuple[ObjectState, ...] = tuple(self.objects[k] for k in there.tolist())
        positions, quaternions = rows[:, :3].copy(), rows[:, 3:7].copy()
        return Agents(
            objects=objects,
            sizes=self._tracks.sizes[there],
            positions=positions,
            quaternions=quaternions,
            velocities=rows[:, 7:].copy(),
            transforms=transform_from(positions, quaternions),
        )
