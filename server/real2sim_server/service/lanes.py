"""Whose turn it is: waiting jobs of several kinds, which get the engine in proportion."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from enum import IntEnum
from itertools import compress
from typing import Generic, TypeVar

T = TypeVar("T")


class Lane(IntEnum):
    """Kinds of jobs, the most urgent first."""

    DRIVE = 0
    """Steps of sessions: somebody's vehicle waits."""
    VIEW = 1
    """Pictures that somebody looks at, and whatever else takes milliseconds."""
    BULK = 2
    """Large pictures, films, loading."""


WEIGHTS = {Lane.DRIVE: 16.0, Lane.VIEW: 4.0, Lane.BULK: 1.0}
"""Time that lanes get, in proportion, while all of them have work."""


class Lanes(Generic[T]):
    """Queues by lane. The next job is of the lane that has had least time for its weight (stride
    scheduling, Waldspurger & Weihl 1995), within a lane the first that came.

    A lane that was idle begins where the others are: it saves up nothing. Not safe to use on
    several threads at once.

    Args:
        length: jobs that may wait in each lane.
    """

    def __init__(self, length: int) -> None:
        self.length = length
        self._waiting: dict[Lane, deque[T]] = {lane: deque() for lane in Lane}
        self._running: list[Lane] = []
        self._passed_over = dict.fromkeys(Lane, 0)
        self._had = dict.fromkeys(Lane, 0.0)

    def __len__(self) -> int:
        return sum(map(len, self._waiting.values()))

    def waiting(self, lane: Lane) -> int:
        """Jobs that wait in a lane."""
        return len(self._waiting[lane])

    def append(self, job: T, lane: Lane) -> None:
        """Put a job at the end of a lane; whether there is room is for the caller to ask."""
        if not self._waiting[lane] and lane not in self._running:
            active = [self._had[other] for other in Lane if self._is_active(other)]
            self._had[lane] = max([self._had[lane], *([min(active)] if active else [])])
        self._waiting[lane].append(job)

    def begin_next(self) -> T | None:
        """The job whose turn it is, now running; None where none waits. Let :meth:`end` follow."""
        return self._begin(lane for lane in Lane if self._waiting[lane])

    def begin_more_urgent(self) -> T | None:
        """Like :meth:`begin_next`, but only of lanes more urgent than that of the running job, and
        not beyond what they may have."""
        present = self._running[-1]
        return self._begin(
            lane
            for lane in Lane
            if lane < present and self._waiting[lane] and self._had[lane] <= self._had[present]
        )

    def begin_with(self, joins: Callable[[T], bool]) -> list[T]:
        """Jobs of the lane of the job begun last that are run with it, in the order they came.

        They leave others behind that came before them. A job is left behind once at most: then it
        is run before any that came later.

        Args:
            joins: whether a job is run with it; asked for each in turn.
        """
        lane = self._running[-1]
        waiting, passed_over = self._waiting[lane], self._passed_over[lane]
        joined: list[T] = []
        stayed: list[T] = []
        behind = 0
        for place, job in enumerate(waiting):
            if joins(job):
                joined.append(job)
                behind = len(stayed)
            elif place < passed_over:
                behind = passed_over - len(joined)
                break
            else:
                stayed.append(job)
        if joined:
            taken = set(map(id, joined))
            self._waiting[lane] = deque(job for job in waiting if id(job) not in taken)
            self._passed_over[lane] = behind
        return joined

    def charge(self, seconds: float) -> None:
        """Count time to the lane of the job begun last."""
        lane = self._running[-1]
        self._had[lane] += seconds / WEIGHTS[lane]

    def end(self) -> None:
        """The job begun last has ended."""
        self._running.pop()

    def discard(self, unwanted: Callable[[T], bool]) -> None:
        """Drop waiting jobs."""
        for lane, jobs in self._waiting.items():
            if any(map(unwanted, jobs)):
                kept = [not unwanted(job) for job in jobs]
                self._passed_over[lane] = sum(kept[: self._passed_over[lane]])
                self._waiting[lane] = deque(compress(jobs, kept))

    def take_all(self) -> list[T]:
        """All that wait, which wait no more."""
        jobs = [job for lane in Lane for job in self._waiting[lane]]
        for lane, waiting in self._waiting.items():
            waiting.clear()
            self._passed_over[lane] = 0
        return jobs

    def _is_active(self, lane: Lane) -> bool:
        return bool(self._waiting[lane]) or lane in self._running

    def _begin(self, candidates: Iterable[Lane]) -> T | None:
        lane = min(candidates, key=lambda lane: (self._had[lane], lane), default=None)
        if lane is None:
            return None
        self._running.append(lane)
        self._passed_over[lane] = max(0, self._passed_over[lane] - 1)
        return self._waiting[lane].popleft()
