"""Windows of the newest entries, with storage shared between branches."""

from __future__ import annotations

import numpy as np
import pytest

from real2sim_server.world.scoring.comfort import RowWindow, Window


def test_the_last_entries_are_kept() -> None:
    window: Window[int] = Window()
    for k in range(50):
        window = window.pushed(k, 4)
        assert list(window) == list(range(max(0, k - 3), k + 1))
        assert window.newest() == k
        assert len(window) == min(k + 1, 4)
    assert window.newest(3) == 46


def test_branched_windows_are_independent() -> None:
    start = Window(1, 2)
    one, other = start.pushed(3, 8), start.pushed(4, 8)
    assert (list(start), list(one), list(other)) == ([1, 2], [1, 2, 3], [1, 2, 4])
    assert list(one.pushed(5, 8)) == [1, 2, 3, 5]
    assert list(other.pushed(6, 3)) == [2, 4, 6]


def test_mapped_changes_every_entry() -> None:
    window = Window(1, 2)
    assert list(window.mapped(lambda k: 10 * k)) == [10, 20]
    assert list(window) == [1, 2]


@pytest.mark.parametrize("most", [1, 4, 20])
def test_the_last_rows_form_one_contiguous_array(most: int) -> None:
    window, rows = RowWindow(np.zeros((0, 2))), np.arange(100.0).reshape(50, 2)
    for k, row in enumerate(rows.tolist()):
        window = window.pushed(row, most)
        np.testing.assert_array_equal(window.rows, rows[max(0, k + 1 - most) : k + 1])
        assert window.rows.flags.c_contiguous


def test_branched_row_windows_are_independent() -> None:
    start = RowWindow(np.zeros((0, 1))).pushed((1.0,), 8)
    one, other = start.pushed((2.0,), 8), start.pushed((3.0,), 8)
    assert [w.rows.ravel().tolist() for w in (start, one, other)] == [[1], [1, 2], [1, 3]]
