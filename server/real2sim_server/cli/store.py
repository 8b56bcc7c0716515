"""Operator commands: store, backup, restore and token."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..console import CommandError, console, errors, refuse_existing
from .common import Overwrite, command, read_settings

if TYPE_CHECKING:
    import sqlalchemy as sa

    from ..service.accounts import NamedToken
    from ..settings import Settings


# --- store, backup, restore -----------------------------------------------------------------------

app = typer.Typer(no_args_is_help=True, help="Inspect and migrate a worker's database.")

Data = Annotated[Path | None, typer.Option(help="State folder; default: as for `real2sim serve`.")]
Url = Annotated[str | None, typer.Option(help="Default $REAL2SIM_STORE_URL, or SQLite in DATA.")]


@command("status", group=app)
def status(*, data: Data = None, url: Url = None) -> None:
    """Show the schema version of a store and pending migrations."""
    from ..service.storage.schema import schema_status

    with _engine(data, url, must_exist=True) as engine:
        found = schema_status(engine)
    console.print(f"schema {found.found or 'none'}; this program's is {found.wanted}")
    for step in found.steps:
        console.print(f"  to do: {step}", highlight=False)
    if found.steps:
        console.print("run `real2sim store migrate` for that; make a backup first")


@command("migrate", group=app)
def migrate(*, data: Data = None, url: Url = None) -> None:
    """Migrate a store in one transaction; create the tables of a new database."""
    from ..service.storage.schema import prepare_schema, schema_status

    with _engine(data, url, must_exist=False) as engine:
        before = schema_status(engine)
        prepare_schema(engine)
    if not before.steps:
        console.print(f"nothing to do: the schema is {before.wanted}")
    for step in before.steps:
        console.print(f"done: {step}", highlight=False)


@command("audit", group=app)
def audit(
    *,
    data: Data = None,
    url: Url = None,
    who: Annotated[str | None, typer.Option(help="Token name; default: all.")] = None,
    last: Annotated[int, typer.Option(min=1, max=1_000_000, help="Number of entries.")] = 100,
) -> None:
    """Print the audit log as JSON lines, newest first."""
    import asyncio
    import json
    from dataclasses import asdict

    from ..service.audit import AuditEntry, AuditLog
    from ..service.storage.store import Store

    settings = read_settings() if data is None else read_settings(data_dir=data)

    async def read() -> list[AuditEntry]:
        store = Store(url or settings.database_url, migration="refuse")
        await store.open()
        try:
            return await AuditLog(store).newest(account=who, limit=last)
        finally:
            await store.close()

    for entry in asyncio.run(read()):
        print(json.dumps(asdict(entry)))


@contextmanager
def _engine(data: Path | None, url: str | None, *, must_exist: bool) -> Iterator[sa.Engine]:
    """The store's database, with a timeout long enough for migrations.

    Raises:
        CommandError: the database is missing or unreachable.
    """
    from sqlalchemy import exc

    from ..service.storage.connection import connect, file_of, shown_url
    from ..service.storage.database import SCHEMA_TIMEOUT_S, TIMEOUT_S

    settings = read_settings() if data is None else read_settings(data_dir=data)
    url = url or settings.database_url
    file = file_of(url)
    if must_exist and file is not None and not file.is_file():
        raise CommandError(
            f"there is no store at {str(file)!r}; name its folder with --data, or give its --url"
        )
    engine = connect(url, timeout_s=TIMEOUT_S if must_exist else SCHEMA_TIMEOUT_S)
    try:
        yield engine
    except exc.SQLAlchemyError as error:
        reason = getattr(error, "orig", None) or error
        raise CommandError(f"cannot use the store {shown_url(url)!r}: {reason}") from error
    finally:
        engine.dispose()


# --- backup, restore ------------------------------------------------------------------------------


@command("backup")
def backup(
    out: Annotated[Path, typer.Argument(help="Output file.", dir_okay=False)],
    *,
    data: Data = None,
) -> None:
    """Back up scenarios, sessions, jobs and assets of a worker, running or not."""
    from ..service.storage.backup import make_backup

    settings = _settings(data)
    refuse_existing(out, overwrite=False)
    out.parent.mkdir(parents=True, exist_ok=True)
    info = make_backup(_database(settings), settings.assets_path, out.absolute())
    size = out.stat().st_size
    console.print(
        f"{out}: {size / 1e6:.1f} MB, {info.assets} assets, schema {info.schema}", highlight=False
    )


@command("restore")
def restore(
    file: Annotated[Path, typer.Argument(help="Backup file.", dir_okay=False)],
    *,
    data: Data = None,
    overwrite: Overwrite = False,
) -> None:
    """Restore a backup into an unused state folder; an existing store is moved aside."""
    from ..service.storage.backup import restore_backup

    settings = _settings(data)
    database = _database(settings)
    aside = restore_backup(
        file,
        settings.data_dir,
        database=database,
        assets=settings.assets_path,
        replace=overwrite,
    )
    console.print(f"restored to {database}", highlight=False)
    if aside != database:
        console.print(f"the store that was there is {aside}", highlight=False)


def _settings(data: Path | None) -> Settings:

    return read_settings() if data is None else read_settings(data_dir=data)


def _database(settings: Settings) -> Path:
    from ..service.storage.connection import file_of, shown_url

    file = file_of(settings.database_url)
    if file is None:
        raise CommandError(
            f"the store is {shown_url(settings.database_url)!r}, which is not a file: use the "
            "database's own tools, as pg_dump and pg_restore, and copy the assets folder"
        )
    return file


# --- token ----------------------------------------------------------------------------------------

token_app = typer.Typer(
    no_args_is_help=True, help="Create, list and revoke the named tokens of a worker."
)

Name = Annotated[str, typer.Argument(help="Name of the holder, as in metrics and logs.")]
TokensFile = Annotated[
    Path | None, typer.Option(help="Default $REAL2SIM_TOKENS_FILE.", dir_okay=False)
]


@command("add", group=token_app)
def add(
    name: Name,
    *,
    file: TokensFile = None,
    requests_per_second: Annotated[
        float | None, typer.Option(help="Requests and socket messages per second.")
    ] = None,
    sessions: Annotated[int | None, typer.Option(help="Maximum open sessions.")] = None,
    jobs: Annotated[int | None, typer.Option(help="Maximum unfinished jobs.")] = None,
    role: Annotated[
        str, typer.Option(help="Role: observe, drive, edit or administer.")
    ] = "administer",
) -> None:
    """Create a token and print it once; the file keeps its hash."""
    from pydantic import ValidationError

    from real2sim_proto.base import invalid_reason

    from ..service.accounts import ROLES, TokenLimits, add_token

    if role not in ROLES:
        raise CommandError(f"--role: one of {', '.join(ROLES)}, not {role!r}")
    try:
        limits = TokenLimits(
            requests_per_second=requests_per_second,
            sessions=sessions,
            jobs=jobs,
        )
    except ValidationError as error:
        first = error.errors()[0]
        option = str(first["loc"][0]).replace("_", "-")
        raise CommandError(f"--{option}: {invalid_reason(first)}") from None
    path = _file(file)
    token = add_token(path, name, limits, role=role)
    errors.print(
        f"token {name!r} is in {path}; a worker with REAL2SIM_TOKENS_FILE={path} takes it within "
        "a second. It is shown this once:",
        highlight=False,
        soft_wrap=True,
    )
    # Print only the token to stdout, to allow piping.
    print(token)


@command("list", group=token_app)
def list_(*, file: TokensFile = None) -> None:
    """List names and limits."""
    from ..service.accounts import read_token_file

    known = read_token_file(_file(file)).tokens
    for token in known:
        line = f"{token.name:20} {token.created_at:26} {token.role:10} {_limits(token)}"
        console.print(line, highlight=False, markup=False, soft_wrap=True)


@command("remove", group=token_app)
def remove(name: Name, *, file: TokensFile = None) -> None:
    """Revoke a token and disconnect its holder."""
    from ..service.accounts import remove_token

    path = _file(file)
    remove_token(path, name)
    console.print(f"token {name!r} is no longer in {path}", highlight=False, soft_wrap=True)


def _limits(token: NamedToken) -> str:
    given = token.limits.model_dump(exclude_none=True)
    return ", ".join(f"{key.replace('_', ' ')}: {value:g}" for key, value in given.items()) or "-"


def _file(given: Path | None) -> Path:

    found = given or read_settings().tokens_file
    if found is None:
        raise CommandError("which file? Give --file, or set REAL2SIM_TOKENS_FILE as for the worker")
    return found.absolute()
