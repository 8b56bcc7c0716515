"""Recorded sweeps as rays, and the beam table of a spinning sensor."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from real2sim_proto.sensors import MAX_RAYS

from ...geometry import Float, apply_transform, invert_transform, wrapped
from ...logs import DrivingLog
from ...render.cast.call import transforms_at
from ...scene import Beams, Detection, Lidar

# Rays of recorded sweeps: origin, direction and time.

FAR = 250.0
"""Recorded points beyond this range are dropped [m]."""
DETECTS_ALL = Detection(range_m=2000.0, reflectivity=1e-6)
"""Assumed maximum range: the sensor's limit is unknown, so the scene determines lost beams."""


@dataclass(frozen=True, eq=False)
class RecordedRays:
    """The rays of a sweep that returned.

    Attributes:
        lidar: a table of these rays.
        range: [R] float64 [m].
        intensity: [R] float32.
        points: [R, 3] float64, measured positions in the world [m].
    """

    lidar: Lidar
    range: Float
    intensity: NDArray[np.float32]
    points: Float

    def select(self, kept: NDArray[np.bool_]) -> RecordedRays:
        """The rays selected by a mask, in order."""
        beams = self.lidar.beams
        chosen = Beams(beams.azimuth[kept], beams.elevation[kept], beams.time_us[kept])
        lidar = replace(self.lidar, beams=chosen)
        return RecordedRays(lidar, self.range[kept], self.intensity[kept], self.points[kept])


def recorded_rays(log: DrivingLog, frame: int) -> RecordedRays | None:
    """The rays of the sweep of ``frame``; None if it is empty.

    Logs compensate sweeps for the vehicle's motion to the frame's time stamp. This function undoes
    the compensation, so that each ray starts at the sensor's position when it was fired.

    Raises:
        LogError: the sweep cannot be read.
    """
    sweep, t_us = log.lidar(frame), int(log.frame_times_us[frame])
    if len(sweep.points) == 0:
        return None
    world = apply_transform(log.ego.transform(t_us), sweep.points)
    instants, index = np.unique(sweep.offset_us, return_inverse=True)
    sensor = transforms_at(log.ego, t_us + instants.astype(np.float64)) @ _shift(sweep.origin)
    to_sensor = invert_transform(sensor)[index]
    local = apply_transform(to_sensor, world[:, None])[:, 0]
    distance = np.linalg.norm(local, axis=1)
    kept = np.flatnonzero((distance > 0.1) & (distance < FAR) & np.isfinite(distance))
    if len(kept) == 0:
        return None
    kept = kept[:: -(-len(kept) // MAX_RAYS)]
    x, y, z = local[kept].T
    beams = Beams(
        np.arctan2(y, x), np.arctan2(z, np.hypot(x, y)), sweep.offset_us[kept].astype(np.float64)
    )
    lidar = Lidar(
        name=f"recorded {log.name} {frame}",
        beams=beams,
        T_vehicle_lidar=_shift(sweep.origin),
        min_range=0.1,
        max_range=FAR,
        detection=DETECTS_ALL,
    )
    return RecordedRays(lidar, distance[kept], sweep.intensity[kept], world[kept])


def _shift(origin: NDArray[np.float32]) -> Float:
    pose = np.eye(4)
    pose[:3, 3] = origin
    return pose


# The beam table, estimated from raw scans.
#
# Scans of some data sets list ring after ring, each starting at the same azimuth, so a drop in
# azimuth starts a new ring. The sensor may be tilted on its vehicle: the rays of a ring form a cone
# about the sensor's axis, the direction of least scatter about the mean. The laser origins differ
# in height, so a ring is the line z = offset + slope rho.

RING_STEP = np.pi
"""Minimum drop in azimuth that starts a ring [rad]."""
MIN_RING = 50
"""Minimum number of points of a ring."""
ROUNDS = 5
"""Rounds of dropping outliers of a ring and refitting."""
HEIGHT_STEP = 0.05
"""Lasers with a smaller height difference have the same origin [m]."""
MIN_STEP = 1e-4
"""Minimum azimuth step of a rotating sensor [rad]."""
NOT_ONE = np.radians(0.35)
"""Maximum scatter of the elevations of a ring [rad]. Scans with more are not ordered by ring."""


@dataclass(frozen=True, eq=False)
class Rings:
    """A fitted beam table.

    Attributes:
        elevation: [B] of each ring, in scan order [rad].
        offset: [B] of each ring's origin above the sensor's [m].
        residual: root mean square of the points' elevation error about their ring, seen from the
        ring's origin [rad], without the worst 5 %.
        ring: [R] int32, of each ray; -1 for rays without a ring.
        columns: azimuth steps per turn.
        clockwise: whether the sensor rotates clockwise seen from above.
        T_vehicle_lidar: [4, 4], rotated so that z is the axis.
        azimuth, height: [R] of each ray about that axis, and of its ring [rad].
    """

    elevation: Float
    offset: Float
    residual: float
    ring: NDArray[np.int32]
    columns: int
    clockwise: bool
    T_vehicle_lidar: Float
    azimuth: Float
    height: Float

    def beams(self, rays: RecordedRays) -> Beams:
        """The grid of rings by columns; each column has the time of ``rays`` at its azimuth."""
        slope, start = _turn(self.azimuth, rays.lidar.beams.time_us)
        azimuth = wrapped(-np.pi + 2 * np.pi * (np.arange(self.columns) + 0.5) / self.columns)
        order = np.argsort(wrapped(azimuth - start) * np.sign(slope), kind="stable")
        azimuth = azimuth[order]
        time_us = wrapped(azimuth - start) / slope
        shape = (len(self.elevation), self.columns)
        return Beams(
            np.broadcast_to(azimuth, shape),
            np.broadcast_to(self.elevation[:, None], shape),
            np.broadcast_to(time_us, shape),
        )

    def missing(self, rays: RecordedRays) -> list[Lidar]:
        """Rays of the sweep that were fired but did not return.

        A ring fires at uniform azimuth steps, so gaps between its returns give the number of lost
        rays. Returns one LiDAR for each height of the laser origins.
        """
        heights = np.round(self.offset / HEIGHT_STEP).astype(int)
        slope, start = _turn(self.azimuth, rays.lidar.beams.time_us)
        found = []
        for height in np.unique(heights):
            rings = np.flatnonzero(heights == height)
            lost = [_gaps(self.azimuth[self.ring == ring]) for ring in rings]
            azimuth = wrapped(np.concatenate(lost))
            if len(azimuth) == 0:
                continue
            pose = self.T_vehicle_lidar.copy()
            pose[:3, 3] += pose[:3, 2] * self.offset[rings].mean()
            elevation = np.repeat(self.elevation[rings], list(map(len, lost)))
            beams = Beams(azimuth, elevation, wrapped(azimuth - start) / slope)
            found.append(replace(rays.lidar, beams=beams, T_vehicle_lidar=pose))
        return found


def _gaps(azimuth: Float) -> Float:
    """Azimuths of the lost rays of a ring, in firing order, at uniform steps."""
    turned = np.unwrap(azimuth)
    closed = np.append(turned, turned[0] + 2 * np.pi * np.sign(turned[-1] - turned[0]))
    away = np.diff(closed)
    step = np.median(np.abs(away))
    step = np.median(np.abs(away)[np.abs(away) < 1.5 * step])
    if not step > MIN_STEP:
        return np.zeros(0)
    lost = np.maximum(np.rint(np.abs(away) / step).astype(int) - 1, 0)
    count = np.arange(lost.sum()) - np.repeat(np.cumsum(lost) - lost, lost)
    share = (count + 1) / np.repeat(lost + 1, lost)
    between: Float = np.repeat(turned, lost) + share * np.repeat(away, lost)
    return between


def fit_rings(rays: RecordedRays) -> Rings | None:
    """The rings of a sweep with rays in scan order; None if it has none."""
    # Rings run from front to front: measured from the back, azimuth drops once per ring.
    turned = rays.lidar.beams.azimuth % (2 * np.pi)
    step = np.diff(turned)
    rises = np.median(step) > 0
    begins = np.flatnonzero((-step if rises else step) > RING_STEP) + 1
    ring = np.zeros(len(turned), np.int32)
    ring[begins] = 1
    ring = np.cumsum(ring).astype(np.int32)
    counts = np.bincount(ring)
    kept = np.flatnonzero(counts >= MIN_RING)
    if len(kept) < 2:
        return None
    number = np.full(len(counts), -1, np.int32)
    number[kept] = np.arange(len(kept))
    ring = number[ring]
    turn = _upright(rays.lidar.beams.directions, ring)
    local = rays.lidar.beams.directions @ turn
    azimuth = np.arctan2(local[:, 1], local[:, 0])
    slope_of, offset, off = _cones(local * rays.range[:, None], ring)
    middle = np.arctan(slope_of)
    elevation = np.where(ring >= 0, middle[ring], np.arcsin(np.clip(local[:, 2], -1, 1)))
    residual = float(np.sqrt(np.mean(np.square(off))))
    if residual > NOT_ONE:
        return None
    width = float(np.median(np.abs(step[np.abs(step) < 0.1])))
    columns = int(np.clip(round(2 * np.pi / max(width, 1e-4)), 1, MAX_RAYS // len(kept)))
    slope, _ = _turn(azimuth, rays.lidar.beams.time_us)
    pose = rays.lidar.T_vehicle_lidar.copy()
    pose[:3, :3] = pose[:3, :3] @ turn
    return Rings(middle, offset, residual, ring, columns, slope < 0, pose, azimuth, elevation)


def _cones(points: Float, ring: NDArray[np.int32]) -> tuple[Float, Float, Float]:
    """Slope and offset [B] of each ring, and its error [rad] without the worst 5 % of points."""
    rho = np.maximum(np.hypot(points[:, 0], points[:, 1]), 1e-3)
    count = int(ring.max()) + 1
    slopes, offsets, off = np.zeros(count), np.zeros(count), []
    for index in range(count):
        own = np.flatnonzero(ring == index)
        far, rise = 1 / rho[own], points[own, 2] / rho[own]
        kept = np.ones(len(own), np.bool_)
        for _ in range(ROUNDS):
            table = np.stack([np.ones(int(kept.sum())), far[kept]], axis=1)
            (slope, offset), *_ = np.linalg.lstsq(table, rise[kept], rcond=None)
            error = np.abs(rise - slope - offset * far)
            kept = error <= np.quantile(error, 0.95)
        slopes[index], offsets[index] = slope, offset
        off.append((rise - slope - offset * far)[kept] / (1 + slope**2))
    return slopes, offsets, np.concatenate(off)


def _upright(directions: Float, ring: NDArray[np.int32]) -> Float:
    """Rotation [3, 3] with the sensor's axes as columns; the last one is the axis of the cones."""
    scatter = np.zeros((3, 3))
    for index in range(int(ring.max()) + 1):
        own = directions[ring == index]
        away = own - own.mean(0)
        scatter += away.T @ away
    axis = np.linalg.eigh(scatter)[1][:, 0]
    axis = axis if axis[2] > 0 else -axis
    ahead = np.array([1.0, 0, 0]) - axis[0] * axis
    ahead /= np.linalg.norm(ahead)
    return np.stack([ahead, np.cross(axis, ahead), axis], axis=1)


def _turn(azimuth: Float, time_us: Float) -> tuple[float, float]:
    """Angular speed [rad/us] of a sweep, and its azimuth at its time stamp [rad]."""
    near = np.abs(time_us) < np.abs(time_us).max() / 4
    start = float(np.angle(np.exp(1j * azimuth[np.abs(time_us) < 2000]).mean()))
    away = wrapped(azimuth[near] - start)
    moments = time_us[near]
    slope = float((away * moments).sum() / max(np.square(moments).sum(), 1e-9))
    return slope if abs(slope) > 1e-9 else -2 * np.pi / 1e5, start
