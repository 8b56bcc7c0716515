"""Clusters of LiDAR points above the ground, and their association into tracks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from ..geometry import Float, apply_transform
from .driving_log import LidarSweep

# --- Ground of a sweep ---------------------------------------------------------------------------

# Tracking runs before a scene has a ground, on single sweeps in the vehicle frame, and only needs
# the points above the ground. A scene's ground is `real2sim_server.scene.Ground`.

GROUND_CELL = 1.0
WINDOW = 7
"""Window size in cells; wider than any vehicle, so that no roof counts as road."""

GROUND_PERCENTILE = 10.0
"""Percentile of heights in a cell that counts as its ground height; lower points are noise."""


@dataclass(frozen=True, eq=False)
class SweepGround:
    """Heights of the ground on a grid around the vehicle.

    Attributes:
        heights: [N, N] z [m] in the vehicle frame, cell by cell of size GROUND_CELL.
        reach: half the side of the grid [m].
    """

    heights: Float
    reach: float

    def at(self, places: Float) -> Float:
        """Height of the ground [m] below positions [..., >= 2], bilinear between cells."""
        cells = (places[..., :2] + self.reach) / GROUND_CELL - 0.5
        rows, columns = cells[..., 0].ravel(), cells[..., 1].ravel()
        found = ndimage.map_coordinates(self.heights, [rows, columns], order=1, mode="nearest")
        return np.asarray(found).reshape(places.shape[:-1])


def find_sweep_ground(points: Float, reach: float) -> SweepGround:
    """The ground under points [N, 3] in the vehicle frame, within ``reach`` [m].

    The lowest points of each cell, opened (a minimum, then a maximum over a window), which removes
    everything above the ground that is narrower than the window, then smoothed.
    """
    side = int(np.ceil(2 * reach / GROUND_CELL))
    cells = np.floor((points[:, :2] + reach) / GROUND_CELL).astype(int)
    inside = ((cells >= 0) & (cells < side)).all(axis=1)
    index = cells[inside, 0] * side + cells[inside, 1]
    lowest = _lowest(points[inside, 2], index, side * side).reshape(side, side)
    filled = _fill(lowest)
    opened = ndimage.grey_opening(filled, size=(WINDOW, WINDOW), mode="nearest")
    return SweepGround(ndimage.uniform_filter(opened, 3, mode="nearest"), side * GROUND_CELL / 2)


def _lowest(heights: Float, index: NDArray[np.intp], cells: int) -> Float:
    order = np.lexsort((heights, index))
    index, heights = index[order], heights[order]
    used, starts, counts = np.unique(index, return_index=True, return_counts=True)
    lowest = np.full(cells, np.nan)
    lowest[used] = heights[starts + (counts * GROUND_PERCENTILE / 100).astype(int)]
    return lowest


def _fill(heights: Float) -> Float:
    """Empty cells get the height of the nearest known one."""
    empty = np.isnan(heights)
    if empty.all():
        return np.zeros_like(heights)
    nearest = ndimage.distance_transform_edt(empty, return_distances=False, return_indices=True)
    return np.asarray(heights[tuple(nearest)])


CELL = 0.35
HEIGHTS = (0.25, 4.2)
"""Height range above the ground of points that are used [m]; excludes kerbs and bridges."""

EGO_MARGIN = 0.6
MIN_POINTS = 6
MAX_EXTENT = 20.0
MAX_BOTTOM = 1.2
MIN_TOP = 0.5


@dataclass(frozen=True, eq=False)
class LidarCluster:
    """Points of one object in one sweep.

    Attributes:
        points: [N, 3] world [m].
        offset: [N] time of measurement relative to the frame [s].
        centre: [2] centre of the points' extent, world frame [m].
        ground: height of the ground below, world z [m].
        sensor: [3] position of the LiDAR, world frame [m].
    """

    points: Float
    offset: Float
    centre: Float
    ground: float
    sensor: Float


def find_clusters(
    sweep: LidarSweep,
    T_world_vehicle: Float,
    *,
    reach: float,
    ego_size: tuple[float, float, float],
) -> list[LidarCluster]:
    """Objects on the ground within ``reach`` [m] of the vehicle.

    Points in the same or adjacent cells of a horizontal grid form a cluster. Clusters are dropped
    if they are too long, have too few points, or are too flat or too far above the ground for a
    vehicle or person.
    """
    points = sweep.points.astype(np.float64)
    near = (np.abs(points[:, :2]) < reach).all(axis=1) & ~_on_ego(points, ego_size)
    points, offset = points[near], sweep.offset_us[near].astype(np.float64) * 1e-6
    ground = find_sweep_ground(points, reach)
    below = ground.at(points)
    above = points[:, 2] - below
    standing = (above > HEIGHTS[0]) & (above < HEIGHTS[1])
    points, offset, below = points[standing], offset[standing], below[standing]
    sensor = apply_transform(T_world_vehicle, sweep.origin.astype(np.float64)[None])[0]
    world = apply_transform(T_world_vehicle, points)
    lift = world[:, 2] - points[:, 2]
    clusters: list[LidarCluster] = []
    for members in _groups(points, reach):
        bottom, top = np.percentile(points[members, 2] - below[members], [2, 98])
        extent = np.ptp(points[members, :2], axis=0)
        if np.hypot(*extent) > MAX_EXTENT or bottom > MAX_BOTTOM or top < MIN_TOP:
            continue
        low, high = world[members, :2].min(axis=0), world[members, :2].max(axis=0)
        clusters.append(
            LidarCluster(
                points=world[members],
                offset=offset[members],
                centre=(low + high) / 2,
                ground=float(np.median(below[members] + lift[members])),
                sensor=sensor,
            )
        )
    return clusters


def _on_ego(points: Float, size: tuple[float, float, float]) -> NDArray[np.bool_]:
    """Mask of points on the recording vehicle itself; its rear axle is at the origin."""
    length, width, _ = size
    along = (points[:, 0] > -0.35 * length - EGO_MARGIN) & (points[:, 0] < 0.85 * length)
    return np.asarray(along & (np.abs(points[:, 1]) < width / 2 + EGO_MARGIN / 2))


def _groups(points: Float, reach: float) -> list[NDArray[np.intp]]:
    """Indices of the points of every group of at least MIN_POINTS."""
    if not len(points):
        return []
    cells = np.floor((points[:, :2] + reach) / CELL).astype(int)
    side = int(np.ceil(2 * reach / CELL)) + 1
    occupied = np.zeros((side, side), dtype=bool)
    occupied[cells[:, 0], cells[:, 1]] = True
    labels, _ = ndimage.label(occupied, np.ones((3, 3), int))
    mine = labels[cells[:, 0], cells[:, 1]]
    order = np.argsort(mine, kind="stable")
    _, starts = np.unique(mine[order], return_index=True)
    groups = np.split(order, starts[1:])
    return [g for g in groups if len(g) >= MIN_POINTS]


# --- Free space ----------------------------------------------------------------------------------

# Distinguishes free space from occluded space.

BEAM = 0.013
"""Maximum angle to a beam at which it observes a direction [rad]."""

NEIGHBOURS = 4
SAME_RANGE = 0.4
"""Maximum distance between the end of a beam and a point on the same surface [m]."""

MIN_RANGE = 1.0


@dataclass(frozen=True, eq=False)
class SweepRays:
    """Rays of one sweep: from ``sensor`` [3] to ``points`` [N, 3], world [m]."""

    points: NDArray[np.float32]
    sensor: Float

    @cached_property
    def _beams(self) -> tuple[cKDTree, Float]:
        """Directions as a tree, and ranges; built on first use."""
        rays = self.points - self.sensor
        ranges = np.linalg.norm(rays, axis=1)
        seen = ranges > MIN_RANGE
        return cKDTree(rays[seen] / ranges[seen, None]), ranges[seen]

    def count(self, points: Float) -> tuple[int, int]:
        """Number of points [N, 3] in the world that are observed free, and observed occupied.

        A beam that passes a point observes free space, one that ends at the point observes it
        occupied, and one that ends before it observes nothing.
        """
        tree, ranges = self._beams
        rays = points - self.sensor
        distance = np.linalg.norm(rays, axis=1)
        near = distance > MIN_RANGE
        if not near.any() or len(ranges) < NEIGHBOURS:
            return 0, 0
        rays, distance = rays[near] / distance[near, None], distance[near]
        apart, index = tree.query(rays, k=NEIGHBOURS, distance_upper_bound=BEAM)
        known = np.isfinite(apart)
        found = np.where(known, ranges[np.minimum(index, len(ranges) - 1)], np.nan)
        beyond = found - distance[:, None]
        occupied = (np.abs(beyond) < SAME_RANGE).any(axis=1)
        # NaN compares false: points without a beam are neither.
        passed = (beyond > SAME_RANGE).sum(axis=1)
        free = ~occupied & (passed > 0) & (passed == known.sum(axis=1))
        return int(free.sum()), int(occupied.sum())


# --- Motion --------------------------------------------------------------------------------------

# Nearly constant velocity in the plane. Sources: Rauch, Tung, Striebel 1965 for the smoother; white
# acceleration noise as in Bar-Shalom et al., "Estimation with Applications to Tracking and
# Navigation", 2001, chapter 6.

ACCELERATION = 2.5
"""Standard deviation of accelerations [m/s^2]."""

INITIAL_SPEED = 12.0
"""Standard deviation of the speed of a new track [m/s]."""

OBSERVATION = np.array([[1.0, 0, 0, 0], [0, 1.0, 0, 0]])


@dataclass(frozen=True, eq=False)
class KalmanState:
    """Mean [4] (x, y, vx, vy) and covariance [4, 4]."""

    mean: Float
    covariance: Float

    @classmethod
    def first(cls, position: Float, deviation: float) -> KalmanState:
        """A state at a measured ``position`` [2] with unknown velocity."""
        variances = [deviation**2] * 2 + [INITIAL_SPEED**2] * 2
        return cls(np.array([*position, 0.0, 0.0]), np.diag(variances))

    def predict(self, seconds: float) -> KalmanState:
        """The state after ``seconds``."""
        transition = _transition(seconds)
        noise = _process_noise(seconds)
        return KalmanState(
            transition @ self.mean, transition @ self.covariance @ transition.T + noise
        )

    def distance(self, position: Float, deviation: float) -> float:
        """Mahalanobis distance of a measured position [2]."""
        residual = position - self.mean[:2]
        innovation_covariance = self.covariance[:2, :2] + deviation**2 * np.eye(2)
        return float(np.sqrt(residual @ np.linalg.solve(innovation_covariance, residual)))

    def update(self, position: Float, deviation: float) -> KalmanState:
        """Update with a measured position [2] with a standard deviation [m]."""
        innovation_covariance = (
            OBSERVATION @ self.covariance @ OBSERVATION.T + deviation** 2 * np.eye(2)
        )
        gain = np.linalg.solve(innovation_covariance, OBSERVATION @ self.covariance).T
        keep = np.eye(4) - gain @ OBSERVATION
        mean = self.mean + gain @ (position - OBSERVATION @ self.mean)
        covariance = keep @ self.covariance @ keep.T + deviation**2 * gain @ gain.T
        return KalmanState(mean, covariance)


def smooth(times: Float, positions: Sequence[Float | None], deviation: float) -> Float:
    """States [T, 4] at ``times`` [T] [s] from measured positions, None for missing ones.

    Forward Kalman filter and backward pass; the first position must be known.
    """
    assert positions[0] is not None
    state = KalmanState.first(positions[0], deviation).update(positions[0], deviation)
    filtered, predicted = [state], [state]
    for i in range(1, len(times)):
        predicted_state = state.predict(times[i] - times[i - 1])
        position = positions[i]
        state = predicted_state if position is None else predicted_state.update(position, deviation)
        predicted.append(predicted_state)
        filtered.append(state)
    means = [filtered[-1].mean]
    for i in range(len(times) - 2, -1, -1):
        transition = _transition(times[i + 1] - times[i])
        gain = np.linalg.solve(predicted[i + 1].covariance, transition @ filtered[i].covariance).T
        means.append(filtered[i].mean + gain @ (means[-1] - predicted[i + 1].mean))
    return np.array(means[::-1])


def _transition(seconds: float) -> Float:
    transition = np.eye(4)
    transition[0, 2] = transition[1, 3] = seconds
    return transition


def _process_noise(seconds: float) -> Float:
    t = seconds
    block = np.array([[t**4 / 4, t**3 / 2], [t**3 / 2, t**2]]) * ACCELERATION**2
    noise = np.zeros((4, 4))
    noise[np.ix_([0, 2], [0, 2])] = noise[np.ix_([1, 3], [1, 3])] = block
    return noise


DEVIATION = 0.5
"""Standard deviation of a cluster's centre between frames [m]: its visible part changes."""

MAHALANOBIS_GATE = 3.5
"""Maximum Mahalanobis distance of a match."""

DISTANCE_GATE = 3.0
"""Maximum distance of a match [m]."""

GATED_COST = 1e6


@dataclass(eq=False)
class Track:
    """Clusters of one object, by frame."""

    state: KalmanState
    clusters: dict[int, LidarCluster] = field(default_factory=dict)

    @property
    def first(self) -> int:
        """First frame."""
        return min(self.clusters)

    @property
    def last(self) -> int:
        """Last frame."""
        return max(self.clusters)


def associate(
    scans: Sequence[Sequence[LidarCluster]], times: Float, *, max_missed: int
) -> list[Track]:
    """Tracks through all frames. A track ends after ``max_missed`` frames without a cluster."""
    alive: list[Track] = []
    ended: list[Track] = []
    for frame, scan in enumerate(scans):
        if frame:
            for track in alive:
                track.state = track.state.predict(times[frame] - times[frame - 1])
        unassigned = _match(alive, scan, frame)
        ended += [t for t in alive if frame - t.last > max_missed]
        alive = [t for t in alive if frame - t.last <= max_missed]
        for index in unassigned:
            cluster = scan[index]
            state = KalmanState.first(cluster.centre, DEVIATION)
            alive.append(Track(state, {frame: cluster}))
    return ended + alive


def _match(tracks: Sequence[Track], clusters: Sequence[LidarCluster], frame: int) -> list[int]:
    """Assign clusters to tracks (Hungarian method); returns the unassigned indices."""
    if not tracks or not clusters:
        return list(range(len(clusters)))
    centres = np.array([c.centre for c in clusters])
    costs = np.full((len(tracks), len(clusters)), GATED_COST)
    for row, track in enumerate(tracks):
        apart = np.linalg.norm(centres - track.state.mean[:2], axis=1)
        for column in np.flatnonzero(apart < DISTANCE_GATE).tolist():
            distance = track.state.distance(centres[column], DEVIATION)
            if distance < MAHALANOBIS_GATE:
                costs[row, column] = apart[column] + _extent_change(track, clusters[column])
    taken = set()
    for row, column in np.transpose(linear_sum_assignment(costs)).tolist():
        if costs[row, column] < GATED_COST:
            track, cluster = tracks[row], clusters[column]
            track.state = track.state.update(cluster.centre, DEVIATION)
            track.clusters[frame] = cluster
            taken.add(column)
    return [i for i in range(len(clusters)) if i not in taken]


def _extent_change(track: Track, cluster: LidarCluster) -> float:
    """Change of the extent [m]; distinguishes adjacent objects."""
    latest = track.clusters[track.last]
    one = np.ptp(latest.points[:, :2], axis=0)
    two = np.ptp(cluster.points[:, :2], axis=0)
    return 0.3 * float(np.abs(one - two).sum())


# --- Boxes ---------------------------------------------------------------------------------------

# A box of one size is fitted to all clusters of an object.

BOX_DEVIATION = 0.15
"""Standard deviation of the centre of a fitted box [m]."""

MIN_HEADING_SPEED = 0.7
"""Minimum speed at which the direction of motion determines the heading [m/s]."""

EXTENT_PERCENTILE = 80.0
"""Percentile of extents that is used as the size; the largest may include a neighbour."""


TYPICAL_LENGTHS = ((1.85, 4.4), (2.5, 5.1), (np.inf, 6.5))
"""Typical lengths of vehicles up to a height: cars, vans, lorries [m]."""


@dataclass(frozen=True, eq=False)
class FittedBox:
    """A box over time.

    Attributes:
        frames: [T] int, first to last without gaps.
        centres: [T, 3] world [m].
        headings: [T] [rad].
        velocities: [T, 2] world [m/s].
        size: (length, width, height) [m].
        residual: root mean square deviation of the measured centres [m].
    """

    frames: NDArray[np.intp]
    centres: Float
    headings: Float
    velocities: Float
    size: tuple[float, float, float]
    residual: float

    @property
    def category(self) -> str:
        """Category according to the size."""
        length, width, height = self.size
        if length > 6.5 or height > 2.7:
            return "truck"
        if length < 1.3 and width < 1.2:
            return "pedestrian"
        if width < 1.1 and length < 2.6:
            return "cyclist"
        return "van" if height > 1.85 else "car"


def fit_box(clusters: Mapping[int, LidarCluster], times: Float) -> FittedBox:
    """A box of the observed size over all frames, with a smooth path and headings along it.

    A scanner sees only the near sides (an L from above), so these determine the position of the
    box: along each of its axes the near face is at the first points, and the far face follows from
    the size. A car seen only from behind gets a typical length.

    Args:
        clusters: by frame, in the world.
        times: times of all frames of the log [s].
    """
    frames = np.arange(min(clusters), max(clusters) + 1)
    rough = [clusters[f].centre if f in clusters else None for f in frames.tolist()]
    states = smooth(times[frames], rough, 3 * BOX_DEVIATION)
    size: tuple[float, float, float] = 0.0, 0.0, 0.0
    positions: list[Float | None] = []
    for _ in range(2):
        headings = _headings(states)
        faces = {
            f: _faces(clusters[f], headings[i], states[i, 2:])
            for i, f in enumerate(frames.tolist())
            if f in clusters
        }
        size = _size(clusters, faces)
        positions = [
            _anchor_box(faces[f], clusters[f], headings[i], size) if f in faces else None
            for i, f in enumerate(frames.tolist())
        ]
        states = smooth(times[frames], positions, BOX_DEVIATION)
    grounds = np.interp(frames, list(clusters), [c.ground for c in clusters.values()])
    centres = np.column_stack([states[:, :2], _running_mean(grounds) + size[2] / 2])
    apart = [
        np.sum((p - s[:2]) ** 2) for p, s in zip(positions, states, strict=True) if p is not None
    ]
    residual = float(np.sqrt(np.mean(apart)))
    return FittedBox(frames, centres, _headings(states), states[:, 2:], size, residual)


def _headings(states: Float) -> Float:
    """Direction of motion [T]; at standstill, the direction at the nearest time with motion."""
    velocity = states[:, 2:]
    fast = np.flatnonzero(np.linalg.norm(velocity, axis=1) > MIN_HEADING_SPEED)
    if not len(fast):
        displacement = states[-1, :2] - states[0, :2]
        return np.full(len(states), np.arctan2(displacement[1], displacement[0]))
    nearest = fast[np.abs(np.arange(len(states))[:, None] - fast).argmin(axis=1)]
    angles = np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0])[nearest])
    return _running_mean(angles)


def _running_mean(values: Float, reach: int = 3) -> Float:
    """Running mean over up to 2 reach + 1 values."""
    padded = np.pad(values, reach, mode="edge")
    return np.convolve(padded, np.full(2 * reach + 1, 1 / (2 * reach + 1)), mode="valid")


def _faces(cluster: LidarCluster, heading: float, velocity: Float) -> Float:
    """Limits of the points [2, 2] (axis; low, high) along and across the heading.

    Points measured earlier or later than the frame are moved with the object.
    """
    flat = cluster.points[:, :2] - cluster.offset[:, None] * velocity
    local = flat @ _axes(heading).T
    return np.percentile(local, [0.5, 99.5], axis=0).T


def _axes(heading: float) -> Float:
    """Rows: forward, left."""
    cos, sin = np.cos(heading), np.sin(heading)
    return np.array([[cos, sin], [-sin, cos]])


def _size(
    clusters: Mapping[int, LidarCluster], faces: Mapping[int, Float]
) -> tuple[float, float, float]:
    extents = np.array([np.ptp(f, axis=1) for f in faces.values()])
    length, width = np.percentile(extents, EXTENT_PERCENTILE, axis=0)
    tops = [np.percentile(c.points[:, 2], 99) - c.ground for c in clusters.values()]
    height = float(np.percentile(tops, EXTENT_PERCENTILE))
    # A vehicle seen from one end or one side only is completed by typical sizes.
    if width > 1.2 and length < 3.6:
        length = next(typical for top, typical in TYPICAL_LENGTHS if height < top)
    elif length > 2.6 and width < 1.5:
        width = 1.8 if height < 2.5 else 2.4
    return float(max(length, 0.5)), float(max(width, 0.5)), max(height, 0.5)


def _anchor_box(
    faces: Float, cluster: LidarCluster, heading: float, size: tuple[float, float, float]
) -> Float:
    """Centre [2] of a box with its near faces at the first points."""
    axes = _axes(heading)
    sensor = axes @ cluster.sensor[:2]
    middle = np.empty(2)
    for axis in (0, 1):
        low, high = faces[axis]
        if sensor[axis] < low:
            middle[axis] = low + size[axis] / 2
        elif sensor[axis] > high:
            middle[axis] = high - size[axis] / 2
        else:
            middle[axis] = (low + high) / 2
    return np.asarray(middle @ axes)
