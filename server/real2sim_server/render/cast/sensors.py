"""Measurement models of LiDARs and radars.

The LiDAR model adds a detection limit, dropped returns and range noise. Random numbers are hashes
of the seed and the ray index, so a sweep is bitwise independent of the number of threads, and
changing one ray does not affect others.

The radar model adds reflected power, resolution cells, a threshold, clutter and ghosts. Each ray
represents its solid angle. Its patch has the radar cross section (RCS) of its projected area times
a factor by class and incidence: a lobe around the normal, and a floor for corners and edges. Powers
of patches in one cell of range, azimuth, elevation and radial velocity add up. A cell above the
threshold is one detection, at the power-weighted mean of its patches. Power falls with the fourth
power of range: a target of REFERENCE_RCS is just detected at the radar's ``detection_range_m``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from real2sim_proto.conventions import SEMANTIC_CLASSES

from ...geometry import Float
from ...scene import Lidar, Radar
from .types import CastRequest, Echo, Image, point_velocities

GOLDEN, MIX_1, MIX_2 = 0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB
WORD = (1 << 64) - 1
LOST, ACROSS, AROUND = 0, 1, 2
"""Indices of a ray's random numbers."""


@dataclass(frozen=True, eq=False)
class Sweep:
    """Measurements of a LiDAR in one turn or frame; arrays have the sensor's shape.

    Attributes:
        range: [m], including noise; 0 without a return.
        returns: ranges by name (``first``, ``strongest``, ``last``) of multi-return sensors.
        intensity: reflectivity, 0 to 1; 0 without a return.
        hit: whether each ray has a return.
        drop_probability: probability that a ray is lost regardless of its target, 0 to 1.
        instance: uint16, instance_id of the target; 0 without a return.
        velocity: [..., 3] velocity of the target, world frame [m/s]; None if not requested.
        time_us: firing time of each ray relative to the timestamp of the sweep [us].
        points: [..., 3] sensor frame at the time of the ray [m].
    """

    range: Image
    returns: dict[str, Image]
    intensity: Image
    hit: NDArray[np.bool_]
    drop_probability: Image
    instance: NDArray[np.uint16]
    velocity: Image | None
    time_us: Image
    points: Image


def detect(echo: Echo, lidar: Lidar, *, seed: int = 0, request: CastRequest | None = None) -> Sweep:
    """Measure ``echo`` with the detector of ``lidar``.

    Args:
        echo: result of :func:`cast`.
        lidar: the sensor.
        seed: seed of noise and dropped returns.
        request: request of the cast, for target velocities.
    """
    probability = drop_probability(echo, lidar)
    hit = echo.hit & (uniform(seed, lidar.beams.count, LOST).reshape(lidar.shape) >= probability)
    noise = lidar.range_noise * normal(seed, lidar.beams.count).reshape(lidar.shape)
    within = echo.range + noise
    hit &= (within >= lidar.min_range) & (within <= lidar.max_range)
    measured = np.where(hit, within, 0).astype(np.float32)
    velocity = None if request is None else point_velocities(request, echo, hit)
    return Sweep(
        range=measured,
        returns={
            name: np.where(hit & (found.range > 0), found.range + noise, 0).astype(np.float32)
            for name, found in echo.returns.items()
        },
        intensity=np.where(hit, np.clip(echo.intensity, 0, 1), 0).astype(np.float32),
        hit=hit,
        drop_probability=probability,
        instance=np.where(hit, echo.instance, 0).astype(np.uint16),
        velocity=velocity,
        time_us=lidar.beams.time_us.astype(np.float32),
        points=(lidar.beams.directions * measured[..., None]).astype(np.float32),
    )


def drop_probability(echo: Echo, lidar: Lidar) -> Image:
    """Probability that each ray is lost.

    Combines the sensor's drop rate, the rate learned from the log, and insufficient power, which
    falls with the square of the range.
    """
    detection = lidar.detection
    limit = detection.reflectivity / detection.range_m**2
    with np.errstate(divide="ignore", invalid="ignore"):
        power = echo.intensity / np.square(echo.range)
        faint = 1 / (1 + np.exp(np.clip((power / limit - 1) / detection.softness, -50, 50)))
    kept = (1 - detection.loss) * (1 - np.clip(echo.drop, 0, 1)) * (1 - faint)
    return np.where(echo.hit, 1 - kept, 1).astype(np.float32)


def uniform(seed: int, count: int, draw: int) -> NDArray[np.float64]:
    """Uniform numbers [count] in [0, 1), one per ray (splitmix64 of seed, ray and draw)."""
    base = np.uint64((seed * MIX_1 + draw * MIX_2) & WORD)
    state = base + (np.arange(count, dtype=np.uint64) + np.uint64(1)) * np.uint64(GOLDEN)
    state = (state ^ (state >> np.uint64(30))) * np.uint64(MIX_1)
    state = (state ^ (state >> np.uint64(27))) * np.uint64(MIX_2)
    state ^= state >> np.uint64(31)
    numbers: NDArray[np.float64] = (state >> np.uint64(11)).astype(np.float64) * 2.0**-53
    return numbers


def normal(seed: int, count: int) -> NDArray[np.float64]:
    """Standard normal numbers [count] (Box-Muller)."""
    radius = np.sqrt(-2 * np.log(1 - uniform(seed, count, ACROSS)))
    numbers: NDArray[np.float64] = radius * np.cos(2 * np.pi * uniform(seed, count, AROUND))
    return numbers


# Radar

REFERENCE_RCS = 10.0
"""RCS of a car from behind [m^2]."""
LOBE = np.radians(12.0)
"""Standard deviation of the lobe around the normal [rad]."""
FLOOR = 0.08
"""RCS at grazing incidence, as a fraction of the lobe's peak."""
GHOST_LOSS = 0.05
"""Power of a ghost relative to a target at the same range."""
CLUTTER_RCS = (-20.0, 5.0)
"""RCS of clutter detections: mean and standard deviation [dBsm]."""
MAX_CLUTTER = 20_000

REFLECTIVITY = {
    "car": 12.0,
    "truck": 20.0,
    "bus": 20.0,
    "trailer": 20.0,
    "train": 30.0,
    "motorcycle": 6.0,
    "bicycle": 3.0,
    "rider": 2.0,
    "person": 1.2,
    "ground": 0.01,
    "pole": 6.0,
    "traffic sign": 20.0,
    "static": 2.0,
}
"""RCS per area of a patch at normal incidence, by class; DEFAULT for other classes."""
DEFAULT = 2.0

CLUTTER, CLUTTER_PLACE, GHOST = 11, 12, 16
"""Indices of random numbers; a position takes four."""


@dataclass(frozen=True, eq=False)
class Patches:
    """Targets of P rays, sensor frame.

    Attributes:
        range: [P] [m].
        azimuth, elevation: [P] [rad].
        velocity: [P] radial velocity relative to the sensor, positive when receding [m/s].
        incidence: [P] angle between ray and normal, 0 to pi/2 [rad].
        semantic: [P] uint8 classes.
        instance: [P] uint16; 0 is background.
    """

    range: Float
    azimuth: Float
    elevation: Float
    velocity: Float
    incidence: Float
    semantic: NDArray[np.uint8]
    instance: NDArray[np.uint16]


@dataclass(frozen=True, eq=False)
class Detections:
    """D detections of a radar, nearest first.

    Attributes:
        range: [D] [m].
        azimuth, elevation: [D] [rad].
        velocity: [D] radial velocity relative to the sensor, negative when approaching [m/s].
        rcs: [D] [dBsm].
        snr: [D] power above the detection threshold [dB].
        instance: [D] uint16, instance of the strongest reflection; 0 for background or no target.
        kind: [D] uint8: TARGET, CLUTTER_KIND or GHOST_KIND.
    """

    range: Float
    azimuth: Float
    elevation: Float
    velocity: Float
    rcs: Float
    snr: Float
    instance: NDArray[np.uint16]
    kind: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.range)

    @property
    def points(self) -> Float:
        """[D, 3] points, sensor frame [m]."""
        flat = self.range * np.cos(self.elevation)
        x, y = flat * np.cos(self.azimuth), flat * np.sin(self.azimuth)
        return np.stack([x, y, self.range * np.sin(self.elevation)], axis=-1)


TARGET, CLUTTER_KIND, GHOST_KIND = 0, 1, 2


def radar_detections(patches: Patches, radar: Radar, *, seed: int = 0) -> Detections:
    """Detections of ``radar`` for ``patches``; deterministic for a seed."""
    targets = _above_threshold(_cells(patches, radar), radar)
    ghosts = _ghosts(targets, radar, seed)
    seen = _measured(_joined([targets, ghosts]), radar, seed)
    found = _joined([seen, _clutter(radar, seed)])
    return _picked(found, np.argsort(found.range, kind="stable"))


def patch_rcs(patches: Patches, solid_angle: float) -> Float:
    """RCS [P] [m^2] of each ray's patch; ``solid_angle`` is that of a ray at the axis [sr]."""
    table = np.full(256, DEFAULT)
    for name, value in REFLECTIVITY.items():
        table[SEMANTIC_CLASSES[name]] = value
    area = patches.range**2 * solid_angle * np.cos(patches.elevation)
    lobe = np.exp(-0.5 * (patches.incidence / LOBE) ** 2)
    found: Float = table[patches.semantic] * area * ((1 - FLOOR) * lobe + FLOOR)
    return found


def _cells(patches: Patches, radar: Radar) -> Detections:
    """One noiseless detection per cell with any reflection."""
    model = radar.model
    rcs = patch_rcs(patches, radar.solid_angle)
    near, far = model.range_m
    kept = (patches.range >= near) & (patches.range <= far) & (rcs > 0)
    values = [getattr(patches, name)[kept] for name in ("range", "azimuth", "elevation")]
    velocity = folded(patches.velocity[kept], model.max_velocity_mps)
    rcs, instance = rcs[kept], patches.instance[kept]
    edges = [np.radians(angle) / 2 for angle in model.field_of_view_deg]
    steps = (
        values[0] / model.range_resolution_m,
        (values[1] + edges[0]) / np.radians(model.azimuth_resolution_deg),
        (values[2] + edges[1]) / np.radians(model.elevation_resolution_deg),
        velocity / model.velocity_resolution_mps + 0.5,
    )
    keys = np.stack([np.floor(step).astype(np.int64) for step in steps], axis=-1)
    _, cell = np.unique(keys, axis=0, return_inverse=True)
    cell = cell.reshape(-1)
    power = rcs / values[0] ** 4
    count = int(cell.max()) + 1 if len(cell) else 0
    total = np.bincount(cell, power, count)
    means = [np.bincount(cell, power * v, count) / total for v in (*values, velocity)]
    sums = total * means[0] ** 4
    strongest = np.zeros(count, np.uint16)
    order = np.argsort(power, kind="stable")
    strongest[cell[order]] = instance[order]
    return Detections(
        range=means[0],
        azimuth=means[1],
        elevation=means[2],
        velocity=means[3],
        rcs=10 * np.log10(np.maximum(sums, 1e-12)),
        snr=np.zeros(count),
        instance=strongest,
        kind=np.full(count, TARGET, np.uint8),
    )


def folded(velocity: Float, most: float | None) -> Float:
    """Velocities folded into the unambiguous range, -most to most."""
    return velocity if most is None else (velocity + most) % (2 * most) - most


def _snr(rcs: Float, distance: Float, radar: Radar) -> Float:
    """Power above the detection threshold [dB], for targets of ``rcs`` [dBsm]."""
    reach = radar.model.detection_range_m
    reference = 10 * np.log10(REFERENCE_RCS)
    found: Float = rcs - reference + 40 * np.log10(reach / distance)
    return found


def _above_threshold(cells: Detections, radar: Radar) -> Detections:
    snr = _snr(cells.rcs, cells.range, radar)
    seen = (snr >= 0) & (cells.rcs >= radar.model.min_rcs_dbsm)
    return _picked(_with(cells, snr=snr), np.flatnonzero(seen))


def _measured(found: Detections, radar: Radar, seed: int) -> Detections:
    """Detections with measurement noise."""
    model, count = radar.model, len(found)
    noise = [normal(seed + k * 7919, count) for k in range(3)]
    velocity = found.velocity + noise[2] * model.velocity_noise_mps
    return _with(
        found,
        range=np.maximum(found.range + noise[0] * model.range_noise_m, 1e-3),
        azimuth=found.azimuth + noise[1] * np.radians(model.azimuth_noise_deg),
        velocity=folded(velocity, model.max_velocity_mps),
    )


def _ghosts(targets: Detections, radar: Radar, seed: int) -> Detections:
    """Ghost detections behind targets, from double reflections."""
    model = radar.model
    drawn = uniform(seed, len(targets), GHOST) < model.ghost_rate
    chosen = _picked(targets, np.flatnonzero(drawn & (targets.instance > 0)))
    distance = 2 * chosen.range
    rcs = chosen.rcs + 10 * np.log10(GHOST_LOSS)
    snr = _snr(rcs, distance, radar)
    ghosts = _with(
        chosen,
        range=distance,
        velocity=folded(2 * chosen.velocity, model.max_velocity_mps),
        rcs=rcs,
        snr=snr,
        kind=np.full(len(chosen), GHOST_KIND, np.uint8),
    )
    return _picked(ghosts, np.flatnonzero((snr >= 0) & (distance <= model.range_m[1])))


def _clutter(radar: Radar, seed: int) -> Detections:
    """False detections: Poisson distributed number, uniform positions in the field of view."""
    model = radar.model
    count = poisson(model.clutter_rate, float(uniform(seed, 1, CLUTTER)[0]))
    places = [uniform(seed, count, CLUTTER_PLACE + k) for k in range(4)]
    near, far = model.range_m
    wide, high = (np.radians(angle) for angle in model.field_of_view_deg)
    most = model.max_velocity_mps or 30.0
    distance = near + places[0] * (far - near)
    rcs = CLUTTER_RCS[0] + CLUTTER_RCS[1] * normal(seed + 104_729, count)
    snr = np.maximum(_snr(rcs, distance, radar), 0.0)
    return Detections(
        distance,
        (places[1] - 0.5) * wide,
        (places[2] - 0.5) * high,
        (2 * places[3] - 1) * most,
        rcs=rcs,
        snr=snr,
        instance=np.zeros(count, np.uint16),
        kind=np.full(count, CLUTTER_KIND, np.uint8),
    )


def poisson(mean: float, drawn: float) -> int:
    """Quantile ``drawn`` in [0, 1) of the Poisson distribution with mean ``mean``."""
    number, logarithm = 0, -mean
    total = np.exp(logarithm)
    while drawn >= total and number < MAX_CLUTTER:
        number += 1
        logarithm += np.log(mean / number) if mean > 0 else -np.inf
        total += np.exp(logarithm)
    return number


def _with(found: Detections, **columns: NDArray) -> Detections:  # type: ignore[type-arg]
    return _mapped(lambda name: columns.get(name, getattr(found, name)))


def _picked(found: Detections, indices: NDArray[np.intp]) -> Detections:
    return _mapped(lambda name: getattr(found, name)[indices])


def _joined(parts: list[Detections]) -> Detections:
    return _mapped(lambda name: np.concatenate([getattr(part, name) for part in parts]))


def _mapped(column: Callable[[str], NDArray]) -> Detections:  # type: ignore[type-arg]
    return Detections(**{field.name: column(field.name) for field in fields(Detections)})
