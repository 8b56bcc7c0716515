"""Cost of appending to a session log on PostgreSQL: prepared statement versus SQLAlchemy
transaction.

``PYTHONPATH=. python -m tests.server.service.storage.measure_appends``
"""

from __future__ import annotations

import asyncio
import tempfile
import time
from dataclasses import replace
from pathlib import Path

from real2sim_server.service.storage.store import SessionEntry, SessionRow, Store

from ..postgres import running_postgres

MANY = 1500
SESSION = SessionRow("w0.1", "w0", "tiny", "0" * 64, None, None, "secret", 1)


async def measure(url: str) -> None:
    """Print the timings of both, twice."""
    for turn, way in enumerate(("prepared", "sqlalchemy") * 2):
        store = Store(url)
        await store.open()
        if way == "sqlalchemy":
            store.database._prepared = None
        session = replace(SESSION, session_id=f"w0.{turn}")
        await store.create_session(session)
        processor, wall = time.process_time(), time.perf_counter()
        for seq in range(MANY):
            store.record(session.claim, [SessionEntry(seq, "action", seq, b"x" * 300, 1)])
        per_entry = [(time.process_time() - processor) / MANY, (time.perf_counter() - wall) / MANY]
        print(f"{way}: {per_entry[0] * 1e3:.3f} ms processor, {per_entry[1] * 1e3:.3f} ms in all")
        await store.close()


if __name__ == "__main__":
    with (
        tempfile.TemporaryDirectory(prefix="real2sim-pg-") as folder,
        running_postgres(Path(folder)) as server,
    ):
        asyncio.run(measure(server.new_database()))
