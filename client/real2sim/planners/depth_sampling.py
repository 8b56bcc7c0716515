"""A planner that samples short drives and checks them against points from depth cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from real2sim_proto.plans import TrajectoryPlan

from .follow_route import Array, Comfort, Path, speed_limits
from .planner import Needs

if TYPE_CHECKING:
    from real2sim_proto.drive import EgoState

    from ..images import Frame
    from ..observation import Observation

DT = 0.2
"""Time between the poses of a drive [s]."""
LANE_CHANGE = 12.0
"""Distance over which an offset is reached [m]."""
REAR = 0.25
"""Fraction of the vehicle's length behind its rear axle."""


@dataclass(frozen=True)
class Lattice:
    """Candidate drives and their costs; SI units.

    Attributes:
        offsets: offsets from the route at the end of the lane change [m].
        accelerations: constant accelerations of the candidates.
        reaction: duration of an acceleration before braking, in the check for a safe stop.
        stopping: braking in that check; a car can brake harder, which leaves a margin.
        margins: free space in front of and on either side of the vehicle [m].
        heights: height range of obstacle points above the road [m].
        cell: side of the squares that group points [m].
        progress: reward per metre driven.
        aside: cost of the squared distance from the route.
        discomfort: cost of the squared longitudinal and lateral acceleration.
        swerve: cost per metre of change from the last chosen offset.
        collision: cost of a collision; grows with speed.
    """

    offsets: tuple[float, ...] = (0.0, -0.6, 0.6, -1.2, 1.2, -1.8, 1.8)
    accelerations: tuple[float, ...] = (1.5, 0.8, 0.0, -1.0, -2.0, -3.5, -5.0, -7.5)
    reaction: float = 0.6
    stopping: float = 5.0
    margins: tuple[float, float] = (1.2, 0.25)
    heights: tuple[float, float] = (0.35, 2.2)
    cell: float = 0.4
    progress: float = 0.3
    aside: float = 0.25
    discomfort: float = 0.02
    swerve: float = 0.2
    collision: float = 100.0


class DepthSampling:
    """A planner that only uses depth images.

    Points above the road in the depth images are treated as static obstacles. A drive is admissible
    if the vehicle can continue on it for a moment and then stop without contact (after the dynamic
    window of Fox, Burgard, Thrun 1997). The planner chooses the admissible drive that is best in
    progress, comfort and nearness to the route. It does not predict motion: behind a car it keeps a
    stopping distance rather than a time gap, and it sees crossing traffic only at its current
    position.

    Examples:
        >>> planner = DepthSampling(speed=6.0)
        >>> with real2sim.connect() as client, client.session(scene="street") as session:
        ...     sensors = planner.needs.sensors(session.welcome.cameras)
        ...     obs = session.reset(sensors=sensors)
        ...     planner.reset(obs)
        ...     obs = session.step(planner.plan(obs))
        >>> obs.step
        1
    """

    needs = Needs(modalities=("depth",), width=160)

    def __init__(
        self,
        speed: float = 8.0,
        *,
        horizon: float = 3.0,
        lattice: Lattice | None = None,
        comfort: Comfort | None = None,
    ) -> None:
        """Create a planner.

        Args:
            speed: cruising speed [m/s].
            horizon: length of a plan [s].
            lattice: drives and their costs; default: ``Lattice()``.
            comfort: limits in bends and along the path; default: ``Comfort()``.
        """
        self.speed = speed
        self.lattice, self.comfort = lattice or Lattice(), comfort or Comfort()
        self._times = np.arange(1, int(horizon / DT + 1e-9) + 1) * DT
        self._offset = 0.0

    def reset(self, obs: Observation) -> None:
        """Forget the last choice."""
        self._offset = 0.0

    def plan(self, obs: Observation) -> TrajectoryPlan:
        """The best drive, in the vehicle frame of ``obs``."""
        lattice, path, speed = self.lattice, Path.along(obs.route), max(obs.ego.speed, 0.0)
        limit = float(speed_limits(path, cruise=self.speed, comfort=self.comfort)[0])
        points = obstacle_points(obs, heights=lattice.heights, cell=lattice.cell)
        best = np.inf
        chosen: tuple[float, Array] = (0.0, np.zeros((len(self._times), 2)))
        for acceleration in lattice.accelerations:
            way = _profile(speed, acceleration, self._times, limit=limit)
            hits = self._hits(path, self._stop(speed, acceleration, limit), points, obs.ego)
            for offset, hit in zip(lattice.offsets, hits, strict=True):
                cost = self._cost(acceleration, offset, way, hit, speed)
                if cost < best:
                    best, chosen = cost, (offset, way)
        self._offset, way = chosen
        (poses,) = _poses(path, way, [self._offset])
        return TrajectoryPlan(
            times_us=[obs.t_us + round(t * 1e6) for t in self._times],
            poses=[tuple(pose) for pose in poses.tolist()],
        )

    def _stop(self, speed: float, acceleration: float, limit: float) -> Array:
        """[K, 2] distance travelled [m] and speed [m/s] while reacting and then braking."""
        lattice = self.lattice
        on = np.arange(DT, lattice.reaction + 1e-9, DT)
        first = _profile(speed, acceleration, on, limit=limit)
        start, left = first[-1]
        braking = max(lattice.stopping, -acceleration)
        after = np.arange(1, int(left / braking / DT) + 2) * DT
        held = _profile(left, -braking, after, limit=np.inf)
        held[:, 0] += start
        return np.concatenate([first, held])

    def _hits(self, path: Path, stop: Array, points: Array, ego: EgoState) -> list[float | None]:
        """By offset: speed [m/s] at the first contact with a point before the stop, or None."""
        if len(points) == 0:
            return [None] * len(self.lattice.offsets)
        poses = _poses(path, stop, self.lattice.offsets)
        inside = _inside(poses, points, ego.size, self.lattice.margins)
        touched: NDArray[np.bool_] = np.any(inside, axis=2)
        return [float(stop[k.argmax(), 1]) if k.any() else None for k in touched]

    def _cost(
        self, acceleration: float, offset: float, way: Array, hit: float | None, speed: float
    ) -> float:
        lattice = self.lattice
        lateral = speed**2 * abs(offset - self._offset) / max(float(way[-1, 0]), 4.0) ** 2
        cost = -lattice.progress * float(way[-1, 0])
        cost += lattice.aside * offset**2 + lattice.swerve * abs(offset - self._offset)
        cost += lattice.discomfort * (acceleration**2 + lateral**2)
        return cost if hit is None else cost + lattice.collision * (1.0 + hit)


def obstacle_points(
    obs: Observation, *, heights: tuple[float, float], cell: float, reach: float = 40.0
) -> Array:
    """[P, 2] float64, x and y in the vehicle frame [m] of points above the road.

    Args:
        obs: observation with depth images.
        heights: lowest and highest above the plane under the vehicle's wheels [m].
        cell: side of the squares that group points; a square needs two of them [m].
        reach: maximum distance ahead and to the side [m].
    """
    clouds = [
        _in_vehicle(frame["depth"], obs.ego) for frame in obs.frames.values() if "depth" in frame
    ]
    if not clouds:
        return np.zeros((0, 2))
    points = np.concatenate(clouds)
    low, high = heights
    near = (np.abs(points[:, :2]) < reach).all(axis=1)
    points = points[near & (points[:, 2] > low) & (points[:, 2] < high)]
    across = int(2 * reach / cell) + 2
    squares = np.floor((points[:, :2] + reach) / cell).astype(np.int64) @ [across, 1]
    kept, count = np.unique(squares, return_counts=True)
    kept = kept[count >= 2]
    found: Array = (np.stack([kept // across, kept % across], axis=1) + 0.5) * cell - reach
    return found


def _in_vehicle(frame: Frame, ego: EgoState) -> Array:
    """Points [P, 3] of a depth image in the vehicle frame [m]."""
    depth: NDArray[np.float32] = frame.array
    v, u = np.nonzero(depth > 0.5)
    z = depth[v, u].astype(np.float64)
    x = (u + 0.5 - frame.K[0, 2]) / frame.K[0, 0] * z
    y = (v + 0.5 - frame.K[1, 2]) / frame.K[1, 1] * z
    world = np.stack([x, y, z], axis=1) @ frame.T_world_sensor[:3, :3].T
    world += frame.T_world_sensor[:3, 3] - np.array(ego.position)
    found: Array = world @ _rotation(ego.quaternion)
    return found


def _rotation(quaternion: tuple[float, float, float, float]) -> Array:
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _profile(speed: float, acceleration: float, times: Array, *, limit: float) -> Array:
    """[K, 2] distance travelled [m] and speed [m/s] at ``times``; speed is in 0 to ``limit``.

    Above the limit the drive brakes at least gently until the limit is reached.
    """
    if speed > limit:
        acceleration, limit = min(acceleration, -1.0), speed
    fine = np.linspace(0.0, times[-1], 10 * len(times) + 1)
    speeds = np.clip(speed + acceleration * fine, 0.0, max(limit, speed))
    travelled = np.concatenate([[0.0], np.cumsum((speeds[1:] + speeds[:-1]) / 2 * np.diff(fine))])
    return np.stack([np.interp(times, fine, travelled), np.interp(times, fine, speeds)], axis=1)


def _poses(path: Path, way: Array, offsets: Sequence[float]) -> Array:
    """[O, K, 3] poses of drives that end at each of the offsets from the route.

    The offset is a cubic of the distance that starts at the vehicle's offset and direction, so a
    drive that is chosen repeatedly is completed.
    """
    middle = np.stack([np.interp(way[:, 0], path.arc, path.points[:, k]) for k in (0, 1)])
    last, beyond = (
        path.points[-1] - path.points[-min(2, len(path.points))],
        way[:, 0] - path.arc[-1],
    )
    length = float(np.linalg.norm(last))
    if length > 0.0:
        middle += np.maximum(beyond, 0.0) * (last / length)[:, None]
    headings = _headings(path)
    heading = np.interp(way[:, 0], path.arc, headings)
    cos, sin = np.cos(headings[0]), np.sin(headings[0])
    aside = float(cos * path.offset[1] - sin * path.offset[0])
    slope = float(np.clip(np.tan(-headings[0]), -1.0, 1.0)) * LANE_CHANGE
    fraction = np.clip(way[:, 0] / LANE_CHANGE, 0.0, 1.0)
    change = np.array(offsets)[:, None] - aside
    square, cube = 3 * change - 2 * slope, slope - 2 * change
    shift = aside + fraction * (slope + fraction * (square + fraction * cube))
    turn = np.where(fraction < 1.0, slope + fraction * (2 * square + fraction * 3 * cube), 0.0)
    x, y = middle[0] - np.sin(heading) * shift, middle[1] + np.cos(heading) * shift
    yaw = heading + np.arctan(turn / LANE_CHANGE)
    return np.stack([x, y, yaw], axis=2)


def _headings(path: Path) -> Array:
    """[N] float64 headings of a path in the vehicle frame [rad]."""
    if len(path.points) < 2:
        return np.zeros(len(path.points))
    along = np.gradient(path.points, path.arc, axis=0)
    found: Array = np.unwrap(np.arctan2(along[:, 1], along[:, 0]))
    return found


def _inside(
    poses: Array, points: Array, size: tuple[float, float, float], margins: tuple[float, float]
) -> NDArray[np.bool_]:
    """[O, K, P] whether each point is inside the vehicle's box, grown by the margins, per pose."""
    d = points - poses[:, :, None, :2]
    c, s = np.cos(poses[..., 2])[..., None], np.sin(poses[..., 2])[..., None]
    along, aside = c * d[..., 0] + s * d[..., 1], c * d[..., 1] - s * d[..., 0]
    ahead = (along > -REAR * size[0]) & (along < (1 - REAR) * size[0] + margins[0])
    found: NDArray[np.bool_] = ahead & (np.abs(aside) < size[1] / 2 + margins[1])
    return found
