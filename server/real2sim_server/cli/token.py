"""``real2sim token``: who may call a worker, and how much of it each may take."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..console import CommandError, console, errors
from .command import command

if TYPE_CHECKING:
    from ..service.accounts import NamedToken

app = typer.Typer(
    no_args_is_help=True, help="Create, list and revoke the named tokens of a worker."
)

Name = Annotated[str, typer.Argument(help="Name of the holder, as in metrics and logs.")]
TokensFile = Annotated[
    Path | None, typer.Option(help="Default $REAL2SIM_TOKENS_FILE.", dir_okay=False)
]


@command("add", group=app)
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
        raise CommandError(f"--{option}: {first['msg']}, not {first['input']!r}") from None
    path = _file(file)
    token = add_token(path, name, limits, role=role)
    errors.print(
        f"token {name!r} is in {path}; a worker with REAL2SIM_TOKENS_FILE={path} takes it within "
        "a second. It is shown this once:",
        highlight=False,
        soft_wrap=True,
    )
    # To stdout and alone, so that it can be piped to where it is kept.
    print(token)


@command("list", group=app)
def list_(*, file: TokensFile = None) -> None:
    """List names and limits."""
    from ..service.accounts import read_token_file

    known = read_token_file(_file(file)).tokens
    for token in known:
        line = f"{token.name:20} {token.created_at:26} {token.role:10} {_limits(token)}"
        console.print(line, highlight=False, markup=False, soft_wrap=True)


@command("remove", group=app)
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
    from ..settings import Settings

    found = given or Settings().tokens_file
    if found is None:
        raise CommandError("which file? Give --file, or set REAL2SIM_TOKENS_FILE as for the worker")
    return found.absolute()
