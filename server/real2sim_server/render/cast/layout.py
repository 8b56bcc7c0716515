"""Tiles of a LiDAR's rays (bands of elevation, divided by azimuth) and their record lists.

A tile has eight groups of eight rays. Groups differ in elevation and rays of a group in azimuth,
because objects on the road appear wide and low. Spinning sensors fill tiles of eight rows by eight
columns; ray tables are divided by sorting. The layout is computed once per ``Beams``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from ..._numba import PARALLEL_LOOPS
from ...geometry import Float, wrapped
from ...scene import Beams
from .._cpu.lanes import LANES, inlined, kernel, prefetch
from ..types import weak_cache

GROUPS = 8
"""Groups per tile."""
TILE_RAYS = GROUPS * LANES
AZIMUTH_BINS = 4096
ELEVATION_BINS = 4096
ELEVATION_BIN = np.pi / ELEVATION_BINS
AZIMUTH_BIN = 2 * np.pi / AZIMUTH_BINS
MAX_BANDS = 250
"""Maximum number of bands; fits eight bits."""


class BeamLayout(NamedTuple):
    """Tiles of rays and lookup tables, in kernel form.

    Attributes:
        rays: [T, 64] int32, index of each ray in the flat order of the beams; padded with -1.
        directions: [T, 8, 3, 8] float32, unit vectors in the sensor frame.
        slots: [T, 64] int32, instant of each ray.
        lows, highs: [T, 8] float32, elevations of the groups [rad].
        sides: [T] int32, 1 for tiles of the first half of the sweep, 2 for the second.
        band_starts: [bands + 1] int64, first tile of each band.
        tile_lows, tile_highs: [T] int32, first and last azimuth bin of each tile.
        first_tiles: [bands, AZIMUTH_BINS] int32, first tile of a band that ends at or after a bin.
        first_bands, last_bands: [ELEVATION_BINS] int32, bands at or above, at or below a bin.
        rows_before, rows_until: [ELEVATION_BINS] int32, number of rows below a bin, and up to its
            end.
        slot_of: [AZIMUTH_BINS] int32, instant at which the sensor scans a bin.
        seam: azimuth at which the sweep begins and ends [rad]; above pi if there is none.
        spread_us: largest difference of a ray's time from that of ``slot_of`` [us].
        rate: angular speed of the sensor [rad/s]; 0 if it does not spin.
    """

    rays: NDArray[np.int32]
    directions: NDArray[np.float32]
    slots: NDArray[np.int32]
    lows: NDArray[np.float32]
    highs: NDArray[np.float32]
    sides: NDArray[np.int32]
    band_starts: NDArray[np.int64]
    tile_lows: NDArray[np.int32]
    tile_highs: NDArray[np.int32]
    first_tiles: NDArray[np.int32]
    first_bands: NDArray[np.int32]
    last_bands: NDArray[np.int32]
    rows_before: NDArray[np.int32]
    rows_until: NDArray[np.int32]
    slot_of: NDArray[np.int32]
    seam: float
    spread_us: float
    rate: float


@weak_cache
def layout_of(beams: Beams) -> BeamLayout:
    """The layout of ``beams``, cached."""
    tiles, bands = _turning_tiles(beams) if len(beams.shape) == 2 else _table_tiles(beams)
    azimuth, elevation = beams.azimuth.ravel(), beams.elevation.ravel()
    tiles, bands = _by_azimuth(tiles, bands, azimuth, beams.slots[1].ravel())
    used = tiles >= 0
    index = np.maximum(tiles, 0)
    grouped = np.where(used, elevation[index], np.nan).reshape(len(tiles), GROUPS, LANES)
    directions = beams.directions.reshape(-1, 3)[index].reshape(len(tiles), GROUPS, LANES, 3)
    slots = beams.slots[1].ravel()[index].astype(np.int32)
    bins = np.where(used, _azimuth_bins(azimuth)[index], -1)
    tile_lows = np.where(used, bins, AZIMUTH_BINS).min(1).astype(np.int32)
    tile_highs = bins.max(1).astype(np.int32)
    starts = np.searchsorted(bands, np.arange(bands[-1] + 2))
    slot_of, seam, spread, rate = _turning(beams)
    middle = len(beams.slots[0]) / 2
    lows = np.where(used.reshape(grouped.shape), grouped, np.inf).min(2)
    highs = np.where(used.reshape(grouped.shape), grouped, -np.inf).max(2)
    mean_slot = np.where(used, slots, 0).sum(1) / used.sum(1)
    first_bands, last_bands = _band_tables(lows, highs, bands)
    rows_before, rows_until = _row_tables(elevation)
    return BeamLayout(
        rays=np.ascontiguousarray(tiles.astype(np.int32)),
        directions=np.ascontiguousarray(directions.transpose(0, 1, 3, 2).astype(np.float32)),
        slots=np.ascontiguousarray(slots),
        lows=lows.astype(np.float32),
        highs=highs.astype(np.float32),
        sides=np.where(mean_slot < middle, 1, 2).astype(np.int32),
        band_starts=starts.astype(np.int64),
        tile_lows=tile_lows,
        tile_highs=tile_highs,
        first_tiles=_first_tiles(tile_highs, starts),
        first_bands=first_bands,
        last_bands=last_bands,
        rows_before=rows_before,
        rows_until=rows_until,
        slot_of=slot_of,
        seam=seam,
        spread_us=spread,
        rate=rate,
    )


def _turning_tiles(beams: Beams) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Tiles [T, 64] of a spinning sensor by rows and columns, and the band of each tile.

    Azimuth offsets of rows are compensated in whole columns, so that a tile is compact.
    """
    rows, columns = beams.shape
    order = np.argsort(beams.elevation[:, 0], kind="stable")
    step = 2 * np.pi / columns
    if columns > 1:
        step = float(np.median(np.abs(_difference(beams.azimuth[0, 1:], beams.azimuth[0, :-1]))))
    sign = 1.0
    if columns > 1 and _difference(beams.azimuth[0, 1], beams.azimuth[0, 0]) < 0:
        sign = -1.0
    shift = np.rint(
        sign * _difference(beams.azimuth[:, 0], beams.azimuth[0, 0]) / max(step, 1e-9)
    ).astype(np.int64)
    whole = bool(abs(step * columns - 2 * np.pi) < step / 2)
    index = np.arange(rows * columns).reshape(rows, columns)
    if whole:
        index = np.stack([np.roll(index[r], int(shift[r])) for r in range(rows)])
    tall, wide = -(-rows // GROUPS) * GROUPS, -(-columns // LANES) * LANES
    padded = np.full((tall, wide), -1, dtype=np.int64)
    padded[:rows, :columns] = index[order]
    blocks = padded.reshape(tall // GROUPS, GROUPS, wide // LANES, LANES).transpose(0, 2, 1, 3)
    bands = np.repeat(np.arange(tall // GROUPS), wide // LANES)
    return blocks.reshape(-1, TILE_RAYS), bands


def _table_tiles(beams: Beams) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Tiles [T, 64] of a ray table, and the band of each tile.

    Bands of equally many rays by elevation are divided by azimuth into roughly square tiles.
    """
    azimuth, elevation = beams.azimuth, beams.elevation
    order = np.argsort(elevation, kind="stable")
    high = max(float(np.ptp(elevation)), 1e-3)
    wide = max(float(np.ptp(azimuth)), 1e-3)
    tiles_needed = max(1, len(order) // TILE_RAYS)
    count = int(np.clip(round(np.sqrt(tiles_needed * high / wide)), 1, MAX_BANDS))
    tiles, bands = [], []
    for band, members in enumerate(np.array_split(order, count)):
        by_azimuth = members[np.argsort(azimuth[members], kind="stable")]
        for first in range(0, len(by_azimuth), TILE_RAYS):
            chosen = by_azimuth[first : first + TILE_RAYS]
            tile = np.full(TILE_RAYS, -1, dtype=np.int64)
            tile[: len(chosen)] = chosen[np.argsort(elevation[chosen], kind="stable")]
            tiles.append(tile)
            bands.append(band)
    return np.array(tiles), np.array(bands)


def _by_azimuth(
    tiles: NDArray[np.int64], bands: NDArray[np.int64], azimuth: Float, slots: NDArray[np.int32]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Tiles by band, then azimuth.

    Tiles across +-pi, or with both the start and the end of the sweep, are split in two.
    """
    middle = (int(slots.max()) + 1) / 2
    cuts: list[tuple[Float, float, float]] = [
        (azimuth, 0.0, np.pi),
        (slots.astype(np.float64), middle, middle),
    ]
    for values, cut, limit in cuts:
        held, index = tiles >= 0, np.maximum(tiles, 0)
        low = np.where(held, values[index], np.inf).min(1)
        high = np.where(held, values[index], -np.inf).max(1)
        mixed = high - low > limit
        before = values[index[mixed]] < cut
        first = np.where(before, tiles[mixed], -1)
        second = np.where(before, -1, tiles[mixed])
        tiles = np.concatenate([tiles[~mixed], first, second])
        bands = np.concatenate([bands[~mixed], bands[mixed], bands[mixed]])
    filled = (tiles >= 0).any(1)
    parted, kept = tiles[filled], bands[filled]
    start = np.where(parted >= 0, azimuth[np.maximum(parted, 0)], np.inf).min(1)
    order = np.lexsort((start, kept))
    _, dense = np.unique(kept[order], return_inverse=True)
    return parted[order], dense


def _azimuth_bins(azimuth: Float) -> NDArray[np.int64]:
    return np.clip(((azimuth + np.pi) / AZIMUTH_BIN).astype(np.int64), 0, AZIMUTH_BINS - 1)


def _first_tiles(tile_highs: NDArray[np.int32], starts: NDArray[np.int64]) -> NDArray[np.int32]:
    table = np.empty((len(starts) - 1, AZIMUTH_BINS), dtype=np.int32)
    for band in range(len(table)):
        reach = np.maximum.accumulate(tile_highs[starts[band] : starts[band + 1]])
        table[band] = starts[band] + np.searchsorted(reach, np.arange(AZIMUTH_BINS))
    return table


def _band_tables(
    lows: Float, highs: Float, bands: NDArray[np.int64]
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    count = int(bands[-1]) + 1
    low = np.array([lows[bands == band].min() for band in range(count)])
    high = np.array([highs[bands == band].max() for band in range(count)])
    edges = -np.pi / 2 + np.arange(ELEVATION_BINS + 1) * ELEVATION_BIN
    first = np.searchsorted(np.maximum.accumulate(high), edges[:-1] - 1e-7)
    last = np.searchsorted(np.minimum.accumulate(low[::-1])[::-1], edges[1:] + 1e-7) - 1
    return first.astype(np.int32), last.astype(np.int32)


def _row_tables(elevation: Float) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    rows = np.unique(np.round(elevation, 7))
    edges = -np.pi / 2 + np.arange(ELEVATION_BINS + 1) * ELEVATION_BIN
    before = np.searchsorted(rows, edges[:-1] - 1e-6)
    until = np.searchsorted(rows, edges[1:] + 1e-6)
    return before.astype(np.int32), until.astype(np.int32)


def _turning(beams: Beams) -> tuple[NDArray[np.int32], float, float, float]:
    """``slot_of``, ``seam``, ``spread_us`` and ``rate`` of BeamLayout."""
    times, slots = beams.slots
    centres = -np.pi + (np.arange(AZIMUTH_BINS) + 0.5) * AZIMUTH_BIN
    duration = float(times[-1] - times[0])
    if len(beams.shape) == 1 and duration > 0:
        return _turning_table(beams)
    if len(beams.shape) == 1 or beams.shape[1] < LANES or duration <= 0:
        return _staring(beams)
    azimuth, elevation_slots = beams.azimuth[0], slots[0]
    offsets = _difference(beams.azimuth[:, 0], azimuth[0])
    middle = (azimuth + float(offsets.mean()) + np.pi) % (2 * np.pi) - np.pi
    order = np.argsort(middle, kind="stable")
    ring = np.concatenate([middle[order][-1:] - 2 * np.pi, middle[order], middle[order][:1] + 6.4])
    ring[-1] = middle[order][0] + 2 * np.pi
    ids = np.concatenate([order[-1:], order, order[:1]])
    after = np.clip(np.searchsorted(ring, centres), 1, len(ring) - 1)
    nearer = np.where(centres - ring[after - 1] <= ring[after] - centres, after - 1, after)
    slot_of = elevation_slots[ids[nearer]].astype(np.int32)
    turned = float(np.abs(_difference(azimuth[1:], azimuth[:-1])).sum())
    rate = turned / (duration * 1e-6)
    step = turned / max(len(azimuth) - 1, 1)
    spread = (float(np.abs(offsets - offsets.mean()).max()) + step + AZIMUTH_BIN) / rate * 1e6
    towards = np.sign(_difference(azimuth[1], azimuth[0]))
    seam = middle[0] - towards * step / 2 if turned > np.pi else 4.0
    seam = float((seam + np.pi) % (2 * np.pi) - np.pi) if turned > np.pi else 4.0
    return slot_of, seam, spread, rate


def _staring(beams: Beams) -> tuple[NDArray[np.int32], float, float, float]:
    """Values of a sensor without scan order."""
    times = beams.slots[0]
    middle = np.full(AZIMUTH_BINS, len(times) // 2, dtype=np.int32)
    return middle, 4.0, float(times[-1] - times[0]) / 2, 0.0


def _turning_table(beams: Beams) -> tuple[NDArray[np.int32], float, float, float]:
    """Values of a ray table, possibly of a spinning sensor (recorded sweeps)."""
    times, slots = beams.slots
    duration = float(times[-1] - times[0])
    bins, when = _azimuth_bins(wrapped(beams.azimuth)), times[slots]
    low, high = np.full(AZIMUTH_BINS, np.inf), np.full(AZIMUTH_BINS, -np.inf)
    np.minimum.at(low, bins, when)
    np.maximum.at(high, bins, when)
    seen = np.flatnonzero(high >= low)
    apart = high[seen] - low[seen]
    at_seam = apart > duration / 2
    if len(seen) < AZIMUTH_BINS // 8 or at_seam.mean() > 0.02 or np.median(apart) > duration / 16:
        return _staring(beams)
    middle = np.where(at_seam, high[seen], (low[seen] + high[seen]) / 2)
    centres = np.arange(AZIMUTH_BINS)
    after = np.searchsorted(seen, centres)
    before = np.clip(after - 1, 0, len(seen) - 1)
    after = np.clip(after, 0, len(seen) - 1)
    nearer = np.where(centres - seen[before] < seen[after] - centres, before, after)
    time_of = middle[nearer]
    slot_of = np.clip(np.searchsorted(times, time_of), 0, len(times) - 1).astype(np.int32)
    jumps = np.flatnonzero(np.abs(np.diff(time_of, append=time_of[0])) > duration / 2)
    seam = -np.pi + (int(jumps[0]) + 1) * AZIMUTH_BIN if len(jumps) else 4.0
    off = np.abs(when - time_of[bins])
    spread = float(off[off < duration / 2].max()) + 2 * AZIMUTH_BIN / (2 * np.pi) * duration
    return (
        slot_of,
        float(wrapped(np.array(seam))) if seam < 4 else 4.0,
        spread,
        float(2 * np.pi / (duration * 1e-6)),
    )


def _difference(a: Float, b: Float) -> Float:
    """Wrapped difference a - b [rad]."""
    turned: Float = (np.asarray(a) - np.asarray(b) + np.pi) % (2 * np.pi) - np.pi
    return turned


# Data exchanged between kernels

RECORD = 16
"""float32 values of a record: one cache line per Gaussian that a ray may hit."""
WHITENING = 0
"""Six planes: lower triangle W by rows, with exponent = |W (x - mean)|^2 + LEVEL."""
MEAN = 6
"""Three planes: centre in the sweep frame [m]."""
LEVEL = 9
"""-ln(opacity) in EXPONENT_UNIT."""
LOW, HIGH = 10, 11
"""Range of elevations at which rays may hit the Gaussian [rad]."""
BODY = 12
"""Index of the instance, as a float32."""
MEMBER = 13
"""Index of the Gaussian in its cloud, as a float32; exact up to 16 million."""
REFLECTIVITY, LOSS = 14, 15
"""LiDAR attributes."""

SHAPE = RECORD
"""Seven planes: quaternion and scales, or the upper half of a covariance by rows."""
OPACITY = RECORD + 7
FRAME = RECORD + 8
"""Twelve planes: transform from the sweep frame to the sensor frame when the sensor scans the
centre; three rows of rotation and translation."""
RANGE = RECORD + 20
"""Distance of the centre from the sensor at that instant [m]."""
LEFT, RIGHT = RECORD + 21, RECORD + 22
"""Range of azimuths at which rays may hit the Gaussian, LEFT < RIGHT [rad]."""
GAIN = RECORD + 23
"""Upper bound of its angular speed relative to the sensor [rad/s]."""
PREPARATION = RECORD + 24


class Body(NamedTuple):
    """Arrays of one instance, all contiguous.

    Attributes:
        means, quats, scales, opacities: arrays of the cloud.
        covars: [N, 3, 3], or [0, 3, 3] if absent.
        attributes: [N, 2] float32, or [0, 2].
        linear, offset: [3, 3] and [3] float64, cloud frame to sweep frame.
        frames: [S, 12] float32, sweep frame to sensor frame at each instant.
        speed, turn: maximum speed [m/s] and angular speed [rad/s] of the sensor relative to the
            body.
        number: index of the instance in the request.
    """

    means: NDArray[np.float32]
    quats: NDArray[np.float32]
    scales: NDArray[np.float32]
    opacities: NDArray[np.float32]
    covars: NDArray[np.float32]
    attributes: NDArray[np.float32]
    linear: NDArray[np.float64]
    offset: NDArray[np.float64]
    frames: NDArray[np.float32]
    speed: np.float32
    turn: np.float32
    number: np.float32


class Sensor(NamedTuple):
    """A LiDAR as float32 numbers.

    Attributes:
        near, far: bounds of returns [m].
        wide, high: standard deviations of a beam at a distance of one metre [m].
        spread: largest difference of a ray's time from the scan time of its direction [s].
        period: time in which the sensor rotates by one radian [s]; 0 if it does not spin.
        duration: duration of a sweep [s].
    """

    near: np.float32
    far: np.float32
    wide: np.float32
    high: np.float32
    spread: np.float32
    period: np.float32
    duration: np.float32


class Lights(NamedTuple):
    """Outputs by ray; [0] if not requested.

    Attributes:
        values: [R, 6] float32: median range, sums of w tau, w, w reflectivity and w loss, and the
            return modes after them.
        owners: [R, 2] int32: body and member at the median, -1 if none.
        returns: [R, 9] float32: range, power and reflectivity of first, strongest and last.
    """

    values: NDArray[np.float32]
    owners: NDArray[np.int32]
    returns: NDArray[np.float32]


# Tile lists, from near to far

TILE_CHUNKS = 8
LOOK_AHEAD = 24
LOW_BITS = np.uint64(0xFFFFFFFF)


@kernel(parallel=PARALLEL_LOOPS)
def count_rays(footprints, order, layout, ordered, counts):
    """Count the records of each chunk in each tile.

    Args:
        footprints: see Records.
        order: [N] uint64, record indices in the low 32 bits, near to far.
        ordered: [N] int64, written: footprints in that order.
        counts: [TILE_CHUNKS, tiles] int64, written.
    """
    total = order.shape[0]
    step = (total + TILE_CHUNKS - 1) // TILE_CHUNKS
    unused = np.empty(0, np.int32)
    for chunk in prange(TILE_CHUNKS):
        counts[chunk, :] = 0
        for i in range(chunk * step, min(total, (chunk + 1) * step)):
            prefetch(footprints, np.int64(order[min(i + LOOK_AHEAD, total - 1)] & LOW_BITS))
            footprint = footprints[np.int64(order[i] & LOW_BITS)]
            ordered[i] = footprint
            visit(footprint, layout, counts[chunk], unused, np.int32(0))


@kernel(parallel=PARALLEL_LOOPS)
def scatter_rays(ordered, order, layout, cursors, lists):
    """Write record indices to ``lists`` int32 at the cursors [TILE_CHUNKS, tiles]."""
    total = order.shape[0]
    step = (total + TILE_CHUNKS - 1) // TILE_CHUNKS
    for chunk in prange(TILE_CHUNKS):
        for i in range(chunk * step, min(total, (chunk + 1) * step)):
            index = np.int32(order[i] & LOW_BITS)
            visit(ordered[i], layout, cursors[chunk], lists, index)


@inlined()
def visit(footprint, layout, cursors, lists, index):
    """Advance the cursor of each tile in a footprint; write ``index`` there if lists are given."""
    band, last_band = footprint & 255, (footprint >> 8) & 255
    first_bin, last_bin = (footprint >> 16) & 8191, (footprint >> 29) & 8191
    side = footprint >> 42
    while band <= last_band:
        begin, end = first_bin, min(last_bin, AZIMUTH_BINS - 1)
        beyond = last_bin - AZIMUTH_BINS
        tile_end = layout.band_starts[band + 1]
        while begin <= end:
            tile = np.int64(layout.first_tiles[band, begin])
            if begin == 0 and first_bin > 0:
                # Beyond +-pi, skip tiles that the first part has already visited.
                tile_end = min(tile_end, np.int64(layout.first_tiles[band, first_bin]))
            while tile < tile_end and layout.tile_lows[tile] <= end:
                met = side == 0 or layout.sides[tile] == side
                if met and layout.tile_highs[tile] >= begin:
                    if lists.shape[0] > 0:
                        lists[cursors[tile]] = index
                    cursors[tile] += 1
                tile += 1
            begin, end, beyond = np.int64(0), beyond, np.int64(-1)
            if end < 0:
                break
        band += 1
