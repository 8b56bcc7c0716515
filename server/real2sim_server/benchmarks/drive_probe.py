"""A drive socket with nothing between the clock and the bytes."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Any, Self, cast

from real2sim_proto import DRIVE_SUBPROTOCOL, decode, encode
from real2sim_proto.sessions import SessionInfo

from .lean_socket import LeanSocket

ANSWER_S = 60.0
SPEED = 8.0
PLAN_POSES = 20
PLAN_PERIOD_US = 100_000
AHEAD_US = [k * PLAN_PERIOD_US for k in range(1, PLAN_POSES + 1)]
POSES = [[SPEED * us * 1e-6, 0.0, 0.0] for us in AHEAD_US]


class DriveProbe:
    """Controls a session by messages made by hand; use it in a ``with`` block.

    Pings are answered with the next message that is read, so read before the worker gives up.

    Args:
        info: of the session.
        resume: of an earlier connection that this one goes on for: its resume token, and the step
            of the last observation it has.

    Attributes:
        socket: to the worker.
        resume_token: with which a further connection may go on.
        pushed: the last observation that nobody has asked for; None for none.
    """

    def __init__(self, info: SessionInfo, *, resume: tuple[str, int] | None = None) -> None:
        self._info = info
        self._resume = resume
        self._id = 0
        self.resume_token = ""
        self.pushed: dict[str, Any] | None = None

    def __enter__(self) -> Self:
        self.socket = LeanSocket(self._info.ws_url, subprotocol=DRIVE_SUBPROTOCOL)
        hello: dict[str, Any] = {
            "type": "hello",
            "protocols": [DRIVE_SUBPROTOCOL],
            "token": self._info.token,
        }
        if self._resume is not None:
            token, step = self._resume
            hello["resume"] = {"token": token, "last_step": step}
        try:
            self.resume_token = self._accepted(hello)[0]["resume_token"]
        except BaseException:
            self.socket.close()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.socket.close()

    def reset(
        self, sensors: Sequence[Mapping[str, Any]], *, dt_us: int, **spec: Any
    ) -> tuple[dict[str, Any], float]:
        """Begin an episode; its first observation and the seconds it took."""
        fields = {"dt_us": dt_us, "sensors": list(sensors), **spec}
        return self._accepted({"type": "reset", "spec": fields})

    def act(self, obs: Mapping[str, Any]) -> tuple[dict[str, Any], float]:
        """Drive straight on; the next observation and the seconds until its bytes were here."""
        return self._accepted(action(obs))

    def send(self, fields: Mapping[str, Any]) -> None:
        """Send a message and wait for nothing."""
        self._id += 1
        self.socket.send(encode({"v": 1, "id": self._id, **fields}))

    def ask(self, fields: Mapping[str, Any]) -> tuple[dict[str, Any], float]:
        """The answer to a message, be it an error, and the seconds it took."""
        started = time.perf_counter()
        self.send(fields)
        while True:
            received = self.socket.recv(ANSWER_S)
            seconds = time.perf_counter() - started
            answer = decode(cast("bytes", received))
            if answer["type"] == "obs" and answer["id"] == 0:
                self.pushed = answer
            elif answer["type"] != "progress":
                return answer, seconds

    def listen(self, seconds: float, *, until_pushed: float = 0.0) -> None:
        """Take what comes unasked for so long, and on until something came, if that takes less
        than ``until_pushed`` seconds."""
        self.pushed, started = None, time.monotonic()
        while True:
            wanted = until_pushed if self.pushed is None else seconds
            left = started + max(wanted, seconds) - time.monotonic()
            if left <= 0:
                return
            with contextlib.suppress(TimeoutError):
                answer = decode(cast("bytes", self.socket.recv(left)))
                if answer["type"] == "obs":
                    self.pushed = answer

    def _accepted(self, fields: Mapping[str, Any]) -> tuple[dict[str, Any], float]:
        answer, seconds = self.ask(fields)
        if answer["type"] == "error":
            raise RuntimeError(f"the worker refused {fields['type']}: {answer['detail']}")
        return answer, seconds


def action(obs: Mapping[str, Any]) -> dict[str, Any]:
    """Straight on after an observation."""
    return {"type": "action", "step": obs["step"], "plan": straight_on(obs["t_us"])}


def straight_on(t_us: int) -> dict[str, Any]:
    """A trajectory plan over the next two seconds."""
    poses = [list(pose) for pose in POSES]  # A copy: some planners change it.
    return {"kind": "trajectory", "times_us": [t_us + us for us in AHEAD_US], "poses": poses}
