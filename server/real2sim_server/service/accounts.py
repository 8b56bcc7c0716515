"""Who takes how much of a worker: an account for each name of a token.

Figures are counted where they arise: requests and bytes on the event loop, engine time on the
engine's thread, that of steps without images on the thread of worlds. Each has one writer, so that
counting is an addition and needs no lock. Limits are
looked at before something begins; what has begun is finished, and counts.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextvars import ContextVar
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import structlog

from . import clock
from .storage.tokens import token_hash
from .token_file import DEFAULT_NAME, Role, TokenFileError, TokenLimits, read_token_file

T = TypeVar("T")

RELOAD_S = 1.0
"""Between looks whether the file of tokens has changed."""
PATIENCE_S = 1.0
"""Between looks of a job whether its account may use the engine again."""

log = structlog.get_logger(__name__)


class Limit(StrEnum):
    """What can be used up."""

    REQUESTS = "requests"
    BYTES = "bytes"
    ENGINE = "engine"
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
    """A growing figure against what it may grow by: a bucket that leaks as fast as is allowed.

    Args:
        allowed: in a period; so much may also come at once.
        period_s: of time [s].
    """

    def __init__(self, allowed: float, period_s: float) -> None:
        self.allowed = allowed
        self._per_s = allowed / period_s
        self._level = 0.0
        self._seen = 0.0
        self._at = clock.monotonic()

    def wait_s(self, total: float, more: float = 0.0) -> float:
        """Seconds until ``more`` may be added to what is ``total`` up to now; 0 for at once."""
        now = clock.monotonic()
        leaked = (now - self._at) * self._per_s
        self._level = max(0.0, self._level - leaked) + (total - self._seen)
        self._at, self._seen = now, total
        # Nothing may be added at the brim, and a single thing may always be added to nothing.
        room = max(self.allowed, more) - self._level
        if room >= more > 0 or (more == 0 and room > 0):
            return 0.0
        return max((more - room) / self._per_s, 1e-3)


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
        received_bytes, sent_bytes: bodies and messages, and images by shared memory.
        engine_seconds: written by the engine's thread alone.
        world_seconds: of the processor, for what needs no engine; written by the thread of worlds
            alone.
        refusals: by limit.
        elsewhere: sessions and unfinished jobs on other workers of the fleet, as they last told.
        revoked: whether the token is no more.
        on_revoked: called on the event loop when that comes to be.
    """

    name: str
    limits: TokenLimits = field(default_factory=TokenLimits)
    role: Role = "administer"
    requests: int = 0
    received_bytes: int = 0
    sent_bytes: int = 0
    engine_seconds: float = 0.0
    world_seconds: float = 0.0
    refusals: dict[Limit, int] = field(default_factory=lambda: dict.fromkeys(Limit, 0))
    elsewhere: Held = NOTHING
    revoked: bool = False
    on_revoked: set[Callable[[], object]] = field(default_factory=set)

    def __post_init__(self) -> None:
        self.limit(self.limits)

    @property
    def computing_seconds(self) -> float:
        """What limits of engine time count: on the engine, or instead of it."""
        return self.engine_seconds + self.world_seconds

    @property
    def is_limited(self) -> bool:
        """Whether a message may be refused, or what it asks for."""
        return not (self._requests is None and self._bytes is None and self._engine is None)

    def limit(self, limits: TokenLimits) -> None:
        """Other limits from now on; what was taken up to now does not count against them."""
        self.limits = limits
        self._requests = _meter(limits.requests_per_second, 1.0, self.requests)
        self._bytes = _meter(limits.bytes_per_day, 86_400.0, self.received_bytes + self.sent_bytes)
        self._engine = _meter(limits.engine_seconds_per_minute, 60.0, self.computing_seconds)

    def admit(self) -> None:
        """Let one request or message in, and count it. On the event loop.

        Raises:
            RevokedError: the token is no more.
            OverLimitError: of requests or bytes.
        """
        if self.revoked:
            raise RevokedError(self.name)
        if self._requests is not None and (wait := self._requests.wait_s(self.requests, 1.0)):
            rate = self.limits.requests_per_second
            raise self._over(Limit.REQUESTS, f"more than {rate:g} requests a second", wait)
        if self._bytes is not None:
            taken = self.received_bytes + self.sent_bytes
            if wait := self._bytes.wait_s(taken):
                allowed = self.limits.bytes_per_day
                raise self._over(Limit.BYTES, f"more than {allowed:g} bytes a day", wait)
        self.requests += 1

    def check_engine(self) -> None:
        """Raises OverLimitError while the account has had its time on the engine."""
        if self._engine is not None and (wait := self._engine.wait_s(self.computing_seconds)):
            allowed = self.limits.engine_seconds_per_minute
            raise self._over(Limit.ENGINE, f"more than {allowed:g} s of the engine a minute", wait)

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


def _meter(allowed: float | None, period_s: float, taken: float) -> Meter | None:
    if allowed is None:
        return None
    meter = Meter(allowed, period_s)
    meter._seen = taken
    return meter


@dataclass(eq=False)
class Payer:
    """Who pays for what a task does.

    Attributes:
        account: that everything is counted for.
        waits: for the engine where others are refused, as jobs do.
        on_engine: whether the present request or message was let on the engine.
    """

    account: Account
    waits: bool = False
    on_engine: bool = False

    async def let_on_engine(self) -> None:
        """Return once the account may use the engine; a request is asked once, not half-way.

        Raises:
            OverLimitError: not now, unless it waits.
        """
        while not self.on_engine:
            try:
                self.account.check_engine()
                self.on_engine = not self.waits
                return
            except OverLimitError as error:
                if not self.waits:
                    raise
                wait_s = min(error.retry_after_s, PATIENCE_S)
                await clock.sleep_until(clock.monotonic() + wait_s)


PAYER: ContextVar[Payer | None] = ContextVar("payer", default=None)
"""Of the running task; tasks and threads that it starts have the same one."""


def admit_message() -> None:
    """Let a message of a socket in, and count it; see :meth:`Account.admit`."""
    payer = PAYER.get()
    if payer is not None:
        payer.account.admit()
        payer.on_engine = False


def admitted_at_once() -> Account | None:
    """Let a message in and count it where no limit has to be asked, neither of messages nor of
    computing; whose it is, None where it has to go by :func:`admit_message`."""
    payer = PAYER.get()
    if payer is None or payer.waits or payer.account.revoked or payer.account.is_limited:
        return None
    payer.account.requests += 1
    return payer.account


def count_sent(nbytes: int) -> None:
    """Count what reaches the client of the running task by another way than its connection."""
    payer = PAYER.get()
    if payer is not None:
        payer.account.sent_bytes += nbytes


async def computing_account() -> Account | None:
    """Whose computing time the running task is about to take; None for nobody's.

    Raises:
        OverLimitError: of engine time; a job waits instead.
    """
    payer = PAYER.get()
    if payer is None:
        return None
    if payer.account.limits.engine_seconds_per_minute is not None:
        await payer.let_on_engine()
    return payer.account


def counted_world_time(account: Account | None, fn: Callable[..., T], *args: Any) -> T:
    """``fn(*args)``, its processor time counted for ``account``; on the thread of worlds."""
    if account is None:
        return fn(*args)
    began = time.thread_time()
    try:
        return fn(*args)
    finally:
        account.world_seconds += time.thread_time() - began


def owner_name() -> str:
    """Name of the account that the running task makes things for."""
    payer = PAYER.get()
    return payer.account.name if payer is not None else DEFAULT_NAME


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
            account.received_bytes, account.sent_bytes = before.received_bytes, before.sent_bytes
            account.engine_seconds = before.engine_seconds
            account.world_seconds = before.world_seconds
            account.limit(account.limits)
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
