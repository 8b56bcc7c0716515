"""A batch socket with nothing between the clock and the bytes."""

from __future__ import annotations

from collections.abc import Sequence
from types import TracebackType
from typing import Any, Self

import numpy as np

from real2sim_proto import DRIVE_SUBPROTOCOL, decode, encode
from real2sim_proto.sessions import SessionInfo

from .drive_probe import ANSWER_S, PLAN_PERIOD_US, PLAN_POSES, SPEED
from .lean_socket import LeanSocket


class BatchProbe:
    """Controls sessions by one message a step; use it in a ``with`` block.

    Args:
        infos: of the sessions.
    """

    def __init__(self, infos: Sequence[SessionInfo]) -> None:
        self._infos = infos
        self._id = 0

    def __enter__(self) -> Self:
        base = self._infos[0].ws_url.rsplit("/", 2)[0]
        self._socket = LeanSocket(f"{base}/batch/drive", subprotocol=DRIVE_SUBPROTOCOL)
        sessions = [{"session_id": i.session_id, "token": i.token} for i in self._infos]
        self.ask("batch_hello", protocols=[DRIVE_SUBPROTOCOL], sessions=sessions)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._socket.close()

    def reset(self, **spec: Any) -> dict[str, Any]:
        """Begin an episode in every world; their first instants."""
        return self.ask("batch_reset", spec=spec)

    def act(self, obs: dict[str, Any]) -> dict[str, Any]:
        """Drive straight on in every world."""
        rows = len(obs["step"])
        ahead = np.arange(1, PLAN_POSES + 1) * PLAN_PERIOD_US
        poses = np.zeros((rows, PLAN_POSES, 3))
        poses[:, :, 0] = SPEED * 1e-6 * ahead
        plans = {
            "kind": "trajectory",
            "times_us": obs["t_us"][:, None] + ahead,
            "poses": poses,
        }
        return self.ask("batch_action", steps=obs["step"], plans=plans)

    def ask(self, kind: str, **fields: Any) -> dict[str, Any]:
        """The answer to a message. Raises RuntimeError where something is refused."""
        self._id += 1
        self._socket.send(encode({"v": 1, "id": self._id, "type": kind, **fields}))
        while (answer := decode(bytes(self._socket.recv(ANSWER_S))))["type"] == "progress":
            continue
        if answer["type"] == "error" or answer.get("errors"):
            raise RuntimeError(f"the worker refused {kind}: {answer}")
        return answer
