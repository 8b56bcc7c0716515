"""Tokens: the file of named tokens with their roles and limits, and the secrets of a worker.

The file holds hashes. A token itself is shown once, when it is made.
"""

from __future__ import annotations

import hashlib
import os
import secrets
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from .._files import atomic_file

# --- Hashes and sealed answers -------------------------------------------------------------------

KEY_FILE = "worker.key"
KEY_BYTES = 32
NONCE_BYTES = 16

_SEALED = b"\x01"
"""First byte of a sealed body; one that is not sealed is JSON."""


def token_hash(token: str) -> str:
    """What is kept of a token. It has 192 random bits: nobody can guess it from its hash."""
    return hashlib.sha256(b"token:" + token.encode()).hexdigest()


def sealed(body: bytes, secret: str) -> bytes:
    """A body that only the holder of ``secret`` can read; the store has the secret as a hash."""
    nonce = secrets.token_bytes(NONCE_BYTES)
    return _SEALED + nonce + _masked(body, nonce, secret)


def unsealed(stored: bytes, secret: str) -> bytes:
    """The body that was sealed with ``secret``."""
    if not stored.startswith(_SEALED):
        return stored
    nonce = stored[1 : 1 + NONCE_BYTES]
    return _masked(stored[1 + NONCE_BYTES :], nonce, secret)


def _masked(body: bytes, nonce: bytes, secret: str) -> bytes:
    mask = hashlib.shake_256(b"reply:" + nonce + secret.encode()).digest(len(body))
    size = len(body)
    both = int.from_bytes(body, "little") ^ int.from_bytes(mask, "little")
    return both.to_bytes(size, "little")


def worker_key(folder: Path) -> bytes:
    """The key of a state folder, made the first time; only its owner can read it.

    Raises:
        OSError: the folder cannot be written to.
    """
    path = folder / KEY_FILE
    if path.is_file() and len(known := path.read_bytes()) == KEY_BYTES:
        return known
    key = secrets.token_bytes(KEY_BYTES)
    temporary = folder / f".{KEY_FILE}.tmp-{secrets.token_hex(6)}"
    descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    with os.fdopen(descriptor, "wb") as file:
        file.write(key)
        file.flush()
        os.fsync(descriptor)
    temporary.replace(path)
    return key


DEFAULT_NAME = "default"
"""Of ``REAL2SIM_TOKEN``, and of everybody where a worker wants no token."""
MAX_TOKENS = 1000
TOKEN_BYTES = 24
MAX_FILE_BYTES = 1 << 20

Role = Literal["observe", "drive", "edit", "administer"]
"""What the holder of a token may do."""
ROLES: tuple[Role, ...] = ("observe", "drive", "edit", "administer")
"""Each may all that the one before it may."""

Rate = Annotated[float, Field(gt=0, le=1e15, allow_inf_nan=False)]


class TokenFileError(ValueError):
    """A file of tokens that cannot be used; the message says why and what to do."""


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class TokenLimits(_Strict):
    """What the holder of a token may take; None is no limit.

    Attributes:
        requests_per_second: requests and messages of sockets; a second's worth at once.
        sessions: open at a time.
        jobs: not over, at a time.
    """

    requests_per_second: Rate | None = None
    sessions: Annotated[int, Field(ge=0, le=1_000_000)] | None = None
    jobs: Annotated[int, Field(ge=0, le=1_000_000)] | None = None


class NamedToken(_Strict):
    """One token.

    Attributes:
        name: of whoever holds it; metrics, logs, sessions and jobs name it so.
        hash: of the token, as :func:`~.storage.tokens.token_hash` makes it.
        created_at: UTC, ISO 8601.
        limits: what its holder may take.
        role: what its holder may do.
    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.\-]{0,39}$")]
    hash: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    created_at: str = ""
    limits: TokenLimits = TokenLimits()
    role: Role = "administer"

    @model_validator(mode="after")
    def _is_free(self) -> NamedToken:
        if self.name == DEFAULT_NAME:
            raise ValueError(f"the name {DEFAULT_NAME!r} is that of REAL2SIM_TOKEN")
        return self


class TokenFile(_Strict):
    """All named tokens of a worker."""

    format: Literal["real2sim.tokens"] = "real2sim.tokens"
    version: Literal[1] = 1
    tokens: Annotated[tuple[NamedToken, ...], Field(max_length=MAX_TOKENS)] = ()

    @model_validator(mode="after")
    def _are_different(self) -> TokenFile:
        for what in ("name", "hash"):
            given = [getattr(token, what) for token in self.tokens]
            if len(set(given)) < len(given):
                raise ValueError(f"two tokens have the same {what}")
        return self


def read_token_file(path: Path) -> TokenFile:
    """The tokens of a file.

    Raises:
        TokenFileError: it is missing, cannot be read, or says something else.
    """
    try:
        with path.open("rb") as file:
            text = file.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        raise TokenFileError(
            f"the tokens cannot be read from {str(path)!r}: {error.strerror}; make a first one "
            f"with `real2sim token add NAME --file {path}`"
        ) from error
    if len(text) > MAX_FILE_BYTES:
        raise TokenFileError(f"{str(path)!r} has more than {MAX_FILE_BYTES} bytes")
    try:
        return TokenFile.model_validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = "/".join(str(part) for part in first["loc"])
        message = str(first["msg"]).removeprefix("Value error, ")
        raise TokenFileError(
            f"{str(path)!r} is no file of tokens: {f'{where}: ' * bool(where)}{message}; "
            "`real2sim token` writes such files"
        ) from error


def add_token(path: Path, name: str, limits: TokenLimits, *, role: Role = "administer") -> str:
    """Make a token, and add its hash to a file, which is made where it is missing.

    Returns:
        The token, which is written nowhere.

    Raises:
        TokenFileError: the name is taken or none, or the file cannot be used.
    """
    present = read_token_file(path) if path.exists() else TokenFile()
    if any(token.name == name for token in present.tokens):
        raise TokenFileError(
            f"there is a token {name!r} already; remove it first: `real2sim token remove {name}`"
        )
    token = secrets.token_urlsafe(TOKEN_BYTES)
    now = datetime.now(UTC).isoformat(timespec="seconds")
    try:
        added = NamedToken(
            name=name, hash=token_hash(token), created_at=now, limits=limits, role=role
        )
        changed = TokenFile(tokens=(*present.tokens, added))
    except ValidationError as error:
        message = str(error.errors()[0]["msg"]).removeprefix("Value error, ")
        raise TokenFileError(f"{name!r} cannot be a token's name: {message}") from error
    _write(path, changed)
    return token


def remove_token(path: Path, name: str) -> None:
    """Take a token out of a file. Raises TokenFileError where there is none of that name."""
    present = read_token_file(path)
    left = tuple(token for token in present.tokens if token.name != name)
    if len(left) == len(present.tokens):
        known = ", ".join(token.name for token in present.tokens) or "none"
        raise TokenFileError(f"there is no token {name!r} in {str(path)!r}; it has: {known}")
    _write(path, TokenFile(tokens=left))


def _write(path: Path, tokens: TokenFile) -> None:
    text = tokens.model_dump_json(indent=1, exclude_none=True) + "\n"
    try:
        with atomic_file(path) as file:
            os.fchmod(file.fileno(), 0o600)
            file.write(text.encode())
    except OSError as error:
        raise TokenFileError(
            f"{str(path)!r} cannot be written: {error.strerror or error}"
        ) from error
