"""``real2sim backup`` and ``real2sim restore``: copies of what a worker keeps."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..console import CommandError, console, refuse_existing
from .command import command
from .options import Overwrite

if TYPE_CHECKING:
    from ..settings import Settings

Data = Annotated[
    Path | None, typer.Option(help="State folder; default as `real2sim serve` has it.")
]


@command("backup")
def backup(
    out: Annotated[Path, typer.Argument(help="File to make.", dir_okay=False)],
    *,
    data: Data = None,
) -> None:
    """Copy scenarios, sessions, jobs and assets of a worker into one file, also while it works."""
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
    file: Annotated[Path, typer.Argument(help="Made by `real2sim backup`.", dir_okay=False)],
    *,
    data: Data = None,
    overwrite: Overwrite = False,
) -> None:
    """Put a backup into a state folder that no worker uses; a store there is moved aside."""
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
    from ..settings import Settings

    return Settings() if data is None else Settings(data_dir=data)


def _database(settings: Settings) -> Path:
    from ..service.storage.connection import file_of, shown_url

    file = file_of(settings.database_url)
    if file is None:
        raise CommandError(
            f"the store is {shown_url(settings.database_url)!r}, which is not a file: use the "
            "database's own tools, as pg_dump and pg_restore, and copy the assets folder"
        )
    return file
