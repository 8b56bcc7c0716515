"""Creation and migration of the database schema."""

from __future__ import annotations

import shutil
import sqlite3
import threading

import pytest
import sqlalchemy as sa

from real2sim_server.service.storage import schema
from real2sim_server.service.storage.connection import StoreError, connect, keep_write_ahead_journal

from ..postgres import Postgres
from .opened_store import run


@pytest.fixture(params=["sqlite", "postgresql"])
def url(request, tmp_path) -> str:
    if request.param == "sqlite":
        return f"sqlite:///{tmp_path / 'store.db'}"
    server: Postgres = request.getfixturevalue("postgres")
    return server.new_database()


async def nothing(_store) -> None:
    pass


def schema_of(url: str) -> dict[str, object]:
    engine = sa.create_engine(url)
    looking = sa.inspect(engine)
    found = {
        name: (
            [(c["name"], str(c["type"]), c["nullable"]) for c in looking.get_columns(name)],
            sorted((i["name"], *i["column_names"]) for i in looking.get_indexes(name)),
        )
        for name in sorted(looking.get_table_names())
    }
    engine.dispose()
    return found


def test_revisions_are_numbered_up_to_the_schema_version():
    assert [number for number, _ in schema._revisions()] == [*range(1, schema.SCHEMA_VERSION + 1)]


REVISION = '''"""scenarios have a colour."""

import sqlalchemy as sa
from alembic import op

revision = "{new:04}"
down_revision = "{last:04}"


def upgrade() -> None:
    op.add_column("scenarios", sa.Column("colour", sa.String(20)))
    {then}
'''


@pytest.fixture
def next_version(tmp_path, monkeypatch):
    """Add a schema revision. ``then`` is another statement of it."""

    def make(then: str = "pass") -> int:
        last = schema.SCHEMA_VERSION
        folder = tmp_path / "revisions"
        shutil.copytree(schema.REVISIONS, folder, dirs_exist_ok=True)
        text = REVISION.format(new=last + 1, last=last, then=then)
        (folder / "versions" / "next.py").write_text(text)
        monkeypatch.setattr(schema, "REVISIONS", folder)
        monkeypatch.setattr(schema, "SCHEMA_VERSION", last + 1)
        return last + 1

    return make


def test_a_store_is_migrated_by_alembic_revisions(url, next_version):
    run(url, nothing)
    new = next_version()
    engine = connect(url, timeout_s=30)
    assert schema.schema_status(engine).steps == (f"{new}: scenarios have a colour",)
    schema.prepare_schema(engine)
    assert schema.schema_status(engine) == schema.SchemaStatus(new, new, ())
    engine.dispose()
    assert "colour" in str(schema_of(url)["scenarios"])


def test_a_failed_revision_leaves_the_store_unchanged(url, next_version):
    run(url, nothing)
    before = schema_of(url)
    next_version("raise OSError('the plug was pulled')")
    with pytest.raises(Exception, match="the plug was pulled"):
        run(url, nothing)
    assert schema_of(url) == before


def test_migration_refuse_rejects_an_older_store_with_the_command(url, next_version):
    run(url, nothing)
    before = schema_of(url)
    next_version()
    with pytest.raises(StoreError, match="real2sim store migrate"):
        run(url, nothing, migration="refuse")
    assert schema_of(url) == before
    run(url, nothing)
    run(url, nothing, migration="refuse")


def test_migration_refuse_still_creates_a_new_store(url):
    run(url, nothing, migration="refuse")
    assert "alembic_version" in schema_of(url)


def test_a_store_from_before_the_first_release_is_refused_and_unchanged(url):
    engine = sa.create_engine(url)
    with engine.begin() as connection:
        for statement in (
            "CREATE TABLE schema_version (version INTEGER NOT NULL PRIMARY KEY)",
            "INSERT INTO schema_version VALUES (5)",
            "CREATE TABLE sessions (session_id VARCHAR(80) NOT NULL PRIMARY KEY)",
        ):
            connection.exec_driver_sql(statement)
    engine.dispose()
    before = schema_of(url)
    with pytest.raises(StoreError, match="before the first release"):
        run(url, nothing)
    assert schema_of(url) == before


def test_concurrent_workers_all_start_on_a_new_database(url):
    errors: list[BaseException] = []
    together = threading.Barrier(4)

    def start() -> None:
        engine = connect(url, timeout_s=30)
        try:
            together.wait()
            schema.prepare_schema(engine)
        except BaseException as error:
            errors.append(error)
        finally:
            engine.dispose()

    threads = [threading.Thread(target=start) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []


class Locked:
    """A cursor whose database is locked by another connection for a while."""

    def __init__(self, times: int, code: int = sqlite3.SQLITE_BUSY) -> None:
        self.left, self.code = times, code

    def execute(self, _statement: str) -> None:
        self.left -= 1
        if self.left >= 0:
            error = sqlite3.OperationalError("database is locked")
            error.sqlite_errorcode = self.code
            raise error


def test_setting_the_journal_mode_is_retried_while_the_database_is_locked():
    cursor = Locked(3)
    keep_write_ahead_journal(cursor, 30)
    assert cursor.left == -1


@pytest.mark.parametrize(("cursor", "timeout_s"), [(Locked(9**9), 0.0), (Locked(1, 8), 30)])
def test_failing_to_set_the_journal_mode_raises(cursor, timeout_s):
    with pytest.raises(sqlite3.OperationalError):
        keep_write_ahead_journal(cursor, timeout_s)


def test_store_files_are_readable_by_their_owner_only(tmp_path):
    file = tmp_path / "store.db"
    sqlite3.connect(file).close()
    file.touch(0o644)

    async def modes(_store):
        return {f.name: f.stat().st_mode & 0o777 for f in tmp_path.glob("store.db*")}

    found = run(f"sqlite:///{file}", modes)
    assert set(found) == {"store.db", "store.db-wal", "store.db-shm"}
    assert set(found.values()) == {0o600}
