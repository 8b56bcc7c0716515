"""The schema of a store: numbered revisions, by Alembic, from older ones to the present one.

A new store gets the present schema at once. A change of `tables` is a new file in
``revisions/versions`` besides, numbered on, which makes of a store of the version before what a new
one would be; files are never changed once released. Versions before 5 are older than Alembic here
and have steps of their own (:mod:`.older`).

The number stands in ``schema_version``, which every program that ever read a store looks at, and as
a revision in Alembic's own table.
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
from .older import LAST, OLDER_STEPS

if TYPE_CHECKING:
    from alembic.config import Config

SCHEMA_LOCK = 0x5232_5301
"""Of PostgreSQL, for the time in which the schema is made or changed."""

REVISIONS = Path(__file__).parent / "revisions"
OLDEST = OLDER_STEPS[0].version - 1
"""Oldest schema that this program can bring up to date."""

Policy = Literal["auto", "refuse"]
"""What happens to a store of an older schema: it is brought up to date, or refused."""

log = structlog.get_logger(__name__)


@dataclass(frozen=True)
class SchemaStatus:
    """What a store's schema is, and what this program would make of it.

    Attributes:
        found: its version; None for an empty database.
        wanted: by this program.
        steps: what would be done, one line a version.
    """

    found: int | None
    wanted: int
    steps: tuple[str, ...]


def schema_status(engine: sa.Engine) -> SchemaStatus:
    """Look at a store's schema; nothing is changed.

    Raises:
        StoreError: this program can neither use it nor bring it up to date.
    """
    with engine.connect() as connection:
        found = _version(connection)
    if found is None:
        return SchemaStatus(None, t.SCHEMA_VERSION, (f"{t.SCHEMA_VERSION}: all tables",))
    check_version(found)
    steps = [f"{step.version}: {step.what}" for step in OLDER_STEPS if step.version > found]
    if max(found, LAST) < t.SCHEMA_VERSION:
        steps += [f"{number}: {what}" for number, what in _revisions() if number > max(found, LAST)]
    return SchemaStatus(found, t.SCHEMA_VERSION, tuple(steps))


def prepare_schema(engine: sa.Engine, *, policy: Policy = "auto") -> None:
    """Make the schema, or bring an older one up to date; several may try at once.

    Args:
        engine: of the store.
        policy: whether an older one is brought up to date.

    Raises:
        StoreError: the schema is newer than this program, or too old for it, or older where that
            is refused; with the command to run.
    """
    with engine.connect() as connection:
        found = _version(connection)
    if found == t.SCHEMA_VERSION:
        return
    if found is not None and OLDEST <= found < t.SCHEMA_VERSION and policy == "refuse":
        raise StoreError(
            f"the store has schema version {found}, this worker wants {t.SCHEMA_VERSION}; make a "
            "backup and run `real2sim store migrate`, or let workers do it by themselves with "
            "REAL2SIM_STORE_MIGRATION=auto"
        )
    with _alone(engine) as connection:
        # Another worker may have been faster.
        found = _version(connection)
        if found == t.SCHEMA_VERSION:
            return
        if found is None:
            t.metadata.create_all(connection)
            _note(connection, t.SCHEMA_VERSION)
            _stamp(connection)
            return
        check_version(found)
        _migrate(connection, found)
    _rewrite(engine)


def check_version(found: int) -> None:
    """Raises StoreError where a schema of that version cannot be used or brought up to date."""
    if OLDEST <= found <= t.SCHEMA_VERSION:
        return
    if found > t.SCHEMA_VERSION:
        remedy = (
            "start a worker of that version, or restore a backup made before the upgrade: "
            "`real2sim restore FILE --overwrite`"
        )
    else:
        remedy = "run `real2sim store migrate` of a version in between first"
    raise StoreError(
        f"the store has schema version {found}, this program reads {OLDEST} to "
        f"{t.SCHEMA_VERSION}; {remedy}, or give another REAL2SIM_STORE_URL"
    )


# --- steps ------------------------------------------------------------------------------


def _migrate(connection: Connection, found: int) -> None:
    for step in OLDER_STEPS:
        if step.version > found:
            step.apply(connection)
            _note(connection, step.version)
            log.warning("store migrated", version=step.version, what=step.what)
    _upgrade(connection, from_version=max(found, LAST))


def _upgrade(connection: Connection, *, from_version: int) -> None:
    """Alembic's revisions behind ``from_version``, in the transaction of the connection."""
    from alembic import command

    def on_step(*, step: Any, **_others: object) -> None:
        number, what = int(step.up_revision_id), step.up_revision.doc
        _note(connection, number)
        log.warning("store migrated", version=number, what=what)

    if not sa.inspect(connection).has_table("alembic_version"):
        command.stamp(_config(connection), f"{from_version:04}")
    command.upgrade(_config(connection, on_step=on_step), "head")


def _stamp(connection: Connection) -> None:
    """Note in a new store that nothing is left for Alembic to do."""
    from alembic import command

    command.stamp(_config(connection), f"{t.SCHEMA_VERSION:04}")


def _config(connection: Connection | None = None, *, on_step: Any = None) -> Config:
    from alembic.config import Config

    config = Config(attributes={"connection": connection, "on_step": on_step})
    config.set_main_option("script_location", str(REVISIONS).replace("%", "%%"))
    return config


def _revisions() -> list[tuple[int, str]]:
    """Versions and what leads to them, oldest first."""
    from alembic.script import ScriptDirectory

    found = ScriptDirectory.from_config(_config()).walk_revisions()
    return sorted((int(one.revision), one.doc.rstrip(".")) for one in found)


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
