"""Tile footprints against the exact ellipse."""

from typing import NamedTuple

import numba
import numpy as np
import pytest

from real2sim_server.render._cpu.lanes import LANES
from real2sim_server.render._cpu.project import (
    FIELD,
    FIELD_MASK,
    PROJECTION,
    ellipse_columns,
    footprints_of_eight,
    tile_columns,
    tile_rows,
)
from real2sim_server.render._cpu.records import (
    EXPONENT_LIMIT,
    EXTENT_X,
    EXTENT_Y,
    FALLOFF,
    LEVEL,
    MEAN_X,
    MEAN_Y,
    RECORD,
    SHARPNESS,
    SLOPE,
    TILE,
    TIP_Y,
)

WIDTH, HEIGHT = 320, 240


class Size(NamedTuple):
    width: np.float32
    height: np.float32


SIZE = Size(np.float32(WIDTH), np.float32(HEIGHT))


@numba.njit
def columns_by_row(values, first, lane, size):
    """Per tile row, the columns by footprint and by ellipse; and the footprint."""
    planes = np.zeros(PROJECTION * LANES, np.float32)
    for other in range(LANES):
        for field in range(RECORD):
            planes[field * LANES + other] = values[first + other, field]
    footprints = np.zeros(LANES, np.int64)
    lanes = footprints_of_eight(planes, 1 << lane, size, footprints)
    footprint = footprints[lane]
    index = first + lane
    found = []
    if lanes != 0:
        first_column, last_column = footprint & FIELD_MASK, (footprint >> FIELD) & FIELD_MASK
        top, bottom = tile_rows(footprint)
        for row in range(top, bottom):
            short = tile_columns(values, footprint, index, row)
            exact = ellipse_columns(values[index], row, first_column, last_column)
            found.append((row, short, exact))
    return found, footprint


def random_records(count, largest, seed=0):
    """Records of random ellipses with half axes up to ``largest`` [px], and their conics."""
    rng = np.random.default_rng(seed)
    values = np.zeros((count, RECORD), np.float32)
    conics = []
    for record in values:
        angle, axes = rng.uniform(0, np.pi), rng.uniform(0.5, largest, 2)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        # The ellipse d^T S^-1 d <= 1 is where the exponent, LIMIT d^T S^-1 d, is within LIMIT.
        S = turn @ np.diag(axes**2) @ turn.T
        conic = EXPONENT_LIMIT * np.linalg.inv(S)
        record[[MEAN_X, MEAN_Y]] = rng.uniform(-20, (WIDTH + 20, HEIGHT + 20))
        record[SHARPNESS] = np.sqrt(conic[0, 0])
        record[SLOPE] = -conic[0, 1] / conic[0, 0]
        record[FALLOFF] = conic[1, 1] - conic[0, 1] ** 2 / conic[0, 0]
        record[LEVEL] = 0
        record[EXTENT_X], record[EXTENT_Y] = np.sqrt(np.diag(S))
        record[TIP_Y] = np.sqrt(S[0, 0]) * S[0, 1] / S[0, 0]
        conics.append(conic)
    return values, conics


@pytest.mark.parametrize("largest", [8, 30, 120])
def test_footprint_columns_match_the_ellipse(largest):
    values, _ = random_records(304, largest)
    small = 0
    for index in range(len(values)):
        found, footprint = columns_by_row(values, index // LANES * LANES, index % LANES, SIZE)
        width = ((footprint >> FIELD) & FIELD_MASK) - (footprint & FIELD_MASK)
        for _, short, exact in found:
            empty = exact[1] <= exact[0]
            if width > 1 and len(found) > 1 and not empty:
                assert short == exact
                small += 1
            elif width > 1 and len(found) > 1:
                assert short[1] <= short[0]
    assert small > 50


@pytest.mark.parametrize("largest", [8, 30, 120])
def test_footprints_cover_every_pixel_of_the_ellipse(largest):
    values, conics = random_records(104, largest, seed=1)
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    for index, (record, conic) in enumerate(zip(values, conics, strict=True)):
        dx, dy = x - record[MEAN_X], y - record[MEAN_Y]
        exponent = conic[0, 0] * dx**2 + 2 * conic[0, 1] * dx * dy + conic[1, 1] * dy**2
        rows, columns = np.nonzero(exponent < EXPONENT_LIMIT * (1 - 1e-4))
        inside = set(zip((rows // TILE).tolist(), (columns // TILE).tolist(), strict=True))
        found, _ = columns_by_row(values, index // LANES * LANES, index % LANES, SIZE)
        named = {(row, column) for row, (a, b), _ in found for column in range(a, b)}
        assert inside <= named
