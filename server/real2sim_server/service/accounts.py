"""Who takes how much of a worker: an account for each name of a token.

Limits are checked before something begins. All of it belongs to the event loop.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextvars import ContextVar
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any, NamedTuple

import structlog

from . import clock
from .tokens import DEFAULT_NAME, Role, TokenFileError, TokenLimits, read_token_file, token_hash

RELOAD_S = 1.0
"""Between looks whether the file of tokens has changed."""

log = structlog.get_logger(__name__)


class Limit(StrEnum):
    """What can be used up."""

    REQUESTS = "requests"
    SESSIONS = "sessions"
    JOBS = "jobs"


class OverLimitError(Exception):
    """The holder of a token has taken what they may; nothing has happened.

    Args:
        limit: which one.
        detail: what was taken and what is allowed.
        retry_after_s: when it may be asked again.
    """

    def __init__(self, limit: Limit, detail: str, *, retry_after_s: float) -> None:
        super().__init__(detail)
        self.limit = limit
        self.retry_after_s = retry_after_s


class RevokedError(Exception):
    """The token was removed while its holder was connected, or had a session."""

    def __init__(self, name: str) -> None:
        super().__init__(f"the token {name!r} is no longer valid")


class Meter:
    """A bucket that leaks as fast as is allowed.

    Args:
        rate: per second; as much may also come at once, and one at least.
    """

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._level = 0.0
        self._at = clock.monotonic()

    def take(self) -> float:
        """Take one; 0, or the seconds until there is one to take [s]."""
        now = clock.monotonic()
        self._level = max(0.0, self._level - (now - self._at) * self._rate)
        self._at = now
        room = max(self._rate, 1.0) - self._level
        if room >= 1.0:
            self._level += 1.0
            return 0.0
        return max((1.0 - room) / self._rate, 1e-3)


class Held(NamedTuple):
    """What somebody has that is limited in number."""

    sessions: int = 0
    jobs: int = 0


NOTHING = Held()


@dataclass(eq=False)
class Account:
    """What the holder of a token has taken since the worker started.

    Attributes:
        name: of the token.
        limits: what its holder may take.
        role: what its holder may do.
        requests: and messages of sockets, those that were let in.
        refusals: by limit.
        elsewhere: sessions and unfinished jobs on other workers of the fleet, as they last told.
        revoked: whether the token is no more.
        on_revoked: called on the event loop when that comes to be.
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
        """Other limits from now on; what was taken up to now does not count against them."""
        self.limits = limits
        rate = limits.requests_per_second
        self._requests = None if rate is None else Meter(rate)

    def admit(self) -> None:
        """Let one request or message in, and count it. On the event loop.

        Raises:
            RevokedError: the token is no more.
            OverLimitError: it has had its requests.
        """
        if self.revoked:
            raise RevokedError(self.name)
        if self._requests is not None and (wait := self._requests.take()):
            rate = self.limits.requests_per_second
            raise self._over(Limit.REQUESTS, f"more than {rate:g} requests a second", wait)
        self.requests += 1

    def check_sessions(self, present: int) -> None:
        """Raises OverLimitError where ``present`` sessions of this worker, with those of others,
        are as many as may be open."""
        most, present = self.limits.sessions, present + self.elsewhere.sessions
        if most is not None and present >= most:
            detail = f"{present} sessions are open, {most} may be"
            raise self._over(Limit.SESSIONS, detail, 5.0)

    def check_jobs(self, present: int) -> None:
        """Raises OverLimitError where ``present`` unfinished jobs of this worker, with those of
        others, are as many as there may be."""
        most, present = self.limits.jobs, present + self.elsewhere.jobs
        if most is not None and present >= most:
            detail = f"{present} jobs are not over, {most} may be"
            raise self._over(Limit.JOBS, detail, 5.0)

    def _over(self, limit: Limit, what: str, wait_s: float) -> OverLimitError:
        self.refusals[limit] += 1
        detail = f"token {self.name!r}: {what}"
        return OverLimitError(limit, detail, retry_after_s=wait_s)


ACCOUNT: ContextVar[Account | None] = ContextVar("account", default=None)
"""For whom the running task works; tasks that it starts work for the same one."""


def admit_message() -> None:
    """Let a message of a socket in; see :meth:`Account.admit`."""
    account = ACCOUNT.get()
    if account is not None:
        account.admit()


def owner_name() -> str:
    """Name of the account that the running task makes things for."""
    account = ACCOUNT.get()
    return account.name if account is not None else DEFAULT_NAME


class Accounts:
    """All accounts of a worker. Belongs to the event loop.

    Args:
        token: the worker's single token, whose account is ``default``.
        file: of named tokens; it may change at any time.

    Raises:
        TokenFileError: the file cannot be used.
    """

    def __init__(self, *, token: str | None, file: Path | None) -> None:
        self.default = Account(DEFAULT_NAME)
        self.wants_token = token is not None or file is not None
        self._file = file
        self._by_name = {DEFAULT_NAME: self.default}
        self._own = {token_hash(token): self.default} if token is not None else {}
        self._by_hash = dict(self._own)
        self._seen: object = None
        self._load()

    def __iter__(self) -> Iterator[Account]:
        """All that were ever there since the start, for metrics."""
        return iter(list(self._by_name.values()))

    def of_token(self, given: str | None) -> Account | None:
        """The account that a token opens; None for a wrong one.

        Where the worker wants no token, that of everybody.
        """
        if not self.wants_token:
            return self.default
        # Looked up by hash: how long that takes tells nothing of the tokens there are.
        return self._by_hash.get(token_hash(given)) if given is not None else None

    def of_owner(self, name: str) -> Account:
        """The account of whoever made something.

        Raises:
            RevokedError: their token is no more.
        """
        account = self._by_name.get(name)
        if account is None or account.revoked:
            raise RevokedError(name)
        return account

    @property
    def counts(self) -> bool:
        """Whether anybody's sessions or jobs are limited in number."""
        return any(a.limits.sessions is not None or a.limits.jobs is not None for a in self)

    def take_word(self, told: Iterable[Mapping[str, Any]]) -> None:
        """Take over what other workers have told of who has how much on them.

        Args:
            told: by worker ``{name: [sessions, jobs]}``.
        """
        sums: dict[str, Held] = {}
        for held in told:
            for name, (sessions, jobs) in held.items():
                before = sums.get(name, NOTHING)
                sums[name] = Held(before.sessions + sessions, before.jobs + jobs)
        for account in self:
            account.elsewhere = sums.get(account.name, NOTHING)

    async def watch(self) -> None:
        """Follow the file of tokens for ever; one that cannot be used changes nothing."""
        while self._file is not None:
            await asyncio.sleep(RELOAD_S)
            await asyncio.to_thread(self.reload)
            for account in self:
                if account.revoked and account.on_revoked:
                    for tell in list(account.on_revoked):
                        tell()

    def reload(self) -> None:
        """Take over the file's tokens if it has changed; on any thread."""
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
        """A new account, which goes on counting where one of its name has ended."""
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
    """For ``Retry-After``: whole seconds, at least one."""
    return max(1, math.ceil(error.retry_after_s))
