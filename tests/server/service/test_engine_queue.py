from __future__ import annotations

from collections import Counter

import pytest

from real2sim_server.service.engine import WEIGHTS, Priority, PriorityQueue


def filled(**counts: int) -> PriorityQueue[str]:
    queue: PriorityQueue[str] = PriorityQueue(1000)
    for name, count in counts.items():
        for k in range(count):
            queue.append(f"{name} {k}", Priority[name.upper()])
    return queue


def run(queue: PriorityQueue[str], jobs: int, seconds: float = 0.01) -> list[str]:
    """Names of the jobs in the order they ran, all of the same duration."""
    begun = []
    for _ in range(jobs):
        job = queue.begin_next()
        assert job is not None
        queue.charge(seconds)
        queue.end()
        begun.append(job)
    return begun


def test_jobs_of_one_priority_run_in_order():
    assert run(filled(view=3), 3) == ["view 0", "view 1", "view 2"]


def test_the_most_urgent_job_runs_first_while_nothing_is_charged():
    assert run(filled(bulk=1, view=1, drive=1), 3) == ["drive 0", "view 0", "bulk 0"]


def test_busy_priorities_share_time_by_weight():
    begun = run(filled(drive=400, view=400, bulk=400), 420)
    had = Counter(job.split()[0] for job in begun)
    assert had == pytest.approx({"drive": 320, "view": 80, "bulk": 20}, abs=1)
    assert [WEIGHTS[priority] for priority in Priority] == [16, 4, 1]


def test_an_idle_priority_accumulates_no_credit():
    queue = filled(drive=200)
    run(queue, 100)
    for k in range(100):
        queue.append(f"bulk {k}", Priority.BULK)
    had = Counter(job.split()[0] for job in run(queue, 34))
    assert had["bulk"] == 2


def test_only_more_urgent_jobs_run_during_a_yield():
    queue = filled(view=1)
    assert queue.begin_next() == "view 0"
    queue.append("bulk", Priority.BULK)
    queue.append("view 1", Priority.VIEW)
    assert queue.begin_more_urgent() is None
    queue.append("drive", Priority.DRIVE)
    assert queue.begin_more_urgent() == "drive"


def test_urgent_jobs_do_not_starve_a_yielding_job():
    queue = filled(bulk=1)
    queue.begin_next()
    begun = 0
    for k in range(1000):
        queue.append(f"drive {k}", Priority.DRIVE)
    queue.charge(0.020)
    while queue.begin_more_urgent() is not None:
        queue.charge(0.020)
        queue.end()
        begun += 1
    assert begun == 17
    queue.charge(0.020)
    assert queue.begin_more_urgent() is not None


def test_discarded_jobs_are_removed_from_their_queues():
    queue = filled(drive=2, bulk=2)
    queue.discard(lambda job: job.endswith("0"))
    assert len(queue) == 2
    assert queue.take_all() == ["drive 1", "bulk 1"]
    assert queue.begin_next() is None


def a_begun_priority(*names: str) -> PriorityQueue[str]:
    queue: PriorityQueue[str] = PriorityQueue(1000)
    for name in names:
        queue.append(name, Priority.DRIVE)
    queue.begin_next()
    return queue


def test_batched_jobs_leave_the_order_of_the_others_unchanged():
    queue = a_begun_priority("a1", "a2", "b1", "a3", "b2")
    assert queue.begin_with(lambda job: job[0] == "a") == ["a2", "a3"]
    queue.end()
    assert [queue.begin_next(), queue.begin_next()] == ["b1", "b2"]


def test_a_job_is_overtaken_at_most_once():
    queue = a_begun_priority("a1", "a2", "c1", "b1", "a3")
    joined = iter([True, False, False, True])
    assert queue.begin_with(lambda _: next(joined)) == ["a2", "a3"]
    queue.append("c2", Priority.DRIVE)
    assert queue.begin_next() == "c1"
    assert queue.begin_with(lambda job: job[0] == "c") == []
    assert [queue.begin_next(), queue.begin_next()] == ["b1", "c2"]


def test_discarded_jobs_do_not_change_which_job_was_overtaken():
    queue = a_begun_priority("a1", "b1", "b2", "a2")
    assert queue.begin_with(lambda job: job[0] == "a") == ["a2"]
    queue.discard(lambda job: job == "b1")
    queue.append("a3", Priority.DRIVE)
    assert queue.begin_with(lambda job: job[0] == "a") == []
    queue.begin_next()
    queue.append("b3", Priority.DRIVE)
    assert queue.begin_with(lambda job: job[0] == "b") == ["b3"]
