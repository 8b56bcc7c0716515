"""Compiled step of many worlds in parallel, built from the functions of a single world."""

# ruff: noqa: PLR0917 - kernels take arrays by position

from __future__ import annotations

import math

import numpy as np
from numba import prange
from numba.np.unsafe.ndarray import to_fixed_tuple

from .._numba import PARALLEL_LOOPS, func, kernel
from ..edit.tracks import poses_at
from ..scene.ground import pose_at
from .boxes import REAR_OVERHANG, first_contacts, heading
from .collision.sweep import COARSE
from .driving import HOLD, PlanarState
from .driving.curve import NO_POSE
from .driving.entries import advance_vehicle, plan_curve, world_poses
from .path import nearest_point, next_in_strip, point_at, sharpest_turn, waypoints
from .scoring.road import off_road
from .traffic.driver import BACK_TO_LANE, MAX_BRAKING, STANDSTILL

# --- Objects -------------------------------------------------------------------------------------

# Recorded objects and objects with IDM drivers. The driver status of an object is NONE while it
# replays the recording, DRIVES, or LEFT after the end of its path. The state of a driver is the
# distance along its path [m], the offset from it [m] and the speed [m/s].

NONE, DRIVES, LEFT = 0, 1, 2


@func
def bodies_of(objects, present, sizes, motion, ego_size):
    """Bodies, laid out as in ``traffic.driver.Surroundings``, and the row of each object, or -1."""
    rows = np.full(len(sizes), -1, np.int64)
    bodies = np.empty((len(sizes) + 1, 7))
    count = 0
    for k in range(len(sizes)):
        if present[k]:
            body = bodies[count]
            body[0], body[1], body[2] = objects[k, 0], objects[k, 1], heading(objects[k, 3:7])
            body[3], body[4] = sizes[k, 0], sizes[k, 1]
            body[5], body[6] = objects[k, 7], objects[k, 8]
            rows[k] = count
            count += 1
    ahead = ego_size[0] / 2 - REAR_OVERHANG
    cos, sin, ego = math.cos(motion[2]), math.sin(motion[2]), bodies[count]
    ego[0], ego[1], ego[2] = motion[0] + ahead * cos, motion[1] + ahead * sin, motion[2]
    ego[3], ego[4] = ego_size[0], ego_size[1]
    ego[5], ego[6] = motion[3] * cos, motion[3] * sin
    return bodies[: count + 1], rows


@func
def advance_objects(
    t_us, dt_us, bodies, rows, tracks, drivers, driving, objects,
    new_drivers, new_driving, new_objects, new_present
):  # fmt: skip
    """Objects ``dt_us`` after ``t_us``: recorded ones first, then those with drivers."""
    end_us = t_us + dt_us
    record_objects(end_us, tracks, new_objects, new_present)
    for k in range(len(drivers)):
        new_drivers[k] = drivers[k]
        new_driving[k] = driving[k]
        if drivers[k] == DRIVES:
            advance_driver(k, dt_us * 1e-6, bodies, rows[k], tracks, new_driving[k], new_objects[k])
            length = tracks.paths[tracks.path_ends[k + 1] - 1, 0]
            new_drivers[k] = DRIVES if new_driving[k, 0] < length else LEFT
            new_present[k] = new_drivers[k] == DRIVES
        elif drivers[k] == LEFT:
            new_objects[k] = objects[k]
            new_present[k] = False
        elif new_present[k] and tracks.driven[k]:
            begin_driver(k, tracks, new_objects[k], new_driving[k])
            new_drivers[k] = DRIVES


@func
def record_objects(t_us, tracks, objects, present):
    """Recorded poses of objects."""
    known, positions, quaternions, velocities, _ = poses_at(
        t_us, tracks.ends, tracks.times, tracks.knots
    )
    present[:] = False
    for i in range(len(known)):
        k = known[i]
        present[k] = True
        objects[k, :3], objects[k, 3:7] = positions[i], quaternions[i]
        objects[k, 7:10] = velocities[i]


@func
def path_of(k, tracks):
    """Knots of the path of an object."""
    return tracks.paths[tracks.path_ends[k] : tracks.path_ends[k + 1]]


@func
def begin_driver(k, tracks, pose, driver):
    """A driver at the current pose of its object, see ``Idm.from_pose``."""
    s, offset, _, yaw, _ = nearest_point(path_of(k, tracks), pose[0], pose[1], math.nan)
    driver[0], driver[1] = s, offset
    driver[2] = max(pose[7] * math.cos(yaw) + pose[8] * math.sin(yaw), 0.0)


@func
def advance_driver(k, dt, bodies, own, tracks, driver, pose):
    """A driver one step later, see ``Idm.advance``."""
    path, idm = path_of(k, tracks), tracks.idm
    headway, gap, most, braking, lateral = idm[0], idm[1], idm[2], idm[3], idm[4]
    s, offset, speed = driver[0], driver[1], driver[2]
    box = (offset, tracks.sizes[k, 0], tracks.sizes[k, 1])
    free, leader_speed = next_in_strip(path, s, box, bodies, own)
    bend = sharpest_turn(path, s, 2.0 * speed)
    desired = min(tracks.desired[k], math.sqrt(lateral / max(bend, 1e-4)))
    wish = 1.0 - (speed / max(desired, STANDSTILL)) ** 4
    if not math.isinf(free):
        dynamic = speed * headway + speed * (speed - leader_speed) / (2 * math.sqrt(most * braking))
        wish -= ((gap + max(0.0, dynamic)) / max(free, 0.1)) ** 2
    acceleration = max(most * wish, -MAX_BRAKING)
    if acceleration < 0 and speed + acceleration * dt <= 0:
        s, speed = s + speed * speed / (-2 * acceleration), 0.0
    else:
        s, speed = s + (speed + acceleration * dt / 2) * dt, speed + acceleration * dt
    later = offset * math.exp(-dt / BACK_TO_LANE)
    drift = (later - offset) / dt
    driver[0], driver[1], driver[2] = s, later, speed
    place_on_path(path, s, speed, later, drift, pose)


@func
def place_on_path(path, s, speed, offset, drift, pose):
    """Write position, quaternion and velocity, see ``traffic.driver.pose_on_path``."""
    x, y, z, yaw = point_at(path, s)
    cos, sin = math.cos(yaw), math.sin(yaw)
    turned = yaw + (math.atan2(drift, speed) if speed > 0.5 else 0.0)
    half = remainder(turned, 2 * math.pi) / 2
    pose[0], pose[1], pose[2] = x - offset * sin, y + offset * cos, z
    pose[3], pose[4], pose[5], pose[6] = math.cos(half), 0.0, 0.0, math.sin(half)
    pose[7], pose[8] = speed * cos - drift * sin, speed * sin + drift * cos
    pose[9] = 0.0


@func
def remainder(value, period):
    """``math.remainder``, which Numba does not support; in [-period / 2, period / 2]."""
    return value - period * np.rint(value / period)


STATE = len(PlanarState._fields)
S, OFFSET, PATH_X, PATH_Y, PATH_Z, PATH_YAW, BEYOND = range(7)
"""Columns of ``places``: position along and lateral offset from the route, its nearest point, and
distance of the worst corner of the ego box off the road [m]."""
PLACES = 7

STANDS, GOES, MOVED = 0, 1, 2
"""Status of a world in a step."""


@kernel(parallel=PARALLEL_LOOPS, nogil=True)
def step_worlds(
    going, times_us, dt_us, law, actions, plan_us, frame_is_vehicle, vehicle, limits, tracks, road,
    motions, poses, places, objects, present, drivers, driving,
    new_motions, new_poses, new_places, new_objects, new_present, new_drivers, new_driving, near,
):  # fmt: skip
    """Move all worlds that are ``going`` by a step.

    Args:
        going: [W] int8: STANDS, GOES, or MOVED if ``new_motions`` already holds the ego's new
            motion.
        times_us: [W] int64, before the step [us].
        dt_us: time step [us].
        law: HOLD for commands, else the tracker of trajectories.
        actions: [W, N, 3] float64 poses of plans; or [W, 1, 3] with acceleration, steering.
        plan_us: [N] int64, times of the poses relative to now [us].
        frame_is_vehicle: whether poses are in the vehicle frame.
        vehicle: the members of VehicleParameters.
        limits: maximum acceleration or braking, maximum steering rate, maximum steering, wheelbase.
        tracks, road: see :mod:`.batch`.
        motions, poses, places: [W, STATE], [W, 4, 4], [W, PLACES], states of the egos.
        objects: [W, K, 10] float64, positions, quaternions, velocities of objects.
        present: [W, K] bool, which of them are in the world.
        drivers: [W, K] int8 and driving: [W, K, 3] float64, see :data:`NONE`.
        new_motions ... new_driving: the same after the step; outputs.
        near: [W] bool, whether the ego may have touched an object within the step; output.
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
    """State of a vehicle ``dt_us`` after it received an action."""
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
    """Place a vehicle on the ground and compute its route and road positions."""
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
    """Conservative test whether the ego may have touched an object within the step.

    The broad phase of ``collision.sweep``: boxes on straight paths, grown by the ego's maximum
    deviation from its own.
    """
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
    """Maximum deviation of the box from a straight path [m], as in ``collision.sweep``."""
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
    """Waypoints [W, N, 2] float32 of all worlds, see :func:`.path.waypoints`."""
    for w in prange(motions.shape[0]):
        pose = (motions[w, 0], motions[w, 1], motions[w, 2])
        found[w] = waypoints(route, places[w, S], pose, found.shape[1], spacing)
