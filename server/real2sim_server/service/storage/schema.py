"""The tables of a store, their rows, and the Alembic revisions that upgrade an older store.

Types are portable between SQLite and PostgreSQL. A new store gets the current tables directly. To
change a table, raise ``SCHEMA_VERSION`` and add a revision with that number to
``revisions/versions``, which migrates a store of the previous version. Released revisions never
change.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import sqlalchemy as sa
import structlog
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
from sqlalchemy.engine import Connection

from ..._records import made_quickly
from .connection import StoreError

if TYPE_CHECKING:
    from alembic.config import Config


# Tables.

SCHEMA_VERSION = 1
"""Increase it with every table change, together with a new file in ``revisions/versions``."""

metadata = MetaData()

alembic_version = Table("alembic_version", MetaData(), Column("version_num", String(32)))
"""Alembic's own table, with the schema version in one row."""

scenarios = Table(
    "scenarios",
    metadata,
    Column("scenario_id", String(80), primary_key=True),
    Column("name", String(200), nullable=False),
    Column("scene", String(80), nullable=False),
    Column("scene_hash", String(64), nullable=False),
    Column("created_us", BigInteger, nullable=False),
)

# Append-only. The primary key prevents two writers from adding the same revision.
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

# State of a scenario at one revision, to open it without replaying the whole log. Snapshots are
# derived from the log: losing one costs time, but no edits.
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
    # Increases whenever a worker takes over the session; writes with an earlier epoch are refused.
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

# Workers that share the store, and the end of each lease.
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
    # Increases whenever a worker takes over the job, as for a session.
    Column("epoch", Integer, nullable=False, server_default="0"),
    # Number of workers that died while running the job.
    Column("deaths", Integer, nullable=False, server_default="0"),
    # Whether any worker can rebuild the job from its document; whether a client has cancelled it.
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

# Scenes, assets and job files in an object store, with their objects.
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

# Requests that changed something, or were refused for their token or role.
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
    """Snapshot of a scenario's state.

    Attributes:
        revision: the revision.
        made_by: program version that created it; other versions may interpret the log differently.
        state: encoded by :func:`real2sim_server.edit.pack_state`.
    """

    scenario_id: str
    revision: int
    made_by: str
    state: bytes


class Claim(NamedTuple):
    """A worker's right to write the log of a session.

    Attributes:
        session_id: the session.
        epoch: increases whenever a worker takes over the session; only the highest is valid.
    """

    session_id: str
    epoch: int


@dataclass(frozen=True)
class SessionRow:
    """A session as created.

    Attributes:
        worker_id: worker that currently has it.
        scenario_id, scenario_revision: its start; None for the bare scene.
        token_hash: hash of its token, from :func:`~..accounts.token_hash`.
        closed_us, reason: None while it is open.
        owner: name of the token that created it.
        epoch: number of takeovers.
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
    """A stored reply, for requests that are repeated with the same Idempotency-Key.

    Attributes:
        fingerprint: SHA-256 of the request; another request with the same key is refused.
    """

    key: str
    fingerprint: str
    status: int
    headers: Mapping[str, str]
    body: bytes


SCHEMA_LOCK = 0x5232_5301
"""PostgreSQL's advisory lock, held while the schema is made or changed."""

REVISIONS = Path(__file__).parent / "revisions"

Policy = Literal["auto", "refuse"]
"""Whether a store with an older schema is migrated or refused."""

log = structlog.get_logger(__name__)


@dataclass(frozen=True)
class SchemaStatus:
    """The schema of a store, and the migrations it needs.

    Attributes:
        found: version of the store; None for an empty database.
        wanted: version of this program.
        steps: pending migrations, one line each.
    """

    found: int | None
    wanted: int
    steps: tuple[str, ...]


def schema_status(engine: sa.Engine) -> SchemaStatus:
    """Check a store's schema without changes.

    Raises:
        StoreError: this program can neither use nor migrate it.
    """
    with engine.connect() as connection:
        found = _version(connection)
    if found is None:
        return SchemaStatus(None, SCHEMA_VERSION, (f"{SCHEMA_VERSION}: all tables",))
    check_version(found)
    pending = [f"{number}: {what}" for number, what in _revisions() if number > found]
    return SchemaStatus(found, SCHEMA_VERSION, tuple(pending))


def prepare_schema(engine: sa.Engine, *, policy: Policy = "auto") -> None:
    """Create the schema, or migrate an older one. Several processes may call this at once.

    Args:
        engine: database engine of the store.
        policy: whether an older schema is migrated or refused.

    Raises:
        StoreError: the schema is newer than this program, was made before the first release, or is
            older and ``policy`` refuses; the message says what to run.
    """
    with engine.connect() as connection:
        found = _version(connection)
    if found == SCHEMA_VERSION:
        return
    if found is not None and 0 < found < SCHEMA_VERSION and policy == "refuse":
        raise StoreError(
            f"the store has schema version {found}, this worker needs {SCHEMA_VERSION}; make a "
            "backup and run `real2sim store migrate`, or let workers migrate by themselves with "
            "REAL2SIM_STORE_MIGRATION=auto"
        )
    with _alone(engine) as connection:
        # Another worker may have been faster.
        found = _version(connection)
        if found == SCHEMA_VERSION:
            return
        if found is None:
            metadata.create_all(connection)
            _stamp(connection)
            return
        check_version(found)
        _upgrade(connection)
    _rewrite(engine)


def check_version(found: int) -> None:
    """Raises StoreError if this program can neither use nor migrate that schema version."""
    if 1 <= found <= SCHEMA_VERSION:
        return
    if found < 1:
        raise StoreError(
            "the store was made before the first release and cannot be read; move it away, or "
            "give another REAL2SIM_STORE_URL"
        )
    raise StoreError(
        f"the store has schema version {found}, this program reads 1 to {SCHEMA_VERSION}; start "
        "a worker of that version, or restore a backup made before the upgrade: `real2sim restore "
        "FILE --overwrite`, or give another REAL2SIM_STORE_URL"
    )


def _upgrade(connection: Connection) -> None:
    """Run the pending revisions in the transaction of the connection."""
    from alembic import command

    def on_step(*, step: Any, **_others: object) -> None:
        number, what = int(step.up_revision_id), step.up_revision.doc
        log.warning("store migrated", version=number, what=what)

    command.upgrade(_config(connection, on_step=on_step), "head")


def _stamp(connection: Connection) -> None:
    """Record in a new store that no revision is pending."""
    from alembic import command

    command.stamp(_config(connection), f"{SCHEMA_VERSION:04}")


def _config(connection: Connection | None = None, *, on_step: Any = None) -> Config:
    from alembic.config import Config

    config = Config(attributes={"connection": connection, "on_step": on_step})
    config.set_main_option("script_location", str(REVISIONS).replace("%", "%%"))
    return config


def _revisions() -> list[tuple[int, str]]:
    """Numbers and titles of all revisions, oldest first."""
    from alembic.script import ScriptDirectory

    found = ScriptDirectory.from_config(_config()).walk_revisions()
    return sorted((int(one.revision), one.doc.rstrip(".")) for one in found)


@contextlib.contextmanager
def _alone(engine: sa.Engine) -> Iterator[Connection]:
    """A transaction during which no other process prepares the schema."""
    with engine.connect() as connection:
        if engine.dialect.name == "sqlite":
            # The driver does not begin a transaction for table definitions.
            connection.exec_driver_sql("BEGIN IMMEDIATE")
        elif engine.dialect.name == "postgresql":
            connection.exec_driver_sql(f"SELECT pg_advisory_xact_lock({SCHEMA_LOCK})")
        yield connection
        connection.commit()


def _version(connection: Connection) -> int | None:
    """The schema version: None for an empty database, 0 for one from before the first release."""
    tables = sa.inspect(connection)
    if not tables.has_table(alembic_version.name) or tables.has_table("schema_version"):
        return 0 if tables.has_table(sessions.name) else None
    found = connection.execute(sa.select(alembic_version.c.version_num)).scalar()
    return None if found is None else int(found)


def _rewrite(engine: sa.Engine) -> None:
    """Rewrite an SQLite file, to remove old values and free pages."""
    if engine.dialect.name != "sqlite":
        return
    with engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
        try:
            connection.exec_driver_sql("PRAGMA auto_vacuum=INCREMENTAL")
            connection.exec_driver_sql("VACUUM")
            connection.exec_driver_sql("PRAGMA wal_checkpoint(TRUNCATE)")
        except sa.exc.OperationalError as error:
            log.warning("store not rewritten after its migration", reason=str(error.orig))
