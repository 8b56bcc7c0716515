"""The address of a worker, timeouts, and how requests and failures map to HTTP."""

from __future__ import annotations

import contextlib
import ipaddress
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import urlsplit

import httpx2

from real2sim_proto.base import bearer_token

from ._calls import (
    RETRYABLE_CODES,
    RETRYABLE_STATUS,
    Reply,
    Request,
    RetryPolicy,
    bearer,
    error_from_reply,
)
from .errors import Real2SimError, ReplyTimeoutError, StatusError, UnreachableError

# The worker's address and timeouts.

DEFAULT_URL = "http://127.0.0.1:8600"
URL_VARIABLE = "REAL2SIM_URL"
TOKEN_VARIABLE = "REAL2SIM_TOKEN"
CLIENT_HEADER = "X-Real2Sim-Client"


@dataclass(frozen=True)
class Target:
    """Address of the worker, and timeouts.

    Attributes:
        url: ``http://host:port`` or ``https://...``, with an optional path prefix; white space
            around it and slashes at its end are removed.
        token: sent as bearer token; never displayed.
        timeout: maximum seconds to wait for a reply.
        long_timeout: seconds for calls that may load a scene, compile kernels or run many steps.
        name: name of the caller, for the history of scenarios.
        policy: which requests are retried.
        shared_memory: default for sessions: required (True), disabled (False), or None.
    """

    url: str
    token: str | None = field(default=None, repr=False)
    timeout: float = 30.0
    long_timeout: float = 300.0
    name: str | None = None
    policy: RetryPolicy = field(default_factory=RetryPolicy, repr=False)
    shared_memory: bool | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "url", _checked_url(self.url))
        if self.name is not None and not re.fullmatch(r"[ -~]{1,80}", self.name):
            raise ValueError(f"name {self.name!r} is not 1 to 80 printable ASCII characters")
        if self.timeout <= 0:
            raise ValueError(f"timeout is {self.timeout!r}; give seconds above 0")
        if self.token is not None:
            object.__setattr__(self, "token", bearer_token(self.token) or None)
        object.__setattr__(self, "long_timeout", max(self.long_timeout, self.timeout))

    def __str__(self) -> str:
        return f"{self.url!r}, token={'***' if self.token else None}"

    @property
    def loopback(self) -> bool:
        """Whether the address is a loopback address."""
        host = urlsplit(self.url).hostname or ""
        if host == "localhost":
            return True
        try:
            return ipaddress.ip_address(host).is_loopback
        except ValueError:
            return False

    @property
    def headers(self) -> dict[str, str]:
        headers = bearer(self.token)
        return headers if self.name is None else headers | {CLIENT_HEADER: self.name}

    def drive_url(self, session_id: str) -> str:
        """Address of a session's drive socket, on the host that this client uses."""
        scheme, rest = self.url.split("://", 1)
        return f"{'wss' if scheme == 'https' else 'ws'}://{rest}/v1/sessions/{session_id}/drive"

    def codec(self, codec: str) -> str:
        """Resolve 'auto': raw on loopback, where copying is faster than encoding; else jpeg."""
        if codec != "auto":
            return codec
        return "raw" if self.loopback else "jpeg"

    def image_codec(self, codec: str, modality: str) -> str:
        """Resolve 'auto' for an image of a modality; only rgb has a lossy codec."""
        if codec == "auto" and modality != "rgb":
            return "raw"
        return self.codec(codec)


def _checked_url(text: str) -> str:
    """An address without surrounding white space. Messages never show what may be a secret."""
    url = text.strip().rstrip("/")
    for place, character in enumerate(url, 1):
        if character.isspace() or not character.isprintable():
            raise ValueError(
                f"character {place} of the url is U+{ord(character):04X}; an address has no white "
                "space and no control characters"
            )
    if "@" in url:
        raise ValueError("the url holds credentials; give a token as token=... instead")
    if "?" in url or "#" in url:
        raise ValueError(
            "the url has a part after '?' or '#'; give only the address, and a token as token=..."
        )
    try:
        parts = urlsplit(url)
        found = parts.scheme in {"http", "https"} and parts.hostname and parts.port != 0
    except ValueError:
        found = False
    if not found:
        raise ValueError(f"url {url!r} is not an address like {DEFAULT_URL!r}")
    return url


def resolve_target(
    url: str | None,
    token: str | None,
    *,
    timeout: float,
    name: str | None,
    retries: int,
    shared_memory: bool | None = None,
) -> Target:
    """Resolve a target from arguments; for None, from the environment, then the defaults.

    Raises:
        ValueError: invalid address or token; the message says whether it comes from the
            environment.
    """
    if not url and (found := os.environ.get(URL_VARIABLE)):
        with _from_variable(URL_VARIABLE):
            url = _checked_url(found)
    if token is None and (found := os.environ.get(TOKEN_VARIABLE)):
        with _from_variable(TOKEN_VARIABLE):
            token = bearer_token(found)
    return Target(
        url or DEFAULT_URL,
        token or None,
        timeout,
        name=name,
        policy=RetryPolicy(retries),
        shared_memory=shared_memory,
    )


@contextlib.contextmanager
def _from_variable(name: str) -> Iterator[None]:
    """Add the name of an environment variable to the error for its value."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{error} (from {name})") from None


UNREACHABLE_HINT = "start a worker with `real2sim serve`, or check the address"


def client_options(target: Target) -> dict[str, Any]:
    """Arguments of an HTTP client for a worker."""
    # A proxy set in the environment cannot reach a worker on this machine.
    return {
        "base_url": target.url,
        "headers": target.headers,
        "timeout": target.timeout,
        "trust_env": not target.loopback,
    }


@contextlib.contextmanager
def request_options(target: Target, request: Request) -> Iterator[dict[str, Any]]:
    """Arguments of one request; the uploaded file, if any, stays open within the block."""
    options: dict[str, Any] = {
        "params": request.params,
        "headers": request.headers,
        "content": request.body,
        "timeout": timeout_of(target, request),
    }
    if request.upload is None:
        yield options
        return
    with request.upload.open("rb") as file:
        yield options | {"data": request.form, "files": {"file": (request.upload.name, file)}}


@contextlib.contextmanager
def http_errors(target: Target, request: Request) -> Iterator[None]:
    """Convert errors of the HTTP library into errors of the SDK."""
    try:
        yield
    except httpx2.ConnectTimeout:
        raise ReplyTimeoutError(
            f"connection to {target.url}", timeout_of(target, request), hint=UNREACHABLE_HINT
        ) from None
    except httpx2.TimeoutException:
        raise ReplyTimeoutError(
            f"reply to {request} from {target.url}",
            timeout_of(target, request),
            hint="the worker may be busy; see `real2sim status`, or give a longer timeout",
        ) from None
    except httpx2.ConnectError as error:
        raise UnreachableError(
            f"no worker answers at {target.url}: {error}", hint=UNREACHABLE_HINT
        ) from None
    except httpx2.TransportError as error:
        raise UnreachableError(
            f"the connection to {target.url} broke during {request}: {error or type(error)}",
        ) from error


def timeout_of(target: Target, request: Request) -> float:
    """Seconds that the reply may take."""
    return target.long_timeout if request.long_timeout else target.timeout


def accepted_reply(response: httpx2.Response, request: Request) -> Reply:
    """The reply in a response. Raises Real2SimError if the worker refuses the request."""
    headers = {name.lower(): value for name, value in response.headers.items()}
    reply = Reply(response.status_code, headers, response.content)
    # A proxy may send the same status with a different body.
    expected = reply.status in request.accepted and reply.media_type == "application/json"
    if reply.status >= 300 and not expected:
        raise error_from_reply(reply)
    return reply


class Attempts:
    """Counts the attempts of one request."""

    def __init__(self, policy: RetryPolicy, request: Request) -> None:
        self._policy = policy
        self._request = request
        self._made = 0

    def delay_after(self, error: Real2SimError) -> float | None:
        """Seconds until the next attempt; None to give up."""
        attempt, self._made = self._made, self._made + 1
        # After a long wait, a retry would only add load to a slow worker.
        waited = self._request.long_timeout and isinstance(error, ReplyTimeoutError)
        if not self._request.idempotent or waited or not _is_transient(error):
            return None
        retry_after = error.retry_after if isinstance(error, StatusError) else None
        return self._policy.delay(attempt, retry_after=retry_after)


def _is_transient(error: Real2SimError) -> bool:
    if isinstance(error, StatusError):
        return error.status in RETRYABLE_STATUS or error.code in RETRYABLE_CODES
    return isinstance(error, UnreachableError | ReplyTimeoutError)
