"""Objects of one world of a batch: the recorded ones, and those that IDM drives.

A driver is a number for each object: NONE, while its place is recorded; DRIVES; LEFT, when it has
come to the end of its path. Its state is where it is along its path, its offset from it [m] and its
speed [m/s].
"""

# Kernels take arrays by position, and Numba knows neither dataclasses nor keyword-only ones.
# ruff: noqa: PLR0917

from __future__ import annotations

import math

import numpy as np

from ..._numba import func
from ...edit.track_kernels import poses_at
from ..boxes import REAR_OVERHANG, heading
from ..path import nearest_point, next_in_strip, point_at, sharpest_turn
from ..traffic.idm import BACK_TO_LANE, HARDEST, STANDSTILL

NONE, DRIVES, LEFT = 0, 1, 2


@func
def bodies_of(objects, present, sizes, motion, ego_size):
    """Bodies as ``traffic.driver.Surroundings`` has them, and the row of each object, or -1."""
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
    """Objects ``dt_us`` after ``t_us``: recorded ones, then those with drivers."""
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
    """Objects as they are recorded."""
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
    """A driver from where its object is, see ``Idm.from_pose``."""
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
    acceleration = max(most * wish, -HARDEST)
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
    """``math.remainder``, which compiled code does not know: between minus and plus half."""
    return value - period * np.rint(value / period)
