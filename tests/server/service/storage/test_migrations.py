"""A store of an older schema becomes what a new one would be."""

from __future__ import annotations

import shutil
import sqlite3
import threading

import pytest
import sqlalchemy as sa

from real2sim_server.service.storage import migrations, older, tables
from real2sim_server.service.storage.connection import connect, keep_write_ahead_journal
from real2sim_server.service.storage.errors import StoreError
from real2sim_server.service.storage.tokens import token_hash

from ..postgres import Postgres
from .opened_store import run

SECRET = "a-token-that-nobody-should-find"
VERSION_1 = [
    "CREATE TABLE schema_version (version INTEGER NOT NULL PRIMARY KEY)",
    "INSERT INTO schema_version VALUES (1)",
    "CREATE TABLE scenarios (scenario_id VARCHAR(80) NOT NULL PRIMARY KEY, name VARCHAR(200) NOT "
    "NULL, scene VARCHAR(80) NOT NULL, scene_hash VARCHAR(64) NOT NULL, created_us BIGINT NOT "
    "NULL)",
    "CREATE TABLE scenario_log (scenario_id VARCHAR(80) NOT NULL, revision INTEGER NOT NULL, kind "
    "VARCHAR(8) NOT NULL, entry TEXT NOT NULL, created_us BIGINT NOT NULL, PRIMARY KEY "
    "(scenario_id, revision), FOREIGN KEY(scenario_id) REFERENCES scenarios (scenario_id) ON "
    "DELETE CASCADE)",
    "CREATE TABLE scenario_snapshots (scenario_id VARCHAR(80) NOT NULL PRIMARY KEY, revision "
    "INTEGER NOT NULL, made_by VARCHAR(80) NOT NULL, state {blob} NOT NULL, FOREIGN "
    "KEY(scenario_id) REFERENCES scenarios (scenario_id) ON DELETE CASCADE)",
    "CREATE TABLE sessions (session_id VARCHAR(80) NOT NULL PRIMARY KEY, worker_id VARCHAR(16) NOT "
    "NULL, scene VARCHAR(80) NOT NULL, scene_hash VARCHAR(64) NOT NULL, scenario_id VARCHAR(80), "
    "scenario_revision INTEGER, token VARCHAR(200) NOT NULL, created_us BIGINT NOT NULL, closed_us "
    "BIGINT, reason TEXT)",
    "CREATE INDEX ix_sessions_open ON sessions (worker_id, closed_us)",
    "CREATE TABLE session_log (session_id VARCHAR(80) NOT NULL, seq INTEGER NOT NULL, kind "
    "VARCHAR(16) NOT NULL, step INTEGER, payload {blob} NOT NULL, created_us BIGINT NOT NULL, "
    "PRIMARY KEY (session_id, seq), FOREIGN KEY(session_id) REFERENCES sessions (session_id) ON "
    "DELETE CASCADE)",
    "CREATE TABLE jobs (job_id VARCHAR(80) NOT NULL PRIMARY KEY, worker_id VARCHAR(16) NOT NULL, "
    "kind VARCHAR(16) NOT NULL, subject VARCHAR(80) NOT NULL, state VARCHAR(16) NOT NULL, document "
    "TEXT NOT NULL, created_us BIGINT NOT NULL)",
    "CREATE INDEX ix_jobs_created ON jobs (created_us)",
    "CREATE INDEX ix_jobs_state ON jobs (worker_id, state)",
    "CREATE TABLE idempotent_replies (key VARCHAR(300) NOT NULL PRIMARY KEY, fingerprint "
    "VARCHAR(64) NOT NULL, status INTEGER NOT NULL, headers TEXT NOT NULL, body {blob} NOT NULL, "
    "created_us BIGINT NOT NULL)",
    "CREATE INDEX ix_idempotent_replies_created ON idempotent_replies (created_us)",
]


@pytest.fixture(params=["sqlite", "postgresql"])
def url(request, tmp_path) -> str:
    if request.param == "sqlite":
        return f"sqlite:///{tmp_path / 'store.db'}"
    server: Postgres = request.getfixturevalue("postgres")
    return server.new_database()


def write_version_1(url: str) -> None:
    """A store as the first schema had it, with a session, a scenario and two stored answers."""
    engine = sa.create_engine(url)
    blob = "BLOB" if engine.dialect.name == "sqlite" else "BYTEA"
    far = 2**60
    with engine.begin() as connection:
        for statement in VERSION_1:
            connection.exec_driver_sql(statement.format(blob=blob))
        connection.exec_driver_sql("INSERT INTO scenarios VALUES ('sc_1', 'n', 'tiny', 'h', 1)")
        connection.execute(
            sa.text("INSERT INTO scenario_log VALUES ('sc_1', 1, 'edit', :entry, 1)"),
            {"entry": '{"kind": "edit"}'},
        )
        connection.execute(
            sa.text(
                "INSERT INTO sessions VALUES ('w0.1','w0','tiny','h',NULL,NULL,:t,1,NULL,NULL)"
            ),
            {"t": SECRET},
        )
        answer = sa.text("INSERT INTO idempotent_replies VALUES (:k, 'f', 201, '{}', :body, :us)")
        telling = f'{{"token":"{SECRET}"}}'.encode()
        for key, body in (("telling", telling), ("harmless", b'{"revision":1}')):
            connection.execute(answer, {"k": key, "body": body, "us": far})
    engine.dispose()


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


def test_an_older_store_gets_the_present_schema(url, tmp_path, request):
    write_version_1(url)
    run(url, nothing)
    new = f"sqlite:///{tmp_path / 'new.db'}"
    if url.startswith("postgresql"):
        new = request.getfixturevalue("postgres").new_database()
    run(new, nothing)
    assert schema_of(url) == schema_of(new)


def test_what_an_older_store_holds_is_kept(url):
    write_version_1(url)

    async def read(store):
        return (
            await store.scenario_entries("sc_1"),
            await store.session("w0.1"),
            await store.reply("harmless"),
            await store.reply("telling"),
        )

    entries, session, harmless, telling = run(url, read)
    assert entries == [{"kind": "edit"}]
    assert session.token_hash == token_hash(SECRET)
    assert harmless.body == b'{"revision":1}'
    assert telling is None


def test_no_token_is_left_in_the_files_of_a_store_that_was_migrated(tmp_path):
    url = f"sqlite:///{tmp_path / 'store.db'}"
    write_version_1(url)
    run(url, nothing)
    for file in tmp_path.iterdir():
        assert SECRET.encode() not in file.read_bytes(), file.name


def test_a_migration_that_fails_leaves_the_store_as_it_was(url, monkeypatch):
    write_version_1(url)
    before = schema_of(url)

    def fail(connection) -> None:
        older._hash_tokens(connection)
        raise OSError("the plug was pulled")

    broken = older.Migration(2, "fails", fail)
    with monkeypatch.context() as patch:
        patch.setattr(migrations, "OLDER_STEPS", (broken,))
        with pytest.raises(Exception, match="the plug was pulled"):
            run(url, nothing)
    assert schema_of(url) == before
    run(url, nothing)
    assert "token_hash" in str(schema_of(url)["sessions"])


def test_every_migration_leads_one_version_on():
    versions = [m.version for m in older.OLDER_STEPS]
    versions += [number for number, _ in migrations._revisions() if number > older.LAST]
    assert versions == list(range(2, tables.SCHEMA_VERSION + 1))


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
    """Makes this program one that has a revision more; what it does besides is given."""

    def make(then: str = "pass") -> int:
        last = tables.SCHEMA_VERSION
        folder = tmp_path / "revisions"
        shutil.copytree(migrations.REVISIONS, folder, dirs_exist_ok=True)
        text = REVISION.format(new=last + 1, last=last, then=then)
        (folder / "versions" / "next.py").write_text(text)
        monkeypatch.setattr(migrations, "REVISIONS", folder)
        monkeypatch.setattr(tables, "SCHEMA_VERSION", last + 1)
        return last + 1

    return make


@pytest.mark.parametrize("old", [False, True], ids=["present", "older-than-alembic"])
def test_a_store_follows_the_revisions_of_alembic(url, old, next_version):
    if old:
        write_version_1(url)
    else:
        run(url, nothing)
    new = next_version()
    engine = connect(url, timeout_s=30)
    assert migrations.schema_status(engine).steps[-1] == f"{new}: scenarios have a colour"
    migrations.prepare_schema(engine)
    assert migrations.schema_status(engine) == migrations.SchemaStatus(new, new, ())
    engine.dispose()
    assert "colour" in str(schema_of(url)["scenarios"])


def test_a_revision_that_fails_leaves_the_store_as_it_was(url, next_version):
    run(url, nothing)
    before = schema_of(url)
    next_version("raise OSError('the plug was pulled')")
    with pytest.raises(Exception, match="the plug was pulled"):
        run(url, nothing)
    assert schema_of(url) == before


def test_an_older_store_is_refused_with_the_command_to_run_where_that_is_asked_for(url):
    write_version_1(url)
    before = schema_of(url)
    with pytest.raises(StoreError, match="real2sim store migrate"):
        run(url, nothing, migration="refuse")
    assert schema_of(url) == before
    run(url, nothing)
    run(url, nothing, migration="refuse")


def test_a_new_store_is_made_also_where_older_ones_are_refused(url):
    run(url, nothing, migration="refuse")
    assert "alembic_version" in schema_of(url)


@pytest.mark.parametrize("old", [False, True], ids=["empty", "older"])
def test_workers_that_start_at_once_on_one_database_all_come_up(url, old):
    if old:
        write_version_1(url)
    errors: list[BaseException] = []
    together = threading.Barrier(4)

    def start() -> None:
        engine = connect(url, timeout_s=30)
        try:
            together.wait()
            migrations.prepare_schema(engine)
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
    """A cursor whose database another connection holds for a while."""

    def __init__(self, times: int, code: int = sqlite3.SQLITE_BUSY) -> None:
        self.left, self.code = times, code

    def execute(self, _statement: str) -> None:
        self.left -= 1
        if self.left >= 0:
            error = sqlite3.OperationalError("database is locked")
            error.sqlite_errorcode = self.code
            raise error


def test_who_finds_the_journal_changed_by_another_connection_tries_again():
    cursor = Locked(3)
    keep_write_ahead_journal(cursor, 30)
    assert cursor.left == -1


@pytest.mark.parametrize(("cursor", "timeout_s"), [(Locked(9**9), 0.0), (Locked(1, 8), 30)])
def test_a_journal_that_cannot_be_changed_is_told(cursor, timeout_s):
    with pytest.raises(sqlite3.OperationalError):
        keep_write_ahead_journal(cursor, timeout_s)


def test_the_files_of_a_store_are_for_its_owner_alone(tmp_path):
    file = tmp_path / "store.db"
    sqlite3.connect(file).close()
    file.touch(0o644)

    async def modes(_store):
        return {f.name: f.stat().st_mode & 0o777 for f in tmp_path.glob("store.db*")}

    found = run(f"sqlite:///{file}", modes)
    assert set(found) == {"store.db", "store.db-wal", "store.db-shm"}
    assert set(found.values()) == {0o600}
