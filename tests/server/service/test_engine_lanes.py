from __future__ import annotations

from collections import Counter

import pytest

from real2sim_server.service.engine import WEIGHTS, Lane, Lanes


def filled(**counts: int) -> Lanes[str]:
    lanes: Lanes[str] = Lanes(1000)
    for name, count in counts.items():
        for k in range(count):
            lanes.append(f"{name} {k}", Lane[name.upper()])
    return lanes


def run(lanes: Lanes[str], jobs: int, seconds: float = 0.01) -> list[str]:
    """Names of the jobs that had their turn, each of the same length."""
    begun = []
    for _ in range(jobs):
        job = lanes.begin_next()
        assert job is not None
        lanes.charge(seconds)
        lanes.end()
        begun.append(job)
    return begun


def test_jobs_of_a_lane_run_in_the_order_they_came():
    assert run(filled(view=3), 3) == ["view 0", "view 1", "view 2"]


def test_of_lanes_that_have_had_nothing_the_most_urgent_is_first():
    assert run(filled(bulk=1, view=1, drive=1), 3) == ["drive 0", "view 0", "bulk 0"]


def test_busy_lanes_get_time_in_proportion_to_their_weights():
    begun = run(filled(drive=400, view=400, bulk=400), 420)
    had = Counter(job.split()[0] for job in begun)
    assert had == pytest.approx({"drive": 320, "view": 80, "bulk": 20}, abs=1)
    assert [WEIGHTS[lane] for lane in Lane] == [16, 4, 1]


def test_a_lane_that_was_idle_has_saved_up_nothing():
    lanes = filled(drive=200)
    run(lanes, 100)
    for k in range(100):
        lanes.append(f"bulk {k}", Lane.BULK)
    had = Counter(job.split()[0] for job in run(lanes, 34))
    assert had["bulk"] == 2


def test_between_pieces_only_more_urgent_jobs_have_their_turn():
    lanes = filled(view=1)
    assert lanes.begin_next() == "view 0"
    lanes.append("bulk", Lane.BULK)
    lanes.append("view 1", Lane.VIEW)
    assert lanes.begin_more_urgent() is None
    lanes.append("drive", Lane.DRIVE)
    assert lanes.begin_more_urgent() == "drive"


def test_urgent_jobs_do_not_starve_the_one_that_gives_way():
    lanes = filled(bulk=1)
    lanes.begin_next()
    begun = 0
    for k in range(1000):
        lanes.append(f"drive {k}", Lane.DRIVE)
    lanes.charge(0.020)
    while lanes.begin_more_urgent() is not None:
        lanes.charge(0.020)
        lanes.end()
        begun += 1
    assert begun == 17
    lanes.charge(0.020)
    assert lanes.begin_more_urgent() is not None


def test_jobs_nobody_wants_any_more_leave_their_lane():
    lanes = filled(drive=2, bulk=2)
    lanes.discard(lambda job: job.endswith("0"))
    assert len(lanes) == 2
    assert lanes.take_all() == ["drive 1", "bulk 1"]
    assert lanes.begin_next() is None


def a_begun_lane(*names: str) -> Lanes[str]:
    lanes: Lanes[str] = Lanes(1000)
    for name in names:
        lanes.append(name, Lane.DRIVE)
    lanes.begin_next()
    return lanes


def test_jobs_that_join_the_running_one_leave_the_others_in_their_order():
    lanes = a_begun_lane("a1", "a2", "b1", "a3", "b2")
    assert lanes.begin_with(lambda job: job[0] == "a") == ["a2", "a3"]
    lanes.end()
    assert [lanes.begin_next(), lanes.begin_next()] == ["b1", "b2"]


def test_a_job_is_left_behind_once_at_most():
    lanes = a_begun_lane("a1", "a2", "c1", "b1", "a3")
    joined = iter([True, False, False, True])
    assert lanes.begin_with(lambda _: next(joined)) == ["a2", "a3"]
    lanes.append("c2", Lane.DRIVE)
    assert lanes.begin_next() == "c1"
    assert lanes.begin_with(lambda job: job[0] == "c") == []
    assert [lanes.begin_next(), lanes.begin_next()] == ["b1", "c2"]


def test_jobs_that_leave_a_lane_do_not_move_who_was_left_behind():
    lanes = a_begun_lane("a1", "b1", "b2", "a2")
    assert lanes.begin_with(lambda job: job[0] == "a") == ["a2"]
    lanes.discard(lambda job: job == "b1")
    lanes.append("a3", Lane.DRIVE)
    assert lanes.begin_with(lambda job: job[0] == "a") == []
    lanes.begin_next()
    lanes.append("b3", Lane.DRIVE)
    assert lanes.begin_with(lambda job: job[0] == "b") == ["b3"]
