"""Start of private actions: each one assigns a motion controller to its entity."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from real2sim_proto import ErrorCode
from real2sim_proto.episode import IdmDriver
from real2sim_proto.storyboard_actions import (
    AcquirePositionAction,
    AssignRouteAction,
    ControllerAction,
    Dynamics,
    FollowTrajectoryAction,
    LaneChangeAction,
    LaneOffsetAction,
    LateralDistanceAction,
    LightStateAction,
    LongitudinalDistanceAction,
    RandomRouteAction,
    SpeedAction,
    SpeedLimits,
    SpeedProfileAction,
    SynchronizeAction,
    TeleportAction,
    VisibilityAction,
)

from ..common import WorldError, copy_with
from .motion import (
    FollowIdm,
    FollowOffset,
    FollowSpeed,
    HoldOffset,
    KeepAside,
    KeepDistance,
    OffsetChange,
    SpeedChange,
    SpeedCourse,
    Synchronize,
    duration,
    duration_at,
    gentle_duration,
    offset_of,
    speed_duration,
)
from .roads import Place, RoadPoint, Trajectory, Way, course_of, path_through
from .view import EntityState, PositionResolver, View, across, distance_ahead

DEFAULT_DESIRED_SPEED = 3.0
"""Desired speed of an entity at rest when its controller is activated [m/s]."""


@dataclass(frozen=True, eq=False)
class Beginning:
    """Inputs of an action at its start.

    Attributes:
        view: current instant.
        places: resolves positions at that instant.
        token: token of the action.
    """

    view: View
    places: PositionResolver
    token: int


def begun(actor: EntityState, action: Any, at: Beginning) -> EntityState:
    """The entity with a started action; instantaneous actions are already finished.

    Raises:
        WorldError: INVALID_REQUEST for an unreachable position, lane or shape.
    """
    return _BEGIN[type(action)](actor, action, at)


def _done(actor: EntityState, at: Beginning, **changes: Any) -> EntityState:
    return copy_with(actor, finished=actor.finished | {at.token}, **changes)


def _dynamics(dynamics: Dynamics) -> Dynamics:
    """Dynamics with a positive rate: some files use negative rates for braking."""
    if dynamics.dimension != "rate":
        return dynamics
    return dynamics.model_copy(update={"value": abs(float(dynamics.value))})


def _freed(actor: EntityState) -> EntityState:
    """Replace a timed trajectory by its path, along which the entity keeps its own speed."""
    if actor.trajectory is None or actor.trajectory.timing is None:
        return actor
    course = actor.trajectory.course
    places = [Place(float(x), float(y), 0.0) for x, y in zip(course.x, course.y, strict=True)]
    if actor.trajectory.sense < 0.0:
        places.reverse()
    way = Way("trajectory", 1, True, path_through(places))
    return copy_with(actor, trajectory=None).on_way(way)


def _on_lane(actor: EntityState, at: Beginning) -> EntityState:
    """Drop the trajectory and continue on the current lane."""
    if actor.trajectory is None:
        return actor
    return copy_with(actor, trajectory=None).on_lane(at.view.network)


def _speed(actor: EntityState, action: SpeedAction, at: Beginning) -> EntityState:
    actor = _freed(actor)
    value, dynamics = float(action.speed), _dynamics(action.dynamics)
    follow = None
    if action.relative_to is not None:
        follow = FollowSpeed(
            at.token, action.relative_to, action.relation, value, dynamics, actor.speed,
            action.continuous,
        )  # fmt: skip
        value = follow.wanted(at.view)
    limits = actor.performance
    if limits.speed is not None:
        value = min(max(value, -float(limits.speed)), float(limits.speed))
    seconds = speed_duration(dynamics, actor.speed, value)
    if follow is not None and (action.continuous or seconds > 0.0):
        return copy_with(actor, speed=actor.speed if seconds > 0.0 else value, longitudinal=follow)
    most = limits.acceleration if value > actor.speed else limits.deceleration
    if seconds > 0.0 and most is not None:
        seconds = max(seconds, duration_at(dynamics.shape, value - actor.speed, float(most)))
    if seconds <= 0.0:
        return _done(actor, at, speed=value, longitudinal=None)
    change = SpeedChange(at.token, dynamics.shape, actor.speed, value, seconds)
    return copy_with(actor, longitudinal=change)


def _speed_profile(actor: EntityState, action: SpeedProfileAction, at: Beginning) -> EntityState:
    actor = _freed(actor)
    base = at.view.entities[action.relative_to].speed if action.relative_to is not None else 0.0
    points, time = [(0.0, actor.speed)], 0.0
    for point in action.points:
        time += max(float(point.time), 0.0)
        points.append((time, base + float(point.speed)))
    if time <= 0.0:
        return _done(actor, at, speed=points[-1][1], longitudinal=None)
    return copy_with(actor, longitudinal=SpeedCourse(at.token, tuple(points)))


def _longitudinal_distance(
    actor: EntityState, action: LongitudinalDistanceAction, at: Beginning
) -> EntityState:
    actor = _freed(actor)
    other = at.view.entities[action.entity]
    ahead = distance_ahead(actor, other.x, other.y, at.view.network)
    leading = ahead < 0.0 if action.place == "any" else action.place == "leading"
    limits = _within(action.limits, actor.performance)
    keep = KeepDistance(at.token, action.model_copy(update={"limits": limits}), leading)
    if limits == SpeedLimits() and actor.trajectory is None:
        # Without limits it is there at once, also in the init actions.
        actor = copy_with(actor, s=actor.s + keep.error(actor, at.view)).placed()
        if not action.continuous:
            return _done(actor, at, longitudinal=None)
    return copy_with(actor, longitudinal=keep)


def _within(limits: SpeedLimits, performance: SpeedLimits) -> SpeedLimits:
    """Limits of an action, if it has any, within the performance of its entity."""
    if limits == SpeedLimits():
        return limits
    given, most = limits.model_dump(), performance.model_dump()
    return SpeedLimits(**{
        name: min((v for v in (given[name], most[name]) if v is not None), default=None)
        for name in given
    })  # fmt: skip


def _synchronize(actor: EntityState, action: SynchronizeAction, at: Beginning) -> EntityState:
    actor = _freed(actor)
    final = None if action.final_speed is None else float(action.final_speed)
    tolerances = (float(action.master_tolerance), float(action.tolerance))
    steady = float(action.steady_distance or 0.0), float(action.steady_time or 0.0)
    there, own = at.places.of(action.master_target), at.places.of(action.target)
    control = Synchronize(
        at.token,
        action.master,
        there,
        own,
        final,
        action.relative,
        tolerances,
        steady,
        action.limits,
    )
    return copy_with(actor, longitudinal=control)


def _where(actor: EntityState, at: Beginning, what: str) -> RoadPoint:
    here = at.view.network.locate(actor.x, actor.y, actor.h)
    if here is None:
        raise WorldError(
            ErrorCode.INVALID_REQUEST,
            f"{actor.name!r} is on no lane and cannot begin a {what}",
            hint="place it on a lane; storyboard.roads gives their number",
        )
    return here


def _lane_change(actor: EntityState, action: LaneChangeAction, at: Beginning) -> EntityState:
    actor, network = _on_lane(actor, at), at.view.network
    here = _where(actor, at, "lane change")
    along = math.cos(actor.h - here.h) >= 0.0
    lane = int(action.lane)
    if action.relative_to is not None:
        other = at.view.entities[action.relative_to]
        base = _where(other, at, "lane change relative to it")
        sense = 1 if math.cos(other.h - base.h) >= 0.0 else -1
        lane = network.neighbour(base.road, base.lane, base.s, lane * sense)
    end = float(action.offset) * (1.0 if along else -1.0)
    if actor.follows_route:
        end += _offset_of_lane(actor, here, lane, at)
    else:
        actor = actor.on_way(network.way(here.road, lane, here.s, along=along))
    dynamics, change = _dynamics(action.dynamics), end - actor.offset
    by_way = dynamics.dimension == "distance" and dynamics.shape != "step"
    extent = float(dynamics.value) if by_way else duration(dynamics, change)
    return _shifted(actor, dynamics.shape, end, extent, at, by_way=by_way)


def _lane_offset(actor: EntityState, action: LaneOffsetAction, at: Beginning) -> EntityState:
    actor, network = _on_lane(actor, at), at.view.network
    base, here = 0.0, network.locate(actor.x, actor.y, actor.h)
    if here is not None and actor.follows_route:
        base = _offset_of_lane(actor, here, here.lane, at)
    else:
        # From now on, offsets of an entity off the road refer to the centre of its lane.
        actor = actor.on_lane(network)
    value, acceleration = base + float(action.offset), action.acceleration
    if action.relative_to is not None:
        left = float(action.offset)
        if action.continuous and acceleration is None:
            return copy_with(actor, lateral=FollowOffset(at.token, action.relative_to, left))
        value = offset_of(at.view.entities[action.relative_to], actor, at.view, left)
    if action.continuous and acceleration is None:
        return copy_with(actor, lateral=HoldOffset(at.token, value))
    most = None if acceleration is None else float(acceleration)
    extent = gentle_duration(action.shape, value - actor.offset, most)
    return _shifted(actor, action.shape, value, extent, at, beside=True)


def _offset_of_lane(actor: EntityState, here: RoadPoint, lane: int, at: Beginning) -> float:
    """Offset from an entity's path of the centre of a lane of its road [m]."""
    network = at.view.network
    centre = network.place(here.road, here.s, network.middle(here.road, lane, here.s))
    assert actor.way is not None
    yaw = actor.way.path.at(actor.s)[3]
    return actor.offset + across(yaw, centre.x - actor.x, centre.y - actor.y)


def _shifted(
    actor: EntityState,
    shape: Any,
    end: float,
    extent: float,
    at: Beginning,
    *,
    by_way: bool = False,
    beside: bool = False,
) -> EntityState:
    if extent <= 0.0:
        return _done(copy_with(actor, lateral=None, offset=end, drift=0.0).placed(), at)
    change = OffsetChange(at.token, shape, actor.offset, end, extent, by_way, beside)
    return copy_with(actor, lateral=change)


def _lateral_distance(
    actor: EntityState, action: LateralDistanceAction, at: Beginning
) -> EntityState:
    actor, other = _on_lane(actor, at), at.view.entities[action.entity]
    side = {"left": 1.0, "right": -1.0}.get(action.side, 0.0)
    if not side:
        side = math.copysign(1.0, across(other.h, actor.x - other.x, actor.y - other.y))
    return copy_with(actor, lateral=KeepAside(at.token, action, side))


def _follow_trajectory(
    actor: EntityState, action: FollowTrajectoryAction, at: Beginning
) -> EntityState:
    backwards = action.timing is None and actor.speed < 0.0
    here = Place(actor.x, actor.y, actor.h)
    course = course_of(action.curve, at.places.of, here=here, backwards=backwards)
    timing, s = action.timing, float(action.offset)
    if timing is not None and course.times is None:
        raise WorldError(
            ErrorCode.INVALID_REQUEST,
            f"trajectory {action.name!r} is to be followed by its times and has none",
            hint="give times to its vertices, or leave out `timing`",
        )
    elapsed = 0.0
    if timing is not None and timing.domain == "absolute":
        elapsed = at.view.elapsed
    elif timing is not None and s > 0.0 and float(timing.scale) > 0.0:
        # It starts at the time of its offset.
        elapsed = (course.time_at(s) - float(timing.offset)) / float(timing.scale)
    following = Trajectory(at.token, course, timing, s, elapsed, course.sense(s))
    longitudinal = actor.longitudinal if timing is None else None
    actor = copy_with(
        actor, trajectory=following, lateral=None, longitudinal=longitudinal, drift=0.0
    )
    if not following.begun():
        return actor
    if timing is not None:
        time = elapsed * float(timing.scale) + float(timing.offset)
        following = replace(following, s=course.distance_at(time))
        actor = copy_with(actor, trajectory=following)
    place = following.place()
    return copy_with(actor, x=place.x, y=place.y, h=place.h)


def _assign_route(actor: EntityState, action: AssignRouteAction, at: Beginning) -> EntityState:
    path = at.view.network.route([at.places.of(w) for w in action.route.waypoints])
    route = Way("route", 1, True, path)
    takes = actor.heads_along(path)
    return _done(actor.on_route(route) if takes else copy_with(actor, route=route), at)


def _random_route(actor: EntityState, action: RandomRouteAction, at: Beginning) -> EntityState:
    way = at.view.network.random_way(Place(actor.x, actor.y, actor.h), actor.name)
    if way is not None:
        return _done(actor.on_route(way), at)
    off_lanes = copy_with(actor, route=None, trajectory=None, lateral=None)
    return _done(off_lanes.on_lane(at.view.network), at)


def _acquire_position(
    actor: EntityState, action: AcquirePositionAction, at: Beginning
) -> EntityState:
    here = Place(actor.x, actor.y, actor.h)
    path = at.view.network.route([here, at.places.of(action.position)])
    moved = actor.on_route(Way("route", 1, True, path))
    return copy_with(moved, lateral=OffsetChange(
        at.token, "linear", moved.offset, moved.offset, max(path.length - moved.s, 1e-6), True
    ))  # fmt: skip


def _teleport(actor: EntityState, action: TeleportAction, at: Beginning) -> EntityState:
    put = actor.put(at.places.of(action.position), at.view.network)
    return _done(put, at, lateral=None)


def _visibility(actor: EntityState, action: VisibilityAction, at: Beginning) -> EntityState:
    return _done(actor, at, visible=action.visible)


def _light_state(actor: EntityState, action: LightStateAction, at: Beginning) -> EntityState:
    return _done(actor, at, lights={**actor.lights, action.lamp: (action, at.view.elapsed)})


def _controller(actor: EntityState, action: ControllerAction, at: Beginning) -> EntityState:
    actor = _freed(actor)
    if not action.active:
        return _done(actor, at, longitudinal=None)
    desired = action.idm.desired_speed
    desired = max(actor.speed, DEFAULT_DESIRED_SPEED) if desired is None else desired
    return _done(actor, at, longitudinal=FollowIdm(at.token, _idm(action), desired))


def _idm(action: ControllerAction) -> IdmDriver:
    return IdmDriver(path="route", **action.idm.model_dump())


_BEGIN: Mapping[type[Any], Callable[[EntityState, Any, Beginning], EntityState]] = {
    SpeedAction: _speed,
    SpeedProfileAction: _speed_profile,
    LaneChangeAction: _lane_change,
    LaneOffsetAction: _lane_offset,
    LateralDistanceAction: _lateral_distance,
    LongitudinalDistanceAction: _longitudinal_distance,
    SynchronizeAction: _synchronize,
    FollowTrajectoryAction: _follow_trajectory,
    AssignRouteAction: _assign_route,
    RandomRouteAction: _random_route,
    AcquirePositionAction: _acquire_position,
    TeleportAction: _teleport,
    VisibilityAction: _visibility,
    LightStateAction: _light_state,
    ControllerAction: _controller,
}
