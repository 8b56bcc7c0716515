"""Planners in processes of their own, so that a planner that fails costs only its episode.

A process serves one planner and answers one request at a time over a socket. Requests are pickled.
Answers are messages of the codec, so the caller never runs code of a planner. :func:`serve` is the
main function of the process.
"""

from __future__ import annotations

import atexit
import contextlib
import dataclasses
import json
import os
import pickle
import select
import signal
import socket
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import IO, TYPE_CHECKING, Any, Self

from real2sim._protocol import valid_plan
from real2sim.planners import Needs, Planner, UnknownPlannerError, load_planner, needs_of
from real2sim_proto import CodecError, decode, encode

if TYPE_CHECKING:
    from real2sim import Observation
    from real2sim_proto.plans import Plan
    from real2sim_proto.scenes import CameraInfo

PLAN_LIMIT_S = 60.0
"""Default time limit for each answer of a planner [s]: to be loaded, to reset, to plan."""
START_S, END_S = 120.0, 5.0
"""Time limits for a process to start before it loads its planner, and to exit [s]."""
CHECK_S = 0.05
"""Interval of checks whether a process that does not answer has ended [s]."""
MAX_ANSWER_BYTES = 1 << 26
OUTPUT_BYTES = 1 << 16
"""Output of a process that is passed on to standard error; the rest is discarded."""
ERROR_LENGTH = 500
CLOSED = 113
"""Exit code of a process whose connection the planner has closed."""
_LENGTH = 8
_PROGRAM = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[2]); "
    "from real2sim_server.policies.planner_process import serve; serve(int(sys.argv[1]))"
)


class PlannerFailedError(Exception):
    """A planner raised an exception, sent no valid plan in time, or ended; says which."""


class PlannerProcesses:
    """A process for each planner, started when it is first loaded and again after it has ended.

    For use in one thread at a time. The processes end with :meth:`close`, or with this object.

    Args:
        limit_s: time limit for each answer of a planner [s].
        threads: number of threads that a planner's libraries use; None leaves it to them.
    """

    def __init__(self, limit_s: float = PLAN_LIMIT_S, *, threads: int | None = None) -> None:
        self._limit_s, self._threads = limit_s, threads
        self._processes: dict[str, _Process] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def load(self, name: str) -> RemotePlanner:
        """A new planner with this name. If its loading fails, its ``reset`` raises the reason.

        Raises:
            ValueError: no such planner.
        """
        process = self._processes.get(name)
        if process is None:
            process = self._processes[name] = _Process(self._limit_s, self._threads)
        return RemotePlanner(name, process)

    def close(self) -> None:
        """End the processes."""
        for process in self._processes.values():
            process.close(patience_s=END_S)
        self._processes.clear()


class RemotePlanner:
    """A planner in another process; its methods raise :class:`PlannerFailedError`.

    Like the planner itself, it has the attributes ``needs`` and ``begin`` only if that has them.
    """

    def __init__(self, name: str, process: _Process) -> None:
        self._process = process
        self._failure: PlannerFailedError | None = None
        try:
            self._describe(process.ask("load", name, "while it was loaded"))
        except PlannerFailedError as error:
            self._failure = error

    def reset(self, obs: Observation) -> None:
        """Reset the planner."""
        if self._failure is not None:
            raise self._failure
        self._process.ask("reset", obs, "in reset")

    def plan(self, obs: Observation) -> Plan:
        """The planner's plan."""
        answer = self._process.ask("plan", obs, f"at step {obs.step}")
        try:
            return valid_plan(answer["plan"])
        except (KeyError, ValueError) as error:
            raise PlannerFailedError(f"plan refused: {error}"[:ERROR_LENGTH]) from error

    def _begin(self, welcome: Any) -> None:
        self._describe(self._process.ask("begin", welcome, "in begin"))

    def _describe(self, answer: Mapping[str, Any]) -> None:
        if answer["begins"]:
            self.begin = self._begin
        if (needs := answer["needs"]) is not None:
            fields: dict[str, Any] = dict(needs)
            fields |= {k: tuple(v) for k, v in needs.items() if isinstance(v, list)}
            chooses = answer["chooses_sensors"]
            self.needs = _RemoteNeeds(**fields, process=self._process if chooses else None)


@dataclass(frozen=True)
class _RemoteNeeds(Needs):
    process: _Process | None = None

    def sensors(self, cameras: Sequence[CameraInfo]) -> list[dict[str, Any]]:
        if self.process is None:
            return super().sensors(cameras)
        chosen = self.process.ask("sensors", list(cameras), "as it chose its cameras")
        sensors: list[dict[str, Any]] = chosen["sensors"]
        return sensors


class _Process:
    """The caller's side of a process; it starts with the first request."""

    def __init__(self, limit_s: float, threads: int | None) -> None:
        self._limit_s, self._threads = limit_s, threads
        self._running: subprocess.Popen[bytes] | None = None
        self._link: socket.socket
        self._end: Any = None

    def ask(self, kind: str, given: Any, when: str) -> dict[str, Any]:
        """The planner's answer to a request.

        Args:
            kind, given: the request, see ``_answer``.
            when: added to the reason if the process ends or does not answer.

        Raises:
            PlannerFailedError: the planner failed. If it still runs, its process is killed, unless
                it only raised an exception.
            ValueError: no such planner.
        """
        try:
            if self._running is None:
                self._start()
            deadline = time.monotonic() + self._limit_s
            request = pickle.dumps((kind, given))
            self._link.settimeout(self._limit_s)
            self._link.sendall(len(request).to_bytes(_LENGTH, "big") + request)
            answer = decode(self._receive(deadline))
        except TimeoutError:
            what = "plan" if kind == "plan" else "answer"
            reason = f"the planner gave no {what} within {self._limit_s:g} s {when}"
        except CodecError as error:
            reason = f"the planner gave an unreadable answer {when}: {error}"
        except (EOFError, OSError):
            reason = f"the planner {self._ending()} {when}"
        else:
            if (unknown := answer.get("unknown")) is not None:
                raise ValueError(unknown)
            if (failure := answer.get("error")) is not None:
                raise PlannerFailedError(failure)
            return answer
        self.close()
        raise PlannerFailedError(reason)

    def close(self, *, patience_s: float = 0.0) -> None:
        """End the process and all that it started; it has ``patience_s`` to exit by itself."""
        if self._running is not None:
            self._end.detach()
            _end(self._running, self._link, patience_s)
            self._running = None

    def _start(self) -> None:
        self._link, theirs = socket.socketpair()
        environment = dict(os.environ)
        if self._threads is not None:
            names = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
            environment |= dict.fromkeys(names, str(self._threads))
        with theirs:
            self._running = subprocess.Popen(
                [sys.executable, "-P", "-c", _PROGRAM, str(theirs.fileno()), json.dumps(sys.path)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                pass_fds=[theirs.fileno()],
                env=environment,
                start_new_session=True,
            )
        self._end = weakref.finalize(self, _end, self._running, self._link, END_S)
        threading.Thread(target=_pass_on, args=(self._running.stdout,), daemon=True).start()
        self._receive(time.monotonic() + START_S)

    def _receive(self, deadline: float) -> bytes:
        """One message of the process. Raises TimeoutError, EOFError, OSError or CodecError."""
        size = int.from_bytes(self._read(_LENGTH, deadline), "big")
        if size > MAX_ANSWER_BYTES:
            raise CodecError(f"{size} bytes are more than {MAX_ANSWER_BYTES}")
        return self._read(size, deadline)

    def _read(self, size: int, deadline: float) -> bytes:
        assert self._running is not None
        parts = bytearray()
        self._link.settimeout(CHECK_S)
        while len(parts) < size:
            # A child of the planner can keep the connection open.
            ended = self._running.poll() is not None
            try:
                part = self._link.recv(min(size - len(parts), 1 << 20))
            except TimeoutError:
                if ended:
                    raise EOFError from None
                if time.monotonic() > deadline:
                    raise
                continue
            if not part:
                raise EOFError
            parts += part
        return bytes(parts)

    def _ending(self) -> str:
        """How the process ended."""
        if self._running is None:
            return "could not be started"
        try:
            code = self._running.wait(END_S)
        except subprocess.TimeoutExpired:
            code = CLOSED
        if code == CLOSED:
            return "closed the connection of its process"
        return f"was killed by signal {-code}" if code < 0 else f"ended with exit code {code}"


def _end(process: subprocess.Popen[bytes], link: socket.socket, patience_s: float) -> None:
    """End a process and its group."""
    link.close()
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(patience_s)
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(END_S)


def _pass_on(output: IO[bytes]) -> None:
    """Pass the first part of a process's output on to standard error, and discard the rest."""
    left = OUTPUT_BYTES
    with output:
        while data := os.read(output.fileno(), 1 << 16):
            if left > 0:
                with contextlib.suppress(OSError):
                    os.write(2, data[:left])
                    if len(data) >= left:
                        os.write(2, b"\n... (further output of the planner is discarded)\n")
                left -= len(data)


# --- In the process -------------------------------------------------------------------------------


def serve(descriptor: int) -> None:
    """Answer requests on a socket until its other end closes; then end the process's group."""
    link, own_pid = socket.socket(fileno=descriptor), os.getpid()
    requests = link.makefile("rb")
    sys.argv = sys.argv[:1]
    # The first function registered is the last one called.
    atexit.register(os.killpg, 0, signal.SIGKILL)
    threading.Thread(target=_end_with_caller, args=(link,), daemon=True).start()
    planner: Any = None
    message = encode({})
    try:
        while True:
            link.sendall(len(message).to_bytes(_LENGTH, "big") + message)
            if not (size := requests.read(_LENGTH)):
                return
            kind, given = pickle.loads(requests.read(int.from_bytes(size, "big")))
            try:
                if kind == "load":
                    planner = None
                    planner = load_planner(given)
                message = encode(_answer(planner, kind, given))
            except UnknownPlannerError as error:
                message = encode({"unknown": str(error)})
            except BaseException as error:  # A planner may raise anything, SystemExit included.
                message = encode({"error": _described(error)})
            if os.getpid() != own_pid:
                os._exit(0)  # A fork of the planner returned here.
    except OSError:
        os._exit(CLOSED)


def _answer(planner: Planner, kind: str, given: Any) -> dict[str, Any]:
    """The answer to a request.

    ``load`` and ``begin`` describe the planner, ``sensors`` has the sensors for cameras, and
    ``plan`` the plan for an observation.
    """
    if kind == "plan":
        plan = planner.plan(given)
        try:
            return {"plan": valid_plan(plan).model_dump()}
        except ValueError as error:
            return {"error": f"plan refused: {error}"[:ERROR_LENGTH]}
    if kind == "reset":
        planner.reset(given)
        return {}
    if kind == "sensors":
        return {"sensors": needs_of(planner).sensors(given)}
    if kind == "begin":
        planner.begin(given)  # type: ignore[attr-defined]
    needs = needs_of(planner)
    fields = {f.name: getattr(needs, f.name) for f in dataclasses.fields(Needs)}
    return {
        "begins": hasattr(planner, "begin"),
        "needs": fields if hasattr(planner, "needs") else None,
        "chooses_sensors": type(needs) is not Needs,
    }


def _described(error: BaseException) -> str:
    try:
        text = f"{type(error).__name__}: {error}"
    except Exception:
        text = type(error).__name__
    return text.encode("utf-8", "replace").decode()[:ERROR_LENGTH]


def _end_with_caller(link: socket.socket) -> None:
    """Kill the group of this process soon after its caller has closed the connection."""
    hung_up = select.poll()
    hung_up.register(link, 0)
    hung_up.poll()
    time.sleep(END_S)
    os.killpg(0, signal.SIGKILL)
