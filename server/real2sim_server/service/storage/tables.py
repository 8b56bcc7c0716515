"""Tables of the store. Portable types only: the same tables serve SQLite and PostgreSQL."""

from __future__ import annotations

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

SCHEMA_VERSION = 7
"""Raised with every change of a table, together with a new file in ``revisions/versions``."""

metadata = MetaData()

schema_version = Table("schema_version", metadata, Column("version", Integer, primary_key=True))

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
