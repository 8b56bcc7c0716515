"""Steps of stores that were made before Alembic: from schema version 1 to 5.

They are closed: what comes after is a revision in ``revisions/versions``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from .tokens import token_hash


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


OLDER_STEPS: tuple[Migration, ...] = (
    Migration(2, "tokens of sessions are kept as hashes", _hash_tokens),
    Migration(3, "sessions keep the name of the token they were made with", _add_owners),
    Migration(4, "sessions may go from one worker to another", _add_leases),
    Migration(5, "jobs may go from one worker to another", _add_leases_of_jobs),
)

LAST = OLDER_STEPS[-1].version
"""Where Alembic begins."""
