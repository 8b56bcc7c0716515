"""Every executor does and reports each task once, even after a worker has died."""

from __future__ import annotations

import os
import signal
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest

from real2sim_server.executors import (
    EXECUTORS,
    ExecutorError,
    Processes,
    RayCluster,
    executor_of,
)

TASKS = {f"task {k}": k for k in range(6)}
SQUARES = {f"task {k}": k * k for k in range(6)}


class Squares:
    """Squares numbers; dies once at one of them, or each time."""

    def __init__(self, mark: Path | None, always: bool, threads: int) -> None:
        assert threads >= 1
        self.mark, self.always = mark, always

    def make(self, number: int) -> int:
        if number == 3 and self.mark is not None and (self.always or not self.mark.exists()):
            self.mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return number * number


def done_by(executor, mark: Path | None = None, *, always: bool = False) -> dict[str, int]:
    found: dict[str, int] = {}

    def keep(name: str, result: int) -> None:
        assert name not in found
        found[name] = result

    executor.run(partial(Squares, mark, always), TASKS, keep)
    return found


def test_one_worker_does_all_in_this_process():
    assert done_by(executor_of("processes", workers=1)) == SQUARES


def test_tasks_of_a_process_that_dies_are_done_again(tmp_path):
    mark = tmp_path / "died"
    assert done_by(executor_of("processes", workers=2), mark) == SQUARES
    assert mark.exists()


def test_a_task_that_kills_every_process_is_an_error(tmp_path):
    with pytest.raises(ExecutorError, match="died 3 times"):
        done_by(Processes(1), tmp_path / "died", always=True)


def test_what_the_caller_raises_ends_the_run():
    def full(name, result):
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        Processes(1).run(partial(Squares, None, False), TASKS, full)


def test_unknown_executors_are_refused():
    with pytest.raises(ExecutorError, match="allowed are processes, ray"):
        executor_of("threads", workers=2)
    with pytest.raises(ExecutorError, match="at least 1"):
        executor_of(EXECUTORS[0], workers=0)


def test_a_missing_ray_is_reported_with_its_extra(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "ray", None)
    with pytest.raises(ExecutorError, match=r"real2sim\[ray\]"):
        RayCluster(1)


@pytest.mark.ray
@pytest.mark.slow
@pytest.mark.parametrize("dies", [False, True])
def test_ray_does_every_task_also_when_an_actor_dies(tmp_path, dies):
    pytest.importorskip("ray")
    mark = tmp_path / "died" if dies else None
    assert done_by(RayCluster(2), mark) == SQUARES
    assert mark is None or mark.exists()


class OneFreePlace:
    """As ``ray``, in a cluster that has room for the first actor only."""

    class exceptions:
        RayActorError = RuntimeError

    def __init__(self) -> None:
        self.calls: list[tuple[int, object]] = []

    def actor(self, number: int):
        def remote(call):
            return SimpleNamespace(remote=lambda *given: self._called(number, call, given))

        return SimpleNamespace(is_ready=remote("is_ready"), make=remote("make"))

    def _called(self, number, call, given):
        self.calls.append((number, (call, *given)))
        return len(self.calls) - 1

    def wait(self, calls, num_returns):
        done = [call for call in calls if self.calls[call][0] == 0]
        assert done, "it would wait for ever"
        return done[:num_returns], []

    def get(self, call):
        _, (kind, *given) = self.calls[call]
        return True if kind == "is_ready" else given[0] ** 2


def test_actors_that_a_cluster_has_no_room_for_are_not_waited_for():
    pytest.importorskip("ray")
    workers = RayCluster(2)
    workers._ray = cluster = OneFreePlace()
    found: dict[str, int] = {}
    workers._do_all([cluster.actor(0), cluster.actor(1)], TASKS, found.__setitem__)
    assert found == SQUARES
