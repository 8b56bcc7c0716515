"""The database of a store: how it is reached, and the schema in it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection, make_url
from sqlalchemy.pool import StaticPool

from . import tables as t


class StoreError(RuntimeError):
    """The store cannot be used; the message says why and what to do."""


def connect(url: str) -> sa.Engine:
    """An engine for ``url``; SQLite's folder is made, its journal is a write-ahead one."""
    parsed = make_url(url)
    if parsed.get_backend_name() != "sqlite":
        return sa.create_engine(parsed, pool_pre_ping=True)
    if not parsed.database or parsed.database == ":memory:":
        # Such a database belongs to its connection, whichever thread uses it.
        other_threads = {"check_same_thread": False}
        engine = sa.create_engine(parsed, poolclass=StaticPool, connect_args=other_threads)
    else:
        Path(parsed.database).absolute().parent.mkdir(parents=True, exist_ok=True)
        engine = sa.create_engine(parsed)
    sa.event.listen(engine, "connect", _set_up_sqlite)
    return engine


def is_local(engine: sa.Engine) -> bool:
    """Whether the database is a file of this machine: a connection to it is never lost."""
    return engine.dialect.name == "sqlite" and not isinstance(engine.pool, StaticPool)


def _set_up_sqlite(connection: Any, _record: object) -> None:
    cursor = connection.cursor()
    # NORMAL loses no committed transaction when the process dies, only when the machine does.
    for pragma in ("journal_mode=WAL", "synchronous=NORMAL", "foreign_keys=ON"):
        cursor.execute(f"PRAGMA {pragma}")
    cursor.execute("PRAGMA busy_timeout=5000")
    cursor.close()


def prepare_schema(connection: Connection) -> None:
    """Create what is missing. Raises StoreError where the schema is of another version."""
    t.schema_version.create(connection, checkfirst=True)
    found = connection.execute(sa.select(sa.func.max(t.schema_version.c.version))).scalar()
    if found is not None and found != t.SCHEMA_VERSION:
        raise StoreError(
            f"the store has schema version {found}, this worker reads {t.SCHEMA_VERSION}; "
            "start a worker of that version, or give another REAL2SIM_STORE_URL"
        )
    t.metadata.create_all(connection)
    if found is None:
        connection.execute(sa.insert(t.schema_version), {"version": t.SCHEMA_VERSION})


def shown_url(url: str) -> str:
    """The URL without its password."""
    try:
        return make_url(url).render_as_string(hide_password=True)
    except sa.exc.ArgumentError:
        return "<no SQLAlchemy URL>"
