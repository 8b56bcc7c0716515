"""Planners for tests of what judges them, most of which misbehave."""

from __future__ import annotations

import contextlib
import os
import resource
import select
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

from real2sim.planners import FollowRoute, Needs
from tests.waiting import LIMIT_S

ALIVE = "TEST_PLANNERS_ALIVE"
"""Environment variable: a named pipe, held open by every process that imports this module."""
STEP = 3

if ALIVE in os.environ:
    os.open(os.environ[ALIVE], os.O_WRONLY)


@contextlib.contextmanager
def none_left_running(folder: Path) -> Iterator[None]:
    """Run planners of this module; at the end, all their processes must have ended."""
    pipe = folder / "alive"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    os.environ[ALIVE] = str(pipe)
    try:
        yield
        # The system reports a hang-up once there were writers and all of them have ended.
        ended = select.poll()
        ended.register(reader, 0)
        assert ended.poll(1000 * LIMIT_S), "a process of a planner is left"
    finally:
        del os.environ[ALIVE]
        os.close(reader)


class _Misbehaves(FollowRoute):
    def plan(self, obs):
        return super().plan(obs) if obs.step < STEP else self.misbehave(obs)


class Exits(_Misbehaves):
    def misbehave(self, obs):
        os._exit(3)


class Killed(_Misbehaves):
    def misbehave(self, obs):
        os.kill(os.getpid(), signal.SIGKILL)
        signal.pause()


class Hangs(_Misbehaves):
    def misbehave(self, obs):
        while True:
            signal.pause()


class Floods(_Misbehaves):
    def misbehave(self, obs):
        while True:
            os.write(1, b"x" * 1000)
            os.write(2, b"y" * 1000)


class CannotBeMade(_Misbehaves):
    def __init__(self):
        raise ValueError("no weights")


class CannotReset(_Misbehaves):
    def reset(self, obs):
        raise KeyError("map")


class Raises(_Misbehaves):
    def misbehave(self, obs):
        raise RuntimeError("boom")


class Leaves(_Misbehaves):
    def misbehave(self, obs):
        sys.exit("no more")


class WrongType(_Misbehaves):
    def misbehave(self, obs):
        return 7


class NotANumber(_Misbehaves):
    def misbehave(self, obs):
        pose = (float("nan"), 0.0, 0.0)
        return {"kind": "trajectory", "times_us": [obs.t_us + 1_000_000], "poses": [pose]}


class ClosesPipes(_Misbehaves):
    def misbehave(self, obs):
        os.closerange(0, 256)
        return super().plan(obs)


class Forks(_Misbehaves):
    """Its child inherits the connection, and outlives it."""

    def misbehave(self, obs):
        if os.fork() == 0:
            while True:
                signal.pause()
        os._exit(4)


class EatsMemory(_Misbehaves):
    def misbehave(self, obs):
        resource.setrlimit(resource.RLIMIT_AS, (2 << 30, resource.RLIM_INFINITY))
        return bytearray(4 << 30)


class _EveryCamera(Needs):
    def sensors(self, cameras):
        return [{"camera": c.name, "modalities": ["rgb"], "width": 48} for c in cameras]


class Sees(FollowRoute):
    """Steers by its images, and chooses its cameras itself."""

    class needs(Needs):
        def sensors(self, cameras):
            return [{"camera": c.name, "modalities": ["rgb"], "width": 48} for c in cameras]

    needs = needs(privileged=True, action="control", width=48)

    def plan(self, obs):
        total = float(obs["front"].sum()) + sum(agent.velocity[0] for agent in obs.agents)
        return {"acceleration": (total % 7919.0) / 7919.0 / 3.0, "steering": 0.0}


class GoodBesideItsForks(FollowRoute):
    """Each child returns from ``plan`` as well; another one never ends."""

    def plan(self, obs):
        if os.fork() == 0 and os.fork() == 0:
            while True:
                signal.pause()
        return super().plan(obs)


REASONS = {
    "Exits": "the planner ended with exit code 3 at step 3",
    "Killed": "the planner was killed by signal 9 at step 3",
    "CannotBeMade": "ValueError: no weights",
    "CannotReset": "KeyError: 'map'",
    "Raises": "RuntimeError: boom",
    "Leaves": "SystemExit: no more",
    "WrongType": "plan refused: plan: 7 is a int",
    "NotANumber": "plan refused: plan: ",
    "ClosesPipes": "the planner closed the connection of its process at step 3",
    "Forks": "the planner ended with exit code 4 at step 3",
    "EatsMemory": "MemoryError: ",
}
"""What is reported of each planner that ends or answers by itself."""
NEVER_ANSWER = {"Hangs": "the planner gave no ", "Floods": "the planner gave no "}
ALL = {name: f"{__name__}:{name}" for name in (*REASONS, *NEVER_ANSWER)}
"""Names for ``load_planner``."""
AND_LIMITS = ((REASONS, 60.0), (NEVER_ANSWER, 1.0))
"""Misbehaviours and their reasons, with a time limit [s]: a short one only where it is reached."""
