"""The schema of a store, and the Alembic revisions that bring an older store up to date.

A new store gets the current tables at once. To change `tables`, raise ``SCHEMA_VERSION`` and add a
revision with that number to ``revisions/versions``; it turns a store of the previous version into
what a new store is. Released revisions never change.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import sqlalchemy as sa
import structlog
from sqlalchemy.engine import Connection

from . import tables as t
from .errors import StoreError

if TYPE_CHECKING:
    from alembic.config import Config

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
    """Look at a store's schema; nothing changes.

    Raises:
        StoreError: this program can neither use nor migrate it.
    """
    with engine.connect() as connection:
        found = _version(connection)
    if found is None:
        return SchemaStatus(None, t.SCHEMA_VERSION, (f"{t.SCHEMA_VERSION}: all tables",))
    check_version(found)
    pending = [f"{number}: {what}" for number, what in _revisions() if number > found]
    return SchemaStatus(found, t.SCHEMA_VERSION, tuple(pending))


def prepare_schema(engine: sa.Engine, *, policy: Policy = "auto") -> None:
    """Create the schema, or migrate an older one. Several processes may call this at once.

    Args:
        engine: of the store.
        policy: whether an older schema is migrated or refused.

    Raises:
        StoreError: the schema is newer than this program, was made before the first release, or is
            older and ``policy`` refuses; the message says what to run.
    """
    with engine.connect() as connection:
        found = _version(connection)
    if found == t.SCHEMA_VERSION:
        return
    if found is not None and 0 < found < t.SCHEMA_VERSION and policy == "refuse":
        raise StoreError(
            f"the store has schema version {found}, this worker needs {t.SCHEMA_VERSION}; make a "
            "backup and run `real2sim store migrate`, or let workers migrate by themselves with "
            "REAL2SIM_STORE_MIGRATION=auto"
        )
    with _alone(engine) as connection:
        # Another worker may have been faster.
        found = _version(connection)
        if found == t.SCHEMA_VERSION:
            return
        if found is None:
            t.metadata.create_all(connection)
            _stamp(connection)
            return
        check_version(found)
        _upgrade(connection)
    _rewrite(engine)


def check_version(found: int) -> None:
    """Raises StoreError if this program can neither use nor migrate that schema version."""
    if 1 <= found <= t.SCHEMA_VERSION:
        return
    if found < 1:
        raise StoreError(
            "the store was made before the first release, whose schema is new; move it away, or "
            "give another REAL2SIM_STORE_URL"
        )
    raise StoreError(
        f"the store has schema version {found}, this program reads 1 to {t.SCHEMA_VERSION}; start "
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

    command.stamp(_config(connection), f"{t.SCHEMA_VERSION:04}")


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
            # The driver starts no transaction before it defines tables.
            connection.exec_driver_sql("BEGIN IMMEDIATE")
        elif engine.dialect.name == "postgresql":
            connection.exec_driver_sql(f"SELECT pg_advisory_xact_lock({SCHEMA_LOCK})")
        yield connection
        connection.commit()


def _version(connection: Connection) -> int | None:
    """The schema version; None for an empty database, 0 for one made before the first release."""
    tables = sa.inspect(connection)
    if not tables.has_table(t.alembic_version.name) or tables.has_table("schema_version"):
        return 0 if tables.has_table(t.sessions.name) else None
    found = connection.execute(sa.select(t.alembic_version.c.version_num)).scalar()
    return None if found is None else int(found)


def _rewrite(engine: sa.Engine) -> None:
    """Rewrite an SQLite file, so that it keeps neither old values nor free pages."""
    if engine.dialect.name != "sqlite":
        return
    with engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
        try:
            connection.exec_driver_sql("PRAGMA auto_vacuum=INCREMENTAL")
            connection.exec_driver_sql("VACUUM")
            connection.exec_driver_sql("PRAGMA wal_checkpoint(TRUNCATE)")
        except sa.exc.OperationalError as error:
            log.warning("store not rewritten after its migration", reason=str(error.orig))
