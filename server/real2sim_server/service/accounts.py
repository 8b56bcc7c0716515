"""Tokens with roles and limits, and the usage of each token's account.

Limits are checked before work begins. All state is used only on the event loop.
"""

from __future__ import annotations

import asyncio
import hashlib
import math
import os
import secrets
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextvars import ContextVar
from dataclasses import dataclass, field
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import structlog
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from real2sim_proto.base import invalid_reason

from .._files import atomic_file
from . import clock

# The file of named tokens and the worker's secrets. The file has hashes; a token is only shown when
# it is created.

# --- Hashes and sealed answers -------------------------------------------------------------------

KEY_FILE = "worker.key"
KEY_BYTES = 32
NONCE_BYTES = 16

_SEALED = b"\x01"
"""First byte of a sealed body; an unsealed body is JSON."""


def token_hash(token: str) -> str:
    """Hash of a token for storage. A token has 192 random bits, so its hash can be public."""
    return hashlib.sha256(b"token:" + token.encode()).hexdigest()


def sealed(body: bytes, secret: str) -> bytes:
    """Seal a body for the holder of ``secret``; the store has only the secret's hash."""
    nonce = secrets.token_bytes(NONCE_BYTES)
    return _SEALED + nonce + _masked(body, nonce, secret)


def unsealed(stored: bytes, secret: str) -> bytes:
    """Open a body that was sealed with ``secret``."""
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
    """The key of a state folder, created on first use; only its owner can read it.

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
"""Account name of ``REAL2SIM_TOKEN``, and of all requests if the worker requires no token."""
MAX_TOKENS = 1000
TOKEN_BYTES = 24
MAX_FILE_BYTES = 1 << 20

Role = Literal["observe", "drive", "edit", "administer"]
"""Permissions of a token."""
ROLES: tuple[Role, ...] = ("observe", "drive", "edit", "administer")
"""Roles in increasing order; each includes the previous ones."""

Rate = Annotated[float, Field(gt=0, le=1e15, allow_inf_nan=False)]


class TokenFileError(ValueError):
    """An unusable token file; the message states the reason and the remedy."""


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class TokenLimits(_Strict):
    """Limits of a token's usage; None means no limit.

    Attributes:
        requests_per_second: requests and socket messages; bursts of one second's worth.
        sessions: open sessions.
        jobs: unfinished jobs.
    """

    requests_per_second: Rate | None = None
    sessions: Annotated[int, Field(ge=0, le=1_000_000)] | None = None
    jobs: Annotated[int, Field(ge=0, le=1_000_000)] | None = None


class NamedToken(_Strict):
    """One token.

    Attributes:
        name: name of the holder, in metrics, logs, sessions and jobs.
        hash: hash of the token, from :func:`token_hash`.
        created_at: UTC, ISO 8601.
        limits: limits of its usage.
        role: its permissions.
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
    """Read the tokens of a file.

    Raises:
        TokenFileError: it is missing, unreadable or invalid.
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
        message = invalid_reason(first)
        raise TokenFileError(
            f"{str(path)!r} is not a token file: {f'{where}: ' * bool(where)}{message}; "
            "`real2sim token` writes such files"
        ) from error


def add_token(path: Path, name: str, limits: TokenLimits, *, role: Role = "administer") -> str:
    """Create a token and add its hash to a file, which is created if missing.

    Returns:
        The token, which is not stored anywhere.

    Raises:
        TokenFileError: the name is taken or invalid, or the file is unusable.
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
        message = invalid_reason(error.errors()[0])
        raise TokenFileError(f"{name!r} cannot be a token's name: {message}") from error
    _write(path, changed)
    return token


def remove_token(path: Path, name: str) -> None:
    """Remove a token from a file. Raises TokenFileError if no token has that name."""
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


RELOAD_S = 1.0
"""Interval between checks of the token file for changes [s]."""

log = structlog.get_logger(__name__)


class Limit(StrEnum):
    """Limited resources."""

    REQUESTS = "requests"
    SESSIONS = "sessions"
    JOBS = "jobs"


class OverLimitError(Exception):
    """An account has reached a limit; the request had no effect.

    Args:
        limit: the limit.
        detail: usage and limit.
        retry_after_s: seconds until a retry may succeed.
    """

    def __init__(self, limit: Limit, detail: str, *, retry_after_s: float) -> None:
        super().__init__(detail)
        self.limit = limit
        self.retry_after_s = retry_after_s


class RevokedError(Exception):
    """The token was removed while its holder was connected or had a session."""

    def __init__(self, name: str) -> None:
        super().__init__(f"the token {name!r} is no longer valid")


class Meter:
    """A leaky bucket.

    Args:
        rate: rate per second; also the burst size, at least one.
    """

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._level = 0.0
        self._at = clock.monotonic()

    def take(self) -> float:
        """Take one unit; returns 0, or the seconds until one is available [s]."""
        now = clock.monotonic()
        self._level = max(0.0, self._level - (now - self._at) * self._rate)
        self._at = now
        room = max(self._rate, 1.0) - self._level
        if room >= 1.0:
            self._level += 1.0
            return 0.0
        return max((1.0 - room) / self._rate, 1e-3)


class Held(NamedTuple):
    """Numbers of an account's limited resources."""

    sessions: int = 0
    jobs: int = 0


NOTHING = Held()


@dataclass(eq=False)
class Account:
    """Usage of a token since the worker started.

    Attributes:
        name: name of the token.
        limits: limits of its usage.
        role: its permissions.
        requests: admitted requests and socket messages.
        refusals: refusals by limit.
        elsewhere: sessions and unfinished jobs on other workers of the fleet, as last reported.
        revoked: whether the token has been removed.
        on_revoked: called on the event loop when the token is removed.
    """

    name: str
    limits: TokenLimits = field(default_factory=TokenLimits)
    role: Role = "administer"
    requests: int = 0
    refusals: dict[Limit, int] = field(default_factory=lambda: dict.fromkeys(Limit, 0))
    elsewhere: Held = NOTHING
    revoked: bool = False
    on_revoked: set[Callable[[], object]] = field(default_factory=set)

    def __post_init__(self) -> None:
        self.limit(self.limits)

    def limit(self, limits: TokenLimits) -> None:
        """Change the limits; earlier usage does not count against them."""
        self.limits = limits
        rate = limits.requests_per_second
        self._requests = None if rate is None else Meter(rate)

    def admit(self) -> None:
        """Admit and count one request or message. On the event loop.

        Raises:
            RevokedError: the token has been removed.
            OverLimitError: the request limit is reached.
        """
        if self.revoked:
            raise RevokedError(self.name)
        if self._requests is not None and (wait := self._requests.take()):
            rate = self.limits.requests_per_second
            raise self._over(Limit.REQUESTS, f"more than {rate:g} requests a second", wait)
        self.requests += 1

    def check_sessions(self, present: int) -> None:
        """Raises OverLimitError if ``present`` sessions on this worker, plus those on others, reach
        the limit."""
        most, present = self.limits.sessions, present + self.elsewhere.sessions
        if most is not None and present >= most:
            detail = f"{present} sessions are open, {most} may be"
            raise self._over(Limit.SESSIONS, detail, 5.0)

    def check_jobs(self, present: int) -> None:
        """Raises OverLimitError if ``present`` unfinished jobs on this worker, plus those on
        others, reach the limit."""
        most, present = self.limits.jobs, present + self.elsewhere.jobs
        if most is not None and present >= most:
            detail = f"{present} jobs are not over, {most} may be"
            raise self._over(Limit.JOBS, detail, 5.0)

    def _over(self, limit: Limit, what: str, wait_s: float) -> OverLimitError:
        self.refusals[limit] += 1
        detail = f"token {self.name!r}: {what}"
        return OverLimitError(limit, detail, retry_after_s=wait_s)


ACCOUNT: ContextVar[Account | None] = ContextVar("account", default=None)
"""Account of the running task; tasks that it starts inherit it."""


def admit_message() -> None:
    """Admit a socket message; see :meth:`Account.admit`."""
    account = ACCOUNT.get()
    if account is not None:
        account.admit()


def owner_name() -> str:
    """Name of the account that owns objects created by the running task."""
    account = ACCOUNT.get()
    return account.name if account is not None else DEFAULT_NAME


class Accounts:
    """All accounts of a worker, for use on the event loop.

    Args:
        token: the worker's single token, with the account ``default``.
        file: file of named tokens; it may change at any time.

    Raises:
        TokenFileError: the file is unusable.
    """

    def __init__(self, *, token: str | None, file: Path | None) -> None:
        self.default = Account(DEFAULT_NAME)
        self.needs_token = token is not None or file is not None
        self._file = file
        self._by_name = {DEFAULT_NAME: self.default}
        self._own = {token_hash(token): self.default} if token is not None else {}
        self._by_hash = dict(self._own)
        self._seen: object = None
        self._load()

    def __iter__(self) -> Iterator[Account]:
        """All accounts since the start, including removed ones, for metrics."""
        return iter(list(self._by_name.values()))

    def of_token(self, given: str | None) -> Account | None:
        """The account of a token; None for a wrong one.

        If the worker requires no token, this is the default account.
        """
        if not self.needs_token:
            return self.default
        # Lookup by hash: its duration reveals nothing about existing tokens.
        return self._by_hash.get(token_hash(given)) if given is not None else None

    def of_owner(self, name: str) -> Account:
        """The account of an owner.

        Raises:
            RevokedError: the owner's token has been removed.
        """
        account = self._by_name.get(name)
        if account is None or account.revoked:
            raise RevokedError(name)
        return account

    @property
    def counts(self) -> bool:
        """Whether any account has a limited number of sessions or jobs."""
        return any(a.limits.sessions is not None or a.limits.jobs is not None for a in self)

    def take_word(self, told: Iterable[Mapping[str, Any]]) -> None:
        """Update the usage on other workers from their reports.

        Args:
            told: reports ``{name: [sessions, jobs]}`` by worker.
        """
        sums: dict[str, Held] = {}
        for held in told:
            for name, (sessions, jobs) in held.items():
                before = sums.get(name, NOTHING)
                sums[name] = Held(before.sessions + sessions, before.jobs + jobs)
        for account in self:
            account.elsewhere = sums.get(account.name, NOTHING)

    async def watch(self) -> None:
        """Reload the token file on changes, until cancelled; an unusable file changes nothing."""
        while self._file is not None:
            await asyncio.sleep(RELOAD_S)
            await asyncio.to_thread(self.reload)
            for account in self:
                if account.revoked and account.on_revoked:
                    for tell in list(account.on_revoked):
                        tell()

    def reload(self) -> None:
        """Reload the file's tokens if it has changed; on any thread."""
        try:
            self._load()
        except TokenFileError as error:
            log.error("tokens not reloaded; those of before stay valid", reason=str(error))

    def _load(self) -> None:
        if self._file is None or (state := _state_of(self._file)) == self._seen:
            return
        known = self._seen is not None
        self._seen = state
        tokens = read_token_file(self._file).tokens
        by_hash = dict(self._own)
        for token in tokens:
            account = self._by_name.get(token.name)
            if account is None or account.revoked:
                account = self._again(account, token.name)
            account.role = token.role
            if account.limits != token.limits:
                account.limit(token.limits)
            by_hash[token.hash] = account
        names = {token.name for token in tokens}
        for account in self:
            account.revoked = account is not self.default and account.name not in names
        self._by_hash = by_hash
        if known:
            log.info("tokens reloaded", tokens=len(tokens))

    def _again(self, before: Account | None, name: str) -> Account:
        """A new account. It continues the counters of a removed account with the same name."""
        account = Account(name)
        if before is not None:
            account.requests, account.refusals = before.requests, dict(before.refusals)
        self._by_name[name] = account
        return account


def _state_of(file: Path) -> object:
    try:
        found = file.stat()
    except OSError:
        return "missing"
    return (found.st_mtime_ns, found.st_size, found.st_ino)


def seconds_to_wait(error: OverLimitError) -> int:
    """Value of ``Retry-After``: whole seconds, at least one."""
    return max(1, math.ceil(error.retry_after_s))
