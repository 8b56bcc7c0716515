"""How requests reach the worker: addresses, time limits, retries."""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import re
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, TypeVar
from urllib.parse import urlsplit

import httpx2

from ._call import Call, Request
from ._replies import Reply, refusal_error
from ._retry import RETRYABLE_STATUS, RetryPolicy
from .errors import Real2SimError, ReplyTimeoutError, StatusError, UnreachableError

T = TypeVar("T")

CLIENT_HEADER = "X-Real2Sim-Client"


@dataclass(frozen=True)
class Target:
    """Where the worker is and how long to wait for it.

    Attributes:
        url: ``http://host:port`` or ``https://...``, with an optional path prefix.
        token: sent as bearer token; never shown.
        timeout: seconds that a reply may take.
        patience: seconds for the calls that may load a scene, compile kernels or run many steps.
        name: who is calling, for the history of scenarios.
    """

    url: str
    token: str | None = field(default=None, repr=False)
    timeout: float = 30.0
    patience: float = 300.0
    name: str | None = None
    policy: RetryPolicy = field(default_factory=RetryPolicy, repr=False)

    def __post_init__(self) -> None:
        parts = urlsplit(self.url)
        if parts.scheme not in {"http", "https"} or not parts.hostname:
            raise ValueError(f"url {self.url!r} is not an address like 'http://127.0.0.1:8600'")
        if parts.username or parts.password:
            raise ValueError("the url holds credentials; give a token as token=... instead")
        if self.name is not None and not re.fullmatch(r"[ -~]{1,80}", self.name):
            raise ValueError(f"name {self.name!r} is not 1 to 80 printable ASCII characters")
        if self.timeout <= 0:
            raise ValueError(f"timeout is {self.timeout!r}; give seconds above 0")
        object.__setattr__(self, "url", self.url.rstrip("/"))
        object.__setattr__(self, "patience", max(self.patience, self.timeout))

    def __str__(self) -> str:
        return f"{self.url!r}, token={'***' if self.token else None}"

    @property
    def loopback(self) -> bool:
        """Whether the worker is on this machine, as far as the address tells."""
        host = urlsplit(self.url).hostname or ""
        if host == "localhost":
            return True
        try:
            return ipaddress.ip_address(host).is_loopback
        except ValueError:
            return False

    @property
    def headers(self) -> dict[str, str]:
        headers = {} if self.token is None else {"Authorization": f"Bearer {self.token}"}
        return headers if self.name is None else headers | {CLIENT_HEADER: self.name}

    def drive_url(self, session_id: str) -> str:
        """Address of a session's drive socket, by the way this client reaches the worker."""
        scheme, rest = self.url.split("://", 1)
        return f"{'wss' if scheme == 'https' else 'ws'}://{rest}/v1/sessions/{session_id}/drive"

    def codec(self, wanted: str) -> str:
        """'auto' made concrete: raw on loopback, where copying beats coding; else jpeg."""
        if wanted != "auto":
            return wanted
        return "raw" if self.loopback else "jpeg"


class Transport:
    """Sends calls and waits."""

    def __init__(self, target: Target, *, transport: httpx2.BaseTransport | None = None) -> None:
        self.target = target
        self._http = httpx2.Client(transport=transport, **_options(target))

    def send(self, call: Call[T]) -> T:
        """The parsed answer; retried where that is safe."""
        attempts = Attempts(self.target.policy, call.request)
        while True:
            try:
                return call.parse(self._exchange(call.request))
            except Real2SimError as error:
                delay = attempts.delay_after(error)
            time.sleep(delay)

    def _exchange(self, request: Request) -> Reply:
        with _translated(self.target, request), _arguments(self.target, request) as arguments:
            response = self._http.request(request.method, request.path, **arguments)
        return _accepted(response, request)

    def close(self) -> None:
        self._http.close()


class AsyncTransport:
    """Sends calls and awaits."""

    def __init__(
        self, target: Target, *, transport: httpx2.AsyncBaseTransport | None = None
    ) -> None:
        self.target = target
        self._http = httpx2.AsyncClient(transport=transport, **_options(target))

    async def send(self, call: Call[T]) -> T:
        """The parsed answer; retried where that is safe."""
        attempts = Attempts(self.target.policy, call.request)
        while True:
            try:
                return call.parse(await self._exchange(call.request))
            except Real2SimError as error:
                delay = attempts.delay_after(error)
            await asyncio.sleep(delay)

    async def _exchange(self, request: Request) -> Reply:
        with _translated(self.target, request), _arguments(self.target, request) as arguments:
            response = await self._http.request(request.method, request.path, **arguments)
        return _accepted(response, request)

    async def close(self) -> None:
        await self._http.aclose()


class Attempts:
    """Counts the tries of one request."""

    def __init__(self, policy: RetryPolicy, request: Request) -> None:
        self._policy = policy
        self._request = request
        self._made = 0

    def delay_after(self, error: Real2SimError) -> float:
        """Seconds until the next try.

        Raises:
            Real2SimError: the error itself, when there is no next try.
        """
        delay = None
        # Who has waited long already would only add work to a worker that is slow.
        waited = self._request.patient and isinstance(error, ReplyTimeoutError)
        if self._request.idempotent and not waited and _passing(error):
            retry_after = error.retry_after if isinstance(error, StatusError) else None
            delay = self._policy.delay(self._made, retry_after=retry_after)
        self._made += 1
        if delay is None:
            raise error
        return delay


def _passing(error: Real2SimError) -> bool:
    if isinstance(error, StatusError):
        return error.status in RETRYABLE_STATUS
    return isinstance(error, UnreachableError | ReplyTimeoutError)


def _options(target: Target) -> dict[str, Any]:
    # A proxy that the environment names cannot reach a worker on this machine.
    return {
        "base_url": target.url,
        "headers": target.headers,
        "timeout": target.timeout,
        "trust_env": not target.loopback,
    }


@contextlib.contextmanager
def _arguments(target: Target, request: Request) -> Iterator[dict[str, Any]]:
    arguments: dict[str, Any] = {
        "params": request.params,
        "headers": request.headers,
        "content": request.body,
        "timeout": _seconds(target, request),
    }
    if request.upload is None:
        yield arguments
        return
    with request.upload.open("rb") as file:
        yield arguments | {"data": request.form, "files": {"file": (request.upload.name, file)}}


@contextlib.contextmanager
def _translated(target: Target, request: Request) -> Iterator[None]:
    try:
        yield
    except httpx2.ConnectTimeout as error:
        raise ReplyTimeoutError(
            f"connection to {target.url}", _seconds(target, request), hint=_HINT
        ) from error
    except httpx2.TimeoutException as error:
        raise ReplyTimeoutError(
            f"reply to {request} from {target.url}",
            _seconds(target, request),
            hint="the worker may be busy; see `real2sim status`, or give a longer timeout",
        ) from error
    except httpx2.ConnectError as error:
        raise UnreachableError(f"no worker answers at {target.url}: {error}", hint=_HINT) from error
    except httpx2.TransportError as error:
        raise UnreachableError(
            f"the connection to {target.url} broke during {request}: {error or type(error)}",
        ) from error


_HINT = "start a worker with `real2sim serve`, or check the address"


def _seconds(target: Target, request: Request) -> float:
    return target.patience if request.patient else target.timeout


def _accepted(response: httpx2.Response, request: Request) -> Reply:
    headers = {name.lower(): value for name, value in response.headers.items()}
    reply = Reply(response.status_code, headers, response.content)
    if reply.status >= 300 and reply.status not in request.accepted:
        raise refusal_error(reply)
    return reply
