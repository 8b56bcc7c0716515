"""A drive socket with nothing between the clock and the bytes."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from types import TracebackType
from typing import Any, Self

from websockets.sync.client import connect

from real2sim_proto import DRIVE_SUBPROTOCOL, decode, encode
from real2sim_proto.sessions import SessionInfo

SPEED = 8.0
PLAN_POSES = 20
PLAN_PERIOD_US = 100_000


class DriveProbe:
    """Controls a session by messages made by hand; use it in a ``with`` block."""

    def __init__(self, info: SessionInfo) -> None:
        self._info = info
        self._id = 0
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        connection = connect(
            self._info.ws_url,
            subprotocols=[DRIVE_SUBPROTOCOL],  # type: ignore[list-item]
            compression=None,
            max_size=None,
            proxy=None,
            ping_interval=None,
        )
        self.socket = self._stack.enter_context(connection)
        hello = {"type": "hello", "protocols": [DRIVE_SUBPROTOCOL], "token": self._info.token}
        self._ask(hello)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._stack.close()

    def reset(
        self, sensors: Sequence[Mapping[str, Any]], *, dt_us: int
    ) -> tuple[dict[str, Any], float]:
        """Begin an episode; its first observation and the seconds it took."""
        return self._ask({"type": "reset", "spec": {"dt_us": dt_us, "sensors": list(sensors)}})

    def act(self, obs: Mapping[str, Any]) -> tuple[dict[str, Any], float]:
        """Drive straight on; the next observation and the seconds until its bytes were here."""
        plan = straight_on(obs["t_us"])
        return self._ask({"type": "action", "step": obs["step"], "plan": plan})

    def _ask(self, fields: Mapping[str, Any]) -> tuple[dict[str, Any], float]:
        self._id += 1
        data = encode({"v": 1, "id": self._id, **fields})
        started = time.perf_counter()
        self.socket.send(data)
        while True:
            received = self.socket.recv(decode=False)
            seconds = time.perf_counter() - started
            answer = decode(received)
            if answer["type"] == "error":
                raise RuntimeError(f"the worker refused {fields['type']}: {answer['detail']}")
            if answer["type"] != "progress":
                return answer, seconds


def straight_on(t_us: int) -> dict[str, Any]:
    """A trajectory plan over the next two seconds."""
    ahead = range(1, PLAN_POSES + 1)
    return {
        "kind": "trajectory",
        "times_us": [t_us + k * PLAN_PERIOD_US for k in ahead],
        "poses": [[SPEED * k * PLAN_PERIOD_US * 1e-6, 0.0, 0.0] for k in ahead],
    }
