"""Tables of the store and their rows. Types are portable between SQLite and PostgreSQL."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from sqlalchemy import (
    BigInteger,
    Column,
    ForeignKey,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    String,
    Table,
    Text,
)

from ..._records import made_quickly

SCHEMA_VERSION = 1
"""Raise it with every change of a table, together with a new file in ``revisions/versions``."""

metadata = MetaData()

alembic_version = Table("alembic_version", MetaData(), Column("version_num", String(32)))
"""Alembic's own table, which holds the schema version in one row."""

scenarios = Table(
    "scenarios",
    metadata,
    Column("scenario_id", String(80), primary_key=True),
    Column("name", String(200), nullable=False),
    Column("scene", String(80), nullable=False),
    Column("scene_hash", String(64), nullable=False),
    Column("created_us", BigInteger, nullable=False),
)

# Append-only. The primary key is what keeps two writers from making the same revision.
scenario_log = Table(
    "scenario_log",
    metadata,
    Column(
        "scenario_id",
        String(80),
        ForeignKey("scenarios.scenario_id", ondelete="CASCADE"),
        primary_key=True,
    ),
    Column("revision", Integer, primary_key=True, autoincrement=False),
    Column("kind", String(8), nullable=False),
    Column("entry", Text, nullable=False),
    Column("created_us", BigInteger, nullable=False),
)

# What a log has led to at one revision, so that opening need not replay all of it. Made from the
# log and nothing else: losing a row costs time, never an edit.
scenario_snapshots = Table(
    "scenario_snapshots",
    metadata,
    Column(
        "scenario_id",
        String(80),
        ForeignKey("scenarios.scenario_id", ondelete="CASCADE"),
        primary_key=True,
    ),
    Column("revision", Integer, nullable=False),
    Column("made_by", String(80), nullable=False),
    Column("state", LargeBinary, nullable=False),
)

sessions = Table(
    "sessions",
    metadata,
    Column("session_id", String(80), primary_key=True),
    Column("worker_id", String(16), nullable=False),
    Column("scene", String(80), nullable=False),
    Column("scene_hash", String(64), nullable=False),
    Column("scenario_id", String(80), nullable=True),
    Column("scenario_revision", Integer, nullable=True),
    Column("token_hash", String(200), nullable=False),
    Column("created_us", BigInteger, nullable=False),
    Column("closed_us", BigInteger, nullable=True),
    Column("reason", Text, nullable=True),
    Column("owner", String(80), nullable=False, server_default="default"),
    # Raised whenever a worker takes the session over; who wrote under an earlier one may no more.
    Column("epoch", Integer, nullable=False, server_default="0"),
)
Index("ix_sessions_open", sessions.c.worker_id, sessions.c.closed_us)

# Append-only: resets, actions and edits of a session in the order in which they took effect.
session_log = Table(
    "session_log",
    metadata,
    Column(
        "session_id",
        String(80),
        ForeignKey("sessions.session_id", ondelete="CASCADE"),
        primary_key=True,
    ),
    Column("seq", Integer, primary_key=True, autoincrement=False),
    Column("kind", String(16), nullable=False),
    Column("step", Integer, nullable=True),
    Column("payload", LargeBinary, nullable=False),
    Column("created_us", BigInteger, nullable=False),
)

# Workers that share the store, and until when each has promised to be alive.
workers = Table(
    "workers",
    metadata,
    Column("worker_id", String(16), primary_key=True),
    Column("lease_until_us", BigInteger, nullable=False),
    Column("document", Text, nullable=False),
)

jobs = Table(
    "jobs",
    metadata,
    Column("job_id", String(80), primary_key=True),
    Column("worker_id", String(16), nullable=False),
    Column("kind", String(16), nullable=False),
    Column("subject", String(80), nullable=False),
    Column("state", String(16), nullable=False),
    Column("document", Text, nullable=False),
    Column("created_us", BigInteger, nullable=False),
    # Raised whenever a worker takes the job over, as of a session.
    Column("epoch", Integer, nullable=False, server_default="0"),
    # Times that a worker died at it.
    Column("deaths", Integer, nullable=False, server_default="0"),
    # Whether any worker can begin it anew from its document, and whether somebody has cancelled it.
    Column("portable", Integer, nullable=False, server_default="0"),
    Column("cancelled", Integer, nullable=False, server_default="0"),
)
Index("ix_jobs_created", jobs.c.created_us)
Index("ix_jobs_state", jobs.c.worker_id, jobs.c.state)

idempotent_replies = Table(
    "idempotent_replies",
    metadata,
    Column("key", String(300), primary_key=True),
    Column("fingerprint", String(64), nullable=False),
    Column("status", Integer, nullable=False),
    Column("headers", Text, nullable=False),
    Column("body", LargeBinary, nullable=False),
    Column("created_us", BigInteger, nullable=False),
)
Index("ix_idempotent_replies_created", idempotent_replies.c.created_us)

# Scenes, assets and files of jobs that lie in a store of objects: of which ones they are made.
shared_bundles = Table(
    "shared_bundles",
    metadata,
    Column("kind", String(8), primary_key=True),
    Column("name", String(80), primary_key=True),
    Column("content", String(64), nullable=False),
    Column("document", Text, nullable=False),
    Column("bytes", BigInteger, nullable=False),
    Column("created_us", BigInteger, nullable=False),
)

# Requests that changed something, and those that were refused for their token or role.
audit = Table(
    "audit",
    metadata,
    Column(
        "entry",
        BigInteger().with_variant(Integer, "sqlite"),
        primary_key=True,
        autoincrement=True,
    ),
    Column("at_us", BigInteger, nullable=False),
    Column("account", String(80), nullable=False),
    Column("client", String(80), nullable=False),
    Column("worker_id", String(16), nullable=False),
    Column("method", String(16), nullable=False),
    Column("path", Text, nullable=False),
    Column("status", Integer, nullable=False),
    Column("request_id", String(80), nullable=False),
)
Index("ix_audit_at", audit.c.at_us)


# --- Rows ----------------------------------------------------------------------------------------


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
        token_hash: of the token that opens it, as :func:`~..tokens.token_hash` makes it.
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
