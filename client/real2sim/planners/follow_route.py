"""A planner that follows the route and slows down in bends and behind others."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from real2sim_proto.plans import TrajectoryPlan

from .planner import Needs

if TYPE_CHECKING:
    from real2sim_proto.drive import AgentState, EgoState

    from ..observation import Observation

Array = NDArray[np.floating[Any]]

WINDOW = np.ones(5) / 5
"""Smoothing window of headings, in points of a path."""


@dataclass(frozen=True)
class Comfort:
    """Driving limits of a :class:`FollowRoute`; SI units.

    Attributes:
        lateral: maximum lateral acceleration; sets the speed in bends.
        acceleration, braking: maximum along the route; an obstacle too near may need more.
        gap: bumper-to-bumper distance at standstill [m].
        headway: time gap to a moving lead vehicle [s].
        clearance: free space required on either side of the vehicle [m].
        recovery: distance along the route over which an offset decays [m].
    """

    lateral: float = 2.0
    acceleration: float = 1.5
    braking: float = 2.5
    gap: float = 4.0
    headway: float = 1.0
    clearance: float = 0.4
    recovery: float = 5.0


class FollowRoute:
    """A planner for examples and tests: follows the route within a speed limit at each point.

    It only sees other road users in sessions that are reset with ``privileged=True``.

    Examples:
        >>> planner = FollowRoute(speed=5.0)
        >>> with real2sim.connect() as client, client.session(scene="street") as session:
        ...     obs = session.reset(privileged=True)
        ...     planner.reset(obs)
        ...     obs = session.step(planner.plan(obs))
        >>> obs.step
        1
    """

    needs = Needs(privileged=True)

    def __init__(
        self,
        speed: float = 8.0,
        *,
        horizon: float = 3.0,
        spacing: float = 0.25,
        comfort: Comfort | None = None,
    ) -> None:
        """Create a planner.

        Args:
            speed: cruising speed [m/s].
            horizon: length of a plan [s].
            spacing: time between its poses [s].
            comfort: accelerations and gaps; default: ``Comfort()``.

        Raises:
            ValueError: see :func:`delays_of_poses`.
        """
        self._delays = delays_of_poses(speed=speed, horizon=horizon, spacing=spacing)
        self.speed = speed
        self.comfort = comfort or Comfort()

    def reset(self, obs: Observation) -> None:
        """Nothing is remembered between plans."""

    def plan(self, obs: Observation) -> TrajectoryPlan:
        """Poses over the next seconds in the vehicle frame of ``obs``."""
        path = Path.along(obs.route)
        limits = speed_limits(path, cruise=self.speed, comfort=self.comfort)
        for obstacle in obstacles_on(path, obs.ego, obs.agents, clearance=self.comfort.clearance):
            limits = np.minimum(limits, behind(obstacle, path.arc, self.comfort))
        travelled = drive_profile(
            path.arc, limits, speed=obs.ego.speed, delays=self._delays, comfort=self.comfort
        )
        return TrajectoryPlan(
            times_us=[obs.t_us + round(delay * 1e6) for delay in self._delays],
            poses=[tuple(pose) for pose in path.poses(travelled, self.comfort.recovery).tolist()],
        )


def delays_of_poses(*, speed: float, horizon: float, spacing: float) -> Array:
    """[K] float64 delays of a plan's poses [s].

    Raises:
        ValueError: a speed, horizon or spacing that allows no plan.
    """
    if not (speed > 0 and 0 < spacing <= horizon):
        raise ValueError(
            f"speed {speed!r}, horizon {horizon!r}, spacing {spacing!r}: give a speed "
            "above 0 and a spacing above 0 that fits the horizon"
        )
    delays: Array = np.arange(1, int(horizon / spacing + 1e-9) + 1) * spacing
    return delays


@dataclass(frozen=True)
class Path:
    """The route ahead, as a polyline with arc length.

    Attributes:
        arc: [N] float64, metres from the point of the route nearest to the vehicle; starts at 0,
            evenly spaced.
        points: [N, 2] float64, vehicle frame [m].
        offset: [2] float64, from that nearest point to the vehicle [m].
    """

    arc: Array
    points: Array
    offset: Array

    @classmethod
    def along(cls, route: Array, *, spacing: float = 0.5) -> Path:
        """The route [R, 2] ahead of the vehicle, resampled; one point if the route is empty."""
        if len(route) == 0:
            return cls(np.zeros(1), np.zeros((1, 2)), np.zeros(2))
        route = _from_vehicle_on(route)
        arc = np.zeros(len(route))
        np.cumsum(_lengths(route[1:] - route[:-1]), out=arc[1:])
        start = _nearest_arc(route, arc)
        count = max(int((arc[-1] - start) / spacing), 0) + 1
        samples = start + np.arange(count) * spacing
        points = _interpolated(samples, arc, route)
        return cls(samples - start, points, -points[0])

    def curvature(self) -> Array:
        """[N] float64 unsigned curvature [1/m], over about two metres to suppress noise."""
        if len(self.points) < 3:
            return np.zeros(len(self.points))
        slope = self._slope(self.points)
        heading = _unwrapped(np.arctan2(slope[:, 1], slope[:, 0]))
        ends = [heading[:1]] * 2, [heading[-1:]] * 2
        smooth = np.convolve(np.concatenate([*ends[0], heading, *ends[1]]), WINDOW, mode="valid")
        return np.abs(self._slope(smooth))

    def direction(self) -> Array:
        """[N, 2] float64 unit vectors along the path; requires at least two points."""
        slope = self._slope(self.points)
        unit: Array = slope / np.maximum(_lengths(slope), 1e-9)[:, None]
        return unit

    def poses(self, travelled: Array, recovery: float) -> Array:
        """[K, 3] x [m], y [m], yaw [rad] after the distances ``travelled`` [K]; the offset decays.

        Yaw is the direction of the resulting path, which a car can follow.
        """
        reach = 0.25
        both = self._at(np.concatenate([travelled, travelled + reach]), recovery)
        here, ahead = both[: len(travelled)], both[len(travelled) :]
        direction = ahead - here
        moving = _lengths(direction) > 1e-6
        yaw = np.where(moving, np.arctan2(direction[:, 1], direction[:, 0]), 0.0)
        # A stationary vehicle cannot turn; its heading reaches the path's within a metre or two.
        turned = _unwrapped(yaw) * (1.0 - np.exp(-travelled))
        return np.concatenate([here, turned[:, None]], axis=1)

    def _at(self, travelled: Array, recovery: float) -> Array:
        inside = _interpolated(travelled, self.arc, self.points)
        beyond = np.maximum(travelled - self.arc[-1], 0.0)[:, None] * self._last_direction()
        # Slope 0 at the start: the return to the route begins along it, not across it.
        fade = ((1.0 + travelled / recovery) * np.exp(-travelled / recovery))[:, None]
        points: Array = inside + beyond + self.offset * fade
        return points

    def _last_direction(self) -> Array:
        if len(self.points) < 2:
            return np.array([1.0, 0.0])
        step = self.points[-1] - self.points[-2]
        length = float(np.linalg.norm(step))
        return step / length if length > 1e-9 else np.array([1.0, 0.0])

    def _slope(self, values: Array) -> Array:
        """Derivatives of values [N, ...] along the path, by central differences."""
        spacing = float(self.arc[1] - self.arc[0])
        slope = np.empty_like(values)
        slope[1:-1] = (values[2:] - values[:-2]) / (2.0 * spacing)
        slope[0] = (values[1] - values[0]) / spacing
        slope[-1] = (values[-1] - values[-2]) / spacing
        return slope


class Profile:
    """A function along a path, evaluated at single points: linear between its samples."""

    def __init__(self, arc: Array, values: Array) -> None:
        """The function with ``values`` [N] at increasing ``arc`` [N]; constant beyond both ends."""
        self._arc: list[float] = arc.tolist()
        self._values: list[float] = values.tolist()

    def at(self, where: float) -> float:
        """Value at one arc length."""
        arc, values = self._arc, self._values
        k = bisect_right(arc, where)
        if k == 0:
            return values[0]
        if k == len(arc):
            return values[-1]
        slope = (values[k] - values[k - 1]) / (arc[k] - arc[k - 1])
        return slope * (where - arc[k - 1]) + values[k - 1]


@dataclass(frozen=True)
class Obstacle:
    """An obstacle: its start along the path [m], and its speed along it [m/s]."""

    arc: float
    speed: float


def speed_limits(path: Path, *, cruise: float, comfort: Comfort) -> Array:
    """[N] float64 speed limit along the path [m/s]: cruising, lower in bends, 0 at the end."""
    bend = np.sqrt(comfort.lateral / np.maximum(path.curvature(), 1e-6))
    limits = np.minimum(bend, cruise)
    to_end = path.arc[-1] - path.arc
    limits = np.minimum(limits, np.sqrt(2.0 * comfort.braking * to_end))
    return brake_ahead(path.arc, limits, braking=comfort.braking)


def brake_ahead(arc: Array, limits: Array, *, braking: float) -> Array:
    """Lower the limits until braking can reach each limit from the previous one."""
    # A running minimum of v^2 + 2 b s would lose precision for small limits.
    places: list[float] = arc.tolist()
    lowered: list[float] = limits.tolist()
    for i in range(len(lowered) - 2, -1, -1):
        reachable = math.sqrt(lowered[i + 1] ** 2 + 2.0 * braking * (places[i + 1] - places[i]))
        lowered[i] = min(lowered[i], reachable)
    return np.array(lowered)


def obstacles_on(
    path: Path, ego: EgoState, agents: Sequence[AgentState], *, clearance: float
) -> list[Obstacle]:
    """Agents whose box overlaps the strip that the vehicle sweeps along the path.

    Distances are those of the vehicle's origin at contact with its front.
    """
    if len(path.arc) < 2 or not agents:
        return []
    corners, velocities = _in_vehicle_frame(ego, agents)
    direction = path.direction()
    dx = corners[..., 0, None] - path.points[:, 0]
    dy = corners[..., 1, None] - path.points[:, 1]
    nearest = (dx * dx + dy * dy).argmin(axis=2)
    along, shift = direction[nearest], corners - path.points[nearest]
    arcs = path.arc[nearest] + (along * shift).sum(axis=2)
    aside = along[..., 0] * shift[..., 1] - along[..., 1] * shift[..., 0]
    reach = 0.5 * ego.size[1] + clearance
    in_strip = (aside.min(axis=1) < reach) & (aside.max(axis=1) > -reach)
    first, last = arcs.min(axis=1), arcs.max(axis=1)
    front = 0.75 * ego.size[0]
    return [
        Obstacle(
            float(first[k]) - front,
            float((velocities[k] * along[k, arcs[k].argmin()]).sum()),
        )
        for k in np.flatnonzero(in_strip & (last > 0.0) & (first < path.arc[-1]))
    ]


def behind(obstacle: Obstacle, arc: Array, comfort: Comfort) -> Array:
    """[N] float64 maximum speed that allows stopping or following behind an obstacle [m/s]."""
    speed = max(obstacle.speed, 0.0)
    free = obstacle.arc - comfort.gap - comfort.headway * speed - arc
    limits: Array = np.sqrt(np.maximum(speed**2 + 2.0 * comfort.braking * free, 0.0))
    return limits


def drive_profile(
    arc: Array, limits: Array, *, speed: float, delays: Array, comfort: Comfort
) -> Array:
    """[K] float64 distance travelled after each delay [s], from ``speed``, within limits [m].

    Braking may exceed ``comfort.braking`` if an obstacle is already too near.
    """
    travelled: list[float] = []
    profile, position, now, speed = Profile(arc, limits), 0.0, 0.0, max(speed, 0.0)
    for delay in delays.tolist():
        steps = max(round((delay - now) / 0.05), 1)
        dt = (delay - now) / steps
        for _ in range(steps):
            limit = profile.at(position + speed * dt)
            target = min(limit, speed + comfort.acceleration * dt)
            following = max(target, speed - 2.0 * comfort.braking * dt, 0.0)
            position += 0.5 * (speed + following) * dt
            speed = following
        travelled.append(position)
        now = delay
    return np.array(travelled)


def _from_vehicle_on(route: Array) -> Array:
    """The route [R, 2], extended back to the vehicle if it starts farther ahead."""
    if len(route) < 2 or not (length := float(np.linalg.norm(route[1] - route[0]))) > 0.0:
        return route
    direction = (route[1] - route[0]) / length
    before = float(route[0] @ direction)
    if before <= 0.0:
        return route
    return np.concatenate([route[:1] - before * direction, route])


def _nearest_arc(route: Array, arc: Array) -> float:
    """Arc length of the point of the polyline nearest to the vehicle's origin."""
    if len(route) == 1:
        return 0.0
    begin, step = route[:-1], route[1:] - route[:-1]
    length2 = np.maximum((step**2).sum(axis=1), 1e-12)
    fraction = np.clip(-(begin * step).sum(axis=1) / length2, 0.0, 1.0)
    i = int(_lengths(begin + fraction[:, None] * step).argmin())
    return float(arc[i] + fraction[i] * math.sqrt(length2[i]))


def _in_vehicle_frame(ego: EgoState, agents: Sequence[AgentState]) -> tuple[Array, Array]:
    """Box corners [A, 4, 2] and velocities [A, 2] of agents, vehicle frame."""
    w, x, y, z = np.array([a.quaternion for a in agents]).T
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)) - ego.yaw
    centres = np.array([a.position for a in agents])[:, :2] - np.array(ego.position[:2])
    centres = _turned_back(centres, ego.yaw)
    half = 0.5 * np.array([a.size for a in agents])
    cos, sin = np.cos(yaw), np.sin(yaw)
    ahead = np.stack([cos, sin], axis=1) * half[:, :1]
    left = np.stack([-sin, cos], axis=1) * half[:, 1:2]
    around = np.stack([ahead + left, ahead - left, -ahead - left, -ahead + left], axis=1)
    velocities = _turned_back(np.array([a.velocity for a in agents])[:, :2], ego.yaw)
    return centres[:, None] + around, velocities


def _turned_back(vectors: Array, yaw: float) -> Array:
    """Rotate world vectors [A, 2] into axes at heading ``yaw`` [rad]."""
    c, s = math.cos(yaw), math.sin(yaw)
    x, y = vectors[:, 0], vectors[:, 1]
    return np.stack([c * x + s * y, c * y - s * x], axis=1)


def _interpolated(where: Array, arc: Array, points: Array) -> Array:
    """[K, 2] points of a polyline with points [N, 2] at arc lengths [N], clamped to its ends."""
    return np.stack([np.interp(where, arc, points[:, k]) for k in (0, 1)], axis=1)


def _lengths(vectors: Array) -> Array:
    """[N] lengths of vectors [N, 2]."""
    x, y = vectors[:, 0], vectors[:, 1]
    lengths: Array = np.sqrt(x * x + y * y)
    return lengths


def _unwrapped(angles: Array) -> Array:
    """Angles [N] without jumps of a full turn [rad]."""
    steps = np.abs(angles[1:] - angles[:-1])
    return np.unwrap(angles) if len(steps) and steps.max() > math.pi else angles
