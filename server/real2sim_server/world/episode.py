"""Episodes: reset validation, clock, route beyond the log, and randomization."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from real2sim_proto import ErrorCode
from real2sim_proto.base import Pose
from real2sim_proto.episode import (
    EstimateRandomization,
    IdmDriver,
    ResetSpec,
    SensorSpec,
    StartRandomization,
    TrafficRandomization,
)
from real2sim_proto.operations import Operation, SetStoryboard, Spawn

from ..edit import EditError, ObjectState, ScenarioState
from ..edit.tracks import PackedTracks
from ..geometry import boxes_overlap, yaw_quaternion
from ..scene import Ground, Scene, Trajectory
from .common import Draws, WorldError
from .ego_motion import Motion
from .path import Float, LoggedPath, LoopTransform, PathPoint
from .traffic.driver import desired_speed, highest_speed


@dataclass(frozen=True)
class EpisodeClock:
    """The clock of an episode.

    Attributes:
        start_us: time of step 0 [us].
        dt_us: time step [us].
        horizon: number of steps after which the episode is truncated.
    """

    start_us: int
    dt_us: int
    horizon: int

    def at(self, step: int) -> int:
        """Time of a step [us]."""
        return self.start_us + step * self.dt_us


def episode_clock(scene: Scene, spec: ResetSpec) -> EpisodeClock:
    """The clock of an episode on ``scene``.

    Raises:
        WorldError: TIME_OUT_OF_RANGE if the start or horizon is outside the log; UNKNOWN_CAMERA;
            INVALID_REQUEST if a sensor period is not a multiple of the clock step, a camera is
            listed twice, or a warm-up is combined with a sampled start.
    """
    clock = _clock(scene, spec)
    for sensor in spec.sensors:
        _check_sensor(scene, spec, sensor)
    cameras = [s.camera for s in spec.sensors]
    twice = {c for c in cameras if cameras.count(c) > 1}
    if twice:
        raise WorldError(
            ErrorCode.INVALID_REQUEST,
            f"cameras {sorted(twice)} are listed more than once",
            hint="list a camera once, with all its modalities",
        )
    return clock


def takes_effect_us(
    spec: ResetSpec, clock: EpisodeClock, t_us: int, latency_us: int, *, jitter_us: int = 0
) -> int:
    """Time at which a plan received at ``t_us`` takes effect [us]: after latency and warm-up.

    Args:
        spec: selects the latency model.
        clock: clock of the episode.
        t_us: current time [us].
        latency_us: measured planning time [us].
        jitter_us: sampled delay added to the latency model [us].
    """
    latency = spec.latency
    wait_us = {
        "zero": 0,
        "fixed": latency.fixed_us,
        "measured": min(max(latency_us, 0), latency.longest_us),
    }[latency.model]
    return max(t_us + wait_us + jitter_us, clock.start_us + spec.warmup_us)


def _clock(scene: Scene, spec: ResetSpec) -> EpisodeClock:
    start = scene.start_us if spec.start_us is None else spec.start_us
    latest = scene.end_us - spec.dt_us
    if not scene.start_us <= start <= latest:
        raise WorldError(
            ErrorCode.TIME_OUT_OF_RANGE,
            f"an episode from start_us={start} with steps of {spec.dt_us} us does not fit the log, "
            f"which covers [{scene.start_us}, {scene.end_us}]",
            hint=f"start between {scene.start_us} and {latest}"
            if latest >= scene.start_us
            else f"the log is only {scene.end_us - scene.start_us} us long; take a smaller dt_us",
        )
    longest = (scene.end_us - start) // spec.dt_us
    if spec.warmup_us % spec.dt_us or spec.warmup_us > longest * spec.dt_us:
        raise WorldError(
            ErrorCode.INVALID_REQUEST,
            f"warmup_us {spec.warmup_us} is not a whole number of steps of {spec.dt_us} us within "
            f"the {longest} that are left of the log",
            hint="the warm-up follows the log in clock steps; choose a multiple of dt_us",
        )
    if spec.warmup_us and any(spec.randomization.start.model_dump().values()):
        raise WorldError(
            ErrorCode.INVALID_REQUEST,
            "a warm-up follows the log, but randomization.start moves the start off it",
            hint="leave out one of warmup_us and randomization.start",
        )
    if spec.beyond_log == "end" and spec.horizon is not None and spec.horizon > longest:
        raise WorldError(
            ErrorCode.TIME_OUT_OF_RANGE,
            f"horizon {spec.horizon} is longer than the {longest} steps of {spec.dt_us} us that "
            f"are left of the log after {start}",
            hint=f"ask for {longest} steps at most, leave horizon out, or let beyond_log be "
            "'loop' or 'extend'",
        )
    return EpisodeClock(start, spec.dt_us, spec.horizon or longest)


def _check_sensor(scene: Scene, spec: ResetSpec, sensor: SensorSpec) -> None:
    if sensor.camera not in scene.rig.names:
        raise WorldError(
            ErrorCode.UNKNOWN_CAMERA,
            f"scene {scene.name!r} has no camera {sensor.camera!r}",
            hint=f"cameras of this scene: {', '.join(scene.rig.names)}",
        )
    if sensor.period_us is not None and sensor.period_us % spec.dt_us:
        raise WorldError(
            ErrorCode.INVALID_REQUEST,
            f"period_us {sensor.period_us} of camera {sensor.camera!r} is not a multiple of dt_us "
            f"{spec.dt_us}",
            hint="all sensors show committed instants; choose a period of whole clock steps",
        )


# --- Beyond the log ------------------------------------------------------------------------------

# An episode may outlast the recording (``beyond_log`` of its reset). The route then continues with
# the final curvature of the recorded drive, which decays to zero. With ``loop``, an ego at the end
# of the recorded drive is reset to its start with the same offset and heading error
# (:class:`.path.LoopTransform`). Road users that follow the route move with it; all others stay.

BEND_FROM = 10.0
"""Length at the end of the recorded drive that determines the final curvature [m]."""

SHARPEST_BEND = 0.05
"""Maximum curvature of a continuation [1/m]; larger values are noise or turns at junctions."""

BEND_FADES = 40.0
"""Distance over which the curvature falls to 1/e [m]."""

SPACING, FADED = 2.0, 160.0
"""Spacing of the points of the continuation, and distance after which it is straight [m]."""

MAX_ROUTE = 100_000.0
"""Maximum length of a route [m]."""

MIN_ROUTE_SPEED = 15.0
"""Minimum speed for which an extended route is long enough [m/s]; 1.5 times the highest recorded
speed, if greater."""

MIN_LOOP_LENGTH = 20.0
"""Minimum length of a recorded drive for a loop [m]."""

STANDING = 2.0
"""Maximum distance that a stationary object covers in the recording [m]."""


def driven_route(scene: Scene, spec: ResetSpec, horizon: int) -> LoggedPath:
    """The reference path of an episode: the recorded drive and, if needed, its continuation.

    Raises:
        WorldError: INVALID_REQUEST for a loop on a recorded drive that is not closed.
    """
    recorded = LoggedPath(scene.ego)
    if spec.beyond_log == "end":
        return recorded
    spawn = spec.agents.spawn
    if spec.beyond_log == "loop" and recorded.length < MIN_LOOP_LENGTH:
        raise WorldError(
            ErrorCode.INVALID_REQUEST,
            f"the recorded drive is {recorded.length:.1f} m long, too short to be driven in a loop",
            hint=f"a loop takes {MIN_LOOP_LENGTH:g} m; choose beyond_log 'extend'",
        )
    reach = max(FADED, spawn.ahead + spawn.margin if spawn is not None else 0.0)
    if spec.beyond_log == "extend":
        speed = max(1.5 * highest_speed(scene.ego), MIN_ROUTE_SPEED)
        reach = min(max(horizon * spec.dt_us * 1e-6 * speed, reach), MAX_ROUTE)
    return continued(recorded, reach, scene.ground)


def lanes_route(route: LoggedPath, scene: Scene, spec: ResetSpec) -> LoggedPath:
    """The path that lanes of spawned objects follow; extends beyond the end of ``route``."""
    spawn = spec.agents.spawn
    if spawn is None or spec.beyond_log != "end":
        return route
    return continued(route, max(FADED, spawn.ahead + spawn.margin), scene.ground)


def continued(path: LoggedPath, reach: float, ground: Ground) -> LoggedPath:
    """The path extended by ``reach`` metres along the ground."""
    before = path.at(max(path.length - BEND_FROM, 0.0))[3]
    bend = (float(path.yaws[-1]) - before) / min(BEND_FROM, path.length)
    bend = min(max(bend, -SHARPEST_BEND), SHARPEST_BEND)
    way = SPACING * np.arange(1, round(min(reach, FADED) / SPACING) + 1)
    yaws = path.yaws[-1] + bend * BEND_FADES * (1.0 - np.exp(-way / BEND_FADES))
    # Each piece follows its chord, with the heading at its middle.
    middles = np.concatenate([[path.yaws[-1]], yaws])
    chords = SPACING * np.exp(0.5j * (middles[1:] + middles[:-1]))
    plane = path.positions[-1, 0] + 1j * path.positions[-1, 1] + np.cumsum(chords)
    if reach > FADED:
        plane = np.append(plane, plane[-1] + (reach - FADED) * np.exp(1j * yaws[-1]))
        yaws = np.append(yaws, yaws[-1])
    xy = np.stack([plane.real, plane.imag], axis=1)
    x, y, z = path.positions[-1].tolist()
    above = z - ground.height(x, y)
    places = np.column_stack([xy, ground.height_at(xy) + above])
    return LoggedPath.through(
        np.vstack([path.positions, places]),
        np.concatenate([path.yaws, yaws]),
        np.vstack([path.ups, np.tile([0.0, 0.0, 1.0], (len(places), 1))]),
    )


def at_start_again(motion: Motion, near: PathPoint, route: LoggedPath, s: float) -> Motion:
    """The motion moved to route distance ``s``, with its offset and heading error at ``near``."""
    x, y, _, yaw = route.at(s)
    return motion._replace(
        x=x - near.offset * math.sin(yaw),
        y=y + near.offset * math.cos(yaw),
        yaw=yaw + math.remainder(motion.yaw - near.yaw, math.tau),
    )


# --- objects --------------------------------------------------------------------------------------

Prolonged = dict[Trajectory, Trajectory]
"""Extended trajectories of stationary objects, by original trajectory. Caching keeps their identity
over an episode, because drivers restart with a new trajectory."""


def tracks_beyond_log(
    state: ScenarioState, until_us: int, prolonged: Prolonged, *, left: Iterable[str] = ()
) -> PackedTracks[ObjectState]:
    """Tracks of the objects up to ``until_us`` [us]; stationary objects are always present.

    If boxes of stationary objects overlap (such as two tracks of one parked car), only the longest
    recorded track is extended beyond its recorded time.

    Args:
        state: objects after all edits.
        until_us: end of the episode [us].
        prolonged: cache of extended trajectories of the episode; updated.
        left: ids of objects that have left.
    """
    gone = frozenset(left)
    visible = [o for o in state.visible if o.object_id not in gone]
    kept = _without_doubles([o for o in visible if o.trajectory.extent < STANDING])
    for subject in visible:
        if subject.object_id in kept and subject.trajectory not in prolonged:
            span = (_from_us(subject, state.clock[0]), until_us)
            prolonged.setdefault(subject.trajectory, _prolonged(subject.trajectory, *span))
    return PackedTracks(
        tuple(
            replace(o, trajectory=prolonged[o.trajectory]) if o.object_id in kept else o
            for o in visible
        )
    )


def _from_us(subject: ObjectState, start_us: int) -> int:
    """Time from which an object exists [us]; one placed by an edit exists from the edit on."""
    return subject.trajectory.start_us if subject.edited else start_us


def _without_doubles(standing: list[ObjectState]) -> set[str]:
    longest = sorted(
        standing,
        key=lambda o: (o.trajectory.start_us - o.trajectory.end_us, o.instance_id),
    )
    kept: list[tuple[ObjectState, Float]] = []
    for subject in longest:
        pose = subject.trajectory.transform(subject.trajectory.start_us)
        if not any(
            boxes_overlap(pose, subject.scaled_size, other_pose, other.scaled_size)
            for other, other_pose in kept
        ):
            kept.append((subject, pose))
    return {subject.object_id for subject, _ in kept}


def _prolonged(trajectory: Trajectory, start_us: int, end_us: int) -> Trajectory:
    """The trajectory, holding its first pose from ``start_us`` and its last up to ``end_us``."""
    p, q, times = trajectory.positions, trajectory.quaternions, trajectory.times_us
    if start_us < times[0]:
        p, q = np.vstack([p[:1], p]), np.vstack([q[:1], q])
        times = np.concatenate([[start_us], times])
    if end_us > times[-1]:
        p, q = np.vstack([p, p[-1:]]), np.vstack([q, q[-1:]])
        times = np.concatenate([times, [end_us]])
    return Trajectory(times, p, q)


# --- Route of an episode -------------------------------------------------------------------------


class LoopReset(NamedTuple):
    """The reset of an ego to the start of a loop.

    Attributes:
        laps: number of completed laps.
        way: total length of the completed laps [m].
        motion, point: motion of the ego after the reset, and its route position.
        loop: transform from before to after the reset.
    """

    laps: int
    way: float
    motion: Motion
    point: PathPoint
    loop: LoopTransform


@dataclass(frozen=True, eq=False)
class EpisodeRoute:
    """Route of an episode.

    Attributes:
        route: reference path.
        lap_length: length of one lap [m]; infinite without a loop.
        until_us: time up to which stationary objects persist beyond the log [us]; None if they end
            with the log.
    """

    route: LoggedPath
    lap_length: float
    until_us: int | None
    _prolonged: Prolonged = field(default_factory=dict)

    @classmethod
    def of(cls, scene: Scene, spec: ResetSpec, clock: EpisodeClock) -> EpisodeRoute:
        """The route of an episode on ``scene``.

        Raises:
            WorldError: INVALID_REQUEST for a loop on a recorded drive that is not closed.
        """
        loops = spec.beyond_log == "loop"
        return cls(
            route=driven_route(scene, spec, clock.horizon),
            lap_length=LoggedPath(scene.ego).length if loops else math.inf,
            until_us=None if spec.beyond_log == "end" else clock.at(clock.horizon),
        )

    def tracks(
        self, state: ScenarioState, *, left: Iterable[str] = ()
    ) -> PackedTracks[ObjectState]:
        """Object tracks from the recording and edits, without objects that have ``left``."""
        if self.until_us is None:
            return state.tracks
        return tracks_beyond_log(state, self.until_us, self._prolonged, left=left)

    def looped(self, motion: Motion, point: PathPoint) -> LoopReset | None:
        """The reset of a loop if the ego has reached its end, else None."""
        laps = max(math.floor(point.s / self.lap_length), 0)
        if laps == 0:
            return None
        way = laps * self.lap_length
        again = at_start_again(motion, point, self.route, point.s - way)
        near = self.route.nearest(again.x, again.y, near_s=point.s - way)
        return LoopReset(laps, way, again, near, LoopTransform.between(motion[:3], again[:3]))


# --- Randomization -------------------------------------------------------------------------------

# Every value is sampled (see :class:`.common.Draws`) and reported under a name, such as
# ``start.lateral`` or ``agents.car_3.headway``.

START_ATTEMPTS = 16
"""Attempts to sample a start outside every object before the recorded one is used."""


def randomized_start(
    recorded: Motion,
    path: LoggedPath,
    spec: StartRandomization,
    draws: Draws,
    *,
    is_free: Callable[[Motion], bool],
) -> tuple[Motion, dict[str, float]]:
    """The ego motion at the start of an episode, and the sampled values by name.

    Args:
        recorded: recorded ego motion at that time.
        path: the recorded drive.
        spec: sampling ranges.
        draws: random numbers of the episode.
        is_free: whether the ego in a given motion touches no object.
    """
    widths = {f"start.{name}": width for name, width in spec.model_dump().items() if width}
    if not widths:
        return recorded, {}
    near = path.nearest(recorded.x, recorded.y)
    for attempt in range(START_ATTEMPTS):
        sampled = {name: draws.around(width, name, attempt) for name, width in widths.items()}
        motion = _shifted(recorded, path, near, sampled)
        if is_free(motion):
            sampled["start.speed"] = motion.speed - recorded.speed
            return motion, {name: sampled[name] for name in widths}
    return recorded, dict.fromkeys(widths, 0.0)


def _shifted(
    recorded: Motion, path: LoggedPath, near: PathPoint, sampled: Mapping[str, float]
) -> Motion:
    x, y, _, yaw = path.at(near.s + sampled.get("start.longitudinal", 0.0))
    offset = near.offset + sampled.get("start.lateral", 0.0)
    speed = max(recorded.speed + sampled.get("start.speed", 0.0), 0.0)
    turns = speed / recorded.speed if recorded.speed > 0 else 0.0
    return recorded._replace(
        x=x - offset * math.sin(yaw),
        y=y + offset * math.cos(yaw),
        yaw=yaw + (recorded.yaw - near.yaw) + sampled.get("start.heading", 0.0),
        speed=speed,
        yaw_rate=recorded.yaw_rate * turns,
    )


@dataclass(frozen=True)
class RandomizedIdm:
    """Parameters of IDM drivers, sampled for each object.

    Attributes:
        spec: ranges of the factors.
        draws: random numbers of the episode.
    """

    spec: TrafficRandomization
    draws: Draws
    widths: Mapping[str, float] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        widths = {name: width for name, width in self.spec.model_dump().items() if width}
        object.__setattr__(self, "widths", widths)

    def driver_of(
        self, subject: ObjectState, spec: IdmDriver
    ) -> tuple[IdmDriver, dict[str, float]]:
        """The driver parameters of an object, and the sampled values by name."""
        sampled: dict[str, float] = {}
        for name, width in self.widths.items():
            value = getattr(spec, name)
            if name == "desired_speed":
                value = desired_speed(subject, spec)
            key = f"agents.{subject.object_id}.{name}"
            sampled[key] = value * (1.0 + self.draws.around(width, key))
        named = {key.rpartition(".")[2]: value for key, value in sampled.items()}
        return spec.model_copy(update=named), sampled


class EstimateError(NamedTuple):
    """Error of the ego's state estimate: x [m], y [m], yaw [rad], speed [m/s]."""

    x: float
    y: float
    yaw: float
    speed: float

    def applied(self, motion: Motion) -> Motion:
        """The estimate of a motion."""
        return motion._replace(
            x=motion.x + self.x,
            y=motion.y + self.y,
            yaw=motion.yaw + self.yaw,
            speed=motion.speed + self.speed,
        )


def estimate_error(
    spec: EstimateRandomization,
    draws: Draws,
    step: int,
    *,
    before: EstimateError | None = None,
    dt: float = 0.0,
) -> EstimateError | None:
    """The estimation error at a step; None if the estimate has no errors.

    Args:
        spec: standard deviations.
        draws: random numbers of the episode.
        step: clock step.
        before: error of the previous step.
        dt: time step [s].
    """
    deviations = (spec.position, spec.position, spec.heading, spec.speed)
    if not any(deviations):
        return None
    fresh = draws.normal("estimate", step, count=4)
    if before is None or not spec.correlation:
        return EstimateError(*(d * n for d, n in zip(deviations, fresh, strict=True)))
    kept = math.exp(-dt / spec.correlation)
    new = math.sqrt(1.0 - kept * kept)
    pairs = zip(before, deviations, fresh, strict=True)
    return EstimateError(*(kept * b + new * d * n for b, d, n in pairs))


def latency_jitter_us(longest_us: int, draws: Draws, step: int) -> int:
    """Sampled delay added to the plan latency of a step [us]; 0 without jitter."""
    return int(draws.uniform("latency", step)[0] * (longest_us + 1)) if longest_us else 0


# --- Placement -----------------------------------------------------------------------------------

# Edits of a running episode place road users relative to the ego's route, from the current time.


def placed(
    operation: Operation, route: LoggedPath, s: float, ground: Ground, *, t_us: int
) -> Operation:
    """The operation with absolute times and poses, resolved against the ego's current state.

    Args:
        operation: operation as requested.
        route: route of the ego.
        s: position of the ego along it [m].
        ground: ground of the scene.
        t_us: current time [us].

    Raises:
        EditError: INVALID_OPERATION for a storyboard; it cannot be added to a running episode.
    """
    if isinstance(operation, SetStoryboard):
        raise EditError(
            ErrorCode.INVALID_OPERATION,
            "an episode has its storyboard from its start; it cannot be set while it runs",
            hint="set it of the scenario, or send it with the next reset",
        )
    if not isinstance(operation, Spawn):
        return operation
    known: dict[str, Any] = {}
    if operation.start_us is None:
        known["start_us"] = t_us
    if (place := operation.place) is not None:
        x, y, _, yaw = route.at(s + place.ahead)
        x, y = x - place.offset * math.sin(yaw), y + place.offset * math.cos(yaw)
        w, qx, qy, qz = yaw_quaternion(yaw + math.pi if place.oncoming else yaw).tolist()
        pose = Pose(position=(x, y, ground.height(x, y)), quaternion=(w, qx, qy, qz))
        known |= {"pose": pose, "place": None}
    return operation.model_copy(update=known)
