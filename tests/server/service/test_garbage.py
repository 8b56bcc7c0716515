"""Garbage collection settings of a worker process."""

from __future__ import annotations

import gc

import pytest

from real2sim_server.service.serve import collect_rarely, freeze_objects


@pytest.fixture(autouse=True)
def settings_of_before():
    before = gc.get_threshold()
    yield
    gc.set_threshold(*before)
    gc.unfreeze()


def test_initial_objects_are_frozen():
    there = [[] for _ in range(1000)]
    freeze_objects()
    assert gc.get_freeze_count() >= len(there)


def test_collections_are_rare_and_still_find_later_garbage():
    class Knot:
        """Refers to itself."""

        def __init__(self) -> None:
            self.own = self

    collect_rarely()
    assert gc.get_threshold()[0] > 100 * 100
    freeze_objects()
    Knot()
    assert gc.collect() > 0
