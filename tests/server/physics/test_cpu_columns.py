"""Particle rows become lane columns and are restored."""

import numba
import numpy as np
import pytest

from real2sim_server.physics.backends.cpu.deform import (
    BATCH,
    bring_back_nine,
    bring_back_six,
    lay_out,
)

PLANE, FIRST = 3, 5


@numba.njit
def there(rows, scratch):
    lay_out(rows, FIRST, scratch, PLANE)


@numba.njit
def nine_back(scratch, rows):
    bring_back_nine(scratch, PLANE, rows, FIRST)


@numba.njit
def six_back(scratch, rows):
    bring_back_six(scratch, PLANE, rows, FIRST)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_columns_contain_the_rows(dtype):
    rows = np.arange((BATCH + 9) * 9, dtype=dtype).reshape(-1, 9)
    scratch = np.full(20 * BATCH, -1, dtype)
    there(rows, scratch)
    planes = scratch.reshape(20, BATCH)
    assert (planes[PLANE : PLANE + 9] == rows[FIRST : FIRST + BATCH].T).all()
    assert (planes[:PLANE] == -1).all()
    assert (planes[PLANE + 9 :] == -1).all()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(("width", "back"), [(9, nine_back), (6, six_back)])
def test_rows_round_trip_and_their_neighbours_are_untouched(dtype, width, back):
    rows = np.full((BATCH + 9, width), -1, dtype)
    scratch = np.arange(20 * BATCH, dtype=dtype)
    back(scratch, rows)
    planes = scratch.reshape(20, BATCH)[PLANE : PLANE + width]
    assert (rows[FIRST : FIRST + BATCH] == planes.T).all()
    assert (rows[:FIRST] == -1).all()
    assert (rows[FIRST + BATCH :] == -1).all()
