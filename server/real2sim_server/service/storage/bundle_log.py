"""Bundles that workers share, in the store: what there is, and of which objects it is made."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass

import sqlalchemy as sa

from ..clock import now_us
from . import tables as t
from .notices import notice
from .store import ConflictError, Store, Write


@dataclass(frozen=True)
class BundleRow:
    """A bundle on record.

    Attributes:
        kind: ``scene``, ``asset`` or ``job``.
        name: of the scene, asset or job.
        content: digest of all that is in it.
        document: its files and their digests, JSON.
        bytes: of all files.
        created_us: when it was put on record, or deleted.
    """

    kind: str
    name: str
    content: str
    document: str
    bytes: int
    created_us: int = 0

    @property
    def deleted(self) -> bool:
        """Whether it was deleted: whoever has a copy of before removes it."""
        return not self.content


class BundleLog:
    """Bundles beyond the folders of one worker.

    Args:
        store: open while this is used.
    """

    def __init__(self, store: Store) -> None:
        self._store = store

    async def add(self, row: BundleRow) -> bool:
        """Put a bundle on record; False where there is one of that name, which stays."""
        values = vars(row) | {"created_us": now_us()}
        with contextlib.suppress(ConflictError):
            await self._store.write(Write(sa.insert(t.shared_bundles), [values]), *self._notice())
            return True
        deleted = self._is(row.kind, row.name) & (t.shared_bundles.c.content == "")
        change = sa.update(t.shared_bundles).where(deleted).values(values)
        counts = await self._store.write(Write(change), *self._notice())
        return counts[0] > 0

    async def get(self, kind: str, name: str) -> BundleRow | None:
        """The bundle of that name."""
        rows = await self._rows(self._is(kind, name))
        return rows[0] if rows else None

    async def all(self) -> list[BundleRow]:
        """All bundles."""
        return await self._rows(sa.true())

    async def state(self) -> tuple[int, int]:
        """Changes whenever a bundle comes or goes."""
        b = t.shared_bundles.c
        newest = sa.func.coalesce(sa.func.max(b.created_us), 0).label("newest")
        query = sa.select(sa.func.count().label("many"), newest).select_from(t.shared_bundles)
        (row,) = await self._store.read(query)
        return int(row["many"]), int(row["newest"])

    async def mark_deleted(self, kind: str, name: str) -> None:
        """Leave word that a bundle was deleted."""
        empty = {"content": "", "document": "", "bytes": 0, "created_us": now_us()}
        change = sa.update(t.shared_bundles).where(self._is(kind, name)).values(empty)
        await self._store.write(Write(change), *self._notice())

    async def remove(self, kind: str, name: str) -> None:
        """Forget a bundle."""
        gone = Write(sa.delete(t.shared_bundles).where(self._is(kind, name)))
        await self._store.write(gone, *self._notice())

    def _notice(self) -> list[Write]:
        return notice("bundles", on_server=self._store.database.is_server)

    async def _rows(self, condition: sa.ColumnElement[bool]) -> list[BundleRow]:
        b = t.shared_bundles.c
        query = sa.select(b.kind, b.name, b.content, b.document, b.bytes, b.created_us)
        query = query.where(condition)
        return [BundleRow(**row) for row in await self._store.read(query)]

    @staticmethod
    def _is(kind: str, name: str) -> sa.ColumnElement[bool]:
        b = t.shared_bundles.c
        return (b.kind == kind) & (b.name == name)
