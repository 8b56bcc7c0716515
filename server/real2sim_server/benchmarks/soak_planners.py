"""Planners for a soak: well-behaved ones, and every way to misbehave that the protocol knows.

Each moves its episode by one step and checks that it was answered as the protocol says.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from typing import Any

from real2sim_proto.sessions import SessionInfo

from .drive_probe import DriveProbe, action

DEADLINE_MS = 100
PUSHED_WITHIN_S = 30.0
"""However busy the machine, a missed deadline is told by then."""
FAULT_PERIOD = 10
"""Steps from one time to the next."""

Obs = dict[str, Any]


class SoakError(AssertionError):
    """An answer that is not as the protocol says."""


class SoakPlanner:
    """One controller of one session.

    Args:
        info: of its session.
        behaviour: key of ``BEHAVIOURS``.
        sensors: of its episodes.
        dt_us: step of the clock.

    Attributes:
        steps: answered so far.
        faults: so far, each answered as it should be.
        latencies_ms: of proper steps.
    """

    def __init__(
        self, info: SessionInfo, *, behaviour: str, sensors: list[dict[str, Any]], dt_us: int
    ) -> None:
        self.info, self.behaviour = info, behaviour
        self.steps = self.faults = 0
        self.latencies_ms: list[float] = []
        self._sensors, self._dt_us = sensors, dt_us
        self._probe = DriveProbe(info)
        self._obs: Obs = {}

    def __enter__(self) -> SoakPlanner:
        self._probe.__enter__()
        self._reset()
        return self

    def __exit__(self, *raised: Any) -> None:
        self._probe.__exit__(*raised)

    def step(self) -> None:
        """One step further, after a misdeed where one is due.

        Raises:
            SoakError: not answered as the protocol says.
        """
        if self._obs["terminated"] or self._obs["truncated"]:
            self._reset()
        inject_fault = BEHAVIOURS[self.behaviour]
        if inject_fault is not None and self._obs["step"] % FAULT_PERIOD == FAULT_PERIOD - 1:
            inject_fault(self)
            self.faults += 1
        else:
            self._go_on()

    def _reset(self) -> None:
        deadline = {"deadline_ms": DEADLINE_MS} if self.behaviour in {"hangs", "late"} else {}
        self._obs, _ = self._probe.reset(self._sensors, dt_us=self._dt_us, **deadline)
        self._probe.pushed = None

    def _go_on(self) -> None:
        answer, seconds = self._probe.ask(action(self._obs))
        if answer["type"] == "error" and self.behaviour in {"hangs", "late"}:
            # A busy machine may make any planner miss a deadline; the clock went on without it.
            self._require(answer, "STALE_STEP")
            self._catch_up()
            return
        self._moved_to(answer)
        self.latencies_ms.append(seconds * 1e3)

    def _moved_to(self, answer: Obs) -> None:
        if answer["type"] != "obs" or answer["step"] != self._obs["step"] + 1:
            raise SoakError(
                f"{self.behaviour}: step {self._obs['step']} was answered by {_short(answer)}"
            )
        self._obs = answer
        self.steps += 1

    def _catch_up(self) -> None:
        pushed = self._probe.pushed
        if pushed is None or pushed["step"] <= self._obs["step"]:
            raise SoakError(f"{self.behaviour}: no observation came although the clock went on")
        self.steps += pushed["step"] - self._obs["step"]
        self._obs = pushed

    def _require(self, answer: Obs, code: str) -> None:
        if answer["type"] != "error" or answer["code"] != code or answer["fatal"]:
            raise SoakError(f"{self.behaviour}: {code} expected, got {_short(answer)}")

    # --- misdeeds ---------------------------------------------------------------------------

    def hang(self) -> None:
        """Say nothing for several deadlines; the clock goes on and says so."""
        self._probe.listen(4 * DEADLINE_MS / 1e3, until_pushed=PUSHED_WITHIN_S)
        self._catch_up()

    def be_late(self) -> None:
        """Answer after the deadline; the plan is stale."""
        asked = action(self._obs)
        self._probe.listen(2 * DEADLINE_MS / 1e3, until_pushed=PUSHED_WITHIN_S)
        answer, _ = self._probe.ask(asked)
        self._require(answer, "STALE_STEP")
        self._catch_up()

    def answer_twice(self) -> None:
        """The same again gets the same again; another plan is a conflict."""
        asked = action(self._obs)
        self._go_on()
        again, _ = self._probe.ask(asked)
        if again["type"] != "obs" or again["step"] != self._obs["step"]:
            raise SoakError(f"the same action again was answered by {_short(again)}")
        other = copy.deepcopy(asked)
        other["plan"]["poses"][0][0] += 1.0
        self._require(self._probe.ask(other)[0], "STEP_CONFLICT")

    def answer_out_of_order(self) -> None:
        """Steps that are over, and steps that have not come."""
        for step, code in (
            (self._obs["step"] + 2, "BAD_STEP"),
            (self._obs["step"] - 2, "STALE_STEP"),
        ):
            self._require(self._probe.ask({**action(self._obs), "step": step})[0], code)
        self._go_on()

    def answer_nan(self) -> None:
        """A plan with a hole in it."""
        asked = action(self._obs)
        asked["plan"]["poses"][3][1] = math.nan
        self._require(self._probe.ask(asked)[0], "BAD_MESSAGE")
        self._go_on()

    def answer_too_short(self) -> None:
        """More times than poses."""
        asked = action(self._obs)
        asked["plan"]["poses"].pop()
        self._require(self._probe.ask(asked)[0], "BAD_MESSAGE")
        self._go_on()

    def drop(self) -> None:
        """Leave in the midst of a step, come back, and ask for it again."""
        asked, token = action(self._obs), self._probe.resume_token
        self._probe.send(asked)
        self._probe.socket.socket.close()
        self._probe.__exit__(None, None, None)
        self._probe = DriveProbe(self.info, resume=(token, self._obs["step"]))
        self._probe.__enter__()
        self._moved_to(self._probe.ask(asked)[0])


def _short(answer: Obs) -> str:
    return ", ".join(f"{k} {answer[k]}" for k in ("type", "step", "code", "detail") if k in answer)


BEHAVIOURS: dict[str, Callable[[SoakPlanner], None] | None] = {
    "proper": None,
    "hangs": SoakPlanner.hang,
    "late": SoakPlanner.be_late,
    "twice": SoakPlanner.answer_twice,
    "out of order": SoakPlanner.answer_out_of_order,
    "NaN": SoakPlanner.answer_nan,
    "wrong length": SoakPlanner.answer_too_short,
    "drops": SoakPlanner.drop,
}
"""What planners do once in ten steps."""
