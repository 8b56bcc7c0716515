"""Reference implementation of the rule-based planners, point by point and agent by agent.

It shares limits and parameters with the planners under test, but no computation.
"""

from __future__ import annotations

import math

import numpy as np

from real2sim.planners.follow_route import Comfort
from real2sim.planners.idm import STEP, Follower

SPACING, REACH = 0.5, 0.25


def follow_route(obs, *, speed: float, delays, comfort: Comfort | None = None) -> np.ndarray:
    """[K, 3] poses of a FollowRoute."""
    comfort = comfort or Comfort()
    arc, points = path_of(obs.route)
    limits = speed_limits(arc, points, speed, comfort)
    for place, forward in obstacles(arc, points, obs, comfort.clearance):
        along = max(forward, 0.0)
        for i in range(len(arc)):
            free = place - comfort.gap - comfort.headway * along - arc[i]
            limits[i] = min(limits[i], math.sqrt(max(along**2 + 2.0 * comfort.braking * free, 0.0)))
    travelled, position, now, v = [], 0.0, 0.0, max(obs.ego.speed, 0.0)
    for delay in delays:
        steps = max(round((delay - now) / 0.05), 1)
        dt = (delay - now) / steps
        for _ in range(steps):
            limit = float(np.interp(position + v * dt, arc, limits))
            following = min(limit, v + comfort.acceleration * dt)
            following = max(following, v - 2.0 * comfort.braking * dt, 0.0)
            position += 0.5 * (v + following) * dt
            v = following
        travelled.append(position)
        now = delay
    return poses(arc, points, travelled, comfort.recovery)


def idm(obs, *, speed: float, delays, follower: Follower | None = None) -> np.ndarray:
    """[K, 3] poses of an Idm."""
    follower, comfort = follower or Follower(), Comfort()
    arc, points = path_of(obs.route)
    limits = speed_limits(arc, points, speed, comfort)
    found = obstacles(arc, points, obs, follower.clearance)
    travelled, position, now, v = [], 0.0, 0.0, max(obs.ego.speed, 0.0)
    for delay in delays:
        while now < delay - 1e-9:
            desired = float(np.interp(position, arc, limits))
            rates = [follower.answer(v, desired, math.inf, 0.0)]
            for place, forward in found:
                along = max(forward, 0.0)
                rates.append(follower.answer(v, desired, place + along * now - position, v - along))
            following = max(v + min(rates) * STEP, 0.0)
            position += 0.5 * (v + following) * STEP
            v, now = following, now + STEP
        travelled.append(position)
    return poses(arc, points, travelled, comfort.recovery)


def path_of(route):
    if len(route) == 0:
        return np.zeros(1), np.zeros((1, 2))
    if len(route) > 1 and (length := float(np.linalg.norm(route[1] - route[0]))) > 0.0:
        ahead = (route[1] - route[0]) / length
        if (before := float(route[0] @ ahead)) > 0.0:
            route = np.concatenate([route[:1] - before * ahead, route])
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(route, axis=0), axis=1))])
    start, best = 0.0, math.inf
    for i in range(len(route) - 1):
        step = route[i + 1] - route[i]
        fraction = min(max(-(route[i] @ step) / max(step @ step, 1e-12), 0.0), 1.0)
        distance = float(np.linalg.norm(route[i] + fraction * step))
        if distance < best:
            start, best = arc[i] + fraction * math.sqrt(max(step @ step, 1e-12)), distance
    samples = start + np.arange(max(int((arc[-1] - start) / SPACING), 0) + 1) * SPACING
    points = np.stack([np.interp(samples, arc, route[:, k]) for k in (0, 1)], axis=1)
    return samples - start, points


def speed_limits(arc, points, cruise, comfort):
    bend = np.zeros(len(points))
    if len(points) > 2:
        slope = np.gradient(points, arc, axis=0)
        heading = np.unwrap(np.arctan2(slope[:, 1], slope[:, 0]))
        smooth = np.convolve(np.pad(heading, 2, mode="edge"), np.ones(5) / 5, mode="valid")
        bend = np.abs(np.gradient(smooth, arc))
    limits = np.minimum(np.sqrt(comfort.lateral / np.maximum(bend, 1e-6)), cruise)
    limits = np.minimum(limits, np.sqrt(2.0 * comfort.braking * (arc[-1] - arc)))
    for i in range(len(limits) - 2, -1, -1):
        reachable = math.sqrt(limits[i + 1] ** 2 + 2.0 * comfort.braking * (arc[i + 1] - arc[i]))
        limits[i] = min(limits[i], reachable)
    return limits


def obstacles(arc, points, obs, clearance):
    """(arc length, speed) of each agent in the corridor, one agent at a time."""
    found = []
    if len(arc) < 2:
        return found
    direction = np.gradient(points, arc, axis=0)
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-9)
    c, s = math.cos(obs.ego.yaw), math.sin(obs.ego.yaw)
    to_vehicle = np.array([[c, s], [-s, c]])
    for agent in obs.agents:
        w, x, y, z = agent.quaternion
        yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)) - obs.ego.yaw
        centre = to_vehicle @ np.subtract(agent.position, obs.ego.position)[:2]
        ahead = np.array([math.cos(yaw), math.sin(yaw)]) * 0.5 * agent.size[0]
        left = np.array([-math.sin(yaw), math.cos(yaw)]) * 0.5 * agent.size[1]
        arcs, aside, along = [], [], []
        for aside_of_centre in (ahead + left, ahead - left, -ahead - left, -ahead + left):
            corner = centre + aside_of_centre
            i = int(np.linalg.norm(corner - points, axis=1).argmin())
            shift = corner - points[i]
            arcs.append(arc[i] + float(direction[i] @ shift))
            aside.append(direction[i, 0] * shift[1] - direction[i, 1] * shift[0])
            along.append(direction[i])
        reach = 0.5 * obs.ego.size[1] + clearance
        if min(aside) < reach and max(aside) > -reach and max(arcs) > 0 and min(arcs) < arc[-1]:
            speed = float(to_vehicle @ np.array(agent.velocity[:2]) @ along[int(np.argmin(arcs))])
            found.append((min(arcs) - 0.75 * obs.ego.size[0], speed))
    return found


def poses(arc, points, travelled, recovery):
    def at(s):
        inside = np.array([np.interp(s, arc, points[:, k]) for k in (0, 1)])
        last = points[-1] - points[-2] if len(points) > 1 else np.array([1.0, 0.0])
        length = float(np.linalg.norm(last))
        last = last / length if length > 1e-9 else np.array([1.0, 0.0])
        fade = (1.0 + s / recovery) * math.exp(-s / recovery)
        return inside + max(s - arc[-1], 0.0) * last - points[0] * fade

    here = np.array([at(s) for s in travelled])
    step = np.array([at(s + REACH) for s in travelled]) - here
    moving = np.linalg.norm(step, axis=1) > 1e-6
    yaw = np.unwrap(np.where(moving, np.arctan2(step[:, 1], step[:, 0]), 0.0))
    return np.concatenate([here, (yaw * (1.0 - np.exp(-np.array(travelled))))[:, None]], axis=1)
