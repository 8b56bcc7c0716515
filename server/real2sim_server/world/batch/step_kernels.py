"""A step of many worlds, each on one core, by the functions that step a single one."""

# Kernels take arrays by position, and Numba knows neither dataclasses nor keyword-only ones.
# ruff: noqa: PLR0917

from __future__ import annotations

import math

import numpy as np
from numba import prange
from numba.np.unsafe.ndarray import to_fixed_tuple

from ..._numba import PARALLEL_LOOPS, func, kernel
from ...scene.ground_kernels import pose_at
from ..boxes import REAR_OVERHANG, first_contacts
from ..collision.sweep import COARSE
from ..driving import HOLD, PlanarState
from ..driving.curve import NO_POSE
from ..driving.entries import advance_vehicle, plan_curve, world_poses
from ..path import nearest_point, waypoints
from ..scoring.road import off_road
from .traffic_kernels import advance_objects, bodies_of, remainder

STATE = len(PlanarState._fields)
S, OFFSET, PATH_X, PATH_Y, PATH_Z, PATH_YAW, BEYOND = range(7)
"""Columns of ``places``: along and beside the route, the nearest point of it, and how far the worst
corner of the ego box is off the road [m]."""
PLACES = 7

STANDS, GOES, MOVED = 0, 1, 2
"""What becomes of a world in a step."""


@kernel(parallel=PARALLEL_LOOPS, nogil=True)
def step_worlds(
    going, times_us, dt_us, law, actions, plan_us, frame_is_vehicle, vehicle, limits, tracks, road,
    motions, poses, places, objects, present, drivers, driving,
    new_motions, new_poses, new_places, new_objects, new_present, new_drivers, new_driving, near,
):  # fmt: skip
    """Move all worlds that are ``going`` by a step.

    Args:
        going: [W] int8: STANDS, GOES, or MOVED where the ego's new motion is in ``new_motions``
            already.
        times_us: [W] int64, before the step [us].
        dt_us: of the step [us].
        law: HOLD for commands, else the tracker of trajectories.
        actions: [W, N, 3] float64: poses of plans; or [W, 1, 3] with acceleration, steering.
        plan_us: [N] int64, times of the poses after now [us].
        frame_is_vehicle: whether poses are those of the vehicle's frame.
        vehicle: the members of VehicleParameters.
        limits: acceleration or braking at most, steering rate, steering and wheelbase.
        tracks, road: see :mod:`.tables`.
        motions, poses, places: [W, STATE], [W, 4, 4], [W, PLACES], of the egos.
        objects: [W, K, 10] float64, positions, quaternions, velocities of objects.
        present: [W, K] bool, which of them are in the world.
        drivers: [W, K] int8 and driving: [W, K, 3] float64, see :mod:`.traffic_kernels`.
        new_motions ... new_driving: the same after the step, written.
        near: [W] bool, written: whether the ego may have met an object within the step.
    """
    for w in prange(going.shape[0]):
        if going[w]:
            step_world(
                times_us[w], dt_us, law, actions[w], plan_us, frame_is_vehicle, vehicle, tracks,
                road, motions[w], places[w], objects[w], present[w], drivers[w], driving[w],
                going[w] == MOVED,
                new_motions[w], new_poses[w], new_places[w], new_objects[w], new_present[w],
                new_drivers[w], new_driving[w],
            )  # fmt: skip
            near[w] = may_meet(
                motions[w], poses[w], new_motions[w], new_poses[w], dt_us * 1e-6, limits,
                road.ego_size, objects[w], present[w], new_objects[w], new_present[w],
                tracks.sizes,
            )  # fmt: skip
        else:
            near[w] = False
            new_motions[w] = motions[w]
            new_poses[w] = poses[w]
            new_places[w] = places[w]
            new_objects[w] = objects[w]
            new_present[w] = present[w]
            new_drivers[w] = drivers[w]
            new_driving[w] = driving[w]


@func
def step_world(
    t_us, dt_us, law, action, plan_us, frame_is_vehicle, vehicle, tracks, road,
    motion, place, objects, present, drivers, driving, is_moved,
    new_motion, new_pose, new_place, new_objects, new_present, new_drivers, new_driving,
):  # fmt: skip
    """Move one world: objects, then the ego."""
    bodies, rows = bodies_of(objects, present, tracks.sizes, motion, road.ego_size)
    advance_objects(
        t_us, dt_us, bodies, rows, tracks, drivers, driving, objects,
        new_drivers, new_driving, new_objects, new_present,
    )  # fmt: skip
    if not is_moved:
        state = to_fixed_tuple(motion, STATE)
        moved = advanced(state, t_us, dt_us, law, action, plan_us, frame_is_vehicle, vehicle)
        for k in range(STATE):
            new_motion[k] = moved[k]
    new_motion[4] = (new_motion[3] - motion[3]) / (dt_us * 1e-6)
    stand(new_motion, new_pose, place[S], new_place, road)


@func
def advanced(state, t_us, dt_us, law, action, plan_us, frame_is_vehicle, vehicle):
    """State of a vehicle ``dt_us`` after it got an action."""
    pending = np.empty((0, 2))
    nothing = np.empty((0, 0))
    schedule = nothing, nothing, nothing, nothing
    if law == HOLD:
        held = (action[0, 0], action[0, 1])
        arguments = (law, np.empty((0, 6)), 0.0, 0.0, held, schedule)
        return advance_vehicle(state, pending, arguments, vehicle, dt_us)[0]
    places = world_poses(action, (state[0], state[1], state[2])) if frame_is_vehicle else action
    knots, turn_rate = plan_curve(state, t_us, (t_us + plan_us, places, NO_POSE), vehicle)
    arguments = (law, knots, turn_rate, 0.0, (0.0, 0.0), schedule)
    return advance_vehicle(state, pending, arguments, vehicle, dt_us)[0]


@func
def stand(motion, pose, near_s, place, road):
    """Put a vehicle onto the ground and look where it is along the route and on the road."""
    x, y, yaw = motion[0], motion[1], motion[2]
    pose[:, :] = pose_at(road.heights, road.frame, x, y, yaw)
    s, offset, point, path_yaw, _ = nearest_point(road.route, x, y, near_s)
    place[S], place[OFFSET], place[PATH_YAW] = s, offset, path_yaw
    place[PATH_X], place[PATH_Y], place[PATH_Z] = point
    ahead = road.ego_size[0] / 2 - REAR_OVERHANG
    middle = (x + ahead * math.cos(yaw), y + ahead * math.sin(yaw), yaw)
    size, half_widths = road.ego_size, road.half_widths
    beyond, _ = off_road(
        middle,
        (size[0], size[1], size[2]),
        (road.line_points, road.line_ends),
        (road.lane_points, road.lane_ends),
        (half_widths[0], half_widths[1]),
    )
    place[BEYOND] = beyond


@func
def may_meet(
    motion, pose, new_motion, new_pose, dt, limits, size, objects, present, new_objects,
    new_present, sizes
):  # fmt: skip
    """Whether the ego may have touched an object within the step: the first look of
    ``collision.sweep``, at the boxes on a straight way, grown by how far the ego may have been
    beside it."""
    slack = deviation(motion, new_motion, dt, limits, size)
    ahead = size[0] / 2 - REAR_OVERHANG
    turned = motion[2] + remainder(new_motion[2] - motion[2], 2 * math.pi)
    way = np.empty((2, 5))
    way[0, 0], way[1, 0] = 0.0, 1.0
    way[0, 1], way[0, 2] = (
        motion[0] + ahead * math.cos(motion[2]),
        motion[1] + ahead * math.sin(motion[2]),
    )
    way[1, 1], way[1, 2] = (
        new_motion[0] + ahead * math.cos(turned),
        new_motion[1] + ahead * math.sin(turned),
    )
    way[0, 3], way[1, 3] = motion[2], turned
    way[0, 4] = pose[2, 3] + ahead * pose[2, 0]
    way[1, 4] = new_pose[2, 3] + ahead * new_pose[2, 0]
    count = 0
    kept = np.empty(len(sizes), np.int64)
    rows = np.empty(len(sizes), np.int64)
    for k in range(len(sizes)):
        if new_present[k]:
            kept[count] = k
            rows[count] = k if present[k] else -1
            count += 1
    after = new_objects[kept[:count]]
    first, _ = first_contacts(
        way,
        (size[0], size[1], size[2]),
        rows[:count],
        (objects[:, :3], objects[:, 3:7]),
        (after[:, :3], after[:, 3:7]),
        sizes[kept[:count]],
        slack,
        COARSE,
    )
    return np.isfinite(first).any()


@func
def deviation(motion, new_motion, dt, limits, size):
    """How far the box may have been from a straight way [m], as ``collision.sweep`` has it."""
    hardest, steer_rate, most_steering, wheelbase = limits
    fastest = max(math.hypot(motion[3], motion[7]), math.hypot(new_motion[3], new_motion[7]))
    fastest += hardest * dt / 2
    chord = math.hypot(new_motion[0] - motion[0], new_motion[1] - motion[1])
    aside = math.sqrt(max((fastest * dt) ** 2 - chord * chord, 0.0)) / 2
    steering = max(abs(motion[5]), abs(new_motion[5])) + steer_rate * dt / 2
    curvature = math.tan(min(steering, most_steering)) / wheelbase
    rate = max(abs(motion[6]), abs(new_motion[6]), curvature * fastest)
    return aside + math.hypot(size[0], size[1]) / 2 * min(rate * dt, 2.0)


@kernel(parallel=PARALLEL_LOOPS, nogil=True)
def routes_ahead(route, motions, places, spacing, found):
    """Waypoints [W, N, 2] float32 of all worlds, see :func:`..path_kernels.waypoints`."""
    for w in prange(motions.shape[0]):
        pose = (motions[w, 0], motions[w, 1], motions[w, 2])
        found[w] = waypoints(route, places[w, S], pose, found.shape[1], spacing)
