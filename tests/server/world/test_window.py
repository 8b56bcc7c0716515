"""The newest entries of a growing sequence, shared by those who go on from it."""

from __future__ import annotations

from real2sim_server.world.scoring.window import Window


def test_the_last_entries_are_kept() -> None:
    window: Window[int] = Window()
    for k in range(50):
        window = window.pushed(k, 4)
        assert list(window) == list(range(max(0, k - 3), k + 1))
        assert window.newest() == k
        assert len(window) == min(k + 1, 4)
    assert window.newest(3) == 46


def test_windows_that_part_do_not_see_each_other() -> None:
    start = Window(1, 2)
    one, other = start.pushed(3, 8), start.pushed(4, 8)
    assert (list(start), list(one), list(other)) == ([1, 2], [1, 2, 3], [1, 2, 4])
    assert list(one.pushed(5, 8)) == [1, 2, 3, 5]
    assert list(other.pushed(6, 3)) == [2, 4, 6]


def test_all_entries_can_be_changed() -> None:
    window = Window(1, 2)
    assert list(window.mapped(lambda k: 10 * k)) == [10, 20]
    assert list(window) == [1, 2]
