"""``real2sim bench soak``: many concurrent sessions for a long time, with misbehaving planners.

Checks that all steps are answered and that the worker's memory does not grow. Half of the sessions
behave properly; the others cycle through the kinds of misbehaviour. Half have a camera.
"""

from __future__ import annotations

import copy
import math
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

import real2sim
from real2sim_proto.sessions import SessionInfo
from real2sim_server.demo.run import worker_process
from real2sim_server.scene.io import save_scene
from real2sim_server.synthetic.gaussian_street import street

from .drive_probe import DriveProbe, action
from .serve import percentiles, resident_bytes

# Planners: well-behaved ones, and every kind of misbehaviour that the protocol handles. Each
# advances its episode by one step and checks the answer.

DEADLINE_MS = 100
PUSHED_WITHIN_S = 30.0
"""Maximum time until the worker reports a missed deadline, even on a busy machine [s]."""
FAULT_PERIOD = 10
"""Steps between faults."""

Obs = dict[str, Any]


class SoakError(AssertionError):
    """A reply that violates the protocol."""


class SoakPlanner:
    """Controller of a session.

    Args:
        info: the session.
        behaviour: key of ``BEHAVIOURS``.
        sensors: sensors of its episodes.
        dt_us: time step [us].

    Attributes:
        steps: number of answered steps.
        faults: number of faults that were handled correctly.
        latencies_ms: latencies of proper steps [ms].
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
        """Advance by one step, with a fault if one is due.

        Raises:
            SoakError: the reply violates the protocol.
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
            # On a busy machine any planner may miss a deadline; the clock has advanced without it.
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

    # --- Faults -----------------------------------------------------------------------------

    def hang(self) -> None:
        """Stay silent for several deadlines; the clock advances and observations are pushed."""
        self._probe.listen(4 * DEADLINE_MS / 1e3, until_pushed=PUSHED_WITHIN_S)
        self._catch_up()

    def be_late(self) -> None:
        """Send a plan after the deadline; it is stale."""
        asked = action(self._obs)
        self._probe.listen(2 * DEADLINE_MS / 1e3, until_pushed=PUSHED_WITHIN_S)
        answer, _ = self._probe.ask(asked)
        self._require(answer, "STALE_STEP")
        self._catch_up()

    def answer_twice(self) -> None:
        """Repeat an action, which repeats the reply; then send another plan: a conflict."""
        asked = action(self._obs)
        self._go_on()
        again, _ = self._probe.ask(asked)
        if again["type"] != "obs" or again["step"] != self._obs["step"]:
            raise SoakError(f"the same action again was answered by {_short(again)}")
        other = copy.deepcopy(asked)
        other["plan"]["poses"][0][0] += 1.0
        self._require(self._probe.ask(other)[0], "STEP_CONFLICT")

    def answer_out_of_order(self) -> None:
        """Send actions for future and past steps."""
        for step, code in (
            (self._obs["step"] + 2, "BAD_STEP"),
            (self._obs["step"] - 2, "STALE_STEP"),
        ):
            self._require(self._probe.ask({**action(self._obs), "step": step})[0], code)
        self._go_on()

    def answer_nan(self) -> None:
        """Send a plan with NaN."""
        asked = action(self._obs)
        asked["plan"]["poses"][3][1] = math.nan
        self._require(self._probe.ask(asked)[0], "BAD_MESSAGE")
        self._go_on()

    def answer_too_short(self) -> None:
        """Send a plan with more times than poses."""
        asked = action(self._obs)
        asked["plan"]["poses"].pop()
        self._require(self._probe.ask(asked)[0], "BAD_MESSAGE")
        self._go_on()

    def drop(self) -> None:
        """Disconnect within a step, reconnect, and repeat the action."""
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
"""Fault of each behaviour, injected every FAULT_PERIOD steps."""


SCENE = "street"
DT_US = 100_000
CAMERA = {"camera": "front", "codec": "raw", "modalities": ["rgb"]}
WARM_UP_SHARE = 0.2
SAMPLE_PERIOD_S = 2.0
GROWTH_MB = 16.0
"""Allowed growth of memory after warm-up [MB]; allocators fluctuate by this much."""

Figures = dict[str, Any]


@dataclass(frozen=True)
class SoakOptions:
    """Size of the soak test.

    Attributes:
        sessions: number of concurrent sessions.
        minutes: total duration; the first fifth is warm-up [min].
        rate_hz: maximum steps per second of each session.
        gaussians, width: Gaussians of the scene, and image width of its camera [px].
    """

    sessions: int = 16
    minutes: float = 10.0
    rate_hz: float = 10.0
    gaussians: int = 100_000
    width: int = 160


@dataclass(eq=False)
class Memory:
    """Resident memory of the worker over time: seconds [s] and sizes [MB]."""

    seconds: list[float] = field(default_factory=list)
    mb: list[float] = field(default_factory=list)

    def figures(self, warm_s: float) -> Figures:
        """Memory at the start, after warm-up and at the end [MB], and the slope [MB/min]."""
        seconds, mb = np.array(self.seconds), np.array(self.mb)
        warm = seconds >= warm_s
        slope = np.polyfit(seconds[warm] / 60, mb[warm], 1)[0] if warm.sum() > 1 else float("nan")
        tenth = max(int(warm.sum()) // 10, 1)
        return {
            "start_mb": float(mb[0]),
            "warm_mb": float(np.median(mb[warm][:tenth])),
            "end_mb": float(np.median(mb[warm][-tenth:])),
            "slope_mb_per_minute": float(slope),
            "curve": [[round(s, 1), round(m, 2)] for s, m in zip(seconds, mb, strict=True)],
        }


def run(options: SoakOptions | None = None) -> Figures:
    """Run the soak test on a new worker; print a table and return its figures.

    ``failures`` lists violations of the protocol; ``grows`` is whether memory grew.
    """
    options = options or SoakOptions()
    console = Console()
    with tempfile.TemporaryDirectory(prefix="real2sim-soak-") as folder:
        root = Path(folder)
        size = {"width": options.width, "height": options.width * 2 // 3}
        save_scene(
            street(SCENE, gaussians=options.gaussians, **size), root / "scenes" / "street.r2s"
        )
        places = {"scenes": root / "scenes", "data": root, "log_file": root / "worker.log"}
        with worker_process(**places) as worker, real2sim.connect(worker.url) as client:
            client.wait_ready()
            client.scenes.load(SCENE)
            figures = _soak(console, client, options, pid=worker.process.pid)
    _print(console, figures)
    return figures


def _soak(console: Console, client: real2sim.Client, options: SoakOptions, *, pid: int) -> Figures:
    memory, failures = Memory(), list[str]()
    infos = [client.sessions.create(scene=SCENE) for _ in range(options.sessions)]
    planners = [
        SoakPlanner(info, behaviour=behaviour, sensors=[CAMERA] if k % 2 else [], dt_us=DT_US)
        for k, (info, behaviour) in enumerate(zip(infos, behaviours(options.sessions), strict=True))
    ]
    stop = threading.Event()
    threads = [
        threading.Thread(target=_drive, args=(p, options.rate_hz, stop, failures), daemon=True)
        for p in planners
    ]
    started = time.monotonic()
    for thread in threads:
        thread.start()
    with console.status("soaking") as status:
        while (passed := time.monotonic() - started) < options.minutes * 60:
            memory.seconds.append(passed)
            memory.mb.append(resident_bytes(pid) / 1e6)
            steps = sum(p.steps for p in planners)
            status.update(f"{passed:.0f} s, {steps} steps, {memory.mb[-1]:.0f} MB")
            time.sleep(min(SAMPLE_PERIOD_S, options.minutes * 6))
    stop.set()
    for thread in threads:
        thread.join(60)
    for info in infos:
        client.sessions.delete(info.session_id)
    return _figures(options, planners, memory, failures)


def behaviours(sessions: int) -> list[str]:
    """Behaviour of each session: every second one is proper, the others cycle through faults."""
    bad = [name for name, inject_fault in BEHAVIOURS.items() if inject_fault is not None]
    return [
        "proper" if k % 4 in {0, 1} else bad[(k // 4 * 2 + k % 4) % len(bad)]
        for k in range(sessions)
    ]


def _drive(
    planner: SoakPlanner, rate_hz: float, stop: threading.Event, failures: list[str]
) -> None:
    try:
        with planner:
            due = time.monotonic()
            while not stop.is_set():
                planner.step()
                due = max(due + 1 / rate_hz, time.monotonic() - 1 / rate_hz)
                stop.wait(max(due - time.monotonic(), 0.0))
    except Exception as error:
        failures.append(f"{planner.behaviour}: {type(error).__name__}: {error}")


def _figures(
    options: SoakOptions, planners: Sequence[SoakPlanner], memory: Memory, failures: Sequence[str]
) -> Figures:
    latencies = [ms for p in planners if p.behaviour == "proper" for ms in p.latencies_ms]
    memory_figures = memory.figures(options.minutes * 60 * WARM_UP_SHARE)
    return {
        "setup": vars(options),
        "steps_answered": sum(p.steps for p in planners),
        "proper_step_ms": percentiles(latencies) if latencies else None,
        "by_habit": {
            name: {
                "sessions": sum(p.behaviour == name for p in planners),
                "steps": sum(p.steps for p in planners if p.behaviour == name),
                "misdeeds": sum(p.faults for p in planners if p.behaviour == name),
            }
            for name in BEHAVIOURS
        },
        "failures": list(failures),
        "memory": memory_figures,
        "grows": memory_figures["end_mb"] - memory_figures["warm_mb"] > GROWTH_MB,
    }


def _print(console: Console, figures: Figures) -> None:
    table = Table("planners", "sessions", "steps", "misdeeds", title="soak", title_justify="left")
    for name, row in figures["by_habit"].items():
        table.add_row(name, *(str(row[k]) for k in ("sessions", "steps", "misdeeds")))
    console.print(table)
    if (ms := figures["proper_step_ms"]) is not None:
        console.print(f"steps of proper planners: p50 {ms['p50']:.1f} ms, p99 {ms['p99']:.1f} ms")
    memory = figures["memory"]
    console.print(
        f"{figures['steps_answered']} steps answered; memory {memory['start_mb']:.0f} MB at the "
        f"start, {memory['warm_mb']:.0f} warm, {memory['end_mb']:.0f} at the end "
        f"({memory['slope_mb_per_minute']:+.2f} MB/min)"
    )
    for failure in figures["failures"]:
        console.print(f"[red]{failure}[/red]", highlight=False)
