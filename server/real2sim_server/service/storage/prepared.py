"""A connection to PostgreSQL that executes statements which the server has seen before, each a
transaction of its own: what a step leaves costs one message there and one back.

SQLAlchemy's way, with a transaction begun and ended around each statement and the statement parsed
anew, takes several times the processor time.
"""

from __future__ import annotations

import contextlib
import select
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import sqlalchemy as sa

from .connection import native_connection

if TYPE_CHECKING:
    import socket


@dataclass(frozen=True, eq=False)
class Prepared:
    """A statement for such a connection.

    Attributes:
        text: with ``:name`` for values; it returns a row for each that it changes.
        values: by name.
    """

    text: str
    values: Mapping[str, object]


class PreparedStatements:
    """Statements that are prepared once for each connection. For one thread at a time.

    Args:
        url: of the database, with the driver pg8000.
        timeout_s: of a statement, a lock, an answer [s].
    """

    def __init__(self, url: sa.URL, *, timeout_s: float) -> None:
        self._url = url
        self._timeout_s = timeout_s
        self._connection: Any = None
        self._socket: socket.socket | None = None
        self._known: dict[str, Any] = {}

    def execute(self, prepared: Prepared) -> int:
        """Rows that the statement has changed; it is committed.

        Raises:
            sqlalchemy.exc.SQLAlchemyError: of the server, or there is none.
        """
        if self._is_broken():
            self.close()
        try:
            statement = self._statement(prepared.text)
            return len(statement.run(**prepared.values))
        except Exception as error:
            self._sort(error, prepared.text)
            raise

    def close(self) -> None:
        """Disconnect; the next statement connects again."""
        connection, self._connection = self._connection, None
        self._known.clear()
        if connection is not None:
            with contextlib.suppress(Exception):
                connection.close()
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _statement(self, text: str) -> Any:
        if self._connection is None:
            self._connection, self._socket = native_connection(self._url, self._timeout_s)
        if (known := self._known.get(text)) is None:
            known = self._known[text] = self._connection.prepare(text)
        return known

    def _is_broken(self) -> bool:
        """Whether the server has said something unasked: that it closes, in all likelihood."""
        return self._socket is not None and bool(select.select([self._socket], [], [], 0)[0])

    def _sort(self, error: Exception, text: str) -> None:
        """Raise errors of the driver as SQLAlchemy does; a connection that may be spoilt goes."""
        from pg8000.exceptions import DatabaseError, InterfaceError

        state = str(error.args[0].get("C", "")) if _is_of_server(error) else ""
        if not state.startswith("23"):
            self.close()
        if isinstance(error, DatabaseError):
            raise sa.exc.OperationalError(text, None, error) from error
        if isinstance(error, InterfaceError):
            raise sa.exc.InterfaceError(text, None, error) from error


def _is_of_server(error: Exception) -> bool:
    return bool(error.args) and isinstance(error.args[0], dict)
