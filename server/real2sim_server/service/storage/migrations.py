"""The schema of a store, and the numbered steps from older ones to the present one.

A new store gets the present schema at once. A change of `tables` is a new entry of
:data:`MIGRATIONS` besides, which makes of a store of the version before what a new one would be;
entries are never changed once released.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import sqlalchemy as sa
import structlog
from sqlalchemy.engine import Connection

from . import tables as t
from .errors import StoreError
from .tokens import token_hash

SCHEMA_LOCK = 0x5232_5301
"""Of PostgreSQL, for the time in which the schema is made or changed."""

log = structlog.get_logger(__name__)


@dataclass(frozen=True)
class Migration:
    """A step to a schema from the one before.

    Attributes:
        version: that it leads to.
        what: it does, for the log.
        apply: does it, within a transaction.
    """

    version: int
    what: str
    apply: Callable[[Connection], None]


def _hash_tokens(connection: Connection) -> None:
    """Session tokens become hashes; answers that hold one are forgotten."""
    if connection.dialect.name == "sqlite":
        connection.exec_driver_sql("PRAGMA secure_delete=ON")
    connection.exec_driver_sql("ALTER TABLE sessions RENAME COLUMN token TO token_hash")
    rows = connection.exec_driver_sql("SELECT session_id, token_hash FROM sessions").all()
    hashed = [{"id": session_id, "hash": token_hash(token)} for session_id, token in rows]
    if hashed:
        change = sa.text("UPDATE sessions SET token_hash = :hash WHERE session_id = :id")
        connection.execute(change, hashed)
    answers = connection.exec_driver_sql("SELECT key, body FROM idempotent_replies").all()
    telling = [{"key": key} for key, body in answers if b'"token"' in bytes(body)]
    if telling:
        connection.execute(sa.text("DELETE FROM idempotent_replies WHERE key = :key"), telling)


def _add_owners(connection: Connection) -> None:
    """Sessions of before belong to the single token that there was."""
    connection.exec_driver_sql(
        "ALTER TABLE sessions ADD COLUMN owner VARCHAR(80) DEFAULT 'default' NOT NULL"
    )


def _add_leases(connection: Connection) -> None:
    """Workers say that they live, and sessions may go from one to another."""
    connection.exec_driver_sql("ALTER TABLE sessions ADD COLUMN epoch INTEGER DEFAULT 0 NOT NULL")
    connection.exec_driver_sql(
        "CREATE TABLE workers (worker_id VARCHAR(16) NOT NULL PRIMARY KEY, "
        "lease_until_us BIGINT NOT NULL, document TEXT NOT NULL)"
    )


def _add_leases_of_jobs(connection: Connection) -> None:
    """Jobs may go from one worker to another; those of before end with theirs."""
    for column in ("epoch", "deaths", "portable", "cancelled"):
        connection.exec_driver_sql(
            f"ALTER TABLE jobs ADD COLUMN {column} INTEGER DEFAULT 0 NOT NULL"
        )


MIGRATIONS: tuple[Migration, ...] = (
    Migration(2, "tokens of sessions are kept as hashes", _hash_tokens),
    Migration(3, "sessions keep the name of the token they were made with", _add_owners),
    Migration(4, "sessions may go from one worker to another", _add_leases),
    Migration(5, "jobs may go from one worker to another", _add_leases_of_jobs),
)

OLDEST = MIGRATIONS[0].version - 1
"""Oldest schema that this program can bring up to date."""


def prepare_schema(engine: sa.Engine) -> None:
    """Make the schema, or bring an older one up to date; several may try at once.

    Raises:
        StoreError: the schema is newer than this program, or too old for it.
    """
    with engine.connect() as connection:
        if _version(connection) == t.SCHEMA_VERSION:
            return
    with _alone(engine) as connection:
        # Another worker may have been faster.
        found = _version(connection)
        if found == t.SCHEMA_VERSION:
            return
        if found is None:
            t.metadata.create_all(connection)
            _note(connection, t.SCHEMA_VERSION)
            return
        check_version(found)
        for migration in MIGRATIONS:
            if migration.version > found:
                migration.apply(connection)
                _note(connection, migration.version)
                log.warning("store migrated", version=migration.version, what=migration.what)
    _rewrite(engine)


def check_version(found: int) -> None:
    """Raises StoreError where a schema of that version cannot be used or brought up to date."""
    if OLDEST <= found <= t.SCHEMA_VERSION:
        return
    if found > t.SCHEMA_VERSION:
        remedy = "start a worker of that version, or restore a backup made before the upgrade"
    else:
        remedy = "start a worker of a version in between first"
    raise StoreError(
        f"the store has schema version {found}, this worker reads {OLDEST} to "
        f"{t.SCHEMA_VERSION}; {remedy}, or give another REAL2SIM_STORE_URL"
    )


@contextlib.contextmanager
def _alone(engine: sa.Engine) -> Iterator[Connection]:
    """A transaction beside which nobody else prepares the schema."""
    with engine.connect() as connection:
        if engine.dialect.name == "sqlite":
            # The driver begins no transaction by itself before it defines tables.
            connection.exec_driver_sql("BEGIN IMMEDIATE")
        elif engine.dialect.name == "postgresql":
            connection.exec_driver_sql(f"SELECT pg_advisory_xact_lock({SCHEMA_LOCK})")
        yield connection
        connection.commit()


def _version(connection: Connection) -> int | None:
    if not sa.inspect(connection).has_table(t.schema_version.name):
        return None
    found: int | None = connection.execute(
        sa.select(sa.func.max(t.schema_version.c.version))
    ).scalar()
    return found


def _note(connection: Connection, version: int) -> None:
    connection.execute(sa.insert(t.schema_version), {"version": version})


def _rewrite(engine: sa.Engine) -> None:
    """Leave nothing of what was changed in the file of an SQLite database, and no wasted space."""
    if engine.dialect.name != "sqlite":
        return
    with engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
        try:
            connection.exec_driver_sql("PRAGMA auto_vacuum=INCREMENTAL")
            connection.exec_driver_sql("VACUUM")
            connection.exec_driver_sql("PRAGMA wal_checkpoint(TRUNCATE)")
        except sa.exc.OperationalError as error:
            log.warning("store not rewritten after its migration", reason=str(error.orig))
