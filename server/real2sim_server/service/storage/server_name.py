"""Who owns the name of a worker on a database server: one process, as long as it is connected."""

from __future__ import annotations

import contextlib
import os
import socket

import sqlalchemy as sa

from .errors import StoreError

NAME_SPACE = 0x5232_5302
"""Of PostgreSQL's advisory locks: names of workers."""


class NameOnServer:
    """Being the only worker of a name on a PostgreSQL database.

    The lock belongs to a connection of its own, and ends with it.
    """

    def __init__(self, engine: sa.Engine, worker_id: str) -> None:
        self._engine = engine
        self._worker_id = worker_id
        self._connection: sa.Connection | None = None

    def hold(self) -> None:
        """Take the name, or make sure that it is still ours.

        Raises:
            StoreError: another worker has it.
            sqlalchemy.exc.SQLAlchemyError: the server does not answer.
        """
        if self._connection is None:
            self._take()
            return
        try:
            self._connection.exec_driver_sql("SELECT 1")
        except Exception:
            # Drivers let errors of sockets through as they are; the connection is spoilt by any.
            self.drop()
            raise

    def drop(self) -> None:
        """Give the name back."""
        connection, self._connection = self._connection, None
        if connection is not None:
            with contextlib.suppress(sa.exc.SQLAlchemyError, OSError):
                connection.invalidate()
                connection.close()

    def _take(self) -> None:
        engine = self._engine.execution_options(isolation_level="AUTOCOMMIT")
        connection = engine.connect()
        try:
            who = f"real2sim {self._worker_id}, process {os.getpid()} on {socket.gethostname()}"
            name = {"who": who[:63], "name": f"real2sim worker {self._worker_id}"}
            connection.execute(sa.text("SELECT set_config('application_name', :who, false)"), name)
            taken = "SELECT pg_try_advisory_lock(:space, hashtext(:name))"
            if not connection.execute(sa.text(taken), name | {"space": NAME_SPACE}).scalar():
                raise StoreError(self._told(connection, name))
        except BaseException:
            connection.close()
            raise
        self._connection = connection

    def _told(self, connection: sa.Connection, name: dict[str, str]) -> str:
        owner = connection.execute(
            sa.text(
                "SELECT a.application_name FROM pg_locks l JOIN pg_stat_activity a USING (pid) "
                "WHERE l.locktype = 'advisory' AND l.classid::bigint = :space "
                "AND l.objid::bigint = (hashtext(:name)::bigint & 4294967295) LIMIT 1"
            ),
            name | {"space": NAME_SPACE},
        ).scalar()
        return (
            f"a worker {self._worker_id!r} runs on this store already ({owner or 'unknown'}). Stop "
            "that one, or give this one another name with REAL2SIM_WORKER_ID"
        )
