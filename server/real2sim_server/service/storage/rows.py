"""Rows of the store."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from ..._records import made_quickly


@dataclass(frozen=True)
class ScenarioRow:
    """A scenario as created; its edits are in the log."""

    scenario_id: str
    name: str
    scene: str
    scene_hash: str
    created_us: int


@dataclass(frozen=True)
class SnapshotRow:
    """What the log of a scenario has led to.

    Attributes:
        revision: after which.
        made_by: the program that made it; another one may read the same log otherwise.
        state: as :func:`real2sim_server.edit.pack_state` has it.
    """

    scenario_id: str
    revision: int
    made_by: str
    state: bytes


class Claim(NamedTuple):
    """A worker's right to write the log of a session.

    Attributes:
        session_id: of the session.
        epoch: raised whenever a worker takes the session over; of several claims the one with the
            highest counts.
    """

    session_id: str
    epoch: int


@dataclass(frozen=True)
class SessionRow:
    """A session as created.

    Attributes:
        worker_id: who has it now.
        scenario_id, scenario_revision: what it began from; None for the bare scene.
        token_hash: of the token that opens it, as :func:`~.tokens.token_hash` makes it.
        closed_us, reason: None while it is open.
        owner: name of the token that it was made with.
        epoch: how often it was taken over.
    """

    session_id: str
    worker_id: str
    scene: str
    scene_hash: str
    scenario_id: str | None
    scenario_revision: int | None
    token_hash: str
    created_us: int
    closed_us: int | None = None
    reason: str | None = None
    owner: str = "default"
    epoch: int = 0

    @property
    def claim(self) -> Claim:
        """The right of ``worker_id`` to write its log."""
        return Claim(self.session_id, self.epoch)


@made_quickly
@dataclass(frozen=True)
class SessionEntry:
    """One entry of a session's log.

    Attributes:
        seq: position in the session's log, from 0.
        kind: ``reset``, ``action`` or ``edit``.
        step: step of the clock it belongs to.
        payload: msgpack or JSON of the message.
    """

    seq: int
    kind: str
    step: int | None
    payload: bytes
    created_us: int


@dataclass(frozen=True)
class StoredReply:
    """An answer stored for a request that may be repeated with the same Idempotency-Key.

    Attributes:
        key: the header's value together with the call it was sent to.
        fingerprint: SHA-256 of the request; another one under the same key is refused.
    """

    key: str
    fingerprint: str
    status: int
    headers: Mapping[str, str]
    body: bytes
